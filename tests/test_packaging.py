"""The promises of a fresh checkout: pinned versions, targets that set themselves up, one-way imports."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import lint_length

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LISTED = {"core": PROJECT["dependencies"], **PROJECT["optional-dependencies"]}
NEEDS = {extra: list(map(Requirement, lines)) for extra, lines in LISTED.items()}
RUNTIME = {*NEEDS} - {"dev", "docs"}


def pins(file: str = "constraints.txt") -> dict[str, str]:
    lines = (ROOT / file).read_text().splitlines()
    found = [line.split("==") for line in lines if line and not line.startswith("#")]
    assert len(dict(found)) == len(found), "pinned twice"
    return {canonicalize_name(name): version for name, version in found}


def make(*arguments: str, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    if (program := shutil.which("make")) is None:
        pytest.skip("make is not installed")
    # The tests may themselves be run by make, with settings of its own.
    own = ("MAKE", "MFLAGS", "PYTHON", "VENV", "CONSTRAINTS")
    env = {key: value for key, value in os.environ.items() if not key.startswith(own)} | environment
    command = [program, *arguments]
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("file", ["constraints.txt", "constraints-lowest.txt"])
def test_every_dependency_is_pinned_within_its_range(file: str) -> None:
    found = pins(file)
    # A build tag such as +cpu is found on some package indices only.
    assert all(re.fullmatch(r"[0-9][0-9a-z.]*", version) for version in found.values())
    for need in (need for needs in NEEDS.values() for need in needs):
        version = found[canonicalize_name(need.name)]
        assert need.specifier.contains(version, prereleases=True), f"{need}: pinned to {version}"


@pytest.mark.parametrize("line", [r"# with extras: (.+)", r"Extras: (.+)\."])
def test_the_readme_names_the_extras_that_there_are(line: str) -> None:
    found = re.findall(line, (ROOT / "README.md").read_text())[0]
    words = re.sub(r"\([^)]*\)", "", found).replace(" and ", ", ").replace("`", "")
    assert {word.strip() for word in words.split(",")} == RUNTIME - {"core"}


def test_the_lowest_versions_are_those_promised_and_the_next_major_ones_are_not() -> None:
    lowest, pinned, found = {}, pins(), pins("constraints-lowest.txt")
    for extra, need in ((extra, need) for extra, needs in NEEDS.items() for need in needs):
        name, parts = canonicalize_name(need.name), need.specifier
        lowest[name] = next(part.version for part in parts if part.operator == ">=")
        following = f"{Version(pinned[name]).major + 1}.0"
        assert extra not in RUNTIME or not parts.contains(following, prereleases=True), need
    assert {name: found[name] for name in pinned} == pinned | lowest


def test_pins_reach_everything_the_core_needs() -> None:
    todo, seen = [need.name for need in NEEDS["core"]], set()
    while todo:
        if (name := canonicalize_name(todo.pop())) not in seen:
            seen.add(name)
            for need in map(Requirement, importlib.metadata.requires(name) or []):
                # What a build of torch for CUDA brings is its own affair.
                ours = not need.name.startswith(("nvidia-", "cuda-", "triton"))
                if ours and (need.marker is None or need.marker.evaluate({"extra": ""})):
                    todo.append(need.name)
    tested = importlib.metadata.version("matplotlib") == pins()["matplotlib"]
    assert seen - set(pins("constraints.txt" if tested else "constraints-lowest.txt")) == set()


@pytest.mark.parametrize(("target", "commands"), [
    ("demo", "bin/symphony demo --out out/demo"), ("table", "bin/python benchmarks/make_table.py --out out/table"),
    ("test", "bin/python -m pytest"),
    ("lint", "ruff check|ruff format --check|codespell|mypy|lint-imports|tests/tools/lint_length.py"),
    ("docs", "bin/mkdocs build --strict"),
])  # fmt: skip
def test_targets_set_themselves_up_once(target: str, commands: str, tmp_path: Path) -> None:
    """And again after a change of the dependencies."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    (venv := tmp_path / ".venv").mkdir()

    def told() -> str:
        return make("--dry-run", target, f"VENV={venv}", cwd=tmp_path).stdout

    first = told()
    assert [line for line in first.splitlines() if "-c constraints.txt -e" in line]
    listed = re.search(r"-e '\.\[(.+)\]'", first)
    assert (listed is not None) == (target not in {"demo", "table"})
    assert listed is None or sorted([*listed[1].split(","), "core"]) == sorted(NEEDS)
    for stamp in (venv / ".core", venv / ".dev"):
        stamp.touch()
    again = told()
    assert "pip" not in again
    assert all(command in first and command in again for command in commands.split("|"))
    later = (venv / ".dev").stat().st_mtime
    for changed in ("pyproject.toml", "constraints.txt"):
        os.utime(tmp_path / changed, (later + 10, later + 10))
        assert "pip install" in told()
        os.utime(tmp_path / changed, (later - 10, later - 10))


def test_a_wheel_holds_all_of_the_package(tmp_path: Path) -> None:
    (source := tmp_path / "source").mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, source / name)
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("recipes", "src"):
        shutil.copytree(ROOT / name, source / name, ignore=ignored, symlinks=True)
    code = "from setuptools.build_meta import build_wheel; build_wheel('..')"
    command = [sys.executable, "-W", "default", "-c", code]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("symphony_traffic-*.whl")
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    paths = (path for path in (ROOT / "src" / "symphony").rglob("*") if path.is_file())
    files = [path for path in paths if "__pycache__" not in path.parts]
    # A link to a folder at the top, whose files no search of this kind finds.
    recipes = {f"symphony/recipes/{file.name}" for file in (ROOT / "recipes").glob("*.py")}
    assert held == recipes | {str(file.relative_to(ROOT / "src")) for file in files}
    parts = ("py.typed", "data/builtin/test/store.json", "pretrained/bc_ts_h/config.json")
    assert held >= {f"symphony/{part}" for part in parts}


def test_long_files_and_rooms_are_found(tmp_path: Path) -> None:
    room = tmp_path / "src" / "symphony" / "deep"
    room.mkdir(parents=True)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text("word " * 12)
    (room / "short.py").write_text("x = 1\n" * 600)
    (room / "made_pb2.py").write_text("x = 1\n" * 900)
    rows = ["| `deep` | all | – | 1 200 |", "| `docs/` | pages | | 12 words |"]
    (tmp_path / "CONTRIBUTING.md").write_text("\n".join(rows))
    too_much = ["src/symphony/deep/long.py: 601 lines, may have 600", "deep: 1201 lines, may have 1200"]
    for lines, expected in ((600, []), (601, too_much)):
        (room / "long.py").write_text("x = 1\n" * lines)
        assert lint_length.long_files(tmp_path) + lint_length.large_rooms(tmp_path) == expected
    (tmp_path / "docs" / "page.md").write_text("word " * 13)
    (tmp_path / "CONTRIBUTING.md").write_text(rows[1])
    told = ["docs: 13 words, may have 12", "deep: has no place in the table of CONTRIBUTING.md"]
    assert lint_length.large_rooms(tmp_path) == told
