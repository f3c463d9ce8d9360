"""Laws of the pruning rules."""

from __future__ import annotations

import doctest
import inspect
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from symphony.collectors import Aggregate, KeepAll, KeepBest, ReplaceBad, Systematic, rules
from symphony.collectors.pruning import checked

NUMBERS = st.floats(-1e3, 1e3, width=32)
ODD = NUMBERS | st.sampled_from([math.inf, -math.inf, math.nan, 0.0])
FRACTIONS = st.floats(0.01, 1.0)
NOISE = st.floats(0, 1, exclude_max=True)


@given(st.lists(ODD, min_size=1, max_size=17), FRACTIONS)
def test_keep_best_keeps_the_lowest(totals, fraction):
    """Against sorting in Python: NaN last, ties by slot; copies differ by one at most."""
    parents = KeepBest(fraction)(torch.tensor([totals]))[0].tolist()
    ranked = sorted(range(len(totals)), key=lambda i: (math.isnan(totals[i]), totals[i], i))
    kept = ranked[: KeepBest(fraction).survivors(len(totals))]
    assert parents == [kept[i % len(kept)] for i in range(len(totals))]
    counts = [parents.count(i) for i in kept]
    assert max(counts) - min(counts) <= 1


@given(st.integers(1, 200), st.integers(1, 200))
def test_survivors_are_the_share_rounded_up(kept, branches):
    if kept <= branches:
        assert KeepBest(kept / branches).survivors(branches) == kept
        assert KeepBest(0.999 * kept / branches).survivors(branches) in (kept, kept - 1)
    assert KeepBest(0.5).survivors(branches) == branches - branches // 2
    assert KeepBest(1e-9).survivors(branches) == 1


@given(st.lists(ODD, min_size=1, max_size=17), NOISE, st.floats(0.01, 100))
def test_systematic_copies_are_proportional(totals, noise, temperature):
    rule = Systematic(temperature)
    given_totals = torch.tensor([totals])
    parents = rule(given_totals, torch.tensor([noise]))
    assert torch.equal(parents, rule(given_totals, torch.tensor([noise])))
    counts = torch.bincount(parents[0], minlength=len(totals))
    assert len(counts) == len(totals)
    if all(map(math.isfinite, totals)):
        expected = len(totals) * torch.softmax(-given_totals[0].double() / temperature, 0)
        assert (counts >= (expected - 1e-6).floor()).all()
        assert (counts <= (expected + 1e-6).ceil()).all()
    finite = [i for i, total in enumerate(totals) if total < math.inf]
    if finite:
        assert set(parents[0].tolist()) <= set(finite)


@given(st.lists(NUMBERS, min_size=1, max_size=17), NOISE)
def test_systematic_fills_slots_by_rank(totals, noise):
    totals = torch.tensor([totals])
    taken = totals.gather(-1, Systematic(100.0)(totals, torch.tensor([noise])))
    assert (taken.diff(dim=-1) >= 0).all()
    # Without differences nothing changes, so what follows a segment's end is harmless.
    level = torch.full_like(totals, 3.0)
    slots = torch.arange(totals.shape[-1])
    if 1e-9 < noise < 1 - 1e-9:
        assert torch.equal(Systematic(100.0)(level, torch.tensor([noise]).double())[0], slots)


def test_systematic_of_equals_keeps_all():
    everything = torch.arange(6).expand(3, 6)
    for value in (0.0, math.inf, math.nan):
        assert torch.equal(
            Systematic()(torch.full((3, 6), value), torch.tensor([0.001, 0.5, 0.999])), everything
        )
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
    totals = torch.tensor([totals])
    threshold = float(torch.tensor(threshold))
    parents = checked(
        ReplaceBad(threshold),
        totals,
        torch.tensor([noise], dtype=torch.float64),
        groups=torch.tensor([groups]) if grouped else None,
    )
    groups = groups if grouped else [0] * len(groups)
    assert parents[0].tolist() == replaced(totals[0].tolist(), threshold, noise, groups)


@given(some_branches(), NUMBERS, NOISE)
def test_replace_bad_leaves_the_good_alone(branches, threshold, noise):
    totals, groups = (torch.tensor([values]) for values in branches)
    noise, good = torch.tensor([noise]), totals <= threshold
    parents = ReplaceBad(threshold)(totals, noise, groups)
    slots = torch.arange(totals.shape[1])[None]
    assert torch.equal(parents[good], slots[good])
    if good.any():
        assert good.gather(1, parents).all()
        kept = groups.gather(1, parents) == groups
        possible = ((groups[:, :, None] == groups[:, None]) & good[:, None]).any(-1)
        assert torch.equal(kept | ~possible, torch.ones_like(kept))
    else:
        assert torch.equal(parents, slots)
    assert torch.equal(parents, ReplaceBad(threshold)(totals, noise, groups))
    everyone = ReplaceBad(math.inf)(totals.nan_to_num(), noise, groups)
    assert torch.equal(everyone, slots)


def test_replace_bad_takes_rows_apart_and_shares_copies_evenly():
    totals, groups = torch.randn(4, 5, 16), torch.randint(3, (4, 5, 16))
    noise = torch.rand(4, 5)
    rule = ReplaceBad(0.2)
    whole = rule(totals, noise, groups)
    for index in ((0, 0), (3, 4), (2, 1)):
        assert torch.equal(rule(totals[index], noise[index], groups[index]), whole[index])
    plain = rule(totals, noise)
    for row in range(4):
        for column in range(5):
            good = totals[row, column] <= 0.2
            copies = torch.bincount(plain[row, column][~good], minlength=16)[good]
            assert copies.max() - copies.min() <= 1
    # the random start reaches every good branch
    totals = torch.tensor([0.0, 9.0, 0.0, 0.0])
    starts = ReplaceBad(1.0)(totals.expand(300, 4), (torch.arange(300) + 0.5) / 300)[:, 1]
    assert torch.bincount(starts).tolist() == [100, 0, 100, 100]


def test_the_example_of_a_rule_runs():
    example = (
        inspect.getsource(rules)
        .partition("PruningRule = ")[2]
        .partition("def takes_groups")[0]
        .rpartition('"""')[0]
    )
    test = doctest.DocTestParser().get_doctest(example, {}, "PruningRule", None, None)
    results = doctest.DocTestRunner(verbose=False).run(test)
    assert (results.failed, results.attempted) == (0, 3)


@pytest.mark.parametrize(
    ("parents", "complaint"),
    [
        ([0, 2, 1], None),
        ([0, 0, 0], None),
        ([0, 1, 3], "outside of 0 ... 2"),
        ([-1, 1, 2], "outside of 0 ... 2"),
        ([0.0, 1.0, 2.0], "must return int64"),
        ([0, 1], "must return int64"),
    ],
)
def test_what_rules_of_others_return_is_checked(parents, complaint):
    def rule(totals, noise):
        return torch.tensor([parents])

    if complaint is None:
        assert checked(rule, torch.zeros(1, 3)).tolist() == [parents]
    else:
        with pytest.raises(ValueError, match=complaint):
            checked(rule, torch.zeros(1, 3))


def test_bad_parameters_are_errors():
    for fraction in (0.0, 1.1, math.nan):
        with pytest.raises(ValueError, match="fraction"):
            KeepBest(fraction)
    with pytest.raises(ValueError, match="temperature"):
        Systematic(0.0)
    with pytest.raises(ValueError, match="threshold"):
        ReplaceBad(math.nan)
    with pytest.raises(ValueError, match="noise"):
        ReplaceBad(1.0)(torch.zeros(1, 2))
    with pytest.raises(ValueError, match="time is one of max, mean, sum, last"):
        Aggregate("median")
    with pytest.raises(ValueError, match="agents is one of"):
        Aggregate("max", "last")


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
