"""Who goes first where paths cross or merge."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from symphony.data.selection import Context, relations
from symphony.metrics import order_statistics, passing_gap
from symphony.metrics.order import REACH
from test_selection import BY_CONTEXT, CASES, scene

STEPS, DT = 60, 0.2
TIME = torch.arange(STEPS) * DT
EVERY = torch.ones(STEPS, dtype=torch.bool)


def along_x(arrival: float, speed: float = 10.0) -> torch.Tensor:
    """Drives along +x and is at the origin at a time."""
    x = speed * (TIME - arrival)
    return torch.stack((x, torch.zeros_like(x)), -1)


def along_y(arrival: float, speed: float = 10.0) -> torch.Tensor:
    return along_x(arrival, speed).flip(-1)


def gap(a: torch.Tensor, b: torch.Tensor, **changes: torch.Tensor) -> float:
    masks = {"first_valid": EVERY, "second_valid": EVERY, **changes}
    return passing_gap(a, b, **masks, dt=DT).item()


@pytest.mark.parametrize(("mine", "theirs"), [(4.0, 6.0), (6.0, 4.5), (5.0, 5.5), (3.0, 10.0)])
def test_crossing_paths(mine: float, theirs: float) -> None:
    assert gap(along_x(mine), along_y(theirs)) == pytest.approx(theirs - mine, abs=0.1)


def test_paths_that_do_not_meet() -> None:
    assert math.isnan(gap(along_x(4.0), along_x(4.0) + torch.tensor([0.0, 3.5])))
    # The other one stops short of the crossing.
    assert math.isnan(gap(along_x(4.0), along_y(6.0).clamp(max=-3.0)))
    # At 30 m/s a step is 6 m: nobody jumps over the place.
    assert gap(along_x(4.1, 30.0), along_y(6.1, 30.0)) == pytest.approx(2.0, abs=0.1)


def test_steps_that_are_not_valid_do_not_count() -> None:
    seen = TIME < 5.0
    assert math.isnan(gap(along_x(4.0), along_y(6.0), second_valid=seen))
    hidden = torch.where(seen[:, None], along_y(6.0), torch.nan)
    assert math.isnan(gap(along_x(4.0), hidden, second_valid=seen))
    wild = torch.where((TIME < 7.0)[:, None], along_y(6.0), 1e30)
    assert gap(along_x(4.0), wild, second_valid=TIME < 7.0) == gap(along_x(4.0), along_y(6.0))


@given(st.floats(1, 11), st.floats(1, 11), st.floats(2, 20), st.floats(2, 20), st.floats(-4, 4))
@example(1.0, 1.0, 2.0, 3.0, 1.0)
def test_swapping_turning_and_moving(mine, theirs, speed, other, angle):
    a, b = along_x(mine, speed).double(), along_y(theirs, other).double()
    plain = gap(a, b)
    assert gap(b, a) == pytest.approx(-plain)
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
    moved = torch.tensor([30.0, -7.0]).double()
    # A place that lies just as far as the paths reach may be counted or not, after a turn.
    found = [passing_gap(a, b, EVERY, EVERY, DT, REACH + margin).item() for margin in (-1e-6, 0, 1e-6)]
    turned = gap(a @ turn + moved, b @ turn + moved)
    assert any(turned == pytest.approx(value, abs=2 * DT / 4, nan_ok=True) for value in found)


def test_statistics() -> None:
    nan = math.nan
    log = torch.tensor([2.0, -1.0, nan, 0.0])
    simulated = torch.tensor([[3.0, -1, 1, 1], [-2, nan, 1, 1], [1, 0, nan, 1], [2, -2, 1, 1]])
    found = order_statistics(simulated, log)
    assert found.pairs == 2
    assert (found.kept, found.reversed, found.apart) == pytest.approx((5 / 8, 1 / 8, 2 / 8))
    assert found.gap_error == pytest.approx((1 + 4 + 1 + 0 + 0 + 1 + 1) / 7)


@pytest.mark.parametrize("case", [*BY_CONTEXT[Context.MERGE], *BY_CONTEXT[Context.CROSSING]])
def test_pairs_that_interact_pass_one_after_the_other(case: str) -> None:
    segment = scene(CASES[case][1])
    found = relations(segment, np.array([1]))
    position, valid = torch.from_numpy(segment.position[:2, :, :2]), torch.from_numpy(segment.valid[:2])
    ahead = passing_gap(position[0], position[1], valid[0], valid[1], segment.dt).item()
    assert abs(ahead) == pytest.approx(min(found.merge[0], found.crossing[0]), abs=0.5)
