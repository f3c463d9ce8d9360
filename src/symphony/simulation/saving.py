"""Simulate an agent and keep its rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.simulation.demonstrations import SceneDataset
from symphony.simulation.driving import driven_by
from symphony.simulation.finite import NotFiniteError
from symphony.simulation.saved import PLAYBACK, SavedRollouts, saved_rollouts
from symphony.simulation.saved_files import About, RolloutFolder, RolloutWriter
from symphony.simulation.workers import batches, naming, shared

_MEMORY = ("batch", "device", "metric", "workers", "engine")
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
    done = len(names) - len(todo)
    with closing(shared(_Drive(agent, dataset, config, keep_tree), batches(todo, config), config)) as results:
        for saved in results:
            for one in saved:
                writer.add(one)
            done += len(saved)
            if progress is not None:
                progress(done, len(names))
    return RolloutFolder(path)


@dataclass(frozen=True)
class _Drive:
    """Simulates an agent on a batch of run segments."""

    agent: Agent
    dataset: SceneDataset
    config: EvaluateConfig
    keep_tree: bool

    def __call__(self, items: list[int]) -> list[SavedRollouts]:
        """What it did in each."""
        dataset = self.dataset
        with naming(dataset, items):
            scenes = dataset.scenes(items).to(torch.device(self.config.device))
            try:
                found = driven_by(self.agent, scenes, self.config, keep_tree=self.keep_tree)
            except NotFiniteError as error:
                raise error.named(dataset.segment(items[error.row]).segment_id) from error
            tree = found.search if self.keep_tree else None
            rollouts, on_cpu = found.rollouts.cpu(), scenes.cpu()
            driver = PLAYBACK if self.agent.policy is None else self.agent.name
            return [
                saved_rollouts(
                    dataset.segment(i), on_cpu, rollouts, b, goal=found.goal, search=tree, driver=driver
                )
                for b, i in enumerate(items)
            ]


def plain_settings(config: EvaluateConfig, interactive: int, duration: float) -> dict[str, Any]:
    """Settings that change what is simulated, with the agent's own where the configuration leaves them to it."""
    found = dataclasses.asdict(config)
    found |= {"interactive": config.interactive or interactive, "duration": config.duration or duration}
    return {name: value for name, value in found.items() if name not in _MEMORY}
