"""Write the tables of the pages from the records in `results/`, between their markers.

    python benchmarks/results_page.py            # rewrites the pages
    python benchmarks/results_page.py --check    # says what differs, and fails if anything does

A block is `<!-- table NAME -->`, the table, `<!-- end table -->`, and `results/NAME.json` its record: what it is
`of`, the commit and the command that `made` it, a heading and the digits after the point for each of its `columns`,
and its `rows`. A cell is text, a number, or a number with its standard error.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "results"
PAGES = ("README.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")))
BLOCK = re.compile(r"(<!-- table ([a-z-]+) -->\n)(.*?)(<!-- end table -->)", re.DOTALL)


def cell(value: Any, digits: int = 0) -> str:
    """Return a value of a record as a table has it: text, a number, or a mean ± its standard error."""
    if isinstance(value, str):
        return value
    numbers = value if isinstance(value, list) else [value]
    return " ± ".join(f"{number:.{digits}f}" for number in numbers)


def table(name: str) -> str:
    """Return the table of a record in Markdown.

    Raises:
        FileNotFoundError: there is no such record.
    """
    record = json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))
    columns = record["columns"]
    lines = [[heading for heading, *_ in columns]]
    for row in record["rows"]:
        lines.append([cell(value, *digits) for value, (_, *digits) in zip(row, columns, strict=True)])
    text = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([text[0], "| --- " * len(columns) + "|", *text[1:]]) + "\n"


def rewritten(text: str) -> str:
    """Return a page with every table written again.

    Raises:
        FileNotFoundError: a block names no record.
    """
    return BLOCK.sub(lambda found: found[1] + table(found[2]) + found[4], text)


def main(args: list[str] | None = None) -> int:
    """Rewrite the pages, or compare them with the records."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args(args).check
    differing = []
    for name in PAGES:
        page = ROOT / name
        before = page.read_text(encoding="utf-8")
        after = rewritten(before)
        if after != before:
            differing.append(name)
            if not check:
                page.write_text(after, encoding="utf-8")
    for name in differing:
        verb = "differs from the records: run benchmarks/results_page.py" if check else "rewritten"
        print(f"{name}: {verb}", file=sys.stderr)
    return 1 if check and differing else 0


if __name__ == "__main__":
    raise SystemExit(main())
