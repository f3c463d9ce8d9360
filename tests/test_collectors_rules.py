"""Pruning rules, the search as a particle filter, and how ends of episodes are counted."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from helpers_collectors import Mass, hashed
from symphony import collectors
from symphony.collectors.rules import checked

STEPS, KEPT, SPREAD = 8, 0.9, 0.5
TOTAL = collectors.Aggregate("sum")


class Filtered(EnvBase):
    """x' = 0.9 x + action, seen as y with noise; the reward is the log-likelihood of what was seen."""

    batch_locked = False

    def __init__(self) -> None:
        super().__init__(batch_size=[])
        time = Unbounded((1,), dtype=torch.int64)
        self.observation_spec = Composite(x=Unbounded((1,)), t=time, y=Unbounded((STEPS,)))
        self.state_spec, self.action_spec = self.observation_spec.clone(), Unbounded((1,))
        self.reward_spec = Unbounded((1,))

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        raise NotImplementedError

    def _step(self, td: TensorDictBase) -> TensorDictBase:
        x = KEPT * td["x"] + td["action"]
        seen = torch.distributions.Normal(x, SPREAD).log_prob(td["y"].gather(-1, td["t"]))
        done = torch.zeros_like(seen, dtype=torch.bool)
        return TensorDict({"x": x, "t": td["t"] + 1, "y": td["y"], "reward": seen, "done": done}, td.shape)


def observed(rows: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return what is seen [rows, T], and by Kalman's filter its log-evidence and the mean of the last state."""
    y, x = [], torch.zeros(rows)
    for _ in range(STEPS):
        x = KEPT * x + torch.randn(rows)
        y.append(x + SPREAD * torch.randn(rows))
    mean, variance, evidence = torch.zeros(rows), 0.0, torch.zeros(rows)
    for seen in y:
        mean, variance = KEPT * mean, KEPT**2 * variance + 1.0
        total = variance + SPREAD**2
        evidence = evidence + torch.distributions.Normal(mean, math.sqrt(total)).log_prob(seen)
        mean = mean + variance / total * (seen - mean)
        variance *= 1 - variance / total
    return torch.stack(y, -1), evidence, mean


def filtered(y: Tensor, rule: Any, branches: int, **how: Any) -> collectors.BeamSearchResult:
    rows, zero = len(y), torch.zeros(len(y), 1)
    start = TensorDict({"x": zero, "t": zero.long(), "y": y}, [rows])
    noise = torch.rand(rows, STEPS)
    how |= {"steps": STEPS, "prune_every": 1, "keep": [("next", "x")], "aggregate": TOTAL}

    def policy(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.randn(*td.shape, 1))

    score, start = collectors.KeyScore("reward", negate=True), collectors.branch(start, branches)
    return collectors.beam_search(Filtered(), policy, score, start, rule=rule, noise=noise, **how)


@pytest.mark.parametrize("threshold", [1.0, 0.5, 0.0])
def test_the_evidence_is_that_of_kalmans_filter(threshold):
    torch.manual_seed(0)
    y, evidence, mean = observed(40)
    y, evidence, mean = (part.repeat_interleave(10, 0) for part in (y, evidence, mean))
    found = filtered(y, collectors.Systematic(threshold=threshold), 128, prune_last=False)
    ratio = (found.log_evidence - evidence).exp()
    if threshold:  # else one weight is all there is, and no mean of a thousand tells a bias
        assert abs(float(ratio.mean()) - 1) < 4 * float(ratio.std()) / math.sqrt(len(ratio))
        assert float(ratio.std()) < 1.0
        error = (found.leaf_log_weights.softmax(-1) * found.trajectories["next", "x"][..., -1, 0]).sum(-1) - mean
        assert float(error.square().mean().sqrt()) < 0.15
    torch.testing.assert_close(found.leaf_log_weights.exp().mean(-1), torch.ones(len(y), dtype=torch.float64))
    assert (found.sample_size >= 1 - 1e-6).all()
    assert (found.sample_size <= 128 + 1e-6).all()
    kept = (found.parents == torch.arange(128)).all(-1)[:, :-1]
    assert torch.equal(kept, found.sample_size[:, :-1] > threshold * 128) or threshold == 1.0


def test_a_value_looks_ahead_without_a_bias():
    """Branches chosen for what they are worth are weighed back when it comes."""
    torch.manual_seed(0)
    y, evidence, _ = observed(40)
    y, evidence = y.repeat_interleave(25, 0), evidence.repeat_interleave(25, 0)

    def value(td: TensorDictBase) -> Tensor:
        coming = td["y"].gather(-1, td["t"].clamp_max(STEPS - 1))
        return 0.2 * (coming - KEPT * td["x"]).square().squeeze(-1)

    found = filtered(y, collectors.Systematic(), 128, value=value, leaves=128)
    ratio = (found.log_evidence - evidence).exp()
    assert abs(float(ratio.mean()) - 1) < 4 * float(ratio.std()) / math.sqrt(len(ratio))
    left = 0.2 * (y[:, -1:] - KEPT * found.trajectories["next", "x"][..., -1, 0]).square().double()
    torch.testing.assert_close(found.leaf_log_weights, left - left.exp().mean(-1, keepdim=True).log())


@pytest.mark.parametrize("rule", [collectors.Systematic(threshold=0.5), collectors.KeepBest()], ids=repr)
def test_weights_are_in_the_batch(rule):
    how = {"branches": 4, "leaves": 4, "prune_every": 3, "aggregate": TOTAL, "frames_per_batch": 96}
    score, weighs = collectors.KeyScore("reward", negate=True), isinstance(rule, collectors.Systematic)
    env = collectors.with_rows(Mass(), [3])
    collector = collectors.BeamSearchCollector(env, score=score, rule=rule, **how)
    fake, batch = collector.fake_tensordict(), collector.next()
    key = ("collector", "log_weight")
    assert (key in batch.keys(True, True)) == (key in fake.keys(True, True)) == weighs
    if weighs:
        torch.testing.assert_close(batch[key].exp().mean(1), torch.ones(3, 8))


@pytest.mark.parametrize("rule", [collectors.KeepBest(), collectors.Systematic(0.3), collectors.KeepAll()], ids=repr)
@pytest.mark.parametrize("agents", [None, 2])
@pytest.mark.parametrize("time", ["max", "mean", "sum", "last"])
def test_what_follows_an_end_changes_nothing(rule, agents, time):
    start = collectors.branch(collectors.with_rows(Mass(agents=agents), [20]).reset(), 4)
    group = () if agents is None else ("agents",)

    def policy(td: TensorDictBase) -> TensorDictBase:
        place = td.get((*group, "place"))
        return td.set((*group, "action"), (place.sum(-1, keepdim=True) * 917.0).sin())

    def found(sticky: bool, garbage: float, **how: Any) -> collectors.BeamSearchResult:
        def score(td: TensorDictBase) -> Tensor:
            x, v = td.get((*group, "place")).unbind(-1)
            over = (x - 0.5 * v).abs() > 1.5  # so was the state before
            return torch.where(over, garbage, -td.get((*group, "reward")).squeeze(-1))

        env, noise = Mass(agents=agents, sticky=sticky), torch.full((20, 3), 0.3)
        how |= {"steps": 9, "prune_every": 3, "rule": rule, "noise": noise, "aggregate": whole}
        return collectors.beam_search(env, policy, score, start, **how)

    whole = collectors.Aggregate(time)
    results = [found(sticky, garbage) for sticky in (True, False) for garbage in (0.0, 1e4, -1e4)]
    for one in results[1:]:
        for name in ("scores", "totals", "parents", "slots", "alive"):
            assert torch.equal(getattr(one, name), getattr(results[0], name)), name
    alive = results[0].alive
    assert not alive.all()
    assert (alive[..., 1:] <= alive[..., :-1]).all()
    assert found(True, 1e4, until_done=False).scores.max() == 1e4


def test_a_value_is_zero_where_all_have_terminated_one_after_the_other():
    """Agent 0 is out after step 1 and in again after step 2, when agent 1 is out."""
    start = collectors.branch(collectors.with_rows(Mass(agents=2), [1]).reset(), 1)
    start["agents", "place"] = torch.tensor([[[[1.4, 0.7], [1.0, 0.6]]]])

    def policy(td: TensorDictBase) -> TensorDictBase:
        return td.set(("agents", "action"), torch.tensor([[-1.0], [0.0]]).expand(*td.shape, 2, 1))

    how: dict[str, Any] = {"steps": 3, "prune_every": 3, "value": lambda td: torch.full(td.shape, 5.0)}
    score = collectors.KeyScore(("agents", "reward"))
    each = [Mass(agents=2, sticky=sticky, limit=1.45) for sticky in (False, True)]
    for every in (1, 2, 3):
        apart = {**how, "prune_every": every, "accumulate": True}
        for env in each:
            found = collectors.beam_search(env, policy, score, start, **apart)
            torch.testing.assert_close(found.leaf_costs, found.leaf_totals.sum(-2))
    start = collectors.branch(collectors.with_rows(Mass(limit=0.6), [9]).reset(), 4)
    score, how = collectors.KeyScore("reward"), {**how, "prune_every": 1, "accumulate": True}
    found = collectors.beam_search(Mass(limit=0.6), hashed, score, start, **how)
    ended = found.trajectories["next", "terminated"].any(-2).squeeze(-1)  # whose values are copied with them
    torch.testing.assert_close(found.leaf_costs, found.leaf_totals.sum(-2) + torch.where(ended, 0.0, 5.0))


def test_ends_change_nothing_where_they_are_not_to():
    """Neither a start that is done nor a step that is leaves anything out."""
    score, rows = collectors.KeyScore("reward", negate=True), collectors.with_rows(Mass(limit=0.6), [5])
    here = collectors.branch(rows.reset(), 4)
    how: dict[str, Any] = {"steps": 4, "prune_every": 2, "prune_last": False, "value": lambda td: td["place"].sum(-1)}
    starts = here, here.clone().set("done", torch.ones_like(here["done"]))
    found = [collectors.beam_search(Mass(), hashed, score, each, until_done=False, **how) for each in starts]
    assert torch.equal(found[0].parents, found[1].parents)
    assert torch.equal(found[0].leaf_costs, found[1].leaf_costs)
    how = {"branches": 2, "frames_per_batch": 40, "until_done": False}
    batch = collectors.BeamSearchCollector(rows, hashed, score=score, **how).next()
    assert batch["next", "done"].any()
    assert batch["collector", "mask"].all()


@pytest.mark.parametrize("threshold", [1.0, 0.0])
def test_a_total_that_is_not_a_number_weighs_nothing(threshold):
    start = collectors.branch(collectors.with_rows(Mass(limit=9.0), [3]).reset(), 4)

    def score(td: TensorDictBase) -> Tensor:
        return torch.where(torch.arange(4) > 0, -td["reward"][..., 0], torch.nan)

    how = {"rule": collectors.Systematic(threshold=threshold), "noise": torch.rand(3, 3), "aggregate": TOTAL}
    found = collectors.beam_search(Mass(limit=9.0), hashed, score, start, steps=3, prune_every=1, **how)
    assert all(part.isfinite().all() for part in (found.log_evidence, found.sample_size, found.leaf_log_weights))


@given(st.integers(1, 6), st.integers(0, 1000))
def test_a_total_is_that_of_the_steps_that_count(length, seed):
    scores = torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(seed))
    alive = (torch.arange(6) < length)[:, None].expand(3, 6, 1)
    for time in ("max", "mean", "sum", "last"):
        for agents in ("sum", "max", "mean"):
            whole = collectors.Aggregate(time, agents)
            torch.testing.assert_close(whole(scores, alive), whole(scores[:, :length]))


NUMBERS = st.floats(-1e3, 1e3, width=32)
ODD = NUMBERS | st.sampled_from([math.inf, -math.inf, math.nan, 0.0])
NOISE = st.floats(0, 1, exclude_max=True)


@given(st.lists(ODD, min_size=1, max_size=17), st.floats(0.01, 1.0))
def test_keep_best_keeps_the_lowest(totals, fraction):
    """Against sorting in Python: NaN last, ties by slot; copies differ by one at most."""
    parents = collectors.KeepBest(fraction)(torch.tensor([totals]))[0].tolist()
    ranked = sorted(range(len(totals)), key=lambda i: (math.isnan(totals[i]), totals[i], i))
    kept = ranked[: max(1, math.ceil(fraction * len(totals) - 1e-9))]
    assert parents == [kept[i % len(kept)] for i in range(len(totals))]


@given(st.lists(ODD, min_size=1, max_size=12), NOISE, st.floats(0.01, 100))
def test_copies_are_proportional(totals, noise, temperature):
    """A branch of weight w gets S w copies, rounded; the best that goes on is in slot 0."""
    given_totals = torch.tensor([totals])
    parents = collectors.Systematic(temperature)(given_totals, torch.tensor([noise]).double())[0]
    counts = torch.bincount(parents, minlength=len(totals))
    assert len(counts) == len(totals)
    if all(map(math.isfinite, totals)):
        share = len(totals) * torch.softmax(-given_totals[0].double() / temperature, 0)
        assert (counts >= (share - 1e-6).floor()).all()
        assert (counts <= (share + 1e-6).ceil()).all()
        assert (given_totals[0][parents].diff() >= 0).all()
    finite = {i for i, total in enumerate(totals) if total < math.inf}
    assert not finite or set(parents.tolist()) <= finite


def test_systematic_of_equals_keeps_all():
    everything = torch.arange(6).expand(3, 6)
    for value in (0.0, 3.0, math.inf, math.nan):
        found = collectors.Systematic()(torch.full((3, 6), value), torch.tensor([0.001, 0.5, 0.999]))
        assert torch.equal(found, everything)
    assert torch.equal(collectors.KeepAll()(torch.rand(3, 6)), everything)


def replaced(totals, threshold, noise, groups):
    """Return what :class:`ReplaceBad` should do, slot by slot."""
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


BRANCHES = st.lists(st.tuples(ODD, st.integers(-2, 2)), min_size=1, max_size=12)


@given(BRANCHES, ODD.filter(lambda x: not math.isnan(x)), NOISE, st.booleans())
def test_replace_bad_by_hand(branches, threshold, noise, grouped):
    totals, groups = map(list, zip(*branches, strict=True))
    totals, threshold = torch.tensor([totals]), float(torch.tensor(threshold))
    given_groups = torch.tensor([groups]) if grouped else None
    numbers = torch.tensor([noise], dtype=torch.float64)
    parents = checked(collectors.ReplaceBad(threshold), totals, numbers, groups=given_groups)
    groups = groups if grouped else [0] * len(groups)
    assert parents[0].tolist() == replaced(totals[0].tolist(), threshold, noise, groups)


def test_bad_parameters_are_errors():
    best, systematic, replace = collectors.KeepBest, collectors.Systematic, collectors.ReplaceBad
    for rule, value in ((best, 0.0), (best, 1.1), (best, math.nan), (systematic, 0.0), (replace, math.nan)):
        with pytest.raises(ValueError, match=r"fraction|temperature|threshold"):
            rule(value)


class Groups(EnvBase):
    """Cars and walkers that count their steps; each ends, by itself, beyond a limit of its own."""

    batch_locked = False

    def __init__(self, **limits: list[float]) -> None:
        super().__init__()
        self.limits = {name: torch.tensor(limit)[:, None] for name, limit in limits.items()}

        def spec(*names: str, flag: bool = False) -> Composite:
            def made(n: int) -> Any:
                return Binary(1, shape=(n, 1), dtype=torch.bool) if flag else Unbounded((n, 1))

            sizes = {group: len(limit) for group, limit in limits.items()}
            return Composite({k: Composite({name: made(n) for name in names}, shape=(n,)) for k, n in sizes.items()})

        self.observation_spec, self.state_spec, self.action_spec = spec("place"), spec("place"), spec("action")
        self.reward_spec, self.done_spec = spec("reward"), spec("done", "terminated", flag=True)

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _at(self, places: dict[str, Tensor], shape: Any) -> TensorDict:
        found = TensorDict(batch_size=shape)
        for group, place in places.items():
            over = place > self.limits[group]
            found[group] = TensorDict({"place": place, "done": over, "terminated": over.clone()}, place.shape[:-1])
        return found

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        shape = torch.Size() if tensordict is None else tensordict.shape
        return self._at({name: torch.zeros(*shape, *limit.shape) for name, limit in self.limits.items()}, shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        found = self._at({name: tensordict[name, "place"] + 1 for name in self.limits}, tensordict.shape)
        for name in self.limits:
            found[name, "reward"] = torch.ones_like(found[name, "place"])
        return found


@pytest.mark.parametrize("walkers", [[9.0, 9.0], [9.0, 1.0], [9.0, 1.0, 9.0], [1.0, 1.0, 1.0]])
def test_ends_in_one_group_change_nothing_in_another(walkers):
    """Scores of all groups end with their agents, those of one alone go on while anybody does."""
    env = Groups(cars=[9.0, 3.0], walkers=walkers)

    def idle(td: TensorDictBase) -> TensorDictBase:
        for name, limit in env.limits.items():
            td.set((name, "action"), torch.zeros(*td.shape, *limit.shape))
        return td

    def everyone(td: TensorDictBase) -> Tensor:
        return torch.cat([td[name, "reward"] for name in env.limits], -2).squeeze(-1)

    how: dict[str, Any] = {"steps": 6, "prune_every": 3, "rule": collectors.KeepAll()}
    start = collectors.branch(env.reset().unsqueeze(0), 2)
    found = collectors.beam_search(env, idle, everyone, start, **how)
    ends = torch.tensor([9.0, 3.0, *walkers])
    expected = (torch.arange(6)[:, None] <= ends).float()
    assert torch.equal(found.scores, expected.expand(1, 2, 6, -1))
    alone = collectors.beam_search(env, idle, collectors.KeyScore(("cars", "reward")), start, **how)
    assert torch.equal(alone.scores, torch.ones(1, 2, 6, 2))
