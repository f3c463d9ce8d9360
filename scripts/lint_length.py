"""Fail when a Python file is longer than it may be; generated files are left out."""

from __future__ import annotations

import sys
from pathlib import Path

FOLDERS = ("src", "tests", "scripts", "recipes", "examples", "benchmarks")
LIMIT = 600
RECIPE = 80
"""Lines of a recipe, in which a method is to be seen at a glance."""


def limit_of(file: Path) -> int:
    """How many lines a file may have."""
    return RECIPE if file.parent.name == "recipes" else LIMIT


def too_long(root: Path) -> list[tuple[Path, int]]:
    """The files below ``root`` with more lines than they may have, with their lengths."""
    files = [file for folder in FOLDERS for file in sorted((root / folder).rglob("*.py"))]
    lengths = [
        (file, len(file.read_text(encoding="utf-8").splitlines()))
        for file in files
        if not file.name.endswith("_pb2.py")
    ]
    return [(file, length) for file, length in lengths if length > limit_of(file)]


def main() -> int:
    """Report on the repository this script lies in."""
    root = Path(__file__).resolve().parents[1]
    found = too_long(root)
    for file, length in found:
        print(f"{file.relative_to(root)}: {length} lines, may have {limit_of(file)}", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
