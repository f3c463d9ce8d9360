"""Write the tables of the eight methods from their runs, as records of ``results/``:

    python benchmarks/methods.py RUN ... --towns NAME ... --roads NAME ...

Each run has an evaluation on both test parts; NAME is its file (* and ? fit any). Those of several trees, with a
rollout of each, have rows of their own. The relations are those of the towns (see ``relations.py``).
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
from symphony.evaluation.table import BASELINES, COLUMNS, collect, compare, method_name, paper_figures

RECORDS = Path(__file__).resolve().parents[1] / "results"
HIT = "collision_rear_ended"
TOWNS, ROADS = ("collision_rate", HIT, "offroad_time", "ade", "min_sade"), ("collision_rate", "ade", "min_sade")
PAPER = ("collision_rate",)


def digits(key: str) -> int:
    """Return how many digits after the point a number is worth."""
    return 1 if key in ("collision_rate", HIT) else COLUMNS[key].digits


def numbers(records: Sequence[Any], keys: Sequence[str]) -> list[list[float]]:
    """Return means and their errors over recordings, averaged over the runs of a method: seeds share the recordings,
    so that more of them hardly lower the error. Collisions are those between states, too.
    """
    averages = [[np.mean([record[name] for record in records]) for name in (key, f"{key}_se")] for key in keys]
    return [[round(float(each), digits(key)) for each in pair] for key, pair in zip(keys, averages, strict=True)]


COMMAND = "methods.py RUN ... --towns NAME ... --roads NAME ..."


def write(name: str, of: str, columns: list[list[Any]], rows: list[list[Any]], command: str = COMMAND) -> None:
    """Write a record, a row a line."""
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.check_output(git, cwd=RECORDS, text=True).strip()  # noqa: S603
    made = {"commit": commit, "command": f"python benchmarks/{command}"}
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
    parts = [collect(given.runs, "main", names)[0] for names in (given.towns, given.roads)]
    several = [[entry for entry in entries if entry.record["config"]["trees"] > 1] for entries in parts]
    towns, roads = ([e for e in every if e not in more] for every, more in zip(parts, several, strict=True))
    for entries in (towns, roads, *filter(None, several)):
        compare(entries, "main")  # fail if they are not comparable
    of_towns, of_roads, paper = by_method(towns), by_method(roads), paper_figures("main", "womd")
    ways = [("", of_towns, of_roads), (", paper's leaves", *map(by_method, several))]
    rows: list[list[Any]] = []
    for name, title in BASELINES.items():
        both = (numbers([each[0].record[name]], keys) for each, keys in ((towns, TOWNS), (roads, ROADS)))
        rows.append([title, *(cell for cells in both for cell in cells), *["–"] * len(PAPER)])
    for method in (method for method in get_args(Method) if method in paper):
        theirs = [paper[method][key][0] for key in PAPER]
        for way, *both in ((way, town, road) for way, town, road in ways if method in town):
            records = ([entry.record for entry in of[method]] for of in both)
            own = map(numbers, records, (TOWNS, ROADS))
            rows.append([method_name(method) + way, *(cell for cells in own for cell in cells), *theirs])
    heads = [("towns", TOWNS), ("real roads", ROADS), ("paper", PAPER)]
    shown = {"collision_rate": "collisions %", HIT: "hit from behind %", "offroad_time": "off-road %"}
    shown |= {"ade": "ADE m", "min_sade": "minSADE m"}
    columns = [
        [f"{head}: {shown[key]}", 2 if head == "paper" else digits(key)] for head, keys in heads for key in keys
    ]
    seeds = ", ".join(f"{method_name(method)}: {len(mine)}" for method, mine in of_towns.items())
    of = f"the eight methods (seeds of {seeds}), on the test parts of simulated towns and of NGSIM, ± over recordings"
    write("methods", f"{of}; beside the figures of the paper on WOMD", [[""], *columns], rows)
    head, *steps = tables(relations(towns))[0]
    write("relations", f"what differs between {of}, of towns, paired", [[title] for title in head], steps)


if __name__ == "__main__":
    main()
