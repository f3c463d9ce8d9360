"""Beam search over simulated futures of environments that keep their state in the TensorDict (paper, section III-A).

S branches of each row are simulated side by side. After every T_p steps each gets a total, aggregated from the
scores of its steps and agents; the branches with *high* totals are dropped and the others copied into the free slots.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from symphony.collectors.backtracking import Backtrack, Run, follow
from symphony.collectors.branching import (
    below,
    branched_env,
    branched_specs,
    check_branching,
    last_name,
    recall,
    take,
    take_values,
)
from symphony.collectors.rules import Aggregate, KeepBest, Pruning, PruningRule, max_then_sum, sample_size
from symphony.programs import compiled, ordered

Policy = Callable[[TensorDictBase], TensorDictBase]
Score = Callable[[TensorDictBase], Tensor]
Aggregation = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class BeamSearchResult:
    """The result of a search: *b rows, S branches, L leaves, T steps in P periods, N agents.

    A *leaf* is what a slot holds at the end; its history was simulated in other slots before each fork. All S
    leaves come in the order of their slots: with :class:`KeepBest`, slot 0 holds the best of the last period.

    Attributes:
        trajectories: [*b, L, T] steps of the leaves, laid out and named as by ``env.rollout``, kept entries only.
        scores: [*b, L, T, N] scores of what each step of the leaves led to, 0 after the end of an episode: of each
            agent's, if N are all agents that end apart (of several groups in the order of ``env.done_keys``).
        alive: [*b, L, T] steps before (and with) the end of their episodes.
        slots: [*b, P, L] int64, the slot in which each period of each leaf's history was simulated.
        totals: [*b, P, S] aggregate of each period, by the slot that simulated it.
        parents: [*b, P, S] int64; after period p slot s was continued from slot `parents[..., p, s]`.
        simulated_scores: [*b, S, T, N] scores by the slot that simulated the step, the pruned ones included.
        tree: [*b, S, T] all simulated steps by slot, if asked for.
        prune_every: T_p; the last period may be shorter.
        simulated_steps: branch-steps that were simulated.
        leaf_costs: [*b, L] what the rule compared in the last period in which an episode of the row went on; with
            ``accumulate`` the totals of their whole histories, plus their values.
        log_weights: [*b, P, S] before each pruning, minus the totals since the row was last resampled, by the
            temperature; None unless the rule is a :class:`Systematic`, like the following.
        leaf_log_weights: [*b, L] after the last pruning, relative to the mean weight; 0 if resampled without a value.
        log_evidence: [*b] estimate of the logarithm of the mean weight of unpruned branches, whose exponential has no
            bias: of the evidence, where totals are negative log-likelihoods and the temperature is 1.
    """

    trajectories: TensorDictBase
    scores: Float[Tensor, "*b L T N"]
    alive: Bool[Tensor, "*b L T"]
    slots: Int[Tensor, "*b P L"]
    totals: Float[Tensor, "*b P S"]
    parents: Int[Tensor, "*b P S"]
    simulated_scores: Float[Tensor, "*b S T N"]
    tree: TensorDictBase | None
    prune_every: int
    simulated_steps: int
    leaf_costs: Float[Tensor, "*b L"] | None = None
    log_weights: Float[Tensor, "*b P S"] | None = None
    leaf_log_weights: Float[Tensor, "*b L"] | None = None
    log_evidence: Float[Tensor, "*b"] | None = None

    @property
    def leaf_totals(self) -> Float[Tensor, "*b P L"]:
        """Totals of the periods of each leaf's history."""
        return self.totals.gather(-1, self.slots)

    @property
    def sample_size(self) -> Float[Tensor, "*b P"] | None:
        """Effective sample size before each pruning, between 1 and S."""
        return None if self.log_weights is None else sample_size(self.log_weights)


def beam_search(
    env: EnvBase,
    policy: Policy,
    score: Score,
    start: TensorDictBase,
    *,
    steps: int,
    prune_every: int = 10,
    rule: PruningRule | Backtrack = KeepBest(0.5),  # noqa: B008  (frozen)
    aggregate: Aggregation = max_then_sum,
    value: Score | None = None,
    accumulate: bool = False,
    prune_last: bool = True,
    until_done: bool = True,
    noise: Float[Tensor, "*b P"] | None = None,
    slot_keys: Sequence[NestedKey] = (),
    group_key: NestedKey | None = None,
    keep: Sequence[NestedKey] | None = None,
    keep_tree: bool = False,
    leaves: int | None = None,
    compile_step: bool | Mapping[str, Any] = False,
    exploration_type: ExplorationType | None = ExplorationType.RANDOM,
) -> BeamSearchResult:
    """Run a beam search: of the S branches of each row, those with high scores are replaced by copies of the others.
    The environment must keep its whole state in the TensorDict.

    Gradients flow through environment, policy and scores unless the caller turns them off, along the history of each
    leaf; no tensor is changed in place. An episode ends once, with the first ``done`` (terminated or truncated): its
    branch is still simulated, since all have one length, but later steps have a score of 0, count in no maximum or
    mean, and rows whose branches have all ended are no longer pruned.

    Args:
        env: can be branched, see :func:`check_branching`. Its transforms are applied to the branches.
        policy: writes the action into the TensorDict it is given.
        score: score of the state after a step, [*b, S, N] or [*b, S]; high is bad, padded agents 0. It gets the next
            state with reward and action, and must not write into it.
        start: [*b, S], e.g. ``branch(env.reset(...), S)``.
        steps: T, decisions per branch.
        prune_every: T_p, steps per period.
        rule: which branches go on; or :class:`Backtrack`, with which nothing is
            copied: branches are independent lines that go back where they are bad. That takes no gradients and gives
            all leaves, and what is said below of slots, groups, values and noise has no meaning for it.
        aggregate: function from the scores of a period [*b, S, T_p, N] to totals [*b, S]: an :class:`Aggregate`,
            which leaves out steps after an end, or another, e.g. ``lambda scores: scores.amax((-1, -2))``.
        value: value of the state after a period, [*b, S] in the units of the totals and high where much is still to
            come that is bad; added to what the rule sees, but where the episode has terminated. Where it was
            truncated, it is that of the state in which it was.
        accumulate: the rule sees the sum of the totals of a branch's whole history, not those of the period alone.
        prune_last: prune after the last period too.
        until_done: False if ends of episodes are to change nothing at all.
        noise: numbers in [0, 1) for rules that draw, see :data:`PruningRule`.
        slot_keys: entries that stay in their slot when a branch is copied, such as the identity of a stream of
            random numbers: otherwise copies of one branch that draw from it would all do the same.
        group_key: integers [*b, S] in `start`, or [*b, S, N] that must all agree, for a rule that takes groups. A
            copy is of its parent's group.
        keep: entries kept of each step, e.g. ``[("next", "agents", "state")]``; default all.
        keep_tree: also return the branches that were pruned.
        leaves: how many to return, the best by their `leaf_costs` first; default all, in the order of their slots.
        compile_step: compile policy, environment and score as one program, or how, as in :func:`torch.compile`.
        exploration_type: the exploration type under which the policy runs.

    Raises:
        ValueError: for an environment that can't be branched, arguments that contradict each other, wrong shapes, or
            what can't be compiled.
    """
    if not start.batch_dims or not start.numel() or steps < 1 or prune_every < 1:
        what = f"a start state of {list(start.shape)}, {steps} steps, pruned every {prune_every}"
        raise ValueError(f"rows, branches, steps and prune_every must be positive: {what}")
    branches = start.shape[-1]
    if leaves is not None and not 1 <= leaves <= branches:
        raise ValueError(f"leaves must be 1 ... {branches} branches, is {leaves}")
    check_branching(env, start)
    whole = branched_env(env, start.shape)
    one_step = compiled(_step, whole, compile_step) if compile_step else _step
    # What a policy only writes is made again at each step; all else, such as its memory, is carried on.
    written = [key for key in getattr(policy, "out_keys", ()) if key not in getattr(policy, "in_keys", ())]
    how = start.shape, policy, score, aggregate, keep, until_done, one_step, start, written, value
    # One program for lines that go back, also when the last of them are few.
    width = min(rule.width or start.numel(), start.numel()) if isinstance(rule, Backtrack) else 0
    simulator = Simulator(env, whole, *how, width if compile_step else 0)
    ended = _ended(env, start, start.ndim) & until_done
    with set_exploration_type(exploration_type), branched_specs(policy, start.shape[:-1], start.shape):
        if isinstance(rule, Backtrack):
            if leaves not in (None, branches):
                raise ValueError("rule Backtrack gives all branches as leaves")
            lines = follow(simulator.run, simulator.total, start, ended, rule, steps, min(prune_every, steps))
            return _independent(lines, prune_every, keep_tree)
        periods = [min(prune_every, steps - first) for first in range(0, steps, prune_every)]
        pruning = Pruning(start, rule, len(periods), group_key=group_key, noise=noise, accumulate=accumulate)
        now, records, scores, alive = start, [], [], []
        worth: Any = None if value is None else 0.0
        terminated = _ended(env, start, start.ndim, "terminated") & ended
        for period, length in enumerate(periods):
            run = simulator.run(now, ended, length, terminated)
            records += run.records
            scores.append(run.scores)
            alive.append(run.alive)
            worth = None if run.worth is None else torch.where(ended.all(-1), worth, run.worth).detach()
            last = period == len(periods) - 1
            active = run.alive[..., 0, :].any(-1).any(-1)
            kept = None if prune_last else last | run.ended.flatten(-2).all(-1)  # rows whose last period this was
            parents = pruning.prune(simulator.total(run), active, worth, kept)
            if not last:
                place = places(parents, start)
                now, ended = take(run.after, place), take_values(run.ended, place, start.ndim)
                now = now.update(run.after.select(*slot_keys))
                if worth is not None and run.terminated is not None:
                    worth, terminated = (take_values(one, place, start.ndim) for one in (worth, run.terminated))
            del run  # or its last states live through the next period

    tree = TensorDict.stack(records, -1)
    del records
    tree.refine_names(..., "time")
    simulated_scores, counted = torch.cat(scores, -2), torch.cat(alive, -2).any(-1)
    slots, costs, log_weights, evidence = _leaves(pruning, worth, leaves)
    # The place of each leaf's steps in the flattened tree [*b, S, T].
    step = torch.arange(steps, device=slots.device)
    place = places(slots, start).transpose(-1, -2)[..., step // prune_every] * steps + step
    trajectories = take(tree, place)
    trajectories.refine_names(..., "time")
    return BeamSearchResult(
        trajectories=trajectories,
        scores=take_values(simulated_scores, place, tree.batch_dims),
        alive=take_values(counted, place, tree.batch_dims),
        slots=slots,
        totals=torch.stack(pruning.totals, -2),
        parents=torch.stack(pruning.parents, -2),
        simulated_scores=simulated_scores,
        tree=tree if keep_tree else None,
        prune_every=prune_every,
        simulated_steps=start.numel() * steps,
        leaf_costs=costs,
        log_weights=torch.stack(pruning.log_weights, -2) if pruning.log_weights else None,
        leaf_log_weights=log_weights,
        log_evidence=evidence,
    )


def _leaves(
    pruning: Pruning, worth: Float[Tensor, "*b S"] | None, count: int | None
) -> tuple[Int[Tensor, "*b P L"], Float[Tensor, "*b L"], Float[Tensor, "*b L"] | None, Float[Tensor, "*b"] | None]:
    """Return `slots`, `leaf_costs`, `leaf_log_weights` and `log_evidence` of the `count` best leaves, or of all."""
    totals, seen, parents = (torch.stack(part, -2) for part in (pruning.totals, pruning.seen, pruning.parents))
    slots, (log_weights, evidence) = lineage(parents), pruning.last_weights()
    # In later periods all branches of a row that has ended are equal.
    last_period = (torch.stack(pruning.active, -1).sum(-1) - 1).clamp_min(0)[..., None, None]
    costs, named = (part.take_along_dim(last_period, -2).squeeze(-2) for part in (seen, slots))
    costs = costs.gather(-1, named)
    if pruning.accumulate:  # of which a rule that weighs sees a part
        costs = totals.gather(-1, slots).sum(-2) + (0.0 if worth is None else worth.gather(-1, slots[..., -1, :]))
    if count is not None:
        best = ranking(costs, named)[..., :count]
        slots, costs = slots.take_along_dim(best[..., None, :], -1), costs.gather(-1, best)
        log_weights = None if log_weights is None else log_weights.gather(-1, best)
    return slots, costs, log_weights, evidence


def _independent(
    lines: tuple[TensorDictBase, Tensor, Tensor, Tensor, int], prune_every: int, keep_tree: bool
) -> BeamSearchResult:
    """Return lines as the leaves of a search in which every branch continues itself."""
    steps, scores, alive, totals, simulated = lines
    slots = torch.arange(totals.shape[-1], device=totals.device).expand(totals.shape)
    steps.refine_names(..., "time")
    tree = steps.copy() if keep_tree else None
    return BeamSearchResult(steps, scores, alive, slots, totals, slots, scores, tree, prune_every, simulated)


@dataclass(frozen=True)
class Simulator:
    """The simulation and scoring of branches; `whole` is the environment for all, [*b, S] of a `shape`."""

    env: EnvBase
    whole: EnvBase
    shape: torch.Size
    policy: Policy
    score: Score
    aggregate: Aggregation
    keep: Sequence[NestedKey] | None
    until_done: bool
    step: Callable[..., tuple[TensorDictBase, TensorDictBase, Tensor, Tensor]]
    start: TensorDictBase
    written: Sequence[NestedKey]
    value: Score | None = None
    width: int = 0  # lines that are simulated at a time, the last again where there are fewer

    def run(
        self, now: TensorDictBase, ended: Bool[Tensor, "*b S K"], length: int, terminated: Tensor | None = None
    ) -> Run:
        """Simulate a period of some steps, of branches of which some agents may have ended, or terminated, before."""
        if len(now) < self.width:
            lines = torch.arange(self.width, device=ended.device).clamp_max(len(now) - 1)[:, None]
            found = self.run(take(now, lines), take_values(ended, lines, 2), length)
            records, after = ([one[: len(now)] for one in part] for part in (found.records, [found.after]))
            return Run(records, *(part[: len(now)] for part in found[1:4]), *after)
        env = self.whole if now.shape == self.shape else branched_env(self.env, now.shape)
        recall(env, now)
        # Policy and environment write into the TensorDict they are given.
        now, records, scores, ends, states = now.copy(), [], [], [ended], []
        for _ in range(length):
            now = now if self.step is _step else ordered(now.exclude(*self.written), self.start)
            kept, now, worth, end = self.step(env, self.policy, self.score, self.keep, now)
            records.append(kept)
            scores.append(worth)
            ends.append(end)
            states += [] if self.value is None else [now.copy()]
        joined = torch.stack(scores, -2)
        if not self.until_done:
            alive = torch.ones(*joined.shape[:-1], 1, dtype=torch.bool, device=joined.device)
            ahead = None if self.value is None else self._valued(now)
            return Run(records, joined, alive, ended, now, ahead, terminated)
        over = torch.stack(ends, -2).cumsum(-2) > 0
        if self.value is None or terminated is None:
            ahead = terminated = None
        else:
            # Flags may not last; of what follows the end of an agent none counts.
            each = torch.stack([_ended(self.env, state, over.ndim - 2, "terminated") for state in states], -2)
            terminated = terminated | (each & ~over[..., :-1, :]).any(-2)
            ahead = self._worth(states, over.all(-1), terminated.all(-1))
        alive = ~over[..., :-1, :]
        if alive.shape[-1] not in (1, joined.shape[-1]):
            alive = alive.any(-1, keepdim=True)
        return Run(records, torch.where(alive, joined, 0.0), alive, over[..., -1, :], now, ahead, terminated)

    def _valued(self, state: TensorDictBase) -> Float[Tensor, "*b S"]:
        assert self.value is not None  # noqa: S101  (not asked for otherwise)
        found = self.value(state)
        if found.shape != state.shape:
            raise ValueError(f"values must be {[*state.shape]}, are {[*found.shape]}")
        return found

    def _worth(
        self, states: Sequence[TensorDictBase], over: Bool[Tensor, "*b S _"], terminated: Bool[Tensor, "*b S"]
    ) -> Float[Tensor, "*b S"]:
        """Return the values of the states that branches came to, or ended in: 0 if their episodes have terminated."""
        came, steps = states[-1], len(states)
        if bool(over[..., -1].any()):
            last = (~over[..., 1:]).sum(-1).clamp_max(steps - 1)
            first = torch.arange(0, last.numel() * steps, steps, device=last.device).reshape(last.shape)
            came = take(TensorDict.stack(states, last.ndim), first + last)
        return torch.where(terminated, 0.0, self._valued(came))

    def total(self, run: Run, length: int | None = None) -> Float[Tensor, "*b S"]:
        """Return the totals of a period, or of its first steps alone."""
        scores, alive = run.scores[..., :length, :], run.alive[..., :length, :]
        weighs = self.aggregate if isinstance(self.aggregate, Aggregate) else None
        found = self.aggregate(scores) if weighs is None else weighs(scores, alive)
        if found.shape != scores.shape[:-2]:
            raise ValueError(f"the aggregate must be {tuple(scores.shape[:-2])}, is {tuple(found.shape)}")
        return torch.where(alive[..., 0, :].any(-1), found, 0.0)


def _step(
    env: EnvBase, policy: Policy, score: Score, keep: Sequence[NestedKey] | None, now: TensorDictBase
) -> tuple[TensorDictBase, TensorDictBase, Float[Tensor, "*b S N"], Bool[Tensor, "*b S K"]]:
    """Return a step's kept entries, next state, scores, and which episodes ended; one program if compiled."""
    acted = policy(now)
    stepped = env.step(acted if acted is now else now.copy().update(acted))  # some return their outputs alone
    now = env.step_mdp(stepped)
    seen = now.copy()  # the reward is shown to the score, but is not part of the next step's input
    for key in env.reward_keys:
        seen.set(key, stepped.get(below(key)))
    values = score(seen)
    values = values.unsqueeze(-1) if values.shape == now.shape else values
    if values.ndim != now.ndim + 1 or values.shape[:-1] != now.shape:
        raise ValueError(f"scores must be {[*now.shape]} or one more, agents, are {[*values.shape]}")
    values = values if values.is_floating_point() else values.float()
    kept = stepped if keep is None else stepped.select(*keep)
    return kept, now, values, _ended(env, stepped.get("next"), now.ndim)


def _ended(env: EnvBase, state: TensorDictBase, batch: int, how: str = "done") -> Bool[Tensor, "*b S K"]:
    """Return whether the episode is done, for each of K agents (of all groups) if they end apart, else for all."""
    names = [below(key)[1:] for key in env.done_keys if last_name(key) == how]
    # As TorchRL has it, the end of a group is that of all that is nested in it.
    outer = [n for n in names if not any(len(o) < len(n) and n[: len(o) - 1] == o[:-1] for o in names)]
    flags = [state.get(key).flatten(batch) for key in outer if state.get(key, None) is not None]
    if not flags:
        return torch.zeros(*state.shape[:batch], 1, dtype=torch.bool, device=state.device)
    return torch.cat(flags, -1)


def places(slots: Int[Tensor, "*b _"], start: TensorDictBase) -> Int[Tensor, "*b _"]:
    """Return the places of slots [*b, L] or [*b, P, L] in the flattened branches [*b, S]."""
    first = torch.arange(0, start.numel(), start.shape[-1], device=slots.device)
    return first.reshape(*start.shape[:-1], *(1,) * (slots.ndim - start.ndim + 1)) + slots


def lineage(parents: Int[Tensor, "*b P S"]) -> Int[Tensor, "*b P S"]:
    """Return the slot that held, in each of the P periods, what each of the S slots holds after the last pruning."""
    slots = [parents[..., -1, :]]
    for period in reversed(range(parents.shape[-2] - 1)):
        slots.append(parents[..., period, :].gather(-1, slots[-1]))
    return torch.stack(slots[::-1], -2)


def ranking(costs: Float[Tensor, "*b L"], slots: Int[Tensor, "*b L"]) -> Int[Tensor, "*b L"]:
    """Return leaves from best to worst by their costs, repeated copies of one slot after all others."""
    # Two stable sorts: by cost, then by how many copies of the same history come before.
    copies = (slots[..., :, None] == slots[..., None, :]).tril(-1).sum(-1)
    order = costs.argsort(dim=-1, stable=True)
    return order.gather(-1, copies.gather(-1, order).argsort(dim=-1, stable=True))
