"""Saved rollouts: what is read is what was written, or an error says where it is not."""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from helpers_saved import AGENT, played, random_trees, searched
from helpers_segments import crossing, hide, segments, straight_road
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.segment import AgentType, Polylines, RunSegment, content_hash
from symphony.data.sources.commonroad import CommonRoadReader
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation.evaluator import evaluate
from symphony.learning.demonstrations import SceneDataset
from symphony.saved.export import commonroad
from symphony.saved.folder import KEY, About, RolloutWriter, load_rollouts, read_tensors, tensors_of
from symphony.saved.folder import save_rollouts as save_all
from symphony.saved.rollouts import world_of
from symphony.saved.saving import save_simulation

ABOUT = About("made", 3, {"interactive": "made", "others": "playback"}, {"rollouts": 2}, {"checksum": "ab"})


def assert_same(one, two):
    """Check for the same arrays of the same types, and the same facts."""
    assert content_hash(one.segment) == content_hash(two.segment)
    (arrays, facts), (others, told) = tensors_of(one), tensors_of(two)
    assert (facts, arrays.keys()) == (told, others.keys())
    for name, value in arrays.items():
        assert value.dtype == others[name].dtype
        np.testing.assert_array_equal(value, others[name], err_msg=name)


@settings(max_examples=15, deadline=None)
@given(segments(), st.integers(1, 3), st.integers(0, 99), st.booleans(), st.data())
def test_reading_is_the_inverse_of_writing(segment, rollouts, seed, searched, data):
    rows = data.draw(st.lists(st.integers(0, segment.num_agents - 1), unique=True, max_size=3))
    rng = np.random.default_rng(seed)
    saved = played(segment, rows, rollouts)
    saved = dataclasses.replace(
        saved, state=rng.normal(0, 50, saved.state.shape).astype("f4"),
        **{name: rng.random(saved.counted.shape) < 0.5 for name in ("collision", "offroad", "counted")},
        goal=rng.integers(-1, 2, saved.goal.shape),
        routes=Polylines.of([rng.normal(size=(k, 2)).astype("f4") for k in (3, 5)]),
        drivers=tuple(f"driver {row}" for row in rows), failed={0: "no plan\nfound"},
        trees=random_trees(saved, seed=seed) if searched else None,
        plan=rng.choice([np.nan, 1.5], (rollouts, len(rows), saved.steps, 3, 2)).astype("f4")
        if seed % 2 else None,
    )  # fmt: skip
    arrays, facts = tensors_of(saved)
    again = read_tensors(save(arrays, {KEY: json.dumps(facts)}), Path("x"), segment.segment_id)
    assert_same(saved, again)
    for name in ("start", "drivers", "failed"):
        assert getattr(saved, name) == getattr(again, name)


def test_a_search_is_kept_with_its_leaves_and_goals(tmp_path):
    about, found = searched()
    folder = save_all(tmp_path / "sim", about, found)
    assert load_rollouts(tmp_path / "sim").about == about
    assert folder.ids == [saved.segment.segment_id for saved in found]
    for saved, again in zip(found, folder, strict=True):
        assert_same(saved, again)
        trees = again.trees
        steps = np.arange(again.steps)
        # A leaf is what its slots simulated, one period after the other.
        for k in range(again.rollouts):
            history = trees.state[0, trees.slots[0, steps // trees.prune_every, k], steps]
            np.testing.assert_array_equal(history, again.state[k, 1:])
        assert (again.goal >= 0).any()
        first = again.routes[int(again.goal.max())][0, :2]
        assert np.linalg.norm(again.state[:, 0, :, :2] - first, axis=-1).min() < 10


def test_an_interrupted_folder_is_continued(tmp_path):
    found = [played(straight_road(seed=k)) for k in range(3)]
    whole = save_all(tmp_path / "whole", ABOUT, found)
    with RolloutWriter(tmp_path / "cut", ABOUT) as writer:
        writer.add(found[0])
        writer.fail(found[1].segment.segment_id, 2, "out of memory")
    assert [entry.failed for entry in load_rollouts(tmp_path / "cut").failures] == ["out of memory"]
    with (tmp_path / "cut" / "index.jsonl").open("a") as index:
        index.write('{"segment": "straight-2", "roll')
    again = save_all(tmp_path / "cut", ABOUT, found)
    assert (sorted(again.ids), again.failures) == (sorted(whole.ids), [])
    for name in whole.ids:
        assert_same(whole.of(name), again.of(name))
    with pytest.raises(DataError, match="exist already"):
        RolloutWriter(tmp_path / "cut", ABOUT).add(found[0])


def test_another_simulation_or_folder_is_refused(tmp_path):
    save_all(tmp_path / "sim", ABOUT, [played(straight_road())])
    with pytest.raises(DataError, match=r"another simulation, which differs in settings\.rollouts"):
        RolloutWriter(tmp_path / "sim", dataclasses.replace(ABOUT, settings={"rollouts": 3}))
    RolloutWriter(tmp_path / "sim", dataclasses.replace(ABOUT, store={"checksum": "ab", "path": "moved"})).close()
    with pytest.raises(DataError, match="differs in store"):
        RolloutWriter(tmp_path / "sim", dataclasses.replace(ABOUT, store={"checksum": "cd"}))
    with patch("symphony.saved.folder.write_json", side_effect=OSError("full")), pytest.raises(OSError, match="full"):
        RolloutWriter(tmp_path / "full", ABOUT)
    RolloutWriter(tmp_path / "full", ABOUT).close()
    (tmp_path / "full" / "index.jsonl").unlink()  # as if there had been no room for it
    RolloutWriter(tmp_path / "full", dataclasses.replace(ABOUT, seed=7)).close()
    (tmp_path / "shop").mkdir()
    (tmp_path / "shop" / "index.jsonl").write_text(foreign := '{"price": 1}\n{"price"')
    with pytest.raises(DataError, match="refusing"):
        RolloutWriter(tmp_path / "shop", ABOUT)
    assert (tmp_path / "shop" / "index.jsonl").read_text() == foreign
    with pytest.raises(DataError, match="not a folder of rollouts"):
        load_rollouts(tmp_path / "shop")
    (tmp_path / "shop" / "index.jsonl").write_text("")
    for name in ("rollouts.lock", ".manifest.1.new.json"):  # of a writer that was killed before its manifest
        (tmp_path / "shop" / name).touch()
    RolloutWriter(tmp_path / "shop", ABOUT).close()


@pytest.mark.parametrize("name", ["..", "a b", "Ü" * 190, ".hidden", "a%2Fb", "x" * 200])
def test_any_name_of_a_segment_is_a_file_of_the_folder(name, tmp_path):
    folder = save_all(tmp_path / "sim", ABOUT, [played(straight_road(segment_id=name))])
    assert (tmp_path / "sim" / folder.entries[0].file).resolve().parent == tmp_path / "sim" / "segments"
    assert folder[0].segment.segment_id == name


def put(value):
    return lambda array: array.reshape(-1).__setitem__(-1, value) or array


@pytest.mark.parametrize(("field", "change", "message"), [
    ("state", None, "missing"), ("state", put(np.nan), "not finite"), ("state", put(2e3), "speed"),
    ("state", lambda a: np.zeros((10**6, 9, 0, 4), "f4"), "dimensions of at most"),
    ("state", lambda a: a.astype("f8"), "dtype"), ("state", lambda a: a[:, :-1], "states for"),
    ("counted", lambda a: a[..., :1], "expected"), ("agents", put(3), "outside"), ("agents", put(0), "twice"),
    ("goal", put(0), "outside"), ("start", 1, "outside"), ("start", "0", "wrong type"),
    ("drivers", ["one"], "agents"), ("drivers", ["one", None], "names"), ("failed", {"2": "why"}, "outside"),
    ("failed", {"9" * 5000: "why"}, "by number"), ("failed", {"\u0661": "why"}, "by number"),
    ("log.position", put(np.inf), "not finite"), ("road.successors", lambda a: a[:, :1], r"expected int32 \[\d+, 2"),
    ("routes.offsets", lambda a: np.array([0, 2**63 - 1, -2, a[-1]], a.dtype), "offsets"),
    ("plan", put(np.inf), "not finite"), ("plan", put(1e6), "plausible"), ("plan", lambda a: a[:1], "is expected"),
        ("plan", lambda a: np.repeat(a, 3, 1), "3 planners for 2 agents"),
    ("tree.score", put(np.inf), "infinite"), ("tree.state", put(np.nan), "not finite"),
    ("tree.parents", put(9), "outside"), ("tree.slots", lambda a: a[..., :1], "not 2 rollouts"),
    ("prune_every", 3, "periods"), ("prune_every", 0, "periods"), ("dt", 0.0, "plausible"),
])  # fmt: skip
def test_what_breaks_the_format_is_named(field, change, message):
    saved = played(crossing(3, steps=9), (0, 1), 2)
    trees = dataclasses.replace(random_trees(saved), there=np.ones((1, 4, 8, 2), bool))
    plan = np.zeros((2, 1, saved.steps, 1, 2), "f4")
    arrays, facts = tensors_of(dataclasses.replace(saved, trees=trees, plan=plan))
    if field in facts:
        facts[field] = change
    elif change is None:
        del arrays[field]
    else:
        arrays[field] = np.ascontiguousarray(change(arrays[field].copy()))
    with pytest.raises(DataError, match=message) as caught:
        read_tensors(save(arrays, {KEY: json.dumps(facts)}), Path("sim/file"), "crossing-0")
    assert (str(caught.value.file), caught.value.segment) == ("sim/file", "crossing-0")
    assert field.removeprefix("log.").removesuffix(".offsets") in str(caught.value.field)


def test_damage_is_found_and_named(tmp_path):
    folder = save_all(tmp_path / "sim", ABOUT, [played(straight_road(seed=k)) for k in range(4)])
    files = [tmp_path / "sim" / entry.file for entry in folder.entries]
    data = bytearray(files[0].read_bytes())
    data[-5] ^= 1
    files[0].write_bytes(data)
    files[1].write_bytes(files[1].read_bytes()[:-100])
    files[2].unlink()
    for k, message in enumerate(["damaged", "damaged", "can't be read"]):
        with pytest.raises(DataError, match=message) as caught:
            load_rollouts(tmp_path / "sim")[k]
        assert (caught.value.file, caught.value.segment) == (files[k], f"straight-{k}")
    # A shape that nothing could hold is damage too, and a list in place of the facts.
    shape = b'{"state": {"dtype": "F32", "shape": [0, 4611686018427387904, 8], "data_offsets": [0, 0]}}'
    for header in (shape, b'{"__metadata__": {"symphony": "[]"}}'):
        padded = header + b" " * (-len(header) % 8)
        with pytest.raises(DataError, match="file one, segment one: damaged"):
            read_tensors(len(padded).to_bytes(8, "little") + padded, Path("one"), "one")
    broken = played(straight_road())
    broken.state[0, 3] = np.nan
    with pytest.raises(DataError, match="not finite"):  # nor is it written
        save_all(tmp_path / "other", ABOUT, [broken])
    assert len(load_rollouts(tmp_path / "other")) == 0


@pytest.mark.parametrize(("file", "change", "message"), [
    ("index.jsonl", {"file": [""]}, "damaged .file must be str"), ("index.jsonl", {"dt": 9.0}, "the index says 9"),
    ("index.jsonl", {"file": "segments/\0"}, "no file of this folder"),
    ("index.jsonl", {"file": "segments/../a"}, "no file of this folder"),
    ("index.jsonl", {"rollouts": 10**9}, "line 1: 1000000000 rollouts"), ("index.jsonl", "3", "line 1 is damaged"),
    ("index.jsonl", "[" * 100_000, "line 1 is damaged"), ("index.jsonl", {"rollouts": 3}, "the index says 3"),
    *(("manifest.json", {name: [3]}, "must be") for name in ("agent", "seed", "drivers", "settings", "store")),
    ("manifest.json", {"format": 9}, "format 1"), ("manifest.json", "[" * 100_000, "not valid JSON"),
])  # fmt: skip
def test_an_index_or_a_manifest_that_lies_is_refused(file, change, message, tmp_path):
    save_all(tmp_path / "sim", ABOUT, [played(straight_road())])
    path = tmp_path / "sim" / file
    text = change if isinstance(change, str) else json.dumps(json.loads(path.read_text()) | change)
    path.write_text(text + "\n")
    with pytest.raises(DataError, match=message):
        load_rollouts(tmp_path / "sim")[0]


@pytest.mark.parametrize("name", [AGENT, "idm"])
def test_agents_that_follow_routes_need_them(name: str, tmp_path: Path) -> None:
    agent, how = load_agent(name), EvaluateConfig(rollouts=2, duration=1)
    without = SceneDataset(SegmentStore(builtin_store("test")), 2, agent.dynamics, [0], duration=1)
    for call in (evaluate, partial(save_simulation, tmp_path / "sim")):
        with pytest.raises(ConfigError, match="routes=True"):
            call(agent, without, how)
    with pytest.raises(ConfigError, match="routes=True"):
        save_simulation(tmp_path / "sim", load_agent("playback"), without, how, planner="idm")


def test_a_simulation_is_kept_whatever_the_batch_and_the_interruptions(tmp_path):
    agent, store, done = load_agent(AGENT), SegmentStore(builtin_store("test")), []

    def kept(name, count, by=agent, **how):
        data = SceneDataset(store, agent.interactive, agent.dynamics, range(count), routes=True, duration=2)
        config = EvaluateConfig(search="tree", rollouts=2, branches=4, batch=how.pop("batch", 2))
        return save_simulation(tmp_path / name, by, data, config, **how)

    kept("cut", 1)
    cut, whole = kept("cut", 3, batch=3, progress=lambda *at: done.append(at)), kept("whole", 3)
    assert done == [(3, 3)]
    assert cut.ids == whole.ids == store.ids[:3]
    for one, two in zip(cut, whole, strict=True):
        assert_same(one, two)
        assert one.trees is not None
        assert one.drivers == (AGENT, AGENT)
    log = kept("log", 1, load_agent("playback"))[0]
    np.testing.assert_allclose(log.state[0, :, 0, :2], store[0].position[log.agents[0], :11, :2])
    assert log.drivers == ("playback", "playback")
    bare = kept("bare", 1, keep_tree=False)[0]
    assert bare.trees is None
    np.testing.assert_array_equal(bare.state, whole[0].state)


def read_back(saved, rollout, path):
    file = path / "scenario.xml"
    file.write_text(commonroad(saved, rollout), encoding="utf-8")
    assert "timeOffset" not in file.read_text(encoding="utf-8")  # the schema knows none of 0
    (item,) = CommonRoadReader().read(file)
    assert isinstance(item, RunSegment), item
    return item


def test_a_rollout_comes_back_from_commonroad(tmp_path):
    """Every agent is where it was in the rollout, at every step, within a millimetre."""
    for saved in searched()[1]:
        found, world = read_back(saved, saved.rollouts - 1, tmp_path), world_of(saved, saved.rollouts - 1)
        assert (found.dt, found.num_steps) == (saved.segment.dt, saved.steps + 1)
        for row in np.flatnonzero(world.valid.any(1)):
            (k,) = np.flatnonzero(found.agent_id == saved.segment.agent_id[row])
            seen, shift = found.valid[k], found.origin[:2] - saved.segment.origin[:2]
            np.testing.assert_array_equal(seen, world.valid[row])
            for mine, other in (
                (found.position[k, seen, :2] + shift, world.position[row, seen]),
                (found.heading[k, seen], world.heading[row, seen]),
                (np.linalg.norm(found.velocity[k, seen], axis=-1), np.abs(world.speed[row, seen])),
                (found.size[k, :2], world.size[row]),
            ):
                np.testing.assert_allclose(mine, other, atol=1e-3)


@pytest.mark.parametrize("known", [True, False])
def test_the_map_and_its_lights_come_back(known, tmp_path):
    """Widths that are not known are nominal."""
    segment = crossing(4, steps=31) if known else straight_road(3)
    road = segment.road
    if not known:
        lost = np.full_like(road.lane_width, np.nan)
        road = dataclasses.replace(road, lane_width=lost, speed_limit=lost)
    segment = segment.replace(road=road, origin=np.array([512_000.0, 5_400_000.0, 0.0]))
    again = read_back(played(segment, [0, 1]), 0, tmp_path)
    other, shift = again.road, again.origin[:2] - segment.origin[:2]
    for mine, theirs in zip(other.lanes, road.lanes, strict=True):
        np.testing.assert_allclose(mine[:, :2] + shift, theirs[:, :2], atol=0.01)
    for name in ("speed_limit", "lane_type"):
        np.testing.assert_allclose(getattr(other, name), getattr(road, name), atol=0.01)
    np.testing.assert_allclose(other.lane_width, road.lane_width if known else 3.6, atol=0.01)
    for name in ("successors", "left_neighbors", "right_neighbors"):
        assert set(map(tuple, getattr(other, name))) == set(map(tuple, getattr(road, name)))
    order = np.argsort(again.signal_lane)
    np.testing.assert_array_equal(again.signal_lane[order], segment.signal_lane)
    np.testing.assert_array_equal(again.signal_state[order], segment.signal_state)
    np.testing.assert_allclose(again.signal_point[order, :2] + shift, segment.signal_point[:, :2], atol=0.01)


def test_agents_that_are_lost_and_odd_ids_stay_apart(tmp_path):
    """An agent seen twice is two obstacles; ids that are not positive are shifted."""
    size = np.array([[9, 2, 0], [0.5, 0.5, 0], [1.8, 0.6, 0], [2, 2, 0]], np.float32)
    ids, kinds = np.array([-3, 0, 4, 9]), np.array([1, 2, 3, 4], np.uint8)
    segment = hide(straight_road(4, steps=21), 2, slice(5, 9))
    segment = segment.replace(agent_id=ids, agent_type=kinds, size=size)
    text = commonroad(played(segment), 0)
    assert all(f"<type>{kind}</type>" in text for kind in ("truck", "pedestrian", "bicycle", "unknown"))
    again = read_back(played(segment), 0, tmp_path)
    assert again.agent_id[:2].tolist() == [1, 4]
    first, second = (again.valid[again.agent_id == number][0] for number in (8, 14))
    np.testing.assert_array_equal(first ^ second, segment.valid[2])
    assert AgentType.CYCLIST in again.agent_type
    late = played(hide(segment, 3, 0), [3])  # present after the first step, not before
    late.counted[:] = True
    assert late.there[0, :, 0].tolist() == [False, *[True] * 20]


def test_a_run_that_failed_at_once_is_a_scenario_without_anybody():
    saved = played(straight_road(1), failed={0: "why"})
    saved.counted[:] = False
    assert "dynamicObstacle" not in commonroad(saved, 0)


def test_the_command_writes_a_file_for_each_rollout(tmp_path, capsys):
    saved = played(crossing(4, steps=11), [0, 1], 3, failed={1: "\udce9"})
    saved.collision[1, [4, 9], [1, 0]], saved.counted[1, 9, 0] = True, False
    save_all(tmp_path / "sim", About("made"), [saved, played(straight_road())])
    sim, out = str(tmp_path / "sim"), tmp_path / "one"
    assert main(["export", sim]) == 0
    names = [path.name for path in sorted((tmp_path / "sim" / "export").iterdir())]
    assert names == [*(f"crossing-0-{k}.xml" for k in range(3)), "straight-0-0.xml"]
    arguments = ["--out", str(out), "--segments", "crossing-0", "--rollouts", "1", "1"]
    assert main(["export", sim, *arguments]) == 0
    assert "written: 1 file in" in capsys.readouterr().out
    (file,) = out.iterdir()
    assert file.read_text() == commonroad(saved, 1)
    assert main(["export", sim, "--rollouts", "1"]) == 1
    assert "straight-0 has rollouts 0 to 0, not 1" in capsys.readouterr().err
