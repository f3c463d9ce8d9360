"""Laws of the motion models."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from symphony.envs import dynamics as module
from symphony.envs.dynamics import Bicycle, Displacement, bicycle_step, displacement_step
from symphony.geometry.frames import rotate, wrap

DT, LENGTH = 0.2, torch.tensor(4.6, dtype=torch.float64)


def states(count: int = 64, seed: int = 0) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 4, generator=rng, dtype=torch.float64)
    return torch.stack([100 * unit[:, 0], 100 * unit[:, 1], 6 * unit[:, 2] - 3, 1 + 15 * unit[:, 3]], -1)


def controls(count: int = 64, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    unit = torch.rand(3, count, generator=rng, dtype=torch.float64)
    return 8 * unit[0] - 4, unit[1] - 0.5, 3 + 9 * unit[2]


def test_bicycle_inverse_recovers_the_controls():
    state, (acceleration, steering, length) = states(), controls()
    after = bicycle_step(state, acceleration, steering, length, DT)
    moved = after[:, 3] > 0  # a vehicle that stops within the step loses part of its braking
    got = module.bicycle_inverse(state, after, length, DT)
    torch.testing.assert_close(got[0][moved], acceleration[moved])
    torch.testing.assert_close(got[1][moved], steering[moved])


def test_displacement_inverse_and_forward_are_exact():
    state, other = states(seed=2), states(seed=3)
    action = module.displacement_inverse(state, other)
    torch.testing.assert_close(displacement_step(state, action, LENGTH, DT)[:, :2], other[:, :2])
    back = module.displacement_inverse(state, displacement_step(state, action, LENGTH, DT))
    torch.testing.assert_close(back, action)
    speed = action.norm(dim=-1).where(action[:, 0] > 0, -action.norm(dim=-1)) / DT  # backwards is negative
    torch.testing.assert_close(displacement_step(state, action, LENGTH, DT)[:, 3], speed)


@given(angle=st.floats(-3, 3), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_moving_the_world_moves_the_result(angle, x, y):
    state, (acceleration, steering, length) = states(), controls()
    turn, shift = torch.tensor(angle, dtype=torch.float64), torch.tensor([x, y], dtype=torch.float64)

    def moved(s: torch.Tensor) -> torch.Tensor:
        return torch.cat([rotate(s[:, :2], turn) + shift, s[:, 2:3] + turn, s[:, 3:]], -1)

    step = torch.stack([1 + acceleration.abs(), steering], -1)
    for law, given_ in ((bicycle_step, (acceleration, steering)), (displacement_step, (step,))):
        after = law(moved(state), *given_, length, DT)
        torch.testing.assert_close(after, moved(law(state, *given_, length, DT)))


def test_gradients():
    state, (acceleration, steering, length) = states(4), controls(4)
    inputs = [t.clone().requires_grad_() for t in (state, acceleration, steering)]
    assert torch.autograd.gradcheck(lambda s, a, d: bicycle_step(s, a, d, length, DT), inputs)
    step = torch.tensor([[2.0, 0.1], [0.0, 0.0], [-0.3, 0.02], [0.01, 0.01]], dtype=torch.float64)
    inputs = [state.clone().requires_grad_(), step.requires_grad_()]
    # At exactly zero the speed has a kink; a hair above it the slope is finite.
    inputs[1].data[1] += 1e-3
    assert torch.autograd.gradcheck(lambda s, d: displacement_step(s, d, LENGTH, DT), inputs)


def drive(seed, steps=50):
    """States [8, T, 4] of smoothly driven vehicles, their sizes, and that all of them are valid."""
    rng = torch.Generator().manual_seed(seed)
    state = torch.cat([torch.zeros(8, 3), 4 + 8 * torch.rand(8, 1, generator=rng)], -1)
    length, phase = torch.full((8,), 4.6), 6 * torch.rand(8, generator=rng)
    path = [state]
    for t in range(steps):
        swing = torch.sin(phase + 0.1 * t)
        path.append(bicycle_step(path[-1], 1.7 * swing.cos(), 0.12 * swing, length, DT))
    path = torch.stack(path, 1)
    return path, torch.stack([length, 0.4 * length], -1), torch.ones(path.shape[:2], dtype=torch.bool)


def test_greedy_fit_follows_smooth_driving():
    path, size, valid = drive(0)
    actions, fitted = Bicycle().fit(path, valid, size, DT)
    assert actions.shape == (8, 50)
    assert not Bicycle().fit(path * torch.tensor([1, 1, 1, -1]), valid, size, DT)[1][:, 0, 3].any()  # none reverses
    error = (fitted - path)[..., :2].norm(dim=-1)
    assert error.max() < 0.25
    assert error[:, -1].mean() < 0.15
    replay = path[:, 0]
    for t in range(50):
        replay = Bicycle().step(replay, actions[:, t], size, DT)
        torch.testing.assert_close(replay, fitted[:, t + 1])


def test_displacement_fit_is_exact_in_position():
    path, size, valid = drive(1)
    _, fitted = Displacement().fit(path, valid, size, DT)
    torch.testing.assert_close(fitted[..., :2], path[..., :2], atol=1e-4, rtol=0)
    assert wrap(fitted[..., 2] - path[..., 2]).abs().max() < 0.05


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_fit_starts_anew_where_an_agent_reappears(dynamics):
    path, size, valid = drive(2)
    valid[:, :5] = valid[:, 20:30] = False
    hidden = torch.where(valid[..., None], path, torch.zeros(()))
    _, fitted = dynamics.fit(hidden, valid, size, DT)
    torch.testing.assert_close(fitted[:, 30], path[:, 30])
    assert (fitted - path)[:, 30:, :2].norm(dim=-1).max() < 0.25
    gap = fitted[:, 19:30, 2:]  # they keep course and speed
    torch.testing.assert_close(gap, gap[:, :1].expand_as(gap), atol=1e-4, rtol=0)


@given(st.floats(3, 25), st.floats(-3, 3), st.integers(0, 146))
def test_the_fit_finds_the_action_that_was_taken(speed, heading, action):
    dynamics = Bicycle()
    state = torch.tensor([[5.0, -2.0, heading, speed]], dtype=torch.float64)
    size = torch.tensor([[4.5, 2.0]], dtype=torch.float64)
    after = dynamics.step(state, torch.tensor([action]), size, 0.2)
    assert dynamics.towards(state, after, size, 0.2).tolist() == [action]
    # Were its place the same, an action whose heading is farther off must not seem nearer.
    elsewhere = after + torch.tensor([0.0, 0.0, 0.3, 0.0])
    found = dynamics.step(state, dynamics.towards(state, elsewhere, size, 0.2), size, 0.2)
    assert abs(wrap(found - elsewhere)[0, 2]) <= abs(wrap(after - elsewhere)[0, 2]) + 1e-9


@pytest.mark.parametrize("action", [-1, 147, 999])
def test_an_action_that_is_none_is_refused(action):
    state, size = torch.zeros(2, 3, 4), torch.full((2, 3, 2), 4.0)
    with pytest.raises(IndexError):
        Bicycle().step(state, torch.full((2, 3), action), size, 0.2)
