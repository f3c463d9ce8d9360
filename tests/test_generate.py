"""Simulated driving: laws of its run segments, fresh and built in, the generator, and roads of one's own."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_segments import straight_road, turned
from helpers_sources import off_road
from helpers_store import fill
from symphony.cli import main
from symphony.data import generate as generation
from symphony.data.builtin import builtin_store
from symphony.data.conformance import check_segments
from symphony.data.generate import MAX_SEED, PRESETS, SPLITS, Harvest, Plan, Split, Task, generate
from symphony.data.segment import AgentType, MarkType, RoadMap, RunSegment, SignalState, content_hash
from symphony.data.selection import MOVING, exclusion, interactive_agents, travel
from symphony.data.sources import sumo
from symphony.data.sources.sumo import process
from symphony.data.sources.sumo.networks import drive_as_drawn, own_network, town
from symphony.data.sources.sumo.process import run_program
from symphony.data.sources.sumo.roads import read_network, shape
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs.routes import route_table
from symphony.errors import ConfigError, DataError
from symphony.evaluation.logs import measure, shortfalls
from symphony.roadgraph import LaneGraph, route_errors
from test_geometry import polygons

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="SUMO is not installed (pip install 'symphony-traffic[sumo]')"
)
seeds = st.integers(0, MAX_SEED)
numbers = st.integers(0, generation.BLOCK - 1)


@pytest.fixture(scope="module")
def segments() -> list[RunSegment]:
    """Some of the built-in run segments, on several maps."""
    return list(SegmentStore(builtin_store("train")))[:12]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, segments: list[RunSegment]) -> None:
    """Networks that give one to three segments each in no time; each seventh fails and each fifth gives none."""

    def give(task: Task) -> Harvest:
        if task.seed % 7 == 3:
            return Harvest(task, [], error="netconvert failed", seconds=0.5)
        count = 0 if task.seed % 5 == 2 else 1 + task.seed % 3
        names = [f"{task.name}-{k}" for k in range(count)]
        made = [segments[(task.seed + k) % len(segments)].replace(segment_id=n) for k, n in enumerate(names)]
        return Harvest(task, made, accepted=count + 1, reasons=Counter(overlap=2), seconds=0.25)

    monkeypatch.setattr(generation, "harvest", give)
    monkeypatch.setattr(generation, "sumo_version", lambda: "0.0")


@given(seeds, seeds, st.sampled_from(SPLITS), st.sampled_from(SPLITS), numbers, numbers)
def test_no_two_networks_are_alike(a: int, b: int, split_a: Split, split_b: Split, i: int, j: int) -> None:
    first, second = next(Plan(1, a, split_a).networks(i)), next(Plan(1, b, split_b).networks(j))
    assert (first.seed == second.seed) == ((a, split_a, i) == (b, split_b, j))
    # Below 2^32, each seed is one word of NumPy's seed sequence: no two of them mix to the same stream.
    assert 1_000_000 <= first.seed < 2**32


def test_bad_plans_name_the_field() -> None:
    bad = {"segments": 0, "seed": MAX_SEED + 1, "split": "dev", "kinds": (), "duration": 15, "interactive": 1}
    for field, value in [*bad.items(), ("kinds", ("village",))]:
        with pytest.raises(ConfigError, match=field.rstrip("s")):
            Plan(**{"segments": 5, field: value})


@pytest.mark.usefixtures("fake")
def test_one_that_was_finished_before_its_lock_was_taken(tmp_path: Path, monkeypatch: Any) -> None:
    plan, begun, looks = Plan(5), generation._begun, [0]
    state = generate(plan, tmp_path / "store")
    before = SegmentStore(tmp_path / "store").checksum()

    def at_first_not(*args: Any) -> Any:
        looks[0] += 1
        return dataclasses.replace(begun(*args), complete=looks[0] > 1)

    monkeypatch.setattr(generation, "_begun", at_first_not)
    assert generate(plan, tmp_path / "store") == state
    assert (looks, SegmentStore(tmp_path / "store").checksum()) == ([2], before)


@pytest.mark.usefixtures("fake")
def test_an_interrupted_store_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = Plan(23, seed=4)
    whole = generate(plan, tmp_path / "whole")
    want = SegmentStore(tmp_path / "whole")
    assert (len(want), whole.complete, bool(whole.failed)) == (23, True, True)

    real, left = StoreWriter.append, [0]

    def append(self: StoreWriter, *args: Any, **options: Any) -> int:
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        return real(self, *args, **options)

    # Each attempt is stopped a few segments further on, within a network or between two.
    monkeypatch.setattr(StoreWriter, "append", append)
    attempts = 0
    while True:
        left[0], attempts = 1 + attempts % 4, attempts + 1
        try:
            state = generate(plan, tmp_path / "broken")
            break
        except KeyboardInterrupt:
            assert not SegmentStore(tmp_path / "broken").report["generation"]["complete"]
    assert attempts > 6
    store = SegmentStore(tmp_path / "broken")
    assert store.ids == want.ids
    assert store.checksum() == want.checksum()
    assert state == whole
    assert [store.tags(i) for i in range(23)] == [want.tags(i) for i in range(23)]
    monkeypatch.setattr(generation, "harvest", None)  # a finished one is left as it is
    assert generate(plan, tmp_path / "broken", workers=3) == state


@pytest.mark.usefixtures("fake")
def test_other_arguments_and_stores_are_refused(tmp_path: Path, segments: list[RunSegment]) -> None:
    generate(Plan(3), tmp_path / "mine")
    for field, value in {"segments": 10, "seed": 1, "split": "test", "kinds": ("grid",)}.items():
        with pytest.raises(ConfigError, match=f"made with {field}"):
            generate(dataclasses.replace(Plan(3), **{field: value}), tmp_path / "mine")
    fill(tmp_path / "other", segments[:1])
    with pytest.raises(DataError, match="not generated"):
        generate(Plan(3), tmp_path / "other")
    assert len(SegmentStore(tmp_path / "other")) == 1


@pytest.mark.usefixtures("fake")
def test_networks_in_vain_come_to_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation, "harvest", lambda task: Harvest(task, [], reasons=Counter(overlap=3)))
    with pytest.raises(DataError, match=rf"{generation.BARREN} networks(.|\n)*{3 * generation.BARREN} x overlap"):
        generate(Plan(3), tmp_path)


@needs_sumo
def test_a_killed_run_is_continued(tmp_path: Path) -> None:
    out = tmp_path / "killed"
    what = f"data generate --count 12 --seed 11 --out {out}".split()
    command = [sys.executable, "-m", "symphony", *what]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        index = out / "segments.idx"
        while process.poll() is None and not (index.exists() and index.stat().st_size):
            time.sleep(0.002)
    finally:
        process.kill()
        process.wait()
    some = len(SegmentStore(out))
    assert 0 < some < 12
    if os.name == "posix":
        assert process.returncode == -signal.SIGKILL
    assert main([*what, "--workers", "2", "--json", str(tmp_path / "killed.json")]) == 0
    state = generate(Plan(12, seed=11), tmp_path / "whole")
    store, whole = SegmentStore(out), SegmentStore(tmp_path / "whole")
    assert store.checksum() == whole.checksum()
    assert store.ids == whole.ids
    written = json.loads((tmp_path / "killed.json").read_text())["stores"]["train"]
    assert written["checksum"] == whole.checksum()
    assert written["generation"]["reasons"] == state.reasons


@pytest.mark.usefixtures("fake")
def test_a_preset_makes_three_stores(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    plans: dict[Split, Plan] = {split: Plan(4, split=split) for split in SPLITS}
    monkeypatch.setattr("symphony.data.sources.sumo.sumo_version", lambda: "0.0")
    small = generation.Preset(plans, dict.fromkeys(SPLITS, "0" * 64))
    monkeypatch.setitem(PRESETS, "town-small", small)
    assert main(["data", "generate", "--out", str(tmp_path), "--preset", "town-small"]) == 0
    assert capsys.readouterr().err.count("made with SUMO 0.0") == 3


def test_built_in_set_meets_the_targets(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path, file = builtin_store("test"), tmp_path / "quality.json"
    assert main(["data", "quality", str(path), "--json", str(file)]) == 0
    assert "collision rate" in capsys.readouterr().out
    quality = json.loads(file.read_text())
    assert quality == measure(SegmentStore(path))
    assert shortfalls(quality) == []
    assert quality["segments"] == len(SegmentStore(path))
    assert quality["fit_error"]["mean"] < 0.1


@pytest.fixture
def altered(tmp_path: Path, segments: list[RunSegment]) -> Any:
    """Measures of one segment after a change."""

    def alter(**changes: Any) -> dict[str, Any]:
        place = tmp_path / f"s{len(list(tmp_path.iterdir()))}"
        return measure(fill(place, [segments[0].replace(**changes)]))

    return alter


def test_faults_are_found(altered: Any, segments: list[RunSegment], tmp_path: Path) -> None:
    segment = segments[0]
    ego, partner = interactive_agents(segment, 2)
    plain = altered()
    assert (plain["collision_rate"], plain["offroad_time"]) == (0, 0)
    # The partner where the ego is, for one step, and both of them beside the road for half the time.
    position = segment.position.copy()
    position[partner, 20] = position[ego, 20]
    assert altered(position=position)["collision_rate"] == 100
    position = segment.position.copy()
    edge = segment.road.boundary[0][:, :2]
    along = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
    beside = (edge[0] + edge[1]) / 2 + np.array([along[1], -along[0]])
    position[np.ix_([ego, partner], np.arange(26, 51), [0, 1])] = beside
    moved = altered(position=position)
    assert moved["offroad_time"] == 50
    assert moved["fit_error"]["mean"] > 1
    assert any("offroad_time" in text for text in shortfalls(moved))
    velocity = segment.velocity * 2
    assert altered(velocity=velocity)["speed"]["mean"] == pytest.approx(2 * plain["speed"]["mean"], abs=2e-4)
    assert measure(fill(tmp_path / "left", segments[2:3]))["directions"] == {"straight": 0, "left": 100, "right": 0}
    # What is not there does not count: here 15 of 50 + 34 steps are off the road.
    half = straight_road(2)
    half.valid[1, 10:20] = half.valid[1, 45:] = False
    half.velocity[1, 10:20] = half.position[1, 45:] = 99
    found = measure(fill(tmp_path / "half", [half]))
    assert (found["acceleration"]["std"], found["fit_error"]["max"]) == pytest.approx((0, 0), abs=0.3)
    half.position[1, 30:45, 1] += 50
    assert measure(fill(tmp_path / "off", [half]))["offroad_time"] == pytest.approx(100 * 15 / 84, abs=1e-3)


def test_measures_do_not_depend_on_which_way_north_is(altered: Any, segments: list[RunSegment]) -> None:
    other = turned(segments[0], np.pi / 2)
    names = ("position", "velocity", "heading", "signal_point", "road")
    found = altered(**{name: getattr(other, name) for name in names})
    for name, value in altered().items():
        assert found[name] == pytest.approx(value, abs=0.02), name


BUILT_IN: tuple[Literal["train", "test"], ...] = ("train", "test")
RULE = sumo.CropRule(focuses=3, per_focus=4)


@pytest.fixture(scope="module")
def simulated() -> dict[str, list[RunSegment]]:
    """Short runs of every kind; seeds with lights, roundabouts and stop signs among them."""
    runs = (("town", 3), ("grid", 1), ("ramp", 1), ("street", 1))
    return {f"{kind}-{seed}": sumo.generate_run(kind, seed, 45.0, rule=RULE)[0] for kind, seed in runs}


@pytest.fixture(scope="module", params=["simulated", *BUILT_IN])
def driven(request: pytest.FixtureRequest) -> list[RunSegment]:
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


@needs_sumo
def test_in_streets_cars_are_parked_and_people_cross_at_crosswalks(simulated: dict[str, list[RunSegment]]) -> None:
    counts = np.zeros(5)
    for s in simulated["street-1"]:
        cars, people = s.agent_type == AgentType.VEHICLE, s.agent_type == AgentType.PEDESTRIAN
        moving = cars & (travel(s) > MOVING)
        assert s.size[moving, 1].max() < 2.0  # wider ones can not pass
        away = np.linalg.norm(s.position[moving & s.valid.all(1), 0] - s.position[s.ego, 0], axis=-1)
        assert (away < 40).sum() > 1  # the ego and another
        edges = shapely.union_all([shapely.linestrings(line[:, :2]) for line in s.road.boundary])
        on_road = s.size[:, 1] / 2 - shapely.distance(edges, shapely.points(s.position[:, 0, :2]))
        parked = cars & s.valid.all(1) & (np.ptp(s.position, axis=1).max(1) == 0) & (on_road > -0.3) & (on_road < 1.1)
        away = np.linalg.norm(s.position[parked, None] - s.position[None, moving], axis=-1)
        counts[:3] += parked.sum(), ((away < 3.0) & s.valid[moving]).any((1, 2)).sum(), on_road[parked].sum()
        spots = s.position[s.valid & people[:, None], :2]
        rings = [s.road.marks[k][:, :2] for k in np.flatnonzero(s.road.mark_type == MarkType.CROSSWALK)]
        on_marks = shapely.contains_xy(shapely.union_all(shapely.polygons(rings)).buffer(0.3), *spots.T)
        assert (on_marks | (off_road(s.road, spots) > 0)).mean() > 0.99
        counts[3:] += on_marks.sum(), (s.agent_type == AgentType.CYCLIST).sum()
    assert (counts > [30, 3, 9, 50, 5]).all()


@needs_sumo
def test_who_is_told_to_drive_or_stand_in_a_street_does(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[NDArray[np.bool_]]()
    monkeypatch.setattr(sumo, "cut_segments", lambda _, __, traffic, *___: seen.append(traffic.present) or ([], {}))
    sumo.generate_run("street", 1, 45.0)
    assert np.sum(seen[0].any(1)) == len(seen[0]) > 50


@needs_sumo
@pytest.mark.parametrize("seed", [5, 7])
def test_on_a_freeway_nobody_appears_or_ends_inside_the_map(seed: int) -> None:
    """The ends of the other carriageway and of its ramps are outside, too."""
    for s in sumo.generate_run("ramp", seed, 45.0)[0]:
        inside = np.linalg.norm(s.position[..., :2], axis=-1) < 170
        ends = np.diff(s.valid, axis=1)
        assert not (ends & np.where(s.valid[:, 1:], inside[:, 1:], inside[:, :-1])).any(), s.segment_id


def test_segments_conform_and_keep_the_exclusions(driven: list[RunSegment]) -> None:
    """Schema, speeds, headings, lanes and the side of the boundary, and that vehicles are on the road."""
    report = check_segments(driven)
    assert report.numbers["off_road"] == 0
    for segment in driven:
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
        both &= (segment.agent_type != AgentType.PEDESTRIAN)[:, None]  # who turn on the spot
        assert np.abs(np.diff(segment.heading, axis=1))[both].max() < 1.65 * segment.dt


def test_vehicles_do_not_overlap(driven: list[RunSegment]) -> None:
    for segment in driven:
        for step in range(0, segment.num_steps, 10):
            seen = segment.valid[:, step]
            now = segment.position[seen, step, :2], segment.heading[seen, step], segment.size[seen, :2]
            shapes = shapely.buffer(polygons(*map(torch.from_numpy, now)), -0.05, join_style="mitre")
            pairs = shapely.STRtree(shapes).query(shapes, predicate="intersects")
            assert (pairs[0] == pairs[1]).all(), (segment.segment_id, step)


def test_ego_follows_a_route_of_the_map(driven: list[RunSegment]) -> None:
    errors = []
    for segment in driven:
        graph, path = LaneGraph(segment.road), segment.position[segment.ego, :, :2]
        table = route_table(segment, graph, segment.ego)
        assert table.logged >= 0, segment.segment_id
        lines = [table.line(route) for route in range(len(table.count))]
        errors.append(route_errors(lines, path[segment.valid[segment.ego]]).min())
    assert np.mean(errors) < 0.5


def test_lights_stand_where_their_lane_enters_the_junction(driven: list[RunSegment]) -> None:
    assert any(len(s.signal_lane) for s in driven)
    for segment in driven:
        first, last = ends(segment.road)
        assert len(np.unique(segment.signal_lane)) == len(segment.signal_lane)
        away = np.linalg.norm(first[segment.signal_lane] - segment.signal_point[:, :2], axis=-1)
        assert away.max(initial=0) < 0.5
        for lane, point in zip(segment.signal_lane, segment.signal_point, strict=True):
            before = segment.road.successors[segment.road.successors[:, 1] == lane, 0]
            assert np.linalg.norm(last[before] - point[:2], axis=-1).min() < 1e-3


def test_nobody_drives_over_a_red_light(driven: list[RunSegment]) -> None:
    """Nobody crosses the line of a light that was red for two seconds; who waits at it starts when it is green."""
    crossings = offences = waited = 0
    for s in driven:
        along = np.stack([np.cos(s.heading), np.sin(s.heading)], -1)
        nose, drives = s.position[..., :2] + s.size[:, None, :1] / 2 * along, s.agent_type != AgentType.PEDESTRIAN
        for q, lane in enumerate(s.signal_lane):
            away, pace = np.linalg.norm(nose - s.signal_point[q, :2], axis=-1), np.linalg.norm(s.velocity, axis=-1)
            for green in (
                np.flatnonzero((s.signal_state[q, 3:] == SignalState.GO) & (s.signal_state[q, 2:-1] < 5)) + 3
            ):
                waits = s.valid[:, green] & (away[:, green - 3] < 2) & (pace[:, green - 3] < 0.01)
                waited += waits.sum()
                assert (pace[waits, green] < 0.1).all()
            line = shapely.LineString(s.road.lanes[lane][:, :2])
            on = (shapely.distance(line, shapely.points(nose)) < 0.6) & s.valid
            crossed = on[:, 12:] & ~on[:, 11:-1] & s.valid[:, 11:-1] & drives[:, None]
            for agent, step in zip(*np.nonzero(crossed), strict=True):
                near = np.linalg.norm(nose[agent, step + 11] - s.signal_point[q, :2]) < 4
                red = (s.signal_state[:, step + 2 : step + 12] == SignalState.STOP).all(1)
                # Movements that share a start can't be told apart at the line.
                same = np.linalg.norm(s.signal_point - s.signal_point[q], axis=-1) < 1
                if near and pace[agent, step + 11] > 1:
                    crossings += 1
                    offences += bool(red[same].all())
    assert crossings > 5
    assert waited > 1
    assert offences == 0


def driven_length(file: Path) -> float:
    """Metres of lane for traffic."""
    _, length, lanes = read_network(file).edge_graph()
    return float((length * lanes).sum())


@needs_sumo
def test_traffic_of_ours_drives_on_opendrive(tmp_path: Path, monkeypatch: Any) -> None:
    """It holds the roads it was made of. Equal arguments give equal stores; the seed and the file decide."""
    made, file = town(np.random.default_rng(3), tmp_path), tmp_path / "own town.xodr"
    arguments = f"--sumo-net-file {made.name} --opendrive-output town.xodr"
    process.run_program("netconvert", arguments, tmp_path)
    (tmp_path / "town.xodr").rename(file)
    length = driven_length(made)
    assert driven_length(own_network(file, tmp_path)) == pytest.approx(length, rel=0.1)
    monkeypatch.setattr(generation, "RECORDED", 0.0)  # as little as a segment needs
    plans = {name: Plan(3, seed=seed, kinds=(str(file),)) for name, seed in (("a", 0), ("b", 0), ("c", 1))}
    for name, plan in plans.items():
        assert generate(plan, tmp_path / name).complete
    a, b, c = (SegmentStore(tmp_path / name) for name in plans)
    assert [name.split("-")[1] for name in a.ids] == ["own_town"] * 3
    assert a.checksum() == b.checksum() != c.checksum()
    file.write_bytes(file.read_bytes() + b"\n")
    with pytest.raises(ConfigError, match="made with roads"):
        generate(plans["a"], tmp_path / "a")


XODR = """<OpenDRIVE xmlns="http://code.asam.net/simulation/standard/opendrive_schema">
<header revMajor="1" revMinor="6"/><road id="7" junction="-1" length="250"><link/>
<type s="0" type="town"><speed max="30" unit="mph"/></type><planView>{pieces}</planView>
<lanes><laneSection s="0">{lanes}</laneSection><laneSection s="125">{lanes}</laneSection></lanes>
<signals><signal id="1" s="60" t="-8" orientation="+" dynamic="yes" type="1000001" subtype="-1"/></signals>
</road></OpenDRIVE>"""
LANE = '<lane id="{0}" type="driving"><link>{2}</link><width sOffset="0" a="{1}" b="0" c="0" d="0"/></lane>'


@needs_sumo
def test_lanes_lie_where_opendrive_has_them(tmp_path: Path) -> None:
    """A road of a line, clothoids and arcs, integrated apart: centres, widths, directions, the limit; no light where
    nothing crosses, whatever stands there. Traffic of ours drives on it, though it has no junction.
    """
    knots, bend = [0, 60, 100, 170, 220, 250], [0, 0, 0.02, 0.02, -0.01, -0.01]
    s = np.linspace(0, 250, 25_001)
    turn = 0.3 + np.cumsum(np.interp(s, knots, bend)) * 0.01
    way = np.stack([np.cos(turn), np.sin(turn)], -1)
    place = np.array([500.0, -200.0]) + np.cumsum(way, 0) * 0.01
    pieces = ""
    for begin, end, *curves in zip(knots, knots[1:], bend, bend[1:], strict=False):
        k, (first, last) = 100 * begin, curves
        at = f's="{begin}" x="{place[k, 0]}" y="{place[k, 1]}" hdg="{turn[k]}" length="{end - begin}"'
        shape = f'<spiral curvStart="{first}" curvEnd="{last}"/>' if first != last else f'<arc curvature="{first}"/>'
        pieces += f"<geometry {at}>{shape if first or last else '<line/>'}</geometry>"
    link = "".join(f'<{name} id="{{0}}"/>' for name in ("predecessor", "successor"))
    made = {k: LANE.format(k, width, link.format(k)) for k, width in ((1, 3), (-1, 3.5), (-2, 3))}
    lanes = f'<left>{made[1]}</left><center><lane id="0" type="none"/></center><right>{made[-1]}{made[-2]}</right>'
    file = tmp_path / "bends.xodr"
    file.write_text(XODR.format(pieces=pieces, lanes=lanes))
    network = read_network(net := own_network(file, tmp_path))
    assert network.speed == pytest.approx(30 * 0.44704, abs=0.01)
    assert network.connectors == {}
    left = np.stack([-way[:, 1], way[:, 0]], -1)
    lanes_of = [(line, w) for line, w in zip(network.lanes, network.width, strict=True) if len(line) > 2]
    for aside, width, sign in ((1.5, 3.0, -1), (-1.75, 3.5, 1), (-5.0, 3.0, 1)):
        truth = shapely.LineString((place + aside * left)[::sign])
        mine = [k for k in lanes_of if shapely.distance(truth, shapely.points(k[0])).max() < 0.03]
        ahead = [truth.project(shapely.points(line)) for line, _ in mine]
        assert all((np.diff(each) > 0).all() for each in ahead)
        assert sum(map(np.ptp, ahead)) == pytest.approx(truth.length, abs=0.5)
        assert [w for _, w in mine] == pytest.approx([width] * 2, abs=0.01)
    drive_as_drawn(net, own=True)
    slow = [v for line, v in zip(network.lanes, read_network(net).speed, strict=True) if len(line) > 2]
    assert max(slow) < np.sqrt(3.0 / 0.02) * 1.05
    assert generate(Plan(1, kinds=(str(file),)), tmp_path / "store").complete


@needs_sumo
@pytest.mark.parametrize(("limit", "speeds"), [
    ('max="undefined" unit=""/></type><type s="9"><speed', {50}), ('max="30" unit="mph"', {48}),
    ('max="80"/></type><type s="60"><speed max="no limit"/></type><type s="190"><speed max="25"', {288, 130, 90}),
])  # fmt: skip
def test_a_straight_road_is_seen_from_its_middle(tmp_path: Path, limit: str, speeds: set[int]) -> None:
    lanes = f'<center><lane id="0" type="none"/></center><right>{LANE.format(-1, 3, "")}</right>'
    text = XODR.format(pieces='<geometry s="0" x="0" y="0" hdg="0" length="250"><line/></geometry>', lanes=lanes)
    file = tmp_path / "straight.xodr"
    bad = ("unit", "mph", "kmh"), ("can't be read", '"3"', '"NaN"'), ("not well-formed", "</road>", "")
    for why, old, new in bad:
        file.write_text(text.replace(old, new))
        with pytest.raises(DataError, match=rf"straight\.xodr.*{why}"):
            generate(Plan(1, kinds=(str(file),)), tmp_path / "out")
    file.write_text(text.replace('max="30" unit="mph"', limit))
    network = read_network(own_network(file, tmp_path))
    assert {round(3.6 * v) for v in network.speed[~np.array(network.internal)]} == speeds
    file.write_text(text.replace("driving", "onRamp").replace('"30" unit="mph"', '"9"/></type><type s="99"><speed'))
    assert {round(3.6 * v) for v in read_network(own_network(file, tmp_path)).speed} >= {32, 50, 80}  # its own
    ends = np.concatenate([line[[0, -1]] for line in network.lanes])
    assert np.linalg.norm(np.array(network.centers)[:, None] - ends, axis=-1).min() > 20


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
    where = {k: f'lat="{48 + 0.0009 * x:.6f}" lon="{9 + 0.00134 * y:.6f}"' for k, (x, y) in places.items()}
    nodes = [f'<node id="{k}" {place}/>' for k, place in where.items()]
    west, south = ("".join(f'<nd ref="{k}"/>' for k in way) for way in ((1, 2, 3), (4, 2, 5)))
    (file := tmp_path / "streets.osm").write_text("nothing yet")
    with pytest.raises(DataError, match=r"streets\.osm"):
        generate(Plan(1, kinds=(str(file),)), tmp_path / "store")
    file.write_text(OSM.format(nodes="\n".join(nodes), west=west, south=south))
    network = read_network(own_network(file, tmp_path))
    assert (len(network.centers), len(network.sources())) == (1, 4)
    assert driven_length(tmp_path / "net.net.xml") == pytest.approx(4 * 600, rel=0.1)
    assert generate(Plan(1, kinds=(str(file),)), tmp_path / "store").complete  # the mended file
    file.write_text(re.sub('<way id="2".*', "", file.read_text()))
    assert len(read_network(own_network(file, tmp_path)).lanes) == 2  # a road that meets no other


@needs_sumo
@pytest.mark.parametrize("more", ["lefthand", "bikelanes.guess", "crossings.guess", "no-internal-links"])
def test_only_lanes_for_cars_count_on_either_side_of_the_road(tmp_path: Path, more: str) -> None:
    grid = "--grid --grid.number 3 --grid.length 120 --default.lanenumber 2 --default-junction-type allway_stop"
    run_program("netgenerate", f"{grid} --sidewalks.guess true --output-file g.net.xml --{more} 1", tmp_path)
    file = tmp_path / "g.net.xml"
    text = file.read_text().replace('disallow="pedestrian', 'disallow="truck bus pedestrian')
    file.write_text(text.replace('from="A0A1" to="A1', 'disallow="passenger" from="A0A1" to="A1', 1))  # a turn
    assert generate(Plan(1, kinds=(str(file),)), tmp_path / "store").complete
    (segment,) = SegmentStore(tmp_path / "store")
    assert segment.road.lane_width == pytest.approx(3.2)
    signs = segment.road.marks.points[np.repeat(segment.road.mark_type, np.diff(segment.road.marks.offsets)) == 5]
    assert off_road(segment.road, signs[:, :2]).min() > -0.01
    check_segments([segment])


@needs_sumo
@pytest.mark.parametrize("rule", ['allow="bus"', 'disallow="all"', 'changeLeft="authority"'])
def test_lanes_are_beside_each_other_where_cars_may_change(tmp_path: Path, rule: str) -> None:
    run_program("netgenerate", "--grid --grid.number 3 --default.lanenumber 3 --output-file g.net.xml", tmp_path)
    middle, file = r'<lane id="\w+_1"', tmp_path / "g.net.xml"  # the middle one of three has a rule of its own
    file.write_text(re.sub(middle, rf"\g<0> {rule}", file.read_text()))
    network = read_network(net := own_network(file, tmp_path))
    lanes, left, right = (3, 1, 2) if "change" in rule else (2, 0, 0)
    assert [(~network.internal).sum(), *map(len, network.beside)] == [24 * lanes, 24 * left, 24 * right]
    assert (network.beside[0] @ [-1, 1] == 1).all()
    net.write_text(net.read_text().replace(' length="', ' length="9'))
    drive_as_drawn(net, own=True)
    assert len(re.findall(rf'{middle} [^>]*allow="pedestrian"', net.read_text())) == 24 * (3 - lanes)  # nor buses
    for length, line in re.findall(r'<lane id="\w+" [^>]* length="(\S+)" [^>]*shape="([^"]+)"', net.read_text()):
        assert float(length) == pytest.approx(shapely.LineString(shape(line)).length, abs=0.1)


@needs_sumo
def test_opendrive_of_those_who_drive_on_the_left_is_refused(tmp_path: Path) -> None:
    (tmp_path / "left.xodr").write_text('<OpenDRIVE><road rule="LHT" id="1"/></OpenDRIVE>')
    with pytest.raises(DataError, match="drives on the left"):
        own_network(tmp_path / "left.xodr", tmp_path)


@needs_sumo
@pytest.mark.parametrize("text", ["", "<OpenDRIVE/>", "<nothing", "\0", '<net><edge id="a" from="\xff"/></net>'])
def test_what_is_no_map_is_an_error_that_names_it(tmp_path: Path, text: str, monkeypatch: Any) -> None:
    monkeypatch.setenv("LC_ALL", "C")  # as in a container: what SUMO says may then be no UTF-8
    for name in ("roads.xodr", "roads.net.xml"):
        (tmp_path / name).write_text(text, encoding="latin-1")
        with pytest.raises(DataError, match=name):
            own_network(tmp_path / name, tmp_path)
    with pytest.raises(ConfigError, match="there is no file"):
        Plan(1, kinds=("nowhere.xodr",))


def test_builtin_sets_are_small_varied_and_apart() -> None:
    stores = {split: SegmentStore(builtin_store(split)) for split in BUILT_IN}
    networks = {s: {store.tags(i)["network"] for i in range(len(store))} for s, store in stores.items()}
    sizes = [len(each) for each in (*stores.values(), *networks.values())]
    assert (np.array(sizes) >= (48, 16, 12, 5)).all()
    assert not networks["train"] & networks["test"]
    roads_of = [{content_hash(s.road) for s in store} for store in stores.values()]  # type: ignore[arg-type]
    assert not roads_of[0] & roads_of[1]
    for store in stores.values():
        store.verify()
        assert {store.tags(i)["kind"] for i in range(len(store))} == {"town", "grid", "ramp"}
        turns, lit = [np.ptp(s.heading[s.ego]) > 0.5 for s in store], [len(s.signal_lane) > 0 for s in store]
        assert 0.25 < np.mean(turns) < 0.8
        assert np.mean(lit) > 0.25
    assert sum(file.stat().st_size for file in builtin_store("train").parent.rglob("*") if file.is_file()) < 5e6
