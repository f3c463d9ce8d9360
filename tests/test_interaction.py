"""The INTERACTION reader: layouts, windows, egos, lights, and files that are refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from helpers_interaction import CARS, COLUMNS, KML, META, PHASES, osm, public, taf, text, track, walker
from helpers_sources import read_error, read_one
from symphony.data.conformance import check_reader
from symphony.data.segment import AgentType, RunSegment, SignalState
from symphony.data.sources import get_reader


def segments(path: Path, **options: object) -> list[RunSegment]:
    """All segments of a file, which must be good."""
    items = list(get_reader("interaction", **options).read(path))
    assert all(isinstance(item, RunSegment) for item in items), items
    return [item for item in items if isinstance(item, RunSegment)]


def test_tracks_of_the_public_layout(tmp_path: Path) -> None:
    path = public(tmp_path, CARS, [*walker("P1"), *walker("P2", speed=6)])
    segment = read_one("interaction", path)
    assert (segment.segment_id, segment.group) == ("DR_X_000_t0", "DR_X_000")
    assert segment.file == "vehicle_tracks_000.csv"
    assert (segment.dt, segment.num_steps) == (0.1, 101)
    assert segment.agent_id.tolist() == [-3, -2, 3, 5, 9]
    kinds = [AgentType.CYCLIST, AgentType.PEDESTRIAN] + 3 * [AgentType.VEHICLE]
    assert segment.agent_type.tolist() == kinds
    np.testing.assert_allclose(segment.size[:, :2], [(1.8, 0.7), (0.7, 0.7)] + 3 * [(4.5, 2)], rtol=1e-6)
    # The middle of the map is the origin.
    np.testing.assert_array_equal(segment.origin, (50, 4, 0))
    car = segment.position[2] + segment.origin
    np.testing.assert_allclose(car[:, 0], np.arange(101), atol=1e-4)
    np.testing.assert_allclose(car[:, 1], 2, atol=1e-4)
    assert np.unique(segment.velocity[2], axis=0).tolist() == [[10, 0]]
    # Walkers look where they walk.
    np.testing.assert_allclose(segment.heading[1], np.pi / 2, rtol=1e-6)
    # Of the two that move and are there throughout, both have one neighbour that moves beside the walkers.
    assert segment.agent_id[segment.ego] == 3


def test_windows_of_a_recording(tmp_path: Path) -> None:
    path = public(tmp_path, track(3, steps=range(256)))
    found = segments(path)
    names = [f"DR_X_000_t{start}" for start in (0, 10, 20)]
    assert [(s.segment_id, s.num_steps) for s in found] == list(zip(names, (101, 101, 56), strict=True))
    np.testing.assert_allclose(found[1].position[:, 0], found[0].position[:, 100])
    assert [s.segment_id for s in segments(path, window=5, stride=10)] == names
    assert len(segments(path, window=20, stride=0.5)) == 32
    seen_within = [*track(1, speed=0, steps=range(256)), *track(3, steps=range(60, 140))]
    items = list(get_reader("interaction", stride=1).read(public(tmp_path, seen_within)))
    assert [s.segment_id for s in items if isinstance(s, RunSegment) and s.num_steps == 80] == ["DR_X_000_t4"]  # of 3
    # A rest of less than half a window is left out.
    assert [s.num_steps for s in segments(public(tmp_path, track(3, steps=range(250))))] == [101, 101]


def test_egos(tmp_path: Path) -> None:
    path = public(tmp_path, [*CARS, *track(7, y=6, steps=range(60))])
    one, two = segments(path, egos="all")
    assert [s.segment_id for s in (one, two)] == ["DR_X_000_t0_ego3", "DR_X_000_t0_ego5"]
    assert [s.agent_id[s.ego] for s in (one, two)] == [3, 5]
    assert one.group == two.group == "DR_X_000"
    np.testing.assert_array_equal(one.road.lanes.points, two.road.lanes.points)
    nobody = read_error("interaction", public(tmp_path, track(9, speed=0)))
    assert nobody.segment == "DR_X_000_t0"
    assert "no moving vehicle is observed at every step" in nobody.message


def test_an_ego_may_enter_late_and_leave_early(tmp_path: Path) -> None:
    late, early = track(3, steps=range(30, 120)), track(5, y=6, steps=range(60))
    parked = track(9, x=60, speed=0)
    (segment,) = segments(public(tmp_path, [*late, *early, *parked]))
    assert (segment.segment_id, segment.num_steps) == ("DR_X_000_t0", 71)
    assert segment.agent_id[segment.ego] == 3
    x = segment.position[segment.ego, :, 0] + segment.origin[0]
    np.testing.assert_allclose(x, np.arange(30, 101), atol=1e-4)
    alone = segments(public(tmp_path, [*track(9, steps=range(100)), *track(3, steps=range(140, 201))]))
    assert [one.num_steps for one in alone] == [100, 61]
    assert read_one("interaction", public(tmp_path, track(3, steps=[*range(71), *range(90, 101)]))).num_steps == 71
    short = public(tmp_path, [*track(3, steps=range(55, 120)), *parked])
    assert "no moving vehicle is observed at every step" in read_error("interaction", short).message


def cases(folder: Path, place: str, rows: list[str]) -> Path:
    path = folder / f"{place}_train.csv"
    path.write_text(text(rows, f"case_id,{COLUMNS},track_to_predict,interesting_agent"))
    return path


def test_cases_of_the_newer_layout(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "DR_Y.osm_xy").write_text(osm())
    rows = []
    for case, x in ((2.0, 0), (1.0, 20)):
        both = [*track(1, x=x, steps=range(1, 41)), *track(2, x=x - 12, steps=range(1, 41))]
        rows += [f"{case},{row},{int(k < 40)},0" for k, row in enumerate(both)]
        rows += [f"{case},P1,{k},{100 * k},pedestrian/bicycle,48,{k / 10},0,1,,,,0,1" for k in range(1, 41)]
    found = segments(cases(tmp_path / "train", "DR_Y", rows))
    assert [s.segment_id for s in found] == ["DR_Y_train_case1", "DR_Y_train_case2"]
    assert {s.group for s in found} == {"DR_Y_train"}
    for segment, x in zip(found, (20, 0), strict=True):
        assert (segment.num_steps, segment.current_step) == (40, 9)
        assert segment.agent_id.tolist() == [-2, 1, 2]
        assert (segment.predict.tolist(), segment.interest.tolist()) == ([1], [0])
        assert segment.agent_type[0] == AgentType.PEDESTRIAN
        np.testing.assert_allclose(segment.position[1, 0] + segment.origin, (x + 1, 2, 0), atol=1e-4)
    cells = [row.split(",") for row in rows if row[0] == "2"]
    on = [",".join([*some[:3], str(int(some[3]) + 5000), *some[4:]]) for some in cells]
    on += [row for row in rows if row[0] == "1"]
    assert [s.current_step for s in segments(cases(tmp_path / "train", "DR_Y", on))] == [9, 9]
    late = [row for row in rows if row[0] == "1" or int(row.split(",")[2]) > 5]
    assert [s.current_step for s in segments(cases(tmp_path / "train", "DR_Y", late))] == [9, 5]


def test_recordings_beside_their_own_maps_differ_by_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "map.osm_xy").write_text(osm())
        (tmp_path / name / "vehicle_tracks_000.csv").write_text(text(CARS))
    monkeypatch.chdir(public(tmp_path).parent)
    files = [Path(name, "vehicle_tracks_000.csv") for name in ("../../a", "../../b", ".")]
    assert [read_one("interaction", file).group for file in files] == ["a_map_000", "b_map_000", "DR_X_000"]


def test_cases_are_not_put_on_the_map_of_another_place(tmp_path: Path) -> None:
    (tmp_path / "DR_A.osm_xy").write_text(osm())
    rows = [f"1.0,{row},0,0" for row in (*track(1), *track(2, x=-12))]
    assert len(segments(cases(tmp_path, "DR_A", rows))) == 1
    assert "no maps/DR_B.osm" in read_error("interaction", cases(tmp_path, "DR_B", rows)).message


def test_lights_of_the_test_area(tmp_path: Path) -> None:
    segment = read_one("interaction", taf(tmp_path))
    assert segment.segment_id == "k1_001_t0"
    lane = segment.road.lane_id[segment.signal_lane].tolist()
    assert lane == [103, 104]
    # The stop line that the map names for the first lane, the stop point of the connection for the other.
    np.testing.assert_allclose(segment.signal_point + segment.origin, [(50, 4, 0), (49, 6, 0)], atol=1e-3)
    assert segment.signal_state[0].tolist() == 20 * [SignalState.STOP] + 81 * [SignalState.GO]
    assert segment.signal_state[1].tolist() == 20 * [SignalState.UNKNOWN] + 81 * [SignalState.STOP]
    later = segments(taf(tmp_path, rows=track(3, steps=range(80))), window=2, stride=3)
    assert [s.signal_state[0, 0] for s in later] == [SignalState.STOP, SignalState.GO, SignalState.GO]
    without = read_one("interaction", taf(tmp_path, "000"))
    assert without.signal_state.shape == (0, 101)
    np.testing.assert_allclose(without.position, segment.position, atol=1e-5)


def raw(x: float = 0, **options: float) -> list[str]:
    return [row for k in range(3) for row in track(k, x=x - 15 * k, **options)]


@pytest.mark.parametrize("factor", [0.56, -1.0, 3.6])
def test_velocities_that_are_not_those_of_the_positions(factor: float, tmp_path: Path) -> None:
    path = public(tmp_path, raw(logged=factor))
    error = read_error("interaction", path)
    assert error.field == "vx, vy"
    assert "motion='positions'" in error.message
    segment = read_one("interaction", path, motion="positions")
    np.testing.assert_allclose(segment.velocity, np.broadcast_to((10, 0), segment.velocity.shape), atol=1e-3)
    np.testing.assert_allclose(segment.heading, 0, atol=1e-3)


def test_headings_that_are_not_those_of_the_motion(tmp_path: Path) -> None:
    def turned(rows: list[str], angle: float) -> list[str]:
        return [row.replace(",0.0,0.0,4.5", f",0.0,{angle},4.5") for row in rows]

    path = public(tmp_path, turned(raw(), 3.1))
    assert read_error("interaction", path).field == "psi_rad"
    np.testing.assert_allclose(read_one("interaction", path, motion="positions").heading, 0, atol=1e-3)
    # What stands before it moves is turned as well, small differences are none, and one that stands keeps what was
    # logged. A window that shows the first seconds alone has the same states.
    still, later = track(0, speed=0, steps=range(30)), track(0, x=-30, steps=range(30, 120))
    rows = [*turned(still, 2.5), *turned(later, 0.3), *track(5, y=6), *turned(track(9, x=20, speed=0), 1.25)]
    (whole,), (first, *_) = (segments(public(tmp_path, rows), motion="positions", window=w) for w in (10, 3))
    np.testing.assert_allclose(whole.heading[0], np.where(np.arange(101) < 30, 0, 0.3), atol=1e-3)
    np.testing.assert_allclose(whole.heading[2], 1.25, rtol=1e-6)
    np.testing.assert_array_equal(whole.velocity[:, :31], first.velocity)
    np.testing.assert_array_equal(whole.heading[:, :31], first.heading)


def test_states_logged_twice(tmp_path: Path) -> None:
    rows = [*CARS, track(3)[7].replace("7.0000,2.0000", "7.2000,2.1000")]
    path = public(tmp_path, rows)
    error = read_error("interaction", path)
    assert "track 3 has two states at 700 ms" in error.message
    found = read_one("interaction", path, motion="positions")
    np.testing.assert_allclose(found.position[0, 7, :2] + found.origin[:2], (7.1, 2.05), atol=1e-4)
    for old, new in (("7.0000,2.0000", "17.0000,2.0000"), ("car", "pedestrian/bicycle")):
        path = public(tmp_path, [*CARS, track(3)[7].replace(old, new)])
        error = read_error("interaction", path, motion="positions")
        assert "track [3] has states at one time that are far apart or of two types" in error.message


GOOD = text(CARS)


@pytest.mark.parametrize(("content", "message"), [
    ("", "empty"), (GOOD[:-1], "cut short"), (GOOD.replace(",vy,", ",v,", 1), "0 columns of that name"),
    (GOOD.replace(",car,", ",", 1), "10 fields, expected 11"),
    (GOOD.replace(",2.0000,", ",inf,", 1), "'inf' can't be read"),
    (GOOD.replace(",2.0000,", ",,", 1), "'' can't be read"),
    (GOOD.replace(",car,", ",cow,", 1), "'cow' can't be read"),
    (GOOD.replace(",100,car", ",100.5,car", 1), "not multiples of their usual step"),
    (GOOD.replace(",100,car", ",130,car"), "not multiples of their usual step"),
    (GOOD.replace("car", "autó", 1), "line 2: not ASCII text"),
    (text([f"3.7,{row}" for row in CARS], f"case_id,{COLUMNS}"), "line 2: case_id: '3.7' can't be read"),
    (GOOD.replace(",car,", ",truck,", 1).replace(",truck,", ",bicycle,", 1), "more than one"),
    (GOOD.replace(",4.5,2.0", ",,"), "length and width must be positive"),
    (text(track(3, x=9000)), "away from the map"),
])  # fmt: skip
def test_broken_tracks_are_refused(content: str, message: str, tmp_path: Path) -> None:
    path = public(tmp_path)
    path.write_text(content, encoding="utf-8")
    error = read_error("interaction", path)
    assert message in str(error)
    assert error.file == path


MAP, META_DATA, SIGNALS, LANES = "../../maps/k1.osm", "meta_data.csv", "signal_phases_001.csv", "k1_map.kml"


@pytest.mark.parametrize(("name", "content", "message"), [
    (MAP, None, "the map is missing"), (MAP, "<osm/>", "has no lanelets"),
    (META_DATA, None, "away from the map"),  # another projection
    (META_DATA, META.replace("001", "002"), "0 rows for recording 001"), (META_DATA, META[:-1], "cut short"),
    (SIGNALS, None, "are missing"), (SIGNALS, PHASES[:-1], "cut short"),
    (SIGNALS, PHASES.replace("DARK", "PINK"), "is not a phase"), (META_DATA, META.replace("Avail", ""), "yes nor no"),
    (SIGNALS, PHASES.replace("2000", "1000"), "has two states"),
    (SIGNALS, PHASES.replace("000,", ","), "the tracks at 11900 ms"), (LANES, None, "are missing"),
    (LANES, KML.replace("<kml", "<!DOCTYPE kml><kml", 1), "document type"),
    (LANES, KML.replace("7, 8", "17, 18").replace(">8<", ">18<"), "fits a lane"),
    (LANES, KML.replace(">2<", ">2, 3<", 1), "is not one lane"), (LANES, KML.replace("7, 8", "7"), "1 for 2 sinks"),
])  # fmt: skip
def test_broken_companions_are_refused(name: str, content: str | None, message: str, tmp_path: Path) -> None:
    path = taf(tmp_path)
    companion = (path.parent / name).resolve()
    if content is None:
        companion.unlink()
    else:
        companion.write_text(content)
    error = read_error("interaction", path)
    assert message in error.message
    assert Path(str(error.file)).resolve() in {path, companion}


@pytest.mark.parametrize("layout", [public, taf])
def test_conforms(layout: Callable[..., Path], tmp_path: Path) -> None:
    """The recording in its folders, and with everything beside it."""
    path = layout(tmp_path / "tree", rows=[*CARS, *track(11, x=-30, speed=8)])
    (tmp_path / "flat").mkdir()
    for file in [*path.parent.iterdir(), *(path.parents[2] / "maps").iterdir()]:
        (tmp_path / "flat" / file.name).write_bytes(file.read_bytes())
    for each in (path, tmp_path / "flat" / path.name):
        assert check_reader(get_reader("interaction"), [each]).segments == 1


@pytest.mark.samples
def test_samples(samples: Path) -> None:
    folder = samples / "real" / "interaction" / "datasets" / "recorded_trackfiles"
    if not folder.is_dir():
        pytest.skip("the INTERACTION samples are not among the samples")
    lit = folder / "k733_2020-09-15" / "vehicle_tracks_000.csv"
    assert "0.56 times the speed" in read_error("interaction", lit).message
    assert "two states" in read_error("interaction", folder / "k733_2018-05-02" / lit.name).message
    reader = get_reader("interaction", window=5, motion="positions")
    found = [item for item in reader.read(lit) if isinstance(item, RunSegment)]
    assert len(found) == 30
    # Of the cars that drive over a stop line, none does so at red.
    assert crossings(found) == {SignalState.GO: 25, SignalState.CAUTION: 2}
    clean = check_reader(get_reader("interaction"), [folder / "k729_2022-03-16" / "vehicle_tracks_011.csv"])
    assert clean.segments == 1


def crossings(found: list[RunSegment]) -> Counter[int]:
    """How many cars enter a lane with a light, by its state."""
    counts: Counter[int] = Counter()
    for s in found:
        for light, lane in enumerate(s.signal_lane):
            line = s.road.lanes[lane][:, :2]
            along = (line[1] - line[0]) / np.hypot(*(line[1] - line[0]))
            away = s.position[..., :2] - line[0]
            ahead, aside = away @ along, away @ np.array([-along[1], along[0]])
            enters = (ahead[:, :-1] < 0) & (ahead[:, 1:] >= 0) & (np.abs(aside[:, 1:]) < 1.5)
            enters &= s.valid[:, :-1] & s.valid[:, 1:] & (s.agent_type == AgentType.VEHICLE)[:, None]
            enters &= np.cos(s.heading[:, 1:] - np.arctan2(along[1], along[0])) > 0.9
            counts.update(s.signal_state[light, enters.nonzero()[1]].tolist())
    return counts
