from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers_sources import (
    RECTANGLE,
    ROAD,
    commonroad,
    driver,
    lanelet,
    obstacle,
    off_road,
    read_one,
    state,
)
from helpers_sources import convert_xml as convert
from symphony.data.segment import RunSegment, content_hash
from symphony.data.sources import get_reader
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter

VERSIONS = ["2018b", "2020a"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "made.xml"


@pytest.mark.parametrize("version", VERSIONS)
def test_tracks(path: Path, version: str) -> None:
    late = driver(8, version, 10.0, -0.5, 8.0, range(2, 4))
    segment = convert(path, ROAD, driver(7, version, 3.3, 0.4), late, version=version)
    assert (segment.segment_id, segment.source, segment.file) == (
        "ZAM_Made-1_1_T-1",
        "commonroad",
        "made.xml",
    )
    assert (segment.dt, segment.num_steps, segment.ego, segment.current_step) == (0.1, 5, 0, 0)
    np.testing.assert_array_equal(segment.agent_id, [7, 8])
    np.testing.assert_array_equal(segment.valid, [[1] * 5, [0, 0, 1, 1, 0]])
    np.testing.assert_array_equal(segment.origin, [3, 0, 0])
    np.testing.assert_allclose(segment.position[0, :, 0], 0.3 + np.arange(5), atol=1e-5)
    np.testing.assert_allclose(segment.position[0, :, 1], 0.4, atol=1e-6)
    np.testing.assert_allclose(segment.position[1, 2:4, :2], [[8.6, -0.5], [9.4, -0.5]], atol=1e-5)
    np.testing.assert_allclose(segment.velocity[0], [[10, 0]] * 5)
    np.testing.assert_array_equal(segment.size, np.float32([[4.5, 2, 0]] * 2))
    assert not segment.position[1, [0, 1, 4]].any()


def test_the_two_versions_say_the_same(path: Path) -> None:
    found = []
    for version in VERSIONS:
        parked = obstacle(9, [state(0, 20, -1)], version, "parkedVehicle", role="static")
        found.append(convert(path, ROAD, driver(7, version), driver(8, version, 9), parked, version=version))
    assert content_hash(found[0]) == content_hash(found[1])


def test_static_obstacles_rest_at_every_step(path: Path) -> None:
    parked = obstacle(9, [state(0, 20, -1, 0.3, 7.0)], kind="parkedVehicle", role="static")
    segment = convert(path, ROAD, parked, driver(7))
    assert segment.agent_id.tolist() == [7, 9]
    assert segment.valid[1].all()
    assert not segment.velocity[1].any()
    np.testing.assert_allclose(segment.heading[1], 0.3)
    np.testing.assert_allclose(segment.position[1], [[20, -1, 0]] * 5, atol=1e-5)


def test_a_missing_velocity_is_the_slope_of_the_positions(path: Path) -> None:
    x = [0.5 * k**2 for k in range(5)]
    accelerating = obstacle(8, [state(k, x[k], 0.2 * k, 0.1, None) for k in range(5)])
    segment = convert(path, ROAD, driver(7), accelerating)
    np.testing.assert_allclose(segment.velocity[1, :, 0], np.gradient(x, 0.1), rtol=1e-4)
    np.testing.assert_allclose(segment.velocity[1, :, 1], 2.0, rtol=1e-4)
    single = obstacle(8, [state(2, 5, 5, 0, None)])
    assert not convert(path, ROAD, driver(7), single).velocity[1].any()


def test_intervals_and_regions_become_their_middle(path: Path) -> None:
    def between(tag: str, low: float, high: float) -> str:
        return f"<{tag}><intervalStart>{low}</intervalStart><intervalEnd>{high}</intervalEnd></{tag}>"

    box = "<rectangle><length>2</length><width>1</width><center><x>30</x><y>1</y></center></rectangle>"
    vague = (
        f"<state><position>{box}</position>{between('orientation', 0.2, 0.4)}{between('time', 1, 3)}"
        f"{between('velocity', 4, 6)}</state>"
    )
    segment = convert(path, ROAD, driver(7), obstacle(8, [vague]))
    assert np.flatnonzero(segment.valid[1]).tolist() == [2]
    np.testing.assert_allclose(segment.position[1, 2], [30, 1, 0], atol=1e-5)
    np.testing.assert_allclose(segment.heading[1, 2], 0.3, rtol=1e-6)
    np.testing.assert_allclose(np.hypot(*segment.velocity[1, 2]), 5, rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "size", "place", "turn"),
    [
        (RECTANGLE, (4.5, 2), (0, 0), 0),
        ("<circle><radius>0.4</radius></circle>", (0.8, 0.8), (0, 0), 0),
        (
            "<polygon>"
            + "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in [(0, 0), (3, 0), (3, 1), (0, 1)])
            + "</polygon>",
            (3, 1),
            (1.5, 0.5),
            0,
        ),
        (
            "<rectangle><length>4</length><width>2</width><orientation>0.5</orientation>"
            "<center><x>1</x><y>0.2</y></center></rectangle>",
            (4, 2),
            (1, 0.2),
            0.5,
        ),
        (RECTANGLE + "<circle><radius>1.5</radius></circle>", (4.5, 3), (0, 0), 0),
    ],
)
def test_boxes_bound_their_shape(
    path: Path, shape: str, size: tuple[float, float], place: tuple[float, float], turn: float
) -> None:
    heading = 0.7
    other = obstacle(8, [state(k, 20, 3, heading, 2.0) for k in range(5)], shape=shape)
    segment = convert(path, ROAD, driver(7), other)
    np.testing.assert_allclose(segment.size[1, :2], size, rtol=1e-6)
    c, s = np.cos(heading), np.sin(heading)
    expected = [20 + c * place[0] - s * place[1], 3 + s * place[0] + c * place[1]]
    np.testing.assert_allclose(segment.position[1, 0, :2], expected, atol=1e-5)
    np.testing.assert_allclose(segment.heading[1], heading + turn, rtol=1e-6)
    np.testing.assert_allclose(segment.velocity[1, 0], [2 * c, 2 * s], rtol=1e-5)


def test_the_ego_has_the_most_moving_neighbours(path: Path) -> None:
    cars = [
        driver(5, x=500),
        driver(9, x=30),
        driver(8, x=0),
        driver(6, x=75),
        driver(3, x=20, steps=range(4)),
        obstacle(2, [state(k, 20, 3, 0, 0) for k in range(5)]),
        obstacle(4, [state(k, 10.0 + k, 3, 0, 10) for k in range(5)], kind="bicycle"),
    ]
    # Within 50 m, 8 has 9, 3 and 4 moving; 9 has 8, 3 and 4, and 6 besides. Without 6 they tie.
    assert convert(path, ROAD, *cars).ego == 1
    assert convert(path, ROAD, *cars[:3], *cars[4:]).ego == 2
    for order in (cars, cars[::-1]):
        path.write_text(commonroad(ROAD, *order))
        items = list(get_reader("commonroad", egos="all").read(path))
        names = [item.segment_id for item in items if isinstance(item, RunSegment)]
        assert names == [f"ZAM_Made-1_1_T-1_ego{ego}" for ego in (5, 6, 8, 9)]


def test_all_egos_differ_only_by_ego_and_name(path: Path, tmp_path: Path) -> None:
    path.write_text(commonroad(ROAD, driver(7), driver(8, x=30)))
    one = read_one("commonroad", path)
    first, second = get_reader("commonroad", egos="all").read(path)
    assert isinstance(first, RunSegment)
    assert isinstance(second, RunSegment)
    assert (first.agent_id[first.ego], second.agent_id[second.ego]) == (7, 8)
    same = {content_hash(each.replace(ego=0, segment_id="")) for each in (one, first, second)}
    assert len(same) == 1
    assert {each.group for each in (one, first, second)} == {"ZAM_Made-1_1_T-1"}
    with StoreWriter(tmp_path / "store") as writer:
        for each in (first, second):
            writer.append(each)
    assert SegmentStore(tmp_path / "store").num_maps == 1


def test_the_boundary_is_open_where_the_network_is_cut(path: Path) -> None:
    """Beside the road a vehicle is off it; beyond the last lanelet, along the lane, it is not."""
    turn = lanelet(12, [(100, 2), (120, 2)], [(100, -2), (120, -2)], '<predecessor ref="11"/>')
    for road, end in ((ROAD, 100), (ROAD + turn, 120)):
        segment = convert(path, road, driver(7))
        spots = np.array(
            [(50, 0), (end + 9, 0), (end + 30, 1), (-9, -1), (50, 3), (end - 1, 3), (end + 9, 9)]
        )
        away = off_road(segment.road, spots - segment.origin[:2])
        assert (away[:4] < 0).all()
        assert (away[4:] > 0).all()
        lines = [segment.road.boundary[k] + segment.origin for k in range(len(segment.road.boundary))]
        assert len(lines) == 2
        # Each runs along one side, drivable side on the left.
        for line in lines:
            assert np.ptp(line[:, 0]) == pytest.approx(end, abs=1e-4)
            assert np.sign(np.diff(line[:, 0])).tolist() == [-np.sign(line[0, 1])] * (len(line) - 1)


# Real files.
