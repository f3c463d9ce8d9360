"""For the reference: a page for each package, and docstrings as Markdown."""

from __future__ import annotations

import ast
import inspect
import linecache
import re
from pathlib import Path
from typing import Any

from griffe import Docstring, Extension, Object
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import symphony

ROOT = Path(__file__).resolve().parents[1]
ROOMS = sorted({file.parent.name for file in ROOT.glob("src/symphony/*/__init__.py")} - {"cli"})
RECIPES = [file.stem for file in sorted((ROOT / "recipes").glob("*.py")) if f"def {file.stem}(" in file.read_text()]
FURTHER = {
    "data": (
        *("segment.RunSegment", "store.SegmentStore", "builtin.builtin_store", "convert.convert"),
        *("sources.base.Reader", "conformance.check_reader", "conformance.check_segments"),
    ),
    "config": ("evaluation.SimulationConfig", "training.RunConfig"),
    "envs": ("scene.scene",),
    "modules": ("realism.discriminator",),
    "collectors": ("beam_search.beam_search",),
    "roadgraph": ("routes.routes",),
    "planners": (
        "gym.DrivingGym",
        *(f"interface.{name}" for name in ("Planner", "Scenario", "Traffic", "Pose", "Control")),
        *("included.IDMPlanner", "included.LogPlanner"),
    ),
    "saved": (
        "rollouts.SavedRollouts",
        "rollouts.SavedTrees",
        "rollouts.saved_rollouts",
        "folder.save_rollouts",
        "folder.load_rollouts",
    ),
    "wosac": ("scorer", "submission.write_submission"),
    "training": ("processes.processes",),
    "recipes": tuple(f"{name}.{name}" for name in RECIPES),
}
"""What is not found through a package: modules that it does not import, and functions with the name of theirs."""
TOP = """# symphony

What `import symphony` offers. These names stay what they are, or are announced in the changelog before they
change; all else may change with a version.

| name | what it is |
| --- | --- |
"""
ROLE = re.compile(r":(?:class|func|meth|data|mod|attr|exc):`~?([^`]+)`")
STAR = re.compile(r"(`+[^`]+`+)|\[\*")


def homes(file: Path) -> dict[str, str]:
    """Modules that a package imports its names from."""
    imports = [n for n in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(n, ast.ImportFrom)]
    return {name.name: str(node.module) for node in imports for name in node.names if name.asname}


def page(room: str) -> str:
    """The page of a package: all that it exports, then what it does not; recipes with their code."""
    options = "    options:\n      show_root_heading: false\n      show_root_toc_entry: false\n"
    source = "    options:\n      show_source: true\n" if room == "recipes" else ""
    parts = [f"# symphony.{room}\n", f"::: symphony.{room}\n{options}"]
    file = ROOT / f"src/symphony/{room}/__init__.py"
    if "__all__ = __dir__()" in file.read_text(encoding="utf-8"):  # names that are not written out
        parts += [f"::: {home}.{name}\n" for name, home in homes(file).items() if home.startswith("symphony.")]
    parts += [f"::: symphony.{room}.{name}\n{source}" for name in FURTHER.get(room, ())]
    return "\n".join(parts)


def public() -> str:
    """The page of the names that most users need: each with the first sentence of its docstring."""
    place, rows = homes(ROOT / "src/symphony/__init__.py"), []
    for name in (name for name in symphony.__all__ if not name.startswith("_")):
        first = as_markdown(inspect.getdoc(getattr(symphony, name)) or "").partition("\n")[0].rstrip(".")
        rows.append(f"| [`{name}`][{place[name]}.{name}] | {first} |\n")
    return TOP + "".join(rows)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of all packages, and of what the package itself names."""
    files.append(File.generated(config, "reference/symphony.md", content=public()))
    for room in ROOMS:
        files.append(File.generated(config, f"reference/{room}.md", content=page(room)))
    return files


def as_markdown(text: str) -> str:
    """Roles become code; a star that begins a shape, outside of code, no emphasis."""
    return STAR.sub(lambda found: found[1] or r"[\*", ROLE.sub(r"`\1`", text))


def comment(file: str, line: int) -> str:
    """What a comment says of the setting on a line of a file: ``#:`` above it, or behind it."""
    text = linecache.getline(file, line).rpartition("  # ")
    lines = [text[2].strip()] if text[1] else []
    while (above := linecache.getline(file, line := line - 1).strip()).startswith("#:"):
        lines.insert(0, above[2:].strip())
    return " ".join(lines)


class Markdown(Extension):
    """Rewrites every docstring that is loaded; a setting without one has its comment."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """See :func:`as_markdown`."""
        if obj.docstring is None and obj.is_attribute and obj.lineno:
            said = comment(str(obj.filepath), obj.lineno)
            obj.docstring = Docstring(said, parent=obj) if said else None
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
