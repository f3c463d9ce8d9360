"""Draws: counter-based numbers, and displacements that a vehicle can drive."""

from __future__ import annotations

import math

import pytest
import scipy
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from symphony import keys
from symphony.config import AgentConfig, AgentSpec
from symphony.envs import Displacement
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES
from symphony.errors import ConfigError
from symphony.geometry.frames import wrap
from symphony.keys import NOISE, OBJECTS, OBJECTS_MASK, OWN, POINTS, POINTS_MASK, STATE, STEP, VALID
from symphony.modules import BoundedDisplacement, DisplacementHistogram, ElementGroup, displacement_policy
from symphony.modules.bounded import INSIDE, LEAST, SMOOTH, displaced, inverse_cdf, shares
from symphony.modules.policy import SeededNoise
from symphony.streams import Stream, fold_in, stream_of, uniform

MASK = 2**64 - 1
int64 = st.integers(-(2**63), 2**63 - 1)
STREAM = -8660814866712981800  # of the name ``a segment``


def splitmix(state: int) -> int:
    """The finaliser of SplitMix64 on Python's unbounded integers."""
    state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & MASK
    return state ^ (state >> 31)


def folded(stream: int, index: int) -> int:
    return splitmix((stream + (index + 1) * 0x9E3779B97F4A7C15) & MASK)


@pytest.mark.parametrize("numbers", [0, 2])
def test_the_pace_of_an_agent_lasts_for_a_rollout_and_draws_stay_uniform(numbers):
    steps, share = 40, 0.3
    start = TensorDict({keys.STREAM: torch.arange(400)[:, None]}, [400])
    start.set(VALID, torch.ones(400, 2, dtype=torch.bool))

    def drawn(pace: float) -> Tensor:
        noise = SeededNoise(3, numbers, pace)
        each = [noise(start.set(STEP, torch.full((400, 1), t))).get(NOISE) for t in range(steps)]
        return torch.stack(each, -1).reshape(400, 2, -1, steps)

    alone, lasting = drawn(0.0), drawn(share)
    assert torch.equal(lasting[:, :, 1:], alone[:, :, 1:])
    level = torch.linspace(0.1, 0.9, 9)
    assert (lasting[:, :, 0].flatten().quantile(level) - level).abs().max() < 0.03
    mean = torch.special.ndtri(lasting[:, :, 0].double()).mean(-1)
    assert float(mean.var()) == pytest.approx(share + (1 - share) / steps, abs=0.06)
    assert abs(float((mean[:, 0] * mean[:, 1]).mean())) < 0.05


def test_the_hash_is_splitmix64():
    # First output of the reference generator for state 0.
    assert folded(0, 0) == int(fold_in(torch.tensor(0), 0)) & MASK == 0xE220A8397B1DCDAF


@given(seed=int64, stream=int64, step=st.integers(0, 2**40))
def test_tensor_arithmetic_equals_unbounded_integers(seed, stream, step):
    bits = folded(folded(splitmix(seed & MASK), stream), step)
    tensor = torch.tensor([stream])
    assert uniform(seed, tensor, step).item() == (2 * (bits >> 41) + 1) * 2.0**-24


def test_streams_keep_the_numbers_that_rollouts_were_made_with_in_every_process():
    first = 1 << 40
    kept = {"GOALS": 0, "PRUNING": 1, "PLANNERS": 3, "WALKS": 5, "ENTRIES": 6, "PACE": 7, "BACKTRACKING": first}
    assert {stream.name: stream - first for stream in Stream} == kept
    assert stream_of("a segment") == STREAM != stream_of("a segment ")
    assert -(2**63) <= STREAM < 2**63


def test_a_draw_inverts_the_cumulative_distribution():
    logits = torch.randn(50, 9, dtype=torch.float64)
    upper = logits.softmax(-1).cumsum(-1)
    lower = upper - logits.softmax(-1)
    for share in (0.01, 0.5, 0.99):
        drawn = inverse_cdf(logits[:, None].expand(50, 9, 9), lower + share * (upper - lower))
        assert torch.equal(drawn, torch.arange(9).expand(50, 9))


@pytest.mark.parametrize("noise", [0.0, 2.0**-24, 0.5, 1 - 2.0**-24, 1.0])
def test_impossible_categories_are_never_drawn(noise):
    torch.manual_seed(0)
    logits, allowed = torch.randn(2000, 12), torch.rand(2000, 12) < 0.4
    allowed[:, 5] = True
    drawn = inverse_cdf(logits.masked_fill(~allowed, -torch.inf), torch.full((2000,), noise))
    assert allowed.gather(1, drawn[:, None]).all()


NAMES = ((OBJECTS, OBJECTS_MASK, OBJECT_FEATURES), (POINTS, POINTS_MASK, POINT_FEATURES))
GROUPS = tuple(ElementGroup(*names) for names in NAMES)
DT, ACCELERATION, LATERAL, SLOPE = 0.2, 4.0, 6.0, 0.3
REACH = ACCELERATION * DT**2
INNER = INSIDE / math.sqrt(1 - INSIDE**2)
"""The Gaussian number that lies at INSIDE the bounds."""


def double(*values):
    return [torch.tensor(v, dtype=torch.float64) for v in values]


def make(pace=2.0, slope=0.1, loc=(0.0, 0.0), scale=(1.0, 1.0), dtype=torch.float64):
    parts = (torch.tensor(v, dtype=dtype) for v in (loc, scale, pace, slope))
    return BoundedDisplacement(*parts, REACH)


def policy(seed=0, **kwargs):
    torch.manual_seed(seed)
    return displacement_policy(SELF_FEATURES, GROUPS, **{"dt": 0.2, "hidden": 16, "head": (16,), **kwargs})


@settings(max_examples=25)
@given(st.floats(0, 8), st.floats(0.005, 0.3), *[st.floats(-0.99 * INNER, 0.99 * INNER)] * 2)
def test_latent_numbers_come_back(pace, slope, first, second):
    dist, u = make(pace, slope), double([first, second])[0]
    torch.testing.assert_close(dist.latent(dist.displacement(u)), u, rtol=1e-6, atol=1e-6)


@settings(max_examples=25)
@given(st.floats(0, 8), st.floats(0.005, 0.3), st.floats(-30, 30), st.floats(-30, 30))
def test_whatever_was_logged_has_a_likelihood(pace, slope, forward, left):
    """Also reversing, sliding sideways and jumps: that of the nearest displacement that is possible."""
    dist, value = make(pace, slope), double([forward, left])[0]
    assert dist.latent(value).abs().max() <= INNER + 1e-9
    assert dist.log_prob(value).isfinite()
    nearest = dist.displacement(dist.latent(value))
    torch.testing.assert_close(dist.log_prob(value), dist.log_prob(nearest), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("pace", [0.0, 0.1, 3.0])
def test_the_density_integrates_to_one(pace):
    dist = make(pace, 0.2, (0.3, -0.2), (0.4, 0.5))
    low, high = (float(dist.displacement(double([u, 0.0])[0])[0]) for u in (-1e6, 1e6))
    edges = torch.linspace(low, high, 2001, dtype=torch.float64)
    forward, share = (edges[1:] + edges[:-1]) / 2, (torch.arange(200, dtype=torch.float64) + 0.5) / 100 - 1
    forward, share = forward[:, None], share[None]
    value = torch.stack(torch.broadcast_tensors(forward, forward * 0.2 * share), -1)
    cell = (high - low) / 2000 * forward * 0.2 * 0.01
    assert (dist.log_prob(value).exp() * cell).sum() == pytest.approx(1.0, abs=2e-3)


def test_gradients_by_differences():
    u, pace, slope = double([[0.3, -0.7], [-2.0, 4.0], [0.0, 0.0]], [2.0, 0.0, 0.15], [0.1, 0.3, 0.2])
    scale = torch.full_like(u, 0.8)
    for value in (u, pace, slope, scale):
        value.requires_grad_()

    def dist(*parts):
        return BoundedDisplacement(*parts, REACH)

    def drawn(*parts):
        torch.manual_seed(0)
        return dist(*parts).rsample((2,))

    noise = torch.rand(3, 2, dtype=torch.float64)
    parts = (u, scale, pace, slope)
    assert torch.autograd.gradcheck(lambda u, p, s: dist(u, scale, p, s).displacement(u), (u, pace, slope))
    assert torch.autograd.gradcheck(lambda *p: dist(*p).icdf(noise), parts)
    assert torch.autograd.gradcheck(drawn, parts)
    inside = dist(*parts).displacement(u.detach().clamp(-2.5, 2.5)).detach()
    assert torch.autograd.gradcheck(lambda *p: dist(*p).log_prob(inside), parts)


@pytest.mark.parametrize("how", ["rsample", "sample", "icdf"])
def test_draws_are_those_of_the_gaussian(how):
    torch.manual_seed(0)
    dist = make(3.0, 0.1, (0.2, -0.3), (0.4, 0.6))
    noise = torch.rand(20000, 2, dtype=torch.float64)
    drawn = dist.icdf(noise) if how == "icdf" else getattr(dist, how)((20000,))
    for k in range(2):
        u = dist.latent(drawn)[:, k]
        standard = (u - dist.loc[k]) / dist.scale[k]
        away = torch.special.ndtr(standard.detach().sort().values) - (torch.arange(20000) + 0.5) / 20000
        assert scipy.special.kolmogorov(20000**0.5 * float(away.abs().max())) > 1e-3
        assert (u < dist.loc[k]).double().mean() == pytest.approx(0.5, abs=0.02)
    ends = torch.tensor([[2.0**-24, 1 - 2.0**-24]])
    assert make(dtype=torch.float32).icdf(ends).isfinite().all()
    across = drawn[:, 1] / drawn[:, 0]
    ranks = [values.argsort().argsort().double() for values in (drawn[:, 0], across)]
    assert abs(torch.corrcoef(torch.stack(ranks))[0, 1]) < 0.03


numbers = st.floats(-1e6, 1e6, width=32)


@settings(max_examples=30)
@given(speed=st.floats(0, 40), length=st.floats(1.0, 15.0), first=numbers, second=numbers)
def test_every_draw_can_be_driven(speed, length, first, second):
    """Bounds on speed, acceleration and lateral acceleration hold for any output of the network."""
    generator = torch.Generator().manual_seed(0)
    td = TensorDict({VALID: torch.ones(1, 1, dtype=torch.bool)}, [1])
    sizes = {OWN: (SELF_FEATURES,), STATE: (4,), OBJECTS: (5, OBJECT_FEATURES), POINTS: (40, POINT_FEATURES)}
    for key, size in sizes.items():
        td[key] = torch.rand(1, 1, *size, generator=generator)
    for key, mask, _ in NAMES:
        td[mask] = td[key][..., 0] < 0.7
    td[OWN][..., 1] = length / 5.0
    td[STATE][..., 3] = speed
    dist, state = policy().get_dist(td), td[STATE]
    action = dist.displacement(torch.tensor([[[first, second]]]))
    forward, left = action.unbind(-1)
    assert action.isfinite().all()
    assert (forward > 0).all()
    assert (left.abs() <= SLOPE * forward * (1 + 1e-6)).all()
    assert (forward / DT - speed).abs().max() <= ACCELERATION * DT + 0.5 * SMOOTH / DT + 1e-4
    after = Displacement().step(state, action, torch.tensor([[[length, 2.0]]]), DT)
    gained = after[..., 3] - state[..., 3]
    assert gained.min() >= -ACCELERATION * DT - 1e-4
    # The way there is longer than its part straight ahead.
    fastest = speed + ACCELERATION * DT + 0.5 * SMOOTH / DT
    assert (after[..., 3] <= fastest * (1 + dist.slope.square()).sqrt() + 1e-4).all()
    distance = action.norm(dim=-1)
    curvature = wrap(after[..., 2] - state[..., 2]).abs() / distance
    # Where the car hardly turns, the turn is a difference of headings that rounding swamps.
    rounding = 1e-6 / distance
    assert ((curvature - rounding) * speed**2 <= LATERAL * (1 + 1e-3)).all()


def test_bad_bounds_and_cells_are_refused():
    for value in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="dt must be positive"):
            policy(dt=value)
    for cells in (-1, 1, 4):
        with pytest.raises(ValueError, match="cells must be odd"):
            policy(cells=cells)
    with pytest.raises(ConfigError, match="cells are of displacements"):
        AgentSpec(action_space="bicycle", dt=DT, agent=AgentConfig(cells=5))


F, L = 5, 7


def histogram(*batch, seed=0, logits=None, pace=2.0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    drawn = 3 * torch.rand((*batch, F * L), generator=generator, dtype=dtype)
    logits = drawn if logits is None else torch.as_tensor(logits, dtype=dtype).expand(*batch, F * L)
    bounds = (torch.full(batch, value, dtype=dtype) for value in (pace, 0.2))
    return DisplacementHistogram(logits, *bounds, REACH, F)


@pytest.mark.parametrize("pace", [0.05, 2.0])
def test_the_density_integrates_to_one_and_is_that_of_the_draws(pace):
    dist = histogram(pace=pace)
    low, high = (displaced(torch.tensor([g, 0.0]).double(), dist.pace, dist.slope, REACH)[0] for g in (-1, 1))
    # What is slower counts as standing.
    low = low.clamp_min(LEAST)
    forward = low + (high - low) * (torch.arange(4000).double() + 0.5) / 4000
    cell = (forward[1] - forward[0]) * forward[:, None] * dist.slope * 0.005
    side = ((torch.arange(400).double() + 0.5) / 200 - 1)[None]
    value = torch.stack(torch.broadcast_tensors(forward[:, None], forward[:, None] * dist.slope * side), -1)
    mass = dist.log_prob(value).exp() * cell
    torch.manual_seed(0)
    drawn = dist.sample((100_000,))
    stands = (drawn[:, 0] < LEAST).double().mean()
    assert mass.sum() + stands == pytest.approx(1.0, abs=5e-3)
    expected = (mass[..., None] * value).sum((0, 1))
    torch.testing.assert_close(drawn[drawn[:, 0] >= LEAST].sum(0) / len(drawn), expected, rtol=0, atol=5e-3)


SHARES = st.tuples(*[st.floats(2**-24, 1 - 2**-24)] * 2)


@settings(max_examples=30)
@given(st.lists(st.floats(-80, 80), min_size=F * L, max_size=F * L), SHARES, st.floats(0, 8))
def test_any_numbers_give_a_displacement(logits, inside, pace):
    for dtype in (torch.float32, torch.float64):
        dist = histogram(logits=logits, pace=pace, dtype=dtype)
        drawn = dist.icdf(torch.tensor(inside, dtype=dtype))
        assert drawn.isfinite().all()
        assert dist.log_prob(drawn).isfinite()
        assert 0 <= drawn[0] <= pace + REACH + 0.02
        assert drawn[1].abs() <= 0.2001 * drawn[0]


def test_gradients_by_differences_of_histogram():
    dist, noise = histogram(4), torch.rand(4, 2, generator=torch.Generator().manual_seed(1)).double()
    logits, pace, slope = (value.requires_grad_() for value in (dist.logits, dist.pace, dist.slope))
    inside = dist.icdf(noise).detach()

    def likelihood(*parts):
        return DisplacementHistogram(*parts, REACH, F).log_prob(inside)

    assert torch.autograd.gradcheck(likelihood, (logits, pace, slope))
    mean_share = lambda x: DisplacementHistogram(x, pace, slope, REACH, F).mean_share  # noqa: E731
    assert torch.autograd.gradcheck(mean_share, logits)


def test_a_draw_moves_with_the_mean_and_is_the_same_with_a_gradient():
    dist, noise = histogram(6), torch.rand(6, 2).double()
    without = dist.icdf(noise)
    dist.logits.requires_grad_()
    drawn = dist.icdf(noise)
    assert torch.equal(drawn, without)
    mean, share = dist.mean_share, shares(without, dist.pace, dist.slope, REACH).requires_grad_()
    (expected,) = torch.autograd.grad(displaced(share, dist.pace, dist.slope, REACH).sum(), share)
    (by_mean,) = torch.autograd.grad((mean * expected).sum(), dist.logits, retain_graph=True)
    (found,) = torch.autograd.grad(drawn.sum(), dist.logits)
    torch.testing.assert_close(found, by_mean)
    assert found.norm() > 0
