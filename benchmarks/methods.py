"""Write the tables of the eight methods from their runs, as records of ``results/``:

    python benchmarks/methods.py RUN ... --towns NAME ... --roads NAME ...

Each run has an evaluation on both test parts; NAME is how its file begins. Errors are over recordings, after the
seeds of a method were averaged; the relations are those of the towns (see ``relations.py``).
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from relations import by_method, relations, tables
from symphony.config import Method
from symphony.evaluation.table import BASELINES, COLUMNS, Entry, collect, compare, method_name, paper_figures
from symphony.metrics.intervals import clustered_mean

RECORDS = Path(__file__).resolve().parents[1] / "results"
TOWNS, ROADS = ("collision_rate", "offroad_time", "ade", "min_sade"), ("collision_rate", "ade", "min_sade")
PAPER = ("collision_rate", "ade")


def digits(key: str) -> int:
    """Return how many digits after the point a number is worth."""
    return 1 if key == "collision_rate" else COLUMNS[key].digits


def means(entries: Sequence[Entry], keys: Sequence[str]) -> list[list[float]]:
    """Return means and standard errors of runs of a method; collisions are those between states, too."""
    runs: list[Any] = [{row["segment"]: row for row in entry.record["per_segment"]} for entry in entries]  # type: ignore[union-attr]
    member = np.unique([row["group"] for row in runs[0].values()], return_inverse=True)[1]
    numbers = np.array([[[run[name][key] for name in runs[0]] for key in keys] for run in runs]).mean(0)
    return [
        [round(x, digits(key)) for x in clustered_mean(row, member)] for key, row in zip(keys, numbers, strict=True)
    ]


def baseline(entry: Entry, name: str, keys: Sequence[str]) -> list[list[float]]:
    """Return the same of a baseline."""
    found: Any = entry.record[name]
    return [[round(found[key], digits(key)), round(found[f"{key}_se"], digits(key))] for key in keys]


def write(name: str, of: str, columns: list[list[Any]], rows: list[list[Any]]) -> None:
    """Write a record, a row a line."""
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.check_output(git, cwd=RECORDS, text=True).strip()  # noqa: S603
    made = {"commit": commit, "command": "python benchmarks/methods.py RUN ... --towns NAME ... --roads NAME ..."}
    lines = [
        f" {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}"
        for k, v in (("of", of), ("made", made), ("columns", columns))
    ]
    body = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in rows)
    text = "{\n" + ",\n".join([*lines, f' "rows": [\n{body}\n ]']) + "\n}\n"
    (RECORDS / f"{name}.json").write_text(text, encoding="utf-8")


def main(args: Sequence[str] | None = None) -> None:
    """Write the records."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    for part in ("--towns", "--roads"):
        parser.add_argument(part, nargs="+", required=True)
    given = parser.parse_args(args)
    towns, roads = (collect(given.runs, "main", names)[0] for names in (given.towns, given.roads))
    for entries in (towns, roads):
        compare(entries, "main")  # fail if they are not comparable
    of_towns, of_roads, paper = by_method(towns), by_method(roads), paper_figures("main", "womd")
    rows: list[list[Any]] = []
    for name, title in BASELINES.items():
        rows.append([title, *baseline(towns[0], name, TOWNS), *baseline(roads[0], name, ROADS), *["–"] * len(PAPER)])
    for method in (method for method in get_args(Method) if method in paper and method in of_towns):
        own = [*means(of_towns[method], TOWNS), *means(of_roads[method], ROADS)]
        rows.append([method_name(method), *own, *(list(paper[method][key]) for key in PAPER)])
    heads = [("towns", TOWNS), ("real roads", ROADS), ("paper", PAPER)]
    shown = {"collision_rate": "collisions %", "offroad_time": "off-road %", "ade": "ADE m", "min_sade": "minSADE m"}
    columns = [
        [f"{head}: {shown[key]}", 2 if head == "paper" else digits(key)] for head, keys in heads for key in keys
    ]
    seeds = sorted({entry.seed for entry in towns})
    of = f"the eight methods, seeds {seeds}, on the test parts of simulated towns and of NGSIM, ± over recordings"
    write("methods", f"{of}; beside the figures of the paper on WOMD", [[""], *columns], rows)
    head, *steps = tables(relations(towns))[0]
    write("relations", f"what differs between {of}, of towns, paired", [[title] for title in head], steps)


if __name__ == "__main__":
    main()
