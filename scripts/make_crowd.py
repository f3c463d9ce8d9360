"""Measure what becomes of agents when more and more of the traffic is theirs, and write a record for each case.

    python scripts/make_crowd.py --data town-small/test --out results/crowd

Every case is an evaluation in open traffic of the same run segments, spread evenly over the store, without search and
as the agent was trained to search. Cases that have a record are left as they are.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.config.evaluation import Others
from symphony.data.store import SegmentStore
from symphony.evaluation.evaluator import evaluate_dataset
from symphony.evaluation.records import evaluation_record
from symphony.files import write_json
from symphony.simulation.crowd import crowd_dataset
from symphony.simulation.demonstrations import evenly_spaced


def main() -> None:
    """Measure all cases."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--agent", default="pretrained:bc_ts_h")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--interactive", default="2,8,16,32,all")
    parser.add_argument("--others", default="log", help=f"one or several of {', '.join(get_args(Others))}")
    parser.add_argument("--segments", type=int, default=16)
    parser.add_argument("--rollouts", type=int, default=8)
    parser.add_argument("--name", default="", help="of the data in the names of records")
    given = parser.parse_args()
    agent, store = load_agent(given.agent), SegmentStore(given.data)
    indices = evenly_spaced(len(store), given.segments)
    for number in given.interactive.split(","):
        for others in given.others.split(","):
            for search in ("none", "agent"):
                settings: dict[str, Any] = {
                    "interactive": number if number == "all" else int(number),
                    "open_traffic": True,
                    "others": others,
                    "search": search,
                    "rollouts": given.rollouts,
                    "branches": given.rollouts,
                    "batch": 4,
                }
                config = EvaluateConfig(**settings)
                parts = [given.name or given.data.name, number, *([others] if others != "log" else [])]
                file = given.out / f"{'-'.join([*parts, 'none' if search == 'none' else 'tree'])}.json"
                if file.exists():
                    continue
                found = evaluate_dataset(agent, crowd_dataset(store, agent, config, indices), config)
                record = evaluation_record(agent, found, store)
                # What is drawn from larger evaluations.
                del record["curvature"], record["per_segment"]
                given.out.mkdir(parents=True, exist_ok=True)
                write_json(file, record)
                rate, cost = (
                    record["agent_collision_rate"],
                    found.seconds / found.metrics.compute()["segments"],
                )
                print(
                    f"{file.stem}: {rate:.1f} % of agents collide, {cost:.2f} CPU s per segment", flush=True
                )


if __name__ == "__main__":
    main()
