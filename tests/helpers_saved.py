"""Saved rollouts for tests: hand-made ones, and those of the included agent with their search."""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np

from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.segment import Polylines, RunSegment
from symphony.data.store import SegmentStore
from symphony.learning.demonstrations import SceneDataset
from symphony.rollouts.driving import simulate_batch
from symphony.saved.folder import About
from symphony.saved.rollouts import SavedRollouts, SavedTrees, saved_rollouts

AGENT = "pretrained:bc_ts_h"


def played(segment: RunSegment, agents: Any = (0,), rollouts: int = 1, **changes: Any) -> SavedRollouts:
    """The log itself, as if it had been simulated; any field by name."""
    rows = np.asarray(agents, np.int64)
    velocity, heading, valid = (getattr(segment, name)[rows] for name in ("velocity", "heading", "valid"))
    speed = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
    state = np.concatenate([segment.position[rows, :, :2], heading[..., None], speed[..., None]], -1)
    shape = (rollouts, segment.num_steps - 1, len(rows))
    values: dict[str, Any] = {
        "segment": segment, "agents": rows,
        "state": np.repeat(state.swapaxes(0, 1)[None], rollouts, 0).astype(np.float32),
        "counted": np.repeat(valid.T[None, 1:] & valid.T[None, :-1], rollouts, 0),
        "collision": np.zeros(shape, bool), "offroad": np.zeros(shape, bool),
        "goal": np.full((rollouts, len(rows)), -1, np.int64), "routes": Polylines.of([]),
        "drivers": ("made",) * len(rows),
    }  # fmt: skip
    return SavedRollouts(**{**values, **changes})


def random_trees(saved: SavedRollouts, branches: int = 4, every: int = 2, seed: int = 0) -> SavedTrees:
    """One search of numbers that mean nothing."""
    rng = np.random.default_rng(seed)
    shape = (1, branches, saved.steps, len(saved.agents))
    periods = -(-saved.steps // every)
    return SavedTrees(
        state=rng.normal(size=(*shape, 4)).astype(np.float32), there=rng.random(shape) < 0.8,
        collision=rng.random(shape) < 0.5, offroad=rng.random(shape) < 0.5,
        score=rng.normal(size=shape).astype(np.float32),
        totals=rng.normal(size=(1, periods, branches)).astype(np.float32),
        parents=rng.integers(0, branches, (1, periods, branches)),
        slots=rng.integers(0, branches, (1, periods, saved.rollouts)), prune_every=every,
    )  # fmt: skip


@lru_cache
def searched(count=2, rollouts=4, branches=6, duration=4) -> tuple[About, list[SavedRollouts]]:
    """Rollouts of the included agent, leaves of one search each, on the first built-in test segments."""
    agent, store = load_agent(AGENT), SegmentStore(builtin_store("test"))
    how: dict[str, Any] = {"routes": True, "duration": duration}
    dataset = SceneDataset(store, agent.interactive, agent.dynamics, range(count), **how)
    config = EvaluateConfig(search="tree", score="discriminator", rollouts=rollouts, branches=branches)
    scenes = dataset.scenes(range(count))
    found = simulate_batch(agent, scenes, config, keep_tree=True)
    how = {"goal": found.goal, "search": found.search, "driver": AGENT}
    segments = [dataset.segment(b).replace(group=store.tags(b)["network"]) for b in range(count)]
    saved = [saved_rollouts(segment, scenes, found.rollouts, b, **how) for b, segment in enumerate(segments)]
    return About.of(AGENT, store, asdict(config)), saved
