"""The beam search on the driving environment (paper, section IV-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from symphony import keys
from symphony.collectors import (
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
from symphony.config import SearchConfig
from symphony.envs.driving import DrivingEnv
from symphony.imports import build_object
from symphony.modules import SeededNoise
from symphony.simulation.demonstrations import SceneDataset
from symphony.streams import Stream, fold_in, uniform

ENDED = -100.0
"""Score past a scene's last logged step, below all others: it decides no maximum, and other totals leave it out."""
OUTCOME: Sequence[keys.Key] = [
    ("next", *key) for key in (keys.STATE, keys.VALID, keys.PROGRESS, keys.COLLISION, keys.OFFROAD)
]
KEPT: Sequence[keys.Key] = [
    keys.SCENE,
    keys.STEP,
    keys.STREAM,
    keys.VALID,
    keys.GOAL,
    keys.PROGRESS,
    keys.STATE,
    keys.ACTION,
    keys.NOISE,
    *OUTCOME,
]
"""What is kept of every step of a search: enough to observe its states anew."""


def kept_keys(env: DrivingEnv, also: Sequence[keys.Key] = ()) -> list[keys.Key]:
    """:data:`KEPT`, with the personas of agents that have them."""
    return [*KEPT, *([keys.PERSONA] if env.observation.persona else []), *also]


def pruning_rule(config: SearchConfig) -> PruningRule:
    """Which branches go on."""
    if ":" in config.rule:
        return build_object(config.rule)
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


def realism_score(
    env: DrivingEnv, discriminator: TensorDictModuleBase | None, *, ego: bool = True
) -> Callable[[TensorDictBase], Tensor]:
    """Scores [..., N] of states up to their scene's last logged step, :data:`ENDED` beyond.

    Args:
        env: whose states are scored.
        discriminator: writes them; None takes the true collision and off-road flags (an oracle).
        ego: whether the first agent is scored; else its score is 0, as that of background agents is.
    """
    score: Callable[[TensorDictBase], Tensor] = flag_score
    if discriminator is not None:
        score = KeyScore(keys.SCORE, discriminator, valid_key=keys.VALID)

    def until_the_end(state: TensorDictBase) -> Float[Tensor, "*b N"]:
        going = state.get(keys.STEP) <= env.scenes.last_step[state.get(keys.SCENE)]
        found = torch.where(going, score(state), ENDED)
        found = found.masked_fill(env.scenes.background[state.get(keys.SCENE).squeeze(-1)], 0.0)
        return found if ego else torch.cat([torch.zeros_like(found[..., :1]), found[..., 1:]], -1)

    return until_the_end


def branched_streams(start: TensorDictBase) -> TensorDictBase:
    """A start state [*b, S] whose branches each have a stream of random numbers of their own."""
    slot = torch.arange(start.shape[-1], device=start.device)[:, None]
    return start.set(keys.STREAM, fold_in(start.get(keys.STREAM), slot))


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
    """What a collector of driving needs beside environment, policy and scores: whole trees, random numbers that
    depend on nothing but seed, segment, branch and step.

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
        "aggregate": max_then_sum,
        "rule_noise": pruning_noise(seed),
        # A copy takes the random numbers of the place it lands in, so that forks part.
        "slot_keys": (keys.STREAM,),
        "group_key": keys.GOAL if takes_groups(pruning_rule(config)) else None,
        "keep": kept_keys(env),
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
    rule: PruningRule,
    prune_every: int,
    leaves: int | None = None,
    keep_tree: bool = False,
    ego: bool = True,
    also: Sequence[keys.Key] = (),
) -> BeamSearchResult:
    """Beam search from a start state [..., S] to the last logged step. Scenes beside each other change nothing.

    Args:
        env: the environment.
        policy: writes the action.
        discriminator: scores the states; None takes the true collision and off-road flags (an oracle).
        start: all branches of a tree.
        seed: of the actions.
        rule: which branches go on.
        prune_every: T_p.
        leaves: return only so many of each tree, the best of their scene's last period; by default all.
        keep_tree: also return the pruned branches.
        ego: whether the first agent is scored, too.
        also: what is kept of every step beside :data:`KEPT`.
    """
    steps, scene = env.decisions, start.get(keys.SCENE)[..., 0, 0]
    return beam_search(
        env,
        TensorDictSequential(SeededNoise(seed, env.dynamics.numbers), policy),
        realism_score(env, discriminator, ego=ego),
        start,
        steps=steps,
        prune_every=prune_every,
        rule=rule,
        aggregate=max_then_sum,
        noise=pruning_noise(seed)(start, -(-steps // prune_every)),
        leaves=leaves,
        # In the last period of all, branches of a shorter scene are equal.
        last_period=(-(-env.scenes.last_step[scene] // prune_every) - 1).clamp_min(0),
        # A copy takes the random numbers of the place it lands in, so that forks part.
        slot_keys=(keys.STREAM,),
        group_key=keys.GOAL if takes_groups(rule) else None,
        keep=kept_keys(env, also),
        keep_tree=keep_tree,
    )
