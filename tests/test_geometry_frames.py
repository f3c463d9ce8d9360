"""Laws of angles and planar frames."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from symphony.geometry import rotate, wrap
from symphony.geometry.frames import forward_speed, with_speed


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrap_range_and_congruence(dtype):
    edges = [k * math.pi for k in range(-9, 10)]
    base = torch.tensor([*edges, 0.0, -1e-12, 1e-12, -1e-30], dtype=dtype)
    up, down = torch.full_like(base, torch.inf), torch.full_like(base, -torch.inf)
    angle = torch.cat(
        [base, base.nextafter(up), base.nextafter(down), torch.linspace(-50, 50, 997, dtype=dtype)]
    )
    wrapped = wrap(angle)
    assert (wrapped >= -math.pi).all()
    assert (wrapped < math.pi).all()
    turns = (angle - wrapped) / (2 * math.pi)
    assert (turns - turns.round()).abs().max() < 1e-5
    inside = (angle >= -math.pi) & (angle < math.pi)
    assert torch.equal(wrapped[inside], angle[inside])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrap_next_to_the_ends_of_many_turns(dtype):
    """Where rounding leaves the quotient on the wrong side of a whole number."""
    odd = torch.arange(-20_001, 20_001, 2, dtype=torch.float64)
    at = (odd * math.pi).to(dtype)
    down, up = torch.full_like(at, -torch.inf), torch.full_like(at, torch.inf)
    for angle in (at, at.nextafter(down), at.nextafter(up)):
        wrapped = wrap(angle).double()
        assert (wrapped >= -math.pi - 1e-6).all()
        assert (wrapped <= math.pi).all()
        # Half a turn away from the nearest end would be the other direction.
        assert (wrapped.abs() - math.pi).abs().max() < 20_001 * math.pi * torch.finfo(dtype).eps * 2


@given(st.floats(-1e4, 1e4))
def test_wrap_keeps_the_direction(angle):
    value = torch.tensor(angle, dtype=torch.float64)
    wrapped = wrap(value)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_wrap_gradient_is_one():
    angle = torch.tensor([-7.0, -math.pi, 0.0, math.pi, 9.0], requires_grad=True)
    wrap(angle).sum().backward()
    assert torch.equal(angle.grad, torch.ones(5))


def test_rotate_by_a_quarter_turn_is_counter_clockwise():
    turned = rotate(torch.tensor([2.0, 1.0]), torch.tensor(math.pi / 2))
    torch.testing.assert_close(turned, torch.tensor([-1.0, 2.0]))


def test_rotation_keeps_distances_and_its_inverse_turns_back():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(3, 5, 7, 2, generator=generator, dtype=torch.float64) * 100
    angle = torch.randn(3, 5, 1, generator=generator, dtype=torch.float64) * 9
    turned = rotate(points, angle)
    torch.testing.assert_close(rotate(turned, -angle), points)
    torch.testing.assert_close(turned.norm(dim=-1), points.norm(dim=-1))
    assert torch.autograd.gradcheck(rotate, (points[0, 0].requires_grad_(), angle[0, 0].requires_grad_()))


def test_speed_is_what_of_a_velocity_points_ahead():
    generator = torch.Generator().manual_seed(0)
    moving = torch.randn(7, 5, generator=generator, dtype=torch.float64)
    heading, velocity = moving[:, 2], moving[:, 3:]
    speed = forward_speed(velocity, heading)
    torch.testing.assert_close(speed, rotate(velocity, -heading)[:, 0])
    torch.testing.assert_close(with_speed(moving), torch.cat([moving[:, :3], speed[:, None]], 1))
