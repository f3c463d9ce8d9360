"""Lanelet2 maps and their projections: what is read, how lanes connect, and what is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_interaction import BORDER, DASHED, LANELETS, ORIGIN, PARKING, ROAD, WAYS, osm, with_area
from helpers_sources import IN_FOLDER, off_road
from symphony.data.segment import LaneType, MarkType, RoadMap
from symphony.data.sources import lanelet2
from symphony.data.sources.lanelet2 import mercator, middle, read_lanelet2, road_map, stop_line, utm
from symphony.errors import DataError

FROM_ORIGIN = partial(mercator, origin=np.array(ORIGIN))


def read(folder: Path, content: str) -> lanelet2.LaneletMap:
    path = folder / "made.osm"
    path.write_text(content)
    return read_lanelet2(path, FROM_ORIGIN)


def road_of(folder: Path, content: str) -> RoadMap:
    return road_map(read(folder, content), np.zeros(2))


@pytest.mark.parametrize("how", ["xy", "local", "degrees"])
def test_lanes_links_and_neighbours(how: str, tmp_path: Path) -> None:
    road = road_of(tmp_path, osm(how))
    assert (road.lane_id.tolist(), road.successors.tolist()) == ([101, 102, 103, 104], [[0, 2], [1, 3]])
    assert road.left_neighbors.tolist() == [[0, 1], [2, 3]]
    assert road.right_neighbors.tolist() == [[1, 0], [3, 2]]
    np.testing.assert_allclose(road.lane_width, 4, atol=1e-4)
    for k, (begin, y) in enumerate(((0, 2), (0, 6), (50, 2), (50, 6))):
        line = road.lanes[k]
        np.testing.assert_allclose(line[[0, -1], :2], [(begin, y), (begin + 50, y)], atol=1e-4)
        assert np.diff(line[:, 0]).max() < 2.01
    # The lowest of the lanelet's own limit and its rule's.
    np.testing.assert_allclose(road.speed_limit, [30 / 3.6, np.nan, np.nan, np.nan], rtol=1e-6)
    assert set(road.lane_type.tolist()) == {LaneType.SURFACE_STREET}


def test_marks(tmp_path: Path) -> None:
    source = read(tmp_path, osm())
    road = road_map(source, np.zeros(2))
    kinds = road.mark_type.tolist()
    assert sorted(kinds) == sorted([MarkType.ROAD_LINE] * 3 + [MarkType.STOP_SIGN, MarkType.CROSSWALK])
    np.testing.assert_allclose(road.marks[kinds.index(MarkType.STOP_SIGN)], [[100, 2, 0]])
    ring = road.marks[kinds.index(MarkType.CROSSWALK)]
    np.testing.assert_array_equal(ring[0], ring[-1])
    lanes = lanelet2.lane_lanelets(source)
    np.testing.assert_allclose(stop_line(lanes[0], source.rules), (50, 4))
    assert stop_line(lanes[1], source.rules) is None
    np.testing.assert_array_equal(middle(source), (50, 4))


def test_the_boundary_is_open_at_both_ends(tmp_path: Path) -> None:
    road = road_of(tmp_path, osm())
    spots = np.array([(50, 4), (120, 4), (-20, 4), (50, -1), (50, 9), (120, 9)])
    assert (off_road(road, spots) < 0).tolist() == [True, True, True, False, False, False]
    assert len(road.boundary) == 2


@IN_FOLDER
@given(st.lists(st.booleans(), min_size=len(WAYS), max_size=len(WAYS)), st.booleans())
def test_the_direction_of_ways_does_not_matter(tmp_path: Path, turned: list[bool], swapped: bool) -> None:
    named = zip(WAYS.items(), turned, strict=True)
    ways = {name: (tuple(nodes)[:: -1 if turn else 1], tags) for (name, (nodes, tags)), turn in named}
    lanelets = dict(reversed(LANELETS.items())) if swapped else LANELETS
    road, same = road_of(tmp_path, osm(ways=ways, lanelets=lanelets)), road_of(tmp_path, osm())
    pairs = (road.lane_id[links].tolist() for links in (road.successors, road.left_neighbors))
    links = [set(map(tuple, each)) for each in pairs]
    assert links == [{(101, 103), (102, 104)}, {(101, 102), (103, 104)}]
    for k, lane in enumerate(np.argsort(road.lane_id)):
        np.testing.assert_allclose(road.lanes[int(lane)], same.lanes[k], atol=1e-6)


@pytest.mark.parametrize(("tags", "left", "right"), [
    (DASHED, True, True), (BORDER, False, False), ({"type": "line_thin", "subtype": "solid_solid"}, False, False),
    ({"type": "line_thin", "subtype": "solid", "lane_change": "yes"}, True, True),
    ({"type": "line_thin", "subtype": "dashed", "lane_change": "no"}, False, False),
    # The solid one is on the left of the way as drawn: it may be crossed from its other side.
    ({"type": "line_thin", "subtype": "solid_dashed"}, True, False),
    ({"type": "line_thin", "subtype": "dashed_solid"}, False, True),
    ({"type": "line_thin", "subtype": "solid", "lane_change:left": "yes"}, True, False),
    ({"type": "line_thin", "subtype": "dashed", "lane_change:left": "no"}, False, True),
])  # fmt: skip
def test_lines_that_may_be_crossed(tags: dict[str, str], left: bool, right: bool, tmp_path: Path) -> None:
    for nodes, swap in (((3, 4), False), ((4, 3), True)):
        road = road_of(tmp_path, osm(ways=WAYS | {22: (nodes, tags)}))
        found = [0, 1] in road.left_neighbors.tolist(), [1, 0] in road.right_neighbors.tolist()
        assert found == ((right, left) if swap else (left, right))


SPEEDS = {"50": 50 / 3.6, "50 km/h": 50 / 3.6, "25 mph": 25 * 0.44704, "8.5 m/s": 8.5, "8.5mps": 8.5}
SPEEDS |= {"de274-60": 60 / 3.6, "us_r2-1-25": 25 * 0.44704, "none": np.nan, "": np.nan, "900": np.nan}
SPEEDS |= {"de274.1": 30 / 3.6, "de310": 50 / 3.6, "de274": np.nan, "usR2-1": np.nan, "de274.1-20": 20 / 3.6}
SPEEDS |= {"DE:zone:30": 30 / 3.6, "speed 40": 40 / 3.6}


def test_speed_limits(tmp_path: Path) -> None:
    for text, expected in SPEEDS.items():
        rules = {202: ({"subtype": "speed_limit", "sign_type": text}, {})}
        content = osm(lanelets=LANELETS | {101: (22, 21, ROAD, (202,))}, rules=rules)
        np.testing.assert_allclose(road_of(tmp_path, content).speed_limit[0], expected, 1e-6)
    sign = WAYS | {31: ((7, 8), {"type": "traffic_sign", "subtype": "de274-30"})}
    rules = {202: ({"subtype": "speed_limit"}, {"refers": 31})}
    content = osm(ways=sign, lanelets=LANELETS | {101: (22, 21, ROAD, (202,))}, rules=rules)
    np.testing.assert_allclose(road_of(tmp_path, content).speed_limit[0], 30 / 3.6, 1e-6)


@pytest.mark.parametrize(("tags", "expected"), [
    ({}, LaneType.SURFACE_STREET), ({"participant:pedestrian": "no"}, LaneType.SURFACE_STREET),
    ({"participant:vehicle:car": "yes", "subtype": "walkway"}, LaneType.SURFACE_STREET),
    *(({"participant:vehicle": word}, LaneType.SURFACE_STREET) for word in ("True", "1", "?")),
    ({"participant:vehicle": "no"}, None), ({"participant:pedestrian": "yes"}, None),
    ({"participant:pedestrian": "yes", "participant:bicycle": "yes"}, LaneType.BIKE_LANE),
])  # fmt: skip
def test_participants_overrule_subtypes(tmp_path: Path, tags: dict[str, str], expected: LaneType | None) -> None:
    road = road_of(tmp_path, osm(lanelets=LANELETS | {103: (25, 24, ROAD | tags, ())}))
    found = dict(zip(road.lane_id.tolist(), road.lane_type.tolist(), strict=True))
    assert found.get(103) == expected


@IN_FOLDER
@given(turned=st.tuples(*[st.booleans()] * 5), first=st.integers(0, 2))
def test_areas_are_road_but_for_their_holes(tmp_path: Path, turned: tuple[bool, ...], first: int) -> None:
    outer = ["61o", "62o", "63o"]
    members = " ".join(outer[first:] + outer[:first] + ["64i", "65i"])
    road, plain = road_of(tmp_path, with_area(PARKING, turned, members)), road_of(tmp_path, osm())
    spots = np.array([(55, 20), (65, 9), (50, 4), (65, 18), (65, 30), (45, 10)])
    assert (off_road(road, spots) < 0).tolist() == [True, True, True, False, False, False]
    assert not (off_road(plain, spots[:2]) < 0).any()
    assert road.lane_id.tolist() == plain.lane_id.tolist()


BROKEN = {
    "": "empty", osm().replace("<osm", "<!DOCTYPE osm><osm", 1): "document type",
    osm(lanelets={}): "has no lanelets", osm(lanelets={105: LANELETS[105]}): "has no lanes",
    osm(lanelets={101: (22, 99, ROAD, ())}): "there is no way 99",
    osm().replace("x='50'", "x='inf'", 1): "not finite", osm().replace("x='50'", "", 1): "is not a number",
    osm("degrees").replace("lat='49.", "lat='89.", 1): "outside latitudes",
    osm().replace("<relation id='102'", "<relation id='101'"): "two lanelets of one id",
    osm().replace("<node id='2'", "<node id='1'"): "node: two of one id",
    osm().replace("<way id='22'", "<way id='21'"): "way 21: two of one id",
    osm(rules={202: ({}, {}), 203: ({}, {})}).replace("id='203'", "id='202'"): "regulatory_element: two of one id",
}  # fmt: skip


@pytest.mark.parametrize("content", BROKEN, ids=BROKEN.values())
def test_broken_maps_are_refused_by_name(content: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=BROKEN[content]) as caught:
        road_of(tmp_path, content)
    # The reader of recordings adds the file where the map itself is sound.
    assert caught.value.file in {tmp_path / "made.osm", None}


@pytest.mark.parametrize(("content", "kind", "example"), [
    (osm().replace("<member type='way' ref='21' role='right'/>", "", 1), lanelet2.NO_LANELET, "0 ways"),
    (osm(ways=WAYS | {21: ((1, 77), BORDER)}), lanelet2.NO_NODE, "node 77"),
    (osm(ways=WAYS | {21: ((1,), BORDER)}), lanelet2.NO_LANELET, "two points"),
    (with_area(PARKING, members="61o 62o"), lanelet2.NO_AREA, "is not closed"),
    (with_area(PARKING, members="61o 62o 63o 64o 65o"), lanelet2.NO_AREA, "2 outlines"),
    (with_area(PARKING, members="61o 99o"), lanelet2.NO_AREA, "there is no way 99"),
])  # fmt: skip
def test_what_a_map_lacks_is_left_out(content: str, kind: str, example: str, tmp_path: Path) -> None:
    source = read(tmp_path, content)
    assert example in source.odd[kind]
    left = {lanelet.lanelet_id for lanelet in source.lanelets}
    assert left == set(LANELETS) - ({101} if kind != lanelet2.NO_AREA else set())
    assert not source.areas


@pytest.mark.parametrize(("origin", "place", "by_utm", "by_mercator"), [
    ((0, 0), (0.0085, 0.0102), (1136.5711, 940.7946), (1135.4588, 946.2157)),
    ((49.01160993928274, 8.43856470258739), (49.0125, 8.4401), (112.9986, 98.1141), (112.0999, 99.0820)),
    ((-33.9, 151.2), (-33.91, 151.21), (944.0642, -1092.8055), (923.9654, -1113.2602)),
])  # fmt: skip
def test_agrees_with_proj(origin: Any, place: Any, by_utm: Any, by_mercator: Any) -> None:
    """PROJ 9: ``+proj=utm +zone=N``, and ``+proj=merc +R=6378137 +lat_ts=<origin>``, minus the origin."""
    for project, expected in ((utm, by_utm), (mercator, by_mercator)):
        found = project(np.array([place, origin], float), np.array(origin, float))
        np.testing.assert_allclose(found, [expected, (0, 0)], atol=1e-4)


@pytest.mark.parametrize("place", [(85, 0), (-90, 0), (0, 181), (np.nan, 0), (0, np.inf)])
def test_places_that_are_none(place: tuple[float, float]) -> None:
    for project in (utm, mercator):
        for given_ in ((np.array([place]), np.zeros(2)), (np.zeros((1, 2)), np.array(place))):
            with pytest.raises(DataError, match="outside latitudes"):
                project(*given_)
