"""Projections: against PROJ's numbers, and their laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from symphony.data.sources.geodesy import FLATTENING, SEMI_MAJOR, mercator, utm
from symphony.errors import DataError

LATITUDES, LONGITUDES = st.floats(-80, 80), st.floats(-179, 179)


@pytest.mark.parametrize(
    ("origin", "place", "by_utm", "by_mercator"),
    [
        ((0, 0), (0.0085, 0.0102), (1136.5711, 940.7946), (1135.4588, 946.2157)),
        (
            (49.01160993928274, 8.43856470258739),
            (49.0125, 8.4401),
            (112.9986, 98.1141),
            (112.0999, 99.0820),
        ),
        ((-33.9, 151.2), (-33.91, 151.21), (944.0642, -1092.8055), (923.9654, -1113.2602)),
    ],
)
def test_agrees_with_proj(
    origin: tuple[float, float],
    place: tuple[float, float],
    by_utm: tuple[float, float],
    by_mercator: tuple[float, float],
) -> None:
    """PROJ 9: ``+proj=utm +zone=N``, and ``+proj=merc +R=6378137 +lat_ts=<origin>``, minus the origin."""
    for project, expected in ((utm, by_utm), (mercator, by_mercator)):
        found = project(np.array([place, origin], float), np.array(origin, float))
        np.testing.assert_allclose(found, [expected, (0, 0)], atol=1e-4)


@given(LATITUDES, LONGITUDES, st.floats(-np.pi, np.pi))
def test_utm_is_conformal_and_true_to_scale(latitude: float, longitude: float, course: float) -> None:
    """A short step on the ellipsoid keeps its length, to the scale of the grid, and angles between steps."""
    squared = FLATTENING * (2 - FLATTENING)
    root = np.sqrt(1 - squared * np.sin(np.radians(latitude)) ** 2)
    north = SEMI_MAJOR * (1 - squared) / root**3
    east = SEMI_MAJOR / root * np.cos(np.radians(latitude))
    origin = np.array([latitude, longitude])
    turns = course + np.array([0, np.pi / 2])
    steps = np.degrees(np.stack([np.sin(turns) / north, np.cos(turns) / east], axis=-1))
    found = utm(origin + steps, origin)
    lengths = np.hypot(*found.T)
    # 0.9996 on the zone's meridian, about 1.0010 at its edge.
    assert (np.abs(lengths - 1.0003) < 0.0008).all()
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-5)
    across = found[0, 0] * found[1, 1] - found[0, 1] * found[1, 0]
    assert across == pytest.approx(lengths[0] * lengths[1], rel=1e-5)


@given(LATITUDES, LONGITUDES)
def test_mercator_points_north_and_east(latitude: float, longitude: float) -> None:
    origin = np.array([latitude, longitude])
    step = np.degrees(1 / SEMI_MAJOR)
    found = mercator(origin + np.array([[step, 0], [0, step / np.cos(np.radians(latitude))]]), origin)
    np.testing.assert_allclose(found, [[0, 1], [1, 0]], atol=1e-5)


@pytest.mark.parametrize("place", [(85, 0), (-90, 0), (0, 181), (np.nan, 0), (0, np.inf)])
def test_places_that_are_none(place: tuple[float, float]) -> None:
    for project in (utm, mercator):
        with pytest.raises(DataError, match="outside latitudes"):
            project(np.array([place]), np.zeros(2))
        with pytest.raises(DataError, match="outside latitudes"):
            project(np.zeros((1, 2)), np.array(place))
