"""The beam search on the driving environment (paper, section III-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from symphony import keys
from symphony.collectors import Backtrack, BeamSearchResult, KeyScore, PruningRule, beam_search, max_then_sum
from symphony.collectors.backtracking import Renew
from symphony.collectors.rules import KeepBest, ReplaceBad, Systematic, takes_groups
from symphony.config import Score, SearchConfig
from symphony.envs.driving import DrivingEnv
from symphony.envs.flags import collision_flags
from symphony.errors import ConfigError
from symphony.imports import build_object
from symphony.learning.demonstrations import SceneDataset
from symphony.modules import SeededNoise
from symphony.rollouts.unroll import draw_goals
from symphony.streams import Stream, fold_in, uniform

FILL, FEW = 4, 256
"""Of lines that go back one in FILL is simulated at a time, at least FEW: the last steps are of few lines."""
AHEAD = 0.5
"""Seconds that :func:`rule_score` looks ahead."""
COMPILER = {"backend": "inductor"}
"""How steps are compiled where they are, as :func:`torch.compile` takes it."""
_KEPT = (
    *(keys.SCENE, keys.STEP, keys.STREAM, keys.VALID, keys.GOAL, keys.PROGRESS),
    *(keys.STATE, keys.ACTION, keys.NOISE),
    *(("next", *key) for key in (keys.STATE, keys.VALID, keys.PROGRESS, keys.COLLISION, keys.OFFROAD)),
)


def _settings(env: DrivingEnv, rule: PruningRule | Backtrack, also: Sequence[Any] = ()) -> dict[str, Any]:
    waiting = [keys.WAITING] if env.open_traffic else []
    return {
        "aggregate": max_then_sum,
        # A copy takes the random numbers of the place it lands in, so that forks part.
        "slot_keys": (keys.STREAM,),
        "group_key": keys.GOAL if takes_groups(rule) else None,
        # Of every step enough to observe its states again.
        "keep": [*_KEPT, *waiting, *also],
    }


def pruning_rule(config: SearchConfig) -> PruningRule:
    """Return the rule that decides which branches go on."""
    if config.rule == "best":
        return KeepBest(0.5)
    if config.rule == "systematic":
        return Systematic(config.temperature)
    return ReplaceBad(config.threshold) if config.rule == "replace" else build_object(config.rule)


def flag_score(state: TensorDictBase) -> Float[Tensor, "*b N"]:
    """Return the score [..., N] of an oracle: 1 where an agent collides or is off the road."""
    bad = state.get(keys.COLLISION) | state.get(keys.OFFROAD)
    return (bad.squeeze(-1) & state.get(keys.VALID)).float()


def no_score(state: TensorDictBase) -> Float[Tensor, "*b N"]:
    """Return the score [..., N], all 0, of a search by the value of states alone, or without a score."""
    return torch.zeros_like(state.get(keys.STATE)[..., 0])


def no_value(state: TensorDictBase) -> Float[Tensor, "*b"]:
    """Return the same value [...] for all states."""
    return no_score(state)[..., 0]


def rule_score(env: DrivingEnv, state: TensorDictBase) -> Float[Tensor, "*b N"]:
    """Return the score [..., N] of a rule: 1 where an agent collides, is off the road, or would collide
    :data:`AHEAD` later, also with agents that it does not observe, if all kept speed and course.
    """
    there, row = state.get(keys.VALID), state.get(keys.SCENE).flatten()
    moves, real = (state.get(key).flatten(0, state.ndim - 1) for key in (keys.STATE, keys.VALID))
    now = env.objects(row, state.get(keys.STEP).flatten(), moves, real)
    place = now.state[..., :2] + AHEAD * now.state[..., 3:]
    ahead = now._replace(state=torch.cat([place, now.state[..., 2:]], -1))
    close = collision_flags(ahead, env.scenes.interactive.index_select(0, row)).reshape(there.shape)
    return torch.maximum(flag_score(state), (close & there).float())


def realism_score(
    env: DrivingEnv, discriminator: TensorDictModuleBase | None, *, score: Score = "discriminator", planned: int = 0
) -> Callable[[TensorDictBase], Tensor]:
    """Return a function that scores states [..., N]; 0 for background agents and the first ``planned`` ones."""
    learned = KeyScore(keys.SCORE, discriminator, valid_key=keys.VALID) if score == "discriminator" else None

    def of_scored(state: TensorDictBase) -> Float[Tensor, "*b N"]:
        if learned is not None:
            found = learned(state)
        else:
            found = flag_score(state) if score == "flags" else rule_score(env, state)
        found = found.masked_fill(env.scenes.background[state.get(keys.SCENE).squeeze(-1)], 0.0)
        return torch.cat([torch.zeros_like(found[..., :planned]), found[..., planned:]], -1)

    return of_scored


def branched_streams(start: TensorDictBase) -> TensorDictBase:
    """Return a start state [*b, S] whose branches each have a stream of random numbers of their own."""
    slot = torch.arange(start.shape[-1], device=start.device)[:, None]
    return start.set(keys.STREAM, fold_in(start.get(keys.STREAM), slot))


def with_drawn_goals(
    env: DrivingEnv,
    goals: TensorDictModuleBase,
    start: TensorDictBase,
    seed: int,
    goals_per: Literal["tree", "branch"] = "tree",
) -> TensorDictBase:
    """Return start states [*b, S] of a search, with :func:`branched_streams` and routes that the goal policy draws:
    once for all branches of a tree (paper, section III-B), or for each branch alone.
    """
    start = branched_streams(start)
    first = start if goals_per == "branch" else start[..., :1]
    goal = draw_goals(env, goals, first, seed, first.get(keys.STREAM).squeeze(-1))
    return env.with_goals(start, goal.expand(*start.shape, -1))


def pruning_noise(seed: int) -> Callable[[TensorDictBase, int], Tensor]:
    """Return numbers [*b, P] for the rule from a start [*b, S]: the first branch's, told apart from its actions'."""

    def noise(start: TensorDictBase, periods: int) -> Float[Tensor, "*b P"]:
        root = start.get(keys.STREAM)[..., 0, :]
        return uniform(seed, fold_in(root, Stream.PRUNING), torch.arange(periods, device=start.device))

    return noise


def collector_settings(
    config: SearchConfig, env: DrivingEnv, seed: int, data: SceneDataset, segments: int, rule: PruningRule
) -> dict[str, Any]:
    """Return settings that a collector of driving needs beside environment, policy and scores: trees of ``segments``
    run segments at a time, which a ``rule`` prunes, and random numbers of seed, segment, branch and step alone.
    """
    return {
        "branches": config.branches,
        "leaves": config.branches,
        "keep_tree": True,
        "prune_every": config.prune_every,
        "rule_noise": pruning_noise(seed),
        "rule": rule,
        **_settings(env, rule),
        "frames_per_batch": segments * config.branches * data.decisions,
        "total_frames": -1,
        **compiled(data),
    }


def compiled(data: SceneDataset) -> dict[str, Any]:
    """Return the setting that compiles the steps of what learns from data, where its batches have few shapes."""
    return {"compile_step": COMPILER if data.few_shapes else False}


def search(
    env: DrivingEnv,
    policy: TensorDictModuleBase,
    discriminator: TensorDictModuleBase | None,
    start: TensorDictBase,
    *,
    seed: int,
    rule: PruningRule | Backtrack,
    prune_every: int,
    pace: float = 0.0,
    score: Score = "discriminator",
    planned: int = 0,
    also: Sequence[keys.Key] = (),
    value: Callable[[TensorDictBase], Tensor] | None = None,
    **returned: Any,
) -> BeamSearchResult:
    """Run a beam search from a start state [..., S], all branches of a tree, to the last step of the longest scene.
    Other scenes of the batch change nothing.

    It prunes every T_p steps by :func:`realism_score`, or by a ``value`` of states alone. It keeps of every step what
    it takes to observe its states again, and what is named in ``also``; ``returned`` are settings of
    :func:`symphony.collectors.beam_search`.
    """
    steps = env.decisions
    try:
        return beam_search(
            env,
            TensorDictSequential(SeededNoise(seed, env.dynamics.numbers, pace), policy),
            realism_score(env, discriminator, score=score, planned=planned) if value is None else no_score,
            start,
            value=None if value is no_value else value,
            prune_last=value is None,
            steps=steps,
            prune_every=prune_every,
            rule=rule,
            noise=pruning_noise(seed)(start, -(-steps // prune_every)),
            **_settings(env, rule, also),
            **returned,
        )
    except ValueError as error:  # of a rule or a score of the user
        raise ConfigError(str(error)) from error


def going_back(env: DrivingEnv, threshold: float, start: TensorDictBase, begin: Renew) -> Backtrack:
    """Return the rule by which lines from ``start`` [*b, S] go back in the driving environment, with random numbers
    of their own at every try, and at the first states [R, 1] with goals that ``begin`` draws again, given how often
    each line [R] went back: the kept ones may be out of reach.
    """

    def renew(state: TensorDictBase, attempt: Int[Tensor, " R"]) -> TensorDictBase:
        # Folded into the numbers of the try before, so that no two tries of a line share them.
        stream = fold_in(state.get(keys.STREAM), Stream.BACKTRACKING + attempt[:, None, None])
        found = env.at(state.copy().set(keys.STREAM, stream))
        first = (found.get(keys.STEP)[:, 0, 0] == 0).nonzero().squeeze(-1)
        if len(first):
            found[first] = begin(found[first], attempt[first])
        return found

    lengths = env.scenes.last_step[start.get(keys.SCENE).flatten()]
    return Backtrack(threshold, renew=renew, lengths=lengths, width=max(FEW, start.numel() // FILL))
