"""Rollouts as they are kept on disk: what was simulated and the log it began in, complete without the store.

Shapes of one run segment: K rollouts, N driven agents, A agents of the log, T simulated steps; of its search trees,
R trees, S branches, P periods between prunings, L leaves. World frame of the segment, SI units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from symphony import keys
from symphony.data.levels import agent_heights
from symphony.data.segment import Polylines, RunSegment

if TYPE_CHECKING:  # who only reads rollouts waits for no torch
    from torch import Tensor

    from symphony.collectors import BeamSearchResult
    from symphony.envs.scene import SceneBatch
    from symphony.rollouts.unroll import Rollouts

PLAYBACK = "playback"
"""The driver of every agent of the log that is not named."""
BACKGROUND = "background:"
"""The begin of the names of drivers whose agents nobody evaluates."""


@dataclass(frozen=True)
class SavedTrees:
    """The searches that the rollouts of a segment come from: rollout ``r * L + l`` is leaf l of tree r.

    Attributes:
        state: [R, S, T, N, 4] x, y, heading, speed after each step, by the slot that simulated it.
        there: [R, S, T, N] whether the agent is there then (in open traffic agents come and go).
        collision: [R, S, T, N].
        offroad: [R, S, T, N].
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

    @property
    def reaches_leaf(self) -> NDArray[np.bool_]:
        """[R, P, S] whether what a slot simulated in a period is part of the history of a leaf."""
        return (self.slots[..., None] == np.arange(self.parents.shape[-1])).any(-2)

    @property
    def copies(self) -> NDArray[np.int64]:
        """[R, P, S] how many slots were continued from what each slot simulated in a period."""
        return (self.parents[..., None] == np.arange(self.parents.shape[-1])).sum(-2)


@dataclass(frozen=True)
class SavedRollouts:
    """K rollouts of one run segment.

    Attributes:
        segment: the log, its map and its lights.
        agents: [N] rows of the log that were driven; all others play back the log.
        state: [K, T + 1, N, 4] x, y, heading, speed, the first state included.
        counted: [K, T, N] steps at which an agent is there, up to the end of a rollout that failed.
        collision: [K, T, N].
        offroad: [K, T, N].
        goal: [K, N] line of ``routes`` that an agent followed, -1 for none.
        routes: points of the routes; z is 0.
        start: step of the log at which the first state lies.
        drivers: [N] who drove each agent.
        failed: reason why a rollout broke off, by its number; its later steps don't count.
        trees: the searches, where they are kept.
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

    @property
    def there(self) -> NDArray[np.bool_]:
        """[K, T + 1, N] which agents are there at each state.

        At the first one where the second counts and the log has them, too: who enters with the first step was not
        there before.
        """
        first = self.counted[:, :1] & self.segment.valid[self.agents, self.start]
        return np.concatenate([first, self.counted], 1)

    @cached_property
    def log_height(self) -> NDArray[np.float32]:
        """See :func:`symphony.data.levels.agent_heights`."""
        return agent_heights(self.segment)

    @property
    def evaluated(self) -> NDArray[np.int64]:
        """Places among the N driven agents of those that are no background."""
        named = self.drivers or ("",) * len(self.agents)
        return np.flatnonzero([not name.startswith(BACKGROUND) for name in named])

    @property
    def rollouts(self) -> int:
        """K."""
        return len(self.state)

    @property
    def steps(self) -> int:
        """T."""
        return self.state.shape[1] - 1

    @property
    def last(self) -> int:
        """Step of the log at which the last state lies."""
        return self.start + self.steps

    def route(self, rollout: int, agent: int) -> NDArray[np.float32] | None:
        """Points [P, 2] of the route that driven agent n followed; None for none."""
        number = int(self.goal[rollout, agent])
        return None if number < 0 else self.routes[number][:, :2]


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
) -> SavedRollouts:
    """Rollouts of one run segment, ready to be written.

    Args:
        segment: in row ``row`` of the scenes.
        scenes: that were simulated.
        rollouts: [B, K, ...] of them.
        row: of the batch.
        goal: [B, K, N] number of the route that each agent followed among its feasible ones, -1 for none.
        search: of which the rollouts are the leaves, with leading dimensions [B, R] and its tree kept.
        driver: of all interactive agents, or of each [N].
        others: what drives background agents.
        failed: see :class:`SavedRollouts`.
    """
    real = scenes.interactive_valid[row].cpu().numpy()
    steps = min(segment.num_steps - 1, rollouts.collision.shape[-2])
    counted, collision, offroad = (
        _array(part[row])[:, :steps, real]
        for part in (rollouts.counted, rollouts.collision, rollouts.offroad)
    )
    names = [driver] * len(real) if isinstance(driver, str) else list(driver)
    background = scenes.background[row].tolist()
    names = [BACKGROUND + others if rule else name for name, rule in zip(names, background, strict=True)]
    number, routes = _routes(scenes, row, goal, len(counted))
    return SavedRollouts(
        segment=segment,
        agents=_array(scenes.interactive[row])[real],
        state=_array(rollouts.state[row])[:, : steps + 1, real],
        counted=counted,
        collision=collision,
        offroad=offroad,
        goal=number[:, real],
        routes=routes,
        drivers=tuple(name for name, there in zip(names, real, strict=True) if there),
        failed=dict(failed or {}),
        trees=None if search is None else _trees(search, row, steps, real),
    )


def _array(part: Tensor) -> NDArray[Any]:
    return part.detach().cpu().numpy()


def _routes(
    scenes: SceneBatch, row: int, goal: Tensor | None, rollouts: int
) -> tuple[NDArray[np.int64], Polylines]:
    """Goals [K, N] as numbers of the distinct routes that some rollout follows, and these."""
    agents = scenes.interactive.shape[1]
    if goal is None:
        return np.full((rollouts, agents), -1, np.int64), Polylines.of([])
    chosen = _array(goal[row]).astype(np.int64)
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
    state, there, collision, offroad = (
        _array(search.tree.get(("next", *key))[row])[:, :, :steps, real]
        for key in (keys.STATE, keys.VALID, keys.COLLISION, keys.OFFROAD)
    )
    periods = math.ceil(steps / search.prune_every)
    totals, parents = (_array(part[row])[:, :periods] for part in (search.totals, search.parents))
    return SavedTrees(
        state=state,
        there=there,
        collision=collision[..., 0],
        offroad=offroad[..., 0],
        score=_array(search.simulated_scores[row])[:, :, :steps, real],
        totals=totals,
        parents=parents,
        slots=_array(search.slots[row])[:, :periods],
        prune_every=search.prune_every,
    )
