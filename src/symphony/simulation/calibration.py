"""How bad a branch may look before it is replaced, taken from what the log itself looks like."""

from __future__ import annotations

import torch
from jaxtyping import Float
from tensordict import TensorDict
from torch import Tensor

from symphony import keys
from symphony.agents import Agent
from symphony.config import SearchConfig
from symphony.envs.driving import DrivingEnv
from symphony.errors import ConfigError, DataError
from symphony.simulation.demonstrations import SceneDataset
from symphony.simulation.search import aggregate_of, realism_score

BATCH = 16
"""Run segments at a time, unless something else is asked for."""


@torch.no_grad()
def logged_totals(
    agent: Agent, dataset: SceneDataset, search: SearchConfig, batch: int = BATCH
) -> Float[Tensor, " M"]:
    """Totals that the log would get in a search, one for each of its periods in which all interactive agents exist.

    The log is taken as fitted to the action space, and agents that follow routes follow those they took.

    Args:
        agent: whose discriminator evaluates.
        dataset: with routes if the agent follows some.
        search: its periods and aggregate.
        batch: segments at a time.

    Raises:
        ConfigError: if the agent has no discriminator.
    """
    if agent.discriminator is None:
        raise ConfigError(f"{agent.name} has no discriminator to calibrate a threshold by")
    agent.check_step(dataset.dt)
    device = next(agent.discriminator.parameters()).device
    aggregate, found = aggregate_of(search), []
    for first in range(0, len(dataset), batch):
        items = list(range(first, min(first + batch, len(dataset))))
        scenes = dataset.scenes(items).to(device)
        env = DrivingEnv(scenes, agent.dynamics, agent.observation)
        score = realism_score(env, agent.discriminator)
        state, logged, progress = dataset.fitted(items, scenes)
        past = torch.arange(state.shape[1], device=device) > scenes.last_step[:, None]
        there = (logged | ~scenes.interactive_valid[:, None]).all(-1) | past
        scene = torch.arange(len(items), device=device)
        goal = scenes.route_logged if agent.goals is not None else torch.full_like(scenes.interactive, -1)
        for begin in range(1, state.shape[1], search.prune_every):
            steps = range(begin, min(begin + search.prune_every, state.shape[1]))
            whole = there[:, list(steps)].all(-1) & ~past[:, begin]
            rows = scene[whole]
            if not len(rows):
                continue
            still = {
                keys.SCENE: rows[:, None],
                keys.STREAM: torch.zeros_like(rows)[:, None],
                keys.VALID: scenes.interactive_valid[rows],
                keys.GOAL: goal[rows],
                keys.PROGRESS: progress[rows, begin - 1],
            }
            scores = []
            for step in steps:
                moving = {keys.STEP: torch.full_like(rows, step)[:, None], keys.STATE: state[rows, step]}
                scores.append(score(env.at(TensorDict(still | moving, batch_size=[len(rows)]))))
            found.append(aggregate(torch.stack(scores, -2)[:, None])[:, 0])
    if not found:
        raise DataError("no interactive agents exist for a whole period", file=dataset.store.path)
    return torch.cat(found)


def calibrated_threshold(
    agent: Agent, dataset: SceneDataset, search: SearchConfig, quantile: float, batch: int = BATCH
) -> float:
    """The total that this share of the logged periods stays below: the threshold of rule ``replace``.

    Args:
        agent: see :func:`logged_totals`.
        dataset: likewise.
        search: likewise.
        quantile: in (0, 1): of 0.99, a branch that drove as the log does would be replaced once in a hundred periods.
        batch: likewise.

    Raises:
        ConfigError: for another quantile, or if the agent has no discriminator.
    """
    if not 0.0 < quantile < 1.0:
        raise ConfigError(f"the quantile must be between 0 and 1, is {quantile}")
    totals = logged_totals(agent, dataset, search, batch)
    return float(totals.double().quantile(quantile))
