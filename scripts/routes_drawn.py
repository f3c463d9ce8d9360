"""What drawn routes cost: collisions of an agent without search, by whether the log took the route that was drawn.

    python scripts/routes_drawn.py pretrained:bc_ts_h town/validation --json routes.json

Every segment is simulated twice with the same random numbers, with drawn routes and with those of the log. Routes are
told apart by whether the log may have taken them and whether they change lanes. How often that is, is counted of
agents whose log tells (``told``).
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictSequential

from symphony import keys
from symphony.agents import load_agent
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, collate, scene
from symphony.envs.routes import route_table
from symphony.modules import SeededNoise
from symphony.roadgraph import LaneGraph, routes, starting_lanes
from symphony.simulation.rollouts import Rollouts, simulate, start_states

BATCH = 8
KINDS = (
    "the log's",
    "another, as many changes",
    "another, changes lanes",
    "another, stays where the log changes",
)


def changes(graph: LaneGraph, segment: Any, agent: int) -> list[bool]:
    """Which feasible routes of an agent change lanes."""
    first = int(np.flatnonzero(segment.valid[agent])[0])
    starts = starting_lanes(graph, segment.position[agent, first, :2], float(segment.heading[agent, first]))
    on = {lane for lane, _ in starts}
    return [
        route[0] not in on or any(b not in graph.successors[a] for a, b in pairwise(route))
        for route in routes(graph, starts)
    ]


def collided(found: Rollouts) -> torch.Tensor:
    """[B, K, N] whether an agent collides in a rollout."""
    return (found.collision & found.counted).any(-2)[:, :, 0]


def main() -> None:
    """Simulate, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent")
    parser.add_argument("store", type=Path)
    parser.add_argument("--rollouts", type=int, default=16)
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    torch.set_num_threads(1)
    agent, store = load_agent(args.agent), SegmentStore(args.store)
    policy = TensorDictSequential(SeededNoise(0, agent.dynamics.numbers), agent.policy)
    rows, told = [], []
    for begin in range(0, len(store), BATCH):
        segments = [store[k] for k in range(begin, min(begin + BATCH, len(store)))]
        graphs = [LaneGraph(segment.road) for segment in segments]
        scenes = collate([scene(s, 2, g) for s, g in zip(segments, graphs, strict=True)])
        env = DrivingEnv(scenes, agent.dynamics, agent.observation)
        starts = [
            start_states(env, agent.goals, trees=args.rollouts, branches=1, seed=0, logged_goals=logged)
            for logged in (False, True)
        ]
        drawn, logged = (collided(simulate(env, policy, start)) for start in starts)
        goal = starts[0].get(keys.GOAL)[:, :, 0]
        for b, (segment, graph) in enumerate(zip(segments, graphs, strict=True)):
            for n in scenes.interactive_valid[b].nonzero()[:, 0].tolist():
                who = int(scenes.interactive[b, n])
                table = route_table(segment, graph, who)
                if table.logged < 0:
                    continue
                change = np.array(changes(graph, segment, who))
                took = goal[b, :, n].numpy()
                # Where the log leaves several open, it changes lanes if all of them do.
                log_changes = bool(change[table.right].all())
                if log_changes or not change[table.right].any():
                    told.append((log_changes, change[took].mean()))
                kind = np.where(
                    table.right[took],
                    0,
                    np.where(change[took] == log_changes, 1, np.where(change[took], 2, 3)),
                )
                rows.append(np.stack([kind, drawn[b, :, n].numpy(), logged[b, :, n].numpy()], -1))
        print(f"{begin + len(segments)} of {len(store)}", end="\r", flush=True)
    kind, one, other = np.concatenate(rows).astype(float).T
    record: dict[str, Any] = {
        "agent": args.agent,
        "data": store.checksum(),
        "segments": len(store),
        "agents": len(rows),
        "rollouts": args.rollouts,
        "told": len(told),
        "changes": dict(zip(("log", "drawn"), 100 * np.mean(told, 0), strict=True)),
        "collisions": {"drawn": 100 * one.mean(), "logged": 100 * other.mean()},
        "kinds": {
            name: {
                "share": 100 * float((kind == k).mean()),
                "drawn": 100 * one[kind == k].mean(),
                "logged": 100 * other[kind == k].mean(),
                "points": 100 * (one - other)[kind == k].sum() / len(kind),
            }
            for k, name in enumerate(KINDS)
            if (kind == k).any()
        },
    }
    args.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
