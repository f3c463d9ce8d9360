"""Measure what each way to search gives the included agent, and what it costs.

    python benchmarks/search_table.py --data DIR --out FOLDER      # FOLDER keeps a record of every evaluation

writes ``results/search.json``. ``DIR`` holds the stores ``town-small/test`` (of which the first 130 segments are
taken) and ``ngsim-test``. Evaluations whose records are there are not made again.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from symphony import EvaluateConfig, SegmentStore, evaluate, load_agent
from symphony.envs.scene import SceneBatch
from symphony.files import write_json
from symphony.learning.experts import logged
from symphony.rollouts.unroll import Rollouts

AGENT, ROLLOUTS, NEAR, MOVES = "pretrained:bc_ts_h", 16, 3.0, 5.0
RECORD = Path(__file__).resolve().parents[1] / "results" / "search.json"
STORES = {"towns": ("town-small/test", 130), "real roads": ("ngsim-test", None)}
WAYS: dict[str, dict[str, Any]] = {
    "no search": {"search": "none"},
    "tree, by the discriminator": {"search": "tree", "score": "discriminator"},
    "tree, by flags": {"search": "tree", "score": "flags"},
    "tree, by the rule": {"search": "tree", "score": "rule"},
    "a leaf each of 16 trees of 2": {"search": "tree", "score": "rule", "goals": "tree", "trees": 16, "branches": 2},
    "back, by the discriminator": {"search": "backtrack", "score": "discriminator"},
    "back, by the rule": {"search": "backtrack", "score": "rule"},
}
FIGURES = {
    "collisions %": ("collision_rate", 1, True),
    "minSADE m": ("min_sade", 2, False),
    "steps": ("relative", 2, False),
}
"""Their names in an evaluation, digits, and whether their standard error is shown."""


def along_log(scenes: SceneBatch, rollouts: Rollouts) -> Float[Tensor, "B K"]:
    """Return [B, K] 1 where every agent that the log moves by 5 m stays within 3 m of its logged path or straight on
    from it; NaN where there is none.
    """
    log, there = logged(scenes)
    found = torch.full(rollouts.state.shape[:2], torch.nan)
    for b, last in enumerate(scenes.last_step.tolist()):
        for n in scenes.interactive_valid[b].nonzero().flatten().tolist():
            path = log[b, : last + 1, n][there[b, : last + 1, n]]
            if len(path) < 2 or (path[-1, :2] - path[0, :2]).norm() < MOVES:
                continue
            way = torch.stack([path[-1, 2].cos(), path[-1, 2].sin()])
            line = torch.cat([path[:, :2], path[-1, :2] + way * torch.arange(1, 61)[:, None]]).double()
            away = torch.cdist(rollouts.state[b, :, : last + 1, n, :2].double(), line).amin(-1).amax(-1)
            found[b] = torch.minimum(found[b].nan_to_num(1.0), (away < NEAR).float())
    return found


def some_along_log(scenes: SceneBatch, rollouts: Rollouts) -> Float[Tensor, "B K"]:
    """Return [B, K] 1 where :func:`along_log` holds for any of the rollouts of the scene."""
    each = along_log(scenes, rollouts)
    return each.amax(1, keepdim=True).expand(each.shape)


METRICS = tuple(f"{Path(__file__)}:{metric.__name__}" for metric in (along_log, some_along_log))


def record(data: Path, out: Path, store: str, way: str) -> dict[str, Any]:
    """Return the numbers of an evaluation, and what it cost."""
    file = out / f"{store.rsplit(maxsplit=1)[-1]} {way}.json".replace(" ", "-").replace(",", "")
    if not file.exists():
        place, count = STORES[store]
        segments = SegmentStore(data / place)
        config = EvaluateConfig(rollouts=ROLLOUTS, metric=METRICS, **WAYS[way])
        found = evaluate(load_agent(AGENT), segments, config, items=None if count is None else range(count))
        numbers = found.numbers()
        route = {"along": ROLLOUTS * numbers[METRICS[0]], "any": 100 * numbers[METRICS[1]]}
        numbers = {name: value for name, value in numbers.items() if not name.startswith(METRICS)}
        write_json(file, {**numbers, **route, "steps": found.steps, "seconds": found.seconds})
        print(file, flush=True)
    return json.loads(file.read_text(encoding="utf-8"))


def main() -> None:
    """Make what is not there, then the record of the table, a row for each way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--commit", default="", help="commit that the evaluations were made at, for the record")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    columns: list[list[Any]] = [[""]]
    rows: list[list[Any]] = [[way] for way in WAYS]
    for store in STORES:
        columns += [[f"{store}: {heading}", digits] for heading, (_, digits, _) in FIGURES.items()]
        found = [record(given.data, given.out, store, way) for way in WAYS]
        for row, one in zip(rows, found, strict=True):
            one["relative"], one["cpu"] = one["steps"] / found[0]["steps"], one["seconds"] / one["segments"]
            for name, digits, error in FIGURES.values():
                values = [round(one[key], digits) for key in (name, f"{name}_se")[: 1 + error]]
                row.append(values if error else values[0])
        for way, one in zip(WAYS, found, strict=True):
            route = f"{one['along']:.1f} of {ROLLOUTS} on the log's route, any in {one['any']:.0f} %"
            print(f"{store}: {way}: {route}, off-road {one['offroad_time']:.2f} %, {one['cpu']:.2f} CPU s a segment")
    made = {"commit": given.commit, "command": "python benchmarks/search_table.py"}
    write_json(
        RECORD,
        {
            "of": "what each way to search gives the included agent: 130 and 170 segments, 16 rollouts",
            "made": made,
            "columns": columns,
            "rows": rows,
        },
    )


if __name__ == "__main__":
    main()
