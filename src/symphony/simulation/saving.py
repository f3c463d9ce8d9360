"""Simulate an agent and keep its rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.errors import DataError
from symphony.simulation.demonstrations import SceneDataset
from symphony.simulation.driving import Simulation, driven_by
from symphony.simulation.finite import NotFiniteError
from symphony.simulation.planned import EgoPlanners
from symphony.simulation.planner import planner_maker
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
    planner: str = "",
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
        planner: of the ego, ``idm``, ``log`` or an import path; then the dataset holds routes and the agent drives
            the other interactive agents. Segments whose ego can't be driven are put on record as failed.
        progress: called with the segments done and their total.

    Raises:
        DataError: the folder holds something else, or the disk refuses.
        ConfigError: the agent can't be simulated so.
        NotFiniteError: a network of the agent puts out a number that is not finite.
    """
    make = planner_maker(planner) if planner else None
    about = About.of(
        agent.name,
        dataset.store,
        plain_settings(config, dataset.interactive, dataset.duration),
        seed=config.seed,
    )
    writer = RolloutWriter(path, about.with_ego(planner) if planner else about)
    names = [dataset.store.ids[i] for i in dataset.indices]
    todo = [i for i, name in enumerate(names) if not writer.has(name)]
    done = len(names) - len(todo)
    driver = PLAYBACK if agent.policy is None else agent.name
    drivers = [planner, *[driver] * (dataset.interactive - 1)] if planner else driver
    for first in range(0, len(todo), config.batch):
        chunk = todo[first : first + config.batch]
        items = _with_ego(writer, dataset, chunk, config.rollouts) if planner else chunk
        if items:
            scenes = dataset.scenes(items).to(torch.device(config.device))
            segments = [dataset.segment(i) for i in items]
            egos = None if make is None else EgoPlanners(planner, make, segments)
            try:
                found = driven_by(agent, scenes, config, keep_tree=keep_tree, egos=egos)
            except NotFiniteError as error:
                raise error.named(names[items[error.row]]) from error
            _write(writer, segments, scenes, found, drivers, keep_tree=keep_tree)
        if progress is not None:
            progress(done + first + len(chunk), len(names))
    return RolloutFolder(path)


def _write(
    writer: RolloutWriter,
    segments: Sequence[RunSegment],
    scenes: SceneBatch,
    found: Simulation,
    driver: str | Sequence[str],
    *,
    keep_tree: bool,
) -> None:
    """Add the rollouts of a batch to a folder."""
    tree = found.search if keep_tree else None
    rollouts, on_cpu = found.rollouts.cpu(), scenes.cpu()
    for b, segment in enumerate(segments):
        failed = found.failed[b] if found.failed else None
        writer.add(
            saved_rollouts(
                segment, on_cpu, rollouts, b, goal=found.goal, search=tree, driver=driver, failed=failed
            )
        )


def _with_ego(writer: RolloutWriter, dataset: SceneDataset, items: Sequence[int], rollouts: int) -> list[int]:
    """Those whose first interactive agent is the ego; the others are put on record as failed."""
    found = []
    for i in items:
        segment = dataset.segment(i)
        try:
            usable = int(dataset.scene(i).interactive[0, 0]) == segment.ego
            why = "the ego is no vehicle that is seen at the first step"
        except DataError as error:
            usable, why = False, error.message
        if usable:
            found.append(i)
        else:
            writer.fail(segment.segment_id, rollouts, why)
    return found


def plain_settings(config: EvaluateConfig, interactive: int, duration: float) -> dict[str, Any]:
    """Settings that change what is simulated, with the agent's own where the configuration leaves them to it."""
    found = dataclasses.asdict(config)
    found |= {"interactive": config.interactive or interactive, "duration": config.duration or duration}
    return {name: value for name, value in found.items() if name not in _MEMORY}
