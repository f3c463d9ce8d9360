"""Laws of backtracking."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from helpers_collectors import ACTION, LOG_PROB, STREAM, Policy, Walk, X, distance, starts
from symphony.collectors import (
    Backtrack,
    BeamSearchCollector,
    BeamSearchResult,
    KeepAll,
    beam_search,
    with_rows,
)

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


def look(
    start: TensorDictBase, rule: Any = RULE, *, steps: int = 12, every: int = 2, **how: Any
) -> BeamSearchResult:
    how = {"score": far, "env": Walk(), **how}
    return beam_search(
        how.pop("env"), Policy(), how.pop("score"), start, steps=steps, prune_every=every, rule=rule, **how
    )


def assert_same(first: BeamSearchResult, second: BeamSearchResult) -> None:
    one, other = first.trajectories, second.trajectories
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    assert one.names == other.names
    for key in one.keys(True, True):
        assert torch.equal(one.get(key), other.get(key)), key
    for name in ("scores", "totals", "slots", "parents", "simulated_scores"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name


@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 9), st.integers(1, 5))
@settings(deadline=None, max_examples=15)
def test_what_is_never_bad_is_independent(rows: int, branches: int, steps: int, every: int) -> None:
    start = starts(Walk(), rows, branches=branches)
    found = look(start, replace(RULE, threshold=math.inf), steps=steps, every=every)
    assert_same(found, look(start, KeepAll(), steps=steps, every=every))
    assert found.simulated_steps == rows * branches * steps


@pytest.mark.parametrize("how", [{}, {"keep": [*STATE, *OUTCOME]}], ids=["all kept", "rebuilt"])
def test_a_rule_that_can_be_met_is_met(how: dict[str, Any]) -> None:
    how, start = dict(how), starts(Walk(), 5, branches=4)
    start.set(X, 0.3 * start.get(X))  # or some begin where the first step is bad, whatever is drawn
    rule = replace(RULE, back=(1, 2, 3, 0), cap=100, renew=rebuilt if "keep" in how else other_numbers)
    how["score"] = lambda state: (distance(state) > 1.2).float()
    before, after = look(start, KeepAll(), **how), look(start, rule, **how)
    assert (before.totals > 0).any(-2).float().mean() > 0.5
    assert (after.totals == 0).all()
    assert (after.scores == 0).all()
    assert before.simulated_steps < after.simulated_steps < 6 * before.simulated_steps
    if "keep" in how:
        whole = look(start, replace(rule, renew=other_numbers), score=how["score"])
        assert torch.equal(whole.trajectories.get(X), after.trajectories.get(X))
        assert set(after.trajectories.keys(True, True)) == {*STATE, *OUTCOME}


@given(st.integers(1, 14), st.sampled_from([(2, 12), (3, 11), (5, 8)]), st.randoms(use_true_random=False))
@settings(deadline=None, max_examples=8)
def test_lines_know_nothing_of_each_other(width: int, periods: tuple[int, int], random: Random) -> None:
    every, steps = periods
    start = starts(Walk(), 4, branches=3)
    whole = look(start, every=every, steps=steps)
    assert_same(whole, look(start, replace(RULE, width=width), every=every, steps=steps))
    rows = random.sample(range(4), 2)
    part = look(start[rows], replace(RULE, width=width), every=every, steps=steps)
    assert torch.equal(part.trajectories.get(X), whole.trajectories.get(X)[rows])
    assert torch.equal(part.totals, whole.totals[rows])


def test_lines_are_true_histories() -> None:
    start = starts(Walk(), 6, branches=3)
    found, env, policy = look(start, steps=11), Walk(), Policy()
    assert found.simulated_steps > 1.2 * 6 * 3 * 11
    lines = found.trajectories
    assert torch.equal(lines.get("step").squeeze(-1), torch.arange(11).expand(6, 3, 11))
    assert torch.equal(lines.get(X)[..., 0, :, :], start.get(X))
    for t in range(11):
        here = lines[..., t].select(*STATE)
        acted = policy(here)
        assert torch.equal(acted.get(ACTION), lines[..., t].get(ACTION))
        after = step_mdp(env.step(acted))
        assert torch.equal(after.get(X), lines[..., t].get(("next", *X)))
        assert torch.equal(far(after), found.scores[..., t, :])
        if t < 10:
            assert torch.equal(after.get(X), lines[..., t + 1].get(X))
    totals = torch.stack([found.scores[..., k : k + 2, :].amax(-2).sum(-1) for k in range(0, 11, 2)], -2)
    assert torch.equal(found.totals, totals)


def test_the_course_of_a_line() -> None:
    """One step is bad, always: a little back, farther, to the start, again to the start, and on at last."""
    places: list[tuple[int, int]] = []

    def noted(state: TensorDictBase, attempt: Tensor) -> TensorDictBase:
        places.append((int(state.get("step")), int(attempt)))
        return other_numbers(state, attempt)

    def bad(state: TensorDictBase) -> Tensor:
        step = state.get("step")
        return (step == 9).float().expand(*step.shape[:-1], 2)

    start = starts(Walk(), 1, branches=1)
    found = look(start, Backtrack(0.0, (1, 3, 0), cap=2, renew=noted), steps=20, score=bad)
    # 1 + 3 + 5 + 5 + 5 + 5 of 10 periods are more than twice a line.
    assert places == [(8, 1), (4, 2), (0, 3), (0, 4), (0, 5), (0, 6)]
    assert found.simulated_steps == 20 + 2 * 24
    places.clear()
    look(start, Backtrack(0.0, (1, 3, 0), cap=0.5, renew=noted), steps=20, score=bad)
    assert places == [(8, 1), (4, 2), (0, 3)]


def test_once_past_its_trouble_a_line_counts_anew() -> None:
    places: list[int] = []

    def noted(state: TensorDictBase, attempt: Tensor) -> TensorDictBase:
        places.append(int(state.get("step")))
        return other_numbers(state, attempt)

    def bad(state: TensorDictBase) -> Tensor:
        """At the first visit of three places, as far as they are told by the numbers of the line."""
        step, tries = state.get("step"), len(places)
        hit = ((step == 6) & (tries == 0)) | ((step == 12) & (tries == 1)) | ((step == 14) & (tries == 2))
        return hit.float().expand(*step.shape[:-1], 2)

    look(starts(Walk(), 1, branches=1), Backtrack(0.0, (2, 4, 0), renew=noted), steps=20, score=bad)
    # A good period two past the first place lies before the second, none between that and the third.
    assert places == [2, 8, 6]


@pytest.mark.parametrize("cap", [0.0, 1.0, 3.0])
def test_what_cannot_be_met_ends(cap: float) -> None:
    start, plain = starts(Walk(), 3, branches=2), 3 * 2 * 12
    rule = replace(RULE, back=(1, 0), cap=cap)
    found = look(start, rule, score=lambda state: (distance(state) > -1).float())
    assert plain <= found.simulated_steps <= plain * (2 + cap)
    assert (found.totals == 2).all()
    late = look(start, rule, score=lambda state: (state.get("step") == 12).expand(*state.shape, 2).float())
    assert plain * (1 + cap) <= late.simulated_steps <= plain * (2 + cap)
    assert (late.totals[..., -1, :] == 2).all()


def test_nothing_is_learned_from_numbers_that_are_none() -> None:
    """NaN is bad, as for rules that prune."""
    start = starts(Walk(), 1, branches=2)
    found = look(start, score=lambda state: distance(state) * math.nan)
    assert found.simulated_steps > 24


def test_a_state_that_lacks_something_is_refused() -> None:
    start = starts(Walk(), 2, branches=2)
    with pytest.raises(ValueError, match=r"their kept states have no .*'x'"):
        look(start, keep=[STREAM, *OUTCOME])
    with pytest.raises(ValueError, match="rule Backtrack"):
        look(start, leaves=1)
    for arguments in ({"back": ()}, {"back": (0, 1)}, {"back": (1, -1)}, {"cap": -1.0}, {"width": 0}):
        with pytest.raises(ValueError, match=r"back|cap|width"):
            Backtrack(0.0, **arguments)
    with pytest.raises(ValueError, match="threshold"):
        Backtrack(math.nan)


def test_as_a_collector() -> None:
    env = Walk()
    collector = BeamSearchCollector(
        with_rows(env, [3]), Policy(), score=far, branches=4, leaves=4, prune_every=2, rule=RULE,
        prepare=lambda start: start.set(STREAM, 50 * start.get(STREAM) + torch.arange(4)[:, None]),
        frames_per_batch=3 * 4 * 10, total_frames=2 * 3 * 4 * 10,
    )  # fmt: skip
    batches = list(collector)
    assert [batch.shape for batch in batches] == [(3, 4, 10)] * 2
    for batch in batches:
        assert LOG_PROB in batch.keys(True)
        assert torch.equal(batch.get(("next", *X))[..., :-1, :, :], batch.get(X)[..., 1:, :, :])
        assert torch.equal(batch.get(("collector", "beam_slot")), torch.arange(4)[:, None].expand(3, 4, 10))
    assert collector.simulated_frames > 2 * 3 * 4 * 10
    collector.shutdown()


def test_a_start_may_be_a_view() -> None:
    one = Walk().reset(TensorDict({}, [2]))
    start = one.unsqueeze(-1).expand(2, 3)
    found = look(start, replace(RULE, renew=lambda state, attempt: other_numbers(state.copy(), attempt)))
    assert torch.equal(
        found.trajectories.get(X)[:, 0], found.trajectories.get(X)[:, 2]
    )  # one stream, one course
