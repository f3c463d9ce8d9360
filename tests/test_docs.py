"""The pages: examples run, commands exist, tables are those of the records, links lead somewhere."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

import lint_length
import symphony.cli
from helpers_processes import output_of
from helpers_store import brief

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md"))
PAGES = ("README.md", "CONTRIBUTING.md", "recipes/README.md", *DOCS)
WHY = r"^(?:<!-- not run: (?P<reason>[^\n]+) -->\n)?"
FENCE = re.compile(WHY + r"```(?P<kind>\w+)(?P<more>[^\n]*)\n(?P<text>.*?)^```$", re.M | re.S)
"""A block of code; a comment before it says why it is not run, and `title="FILE"` that it is a file."""


def blocks(page: str, kind: str) -> list[tuple[str, str]]:
    """Text of every block that is meant to work, with the file that it is (or nothing)."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = [block for block in FENCE.finditer(text) if block["kind"] == kind and not block["reason"]]
    titles = [re.search(r'title="([^"]+)"', block["more"]) for block in found]
    return [(block["text"], title[1] if title else "") for block, title in zip(found, titles, strict=True)]


def commands(page: str) -> list[list[str]]:
    """Every command of the shell blocks of a page, lines joined, loops at their first word, without comments."""
    found = []
    for block, _ in blocks(page, "sh"):
        first = dict(re.findall(r"for (\w+) in (\w+)", block))
        text = re.sub(r"\$(\w+)", lambda name, first=first: first.get(name[1], "1"), block)
        for line in text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["torchrun"]:
                words = words[words.index("-m") + 1 :]
            if words:
                found.append(words)
    return found


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brief(tmp_path_factory.mktemp("brief") / "store", range(4), steps=16)


@pytest.mark.filterwarnings("ignore::symphony.errors.DataWarning")  # code that an agent names, and is trusted
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")])
def test_examples_run(page: str, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("symphony.data.builtin.builtin_store", lambda split: store)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    before, space = set(sys.modules), {"__name__": "example"}
    with contextlib.redirect_stdout(io.StringIO()):
        for text, file in blocks(page, "python"):
            if file:
                (tmp_path / file).write_text(text)
            else:
                exec(compile(text, page, "exec"), space)  # noqa: S102
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", None)):
            del sys.modules[name]


@pytest.mark.parametrize("page", PAGES)
def test_commands_are_understood(page: str, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setattr(symphony.cli, "guarded", lambda run: 0)  # parsed as ever, but nothing runs
    for words in commands(page):
        status = symphony.cli.main(words[1:]) if words[0] == "symphony" else 0
        assert status == 0, f"{page}: {shlex.join(words)}\n{capsys.readouterr().err}"


def test_other_commands_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    for page in PAGES:
        for words in commands(page):
            assert words[0] != "make" or words[1] in targets, f"{page}: {shlex.join(words)}"
            assert words[0] != "python" or (ROOT / words[1]).is_file(), f"{page}: {shlex.join(words)}"
        assert {*re.findall(r"`make ([a-z-]+)`", (ROOT / page).read_text())} <= targets, page


def test_tables_are_those_of_the_records_which_are_few_and_say_how_they_were_made(capsys: Any) -> None:
    tables = runpy.run_path(str(ROOT / "benchmarks" / "results_page.py"))
    assert tables["main"](["--check"]) == 0, capsys.readouterr().err
    pages = "".join((ROOT / name).read_text() for name in tables["PAGES"])
    records = {path.stem: json.loads(path.read_text()) for path in tables["RECORDS"].glob("*.json")}
    assert {found[2] for found in tables["BLOCK"].finditer(pages)} == records.keys()
    assert sum(path.stat().st_size for path in tables["RECORDS"].iterdir()) < 1_000_000
    assert len(tables["BLOCK"].findall((ROOT / "docs" / "results.md").read_text())) <= 5
    for record in records.values():
        assert record["of"]
        assert set(record["made"]) == {"commit", "command"}
        assert len(record["rows"]) <= 12


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as they are made for it."""
    headings = re.findall(r"(?m)^#+ (.+)$", page.read_text())
    return {re.sub(r"[^a-z0-9 -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_lead_somewhere() -> None:
    for page in (ROOT / name for name in PAGES if "reference" not in name):
        for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
            place, _, anchor = link.partition("#")
            if not link.startswith(("https://", "reference/")):  # the latter are made with the pages
                other = page.parent / place if place else page
                assert other.exists(), f"{page}: {link}"
                assert not anchor or anchor in anchors(other), f"{page}: {link}"


def test_pages_are_short() -> None:
    assert lint_length.words(ROOT) <= 14_000
    assert len((ROOT / "docs/ablations.md").read_text().split()) <= 1_200
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


OTHERS = re.compile(r"(?<![\w-])symphony\[[a-z]|pip install (?:[^\n`|#]*[\s'\"])?symphony(?![\w-])")
"""Of the package index: an extra of `symphony`, or `symphony` itself, which is another project."""


def test_nothing_tells_to_install_another_project() -> None:
    folders = [ROOT / name for name in ("docs", "src", "tests", "recipes", "examples", "benchmarks")]
    files = [*ROOT.glob("*"), *(file for folder in folders for file in folder.rglob("*"))]
    for file in (file for file in files if file.suffix in {".md", ".py", ".toml"}):
        found = OTHERS.search(file.read_text(encoding="utf-8"))
        assert found is None, f"{file.relative_to(ROOT)}: {found and found[0]}"


def _built(out: str) -> int:
    """Build the pages; the package, which a hook looks at, is imported here already."""
    os.chdir(ROOT)
    os.environ["NO_MKDOCS_2_WARNING"] = "1"
    warnings.simplefilter("default")
    from mkdocs.__main__ import cli

    return cli(["build", "--strict", "--quiet", "--site-dir", out], standalone_mode=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed (the extra [docs])")
    out = tmp_path_factory.mktemp("site")
    output_of(_built, str(out), said=tmp_path_factory.mktemp("said") / "said")
    return out


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    missing = set()
    for package in sorted((ROOT / "src" / "symphony").glob("*/__init__.py")):
        room = package.parent.name
        module = importlib.import_module(f"symphony.{room}")
        objects = [getattr(module, name) for name in getattr(module, "__all__", ())]
        names = {found.__name__ for found in objects if inspect.isclass(found) or inspect.isfunction(found)}
        if room != "cli" and names:
            page = (site / "reference" / f"{room}.html").read_text(encoding="utf-8")
            shown = set(re.findall(rf'id="symphony\.{room}\.(?:\w+\.)*(\w+)"', page))
            missing |= {f"{room}.{name}" for name in names - shown}
    # Where a function has the name of its module, the page needs `::: symphony.ROOM.NAME.NAME`.
    assert missing == set()


def test_docstrings_are_markdown_in_the_reference(site: Path) -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in (site / "reference").glob("*.html"))
    prose = re.sub(r'<span class="sd">.*?</span>', "", pages)  # without the sources that are shown
    assert re.findall(r"[^\n]*:(?:class|func|meth|data|mod|attr):[^\n]*", prose) == []
    assert "[*env.batch_size, T]" in pages  # not the beginning of an emphasis


def test_the_pages_build(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path], cwd=ROOT, check=True
    )
