"""Measure an agent wherever the pages show the included one.

    python scripts/measure_included.py --data DIR --out results

Runs one command of `symphony` after the other, prints each, and leaves records that are there as they are, so that it
can be stopped. After an agent was replaced, write to a new folder and copy what it holds. ``DIR`` holds the stores::

    town-small/test, town/validation, town/test   symphony data generate --preset town-small (town)
    ngsim-validation, ngsim-test                  symphony data convert commonroad PART/*.xml --egos all --smooth 0.8
    ngsim-10hz                                    the test part as docs/wosac.md converts it
    lined-test                                    scripts/make_roadside.py
    womd, argoverse2, interaction, nuscenes       as docs/roads.md converts them
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from results_base import RECORDS

AGENT = "pretrained:bc_ts_h"
RULES = {
    "none": "--search none",
    "systematic-tree": "--search tree --rule systematic --temperature 0.6 --goals tree",
    "systematic-branch": "--search tree --rule systematic --temperature 0.6 --goals branch",
    "replace-branch": "--search tree --rule replace --goals branch",
}
AGAIN = {
    "16": "",
    "32": "--branches 32",
    "64": "--branches 64",
}
FOREST = {"none": "--search none", "one": "", "forest": "--trees 16 --goals tree"}
ELSEWHERE = ("womd", "argoverse2", "interaction", "nuscenes")


def segments(record: str) -> str:
    """An option that names those of a record: of an evaluation, of a planner's, or of WOSAC scores."""
    found = json.loads((RECORDS / f"{record}.json").read_text())
    if "agents" in found:
        names = next(iter(found["agents"].values()))["segments"]
    else:
        names = [row["segment"] for row in found.get("per_segment") or found["per_run"]]
    return " ".join(["--segments", *names])


def commands(agent: str) -> Iterator[tuple[str, str]]:
    """Names of records, and what makes them: DIR and FILE stand for the stores and the record."""
    town, ngsim = "DIR/town-small/test", "DIR/ngsim-test"
    for name, rule in RULES.items():
        for part, store in (("town", town), ("ngsim", ngsim)):
            yield f"driving/{part}-{name}", f"evaluate {agent} {rule} --data {store} --json FILE"
    for name, search in (("bc_h", "--search none"), ("bc_ts_h", "")):
        for store in ELSEWHERE:
            yield f"roads/{store}-{name}", f"evaluate {agent} {search} --data DIR/{store} --json FILE"
    yield "roads/8-included-bc_ts_h", f"evaluate {agent} --interactive 8 --data {ngsim} --json FILE"
    for name in ("none", "replace-branch"):
        yield f"roadside/included-{name}", f"evaluate {agent} {RULES[name]} --data DIR/lined-test --json FILE"
    some = segments("planners/0-log-log")
    for number, search in enumerate(("--search none", "--trees 2 --branches 8")):
        for planner in ("log", "idm", "coast"):
            drives = "examples/coast.py:plan" if planner == "coast" else planner
            crowd = f"--planner {drives} --interactive 8 --rollouts 2 {search}"
            name = f"planners/{3 + number}-bctsh-{'search-' if number else ''}{planner}"
            yield name, f"evaluate {agent} {crowd} --data {town} {some} --json FILE"
    for name, how in (
        ("bc_h", "--search none"),
        ("bc_h-logged", "--search none --logged-goals"),
        ("bc_ts_h", ""),
    ):
        for part, where in (("sumo", town), ("ngsim", "DIR/ngsim-10hz --horizon 5")):
            more = f"{how} --branches 4 --no-baselines {segments(f'wosac/{part}-bc')}"
            yield f"wosac/{part}-{name}", f"wosac evaluate {agent} --data {where} {more} --json FILE"
    hundred = segments("forest/town-bc_ts-none")
    for name, how in FOREST.items():
        whole = f"evaluate {agent} {how} --data DIR/town/test {hundred} --json FILE"
        yield f"forest/town-included-{name}", whole
    for name, how in AGAIN.items():
        yield f"again/town-{name}", f"evaluate {agent} {how} --data DIR/town/validation --json FILE"
            yield f"again/ngsim-{name}", f"evaluate {agent} {how} --data DIR/ngsim-validation --json FILE"


def main() -> None:
    """Make all records that are not there."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--agent", default=AGENT, help="also the folder of a run")
    parser.add_argument("--only", nargs="*", default=[], help="folders of records: driving, roads, ...")
    given = parser.parse_args()
    for name, template in commands(given.agent):
        file = given.out / f"{name}.json"
        if file.exists() or (given.only and name.split("/")[0] not in given.only):
            continue
        file.parent.mkdir(parents=True, exist_ok=True)
        words = [word.replace("DIR/", f"{given.data}/") for word in template.split()]
        run("-m", "symphony", *(str(file) if word == "FILE" else word for word in words))
    if not given.only or "crowd" in given.only:
        crowds = str(Path(__file__).with_name("make_crowd.py"))
        for part, store in (("town", "town-small/test"), ("ngsim", "ngsim-validation")):
            more = ("--segments", "16" if part == "town" else "12", "--out", str(given.out / "crowd"))
            where = ("--agent", given.agent, "--data", str(given.data / store), "--name", part)
            run(crowds, *where, *more)


def run(*words: str) -> None:
    """One command of Python; its failure ends this one."""
    print(" ".join(words)[:150], flush=True)
    found = subprocess.run([sys.executable, *words], check=False, stdout=subprocess.DEVNULL)
    if found.returncode:
        raise SystemExit(found.returncode)


if __name__ == "__main__":
    main()
