"""The eight methods over several seeds: train, evaluate, and print the comparison, paired over segments.

    python scripts/compare.py train --data TRAIN --runs DIR
    python scripts/compare.py evaluate --data TEST --runs DIR --results DIR
    python scripts/compare.py table --results DIR

Every step skips what is there already, so an interrupted one goes on when it is called again. To save time, methods
with tree search start from the networks of the method without it, of the same seed; they learn by the paper's
halving. With `--before RUNS` every method starts from the run of its own name there, for the paper's settings of 20 s
(`--duration 20`) and eight interactive agents (`--interactive 8`). `symphony table` makes the paper's tables of
single runs that were evaluated with `symphony evaluate`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from symphony.agents.networks import dynamics_of
from symphony.config import (
    AgentConfig,
    DiscriminatorConfig,
    EvaluateConfig,
    Method,
    MGAILConfig,
    SearchConfig,
    TrainConfig,
)
from symphony.data.store import SegmentStore
from symphony.evaluation import evaluate
from symphony.evaluation.evaluator import Evaluation
from symphony.files import write_json
from symphony.simulation.demonstrations import SceneDataset
from symphony.training import train

METHODS: tuple[Method, ...] = get_args(Method)
BEFORE = {"bc_ts": "bc", "bc_ts_h": "bc_h", "mgail_ts": "mgail", "mgail_ts_h": "mgail_h"}
HALVING: dict[str, Any] = {"rule": "best", "prune_every": 10}
"""The paper's pruning."""
TREE = {**HALVING, "search": "tree"}
RARELY = {"search": "tree", "rule": "systematic", "prune_every": 10, "temperature": 0.3}
OFTEN = {**RARELY, "prune_every": 2, "temperature": 0.6}
KINDS: dict[str, dict[str, Any]] = {
    "none": {"search": "none"},
    "tree": TREE,
    "systematic": RARELY,
    "often": OFTEN,
    "forest": {**OFTEN, "trees": 16, "branches": 4},
    "small": {**RARELY, "trees": 4, "branches": 4},
    "best": {"search": "best", "rollouts": 1},
    "oracle": {**TREE, "search": "oracle"},
}
"""Ways to simulate: independent rollouts; the leaves of one tree, halved every two seconds; resampled instead of
halved; that more often; one leaf each of sixteen such trees of four branches; the leaves of four trees of four
branches; the best of sixteen independent rollouts by the discriminator; one tree pruned by the true flags.
"""
DEFAULT_KINDS = dict.fromkeys(("bc", "bc_h", "mgail", "mgail_h"), ("none",))
COLUMNS = {"collision_rate": 1, "offroad_time": 2, "ade": 2, "min_sade": 2, "curvature_jsd": 3}
"""Figures of a table, and the digits after their points."""
EACH = tuple(COLUMNS)[:4]
"""Those that every segment has."""


def run_name(method: str, seed: int) -> str:
    """Folder of one run."""
    return f"{method}-{seed}"


def settings(arguments: argparse.Namespace, method: Method, seed: int) -> TrainConfig:
    """The configuration of one run."""
    out, searches = arguments.runs / run_name(method, seed), method in BEFORE
    adversarial = method.startswith("mgail")
    warm = arguments.before / run_name(method, seed) if arguments.before else None
    if searches and warm is None:
        warm = arguments.runs / run_name(BEFORE[method], seed)
    steps, mgail = arguments.search_steps if searches else arguments.steps, MGAILConfig()
    if adversarial:
        regression = 0 if warm else arguments.regression
        steps = regression + (arguments.adversarial_search_steps if searches else arguments.adversarial_steps)
        mgail = MGAILConfig(regression=regression, head_start=0 if warm else 50, cost="non_saturating")
    judged = searches or adversarial
    return TrainConfig(
        method,
        arguments.data,
        out,
        steps=steps,
        seed=seed,
        duration=arguments.duration,
        agent=AgentConfig(num_points=128, interactive=arguments.interactive),
        states=512 if searches and not adversarial else 1024,
        learning_rate=arguments.search_rate if warm else 1e-3,
        search=SearchConfig(**HALVING, segments=arguments.rollout_segments, updates=2)
        if adversarial
        else SearchConfig(**HALVING, weight=arguments.weight, survivors=arguments.survivors),
        discriminator=DiscriminatorConfig(features=arguments.features) if judged else DiscriminatorConfig(),
        mgail=mgail,
        warm_start=warm,
        checkpoint_every=500 if steps > 1000 else 50,
        resume=(out / "config.json").is_file(),
        wandb="disabled",
    )


def learn(arguments: argparse.Namespace) -> None:
    """Train what is missing; all runs of one action space share the prepared data."""
    data: dict[bool, SceneDataset] = {}
    for seed in arguments.seeds:
        for method in arguments.methods:
            config = settings(arguments, method, seed)
            done = config.out / "checkpoints" / f"step-{config.steps:012d}" / "checkpoint.json"
            if done.is_file():
                continue
            if config.adversarial not in data:
                data[config.adversarial] = SceneDataset(
                    SegmentStore(arguments.data),
                    config.agent.interactive,
                    dynamics_of(config),
                    duration=config.duration,
                    routes=True,
                )
            began = time.perf_counter()
            train(config, data[config.adversarial])
            print(f"{config.out.name}: {time.perf_counter() - began:.0f} s", flush=True)


def judge(arguments: argparse.Namespace) -> None:
    """Evaluate every run in every way that is missing."""
    for seed in arguments.seeds:
        for method in arguments.methods:
            for kind in arguments.kinds or DEFAULT_KINDS.get(method, ("tree", "none", "best", "oracle")):
                result = arguments.results / f"{run_name(method, seed)}-{kind}.json"
                run = arguments.runs / run_name(method, seed)
                if result.is_file() or not (run / "checkpoints").is_dir():
                    continue
                began = time.perf_counter()
                found = evaluate(str(run), arguments.data, EvaluateConfig(seed=seed, **KINDS[kind]))
                seconds = time.perf_counter() - began
                numbers = measured(found)
                write_json(
                    result,
                    {"method": method, "seed": seed, "kind": kind, "seconds": round(seconds), **numbers},
                )
                shown = " ".join(f"{name} {numbers[name]}" for name in COLUMNS)
                print(f"{result.stem}: {shown} ({seconds:.0f} s)", flush=True)


def measured(found: Evaluation) -> dict[str, Any]:
    """What is kept of an evaluation: its figures, and those of every segment for paired comparisons."""
    rows = found.metrics.rows()
    each = {name: json.dumps([_short(row[name]) for row in rows]) for name in EACH}
    return {**{k: _short(v) for k, v in found.numbers().items() if k != "agent"}, "per_segment": each}


def _short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def tabulate(arguments: argparse.Namespace) -> None:
    """Means over seeds, their standard errors, and paired differences to BC."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for path in sorted(arguments.results.glob("*.json")):
        row = json.loads(path.read_text())
        if "method" in row:
            found.setdefault((row["method"], row["kind"]), []).append(row)
    print("| method | simulated | seeds | collision % | off-road % | ADE m | minSADE m | JSD nats |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for (method, kind), rows in sorted(found.items(), key=_order):
        print(f"| {method} | {kind} | {len(rows)} | {' | '.join(figures(rows))} |")
    print("\nPaired over segments and seeds, relative to bc (none):")
    base = {row["seed"]: row for row in found.get(("bc", "none"), [])}
    for (method, kind), rows in sorted(found.items(), key=_order):
        pairs = [(base[row["seed"]], row) for row in rows if row["seed"] in base]
        if pairs and (method, kind) != ("bc", "none"):
            differences = ", ".join(f"{name} {paired(pairs, name)}" for name in EACH)
            print(f"{method} {kind}: {differences}")
    kinds = ("into_leader", "rear_ended_by_playback", "crossing", "oncoming", "sideswipe", "other")
    print("\n| method | simulated | " + " | ".join(kinds) + " |")
    print("| --- " * (2 + len(kinds)) + "|")
    for (method, kind), rows in sorted(found.items(), key=_order):
        print(f"| {method} | {kind} | {' | '.join(_mean(rows, f'collision_{k}', 1) for k in kinds)} |")


def _order(item: tuple[tuple[str, str], Any]) -> tuple[int, int]:
    (method, kind), _ = item
    return METHODS.index(method), list(KINDS).index(kind)


def figures(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Of a table's row: means over what was :func:`measured`, with standard errors if there are several."""
    return [_mean(rows, name, digits) for name, digits in COLUMNS.items()]


def _mean(rows: Sequence[dict[str, Any]], name: str, digits: int) -> str:
    values = np.array([row[name] for row in rows], dtype=float)
    if len(values) < 2:
        return f"{values[0]:.{digits}f}"
    return f"{values.mean():.{digits}f} ± {values.std(ddof=1) / len(values) ** 0.5:.{digits}f}"


def paired(pairs: Sequence[tuple[dict[str, Any], dict[str, Any]]], name: str) -> str:
    """By how much the second of each pair is above the first: the mean over pairs and segments of what was
    :func:`measured`, and its standard error over segments."""
    rows = [
        np.array(json.loads(b["per_segment"][name])) - np.array(json.loads(a["per_segment"][name]))
        for a, b in pairs
    ]
    difference = np.mean(rows, 0)
    return f"{difference.mean():+.2f} ± {difference.std(ddof=1) / len(difference) ** 0.5:.2f}"


def main() -> None:
    """Run one of the three steps."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    steps = parser.add_subparsers(required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--data", type=Path, required=True)
    common.add_argument("--runs", type=Path, required=True)
    common.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    common.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    part = steps.add_parser("train", parents=[common])
    part.set_defaults(run=learn)
    part.add_argument("--steps", type=int, default=3000)
    part.add_argument("--search-steps", type=int, default=800)
    part.add_argument("--regression", type=int, default=2500)
    part.add_argument("--adversarial-steps", type=int, default=300)
    part.add_argument("--adversarial-search-steps", type=int, default=150)
    part.add_argument("--rollout-segments", type=int, default=8)
    part.add_argument("--duration", type=int, default=0)
    part.add_argument("--interactive", type=int, default=2)
    part.add_argument("--before", type=Path)
    part.add_argument("--search-rate", type=float, default=5e-4)
    part.add_argument("--weight", type=float, default=1.0)
    part.add_argument("--survivors", choices=("all", "best"), default="best")
    part.add_argument("--features", choices=("clearance", "paper", "foresight"), default="foresight")
    part = steps.add_parser("evaluate", parents=[common])
    part.set_defaults(run=judge)
    part.add_argument("--results", type=Path, required=True)
    part.add_argument("--kinds", nargs="+", choices=KINDS)
    part = steps.add_parser("table")
    part.set_defaults(run=tabulate)
    part.add_argument("--results", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
