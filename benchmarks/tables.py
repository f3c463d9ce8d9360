"""The tables of a report from what ``measure.py`` wrote, on standard output or as ``benchmarks/reports/measure.md``:

python benchmarks/tables.py out/bench.json [--before older.json] [--write]

With ``--before``, speeds relative to the matrix product of their own run are set beside those of an earlier one.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]
YARDSTICKS = ("brute force", "matmul")
REPORT = Path(__file__).resolve().parent / "reports" / "measure.md"


def table(head: Iterable[str], lines: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown."""
    head = list(head)
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *lines]) + "\n"


def rate(row: Row) -> float:
    """Return units a second."""
    return float(row["units"] / row["seconds"])


def spread(row: Row) -> str:
    """Return half the distance of the quartiles, relative to the median."""
    low, high = row["quartiles"]
    return f"{50 * (high - low) / row['seconds']:.0f} %"


def share(row: Row, operations: str) -> str:
    """Return the share of the speed of the matrix product."""
    found = row.get(operations, 0)  # reports of before have fewer
    return f"{100 * found / row['seconds'] / row['matmul']:.0f} %" if found else ""


def per_product(row: Row) -> float:
    """Return units in the time of 10^9 operations of the matrix product."""
    return rate(row) / row["matmul"] * 1e9


def speeds(found: Mapping[str, list[Row]], before: Mapping[str, list[Row]]) -> Iterator[list[str]]:
    """Yield a line for each row and setting of the allocator."""
    brute = rate(found["brute force"][-1]) if "brute force" in found else 0.0
    for name, runs in found.items():
        if " = " in name or name == "matmul":
            continue
        for row in runs:
            comparable = brute and row["unit"] == "agent-steps"
            old = [one for one in before.get(name, []) if one["tuned"] == row["tuned"]]
            yield [
                name,
                "kept" if row["tuned"] else "as it comes",
                f"{rate(row):,.4g} {row['unit']}/s",
                f"{1e3 / rate(row) if row['unit'] != 'agent-steps' else 1e3 * row['seconds']:,.4g}",
                spread(row),
                f"{rate(row) / brute:.2f}" if comparable else "",
                share(row, "flops"),
                share(row, "dense"),
                f"{row['operators']:,}" if row["operators"] else "",
                f"{row['faults']:,.0f}",
                f"{row['mebibytes']:,.0f}",
                *([f"{per_product(row) / per_product(old[0]):.2f}" if old else ""] if before else []),
            ]


HEAD = (
    "work",
    "freed memory",
    "speed",
    "ms",
    "spread",
    "of brute force",
    "of the matrix product",
    "dense count",
    "operators",
    "page faults",
    "peak MiB",
)


def parts(found: Mapping[str, list[Row]]) -> Iterator[list[str]]:
    """Yield a line for each row whose parts are known, most expensive first."""
    for name, runs in found.items():
        row = runs[-1]
        if row["parts"]:
            shares = sorted(row["parts"].items(), key=lambda item: -item[1])
            yield [name, ", ".join(f"{part} {100 * share:.0f} %" for part, share in shares if share >= 0.005)]


def curves(found: Mapping[str, list[Row]]) -> Iterator[list[str]]:
    """Yield a line for each curve: milliseconds of a round and its peak of memory, as one number grows."""
    grown: dict[str, list[str]] = {}
    for name, (row, *_) in found.items():
        what, _, size = name.partition(" = ")
        if size:
            text = f"{size}: {1e3 * row['seconds']:,.3g} ms, {row['mebibytes']:,.0f} MiB"
            grown.setdefault(what, []).append(text)
    for what, texts in grown.items():
        yield [what, "; ".join(texts)]


def text(report: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> str:
    """Return the whole report."""
    found, machine = report["rows"], report["machine"]
    old = {} if before is None else before["rows"]
    products = [row["matmul"] for runs in found.values() for row in runs]
    heading = f"# {report['date']}: speed of version {machine['symphony']}\n"
    cores, minutes = f"{machine['cores']} cores", f"{report['minutes']:.0f} minutes"
    low, high = (f"{extreme(products) / 1e9:.0f}" for extreme in (min, max))
    what = f"""One thread of {machine["processor"]} ({cores}), Python {machine["python"]}, torch {machine["torch"]};
CPU time, medians. `make bench` measures again, in {minutes}. A product of matrices ran at {low} to
{high} GFLOP/s beside the rows: where that differs, others used the machine.

- *freed memory*: "kept" by `symphony.allocator.tune()`, as the `symphony` command does.
- *ms*: of a round of all agents; of one update or segment where those are counted.
- *spread*: half the distance of the quartiles.
- *of the matrix product*: operations in products of matrices a second, in those of the product beside.
- *dense count*: the same, of the operations that encoding and differentiating every element would take.
- *operators*, *page faults*: of a round; *peak MiB*: of memory above what was prepared.
"""
    head = [*HEAD, *(["before: 1"] if old else [])]
    sections = [heading, what, table(head, speeds(found, old))]
    if any(row["parts"] for runs in found.values() for row in runs):
        sections += ["## Where the time goes\n", table(["work", "shares"], parts(found))]
    if any(" = " in name for name in found):
        sections += ["## As one number grows\n", table(["number", "a round"], curves(found))]
    if report["start"]:
        first = next(iter(report["start"].values()))
        lines = [[name, f"{taken:.1f}", f"{taken / first:.2f}"] for name, taken in report["start"].items()]
        sections += ["## Start\n", table(["until", "CPU seconds", "of the first"], lines)]
    return "\n".join(sections)


def main() -> None:
    """Print or write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("--before", type=Path)
    parser.add_argument("--write", action="store_true", help="as the latest report")
    arguments = parser.parse_args()
    report = json.loads(arguments.report.read_text())
    before = None if arguments.before is None else json.loads(arguments.before.read_text())
    made = text(report, before)
    if not arguments.write:
        print(made)
        return
    REPORT.write_text(made)
    print(REPORT)


if __name__ == "__main__":
    main()
