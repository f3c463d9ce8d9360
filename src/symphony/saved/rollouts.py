"""Rollouts as kept on disk: what was simulated and the log it began in, complete without the store.

Shapes of one run segment: K rollouts, N driven agents, A agents of the log, T simulated steps; of its search trees,
R trees, S branches, P periods between prunings, L leaves. World frame of the segment, SI units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony import keys
from symphony.data.levels import agent_heights
from symphony.data.segment import Polylines, RunSegment

if TYPE_CHECKING:  # reading rollouts alone needs no torch
    from torch import Tensor

    from symphony.collectors import BeamSearchResult
    from symphony.envs.scene import SceneBatch
    from symphony.rollouts.unroll import Rollouts

PLAYBACK = "playback"  # the driver of every agent of the log that is not named
BACKGROUND = "background:"  # the start of the names of drivers whose agents are not evaluated


@dataclass(frozen=True)
class SavedTrees:
    """The searches that the rollouts of a segment come from: rollout ``r * L + l`` is leaf l of tree r.

    Attributes:
        state: [R, S, T, N, 4] x, y, heading, speed after each step, by the slot that simulated it.
        there: [R, S, T, N] whether the agent is present then; ``collision`` and ``offroad`` are alike.
        score: [R, S, T, N] of those states, high is bad; NaN where there is none.
        totals: [R, P, S] what the pruning after each period compared.
        parents: [R, P, S] after period p slot s was continued from slot ``parents[p, s]``.
        slots: [R, P, L] the slot in which each period of each leaf's history was simulated.
        prune_every: steps per period; the last may be shorter.
    """

    state: NDArray[np.float32]
    there: NDArray[np.bool_]
    collision: NDArray[np.bool_]
    offroad: NDArray[np.bool_]
    score: NDArray[np.float32]
    totals: NDArray[np.float32]
    parents: NDArray[np.int64]
    slots: NDArray[np.int64]
    prune_every: int


@dataclass(frozen=True)
class SavedRollouts:
    """K rollouts of one run segment.

    Attributes:
        segment: the log, its map and its lights.
        agents: [N] rows of the log that were driven; all others play back the log.
        state: [K, T + 1, N, 4] x, y, heading, speed, the first state included.
        counted: [K, T, N] steps at which an agent is present, up to the end of a rollout that failed; of the same
            shape are ``collision`` and ``offroad``.
        goal: [K, N] line of ``routes`` that an agent followed, -1 for none.
        routes: points of the routes; z is 0.
        start: step of the log at which the first state lies.
        drivers: [N] who drove each agent.
        failed: reason why a rollout broke off, by its number; its later steps don't count.
        trees: the searches, where they are kept.
        plan: [K, P, T, H, 2] points that the planners of the first P agents meant to pass, NaN for none; or None.
    """

    segment: RunSegment
    agents: NDArray[np.int64]
    state: NDArray[np.float32]
    counted: NDArray[np.bool_]
    collision: NDArray[np.bool_]
    offroad: NDArray[np.bool_]
    goal: NDArray[np.int64]
    routes: Polylines
    start: int = 0
    drivers: tuple[str, ...] = ()
    failed: Mapping[int, str] = field(default_factory=dict)
    trees: SavedTrees | None = None
    plan: NDArray[np.float32] | None = None

    @property
    def there(self) -> NDArray[np.bool_]:
        """The agents present at each state [K, T + 1, N]: at the first if the second counts and the log has them."""
        first = self.counted[:, :1] & self.segment.valid[self.agents, self.start]
        return np.concatenate([first, self.counted], 1)

    def logged(self, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return [rows, T + 1] where the log has agents at the simulated states."""
        within = np.arange(self.start, self.last + 1)
        return self.segment.valid[rows][:, within] & (within < self.segment.log_steps)

    @cached_property
    def log_height(self) -> NDArray[np.float32]:
        """The height and level of logged agents, see :func:`symphony.data.levels.agent_heights`."""
        return agent_heights(self.segment)

    @property
    def evaluated(self) -> NDArray[np.int64]:
        """The places among the N driven agents of those that are not background."""
        named = self.drivers or ("",) * len(self.agents)
        return np.flatnonzero([not name.startswith(BACKGROUND) for name in named])

    @property
    def rollouts(self) -> int:
        """The number of rollouts, K."""
        return len(self.state)

    @property
    def steps(self) -> int:
        """The number of simulated steps, T."""
        return self.state.shape[1] - 1

    @property
    def last(self) -> int:
        """The step of the log at which the last state lies."""
        return self.start + self.steps


class World(NamedTuple):
    """All agents in one rollout, A agents at U states: position [A, U, 2], heading [A, U], velocity [A, U, 2],
    presence [A, U], length and width [A, 2], height and level [A, U, 2] (:mod:`symphony.data.levels`) if known.
    """

    position: NDArray[np.float64]
    heading: NDArray[np.float64]
    velocity: NDArray[np.float64]
    valid: NDArray[np.bool_]
    size: NDArray[np.float64]
    height: NDArray[np.float32] | None = None

    @property
    def speed(self) -> NDArray[np.float64]:
        """The speed along the heading [A, U], negative when reversing."""
        return self.velocity[..., 0] * np.cos(self.heading) + self.velocity[..., 1] * np.sin(self.heading)


def world_of(saved: SavedRollouts, rollout: int) -> World:
    """Return all agents in one rollout: driven ones where they were driven, all others as logged."""
    segment, agents, within = saved.segment, saved.agents, slice(saved.start, saved.last + 1)
    logged = (segment.position[..., :2], segment.heading, segment.velocity)
    position, heading, velocity = (part[:, within].astype(np.float64) for part in logged)
    valid, there = segment.valid[:, within].copy(), saved.there[rollout].T
    state = np.where(there[..., None], saved.state[rollout].swapaxes(0, 1), 0).astype(np.float64)
    direction = np.stack([np.cos(state[..., 2]), np.sin(state[..., 2])], -1)
    position[agents], heading[agents] = state[..., :2], state[..., 2]
    velocity[agents], valid[agents] = state[..., 3:] * direction, there
    height = None
    if len(saved.log_height):
        # Of driven agents those of the nearest places of their logs.
        place = saved.state[rollout].swapaxes(0, 1)[:, :, None, :2]
        away = np.square(segment.position[agents][:, None, :, :2] - place).sum(-1)
        step = np.where(segment.valid[agents][:, None], away, np.inf).argmin(-1)
        height = saved.log_height[within].swapaxes(0, 1).copy()
        height[agents] = saved.log_height[step, agents[:, None]]
    return World(position, heading, velocity, valid, segment.size[:, :2].astype(np.float64), height)


def saved_rollouts(
    segment: RunSegment,
    scenes: SceneBatch,
    rollouts: Rollouts,
    row: int = 0,
    *,
    goal: Tensor | None = None,
    search: BeamSearchResult | None = None,
    driver: str | Sequence[str] = "",
    others: str = "",
    failed: Mapping[int, str] | None = None,
    plan: NDArray[np.float32] | None = None,
) -> SavedRollouts:
    """Return the rollouts of one run segment, a row of the B scenes, ready to be written. Takes those of all scenes
    [B, K, ...], their goals [B, K, N], the search [B, R] whose leaves they are, the driver of all interactive agents
    or of each, that of background agents (``others``), why rollouts failed, by number, and planned paths (``plan``).
    """
    real, background = (_array(part[row]) for part in (scenes.interactive_valid, scenes.background))
    steps = min(segment.num_steps - 1, rollouts.collision.shape[-2])
    collision, offroad, counted = (_array(part[row])[:, :steps, real] for part in rollouts[1:])
    names = [driver] * len(real) if isinstance(driver, str) else driver
    names = [BACKGROUND + others if rule else name for name, rule in zip(names, background, strict=True)]
    line, routes = _routes(scenes, row, goal, len(counted))
    agents, state = _array(scenes.interactive[row])[real], _array(rollouts.state[row])[:, : steps + 1, real]
    about: dict[str, Any] = {"drivers": tuple(np.array(names, object)[real]), "failed": dict(failed or {})}
    about["trees"] = None if search is None else _trees(search, row, steps, real)
    about["plan"] = None if plan is None else plan[:, :, :steps]
    return SavedRollouts(segment, agents, state, counted, collision, offroad, line[:, real], routes, **about)


def _array(part: Tensor) -> NDArray[Any]:
    return part.detach().cpu().numpy()


def _routes(scenes: SceneBatch, row: int, goal: Tensor | None, rollouts: int) -> tuple[NDArray[np.int64], Polylines]:
    """Return goals [K, N] as numbers of the distinct routes that some rollout follows, and these routes."""
    agents = scenes.interactive.shape[1]
    chosen = np.full((rollouts, agents), -1) if goal is None else _array(goal[row])
    place = np.broadcast_to(np.arange(agents), chosen.shape)
    # Agents have routes of their own: a pair (agent, route) is one line.
    pairs, number = np.unique(np.stack([place, chosen], -1).reshape(-1, 2), axis=0, return_inverse=True)
    follows = pairs[:, 1] >= 0
    lines = [_array(scenes.whole_route(row, *pair)) for pair in pairs[follows].tolist()]
    line = np.where(follows, np.cumsum(follows) - 1, -1)
    return line[number.reshape(chosen.shape)], Polylines.of(lines)


def _trees(search: BeamSearchResult, row: int, steps: int, real: NDArray[np.bool_]) -> SavedTrees:
    if search.tree is None:
        raise ValueError("the search did not keep its tree")
    names = (keys.STATE, keys.VALID, keys.COLLISION, keys.OFFROAD)
    kept = [search.tree.get(("next", *key)) for key in names] + [search.simulated_scores]
    state, there, hit, off, score = (_array(part[row])[:, :, :steps, real] for part in kept)
    periods = math.ceil(steps / search.prune_every)
    rest = (search.totals, search.parents, search.slots)
    totals, parents, slots = (_array(part[row])[:, :periods] for part in rest)
    hit, off, every = hit[..., 0], off[..., 0], search.prune_every
    return SavedTrees(state, there, hit, off, score, totals, parents, slots, every)
