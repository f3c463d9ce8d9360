"""Measure whether agents drive in the style that they are told, and write a record.

    python scripts/make_personas.py RUN --data town-small/test --out results/personas/town.json

Every case asks all driven agents for the same quantiles; the first asks for none, so that they are drawn. The speed
that a free vehicle stays below nine tenths of the time, relative to the limit, and the median time headway of one
that follows are measured in rollouts as they are in logs; errors are over groups of segments, differences paired
over them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.evaluation.paired import clustered_mean
from symphony.files import write_json
from symphony.roadgraph import LaneGraph
from symphony.simulation.crowd import CrowdDataset, crowd_dataset
from symphony.simulation.demonstrations import evenly_spaced
from symphony.simulation.driving import simulation
from symphony.simulation.personas import styles
from symphony.simulation.saved import SavedRollouts, saved_rollouts
from symphony.simulation.workers import batches, segments_together
from symphony.simulation.world import world_of

QUANTILES = (0.2, 0.5, 0.8)
MEASURES = ("headway", "free_speed", "speed", "collision", "offroad")
"""Seconds; relative to the limit; m/s; percent of agents; percent of time."""


def measured(saved: SavedRollouts, graph: LaneGraph) -> NDArray[np.float64]:
    """Means [5] over the driven agents of all rollouts of a segment, NaN for what none of them tells."""
    found, segment = [], saved.segment
    for k in range(saved.rollouts):
        world = world_of(saved, k)
        moved = segment.replace(
            position=np.concatenate([world.position, segment.position[..., 2:]], -1).astype(np.float32),
            heading=world.heading.astype(np.float32),
            velocity=world.velocity.astype(np.float32),
            valid=world.valid,
        )
        own, counted = styles(moved, graph)[saved.agents], saved.counted[k]
        hit, off = (100.0 * (flag[k] & counted) for flag in (saved.collision, saved.offroad))
        time = np.maximum(counted.sum(0), 1)
        speed = (saved.state[k, 1:, :, 3] * counted).sum(0) / time
        found.append(np.column_stack([own, speed, hit.max(0), off.sum(0) / time]))
    rows = np.concatenate(found)
    known = ~np.isnan(rows)
    return np.where(known.any(0), np.where(known, rows, 0).sum(0) / np.maximum(known.sum(0), 1), np.nan)


def simulated(run: str, dataset: CrowdDataset, config: EvaluateConfig) -> NDArray[np.float64]:
    """Means [segments, 5]."""
    agent, rows = load_agent(run), []
    for items in batches(range(len(dataset)), segments_together(agent, config, dataset.interactive), config):
        scenes = dataset.scenes(items)
        rollouts = simulation(agent, scenes, config).rollouts
        for b, i in enumerate(items):
            saved = saved_rollouts(dataset.segment(i), scenes, rollouts, b)
            rows.append(measured(saved, dataset.graph(i)))
    return np.array(rows)


def numbers(values: NDArray[np.float64], groups: NDArray[np.int64]) -> dict[str, float]:
    """Means over segments that tell, with errors."""
    found: dict[str, float] = {}
    for name, column in zip(MEASURES, values.T, strict=True):
        known = ~np.isnan(column)
        found[name], found[f"{name}_se"] = clustered_mean(column[known], groups[known])
    return found


def main() -> None:
    """Measure all cases."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--count", type=int, default=24, help="segments, spread evenly over the store")
    parser.add_argument("--interactive", type=int, default=8)
    parser.add_argument("--rollouts", type=int, default=4)
    given = parser.parse_args()
    agent, store = load_agent(given.run), SegmentStore(given.data)
    asked = [""] + [
        f"headway={headway:g},speed={speed:g}"
        for headway in QUANTILES
        for speed in QUANTILES
        if 0.5 in (headway, speed)
    ]
    cases: list[dict[str, Any]] = []
    by_case: dict[str, NDArray[np.float64]] = {}
    for persona in asked:
        config = EvaluateConfig(
            interactive=given.interactive, rollouts=given.rollouts, search="none", batch=8, persona=persona
        )
        dataset = crowd_dataset(store, agent, config, evenly_spaced(len(store), given.count))
        names = [dataset.segment(i).group or dataset.segment(i).segment_id for i in range(len(dataset))]
        groups = np.unique(names, return_inverse=True)[1]
        by_case[persona] = simulated(given.run, dataset, config)
        cases.append({"asked": persona, **numbers(by_case[persona], groups)})
        print(persona or "drawn", {name: round(cases[-1][name], 3) for name in MEASURES}, flush=True)
    apart = {
        "headway": by_case["headway=0.8,speed=0.5"] - by_case["headway=0.2,speed=0.5"],
        "speed": by_case["headway=0.5,speed=0.8"] - by_case["headway=0.5,speed=0.2"],
    }
    record = {
        "data": {"name": store.path.resolve().name, "checksum": store.checksum()},
        "segments": given.count,
        "interactive": given.interactive,
        "rollouts": given.rollouts,
        "cases": cases,
        "differences": {name: numbers(values, groups) for name, values in apart.items()},
    }
    given.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(given.out, record)


if __name__ == "__main__":
    main()
