"""Simulate an agent and keep its rollouts."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import torch

from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.envs.driving import NO_ROUTES
from symphony.errors import ConfigError, DataError
from symphony.learning.demonstrations import SceneDataset
from symphony.planners.calls import SECONDS
from symphony.planners.driver import ego_planners
from symphony.planners.identity import planner_settings
from symphony.planners.interface import Named, Planners, planner_name
from symphony.rollouts.control import given_goals
from symphony.rollouts.driving import beside_planner, simulate_batch
from symphony.rollouts.workers import batches, naming, segments_together, settled, shared
from symphony.saved.folder import About, RolloutFolder, RolloutWriter
from symphony.saved.rollouts import PLAYBACK, SavedRollouts, saved_rollouts

_MEMORY = ("batch", "device", "metric", "workers", "engine", "compile")  # settings that change no rollout
PLANNED = 16  # run segments simulated at a time with a planner, of which each rollout has a copy


def save_simulation(
    path: str | Path,
    agent: Agent,
    dataset: SceneDataset,
    config: EvaluateConfig,
    *,
    keep_tree: bool = True,
    planner: Named = "",
    planner_seconds: float = SECONDS,
    drives: Planners | None = None,
    goals: Sequence[str] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> RolloutFolder:
    """Simulate an agent on every run segment of a dataset and keep the rollouts in a folder, with ``keep_tree`` also
    all branches of the search. An interrupted one continues. With goals or a planner the dataset must have routes.

    The ``planner`` (see :func:`symphony.planners.interface.planner_maker`) drives the ego, those in ``drives`` the
    agents with these ids, which the dataset must have ``also`` (:class:`symphony.rollouts.crowd.Crowd`), and the
    agent all other interactive ones, without a search unless one is asked for. A run fails if an answer takes more
    than ``planner_seconds``. Segments whose planner has no agent to drive are recorded as failed. Goals are as in
    :func:`symphony.rollouts.control.given_goals`. ``progress`` is called with the segments done and their total.

    Raises:
        DataError: the folder holds something else, or the disk refuses.
        ConfigError: the agent can't be simulated in this way, or a goal can't be reached.
    """
    if drives and not planner:
        raise ConfigError("others can have a planner only beside one of the ego (`log` plays back its log)")
    after = getattr(config, "after_collision", "go-on")
    if agent.policy is None and not planner and (config.others, after) != ("log", "go-on"):
        raise ConfigError("log playback without a planner is all log: no --others, no --after-collision")
    if (agent.routed or planner or goals) and not dataset.routes:
        raise ConfigError(NO_ROUTES)
    planners: Planners = {None: planner, **(drives or {})} if planner else {}
    config = beside_planner(config) if planner else config
    settings = plain_settings(config, agent, dataset.interactive, dataset.duration)
    settings |= {"goal": list(goals)} if goals else {}
    settings |= planner_settings(planners, planner_seconds)  # fails before anything is simulated
    about = About.of(agent.name, dataset.store, settings, seed=config.seed, planner=planner_name(planner))
    with RolloutWriter(path, about) as writer:
        names = [dataset.store.ids[i] for i in dataset.indices]
        todo = [i for i, segment in enumerate(names) if not writer.has(segment)]
        if planner:
            todo = [i for i in todo if has_ego(writer, dataset, i, config.rollouts)]
        done = len(names) - len(todo)
        most = PLANNED if planner and not config.batch else len(names)
        together = min(segments_together(agent, config, dataset.interactive), max(most, 1))
        config = settled(config, dataset, -(-len(todo) // together))
        drive = partial(_drive, agent, dataset, config, keep_tree, planners, planner_seconds, tuple(goals))
        tasks = batches(todo, together, config)
        with closing(shared(drive, tasks, config, dataset)) as results:
            for saved in results:
                for one in saved:
                    writer.add(one)
                done += len(saved)
                progress(done, len(names))
    return RolloutFolder(path)


def _drive(
    agent: Agent,
    dataset: SceneDataset,
    config: EvaluateConfig,
    keep_tree: bool,
    planners: Planners,
    planner_seconds: float,
    goals: Sequence[str],
    items: list[int],
) -> list[SavedRollouts]:
    """Return an agent's rollouts of each run segment of a batch, with planners of the first agents, by id."""
    with naming(dataset, items):
        scenes = dataset.scenes(items).to(torch.device(config.device))
        segments = [dataset.segment(i) for i in items]
        drivers = [PLAYBACK if agent.policy is None else agent.name] * scenes.interactive.shape[1]
        given = given_goals(goals, segments, scenes, planned=len(planners)) if goals else None
        egos = ego_planners(planners, segments, scenes.interactive, planner_seconds)
        drivers[: len(egos)] = [one.name for one in egos]
        found = simulate_batch(agent, scenes, config, keep_tree=keep_tree, egos=egos, given=given)
        rollouts, on_cpu = found.rollouts.cpu(), scenes.cpu()
        about: dict[str, Any] = {"goal": found.goal, "driver": drivers, "others": config.others}
        about["search"] = found.search if keep_tree else None
        saved = []
        for b, segment in enumerate(segments):
            failed, plan = (found.failed[b], found.meant[b]) if found.failed else (None, None)
            saved.append(saved_rollouts(segment, on_cpu, rollouts, b, failed=failed, plan=plan, **about))
        return saved


def has_ego(writer: RolloutWriter, dataset: SceneDataset, item: int, rollouts: int) -> bool:
    """Return whether the first interactive agent of an item is the ego; otherwise record it as failed."""
    segment, why = dataset.segment(item), "the ego is not a vehicle that is seen at the first step"
    try:
        if int(dataset.scene(item).interactive[0, 0]) == segment.ego:
            return True
    except DataError as error:
        why = error.message
    writer.fail(segment.segment_id, rollouts, why, segment.group)
    return False


def plain_settings(config: EvaluateConfig, agent: Agent, interactive: int, duration: float) -> dict[str, Any]:
    """Return settings that change what is simulated, with the agent's choices filled in, and digests of its files."""
    found = dataclasses.asdict(config)
    found |= {"interactive": config.interactive or interactive, "duration": config.duration or duration}
    found = {name: value for name, value in found.items() if name not in _MEMORY}
    if not agent.modules:
        return found
    weights = hashlib.sha256()
    for part, module in sorted(agent.modules.items()):
        for name, value in sorted(module.state_dict().items()):
            weights.update(f"{part}.{name} {value.dtype} {tuple(value.shape)}".encode())
            weights.update(value.detach().cpu().contiguous().numpy().tobytes())
    text = "" if agent.spec is None else json.dumps(dataclasses.asdict(agent.spec), sort_keys=True)
    built = hashlib.sha256(text.encode()).hexdigest()[:12]
    return found | {"weights": weights.hexdigest()[:12], "specification": built}
