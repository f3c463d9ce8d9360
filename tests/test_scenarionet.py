"""The ScenarioNet reader: what it derives and refuses; its pickles are plain data, and never run."""

from __future__ import annotations

import contextlib
import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fuzz_mutations import bytes_
from helpers_scenarionet import FAR, STEPS, line, ring, scenario, track, write
from helpers_segments import CHARACTERS
from helpers_sources import off_road, read_error, read_one
from symphony.data.convert import convert
from symphony.data.levels import levels_of
from symphony.data.segment import AgentType, LaneType, MarkType, SignalState
from symphony.data.sources import safe_pickle
from symphony.data.sources.base import FROM_AXLE
from symphony.data.sources.safe_pickle import load_plain
from symphony.data.store import SegmentStore
from symphony.errors import DataError


def test_tracks(tmp_path: Path) -> None:
    segment = read_one("scenarionet", write(tmp_path))
    assert (segment.segment_id, segment.group) == ("scene-0001", "nuscenes boston-seaport 2018-08-01")
    assert (segment.dt, segment.num_steps, segment.ego) == (0.1, STEPS, 1)
    assert segment.agent_id.tolist() == [0, 1, 2, 3]
    kinds = [AgentType.VEHICLE, AgentType.VEHICLE, AgentType.OTHER, AgentType.PEDESTRIAN]
    assert (segment.agent_type.tolist(), segment.valid[0].tolist()) == (kinds, [k >= 3 for k in range(STEPS)])
    np.testing.assert_allclose(segment.size[[0, 3]], [(4.5, 2, 1.6), (0.7, 0.6, 1.8)], rtol=1e-6)
    np.testing.assert_array_equal(segment.origin, (*FAR, 0))
    np.testing.assert_allclose(segment.position[1, 10], (10 + FROM_AXLE, 0, 0.9), rtol=1e-6)
    np.testing.assert_allclose(segment.velocity[1], np.broadcast_to((10, 0), (STEPS, 2)))


def test_an_ego_wider_than_long_is_turned(tmp_path: Path) -> None:
    tree = scenario()
    tree["tracks"]["ego"] = track(0, 0, 10, size=(1.73, 4.08, 1.56))
    tree["tracks"]["8f3a"] = track(12, 4, 9, size=(1.0, 2.0, 1.5))
    segment = read_one("scenarionet", write(tmp_path, tree))
    # Anybody else is as logged.
    np.testing.assert_allclose(segment.size[[segment.ego, 0]], [(4.08, 1.73, 1.56), (1, 2, 1.5)], rtol=1e-6)


@pytest.mark.parametrize("dataset", ["nuscenes", "metadrive"])
def test_what_is_derived_of_the_map(dataset: str, tmp_path: Path) -> None:
    tree = changed("metadata/dataset", dataset)
    told = {"exit_lanes": ["on"], "left_neighbor": ["left", "right"], "speed_limit_kmh": 1000}  # no limit
    for name in ("left", "on") if dataset == "metadrive" else ():  # roads lead to all lanes of the next
        tree["map_features"][name] |= told
        tree["tracks"]["c0"]["state"].pop("length", None)  # nor do cones have a size
    road = read_one("scenarionet", write(tmp_path, tree)).road
    links = [each.tolist() for each in (road.successors, road.left_neighbors, road.right_neighbors)]
    assert links == [[[0, 2], [2, 3]], [[0, 1]], [[1, 0]]]
    assert road.lane_type.tolist() == [LaneType.SURFACE_STREET] * 4
    np.testing.assert_allclose(road.lane_width, [4, 4, np.nan, 4], rtol=1e-6)
    # The 100 km/h of nuScenes' connectors are ScenarioNet's.
    assert np.isnan(road.speed_limit).all()
    assert road.mark_type.tolist() == [MarkType.ROAD_LINE]
    # On the road, beyond both open ends, in the hole, beside the road.
    spots = np.array([(20, 0), (50, 0), (90, 0), (-9, 3), (50, 4), (20, -3), (20, 7)])
    assert (off_road(road, spots) < 0).tolist() == [True] * 4 + [False] * 3


def test_successors_begin_where_a_lane_ends(tmp_path: Path) -> None:
    for points, succeeds in (
        (((40, 0), (60, 0)), True), (((40.3, 0.3), (60, 0)), True), (((40.6, 0), (60, 0)), False),
        (((40, 0), (50, 10)), True), (((40, 0), (45, 10)), False), (((40, 0), (20, 0.5)), False),
    ):  # fmt: skip
        found = read_one("scenarionet", write(tmp_path, changed(LINE, line(*points)))).road.successors.tolist()
        assert ([0, 2] in found) == succeeds, points


def test_what_other_sources_say_about_the_map(tmp_path: Path) -> None:
    """Links, limits, edges and lights as ScenarioNet has them of the Waymo dataset and of nuPlan."""
    tree = changed("metadata/dataset", "waymo")
    features = tree["map_features"]
    del features["boundary_0"], features["boundary_1"]
    features["right"] |= {"exit_lanes": ["left", "gone"], "left_neighbor": [{"feature_id": "left"}]}
    features["edge"] = {"type": "ROAD_EDGE_BOUNDARY", "polyline": ring((0, -2), (80, -2))}
    features["zebra"] = {"type": "CROSSWALK", "polygon": ring((38, -2), (40, -2), (40, 6))}
    features["sign"] = {"type": "STOP_SIGN", "position": FAR + np.array([39, -3])}
    marked = {"objects_of_interest": ["p1", "gone"], "tracks_to_predict": {"never": {}, "8f3a": {}, "p1": {}}}
    tree["metadata"] |= {**marked, "current_time_index": 10}
    features["later"] = {"type": "SOMETHING_NEW", "polyline": line((0, 0), (1, 1))}
    states = 10 * ["LANE_STATE_STOP"] + 5 * ["TRAFFIC_LIGHT_GREEN"] + (STEPS - 15) * [None]
    tree["dynamic_map_states"] = {
        "on": {"lane": "on", "state": {"object_state": states}, "stop_point": np.array([*FAR, 1.0])},
        "end": {"lane": "end", "state": {"object_state": np.array(STEPS * ["LANE_STATE_GO"])}},
        "gone": {"lane": "gone", "state": {"object_state": states}},
    }
    segment = read_one("scenarionet", write(tmp_path, tree))
    assert (segment.interest.tolist(), segment.predict.tolist(), segment.current_step) == ([3], [0, 3], 10)
    road = segment.road
    links = [each.tolist() for each in (road.successors, road.left_neighbors, road.right_neighbors)]
    assert links == [[[0, 1]], [[0, 1]], []]
    np.testing.assert_allclose(road.speed_limit, [np.nan, np.nan, 100 / 3.6, np.nan], rtol=1e-6)
    np.testing.assert_allclose(road.boundary.points, [(0, -2, 0), (80, -2, 0)])
    assert sorted(road.mark_type.tolist()) == [MarkType.ROAD_LINE, MarkType.CROSSWALK, MarkType.STOP_SIGN]
    assert segment.signal_lane.tolist() == [2, 3]
    np.testing.assert_allclose(segment.signal_point, [(0, 0, 1), (60, 0, 0)])
    lights = [SignalState.STOP] * 10 + [SignalState.GO] * 5 + [SignalState.UNKNOWN] * (STEPS - 15)
    assert segment.signal_state.tolist() == [lights, STEPS * [SignalState.GO]]


def test_a_boundary_without_heights_takes_them_from_the_lanes(tmp_path: Path) -> None:
    """Of Argoverse 2 lanes have the city's height, and agents none."""
    tree = changed("metadata/dataset", "av2")
    features = tree["map_features"]
    for name in ("right", "left", "on", "end"):
        features[name]["polyline"] = np.pad(features[name]["polyline"], ((0, 0), (0, 1)), constant_values=20.0)
        features[name].pop("polygon", None)
    del features["boundary_0"], features["boundary_1"]
    segment = read_one("scenarionet", write(tmp_path, tree))
    assert levels_of(segment).flat
    assert segment.position[segment.ego, 10, 0] == pytest.approx(10 + FROM_AXLE)
    features["edge"] = {"type": "ROAD_EDGE_BOUNDARY", "polyline": np.array([(*FAR, 0.0), (*FAR, 5.0)])}
    road = read_one("scenarionet", write(tmp_path, tree)).road
    assert (road.lanes.points[:, 2] == 20).all()


def test_a_track_of_nuscenes_does_not_stop_where_it_ends(tmp_path: Path) -> None:
    """ScenarioNet's velocities are differences to the next position, and 0 where there is none."""
    tree = scenario()
    state = tree["tracks"]["8f3a"]["state"]
    state["valid"][[10, 12, 13]] = 0
    speed = np.arange(STEPS) * (state["valid"] > 0)
    ends = [9, 11, STEPS - 1]
    speed[ends] = 0
    state["velocity"] = np.stack([speed, speed], axis=-1)
    found = read_one("scenarionet", write(tmp_path, tree)).velocity[0, :, 0]
    # A single state has none before it.
    expected = speed.copy()
    expected[ends] = [8, 0, STEPS - 2]
    assert found.tolist() == expected.tolist()
    tree["metadata"]["dataset"] = "waymo"
    np.testing.assert_array_equal(read_one("scenarionet", write(tmp_path, tree)).velocity[0, :, 0], speed)


def test_long_outlines_that_were_cut_up_leave_no_islands_as_road(tmp_path: Path) -> None:
    """As ScenarioNet writes Argoverse 2: pieces of 20 points, so that only short rings are whole."""
    tree = changed("metadata/dataset", "av2")
    features = tree["map_features"]
    for lane in ("right", "left", "on", "end"):
        features[lane].pop("polygon", None)
        features[lane]["speed_limit_kmh"] = 136.79424
    outline = features.pop("boundary_0")["polyline"]
    for name, piece in (("boundary_00", outline[:3]), ("boundary_020", outline[3:])):
        features[name] = {"type": "ROAD_LINE_SOLID_SINGLE_WHITE", "polyline": piece}
    road = read_one("scenarionet", write(tmp_path, tree)).road
    spots = np.array([(20, 0), (50, 0), (50, 4), (20, -3)])
    assert (off_road(road, spots) < 0).tolist() == [True, True, False, False]
    assert road.mark_type.tolist() == [MarkType.ROAD_LINE] * 4
    assert np.isnan(road.speed_limit).all()


def test_what_scenarionet_makes_of_nuplan(tmp_path: Path) -> None:
    """Neighbours are all lanes of a road, in any order; stop points lie past the line; logs have many scenarios."""
    tree = scenario()
    tree["metadata"] |= {"dataset": "nuplan", "map": "us-ma-boston", "log_name": "2021.05.12_veh-35"}
    del tree["metadata"]["date"]
    tree["map_features"]["left"]["left_neighbor"] = ["left", "right"]
    states = STEPS * ["TRAFFIC_LIGHT_RED"]
    stop = (FAR + np.array([48, 0])).tolist()
    tree["dynamic_map_states"] = {"on": {"lane": "on", "state": {"object_state": states}, "stop_point": stop}}
    segment = read_one("scenarionet", write(tmp_path, tree))
    assert segment.group == "nuplan us-ma-boston 2021.05.12_veh-35"
    neighbors = segment.road.left_neighbors.tolist(), segment.road.right_neighbors.tolist()
    assert neighbors == ([[0, 1]], [[1, 0]])
    np.testing.assert_allclose(segment.signal_point, [(40, 0, 0)])


def changed(path: str, value: Any) -> dict[str, Any]:
    """The scenario with another value, or with ``...`` none, under a path of keys."""
    tree = holder = scenario()
    *above, last = path.split("/")
    for key in above:
        holder = holder[key]
    if value is ...:
        del holder[last]
    else:
        holder[last] = value
    return tree


STATE, LINE, LIGHTS = "tracks/ego/state/", "map_features/on/polyline", "dynamic_map_states"


@pytest.mark.parametrize(("path", "value", "field"), [
    ("id", 7, "id"), ("metadata", ..., "metadata"), ("metadata/ts", np.arange(STEPS) ** 2 * 0.1, "metadata: ts"),
    ("metadata/ts", np.full(STEPS, np.nan), "metadata: ts"), ("length", 7, "metadata"),
    ("metadata/dataset", ..., "metadata: dataset"), ("map_features/on/type", ..., "map_features on"),
    ("tracks/ego/type", ..., "tracks ego"), ("metadata/current_time_index", -1, "metadata: current_time_index"),
    ("metadata/sdc_id", "never", "metadata: sdc_id"), ("metadata/map", "\ud800", "group"),
    ("tracks", {}, "tracks"), ("metadata/ts", (np.arange(STEPS) / 10).astype(str), "metadata"),
    ("metadata/ts", np.zeros((STEPS, 2)), "metadata"), (STATE + "heading", np.zeros(2 * STEPS), "tracks ego"),
    (STATE + "heading", np.zeros((STEPS, 2)), "tracks ego"), (STATE + "position", np.zeros((STEPS, 2)), "tracks ego"),
    (STATE + "position", np.zeros((3, STEPS)), "tracks ego"),
    (STATE + "heading", np.array(STEPS * ["a"]), "tracks ego"), ("map_features/on/exit_lanes", 7, "map_features on"),
    (STATE + "heading", np.full(STEPS, np.inf), "heading"), (LINE, [[[1], [2]]], "map_features on"),
    (LINE, [(1, 2), (1, 2, 3)], "map_features on"), (LINE, np.full((2, 2), "7"), "map_features on"),
    (LINE, [(1e9, 0)], "map_features on"), (LINE, [(10**400, 0)], "map_features on"),
    (LIGHTS, {"on": {"lane": "on", "state": {"object_state": STEPS * ["PINK"]}}}, LIGHTS),
    (LIGHTS, {"on": {"lane": "on", "state": {"object_state": ["LANE_STATE_GO"]}}}, f"{LIGHTS} on"),
])  # fmt: skip
def test_broken_scenarios_are_refused_by_name(path: str, value: Any, field: str, tmp_path: Path) -> None:
    error = read_error("scenarionet", write(tmp_path, changed(path, value)))
    assert (error.field, error.file) == (field, tmp_path / "sd_made.pkl")
    assert error.segment == (None if path == "id" else "scene-0001")


def test_what_holds_itself_many_times_is_no_word(tmp_path: Path) -> None:
    """Written out it would take all memory."""
    value: Any = []
    for _ in range(60):
        value = [value, value]
    tree = changed("metadata/map", value)
    tree["tracks"]["ego"]["type"] = tree["map_features"]["on"]["type"] = value
    found = read_one("scenarionet", write(tmp_path, tree))
    assert found.agent_type[found.ego] == AgentType.OTHER


@pytest.mark.parametrize("key", ["id", "map_features/\ud800"])
def test_names_that_can_not_be_written_end_no_conversion(key: str, tmp_path: Path) -> None:
    tree = changed(key, "\ud800" if key == "id" else {"type": "STOP_SIGN"})
    write(tmp_path, tree).rename(tmp_path / "0.pkl")
    report = convert("scenarionet", [tmp_path / "0.pkl", write(tmp_path)], tmp_path / "out", interactive=1)
    assert (report.converted, report.files) == (1, 2)
    (skipped,) = SegmentStore(tmp_path / "out").report["skipped"]
    assert "\\ud800" in skipped["segment"] + skipped["field"]


TEXT, PROTOCOLS = st.text(CHARACTERS, max_size=9), range(4, pickle.HIGHEST_PROTOCOL + 1)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXT
ARRAYS = arrays.arrays(
    st.sampled_from([np.dtype(name) for name in ("<f8", ">f4", "<i8", "|u1", "|b1", "|S4")]),
    arrays.array_shapes(max_dims=3, max_side=4, min_side=0),
)
NAMES = st.lists(TEXT, max_size=3).map(lambda names: np.array(names, "<U3"))
LEAVES = SCALARS | ARRAYS | NAMES | st.binary(max_size=5) | st.sets(st.integers(), max_size=3)
TREES = st.recursive(LEAVES, lambda inner: (
    st.lists(inner, max_size=4) | st.tuples(inner, inner) | st.dictionaries(TEXT, inner, max_size=4)
), max_leaves=12)  # fmt: skip


def load(data: bytes, folder: Path) -> Any:
    path = folder / "a.pkl"
    path.write_bytes(data)
    return load_plain(path)


def refused(data: bytes, folder: Path) -> str:
    with pytest.raises(DataError) as caught:
        load(data, folder)
    assert caught.value.file == folder / "a.pkl"
    return caught.value.message


def same(found: Any, expected: Any) -> bool:
    if isinstance(expected, np.ndarray):
        equal = np.array_equal(found.value, expected, equal_nan=expected.dtype.kind == "f")
        return equal and found.value.dtype == expected.dtype
    if isinstance(expected, dict):
        return list(found) == list(expected) and all(same(found[k], v) for k, v in expected.items())
    if isinstance(expected, list | tuple):
        both = type(found) is type(expected) and len(found) == len(expected)
        return both and all(map(same, found, expected))
    return type(found) is type(expected) and found == expected


@settings(max_examples=25)
@given(TREES, st.sampled_from(PROTOCOLS))
def test_plain_data_comes_back(tmp_path_factory: pytest.TempPathFactory, tree: Any, protocol: int) -> None:
    assert same(load(pickle.dumps(tree, protocol), tmp_path_factory.getbasetemp()), tree)


def test_arrays_of_any_order_and_scalars(tmp_path: Path) -> None:
    turned = np.arange(24.0).reshape(2, 3, 4).transpose(2, 0, 1)
    tree = {"a": np.asfortranarray(turned), "b": turned[::2], "c": turned.copy()}
    numbers = [np.float32(1.5), np.int64(-7), np.bool_(True), np.str_("ab")]
    for protocol in PROTOCOLS:
        assert same(load(pickle.dumps(tree, protocol), tmp_path), tree)
        assert load(pickle.dumps(numbers, protocol), tmp_path) == [1.5, -7, True, "ab"]


class Bomb:
    """Would leave a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.path}",)


def test_code_is_refused_by_name_and_never_run(tmp_path: Path) -> None:
    for protocol in PROTOCOLS:
        message = refused(pickle.dumps({"id": [Bomb(tmp_path / "sprung")]}, protocol), tmp_path)
        assert "system, which no plain data needs" in message
    assert not (tmp_path / "sprung").exists()


OTHERS = {
    "collections.OrderedDict": OrderedDict(a=1), "path": Path("x"), "builtins.len": len,
    "numpy.random": np.random.default_rng(0), "an array of type 'O8'": np.array([{}], object),
    "an array of type 'V8'": np.zeros(2, [("a", "f8")]), "an array of type 'M8'": np.zeros(2, "M8[s]"),
    "an array of type 'U9999'": np.zeros(1, "U9999"),
}  # fmt: skip


def test_other_things_are_refused_by_name(tmp_path: Path) -> None:
    for name, value in OTHERS.items():
        assert name in refused(pickle.dumps(value), tmp_path)


def array_pickle(shape: Any, data: Any, kind: str = "f8", order: Any = "<") -> bytes:
    """An array whose state is made up."""

    class Kind:
        def __reduce__(self) -> Any:
            return np.dtype, (kind, False, True), (3, order, None, None, None, -1, -1, 0)

    class Made:
        def __reduce__(self) -> Any:
            maker = np._core.multiarray._reconstruct  # type: ignore[attr-defined]
            return maker, (np.ndarray, (0,), b"b"), (1, shape, Kind(), False, data)

    return pickle.dumps(Made())


def test_arrays_that_lie_are_refused(tmp_path: Path) -> None:
    eight = b"12345678"
    for message, *made in (
        ("impossible shape", (10**12,), b""), ("impossible shape", (-1,), b""),
        ("impossible shape", (2.0,), 2 * eight), ("impossible shape", (True,), eight),
        ("in 8 bytes", (10**5,) * 8, eight), ("without a shape", (0,) * 99, b""), ("without a shape", [1], eight),
        ("in 8 bytes", (2,), eight), ("of objects", (1,), "12345678"), ("of objects", (1,), [1.0]),
        ("of type 'O'", (1,), eight, "O"), ("of type", (1,), eight, "f8,f8"), ("structured", (1,), eight, "f8", "!"),
    ):  # fmt: skip
        assert message in refused(array_pickle(*made), tmp_path)


@pytest.mark.parametrize(("data", "message"), [
    (b"", "empty"), (pickle.dumps([1, 2])[:-1], "not a pickle"), (b"\xff" * 100, "not a pickle"),
    (b"\x80\x04)\x81.", "NEWOBJ"),  # an object of a class
    (pickle.dumps([1], 2), "protocol 2; 4 and 5 are read"), (b"Pabc\n.", "PERSID"),
    (b"\x80\x04B\xff\xff\xff\x7fabc.", "not a pickle"),  # more bytes than there are
    (b"\x80\x05\x96\xff\xff\xff\xff\xff\x00\x00\x00abc.", "not a pickle"),
    (b"\x80\x04\x8c\x05numpy\x8c\x0bos.path.sep\x93.", "refers to numpy.os.path.sep"),
])  # fmt: skip
def test_raw_programs_are_refused(data: bytes, message: str, tmp_path: Path) -> None:
    assert message in refused(data, tmp_path)


def test_too_large_files_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {"MAX_BYTES": "at most 99: too large", "MAX_OPCODES": "more than 99 instructions"}
    for limit, message in limits.items():
        with monkeypatch.context() as patch:
            patch.setattr(safe_pickle, limit, 99)
            assert message in refused(pickle.dumps(list(range(200))), tmp_path)


def test_damaged_pickles_give_errors_or_plain_data(tmp_path: Path) -> None:
    tree = {"a": np.arange(6.0).reshape(2, 3), "b": ["x", 2, {"c": (1.5, None)}], "d": np.float64(2)}
    for seed in range(60):
        data = bytes_(np.random.default_rng(seed), pickle.dumps(tree, PROTOCOLS[seed % len(PROTOCOLS)]))
        with contextlib.suppress(DataError):
            assert type(load(data, tmp_path)).__module__ in {"builtins", safe_pickle.__name__}
