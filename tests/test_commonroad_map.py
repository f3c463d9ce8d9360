"""Lanelet networks and traffic lights of CommonRoad files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from helpers_sources import ROAD, bound, driver, lanelet, off_road, signed_area
from helpers_sources import convert_xml as convert
from symphony.data.segment import MarkType, SignalState
from symphony.data.sources.lines import SLIT, drivable_rings


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "made.xml"


def test_lanes(path: Path) -> None:
    near = lanelet(12, [(0, 6), (50, 6)], [(0, 2), (50, 2)], '<adjacentRight ref="10" drivingDir="same"/>')
    against = lanelet(
        13, [(50, -2), (0, -2)], [(50, -6), (0, -6)], '<adjacentLeft ref="10" drivingDir="opposite"/>'
    )
    main = lanelet(
        10,
        [(0, 2), (50, 2)],
        [(0, -2), (20, -2), (50, -2)],
        '<successor ref="11"/><successor ref="99"/><adjacentLeft ref="12" drivingDir="same"/>'
        '<adjacentRight ref="13" drivingDir="opposite"/>',
    )
    after = lanelet(11, [(50, 2), (100, 2)], [(50, -2), (100, -1)], '<predecessor ref="10"/>')
    segment = convert(path, driver(7), main, after, near, against)
    road = segment.road
    assert road.lane_id.tolist() == [10, 11, 12, 13]
    assert road.successors.tolist() == [[0, 1]]
    assert road.left_neighbors.tolist() == [[0, 2]]
    assert road.right_neighbors.tolist() == [[2, 0]]
    np.testing.assert_allclose(road.lane_width, [4, 3.5, 4, 4], rtol=1e-6)
    np.testing.assert_allclose(road.lanes[0][:, :2], [[0, 0], [25, 0], [50, 0]], atol=1e-6)
    np.testing.assert_allclose(road.lanes[3][:, :2], [[50, -4], [0, -4]], atol=1e-6)


def test_speed_limits_of_either_version(path: Path) -> None:
    ends = [(50, 2), (100, 2)], [(50, -2), (100, -2)]
    sign = (
        '<trafficSign id="5"><trafficSignElement><trafficSignID>{}</trafficSignID>'
        "<additionalValue>13.5</additionalValue></trafficSignElement></trafficSign>"
    )
    old = convert(
        path, driver(7, "2018b"), lanelet(11, *ends, "<speedLimit>12.5</speedLimit>"), version="2018b"
    )
    assert old.road.speed_limit.tolist() == [12.5]
    lane = lanelet(11, *ends, '<trafficSignRef ref="5"/><trafficSignRef ref="77"/>')
    for kind, expected in (("274", 13.5), ("R2-1", 13.5), ("206", None)):
        (found,) = convert(path, driver(7), lane, sign.format(kind)).road.speed_limit.tolist()
        assert found == expected or (expected is None and np.isnan(found))


def test_walkways_are_no_lanes(path: Path) -> None:
    walk = lanelet(20, [(0, 4), (50, 4)], [(0, 2), (50, 2)], "<laneletType>sidewalk</laneletType>")
    cross = lanelet(21, [(20, 2), (20, -2)], [(18, 2), (18, -2)], "<laneletType>crosswalk</laneletType>")
    segment = convert(path, ROAD, walk, cross, driver(7))
    assert segment.road.lane_id.tolist() == [10, 11]
    assert segment.road.mark_type.tolist() == [MarkType.CROSSWALK]
    assert segment.road.boundary.points[:, 1].max() == 2


@pytest.mark.parametrize("kind", ["shoulder", "border", "parking", "restricted"])
def test_what_lies_beside_the_lanes_is_road_and_no_lane(path: Path, kind: str) -> None:
    """Nobody's route leads along it, nobody who stands there is off the road, and it is cut where the lanes are."""
    types = f"<laneletType>urban</laneletType><laneletType>{kind}</laneletType>"
    more = '<adjacentLeft ref="10" drivingDir="same"/>'
    strips = [
        lanelet(20, [(0, -2), (50, -2)], [(0, -4), (50, -4)], f'{types}<successor ref="21"/>{more}'),
        lanelet(21, [(50, -2), (100, -2)], [(50, -4), (100, -4)], types),
    ]
    segment, plain = (convert(path, ROAD, *beside, driver(7)) for beside in (strips, []))
    road = segment.road
    for name in ("lane_id", "successors", "left_neighbors", "right_neighbors", "lane_type"):
        np.testing.assert_array_equal(getattr(road, name), getattr(plain.road, name))
    spots = np.array([(50, 0), (50, -3), (99, -3.9), (150, -3), (50, -4.5), (50, 2.5)]) - segment.origin[:2]
    assert (off_road(road, spots) > 0).tolist() == [False] * 4 + [True] * 2
    with pytest.raises(AssertionError, match="field lanelet: has no lanes"):
        convert(path, *strips, driver(7))


def test_painted_lines_are_marks_and_shared_ones_count_once(path: Path) -> None:
    middle = [(0, 2), (50, 2)]
    left, right = bound("left", middle, "dashed"), bound("right", [(0, -2), (50, -2)], "no_marking")
    low = f'<lanelet id="10">{left}{right}</lanelet>'
    left, right = bound("left", [(0, 6), (50, 6)], "solid"), bound("right", middle, "dashed")
    high = f'<lanelet id="12">{left}{right}</lanelet>'
    road = convert(path, low, high, driver(7)).road
    assert road.mark_type.tolist() == [MarkType.ROAD_LINE] * 2
    assert sorted(road.marks.points[:, 1].tolist()) == [2, 2, 6, 6]


def test_boundary_rings_have_the_drivable_side_on_their_left(path: Path) -> None:
    corners = [(-20, -20), (20, -20), (20, 20), (-20, 20), (-20, -20)]
    inner = [(0.8 * x, 0.8 * y) for x, y in corners]
    square = [
        lanelet(k, inner[k : k + 2], corners[k : k + 2], f'<successor ref="{(k + 1) % 4}"/>')
        for k in range(4)
    ]
    road = convert(path, *square, driver(7, y=-18)).road
    areas = sorted(signed_area(road.boundary[k].astype(float)) for k in range(len(road.boundary)))
    np.testing.assert_allclose(areas, [-(32.0**2), 40.0**2], rtol=1e-4)
    for k in range(len(road.boundary)):
        np.testing.assert_array_equal(road.boundary[k][0], road.boundary[k][-1])


TINY = 4.139035625378231e-209
"""On the way shapely divides by what is not quite zero."""


@settings(max_examples=40, deadline=None)
@example(
    [
        (0.0, 0.0, 1.0, 1.0, 0.0),
        (0.0, 0.0, 1.0, 1.0, 1.0),
        (0.0, 0.0, 1.0, 1.0, 1.0),
        (0.0, 0.0, 2.0, 1.0, TINY),
        (0.0, TINY, 3.0, 1.0, 0.0),
        (2.0, 0.0, 1.0, 1.0, 2.0),
    ]
)
@given(
    st.lists(
        st.tuples(
            st.floats(-50, 50),
            st.floats(-50, 50),
            st.floats(0.1, 20),
            st.floats(1, 20),
            st.floats(0, 6.3),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_rings_bound_the_union(boxes: list[tuple[float, ...]]) -> None:
    outlines = []
    for x, y, length, width, angle in boxes:
        corners = np.array([[0, 0], [length, 0], [length, width], [0, width], [0, 0]])
        c, s = np.cos(angle), np.sin(angle)
        outlines.append(corners @ np.array([[c, s], [-s, c]]) + [x, y])
    rings = drivable_rings(outlines)
    area = sum(signed_area(ring) for ring in rings)
    with np.errstate(all="ignore"):
        union = shapely.union_all([shapely.Polygon(outline) for outline in outlines])
    assert area >= union.area - 0.5
    assert area <= union.buffer(2 * SLIT).area + 0.5
    shells = [shapely.Polygon(ring) for ring in rings if signed_area(ring) > 0]
    holes = [shapely.Polygon(ring) for ring in rings if signed_area(ring) < 0]
    rebuilt = shapely.union_all(shells).difference(shapely.union_all(holes))
    assert union.difference(rebuilt.buffer(0.05)).area < 0.05


LIGHT = (
    '<trafficLight id="30"><cycle>'
    "<cycleElement><duration>3</duration><color>green</color></cycleElement>"
    "<cycleElement><duration>1</duration><color>yellow</color></cycleElement>"
    "<cycleElement><duration>4</duration><color>{color}</color></cycleElement>"
    "<timeOffset>{offset}</timeOffset></cycle><direction>{direction}</direction><active>{active}</active></trafficLight>"
)


def light(color: str = "red", offset: int = 0, direction: str = "all", active: str = "true") -> str:
    return LIGHT.format(color=color, offset=offset, direction=direction, active=active)


def branch(target: int, dy: float) -> str:
    return lanelet(target, [(50, 2), (100, 2 + dy)], [(50, -2), (100, -2 + dy)])


APPROACH = lanelet(
    10,
    [(0, 2), (50, 2)],
    [(0, -2), (50, -2)],
    '<successor ref="11"/><successor ref="12"/><trafficLightRef ref="30"/>',
)
FORK = APPROACH + branch(11, 0) + branch(12, 30)
TURNS = (
    '<intersection id="40"><incoming id="41"><incomingLanelet ref="10"/>'
    '<successorsStraight ref="11"/><successorsLeft ref="12"/></incoming></intersection>'
)


@pytest.mark.parametrize("offset", [0, 2, 5, -3, 800])
def test_a_light_repeats_its_cycle_from_the_offset(path: Path, offset: int) -> None:
    segment = convert(path, FORK, light(offset=offset), driver(7, steps=range(100, 140)))
    cycle = [SignalState.GO] * 3 + [SignalState.CAUTION] + [SignalState.STOP] * 4
    expected = [cycle[(step - offset) % 8] for step in range(100, 140)]
    assert segment.signal_lane.tolist() == [1, 2]
    np.testing.assert_array_equal(segment.signal_state, [expected, expected])
    stop = segment.signal_point + segment.origin
    np.testing.assert_allclose(stop, [[50, 0, 0]] * 2, atol=1e-4)


@pytest.mark.parametrize(
    ("direction", "lanes"), [("straight", [1]), ("left", [2]), ("leftStraight", [1, 2]), ("right", [])]
)
def test_a_light_holds_for_its_directions(path: Path, direction: str, lanes: list[int]) -> None:
    assert convert(path, FORK, TURNS, light(direction=direction), driver(7)).signal_lane.tolist() == lanes
