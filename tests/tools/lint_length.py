"""Fail where a file, a room of the package, the tests or the pages have become longer than they may be.

A file has at most 600 lines. What else is bounded is the table of rooms in CONTRIBUTING.md; where a room is still
larger than its bound, the column `today` bounds it instead, so that it can only shrink: `--update` writes that column
anew.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path("CONTRIBUTING.md")
ROW = re.compile(
    r"^(\| `(?P<room>\w+)/?` \|.*\|) (?P<bound>[\d ]+?)(?P<unit> words)? \| (?P<today>[\d ]*?) ?\|$", re.M
)
"""A row of the table: a room, what it owns and may import, its bound, and its size today if that is larger."""
FOLDERS = ("src", "tests", "recipes", "examples", "benchmarks")
LIMIT = 600
RECIPE = 80  # lines of a recipe, in which a method is to be seen at a glance


def python(*folders: Path) -> Iterator[tuple[Path, int]]:
    """The Python files below folders with their lengths; generated ones are left out."""
    for folder in folders:
        for file in sorted(folder.rglob("*.py")):
            if not file.name.endswith("_pb2.py"):
                yield file, len(file.read_text(encoding="utf-8").splitlines())


def long_files(root: Path) -> list[str]:
    """Return what is wrong with single files."""
    found = []
    for file, lines in python(*(root / folder for folder in FOLDERS)):
        most = RECIPE if file.parent.name == "recipes" else LIMIT
        if lines > most:
            found.append(f"{file.relative_to(root)}: {lines} lines, may have {most}")
    return found


def words(root: Path) -> int:
    """Words of the pages and of the text of notebooks, those of tables and code included."""
    texts = [page.read_text(encoding="utf-8") for page in sorted((root / "docs").rglob("*.md"))]
    for notebook in sorted((root / "docs").rglob("*.ipynb")):
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        texts += ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
    return sum(len(text.split()) for text in texts)


def size(root: Path, room: str) -> int:
    """The lines of a room, of all (`symphony`), of the files beside them (`leaves`), of `tests`; words of `docs`."""
    package = root / "src" / "symphony"
    if room == "docs":
        return words(root)
    if room == "symphony":
        return sum(lines for _, lines in python(package))
    if room == "leaves":
        return sum(lines for file, lines in python(package) if file.parent == package)
    return sum(lines for _, lines in python(root / "tests" if room == "tests" else package / room))


def large_rooms(root: Path) -> list[str]:
    """Return what is wrong with rooms: too large, or not in the table."""
    table = (root / TABLE).read_text(encoding="utf-8")
    rows = {row["room"]: row for row in ROW.finditer(table)}
    found = []
    for room, row in rows.items():
        most, now = number(row["today"]) or number(row["bound"]), size(root, room)
        if now > most:
            found.append(f"{room}: {now} {row['unit'] or ' lines'}, may have {most}".replace("  ", " "))
    package = root / "src" / "symphony"
    folders = {file.relative_to(package).parts[0] for file, _ in python(package)}
    missing = sorted(name for name in folders if not name.endswith(".py") and name not in rows)
    return found + [f"{name}: has no place in the table of {TABLE}" for name in missing]


def number(cell: str) -> int:
    """Return the number in a cell; 0 where it is empty."""
    return int(cell.replace(" ", "") or 0)


def updated(root: Path) -> str:
    """The page with the column `today` as it is: empty where a room keeps to its bound."""

    def row(found: re.Match[str]) -> str:
        now = size(root, found["room"])
        today = f" {now:,} ".replace(",", " ") if now > number(found["bound"]) else " "
        return f"{found[1]} {found['bound']}{found['unit'] or ''} |{today}|"

    return ROW.sub(row, (root / TABLE).read_text(encoding="utf-8"))


def main(args: list[str] | None = None) -> int:
    """Report on the repository this program lies in; status 1 if anything is too long."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="write sizes of today into the table")
    if parser.parse_args(args).update:
        (ROOT / TABLE).write_text(updated(ROOT), encoding="utf-8")
    found = long_files(ROOT) + large_rooms(ROOT)
    print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
