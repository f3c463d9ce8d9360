"""Laws of backtracking."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl import envs

from helpers_collectors import ACTION, STREAM, Mass, Policy, Walk, X, assert_same, distance, give_streams, starts
from symphony.collectors import Backtrack, BeamSearchCollector, KeepAll, KeyScore, beam_search, branch, with_rows

STATE = [STREAM, "step", X]
OUTCOME = [("next", *key) if isinstance(key, tuple) else ("next", key) for key in STATE]


def other_numbers(state: TensorDictBase, attempt: Tensor) -> TensorDictBase:
    return state.set(STREAM, 3 * state.get(STREAM) + 10_000 * attempt[:, None, None])


def rebuilt(state: TensorDictBase, attempt: Tensor) -> TensorDictBase:
    """The state from its kept entries, as an environment would reset to it."""
    x, step, stream = (state.get(key) for key in (X, "step", STREAM))
    return other_numbers(Walk()._state(x, step, stream), attempt)


def far(state: TensorDictBase) -> Tensor:
    """[..., N] 1 where a walker is far from the origin."""
    return (distance(state) > 0.9).float()


RULE = Backtrack(0.0, renew=other_numbers)


def look(start, rule=RULE, *, score=far, steps=12, every=2, **how):
    return beam_search(Walk(), Policy(), score, start, steps=steps, prune_every=every, rule=rule, **how)


def assert_same_search(first: Any, second: Any) -> None:
    assert_same(first.trajectories, second.trajectories)
    assert first.trajectories.names == second.trajectories.names
    for name in ("scores", "totals", "slots", "parents", "simulated_scores"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name


@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 9), st.integers(1, 5) | st.just(99))
@settings(deadline=None, max_examples=8)
def test_what_is_never_bad_is_independent(rows, branches, steps, every):
    start, seen = starts(Walk(), rows, branches=branches), []
    found = look(start, Backtrack(math.inf), steps=steps, every=every, score=lambda s: far(seen.append(s) or s))
    assert len(seen) < steps + min(every, steps)
    assert_same_search(found, look(start, KeepAll(), steps=steps, every=every))
    assert found.simulated_steps == rows * branches * steps


@pytest.mark.parametrize("keep", [None, [*STATE, *OUTCOME]], ids=["all kept", "rebuilt"])
def test_a_rule_that_can_be_met_is_met(keep):
    start = starts(Walk(), 5, branches=4)
    start.set(X, 0.3 * start.get(X))  # or some begin where the first step is bad, whatever is drawn
    rule = replace(RULE, back=(1, 2, 3, *[0] * 60), cap=100, renew=rebuilt if keep else other_numbers)
    how = {"score": lambda state: (distance(state) > 1.2).float(), "keep": keep}
    before, after = look(start, KeepAll(), **how), look(start, rule, **how)
    assert (before.totals > 0).any(-2).float().mean() > 0.5
    assert (after.totals == 0).all()
    assert (after.scores == 0).all()
    assert before.simulated_steps < after.simulated_steps < 6 * before.simulated_steps
    if keep:
        whole = look(start, replace(rule, renew=other_numbers), score=how["score"])
        assert torch.equal(whole.trajectories.get(X), after.trajectories.get(X))
        assert set(after.trajectories.keys(True, True)) == {*STATE, *OUTCOME}


@given(st.integers(1, 9), st.sampled_from([(3, 11), (4, 8)]), st.randoms(use_true_random=False))
@settings(deadline=None, max_examples=3)
def test_lines_know_nothing_of_each_other(width, periods, random):
    every, steps = periods
    start, rule = starts(Walk(), 4, branches=2), replace(RULE, cap=2.0)
    whole = look(start, rule, every=every, steps=steps)
    assert_same_search(whole, look(start, replace(rule, width=width), every=every, steps=steps))
    rows = random.sample(range(4), 2)
    part = look(start[rows], replace(rule, width=width), every=every, steps=steps)
    assert torch.equal(part.trajectories.get(X), whole.trajectories.get(X)[rows])
    assert torch.equal(part.totals, whole.totals[rows])


def test_lines_are_true_histories():
    start = starts(Walk(), 6, branches=3)
    found, env, policy = look(start, steps=11), Walk(), Policy()
    assert found.simulated_steps > 1.2 * 6 * 3 * 11
    lines = found.trajectories
    assert torch.equal(lines.get("step").squeeze(-1), torch.arange(11).expand(6, 3, 11))
    assert torch.equal(lines.get(X)[..., 0, :, :], start.get(X))
    assert torch.equal(lines.get(X)[..., 1:, :, :], lines.get(("next", *X))[..., :-1, :, :])
    acted = policy(lines.select(*STATE))
    assert torch.equal(acted.get(ACTION), lines.get(ACTION))
    after = env.step(acted).get("next")
    assert torch.equal(after.get(X), lines.get(("next", *X)))
    assert torch.equal(far(after), found.scores)
    totals = torch.stack([found.scores[..., k : k + 2, :].amax(-2).sum(-1) for k in range(0, 11, 2)], -2)
    assert torch.equal(found.totals, totals)


def course(rule: Backtrack, bad: Any) -> tuple[list[tuple[int, int]], int]:
    """Where a line of 20 steps goes back to with which tries, and how many steps are simulated."""
    places = []

    def noted(state: TensorDictBase, attempt: Tensor) -> TensorDictBase:
        places.append((int(state.get("step")), int(attempt)))
        return other_numbers(state, attempt)

    def score(state: TensorDictBase) -> Tensor:
        step = state.get("step")
        return bad(step, len(places)).float().expand(*step.shape[:-1], 2)

    found = look(starts(Walk(), 1, branches=1), replace(rule, renew=noted), steps=20, score=score)
    return places, found.simulated_steps


def test_the_course_of_a_line():
    """One step is bad, always: a little back, farther, to the start, again to the start, and on at last."""
    rule = Backtrack(0.0, (1, 3, 0, 0), cap=2)
    places, simulated = course(rule, lambda step, tries: step == 9)
    assert places == [(8, 1), (4, 2), (0, 3), (0, 4)]
    assert simulated == 20 + 2 * (1 + 3 + 5 + 5)
    # 1 + 3 of 10 periods are the cap.
    assert course(replace(rule, cap=0.4), lambda step, tries: step == 9)[0] == [(8, 1), (4, 2)]


def test_agents_that_can_do_no_better_are_excused_and_hide_no_others():
    """The first walker is always bad; the second can do better."""
    start, rule = starts(Walk(), 6, branches=3), replace(RULE, back=(1, 3, 0, 0), cap=20)
    start.set(X, 0.3 * start.get(X))

    def score(state: TensorDictBase) -> Tensor:
        second = (distance(state)[..., 1:] > 1.2).float()
        return torch.cat([torch.ones_like(second), second], -1)

    free, found = (look(start, rule, score=score) for rule in (KeepAll(), rule))
    assert min(found.scores[..., 0].min(), found.totals.min()) == 1
    bad, left = ((each.scores[..., 1] > 0).any(-1).float().mean() for each in (free, found))
    assert bad > 0.5 > 3 * left
    assert found.simulated_steps < 3 * free.simulated_steps


def test_once_past_its_trouble_a_line_counts_anew():
    def bad(step: Tensor, tries: int) -> Tensor:
        """At the first visit of three places, as far as they are told by the numbers of the line."""
        return step == {0: 6, 1: 12, 2: 14}.get(tries, -1)

    # A good period two past the first place lies before the second, none between that and the third.
    assert course(Backtrack(0.0, (2, 4, 0)), bad)[0] == [(2, 1), (8, 2), (6, 3)]


@pytest.mark.parametrize("cap", [0.0, 3.0])
def test_what_cannot_be_met_ends(cap):
    start, plain = starts(Walk(), 3, branches=2), 3 * 2 * 12
    rule = replace(RULE, back=(1, *[0] * 9), cap=cap)
    found = look(start, rule, score=lambda state: (distance(state) > -1).float())
    assert plain <= found.simulated_steps <= plain * (2 + cap)
    assert (found.totals == 2).all()
    at_the_end: Any = {"score": lambda state: (state.get("step") == 12).expand(*state.shape, 2).float()}
    late = look(start, rule, **at_the_end)
    assert look(start, rule, steps=11, **at_the_end).simulated_steps == 3 * 2 * 11  # before it
    assert plain * (1 + cap) <= late.simulated_steps <= plain * (2 + cap)
    assert (late.totals[..., -1, :] == 2).all()
    # NaN is bad, as for rules that prune.
    assert look(start, score=lambda state: distance(state) * math.nan).simulated_steps > plain


def test_what_can_not_be_right_is_refused():
    start = starts(Walk(), 2, branches=2)
    with pytest.raises(ValueError, match=r"their kept states have no .*'x'"):
        look(start, keep=[STREAM, *OUTCOME])
    with pytest.raises(ValueError, match="rule Backtrack"):
        look(start, leaves=1)
    with pytest.raises(ValueError, match="lengths are those of 3 lines, there are 4"):
        look(start, replace(RULE, lengths=torch.full((3,), 12)))
    for wrong in [(0, ()), (0, (0, 1)), (0, (1, -1)), (0, (1,), -1.0), (0, (1,), 6.0, None, 0), (math.nan,)]:
        with pytest.raises(ValueError, match="back and width begin at 1, cap at 0, and the threshold is a number"):
            Backtrack(*wrong)


@pytest.mark.parametrize(("until", "apart"), [(True, True), (True, False), (False, True)])
def test_who_has_ended_stays_so_where_others_go_back(until, apart):
    """Agent 0 leaves in the first step; agent 1 is bad at steps 5 and 6 until the line has gone back."""
    start = branch(with_rows(Mass(agents=2), [1]).reset(), 1)
    start["agents", "place"] = torch.tensor([[[[1.45, 0.5], [0.0, 0.0]]]])
    calls = itertools.count(1)

    def score(td: TensorDictBase) -> Tensor:
        bad = next(calls) in {5, 6}
        each = torch.tensor([0.1, 9.0 if bad else 0.1]).expand(*td.shape, 2)
        return each if apart else each.sum(-1)

    actions = torch.tensor([[-0.6], [0.0]])
    still = TensorDictModule(lambda x: actions.expand(*x.shape[:-1], 1), [("agents", "place")], [ACTION])
    how: Any = {"steps": 8, "prune_every": 2, "rule": Backtrack(5.0, back=(1,))}
    found = beam_search(Mass(agents=2), still, score, start, until_done=until, **how)
    assert next(calls) > 9
    if until and apart:
        torch.testing.assert_close(found.scores[0, 0, :, 0], torch.tensor([0.1, *[0.0] * 7]))


@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs:UserWarning")
@pytest.mark.parametrize("rows", [(), (3,)])
def test_random_actions_go_back_too(rows):
    env = envs.TransformedEnv(with_rows(Mass(), rows) if rows else Mass(), envs.StepCounter())
    how = {"branches": 4, "leaves": 4, "prune_every": 2, "rule": Backtrack(-9.0)}
    how["frames_per_batch"] = 4 * 6 * math.prod(rows)
    assert BeamSearchCollector(env, score=KeyScore("reward", negate=True), **how).next().shape == (*rows, 4, 6)


def test_as_a_collector():
    how = {"score": far, "branches": 4, "leaves": 4, "prune_every": 2, "rule": RULE, "prepare": give_streams}
    collector = BeamSearchCollector(with_rows(Walk(), [3]), Policy(), frames_per_batch=120, total_frames=240, **how)
    batches = list(collector)
    assert [batch.shape for batch in batches] == [(3, 4, 10)] * 2
    for batch in batches:
        assert torch.equal(batch.get(("next", *X))[..., :-1, :, :], batch.get(X)[..., 1:, :, :])
        assert torch.equal(batch.get(("collector", "beam_slot")), torch.arange(4)[:, None].expand(3, 4, 10))
    assert collector.simulated_frames > 240
