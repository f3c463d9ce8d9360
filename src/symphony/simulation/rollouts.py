"""Closed-loop simulation, with and without search, keeping only what is read afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from symphony import keys
from symphony.collectors import (
    BeamSearchResult,
    KeepBest,
    KeyScore,
    PruningRule,
    Systematic,
    beam_search,
)
from symphony.config import SearchConfig
from symphony.envs.driving import DrivingEnv
from symphony.modules import SeededNoise, drawn_goals
from symphony.streams import fold_in, uniform

ENDED = -100.0
"""Score past a scene's last logged step, below all others: it decides no maximum, and in a mean or sum it weighs
equally on all branches.
"""
_GOALS = 1 << 40
_PRUNING = (1 << 40) + 1
_RETRIES = (1 << 40) + 2
"""Numbers of the streams that goals, prunings and repeats draw from, far above those of rollouts and agents."""


class Rollouts(NamedTuple):
    """What became of the interactive agents. T simulated steps, after the first state.

    Attributes:
        state: [..., T + 1, N, 4] x, y, heading, speed, the first state included.
        collision: [..., T, N].
        offroad: [..., T, N].
        counted: [..., T, N] steps that are judged: of real agents, up to the segment's last logged step.
    """

    state: Tensor
    collision: Tensor
    offroad: Tensor
    counted: Tensor

    def cpu(self) -> Rollouts:
        """The same on the CPU."""
        return Rollouts(*(part.cpu() for part in self))


@torch.no_grad()
def simulate(
    env: DrivingEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    start: TensorDictBase,
    steps: int | None = None,
) -> Rollouts:
    """Roll a policy out from a start state.

    Only states and flags are kept: the observations of sixteen rollouts would take gigabytes.

    Args:
        env: the environment.
        policy: writes the action into the TensorDict it is given.
        start: as returned by :meth:`DrivingEnv.start`, any batch shape.
        steps: decisions; by default up to the last logged step of the longest scene.
    """
    steps = _steps(env, start) if steps is None else steps
    now, states, collisions, offroads = start, [start.get(keys.STATE)], [], []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(steps):
            now = step_mdp(env.step(policy(now)), exclude_reward=True)
            states.append(now.get(keys.STATE))
            collisions.append(now.get(keys.COLLISION).squeeze(-1))
            offroads.append(now.get(keys.OFFROAD).squeeze(-1))
    return Rollouts(
        torch.stack(states, -3),
        torch.stack(collisions, -2),
        torch.stack(offroads, -2),
        _counted(env, start, steps),
    )


@torch.no_grad()
def draw_goals(
    env: DrivingEnv, goals: TensorDictModuleBase | None, start: TensorDictBase, seed: int, tree: Tensor
) -> Tensor:
    """The route [..., N] each agent follows from a start state, -1 for none.

    Args:
        env: the environment.
        goals: the goal policy; None takes the routes nearest to the log.
        start: [...], one entry per draw.
        seed: of the draw.
        tree: [...] number of the draw within its scene, so that it is the same whatever the batch.
    """
    if goals is None:
        return env.scenes.route_logged[start.get(keys.SCENE).squeeze(-1)]
    seen = env.choices(start)
    stream = fold_in(fold_in(env.scenes.stream[start.get(keys.SCENE)], _GOALS), tree[..., None])
    place = torch.arange(env.num_agents, device=start.device)
    seen.set(keys.GOAL_NOISE, uniform(seed, fold_in(stream, place), 0))
    with set_exploration_type(ExplorationType.RANDOM):
        seen = goals(seen)
    return drawn_goals(seen.get(keys.GOAL), seen.get(keys.ROUTES_MASK))


def plant(
    env: DrivingEnv,
    goals: TensorDictModuleBase | None,
    *,
    trees: int,
    branches: int,
    seed: int,
    logged_goals: bool = False,
) -> TensorDictBase:
    """First states [B, trees, branches] of all scenes; branches of a tree share their goals, trees draw their own.

    Args:
        env: the environment.
        goals: the goal policy; None for agents that follow none.
        trees: per scene.
        branches: per tree.
        seed: of the goals.
        logged_goals: take the routes nearest to the log instead.
    """
    device, scenes = env.scenes.device, len(env.scenes)
    number = torch.arange(trees * branches, device=device).reshape(trees, branches)
    scene = torch.arange(scenes, device=device)[:, None, None]
    start = env.start(scene.expand(-1, trees, branches), number.expand(scenes, -1, -1))
    if goals is None:
        return start
    tree = torch.arange(trees, device=device).expand(scenes, trees)
    goal = draw_goals(env, None if logged_goals else goals, start[..., 0], seed, tree)
    return env.with_goals(start, goal[..., None, :].expand(*start.shape, -1))


def pruning_rule(config: SearchConfig) -> PruningRule:
    """Which branches go on."""
    return Systematic(config.temperature) if config.rule == "systematic" else KeepBest(config.keep)


def flag_score(state: TensorDictBase) -> Tensor:
    """Score [..., N] of an oracle: 1 where an agent collides or is off the road."""
    bad = state.get(keys.COLLISION) | state.get(keys.OFFROAD)
    return (bad.squeeze(-1) & state.get(keys.VALID)).float()


def search(
    env: DrivingEnv,
    policy: TensorDictModuleBase,
    discriminator: TensorDictModuleBase | None,
    start: TensorDictBase,
    *,
    seed: int,
    rule: PruningRule,
    prune_every: int,
    leaves: int | None = None,
    keep_tree: bool = False,
    retries: int = 0,
    retry_above: float = 0.0,
) -> BeamSearchResult:
    """Beam search from a start state [..., S] to the last logged step (paper, section IV-A).

    Args:
        env: the environment.
        policy: writes the action.
        discriminator: scores the states; None takes the true collision and off-road flags (an oracle).
        start: all branches of a tree with the same goals.
        seed: of the actions.
        rule: which branches go on.
        prune_every: T_p.
        leaves: return only so many of each tree, the best of the last period; by default all.
        keep_tree: also return the pruned branches.
        retries: how often a period is simulated again, from its start, for branches that end it with a total above
            ``retry_above``.
        retry_above: that total.
    """
    score: Callable[[TensorDictBase], Tensor] = flag_score
    if discriminator is not None:
        score = KeyScore(keys.SCORE, discriminator, valid_key=keys.VALID)
    last = env.scenes.last_step

    def until_the_end(state: TensorDictBase) -> Tensor:
        going = state.get(keys.STEP) <= last[state.get(keys.SCENE)]
        return torch.where(going, score(state), ENDED)

    # The random numbers of the pruning are the tree's: those of its first branch, told apart from its actions'.
    steps, root = _steps(env, start), start.get(keys.STREAM)[..., 0, :]
    periods = torch.arange(-(-steps // prune_every), device=start.device)
    following = [("next", *key) for key in (keys.STATE, keys.COLLISION, keys.OFFROAD)]
    return beam_search(
        env,
        TensorDictSequential(SeededNoise(seed, env.dynamics.numbers), policy),
        until_the_end,
        start,
        steps=steps,
        prune_every=prune_every,
        rule=rule,
        noise=uniform(seed, fold_in(root, _PRUNING), periods),
        leaves=leaves,
        # A copy takes the random numbers of the place it lands in, so that forks part.
        slot_keys=(keys.STREAM,),
        keep=[keys.STATE, keys.ACTION, keys.NOISE, keys.STEP, *following],
        keep_tree=keep_tree,
        retries=retries,
        retry_above=retry_above if retries else None,
        reseed=_reseed,
    )


def branched_streams(start: TensorDictBase) -> TensorDictBase:
    """A start state [*b, S] whose branches each have a stream of random numbers of their own."""
    slot = torch.arange(start.shape[-1], device=start.device)[:, None]
    return start.set(keys.STREAM, fold_in(start.get(keys.STREAM), slot))


def _reseed(state: TensorDictBase, attempt: int) -> TensorDictBase:
    return state.set(keys.STREAM, fold_in(state.get(keys.STREAM), _RETRIES + attempt))


def rollouts_of(env: DrivingEnv, start: TensorDictBase, trajectories: TensorDictBase) -> Rollouts:
    """What the evaluator reads, from the leaves [..., L, T] of a search that began in ``start`` [..., S], S >= L."""
    start = start[..., : trajectories.shape[-2]]
    state = torch.cat([start.get(keys.STATE)[..., None, :, :], trajectories.get(("next", *keys.STATE))], -3)
    collision, offroad = (
        trajectories.get(("next", *key)).squeeze(-1) for key in (keys.COLLISION, keys.OFFROAD)
    )
    return Rollouts(state, collision, offroad, _counted(env, start, collision.shape[-2]))


def _steps(env: DrivingEnv, start: TensorDictBase) -> int:
    return int(env.scenes.last_step[start.get(keys.SCENE)].max())


def _counted(env: DrivingEnv, start: TensorDictBase, steps: int) -> Tensor:
    step = start.get(keys.STEP) + torch.arange(1, steps + 1, device=start.device)
    within = step <= env.scenes.last_step[start.get(keys.SCENE)]
    return within[..., None] & start.get(keys.VALID)[..., None, :]
