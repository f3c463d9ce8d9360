"""Displacements a vehicle can drive: the distribution, and the policy that draws from it."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch.distributions import Normal
from torchrl.envs.utils import ExplorationType, set_exploration_type

from helpers_segments import crossing
from symphony.envs import Displacement, DrivingEnv, ObservationConfig, collate, scene
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES
from symphony.geometry.frames import rotate, wrap
from symphony.keys import ACTION, NOISE, OBJECTS, OBJECTS_MASK, OWN, POINTS, POINTS_MASK, STATE, VALID
from symphony.modules import BoundedDisplacement, ElementGroup, SeededNoise, displacement_policy
from symphony.modules.bounded import INSIDE, SMOOTH
from symphony.modules.displacement import _Parameters
from symphony.objectives import BCLoss
from test_env import moved

GROUPS = (
    ElementGroup(OBJECTS, OBJECTS_MASK, OBJECT_FEATURES),
    ElementGroup(POINTS, POINTS_MASK, POINT_FEATURES),
)
DT, ACCELERATION, LATERAL, SLOPE = 0.2, 4.0, 6.0, 0.3
REACH = ACCELERATION * DT**2
INNER = INSIDE / math.sqrt(1 - INSIDE**2)
"""The Gaussian number that lies at INSIDE the bounds."""


def double(*values):
    return [torch.tensor(v, dtype=torch.float64) for v in values]


def make(pace=2.0, slope=0.1, loc=(0.0, 0.0), scale=(1.0, 1.0), dtype=torch.float64):
    parts = (torch.tensor(v, dtype=dtype) for v in (loc, scale, pace, slope))
    return BoundedDisplacement(*parts, REACH)


def given_bounds(law):
    paces, slopes, inner = st.floats(0, 8), st.floats(0.005, 0.3), st.floats(-0.99 * INNER, 0.99 * INNER)
    return settings(max_examples=40)(given(paces, slopes, inner, inner)(law))


def observed(*batch, agents=3, seed=0, points=40):
    generator = torch.Generator().manual_seed(seed)

    def rand(*size):
        return torch.rand(*batch, agents, *size, generator=generator)

    td = TensorDict(batch_size=batch)
    td[OWN] = rand(SELF_FEATURES) + 0.5
    td[STATE] = torch.cat([40 * rand(2) - 20, 6 * rand(1) - 3, 20 * rand(1)], -1)
    td[OBJECTS], td[OBJECTS_MASK] = rand(5, OBJECT_FEATURES) - 0.5, rand(5) < 0.7
    td[POINTS], td[POINTS_MASK] = rand(points, POINT_FEATURES) - 0.5, rand(points) < 0.7
    td[VALID] = rand() < 0.8
    td[VALID][..., 0] = True
    return td


def policy(seed=0, **kwargs):
    torch.manual_seed(seed)
    return displacement_policy(SELF_FEATURES, GROUPS, **{"dt": 0.2, "hidden": 16, "head": (16,), **kwargs})


@given_bounds
def test_latent_numbers_come_back(pace, slope, first, second):
    dist, u = make(pace, slope), double([first, second])[0]
    torch.testing.assert_close(dist.latent(dist.displacement(u)), u, rtol=1e-6, atol=1e-6)


@given_bounds
def test_displacements_within_the_bounds_come_back(pace, slope, first, second):
    dist = make(pace, slope)
    low, high = (dist.displacement(double([u, 0.0])[0])[0] for u in (-INNER, INNER))
    forward = low + (high - low) * (0.5 + 0.5 * first / INNER)
    wanted = torch.stack([forward, forward * slope * INSIDE * second / INNER])
    got = dist.displacement(dist.latent(wanted))
    torch.testing.assert_close(got, wanted, rtol=1e-6, atol=1e-8)


@settings(max_examples=40)
@given(st.floats(0, 8), st.floats(0.005, 0.3), st.floats(-30, 30), st.floats(-30, 30))
def test_whatever_was_logged_has_a_likelihood(pace, slope, forward, left):
    """Also reversing, sliding sideways and jumps: that of the nearest displacement that is possible."""
    dist, value = make(pace, slope), double([forward, left])[0]
    assert dist.latent(value).abs().max() <= INNER + 1e-9
    assert dist.log_prob(value).isfinite()
    nearest = dist.displacement(dist.latent(value))
    torch.testing.assert_close(dist.log_prob(value), dist.log_prob(nearest), rtol=1e-4, atol=1e-4)


@given_bounds
def test_the_density_is_that_of_the_gaussian_over_the_volume(pace, slope, first, second):
    dist, u = make(pace, slope, (0.3, -0.4), (0.7, 1.5)), double([first, second])[0]
    volume = torch.autograd.functional.jacobian(dist.displacement, u).det().abs()
    expected = Normal(dist.loc, dist.scale).log_prob(u).sum() - volume.log()
    torch.testing.assert_close(dist.log_prob(dist.displacement(u)), expected, rtol=1e-5, atol=1e-5)


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
        assert stats.kstest(standard.detach().numpy(), "norm").pvalue > 1e-3
        assert (u < dist.loc[k]).double().mean() == pytest.approx(0.5, abs=0.02)
    ends = torch.tensor([[2.0**-24, 1 - 2.0**-24]])
    assert make(dtype=torch.float32).icdf(ends).isfinite().all()
    across = drawn[:, 1] / drawn[:, 0]
    assert abs(stats.spearmanr(drawn[:, 0].numpy(), across.numpy()).statistic) < 0.03


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_shapes(batch):
    dist = make().expand(batch)
    assert (dist.batch_shape, dist.event_shape) == (torch.Size(batch), torch.Size([2]))
    assert isinstance(dist, BoundedDisplacement)
    drawn = dist.sample((5,))
    assert drawn.shape == (5, *batch, 2)
    assert dist.log_prob(drawn).shape == (5, *batch)
    assert dist.mode.shape == dist.deterministic_sample.shape == (*batch, 2)
    torch.testing.assert_close(dist.log_prob(drawn), make().log_prob(drawn))
    assert torch.equal(dist.mode, make().mode.expand(*batch, 2))


numbers = st.floats(-1e6, 1e6, width=32)


@settings(max_examples=60)
@given(speed=st.floats(0, 40), length=st.floats(1.0, 15.0), first=numbers, second=numbers)
def test_every_draw_can_be_driven(speed, length, first, second):
    """Bounds on speed, acceleration and lateral acceleration hold for any output of the network."""
    td = observed(1, agents=1)
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


@settings(max_examples=40)
@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_a_standing_car_neither_slides_nor_spins(first, second):
    u, state = torch.tensor([first, second], requires_grad=True), torch.tensor([3.0, 4.0, 0.5, 0.0])
    dist = make(0.0, SLOPE, dtype=torch.float32)
    after = Displacement().step(state, dist.displacement(u), torch.tensor([4.6, 1.9]), DT)
    # What the largest acceleration reaches from standstill, and the turn of a wheel held at the largest angle.
    assert (after[:2] - state[:2]).norm() <= 1.1 * (REACH + SMOOTH)
    assert (after[2] - state[2]).abs() <= SLOPE * (REACH + SMOOTH) / (0.3 * 4.6) + 1e-6
    (gradient,) = torch.autograd.grad(after.sum(), u)
    assert gradient.isfinite().all()
    assert gradient.abs().max() < 10


@pytest.mark.parametrize("steering", [-5.0, 5.0])
def test_a_braking_car_comes_to_rest(steering):
    u, state = torch.tensor([-5.0, steering], requires_grad=True), torch.tensor([0.0, 0.0, 0.0, 6.0])
    path = [state]
    for _ in range(50):
        pace = path[-1][3] * DT
        dist = BoundedDisplacement(u, torch.ones(2), pace, torch.tensor(SLOPE), REACH)
        path.append(Displacement().step(path[-1], dist.mode, torch.tensor([4.6, 1.9]), DT))
    track = torch.stack(path)
    assert (track[1:, 3] >= 0).all()
    assert track[10:, 3].max() < 0.1
    # At rest, with the wheel still held over, for 8 s.
    assert (track[-1, :3] - track[10, :3]).abs().max() < 0.1
    (gradient,) = torch.autograd.grad(track[-1].sum(), u)
    assert gradient.isfinite().all()


def test_exploration_type_decides_how_actions_are_drawn():
    actor, td = policy(), observed(200)
    modes = actor.get_dist(td.clone()).mode
    for kind in (InteractionType.DETERMINISTIC, InteractionType.MODE):
        with set_interaction_type(kind):
            assert torch.equal(actor(td.clone())[ACTION], modes)
            assert torch.equal(actor(td.clone().set(NOISE, torch.rand(200, 3, 2)))[ACTION], modes)
    noise = torch.rand(200, 3, 2)
    for kind in (ExplorationType.RANDOM, None):
        with set_exploration_type(kind):
            drawn = actor(td.clone().set(NOISE, noise))[ACTION]
            assert torch.equal(drawn, actor.get_dist(td.clone()).icdf(noise))
            torch.manual_seed(5)
            first, second = (actor(td.clone())[ACTION] for _ in range(2))
            assert not torch.equal(first, second)
            torch.manual_seed(5)
            assert torch.equal(actor(td.clone())[ACTION], first)


@pytest.mark.parametrize("angle", [0.7, -2.5])
def test_turning_the_world_changes_nothing(angle):
    segment, turn, shift = crossing(seed=2, steps=12), torch.tensor(angle), torch.tensor([30.0, -12.0])
    actor, tracks, actions = policy(), [], []
    sees = ObservationConfig(num_objects=5, num_points=40)
    for world in (segment, moved(segment, angle, 30.0, -12.0)):
        env = DrivingEnv(collate([scene(world, [0, 1, 2])]), Displacement(), sees)
        now, draw = env.start(torch.tensor([0])), SeededNoise(3, env.dynamics.numbers)
        with torch.no_grad():
            for _ in range(8):
                now = env.step(actor(draw(now)))["next"]
        tracks.append(now[STATE])
        actions.append(actor(draw(now))[ACTION])
    torch.testing.assert_close(actions[0], actions[1], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(
        rotate(tracks[0][..., :2], turn) + shift, tracks[1][..., :2], rtol=0, atol=5e-3
    )
    assert wrap(tracks[0][..., 2] + turn - tracks[1][..., 2]).abs().max() < 2e-3


def test_padded_agents_change_nothing():
    actor, td = policy(), observed(8)
    td[ACTION] = actor(td.clone())[ACTION].detach()
    dirty, absent = td.clone(), ~td[VALID]
    assert absent.any()
    for key in (OWN, STATE, POINTS, OBJECTS, ACTION):
        dirty[key][absent] = torch.nan
    results = []
    for batch in (td, dirty):
        out = BCLoss(actor)(batch)["loss_bc"]
        results.append([out, *torch.autograd.grad(out, list(actor.parameters()))])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


def test_regression_to_the_log_reaches_every_parameter():
    actor, td = policy(), observed(40)
    # The bounds depend on the state alone, so that these numbers are what the network has to learn.
    wanted = td[OWN][..., [0, 2]] - 1
    td[ACTION] = actor.get_dist(td.clone()).displacement(wanted).detach()
    loss = BCLoss(actor)
    first = loss(td)["loss_bc"]
    first.backward()
    assert all(p.grad is not None and p.grad.norm() > 0 for p in actor.parameters())
    optimizer = torch.optim.Adam(actor.parameters(), lr=0.02)
    for _ in range(40):
        optimizer.zero_grad()
        last = loss(td)["loss_bc"]
        last.backward()
        optimizer.step()
    assert last < first - 1
    before, after = (
        (a.get_dist(td.clone()).loc - wanted)[td[VALID]].square().mean() for a in (policy(), actor)
    )
    assert after < 0.3 * before


def test_weights_follow_the_seed_and_can_be_kept():
    td = observed(4).set(NOISE, torch.rand(4, 3, 2))
    actor, other = policy(), policy(seed=1)
    assert all(torch.equal(a, b) for a, b in zip(actor.parameters(), policy().parameters(), strict=True))
    assert not torch.equal(actor(td.clone())[ACTION], other(td.clone())[ACTION])
    other.load_state_dict(actor.state_dict())
    assert torch.equal(actor(td.clone())[ACTION], other(td.clone())[ACTION])


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_shapes_and_keys_are_free(batch):
    names = {OWN: "own", VALID: "ok", STATE: "where", NOISE: "u"}
    renamed = {"own_keys": ("own",), "valid_key": "ok", "state_key": "where", "noise_key": "u"}
    td = observed(*batch).set(NOISE, torch.rand(*batch, 3, 2))
    expected = policy()(td.clone())[ACTION]
    assert (expected.shape, expected.dtype) == ((*batch, 3, 2), torch.float32)
    for old, new in names.items():
        td.rename_key_(old, new)
    assert torch.equal(policy(**renamed, action_key="a")(td)["a"], expected)


@pytest.mark.parametrize("name", ["dt", "max_acceleration", "max_lateral", "max_slope", "min_scale"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_bad_bounds_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        policy(**{name: value})


@given(st.floats(0, 40), st.floats(2, 12))
def test_what_is_offered_turns_no_sharper_than_tyres_hold(speed: float, length: float) -> None:
    slope, lateral, axle = 0.4, 6.0, 0.3
    bounds = _Parameters(3, 0.2, 5.0, 0.1, slope, lateral, axle)
    own, state = torch.tensor([[[0.0, length / 5.0, 0.4, 0.0]]]), torch.tensor([[[0.0, 0.0, 0.0, speed]]])
    _, distance, tangent = bounds(torch.zeros(1, 1, 3), state, own, torch.ones(1, 1, dtype=torch.bool))
    assert distance.item() == pytest.approx(0.2 * speed)
    arm, most = axle * length, tangent.item()
    assert most * speed**2 / arm <= lateral * (1 + 1e-5)
    # Slowly what the wheels can, fast what holds.
    expected = min(slope, lateral * arm / max(speed, 1e-6) ** 2)
    assert expected / math.sqrt(2) - 1e-6 <= most <= expected + 1e-6
    assert most == pytest.approx(slope, rel=1e-3) or speed > 0.5
