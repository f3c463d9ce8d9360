"""Displacements drawn from a histogram."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from symphony.config import AgentConfig, AgentSpec
from symphony.errors import ConfigError
from symphony.keys import ACTION, NOISE, STATE, VALID
from symphony.modules import DisplacementHistogram
from symphony.modules.bounded import LEAST, displaced, shares
from symphony.objectives import BCLoss
from symphony.streams import uniform
from test_modules_displacement import DT, REACH, SLOPE, observed, policy

F, L = 5, 7


def histogram(*batch, seed=0, logits=None, pace=2.0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    drawn = 3 * torch.rand((*batch, F * L), generator=generator, dtype=dtype)
    logits = drawn if logits is None else torch.as_tensor(logits, dtype=dtype).expand(*batch, F * L)
    bounds = (torch.full(batch, value, dtype=dtype) for value in (pace, 0.2))
    return DisplacementHistogram(logits, *bounds, REACH, F)


def one_cell(number, **kwargs):
    return histogram(logits=[0.0 if i == number else -1e9 for i in range(F * L)], **kwargs)


def test_cells_fill_what_can_be_reached():
    for edges, cells in zip(histogram().edges, (F, L), strict=True):
        assert edges.shape == (cells + 1,)
        assert (edges.diff() > 0).all()
        assert (edges[0], edges[-1]) == (-1, 1)
        torch.testing.assert_close(edges, -edges.flip(0))
        # Dense in the middle, which is one cell about 0.
        assert edges.diff().argmin() == cells // 2


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


def test_draws_lie_in_their_cells_as_often_as_these_are_likely():
    torch.manual_seed(0)
    dist = histogram()
    drawn = dist.icdf(torch.rand(50_000, 2).double())
    share = shares(drawn, dist.pace, dist.slope, REACH)
    number = [torch.bucketize(share[:, k].contiguous(), edges) - 1 for k, edges in enumerate(dist.edges)]
    found = torch.bincount(number[0] * L + number[1], minlength=F * L) / len(drawn)
    torch.testing.assert_close(found.double(), dist.logits.softmax(-1), rtol=0, atol=0.005)
    torch.testing.assert_close(share.mean(0), dist.mean_share, rtol=0, atol=0.01)


@settings(max_examples=40)
@given(st.integers(0, F * L - 1), st.floats(0.01, 0.99), st.floats(0.01, 0.99))
def test_a_draw_is_likeliest_under_its_own_cell(number, first, second):
    drawn = one_cell(number).icdf(torch.tensor([first, second]).double())
    found = torch.stack([one_cell(other).log_prob(drawn) for other in range(F * L)])
    assert found.argmax() == number
    place = one_cell(number).within(torch.tensor(number), torch.tensor([0.5, 0.5]).double())
    torch.testing.assert_close(
        one_cell(number).mode, displaced(place, torch.tensor(2.0), torch.tensor(0.2), REACH).double()
    )


@settings(max_examples=60)
@given(
    st.lists(st.floats(-80, 80), min_size=F * L, max_size=F * L),
    st.floats(2**-24, 1 - 2**-24),
    st.floats(2**-24, 1 - 2**-24),
    st.floats(0, 8),
)
def test_any_numbers_give_a_displacement(logits, first, second, pace):
    for dtype in (torch.float32, torch.float64):
        dist = histogram(logits=logits, pace=pace, dtype=dtype)
        drawn = dist.icdf(torch.tensor([first, second], dtype=dtype))
        assert drawn.isfinite().all()
        assert dist.log_prob(drawn).isfinite()
        assert 0 <= drawn[0] <= pace + REACH + 0.02
        assert drawn[1].abs() <= 0.2001 * drawn[0]


@settings(max_examples=40)
@given(st.floats(0, 8), st.floats(-30, 30), st.floats(-30, 30))
def test_whatever_was_logged_has_a_likelihood(pace, forward, left):
    value = torch.tensor([forward, left]).double()
    assert histogram(pace=pace).log_prob(value).isfinite()


def test_gradients_by_differences():
    dist, noise = histogram(4), torch.rand(4, 2, generator=torch.Generator().manual_seed(1)).double()
    logits, pace, slope = (value.requires_grad_() for value in (dist.logits, dist.pace, dist.slope))
    inside = dist.icdf(noise).detach()

    def likelihood(*parts):
        return DisplacementHistogram(*parts, REACH, F).log_prob(inside)

    assert torch.autograd.gradcheck(likelihood, (logits, pace, slope))
    assert torch.autograd.gradcheck(
        lambda x: DisplacementHistogram(x, pace, slope, REACH, F).mean_share, logits
    )


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


def test_one_that_stands_can_start():
    """At standstill the gradient to drive on is not that of a Gaussian far out: it still moves the draw."""
    dist = histogram(pace=0.0)
    dist.logits.requires_grad_()
    drawn = torch.stack(
        [dist.icdf(torch.tensor([x, 0.5]).double())[0] for x in torch.linspace(0.02, 0.98, 40)]
    )
    (gradient,) = torch.autograd.grad(drawn.mean(), dist.logits)
    by_forward = gradient.unflatten(0, (F, L)).sum(-1)
    assert by_forward[0] < -1e-3
    assert by_forward[-1] > 1e-3


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_shapes(batch):
    dist = histogram().expand(batch)
    assert (dist.batch_shape, dist.event_shape) == (torch.Size(batch), torch.Size([2]))
    drawn = dist.sample((5,))
    assert drawn.shape == (5, *batch, 2)
    assert dist.log_prob(drawn).shape == (5, *batch)
    assert dist.mode.shape == dist.deterministic_sample.shape == (*batch, 2)
    torch.testing.assert_close(dist.log_prob(drawn), histogram().log_prob(drawn))


def test_a_policy_tells_two_manners_apart():
    """Where half of the experts brake and half accelerate, one Gaussian learns to do neither."""
    torch.manual_seed(0)
    td, brakes = observed(120), torch.rand(120, 3) < 0.5
    wanted = torch.stack([torch.where(brakes, -1.0, 1.0), torch.zeros(120, 3)], -1)
    bounds, between, left = policy().get_dist(td.clone()), [], []
    td[ACTION] = bounds.displacement(wanted + 0.1 * torch.randn(120, 3, 2)).detach()
    for cells in (0, 11):
        actor = policy(cells=cells)
        loss, optimizer = BCLoss(actor), torch.optim.Adam(actor.parameters(), lr=0.02)
        for _ in range(75):
            optimizer.zero_grad()
            loss(td)["loss_bc"].backward()
            optimizer.step()
        assert all(p.grad is not None and p.grad.norm() > 0 for p in actor.parameters())
        actions = actor(td.clone().set(NOISE, torch.rand(120, 3, 2)))[ACTION]
        # One that stands does not show whether it brakes.
        fast = td[VALID] & (td[STATE][..., 3] > 2)
        drawn = bounds.latent(actions)[fast][:, 0]
        between.append((drawn.abs() < 0.5).double().mean())
        left.append((drawn < -0.5).double().mean())
    assert between[0] > 0.25
    assert between[1] < 0.1
    assert 0.35 < left[1] < 0.65


def test_actions_can_be_driven():
    actor, td = policy(cells=9), observed(20, points=100)
    td[NOISE] = uniform(0, torch.arange(120).view(20, 3, 2), 0)
    forward, left = actor(td.clone())[ACTION][td[VALID]].detach().unbind(-1)
    speed = td[STATE][td[VALID]][:, 3]
    assert (left.abs() <= SLOPE * forward).all()
    assert (forward / DT - speed).abs().max() <= REACH / DT + 0.1


def test_padded_agents_change_nothing():
    actor, td = policy(cells=5), observed(8)
    td[ACTION] = actor(td.clone())[ACTION].detach()
    dirty, absent = td.clone(), ~td[VALID]
    dirty[STATE][absent] = dirty[ACTION][absent] = torch.nan
    results = []
    for batch in (td, dirty):
        out = BCLoss(actor)(batch)["loss_bc"]
        results.append([out, *torch.autograd.grad(out, list(actor.parameters()))])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("cells", [-1, 1, 4])
def test_a_number_of_cells_without_a_middle_and_sides_is_refused(cells):
    with pytest.raises(ValueError, match="cells must be odd"):
        policy(cells=cells)


def test_cells_are_of_displacements():
    with pytest.raises(ConfigError, match="cells are of displacements"):
        AgentSpec(action_space="bicycle", dt=DT, agent=AgentConfig(cells=5))
