"""Simulate an agent and keep its rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.simulation.demonstrations import SceneDataset
from symphony.simulation.driving import driven_by
from symphony.simulation.finite import NotFiniteError
from symphony.simulation.saved import PLAYBACK, saved_rollouts
from symphony.simulation.saved_files import About, RolloutFolder, RolloutWriter

_MEMORY = ("batch", "device", "metric")
"""Settings that change no rollout."""


def save_simulation(
    path: str | Path,
    agent: Agent,
    dataset: SceneDataset,
    config: EvaluateConfig,
    *,
    keep_tree: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> RolloutFolder:
    """Simulate an agent on every run segment of a dataset and keep the rollouts, segment by segment.

    What was cut short goes on where it stopped: rollouts depend on the seed and the segment, not on the batch.

    Args:
        path: the folder.
        agent: on ``config.device``; log playback is kept as it is.
        dataset: in the agent's action space, with routes if it follows goals.
        config: how it is simulated.
        keep_tree: of a search keep all branches with their scores, too.
        progress: called with the segments done and their total.

    Raises:
        DataError: the folder holds something else, or the disk refuses.
        ConfigError: the agent can't be simulated so.
        NotFiniteError: a network of the agent puts out a number that is not finite.
    """
    writer = RolloutWriter(
        path,
        About.of(
            agent.name,
            dataset.store,
            plain_settings(config, dataset.interactive, dataset.duration),
            seed=config.seed,
        ),
    )
    names = [dataset.store.ids[i] for i in dataset.indices]
    todo = [i for i, name in enumerate(names) if not writer.has(name)]
    driver = PLAYBACK if agent.policy is None else agent.name
    for first in range(0, len(todo), config.batch):
        items = todo[first : first + config.batch]
        scenes = dataset.scenes(items).to(torch.device(config.device))
        try:
            found = driven_by(agent, scenes, config, keep_tree=keep_tree)
        except NotFiniteError as error:
            raise error.named(names[items[error.row]]) from error
        tree = found.search if keep_tree else None
        rollouts, on_cpu = found.rollouts.cpu(), scenes.cpu()
        for b, i in enumerate(items):
            segment = dataset.segment(i)
            writer.add(
                saved_rollouts(segment, on_cpu, rollouts, b, goal=found.goal, search=tree, driver=driver)
            )
        if progress is not None:
            progress(len(names) - len(todo) + first + len(items), len(names))
    return RolloutFolder(path)


def plain_settings(config: EvaluateConfig, interactive: int, duration: float) -> dict[str, Any]:
    """Settings that change what is simulated, with the agent's own where the configuration leaves them to it."""
    found = dataclasses.asdict(config)
    found |= {"interactive": config.interactive or interactive, "duration": config.duration or duration}
    return {name: value for name, value in found.items() if name not in _MEMORY}
