"""What MGAIL's adversarial updates are sensitive to: one setting changed at a time, from the same regression.

    python scripts/sweep.py train --data TRAIN --test VALIDATION --start RUN --runs DIR --results DIR
    python scripts/sweep.py table --results DIR

`--start` is a run that was only regressed to the log (`symphony train mgail_h --mgail.regression N --steps N`); what
it was trained with is kept but for what is changed. Only what is missing in the results is trained and judged, so an
interrupted sweep goes on when it is called again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from compare import COLUMNS, figures, measured, paired
from symphony.agents.agent import read_config
from symphony.agents.networks import dynamics_of
from symphony.config import EvaluateConfig, MGAILConfig, TrainConfig
from symphony.data.store import SegmentStore
from symphony.evaluation import evaluate
from symphony.files import write_json
from symphony.simulation.demonstrations import SceneDataset
from symphony.training import train
from symphony.training.logging import read_metrics

BASE = MGAILConfig(regression=0, head_start=50, cost="non_saturating")
VARIATIONS: dict[str, dict[str, dict[str, Any]]] = {
    "base": {},
    "log_d": {"mgail": {"cost": "log_d"}},
    "logit": {"mgail": {"cost": "logit"}},
    "penalty": {"discriminator": {"gradient_penalty": 1.0}},
    "noise": {"discriminator": {"instance_noise": 0.1}},
    "slow-policy": {"mgail": {"learning_rate": 5e-5}},
    "fast-policy": {"mgail": {"learning_rate": 8e-4}},
    "slow-judge": {"discriminator": {"learning_rate": 2.5e-4}},
    "judge-twice": {"mgail": {"discriminator_updates": 2}},
    "expert": {"mgail": {"expert_weight": 0.1}},
    "expert-more": {"mgail": {"expert_weight": 1.0}},
    "truncated": {"mgail": {"truncate": 10}},
    "react": {"mgail": {"react": True}},
}
"""Of the settings in `BASE` and of those that the start was trained with."""
START = "start"
"""Name of the start itself, judged beside them."""
NAMES = (START, *VARIATIONS)
LATE = (
    "auc",
    "accuracy_simulated",
    "accuracy_data",
    "mgail_score",
    "gradient_norm_policy",
    "search_collision_all",
)
"""Metrics of training of which the mean over the last third of the updates is kept."""


def settings(start: Path, name: str, runs: Path, data: Path, steps: int) -> TrainConfig:
    """The configuration of one run."""
    trained, changed = read_config(start), VARIATIONS[name]
    return replace(
        trained,
        data=data,
        out=runs / f"{trained.method}-{name}",
        steps=steps,
        mgail=replace(BASE, **changed.get("mgail", {})),
        discriminator=replace(trained.discriminator, **changed.get("discriminator", {})),
        warm_start=start,
        checkpoint_every=steps,
        log_every=5,
        wandb="disabled",
    )


def learn(arguments: argparse.Namespace) -> None:
    """Train and judge what is missing."""
    data: SceneDataset | None = None
    for name in arguments.names:
        method = read_config(arguments.start).method
        result, run, trained = arguments.results / f"{method}-{name}.json", arguments.start, {}
        if result.is_file():
            continue
        if name != START:
            config = settings(arguments.start, name, arguments.runs, arguments.data, arguments.steps)
            if data is None:
                store = SegmentStore(arguments.data)
                data = SceneDataset(store, config.agent.interactive, dynamics_of(config), routes=True)
            began = time.process_time()
            run = train(replace(config, resume=(config.out / "config.json").is_file()), data)
            trained = {"cpu_seconds": round(time.process_time() - began), **_late(read_metrics(run))}
        found = evaluate(str(run), arguments.test, EvaluateConfig(rollouts=arguments.rollouts))
        write_json(result, {"method": method, "name": name, **trained, **measured(found)})
        print(result.stem, *(f"{key} {found.numbers()[key]:.3f}" for key in COLUMNS), flush=True)


def _late(metrics: list[dict[str, Any]]) -> dict[str, float]:
    found = {}
    for name in LATE:
        values = [row[name] for row in metrics if row.get(name) is not None]
        found[name] = float(f"{np.mean(values[-max(1, len(values) // 3) :]):.3g}")
    return found


def tabulate(arguments: argparse.Namespace) -> None:
    """What every change did, with differences to the base paired over segments."""
    rows = [json.loads(path.read_text()) for path in sorted(arguments.results.glob("*.json"))]
    base = {row["method"]: row for row in rows if row["name"] == "base"}
    columns = (
        "method",
        "change",
        "collisions %",
        "(to base)",
        "off-road %",
        "ADE m",
        "(to base)",
        "minSADE m",
        "JSD",
    )
    columns = (*columns, "AUC", "CPU s")
    print(f"| {' | '.join(columns)} |")
    print("| --- " * len(columns) + "|")
    for row in sorted(rows, key=lambda row: (row["method"], NAMES.index(row["name"]))):
        numbers = figures([row])
        for place, name in ((1, "collision_rate"), (4, "ade")):
            apart = paired([(base[row["method"]], row)], name) if row["name"] != "base" else ""
            numbers.insert(place, apart)
        cells = [
            row["method"],
            row["name"],
            *numbers,
            *(f"{row.get(name, '')}" for name in ("auc", "cpu_seconds")),
        ]
        print(f"| {' | '.join(cells)} |")


def main() -> None:
    """Run the sweep, or print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = parser.add_subparsers(required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--results", type=Path, required=True)
    part = parts.add_parser("train", parents=[common])
    part.set_defaults(run=learn)
    part.add_argument("--data", type=Path, required=True)
    part.add_argument("--test", type=Path, required=True)
    part.add_argument("--start", type=Path, required=True)
    part.add_argument("--runs", type=Path, required=True)
    part.add_argument("--names", nargs="+", choices=NAMES, default=NAMES)
    part.add_argument("--steps", type=int, default=150)
    part.add_argument("--rollouts", type=int, default=8)
    parts.add_parser("table", parents=[common]).set_defaults(run=tabulate)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
