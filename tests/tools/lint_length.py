"""Fail where a file, a room of the package, the tests or the pages have become longer than they may be.

A file has at most 600 lines. What else is bounded is the table of rooms in CONTRIBUTING.md.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path("CONTRIBUTING.md")
ROW = re.compile(r"^\| `(?P<room>\w+)/?` \|.*\| (?P<bound>[\d ]+?)(?P<unit> words)? \|$", re.M)
"""A row of the table: a room, what it owns and may import, and its bound."""
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
        most, now = int(row["bound"].replace(" ", "")), size(root, room)
        if now > most:
            found.append(f"{room}: {now} {row['unit'] or ' lines'}, may have {most}".replace("  ", " "))
    package = root / "src" / "symphony"
    folders = {file.relative_to(package).parts[0] for file, _ in python(package)}
    missing = sorted(name for name in folders if not name.endswith(".py") and name not in rows)
    return found + [f"{name}: has no place in the table of {TABLE}" for name in missing]


def main() -> int:
    """Report on the repository this program lies in; status 1 if anything is too long."""
    found = long_files(ROOT) + large_rooms(ROOT)
    print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
