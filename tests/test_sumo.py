"""Simulated driving: laws of its run segments, fresh and built in, the generator, and roads of one's own."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from symphony.data.builtin import builtin_store
from symphony.data.conformance import check_segments
from symphony.data.generate import Plan, generate
from symphony.data.segment import RoadMap, RunSegment, SignalState, content_hash
from symphony.data.selection import MOVING, exclusion, interactive_agents, travel
from symphony.data.sources import sumo
from symphony.data.sources.sumo import process
from symphony.data.sources.sumo.networks import own_network, town
from symphony.data.sources.sumo.roads import read_network
from symphony.data.store import SegmentStore
from symphony.envs.routes import route_table
from symphony.errors import ConfigError, DataError
from symphony.roadgraph import LaneGraph, route_errors

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None,
    reason="SUMO is not installed (pip install 'symphony-traffic[sumo]')",
)
SPLITS: tuple[Literal["train", "test"], ...] = ("train", "test")
RULE = sumo.CropRule(focuses=3, per_focus=4)


@pytest.fixture(scope="module")
def simulated() -> dict[str, list[RunSegment]]:
    """Short runs of every kind; seeds with lights, roundabouts and stop signs among them."""
    runs = (("town", 0), ("town", 3), ("grid", 1), ("ramp", 1))
    return {f"{kind}-{seed}": sumo.generate_run(kind, seed, 45.0, rule=RULE).segments for kind, seed in runs}


@pytest.fixture(scope="module", params=["simulated", *SPLITS])
def segments(request: pytest.FixtureRequest) -> list[RunSegment]:
    """Run segments that must satisfy the laws below, fresh and built in."""
    if request.param != "simulated":
        return list(SegmentStore(builtin_store(request.param)))[::2]
    if importlib.util.find_spec("sumo") is None:
        pytest.skip("SUMO is not installed (pip install 'symphony-traffic[sumo]')")
    return [s for run in request.getfixturevalue("simulated").values() for s in run]


def ends(road: RoadMap) -> tuple[NDArray[Any], NDArray[Any]]:
    """First and last point [L, 2] of every lane."""
    points, offsets = road.lanes.points[:, :2], road.lanes.offsets
    return points[offsets[:-1]], points[offsets[1:] - 1]


def boxes(segment: RunSegment, step: int) -> NDArray[Any]:
    """Rectangles of the agents seen at a step."""
    seen = segment.valid[:, step]
    heading, half = segment.heading[seen, step], segment.size[seen, :2] / 2
    along = np.stack([np.cos(heading), np.sin(heading)], -1)[:, None]
    left = np.stack([-np.sin(heading), np.cos(heading)], -1)[:, None]
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    corners = signs[:, :1] * half[:, None, :1] * along + signs[:, 1:] * half[:, None, 1:] * left
    return shapely.polygons(segment.position[seen, step, None, :2] + corners)


# Laws of all segments


def test_segments_conform_and_keep_the_exclusions(segments: list[RunSegment]) -> None:
    """Schema, speeds, headings, lanes and the side of the boundary, and that vehicles are on the road."""
    report = check_segments(segments)
    assert report.numbers["off_road"] == 0
    for segment in segments:
        assert exclusion(segment, 2) is None
        pair = interactive_agents(segment, 2)
        assert segment.valid[pair].all()
        assert (travel(segment)[pair] > MOVING).all()
        assert (segment.num_steps, segment.dt, segment.source) == (51, 0.2, "sumo")
        first, last = ends(segment.road)
        gap = first[segment.road.successors[:, 1]] - last[segment.road.successors[:, 0]]
        assert np.linalg.norm(gap, axis=-1).max() < 0.5
        both = segment.valid[:, 1:] & segment.valid[:, :-1]
        assert np.linalg.norm(np.diff(segment.velocity, axis=1), axis=-1)[both].max() < 7.6 * segment.dt
        assert np.abs(np.diff(segment.heading, axis=1))[both].max() < 1.65 * segment.dt


def test_vehicles_do_not_overlap(segments: list[RunSegment]) -> None:
    for segment in segments:
        for step in range(0, segment.num_steps, 10):
            shapes = shapely.buffer(boxes(segment, step), -0.05, join_style="mitre")
            pairs = shapely.STRtree(shapes).query(shapes, predicate="intersects")
            assert (pairs[0] == pairs[1]).all(), (segment.segment_id, step)


def test_ego_follows_a_route_of_the_map(segments: list[RunSegment]) -> None:
    errors = []
    for segment in segments:
        graph, path = LaneGraph(segment.road), segment.position[segment.ego, :, :2]
        table = route_table(segment, graph, segment.ego)
        assert table.logged >= 0, segment.segment_id
        lines = [table.line(route) for route in range(len(table.count))]
        errors.append(route_errors(lines, path[segment.valid[segment.ego]]).min())
    assert np.mean(errors) < 0.5


def test_lights_stand_where_their_lane_enters_the_junction(segments: list[RunSegment]) -> None:
    assert any(len(s.signal_lane) for s in segments)
    for segment in segments:
        first, last = ends(segment.road)
        assert len(np.unique(segment.signal_lane)) == len(segment.signal_lane)
        away = np.linalg.norm(first[segment.signal_lane] - segment.signal_point[:, :2], axis=-1)
        assert away.max(initial=0) < 0.5
        for lane, point in zip(segment.signal_lane, segment.signal_point, strict=True):
            before = segment.road.successors[segment.road.successors[:, 1] == lane, 0]
            assert np.linalg.norm(last[before] - point[:2], axis=-1).min() < 1e-3


def test_nobody_drives_over_a_red_light(segments: list[RunSegment]) -> None:
    """Few cross the line while their light shows red: none that was red for the last two seconds."""
    crossings = offences = 0
    for s in segments:
        along = np.stack([np.cos(s.heading), np.sin(s.heading)], -1)
        nose = s.position[..., :2] + s.size[:, None, :1] / 2 * along
        for q, lane in enumerate(s.signal_lane):
            line = shapely.LineString(s.road.lanes[lane][:, :2])
            on = (shapely.distance(line, shapely.points(nose)) < 0.6) & s.valid
            crossed = on[:, 12:] & ~on[:, 11:-1] & s.valid[:, 11:-1]
            for agent, step in zip(*np.nonzero(crossed), strict=True):
                near = np.linalg.norm(nose[agent, step + 11] - s.signal_point[q, :2]) < 4
                speed = np.linalg.norm(s.velocity[agent, step + 11])
                red = (s.signal_state[:, step + 2 : step + 12] == SignalState.STOP).all(1)
                # Movements that share a start can't be told apart at the line.
                same = np.linalg.norm(s.signal_point - s.signal_point[q], axis=-1) < 1
                if near and speed > 1:
                    crossings += 1
                    offences += bool(red[same].all())
    assert crossings > 5
    assert offences == 0


# The generator


@needs_sumo
@pytest.mark.parametrize("name", ["town-0", "ramp-1"])
def test_same_seed_same_segments(simulated: dict[str, list[RunSegment]], name: str) -> None:
    kind, seed = name.split("-")
    again = sumo.generate_run(kind, int(seed), 45.0, rule=RULE).segments
    assert [content_hash(s) for s in again] == [content_hash(s) for s in simulated[name]]


@needs_sumo
def test_segments_of_one_focus_share_map_and_origin(simulated: dict[str, list[RunSegment]]) -> None:
    for run in simulated.values():
        by_focus: dict[str, list[RunSegment]] = {}
        for segment in run:
            by_focus.setdefault(segment.segment_id.split("-w")[0], []).append(segment)
        assert any(len(group) > 1 for group in by_focus.values())
        assert all(len({(id(s.road), s.origin.tobytes()) for s in group}) == 1 for group in by_focus.values())
        assert len({id(segment.road) for segment in run}) == len(by_focus)


# Roads of one's own


def driven_length(file: Path) -> float:
    """Metres of lane for traffic."""
    _, length, lanes = read_network(file).edge_graph()
    return float((length * lanes).sum())


@needs_sumo
def test_traffic_of_ours_drives_on_opendrive(tmp_path: Path) -> None:
    """It holds the roads it was made of. Equal arguments give equal stores; the seed and the file decide."""
    made, file = town(np.random.default_rng(3), tmp_path), tmp_path / "own town.xodr"
    arguments = f"--sumo-net-file {made.name} --opendrive-output town.xodr"
    process.run_program("netconvert", arguments, tmp_path)
    (tmp_path / "town.xodr").rename(file)
    length = driven_length(made)
    assert driven_length(own_network(file, tmp_path)) == pytest.approx(length, rel=0.1)
    plans = {name: Plan(3, seed=seed, kinds=(str(file),)) for name, seed in (("a", 0), ("b", 0), ("c", 1))}
    for name, plan in plans.items():
        assert generate(plan, tmp_path / name).complete
    a, b, c = (SegmentStore(tmp_path / name) for name in plans)
    assert [name.split("-")[1] for name in a.ids] == ["own_town"] * 3
    assert a.checksum() == b.checksum() != c.checksum()
    file.write_bytes(file.read_bytes() + b"\n")
    with pytest.raises(ConfigError, match="made with roads"):
        generate(plans["a"], tmp_path / "a")


OSM = """<osm version="0.6">
{nodes}
<way id="1">{west}<tag k="highway" v="residential"/></way>
<way id="2">{south}<tag k="highway" v="residential"/></way>
<way id="3"><nd ref="6"/><nd ref="7"/><tag k="highway" v="footway"/></way>
</osm>"""


@needs_sumo
def test_streets_of_openstreetmap_are_driven_and_footways_are_not(tmp_path: Path) -> None:
    """Two streets of 600 m that cross, and a footway."""
    places = {1: (0, -3), 2: (0, 0), 3: (0, 3), 4: (-3, 0), 5: (3, 0), 6: (1, 1), 7: (2, 2)}
    nodes = [
        f'<node id="{k}" lat="{48 + 0.0009 * x:.6f}" lon="{9 + 0.00134 * y:.6f}"/>'
        for k, (x, y) in places.items()
    ]
    west, south = ("".join(f'<nd ref="{k}"/>' for k in way) for way in ((1, 2, 3), (4, 2, 5)))
    file = tmp_path / "streets.osm"
    file.write_text(OSM.format(nodes="\n".join(nodes), west=west, south=south))
    network = read_network(own_network(file, tmp_path))
    assert (len(network.centers), len(network.sources())) == (1, 4)
    assert driven_length(tmp_path / "net.net.xml") == pytest.approx(4 * 600, rel=0.1)


@needs_sumo
@pytest.mark.parametrize("text", ["", "<OpenDRIVE/>", "<nothing", "\0"])
def test_what_is_no_map_is_an_error_that_names_it(tmp_path: Path, text: str) -> None:
    file = tmp_path / "roads.xodr"
    file.write_text(text)
    with pytest.raises(DataError, match=r"roads\.xodr"):
        own_network(file, tmp_path)
    with pytest.raises(ConfigError, match="there is no file"):
        Plan(1, kinds=("nowhere.xodr",))


# The built-in set


def test_builtin_sets_are_small_varied_and_apart() -> None:
    stores = {split: SegmentStore(builtin_store(split)) for split in SPLITS}
    networks = {s: {store.tags(i)["network"] for i in range(len(store))} for s, store in stores.items()}
    sizes = [len(each) for each in (*stores.values(), *networks.values())]
    assert (np.array(sizes) >= (48, 16, 12, 5)).all()
    assert not networks["train"] & networks["test"]
    roads_of = [
        {content_hash(store.road(k)) for k in range(len(store.map_hashes))} for store in stores.values()
    ]  # type: ignore[arg-type]
    assert not roads_of[0] & roads_of[1]
    for store in stores.values():
        store.verify()
        assert {store.tags(i)["kind"] for i in range(len(store))} == {"town", "grid", "ramp"}
        turns, lit = zip(
            *((np.ptp(s.heading[s.ego]) > 0.5, len(s.signal_lane) > 0) for s in store), strict=True
        )
        assert 0.25 < np.mean(turns) < 0.8
        assert np.mean(lit) > 0.25
    folder = builtin_store("train").parent
    assert sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) < 5e6
