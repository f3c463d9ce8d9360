"""A planner with a known flaw: its rate of failures by brute force, and by `symphony hunt` at 1/20 of the runs.

python benchmarks/rare_failures.py; prints what docs/test-bench.md says of it.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from symphony.agents import load_agent
from symphony.bench.measures import MEASURES
from symphony.bench.rare import Hunt, hunt
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.evaluation.report import Report, add_segment
from symphony.planners.driver import EgoPlanners
from symphony.planners.included import IDMPlanner
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import simulate_batch
from symphony.saved.rollouts import saved_rollouts

METRIC, TREES, EACH = "at_fault_collision_rate", 8, 200
"""What is counted, trees of a hunt, and free rollouts that are simulated at a time."""


def main() -> None:
    """Compare the two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--segment", type=int, default=4, help="place in the included test segments")
    parser.add_argument("--acceleration", type=float, default=0.3, help="m/s^2; the lower, the later it brakes")
    parser.add_argument("--runs", type=int, default=4000, help="free rollouts; a hunt has a twentieth of them")
    parser.add_argument("--hunts", type=int, default=24, help="hunts, with a seed each")
    chosen = parser.parse_args()
    # It keeps no distance, and takes it that it can brake with 50 m/s^2.
    late = partial(IDMPlanner, headway=0.0, gap=0.0, acceleration=chosen.acceleration, braking=50.0)
    agent, store = load_agent("pretrained:bc_ts_h"), SegmentStore(builtin_store("test"))
    config = EvaluateConfig(rollouts=EACH, search="none", goals="branch", interactive=2)
    dataset = crowd_dataset(store, agent, config, [chosen.segment], routes=True)
    scenes, segment, hits = dataset.scenes([0]), dataset.segment(0), 0.0
    rounds = -(-chosen.runs // EACH)
    for seed in range(rounds):
        seeded = replace(config, seed=1000 + seed)
        found = simulate_batch(agent, scenes, seeded, egos=[EgoPlanners("late", late, [segment])])
        about = {"goal": found.goal, "driver": ["late", agent.name]}
        report = Report(agent.name, "ego")
        add_segment(report, saved_rollouts(segment, scenes, found.rollouts, 0, **about))
        hits += sum(bool(MEASURES[METRIC].of(run)) for run in report.rows)
    runs = rounds * EACH
    rate = hits / runs
    print(f"free rollouts {runs}: {100 * rate:.3f} ± {100 * math.sqrt(rate * (1 - rate) / runs):.3f} %", flush=True)
    estimates, kept = [], []
    for seed in range(chosen.hunts):
        branches = runs // 20 // TREES
        how = EvaluateConfig(rollouts=TREES, trees=TREES, branches=branches, interactive=2, seed=seed)
        with TemporaryDirectory() as out:
            *_, mean = hunt(Path(out) / "hunt", Hunt(agent, dataset, how, late, METRIC))
        estimates.append(mean.rate)
        kept.append(mean.trees)
    each, scatter = runs // 20, float(np.std(estimates, ddof=1))
    mean, error = float(np.mean(estimates)), scatter / math.sqrt(len(estimates))
    print(f"{chosen.hunts} hunts of {each}: {100 * mean:.3f} ± {100 * error:.3f} %; one ± {100 * scatter:.3f} %")
    print(f"as many free rollouts ± {100 * math.sqrt(rate * (1 - rate) / each):.3f} %")
    seen = np.mean(np.array(kept) > 0), 1 - (1 - rate) ** each
    print(f"see a failure: {seen[0]:.2f} of hunts, {seen[1]:.2f} of as many free rollouts")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
