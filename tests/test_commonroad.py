"""The CommonRoad reader: obstacles, egos, lanelet networks and traffic lights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from helpers_sources import RECTANGLE, ROAD, bound, driver, lanelet, obstacle, off_road, signed_area, state
from helpers_sources import commonroad as file_of
from helpers_sources import convert_xml as convert
from helpers_store import fill
from symphony.agents import load_agent
from symphony.bench.published import pdm
from symphony.config.evaluation import SimulateConfig
from symphony.data import convert as conversion
from symphony.data.segment import MarkType, RunSegment, SignalState, content_hash
from symphony.data.sources import get_reader
from symphony.data.sources.lines import SLIT, drivable_rings
from symphony.envs import scene
from symphony.errors import ConfigError
from symphony.evaluation.planners import run_score
from symphony.evaluation.report import report
from symphony.planners.interface import scenario_of
from symphony.roadgraph import LaneGraph
from symphony.rollouts.crowd import crowd_dataset
from symphony.saved.saving import save_simulation


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "made.xml"


def test_tracks(path: Path) -> None:
    late = driver(8, "2020a", 10.0, -0.5, 8.0, range(2, 4))
    segment = convert(path, ROAD, driver(7, "2020a", 3.3, 0.4), late)
    assert (segment.segment_id, segment.file) == ("ZAM_Made-1_1_T-1", "made.xml")
    assert (segment.dt, segment.num_steps, segment.ego, segment.current_step) == (0.1, 5, 0, 0)
    np.testing.assert_array_equal(segment.agent_id, [7, 8])
    np.testing.assert_array_equal(segment.valid, [[1] * 5, [0, 0, 1, 1, 0]])
    np.testing.assert_array_equal(segment.origin, [3, 0, 0])
    np.testing.assert_allclose(segment.position[0, :, 0], 0.3 + np.arange(5), atol=1e-5)
    np.testing.assert_allclose(segment.position[1, 2:4, :2], [[8.6, -0.5], [9.4, -0.5]], atol=1e-5)
    np.testing.assert_allclose(segment.velocity[0], [[10, 0]] * 5)
    np.testing.assert_array_equal(segment.size, np.float32([[4.5, 2, 0]] * 2))
    assert not segment.position[1, [0, 1, 4]].any()


def test_the_two_versions_say_the_same_and_static_obstacles_rest(path: Path) -> None:
    found = []
    for version in ("2018b", "2020a"):
        parked = obstacle(9, [state(0, 20, -1, 0.3, 7.0)], version, "parkedVehicle", role="static")
        found.append(convert(path, ROAD, driver(7, version), driver(8, version, 9), parked, version=version))
    assert content_hash(found[0]) == content_hash(found[1])
    segment = found[0]
    assert (segment.agent_id[2], segment.valid[2].all(), segment.velocity[2].any()) == (9, True, False)
    np.testing.assert_allclose(segment.heading[2], 0.3)
    np.testing.assert_allclose(segment.position[2] + segment.origin, [[20, -1, 0]] * 5, atol=1e-5)


def test_a_missing_velocity_is_the_slope_of_the_positions(path: Path) -> None:
    x = [0.5 * k**2 for k in range(5)]
    accelerating = obstacle(8, [state(k, x[k], 0.2 * k, 0.1, None) for k in range(5)])
    segment = convert(path, ROAD, driver(7), accelerating)
    np.testing.assert_allclose(segment.velocity[1, :, 0], np.gradient(x, 0.1), rtol=1e-4)
    np.testing.assert_allclose(segment.velocity[1, :, 1], 2.0, rtol=1e-4)
    single = obstacle(8, [state(2, 5, 5, 0, None)])
    assert not convert(path, ROAD, driver(7), single).velocity[1].any()


POLYGON = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in [(0, 0), (3, 0), (3, 1), (0, 1)])
TURNED = "<length>4</length><width>2</width><orientation>0.5</orientation><center><x>1</x><y>0.2</y></center>"


@pytest.mark.parametrize(("shape", "size", "place", "turn"), [
    (RECTANGLE, (4.5, 2), (0, 0), 0), ("<circle><radius>0.4</radius></circle>", (0.8, 0.8), (0, 0), 0),
    (f"<polygon>{POLYGON}</polygon>", (3, 1), (1.5, 0.5), 0),
    (f"<rectangle>{TURNED}</rectangle>", (4, 2), (1, 0.2), 0.5),
])  # fmt: skip
def test_boxes_bound_their_shape(path, shape, size, place, turn):
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
        driver(5, x=500), driver(9, x=30), driver(8, x=0), driver(6, x=75), driver(3, x=20, steps=range(4)),
        obstacle(2, [state(k, 20, 3, 0, 0) for k in range(5)]),
        obstacle(4, [state(k, 10.0 + k, 3, 0, 10) for k in range(5)], kind="bicycle"),
    ]  # fmt: skip
    # Within 50 m, 8 has 9, 3 and 4 moving; 9 has 8, 3 and 4, and 6 besides. Without 6 they tie.
    assert convert(path, ROAD, *cars).ego == 1
    assert convert(path, ROAD, *cars[:3], *cars[4:]).ego == 2
    for order in (cars, cars[::-1]):
        path.write_text(file_of(ROAD, *order))
        items = list(get_reader("commonroad", egos="all").read(path))
        names = [item.segment_id for item in items if isinstance(item, RunSegment)]
        assert names == [f"ZAM_Made-1_1_T-1_ego{ego}" for ego in (5, 6, 8, 9)]
        # All in one frame, on one map.
        alike = [item.replace(ego=0, segment_id="") for item in items if isinstance(item, RunSegment)]
        assert len({content_hash(item) for item in alike}) == 1


def test_lanes(path: Path) -> None:
    near = lanelet(12, [(0, 6), (50, 6)], [(0, 2), (50, 2)], '<adjacentRight ref="10" drivingDir="same"/>')
    opposite = '<adjacentLeft ref="10" drivingDir="opposite"/>'
    against = lanelet(13, [(50, -2), (0, -2)], [(50, -6), (0, -6)], opposite)
    links = '<successor ref="11"/><successor ref="99"/><adjacentLeft ref="12" drivingDir="same"/>'
    links += '<adjacentRight ref="13" drivingDir="opposite"/>'
    main = lanelet(10, [(0, 2), (50, 2)], [(0, -2), (20, -2), (50, -2)], links)
    after = lanelet(11, [(50, 2), (100, 2)], [(50, -2), (100, -1)], '<predecessor ref="10"/>')
    road = convert(path, driver(7), main, after, near, against).road
    assert road.lane_id.tolist() == [10, 11, 12, 13]
    links = [each.tolist() for each in (road.successors, road.left_neighbors, road.right_neighbors)]
    assert links == [[[0, 1]], [[0, 2]], [[2, 0]]]
    np.testing.assert_allclose(road.lane_width, [4, 3.5, 4, 4], rtol=1e-6)
    np.testing.assert_allclose(road.lanes[0][:, :2], [[0, 0], [25, 0], [50, 0]], atol=1e-6)
    np.testing.assert_allclose(road.lanes[3][:, :2], [[50, -4], [0, -4]], atol=1e-6)


def test_speed_limits_of_either_version(path: Path) -> None:
    ends = [(50, 2), (100, 2)], [(50, -2), (100, -2)]
    sign = (
        '<trafficSign id="5"><trafficSignElement><trafficSignID>{}</trafficSignID>'
        "<additionalValue>13.5</additionalValue></trafficSignElement></trafficSign>"
    )
    old = lanelet(11, *ends, "<speedLimit>12.5</speedLimit>")
    assert convert(path, driver(7, "2018b"), old, version="2018b").road.speed_limit.tolist() == [12.5]
    lane = lanelet(11, *ends, '<trafficSignRef ref="5"/><trafficSignRef ref="77"/>')
    for kind, expected in (("274", 13.5), ("R2-1", 13.5), ("274.1", 13.5), ("B14", 13.5), ("206", np.nan)):
        found = convert(path, driver(7), lane, sign.format(kind)).road.speed_limit
        np.testing.assert_array_equal(found, np.float32([expected]))
    with pytest.raises(AssertionError, match=r"trafficSign \[5\]: two of one id"):
        convert(path, driver(7), lane, 2 * sign.format("274"))


def test_what_lies_beside_the_lanes_is_road_and_no_lane(path: Path) -> None:
    """No route leads along it, no agent that stands there is off the road, and it is cut where the lanes are."""
    walk = lanelet(30, [(0, 4), (50, 4)], [(0, 2), (50, 2)], "<laneletType>sidewalk</laneletType>")
    cross = lanelet(31, [(20, 2), (20, -2)], [(18, 2), (18, -2)], "<laneletType>crosswalk</laneletType>")
    plain = convert(path, ROAD, driver(7)).road
    for kind in ("shoulder", "border", "parking", "restricted"):
        types = f"<laneletType>urban</laneletType><laneletType>{kind}</laneletType>"
        more = '<successor ref="21"/><adjacentLeft ref="10" drivingDir="same"/>'
        strips = [
            lanelet(20, [(0, -2), (50, -2)], [(0, -4), (50, -4)], types + more),
            lanelet(21, [(50, -2), (100, -2)], [(50, -4), (100, -4)], types),
        ]
        segment = convert(path, ROAD, *strips, walk, cross, driver(7))
        for name in ("lane_id", "successors", "left_neighbors", "right_neighbors", "lane_type"):
            np.testing.assert_array_equal(getattr(segment.road, name), getattr(plain, name))
        assert segment.road.mark_type.tolist() == [MarkType.CROSSWALK]
        spots = np.array([(50, 0), (50, -3), (99, -3.9), (150, -3), (50, -4.5), (50, 2.5)])
        away = off_road(segment.road, spots - segment.origin[:2])
        assert (away > 0).tolist() == [False] * 4 + [True] * 2
        with pytest.raises(AssertionError, match="field lanelet: has no lanes"):
            convert(path, *strips, driver(7))


def test_painted_lines_are_marks_and_shared_ones_count_once(path: Path) -> None:
    middle = [(0, 2), (50, 2)]
    low = bound("left", middle, "dashed") + bound("right", [(0, -2), (50, -2)], "no_marking")
    high = bound("left", [(0, 6), (50, 6)], "solid") + bound("right", middle, "dashed")
    road = convert(path, f'<lanelet id="1">{low}</lanelet><lanelet id="2">{high}</lanelet>', driver(7)).road
    assert road.mark_type.tolist() == [MarkType.ROAD_LINE] * 2
    assert sorted(road.marks.points[:, 1].tolist()) == [2, 2, 6, 6]


def test_the_boundary_is_open_where_the_network_is_cut(path: Path) -> None:
    """Beside the road a vehicle is off it; beyond the last lanelet, along the lane, it is not."""
    turn = lanelet(12, [(100, 2), (120, 2)], [(100, -2), (120, -2)], '<predecessor ref="11"/>')
    for road, end in ((ROAD, 100), (ROAD + turn, 120)):
        segment = convert(path, road, driver(7))
        inside = [(50, 0), (end + 9, 0), (end + 30, 1), (-9, -1)]
        outside = [(50, 3), (end - 1, 3), (end + 9, 9)]
        away = off_road(segment.road, np.array(inside + outside) - segment.origin[:2])
        assert (away > 0).tolist() == [False] * 4 + [True] * 3
        lines = [segment.road.boundary[k] + segment.origin for k in range(len(segment.road.boundary))]
        assert len(lines) == 2
        # Each runs along one side, drivable side on the left.
        for line in lines:
            assert np.ptp(line[:, 0]) == pytest.approx(end, abs=1e-4)
            assert np.sign(np.diff(line[:, 0])).tolist() == [-np.sign(line[0, 1])] * (len(line) - 1)


TINY = 4.139035625378231e-209
"""On the way shapely divides by what is not quite zero."""
BOX = st.tuples(*(st.floats(a, b) for a, b in ((-50, 50), (-50, 50), (0.1, 20), (1, 20), (0, 6.3))))


@settings(max_examples=25, deadline=None)
@example([(0, 0, 1, 1, 0), *[(0, 0, 1, 1, 1)] * 2, (0, 0, 2, 1, TINY), (0, TINY, 3, 1, 0), (2, 0, 1, 1, 2)])
@given(st.lists(BOX, min_size=1, max_size=6))
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
    assert union.area - 0.5 <= area <= union.buffer(2 * SLIT).area + 0.5
    shells = [shapely.Polygon(ring) for ring in rings if signed_area(ring) > 0]
    holes = [shapely.Polygon(ring) for ring in rings if signed_area(ring) < 0]
    rebuilt = shapely.union_all(shells).difference(shapely.union_all(holes))
    assert union.difference(rebuilt.buffer(0.05)).area < 0.05


CYCLE = "".join(
    f"<cycleElement><duration>{steps}</duration><color>{color}</color></cycleElement>"
    for steps, color in ((3, "green"), (1, "yellow"), (4, "red"))
)


def forked(more: str = "") -> list[str]:
    """A lane along +x that forks after 50 m: 11 goes straight on, 12 to the left."""
    links = f'<successor ref="11"/><successor ref="12"/>{more}'
    stem = lanelet(10, [(0, 2), (50, 2)], [(0, -2), (50, -2)], links)
    ahead = lanelet(11, [(50, 2), (150, 2)], [(50, -2), (150, -2)], '<predecessor ref="10"/>')
    turn = np.radians(np.arange(0, 91, 10))
    rings = [np.stack([50 + r * np.sin(turn), 40 - r * np.cos(turn)], -1).tolist() for r in (38, 42)]
    return [stem, ahead, lanelet(12, *rings, '<predecessor ref="10"/>')]


FORK = "".join(forked('<trafficLightRef ref="30"/>'))
TURNS = (
    '<intersection id="40"><incoming id="41"><incomingLanelet ref="10"/>'
    '<successorsStraight ref="11"/><successorsLeft ref="12"/></incoming></intersection>'
)


def light(offset: int = 0, direction: str = "all", active: str = "true") -> str:
    cycle = f"<cycle>{CYCLE}<timeOffset>{offset}</timeOffset></cycle>"
    more = f"<direction>{direction}</direction><active>{active}</active>"
    return f'<trafficLight id="30">{cycle}{more}</trafficLight>'


@pytest.mark.parametrize("offset", [0, 5, -3, 800])
def test_a_light_repeats_its_cycle_from_the_offset(path: Path, offset: int) -> None:
    segment = convert(path, FORK, light(offset), driver(7, steps=range(100, 140)))
    cycle = [SignalState.GO] * 3 + [SignalState.CAUTION] + [SignalState.STOP] * 4
    expected = [cycle[(step - offset) % 8] for step in range(100, 140)]
    assert segment.signal_lane.tolist() == [1, 2]
    np.testing.assert_array_equal(segment.signal_state, [expected, expected])
    np.testing.assert_allclose(segment.signal_point + segment.origin, [[50, 0, 0]] * 2, atol=1e-4)
    assert not convert(path, FORK, light(active="false"), driver(7)).signal_state.any()


@pytest.mark.parametrize(
    ("direction", "lanes"), [("straight", [1]), ("left", [2]), ("leftStraight", [1, 2]), ("right", [])]
)
def test_a_light_holds_for_its_directions(path: Path, direction: str, lanes: list[int]) -> None:
    assert convert(path, FORK, TURNS, light(0, direction), driver(7)).signal_lane.tolist() == lanes


def problem(goal: str, number: int = 100, x: float = 5.0) -> str:
    """The ego on the lane along +x at 8 m/s, which is to be somewhere between steps 20 and 30."""
    times = "<time><intervalStart>20</intervalStart><intervalEnd>30</intervalEnd></time>"
    first = state(0, x, 0.0, 0.0, 8.0, "initialState")
    place = f"<position>{goal}</position>" if goal else ""
    return f'<planningProblem id="{number}">{first}<goalState>{times}{place}</goalState></planningProblem>'


AREA = "<rectangle><length>4</length><width>3</width><center><x>90</x><y>33</y></center></rectangle>"


def problems_of(path: Path, *parts: str) -> list[RunSegment]:
    path.write_text(file_of(*parts))
    return [one for one in get_reader("commonroad", egos="problem").read(path) if isinstance(one, RunSegment)]


@pytest.mark.parametrize(("goal", "place", "lane"), [
    ('<lanelet ref="11"/>', (100, 0), 11),
    ('<lanelet ref="12"/>', (50 + 40 * np.sin(np.pi / 4), 40 - 40 * np.cos(np.pi / 4)), 12), (AREA, (90, 33), 12),
    (AREA + "<circle><radius>2</radius><center><x>92</x><y>35</y></center></circle>", (91, 34), 12),
    ("<point><x>140</x><y>1</y></point>", (140, 1), 11),
])  # fmt: skip
def test_the_ego_of_a_planning_problem_is_on_its_way_to_the_goal(path, tmp_path, goal, place, lane):
    (segment,) = problems_of(path, *forked(), driver(7, x=30.0), problem(goal))
    assert (segment.segment_id, segment.group) == ("ZAM_Made-1_1_T-1_problem100", "ZAM_Made-1_1_T-1")
    assert (segment.agent_id.tolist(), segment.ego, segment.num_steps) == ([100, 7], 0, 31)
    assert segment.valid[0].tolist() == [True] + [False] * 30
    assert segment.velocity[0, 0].tolist() == [8, 0]
    np.testing.assert_allclose(segment.size[0], [4.508, 1.61, 0])
    np.testing.assert_allclose(segment.position[0, 0] + segment.origin, [5, 0, 0], atol=1e-5)
    np.testing.assert_allclose(segment.goal + segment.origin[:2], place, atol=0.2)
    with pytest.raises(ConfigError, match="planning problem has none"):
        conversion.convert("commonroad", [path], tmp_path / "near", radius=50.0, reader_options={"egos": "problem"})
    store = fill(tmp_path / "store", [segment])
    assert (store[0].goal, store.tags(0)) == (segment.goal, {})
    assert scenario_of(store[0], 0, np.zeros((0, 2)), np.zeros(4), 0).goal.tolist() == segment.goal
    assert content_hash(store[0]) == store.content(0) != content_hash(segment.replace(goal=None))
    made = scene(store[0], [0], LaneGraph(segment.road))
    end = made.whole_route(0, 0, int(made.route_logged[0, 0]))[-1].numpy() + segment.origin[:2]
    np.testing.assert_allclose(end, {11: (150, 0), 12: (90, 40)}[lane], atol=0.1)
    # A planner drives it there; what is measured against a log is not defined.
    agent = load_agent("playback")
    config = SimulateConfig(rollouts=1)
    dataset = crowd_dataset(store, agent, config, default=1, routes=True)
    saved = save_simulation(tmp_path / "sim", agent, dataset, config, planner="idm")
    (row,) = report(saved, "ego").rows
    assert (row["failed"], row["collision"], row["offroad_time"]) == ("", False, 0)
    assert (row["progress"] > 20, saved[0].segment.goal) == (True, segment.goal)
    assert [row["progress_ratio"], row["log_distance"], run_score(row), pdm(row, saved[0], [])] == [None] * 4


def test_planning_problems_are_a_segment_each_and_wrong_ones_are_named(path):
    found = problems_of(path, *forked(), driver(7), problem("", 8), problem('<lanelet ref="11"/>', 9, 30.0))
    assert [(one.segment_id[16:], one.goal is None) for one in found] == [("_problem8", True), ("_problem9", False)]
    for parts, why in (
        ([driver(7)], "planningProblem: missing"),
        ([problem('<lanelet ref="13"/>')], "names lanelet 13, which is no lane"),
        ([problem("").replace("initialState", "noState")], "planningProblem 100: initialState: missing"),
    ):
        path.write_text(file_of(*forked(), *parts))
        (error,) = get_reader("commonroad", egos="problem").read(path)
        assert why in str(error)
