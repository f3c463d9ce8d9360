"""How varied the proposals of an agent are, before any search: entropy of its decisions, distance between rollouts.

    python scripts/proposals.py pretrained:bc_ts_h town/test --segments 200 --json proposals.json

Every segment is simulated without a search. ``entropy`` is the mean over the decisions at the first state, in nats;
``spread`` the distance of the rollouts of a segment to their mean, root mean square over rollouts, mean over agents,
in metres, after each number of seconds that the segment lasts.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.distributions import Categorical

from symphony import EvaluateConfig, keys
from symphony.agents import load_agent
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, collate, scene
from symphony.modules import SeededNoise
from symphony.simulation.driving import simulated
from symphony.simulation.rollouts import start_states

BATCH = 8
SECONDS = (1.0, 2.0, 4.0, 8.0)


def spread(state: torch.Tensor, counted: torch.Tensor, step: int) -> list[float]:
    """Per interactive agent there throughout: distance [m] of its K places after `step` steps to their mean."""
    place = state[:, :, step, :, :2]  # [B, K, N, 2]
    apart = (place - place.mean(1, keepdim=True)).square().sum(-1).mean(1).sqrt()  # [B, N]
    return apart[counted[:, :, :step].all(2).all(1)].tolist()


def main() -> None:
    """Simulate, measure, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent")
    parser.add_argument("store", type=Path)
    parser.add_argument("--segments", type=int, help="the first so many; by default all")
    parser.add_argument("--rollouts", type=int, default=16)
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    torch.set_num_threads(1)
    agent, store = load_agent(args.agent), SegmentStore(args.store)
    if not agent.dynamics.discrete:
        parser.error(f"{args.agent} chooses no actions from a list, whose entropy could be told")
    config = EvaluateConfig(rollouts=args.rollouts, search="none")
    count = min(args.segments or len(store), len(store))
    entropies: list[float] = []
    apart: dict[float, list[float]] = {seconds: [] for seconds in SECONDS}
    for begin in range(0, count, BATCH):
        segments = [store[k] for k in range(begin, min(begin + BATCH, count))]
        scenes = collate([scene(s, 2) for s in segments])
        found = simulated(agent, scenes, config)
        env = DrivingEnv(scenes, agent.dynamics, agent.observation)
        start = start_states(env, agent.goals, trees=args.rollouts, branches=1, seed=config.seed)
        with torch.no_grad():
            first = agent.policy(SeededNoise(config.seed, agent.dynamics.numbers)(start))
        there = scenes.interactive_valid[:, None, None].expand(first[keys.LOGITS].shape[:-1])
        entropies += Categorical(logits=first[keys.LOGITS]).entropy()[there].tolist()
        for seconds in SECONDS:
            step = round(seconds / segments[0].dt)
            if step < found.state.shape[2]:
                apart[seconds] += spread(found.state, found.counted, step)
        print(f"{begin + len(segments)} of {count}", end="\r", flush=True)
    record: dict[str, Any] = {
        "agent": args.agent,
        "data": store.checksum(),
        "segments": count,
        "rollouts": args.rollouts,
        "entropy": float(np.mean(entropies)),
        "spread": {str(seconds): float(np.mean(found)) for seconds, found in apart.items() if found},
        "agents": {str(seconds): len(found) for seconds, found in apart.items()},
    }
    args.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
