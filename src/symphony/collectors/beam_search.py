"""Beam search over simulated futures of environments that keep their state in the TensorDict (paper, section IV-A).

S branches of each row are simulated side by side. After every T_p steps each gets a total, aggregated from the
scores of its steps and agents; the branches with *high* totals are dropped and the others copied into the free
slots. Nothing here knows what is simulated: rows, branches and agents are batch dimensions of any TorchRL
environment that can be branched, see :func:`symphony.collectors.branching.check_branching`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from symphony.collectors._rows import take, take_values
from symphony.collectors.backtracking import Backtrack, Lines, follow
from symphony.collectors.branching import check_branching
from symphony.collectors.result import BeamSearchResult, lineage, ranking
from symphony.collectors.rules import (
    GroupRule,
    KeepBest,
    PruningRule,
    group_members,
    prune,
    takes_groups,
)
from symphony.collectors.scores import max_then_sum
from symphony.errors import ConfigError

Policy = Callable[[TensorDictBase], TensorDictBase]
Score = Callable[[TensorDictBase], Tensor]
Aggregation = Callable[[Tensor], Tensor]


def beam_search(
    env: EnvBase,
    policy: Policy,
    score: Score,
    start: TensorDictBase,
    *,
    steps: int,
    prune_every: int = 10,
    rule: PruningRule | GroupRule | Backtrack = KeepBest(0.5),  # noqa: B008  (frozen)
    aggregate: Aggregation = max_then_sum,
    prune_last: bool = True,
    noise: Float[Tensor, "*b P"] | None = None,
    slot_keys: Sequence[NestedKey] = (),
    group_key: NestedKey | None = None,
    keep: Sequence[NestedKey] | None = None,
    keep_tree: bool = False,
    leaves: int | None = None,
    last_period: Int[Tensor, "*b"] | None = None,
    exploration_type: ExplorationType | None = ExplorationType.RANDOM,
) -> BeamSearchResult:
    """Search an environment whose whole state is in the TensorDict (no GymEnv, VmasEnv, SerialEnv or ParallelEnv).

    S branches are simulated per row, and those with high scores make room for copies of the others.

    Gradients flow through environment, policy and scores unless the caller turns them off, along the history of
    each leaf; no tensor is changed in place. The end of an episode changes nothing: every branch runs for
    `steps` steps, and a score that should not count what follows the end must be 0 there.

    Args:
        env: accepts any batch shape (``batch_size=[]``, ``batch_locked=False``); random numbers of its own are
            allowed, memory is not.
        policy: writes the action into the TensorDict it is given.
        score: of the state after a step, [*b, S, N] or [*b, S]; high is bad, padded agents 0. It gets the next
            state with reward and action, and must not write into it.
        start: [*b, S], e.g. ``branch(env.reset(...), S)``.
        steps: T, decisions per branch.
        prune_every: T_p, steps per period.
        rule: which branches go on, see :mod:`symphony.collectors.rules`; or :class:`Backtrack`, with which nothing is
            copied: branches are independent lines that go back where they are bad. That takes no gradients and gives
            all leaves, and what is said below of slots, groups and noise has no meaning for it.
        aggregate: any function of the scores of a period [*b, S, T_p, N] that gives totals [*b, S], e.g.
            ``lambda scores: scores.amax((-1, -2))``; see :class:`symphony.collectors.Aggregate`.
        prune_last: prune after the last period too.
        noise: numbers in [0, 1) for rules that draw, one per row and period.
        slot_keys: entries that stay in their slot when a branch is copied, such as the identity of a stream of
            random numbers: otherwise copies of one branch that draw from it would all do the same.
        group_key: integers [*b, S] in `start`, or [*b, S, N] that must all agree; branches compete only with those
            of the same group. A :class:`GroupRule` may mix groups; a copy is then of its parent's group.
        keep: entries kept of each step, e.g. ``[("next", "agents", "state")]``; default all.
        keep_tree: also return the branches that were pruned.
        leaves: return only so many, the best of the last period first; default all, in the order of their slots.
        last_period: [*b] number of the period that is the last for `leaves`, where rows end sooner than others.
        exploration_type: under which the policy runs.

    Raises:
        ConfigError: for an environment that can't be branched, arguments that contradict each other or shapes that
            do not fit.
    """
    _check(start, steps, prune_every, leaves)
    if last_period is not None and last_period.shape != start.shape[:-1]:
        raise ConfigError(f"last_period is {list(last_period.shape)}, rows are {list(start.shape[:-1])}")
    check_branching(env, start)
    if isinstance(rule, Backtrack):
        if leaves not in (None, start.shape[-1]):
            raise ConfigError("rule Backtrack gives all branches as leaves")
        with set_exploration_type(exploration_type):
            lines = follow(
                lambda now, length: _simulate(env, policy, score, now, length, aggregate, keep),
                aggregate,
                start,
                rule,
                steps,
                prune_every,
            )
        return _independent(lines, prune_every, keep_tree)
    groups = None if group_key is None else _groups(start, group_key)
    members = None if groups is None or takes_groups(rule) else group_members(groups)
    periods = [min(prune_every, steps - first) for first in range(0, steps, prune_every)]
    noises = _noises(noise, start, len(periods))

    now = start
    records: list[TensorDictBase] = []
    scores, totals, parents = [], [], []
    simulated = 0
    with set_exploration_type(exploration_type):
        for period, length in enumerate(periods):
            run = _simulate(env, policy, score, now, length, aggregate, keep)
            simulated += length * start.numel()
            records += run.records
            scores.append(run.scores)
            totals.append(run.totals)
            last = period == len(periods) - 1
            if last and not prune_last:
                parents.append(torch.arange(start.shape[-1], device=run.totals.device).expand(start.shape))
                break
            parents.append(prune(rule, run.totals.detach(), noises[period], members, groups))
            groups = None if groups is None else groups.gather(-1, parents[-1])
            if not last:
                now = _fork(run.after, parents[-1], slot_keys)

    tree = TensorDict.stack(records, -1)
    del records
    simulated_scores, all_totals, all_parents = (
        torch.cat(scores, -2),
        torch.stack(totals, -2),
        torch.stack(parents, -2),
    )
    slots = lineage(all_parents)
    if leaves is not None:
        ended = (
            torch.full(start.shape[:-1], len(periods) - 1, device=slots.device)
            if last_period is None
            else last_period
        )
        last_totals, last_slots = (_period(part, ended) for part in (all_totals.detach(), slots))
        best = ranking(last_totals, last_slots)[..., :leaves]
        slots = slots.gather(-1, best[..., None, :].expand(*slots.shape[:-1], leaves))
    steps_at = _step_rows(slots, start.shape[-1], periods)
    trajectories = take(tree, steps_at)
    trajectories.refine_names(..., "time")
    tree.refine_names(..., "time")
    return BeamSearchResult(
        trajectories=trajectories,
        scores=take_values(simulated_scores, steps_at, tree.batch_dims),
        slots=slots,
        totals=all_totals,
        parents=all_parents,
        simulated_scores=simulated_scores,
        tree=tree if keep_tree else None,
        prune_every=prune_every,
        simulated_steps=simulated,
    )


def _independent(lines: Lines, prune_every: int, keep_tree: bool) -> BeamSearchResult:
    """Lines as the leaves of a search in which every branch goes on from itself."""
    slots = torch.arange(lines.totals.shape[-1], device=lines.totals.device).expand(lines.totals.shape)
    lines.steps.refine_names(..., "time")
    return BeamSearchResult(
        trajectories=lines.steps,
        scores=lines.scores,
        slots=slots,
        totals=lines.totals,
        parents=slots,
        simulated_scores=lines.scores,
        tree=lines.steps.copy() if keep_tree else None,
        prune_every=prune_every,
        simulated_steps=lines.simulated,
    )


def _period(values: Shaped[Tensor, "*b P S"], number: Int[Tensor, "*b"]) -> Shaped[Tensor, "*b S"]:
    """Of each row the values of a period of its own."""
    place = number[..., None, None].expand(*number.shape, 1, values.shape[-1])
    return values.gather(-2, place).squeeze(-2)


def score_state(
    env: EnvBase, score: Score, stepped: TensorDictBase, now: TensorDictBase
) -> Float[Tensor, "*b S N"]:
    """Scores [*b, S, N] of the state `now` that the step `stepped` led to.

    The reward is shown to the score, but is no part of the next step's input.
    """
    seen = now.copy()
    for key in env.reward_keys:
        seen.set(key, stepped.get(("next", key) if isinstance(key, str) else ("next", *key)))
    values = score(seen)
    values = values.unsqueeze(-1) if values.shape == now.shape else values
    if values.ndim != now.ndim + 1 or values.shape[:-1] != now.shape:
        expected = ", ".join(map(str, now.shape))
        raise ConfigError(f"scores must be [{expected}] or [{expected}, agents], are {list(values.shape)}")
    return values if values.is_floating_point() else values.float()


class _Run(NamedTuple):
    """A period of length T_p as simulated, by slot."""

    records: list[TensorDictBase]
    scores: Float[Tensor, "*b S T N"]
    totals: Float[Tensor, "*b S"]
    after: TensorDictBase


def _simulate(
    env: EnvBase,
    policy: Policy,
    score: Score,
    now: TensorDictBase,
    length: int,
    aggregate: Aggregation,
    keep: Sequence[NestedKey] | None,
) -> _Run:
    # Policy and environment write into the TensorDict they are given.
    now, records, scores = now.copy(), [], []
    for _ in range(length):
        stepped = env.step(policy(now))
        now = env.step_mdp(stepped)
        records.append(stepped if keep is None else stepped.select(*keep))
        scores.append(score_state(env, score, stepped, now))
        del stepped  # or one more set of observations lives through the next step
    joined = torch.stack(scores, -2)
    totals = aggregate(joined)
    if totals.shape != now.shape:
        raise ConfigError(f"the aggregate must be {tuple(now.shape)}, is {tuple(totals.shape)}")
    return _Run(records, joined, totals, now)


def _fork(
    state: TensorDictBase, parents: Int[Tensor, "*b S"], slot_keys: Sequence[NestedKey]
) -> TensorDictBase:
    branches = parents.shape[-1]
    # Places in the flattened [*b, S]: of the first branch of each row, and of the parents beside it.
    first = torch.arange(0, parents.numel(), branches, device=parents.device)
    rows = first.reshape(*parents.shape[:-1], 1) + parents
    return _set_slots(take(state, rows), state, slot_keys)


def _set_slots(state: TensorDictBase, slots: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    for key in keys:
        state.set(key, slots.get(key))
    return state


def _step_rows(slots: Int[Tensor, "*b P L"], branches: int, periods: list[int]) -> Int[Tensor, "*b L T"]:
    """For each leaf and step its place in the flattened tree [*b, S, T]."""
    device, steps = slots.device, sum(periods)
    # All periods are as long as the first, but for the last, which may be shorter.
    period = torch.arange(steps, device=device) // periods[0]
    slot = slots.transpose(-1, -2).index_select(-1, period)
    row = torch.arange(slot[..., 0, 0].numel(), device=device).reshape(*slot.shape[:-2], 1, 1)
    return (row * branches + slot) * steps + torch.arange(steps, device=device)


def _groups(start: TensorDictBase, key: NestedKey) -> Int[Tensor, "*b S"]:
    """The group of each branch: its number, or the first branch that agrees with it in all of its numbers."""
    value = start.get(key)
    if value is None:
        raise ConfigError(f"the start state has no entry {key!r}")
    if value.is_floating_point() or value.shape[: start.ndim] != start.shape or value.ndim > start.ndim + 1:
        raise ConfigError(f"{key!r} must hold integers, one or some per branch, is {list(value.shape)}")
    if value.ndim == start.ndim:
        return value
    return (value[..., :, None, :] == value[..., None, :, :]).all(-1).int().argmax(-1)


def _noises(
    noise: Float[Tensor, "*b P"] | None, start: TensorDictBase, periods: int
) -> Sequence[Float[Tensor, "*b"] | None]:
    if noise is None:
        return [None] * periods
    if noise.shape != (*start.shape[:-1], periods):
        raise ConfigError(f"noise must be {[*start.shape[:-1], periods]}, is {list(noise.shape)}")
    return noise.unbind(-1)


def _check(
    start: TensorDictBase,
    steps: int,
    prune_every: int,
    leaves: int | None,
) -> None:
    if not start.batch_dims or not start.numel():
        raise ConfigError(f"the start state must have rows and branches, its batch is {list(start.shape)}")
    if steps < 1 or prune_every < 1:
        raise ConfigError(f"steps and prune_every must be positive, are {steps} and {prune_every}")
    if leaves is not None and not 1 <= leaves <= start.shape[-1]:
        raise ConfigError(f"leaves must be 1 ... {start.shape[-1]} branches, is {leaves}")
