"""Where along a line something is that follows it, also where the line comes back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from symphony.geometry.polylines import NEAR, earliest_pass, stations_along

Reals = NDArray[np.float64]


def bend(turns: float, radius: float = 20.0, length: float = 189.0) -> Reals:
    """A straight line, or one that goes around a circle of the given radius, in points 3 m apart."""
    arc = np.arange(0.0, length + 1e-9, 3.0)
    if not turns:
        return np.stack([arc, np.zeros_like(arc)], -1)
    return radius * np.stack([np.sin(arc / radius), 1.0 - np.cos(arc / radius)], -1)


def at(line: Reals, along: Reals) -> Reals:
    arc = np.concatenate([[0.0], np.linalg.norm(np.diff(line, axis=0), axis=-1).cumsum()])
    return np.stack([np.interp(along, arc, line[:, k]) for k in (0, 1)], -1)


@settings(max_examples=60, deadline=None)
@given(
    radius=st.floats(12.0, 60.0),
    speed=st.floats(0.0, 20.0),
    start=st.floats(0.0, 5.0),
    seed=st.integers(0, 999),
    hidden=st.booleans(),
)
def test_who_drives_around_a_block_gets_on(radius, speed, start, seed, hidden):
    # Up to two and a half times around: every place is passed again.
    line = bend(1.0, radius)
    arc = np.linalg.norm(np.diff(line, axis=0), axis=-1).sum()
    true = np.minimum(start + speed * 0.2 * np.arange(51), arc)
    rng = np.random.default_rng(seed)
    path = at(line, true) + rng.uniform(-0.3, 0.3, (51, 2))
    valid = np.ones(51, bool)
    if hidden:
        valid[[0, 7, 8, 30]] = False
        path[~valid] = np.nan
    found = stations_along(line[None], path[None], valid[None])[0]
    assert np.isnan(found[~valid]).all()
    assert np.abs(found - true)[valid].max() < 1.5


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), steps=st.integers(1, 30))
def test_on_lines_that_never_come_back_it_is_the_nearest_place(seed: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    line = np.stack([np.arange(0.0, 190.0, 3.0), 6.0 * np.sin(np.arange(64) / rng.uniform(8, 20))], -1)
    along = np.sort(rng.uniform(-10.0, 200.0, steps))
    path = (
        np.stack([along, rng.uniform(-3.0, 3.0, steps)], -1) + [0.0, 1.0] * np.interp(along, *line.T)[:, None]
    )
    found = stations_along(line[None], path[None], np.ones((1, steps), bool))[0]
    nearest = shapely.line_locate_point(shapely.LineString(line), shapely.points(path))
    np.testing.assert_allclose(found, nearest, atol=1e-6)


@pytest.mark.parametrize("turn", [0.3, 2.0])
def test_turning_the_world_padding_and_company_change_nothing(turn: float) -> None:
    line, straight = bend(1.0), bend(0.0)
    path, other = at(line, np.arange(0.0, 160.0, 4.0)), at(straight, np.arange(0.0, 160.0, 4.0)) + 1.0
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    valid = np.ones((1, len(path)), bool)
    alone = stations_along(line[None], path[None], valid)
    turned: Any = stations_along((line @ rotation.T)[None], (path @ rotation.T)[None], valid)
    np.testing.assert_allclose(turned, alone, atol=1e-9)
    padded = np.pad(line, ((0, 9), (0, 0)), "edge")
    np.testing.assert_allclose(stations_along(padded[None], path[None], valid), alone, atol=1e-12)
    both = stations_along(np.stack([line, straight]), np.stack([path, other]), valid.repeat(2, 0))
    np.testing.assert_array_equal(both[:1], alone)


def test_a_point_that_is_not_finite_is_refused_by_its_place() -> None:
    path = np.zeros((2, 5, 2))
    path[1, 3, 0] = np.nan
    with pytest.raises(ValueError, match="path 1, step 3"):
        stations_along(np.stack([bend(0.0)] * 2), path, np.ones((2, 5), bool))


@given(
    arrays(
        np.float64, st.tuples(st.integers(1, 4), st.integers(1, 12)), elements=st.integers(0, 6).map(float)
    )
)
def test_the_earliest_pass_is_a_dip_nearly_as_low_as_any(distance: NDArray[np.float64]) -> None:
    for row, found in zip(distance, earliest_pass(distance), strict=True):
        around = [np.inf, *row, np.inf]
        dips = [k for k in range(len(row)) if around[k] >= row[k] <= around[k + 2]]
        assert found == min(k for k in dips if row[k] <= min(row) + NEAR)
