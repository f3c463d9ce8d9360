"""Laws of the pruning rules."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from symphony.collectors import KeepAll, KeepBest, ReplaceBad, Residual, Stratified, Systematic
from symphony.collectors.rules import checked

NUMBERS = st.floats(-1e3, 1e3, width=32)
ODD = NUMBERS | st.sampled_from([math.inf, -math.inf, math.nan, 0.0])
NOISE = st.floats(0, 1, exclude_max=True)
SCHEMES = (Systematic, Stratified, Residual)


@given(st.lists(ODD, min_size=1, max_size=17), st.floats(0.01, 1.0))
def test_keep_best_keeps_the_lowest(totals, fraction):
    """Against sorting in Python: NaN last, ties by slot; copies differ by one at most."""
    parents = KeepBest(fraction)(torch.tensor([totals]))[0].tolist()
    ranked = sorted(range(len(totals)), key=lambda i: (math.isnan(totals[i]), totals[i], i))
    kept = ranked[: max(1, math.ceil(fraction * len(totals) - 1e-9))]
    assert parents == [kept[i % len(kept)] for i in range(len(totals))]


@given(st.integers(1, 200), st.integers(1, 200))
def test_survivors_are_the_share_rounded_up(kept, branches):
    def survivors(fraction):
        return len(KeepBest(fraction)(torch.arange(branches)).unique())

    if kept <= branches:
        assert survivors(kept / branches) == kept
        assert survivors(0.999 * kept / branches) in (kept, kept - 1)
    assert survivors(0.5) == branches - branches // 2
    assert survivors(1e-9) == 1


@given(
    st.lists(ODD, min_size=1, max_size=12), st.lists(NOISE, min_size=12, max_size=12), st.floats(0.01, 100)
)
def test_copies_are_proportional(totals, noise, temperature):
    """A branch of weight w gets as many copies of S w as its scheme promises; the best that goes on is in slot 0."""
    given_totals = torch.tensor([totals])
    for scheme in SCHEMES:
        numbers = torch.tensor([noise[: len(totals)]] if scheme is Stratified else noise[:1]).double()
        parents = scheme(temperature)(given_totals, numbers)[0]
        counts = torch.bincount(parents, minlength=len(totals))
        assert len(counts) == len(totals)
        if all(map(math.isfinite, totals)):
            share = len(totals) * torch.softmax(-given_totals[0].double() / temperature, 0)
            assert (counts >= (share - 1e-6).floor()).all() or scheme is Stratified
            assert (counts <= (share + 1e-6).ceil() + (scheme is not Systematic)).all()
            assert (given_totals[0][parents].diff() >= 0).all()
        finite = {i for i, total in enumerate(totals) if total < math.inf}
        assert not finite or set(parents.tolist()) <= finite


@pytest.mark.parametrize("scheme", SCHEMES)
def test_copies_are_fair(scheme):
    totals = torch.tensor([0.3, 2.0, 0.1, 0.9, 0.3])
    torch.manual_seed(0)
    noise = torch.rand(20000, *([5] if scheme is Stratified else []))
    parents = scheme(0.7)(totals.expand(20000, 5), noise)
    average = torch.bincount(parents.flatten(), minlength=5) / 20000
    torch.testing.assert_close(average, 5 * torch.softmax(-totals / 0.7, 0), atol=0.02, rtol=0)


def test_systematic_of_equals_keeps_all():
    """So that what follows an episode's end is harmless."""
    everything = torch.arange(6).expand(3, 6)
    for value in (0.0, 3.0, math.inf, math.nan):
        found = Systematic()(torch.full((3, 6), value), torch.tensor([0.001, 0.5, 0.999]))
        assert torch.equal(found, everything)
    assert torch.equal(KeepAll()(torch.rand(3, 6)), everything)


def replaced(totals, threshold, noise, groups):
    """What :class:`ReplaceBad` is to do, slot by slot."""
    slots = range(len(totals))
    good = [i for i in slots if totals[i] <= threshold]
    parents, turns = list(slots), {}
    for i in slots:
        if i in good or not good:
            continue
        pool = [k for k in good if groups[k] == groups[i]]
        name = groups[i] if pool else "any"
        pool = pool or good
        parents[i] = pool[(math.floor(noise * len(pool)) + turns.get(name, 0)) % len(pool)]
        turns[name] = turns.get(name, 0) + 1
    return parents


@st.composite
def some_branches(draw):
    number = draw(st.integers(1, 12))
    totals = draw(st.lists(ODD, min_size=number, max_size=number))
    return totals, draw(st.lists(st.integers(-2, 2), min_size=number, max_size=number))


@given(some_branches(), ODD.filter(lambda x: not math.isnan(x)), NOISE, st.booleans())
def test_replace_bad_by_hand(branches, threshold, noise, grouped):
    totals, groups = branches
    totals, threshold = torch.tensor([totals]), float(torch.tensor(threshold))
    given_groups = torch.tensor([groups]) if grouped else None
    numbers = torch.tensor([noise], dtype=torch.float64)
    parents = checked(ReplaceBad(threshold), totals, numbers, groups=given_groups)
    groups = groups if grouped else [0] * len(groups)
    assert parents[0].tolist() == replaced(totals[0].tolist(), threshold, noise, groups)


def test_replace_bad_takes_rows_apart_and_shares_copies_evenly():
    totals, groups, noise = torch.randn(4, 5, 16), torch.randint(3, (4, 5, 16)), torch.rand(4, 5)
    rule = ReplaceBad(0.2)
    whole, plain = rule(totals, noise, groups), rule(totals, noise)
    for index in ((0, 0), (3, 4), (2, 1)):
        assert torch.equal(rule(totals[index], noise[index], groups[index]), whole[index])
    for parents, good in zip(plain.flatten(0, 1), (totals <= 0.2).flatten(0, 1), strict=True):
        copies = torch.bincount(parents[~good], minlength=16)[good]
        assert copies.max() - copies.min() <= 1
    # the random start reaches every good branch
    totals = torch.tensor([0.0, 9.0, 0.0, 0.0])
    starts = ReplaceBad(1.0)(totals.expand(300, 4), (torch.arange(300) + 0.5) / 300)[:, 1]
    assert torch.bincount(starts).tolist() == [100, 0, 100, 100]


@given(st.integers(1, 12), st.integers(0, 2**31), NOISE)
def test_replace_bad_takes_a_goal_from_nobody_who_drives_well_with_it(branches, seed, noise):
    """Goals are lost only with the last good branch that has them: what is evaluated is the driving, not the goal."""
    torch.manual_seed(seed)
    totals, groups = torch.randn(20, branches), torch.randint(4, (20, branches))
    parents = ReplaceBad(0.0)(totals, torch.full((20,), noise), groups)
    after, good = groups.gather(1, parents), totals <= 0
    for row in range(20):
        alive = set(groups[row][good[row]].tolist())
        for group in range(4):
            before, now = ((each[row] == group).sum() for each in (groups, after))
            if alive == set(groups[row].tolist()) or not alive:
                assert now == before
            elif group in alive:
                assert now >= before
            else:
                assert now == 0


@pytest.mark.parametrize("wrong", [(KeepBest, 0.0), (KeepBest, 1.1), (KeepBest, math.nan), (Systematic, 0.0)])
def test_bad_parameters_are_errors(wrong):
    rule, value = wrong
    with pytest.raises(ValueError, match=r"fraction|temperature"):
        rule(value)
    with pytest.raises(ValueError, match="threshold"):
        ReplaceBad(math.nan)
