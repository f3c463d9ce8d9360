"""The beam search on the driving environment (paper, section IV-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from symphony import keys
from symphony.collectors import (
    Backtrack,
    BeamSearchResult,
    KeepBest,
    KeyScore,
    PruningRule,
    ReplaceBad,
    Systematic,
    beam_search,
    max_then_sum,
)
from symphony.collectors.rules import takes_groups
from symphony.config import Score, SearchConfig
from symphony.envs.driving import DrivingEnv
from symphony.envs.flags import collision_flags
from symphony.errors import ConfigError
from symphony.imports import load_object
from symphony.learning.demonstrations import SceneDataset
from symphony.modules import SeededNoise
from symphony.rollouts.unroll import draw_goals
from symphony.streams import Stream, fold_in, uniform

FILL, FEW = 4, 256
"""Lines that go back: those of so many times the usual run segments are simulated one after the other, as many at a
time as usual, at least so many: else the last steps of every batch would be of few lines.
"""
AHEAD = 0.5
"""Seconds that :func:`rule_score` looks ahead."""
KEPT: Sequence[keys.Key] = [
    *(keys.SCENE, keys.STEP, keys.STREAM, keys.VALID, keys.GOAL, keys.PROGRESS),
    *(keys.STATE, keys.ACTION, keys.NOISE),
    *(("next", *key) for key in (keys.STATE, keys.VALID, keys.PROGRESS, keys.COLLISION, keys.OFFROAD)),
]
"""Entries that are kept of every step of a search, enough to observe its states anew; beside them personas of agents
that have some, and in open traffic who has not entered yet.
"""


def _settings(
    env: DrivingEnv, rule: PruningRule | Backtrack, also: Sequence[keys.Key] = ()
) -> dict[str, Any]:
    """Settings that every search of driving gives the collector."""
    persona = [keys.PERSONA] if env.observation.persona else []
    waiting = [keys.WAITING] if env.open_traffic else []
    return {
        "aggregate": max_then_sum,
        # A copy takes the random numbers of the place it lands in, so that forks part.
        "slot_keys": (keys.STREAM,),
        "group_key": keys.GOAL if takes_groups(rule) else None,
        "keep": [*KEPT, *persona, *waiting, *also],
    }


def pruning_rule(config: SearchConfig) -> PruningRule:
    """Which branches go on."""
    if ":" in config.rule:
        return load_object(config.rule)()
    rules: dict[str, Callable[[], PruningRule]] = {
        "best": lambda: KeepBest(0.5),
        "systematic": lambda: Systematic(config.temperature),
        "replace": lambda: ReplaceBad(config.threshold),
    }
    return rules[config.rule]()


def flag_score(state: TensorDictBase) -> Float[Tensor, "*b N"]:
    """Score [..., N] of an oracle: 1 where an agent collides or is off the road."""
    bad = state.get(keys.COLLISION) | state.get(keys.OFFROAD)
    return (bad.squeeze(-1) & state.get(keys.VALID)).float()


def rule_score(env: DrivingEnv, state: TensorDictBase) -> Float[Tensor, "*b N"]:
    """Score [..., N] of a rule: 1 where an agent collides, is off the road, or would collide within
    :data:`AHEAD`, were everyone to keep speed and course.

    It looks at everybody, so that it says the same of agents that observe little.
    """
    there, row = state.get(keys.VALID), state.get(keys.SCENE).flatten()
    moves, real = (state.get(key).flatten(0, state.ndim - 1) for key in (keys.STATE, keys.VALID))
    now = env.objects(row, state.get(keys.STEP).flatten(), moves, real)
    place = now.state[..., :2] + AHEAD * now.state[..., 3:]
    ahead = now._replace(state=torch.cat([place, now.state[..., 2:]], -1))
    close = collision_flags(ahead, env.scenes.interactive.index_select(0, row)).reshape(there.shape)
    return torch.maximum(flag_score(state), (close & there).float())


def realism_score(
    env: DrivingEnv,
    discriminator: TensorDictModuleBase | None,
    *,
    score: Score = "discriminator",
    ego: bool = True,
) -> Callable[[TensorDictBase], Tensor]:
    """Scores [..., N] of states.

    Args:
        env: whose states are scored.
        discriminator: writes them, where they are its own.
        score: what a search looks for in a state.
        ego: whether the first agent is scored; else its score is 0, as that of background agents is.
    """
    of_states: Callable[[TensorDictBase], Tensor]
    if score == "discriminator":
        of_states = KeyScore(keys.SCORE, discriminator, valid_key=keys.VALID)
    else:
        of_states = flag_score if score == "flags" else partial(rule_score, env)

    def of_scored(state: TensorDictBase) -> Float[Tensor, "*b N"]:
        found = of_states(state).masked_fill(env.scenes.background[state.get(keys.SCENE).squeeze(-1)], 0.0)
        return found if ego else torch.cat([torch.zeros_like(found[..., :1]), found[..., 1:]], -1)

    return of_scored


def branched_streams(start: TensorDictBase) -> TensorDictBase:
    """A start state [*b, S] whose branches each have a stream of random numbers of their own."""
    slot = torch.arange(start.shape[-1], device=start.device)[:, None]
    return start.set(keys.STREAM, fold_in(start.get(keys.STREAM), slot))


def with_drawn_goals(
    env: DrivingEnv,
    goals: TensorDictModuleBase,
    start: TensorDictBase,
    seed: int,
    goals_per: Literal["tree", "branch"] = "tree",
) -> TensorDictBase:
    """Start states [*b, S] of a search, with :func:`branched_streams` and routes that the goal policy draws.

    Args:
        env: the environment.
        goals: the goal policy.
        start: all branches of a tree, in one stream of random numbers.
        seed: of the draw.
        goals_per: who draws goals together: all branches of a tree (paper, section IV-B), or each branch alone.
    """
    start = branched_streams(start)
    first = start if goals_per == "branch" else start[..., :1]
    goal = draw_goals(env, goals, first, seed, first.get(keys.STREAM).squeeze(-1))
    return env.with_goals(start, goal.expand(*start.shape, -1))


def pruning_noise(seed: int) -> Callable[[TensorDictBase, int], Tensor]:
    """Numbers [*b, P] for the rule from a start state [*b, S]: the tree's, which are those of its first branch, told
    apart from its actions'.
    """

    def noise(start: TensorDictBase, periods: int) -> Float[Tensor, "*b P"]:
        root = start.get(keys.STREAM)[..., 0, :]
        return uniform(seed, fold_in(root, Stream.PRUNING), torch.arange(periods, device=start.device))

    return noise


def collector_settings(
    config: SearchConfig, env: DrivingEnv, seed: int, data: SceneDataset, segments: int
) -> dict[str, Any]:
    """Settings that a collector of driving needs beside environment, policy and scores: whole trees, random numbers
    that depend on nothing but seed, segment, branch and step.

    Args:
        config: of the search.
        env: that is searched.
        seed: of the pruning.
        data: that the environment draws its scenes from.
        segments: how many at a time, or all, if there are fewer.
    """
    return {
        "branches": config.branches,
        "leaves": config.branches,
        "keep_tree": True,
        "prune_every": config.prune_every,
        "rule_noise": pruning_noise(seed),
        **_settings(env, pruning_rule(config)),
        "frames_per_batch": min(segments, len(data)) * config.branches * data.decisions,
        "total_frames": -1,
    }


def search(
    env: DrivingEnv,
    policy: TensorDictModuleBase,
    discriminator: TensorDictModuleBase | None,
    start: TensorDictBase,
    *,
    seed: int,
    rule: PruningRule | Backtrack,
    prune_every: int,
    score: Score = "discriminator",
    leaves: int | None = None,
    keep_tree: bool = False,
    ego: bool = True,
    also: Sequence[keys.Key] = (),
) -> BeamSearchResult:
    """Beam search from a start state [..., S] to the last logged step. Scenes beside each other change nothing.

    Args:
        env: the environment.
        policy: writes the action.
        discriminator: scores the states, where the score is its own.
        start: all branches of a tree.
        seed: of the actions.
        rule: which branches go on.
        prune_every: T_p.
        score: what it looks for.
        leaves: return only so many of each tree, the best of their scene's last period; by default all.
        keep_tree: also return the pruned branches.
        ego: whether the first agent is scored, too.
        also: what is kept of every step beside :data:`KEPT`.
    """
    steps = env.decisions
    try:
        return beam_search(
            env,
            TensorDictSequential(SeededNoise(seed, env.dynamics.numbers), policy),
            realism_score(env, discriminator, score=score, ego=ego),
            start,
            steps=steps,
            prune_every=prune_every,
            rule=rule,
            noise=pruning_noise(seed)(start, -(-steps // prune_every)),
            leaves=leaves,
            keep_tree=keep_tree,
            **_settings(env, rule, also),
        )
    except ValueError as error:  # of a rule or a score of the user
        raise ConfigError(str(error)) from error


def going_back(
    env: DrivingEnv, threshold: float, lines: int, begin: Callable[[TensorDictBase], TensorDictBase]
) -> Backtrack:
    """The rule by which lines go back in the driving environment, with random numbers of their own at every try.

    Args:
        env: the environment.
        threshold: of the totals.
        lines: how many there are; one in :data:`FILL` is simulated at a time, at least :data:`FEW`.
        begin: from first states [R, 1] to others with goals drawn anew: those kept may not be met by anybody.
    """

    def renew(state: TensorDictBase, attempt: Int[Tensor, " R"]) -> TensorDictBase:
        # Folded into the numbers of the try before, so that no two tries of a line share them.
        stream = fold_in(state.get(keys.STREAM), Stream.BACKTRACKING + attempt[:, None, None])
        found = env.at(state.copy().set(keys.STREAM, stream))
        first = (found.get(keys.STEP)[:, 0, 0] == 0).nonzero().squeeze(-1)
        if len(first):
            found[first] = begin(found[first])
        return found

    return Backtrack(threshold, renew=renew, width=max(FEW, lines // FILL))
