"""Saved rollouts: what is read is what was written, or an error says where it is not."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from helpers_saved import AGENT, played, random_trees, searched
from helpers_segments import crossing, segments, straight_road
from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.segment import Polylines, RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.errors import DataError
from symphony.learning.demonstrations import SceneDataset
from symphony.saved.folder import (
    KEY,
    About,
    RolloutFolder,
    RolloutWriter,
    load_rollouts,
    read_tensors,
    save_rollouts,
    tensors_of,
)
from symphony.saved.rollouts import SavedRollouts
from symphony.saved.saving import save_simulation

ABOUT = About("made", 3, {"interactive": "made", "others": "playback"}, {"rollouts": 2}, {"checksum": "ab"})


def assert_same(one: SavedRollouts, two: SavedRollouts) -> None:
    """The same arrays of the same types, and the same facts."""
    assert content_hash(one.segment) == content_hash(two.segment)
    (arrays, facts), (others, told) = tensors_of(one), tensors_of(two)
    assert facts == told
    assert arrays.keys() == others.keys()
    for name, value in arrays.items():
        assert value.dtype == others[name].dtype
        np.testing.assert_array_equal(value, others[name], err_msg=name)


@settings(max_examples=30, deadline=None)
@given(segment=segments(), rollouts=st.integers(1, 3), seed=st.integers(0, 99), data=st.data())
def test_reading_is_the_inverse_of_writing(
    segment: RunSegment, rollouts: int, seed: int, data: st.DataObject
) -> None:
    rows = data.draw(st.lists(st.integers(0, segment.num_agents - 1), unique=True, max_size=3))
    rng = np.random.default_rng(seed)
    saved = played(segment, rows, rollouts)
    saved = dataclasses.replace(
        saved,
        state=rng.normal(0, 50, saved.state.shape).astype("f4"),
        **{name: rng.random(saved.counted.shape) < 0.5 for name in ("collision", "offroad", "counted")},
        goal=rng.integers(-1, 2, saved.goal.shape),
        routes=Polylines.of([rng.normal(size=(k, 2)).astype("f4") for k in (3, 5)]),
        drivers=tuple(f"driver {row}" for row in rows),
        failed={0: "no plan\nfound"},
    )
    if data.draw(st.booleans()):
        saved = dataclasses.replace(saved, trees=random_trees(saved, seed=seed))
    arrays, facts = tensors_of(saved)
    held = save(arrays, {KEY: json.dumps(facts)})
    again = read_tensors(held, Path("x"), segment.segment_id)
    assert_same(saved, again)
    for item in dataclasses.fields(SavedRollouts):
        if item.name in ("start", "drivers", "failed"):
            assert getattr(saved, item.name) == getattr(again, item.name)
    if saved.trees is not None:  # files that don't say who is there
        del arrays["tree.there"]
        old = read_tensors(save(arrays, {KEY: json.dumps(facts)}), Path("x"), segment.segment_id)
        trees = dataclasses.replace(saved.trees, there=np.ones_like(saved.trees.there))
        assert_same(dataclasses.replace(saved, trees=trees), old)


def test_a_search_is_kept_with_its_leaves_and_goals(tmp_path: Path) -> None:
    about, found = searched()
    folder = save_rollouts(tmp_path / "sim", about, found)
    assert load_rollouts(tmp_path / "sim").about == about
    assert folder.ids == [saved.segment.segment_id for saved in found]
    for saved, again in zip(found, folder, strict=True):
        assert_same(saved, again)
        trees = again.trees
        assert trees is not None
        steps = np.arange(again.steps)
        # A leaf is what its slots simulated, one period after the other.
        for k in range(again.rollouts):
            history = trees.state[0, trees.slots[0, steps // trees.prune_every, k], steps]
            np.testing.assert_array_equal(history, again.state[k, 1:])
        assert (again.goal >= 0).any()
        first = again.routes[int(again.goal.max())][0, :2]
        assert np.linalg.norm(again.state[:, 0, :, :2] - first, axis=-1).min() < 10


def test_an_interrupted_folder_is_continued(tmp_path: Path) -> None:
    found = [played(straight_road(seed=k)) for k in range(3)]
    whole = save_rollouts(tmp_path / "whole", ABOUT, found)
    with RolloutWriter(tmp_path / "cut", ABOUT) as writer:
        writer.add(found[0])
        writer.fail(found[1].segment.segment_id, 2, "out of memory")
    assert [entry.failed for entry in load_rollouts(tmp_path / "cut").failures] == ["out of memory"]
    with (tmp_path / "cut" / "index.jsonl").open("a") as index:
        index.write('{"segment": "straight-2", "roll')
    again = save_rollouts(tmp_path / "cut", ABOUT, found)
    assert sorted(again.ids) == sorted(whole.ids)
    assert again.failures == []
    for name in whole.ids:
        assert_same(whole.of(name), again.of(name))
    with pytest.raises(DataError, match="there already"):
        RolloutWriter(tmp_path / "cut", ABOUT).add(found[0])


def test_another_simulation_or_folder_is_refused(tmp_path: Path) -> None:
    save_rollouts(tmp_path / "sim", ABOUT, [played(straight_road())])
    for changes, name in (({"seed": 4}, "seed"), ({"settings": {"rollouts": 3}}, r"settings\.rollouts")):
        with pytest.raises(DataError, match=f"another simulation, which differs in {name}"):
            RolloutWriter(tmp_path / "sim", dataclasses.replace(ABOUT, **changes))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    with pytest.raises(DataError, match="refusing"):
        RolloutWriter(tmp_path / "other", ABOUT)
    with pytest.raises(DataError, match="no folder of rollouts"):
        load_rollouts(tmp_path / "other")


@pytest.mark.parametrize("name", ["..", "a b", "Ü" * 190, ".hidden", "a%2Fb", "x" * 200])
def test_any_name_of_a_segment_is_a_file_of_the_folder(name: str, tmp_path: Path) -> None:
    folder = save_rollouts(tmp_path / "sim", ABOUT, [played(straight_road(segment_id=name))])
    assert (tmp_path / "sim" / folder.entries[0].file).resolve().parent == tmp_path / "sim" / "segments"
    assert folder[0].segment.segment_id == name


def put(value: Any) -> Any:
    def change(array: Any) -> Any:
        array.reshape(-1)[-1] = value
        return array

    return change


@pytest.mark.parametrize(("field", "change", "message"), [
    ("state", None, "missing"),
    ("state", put(np.nan), "not finite"),
    ("state", put(2e3), "speed"),
    ("state", lambda a: np.zeros((10**6, 9, 0, 4), "f4"), "dimensions of at most"),
    ("state", lambda a: a.astype("f8"), "dtype"),
    ("state", lambda a: a[:, :-1], "states for"),
    ("counted", lambda a: a[..., :1], "expected"),
    ("agents", put(3), "outside"),
    ("agents", put(0), "twice"),
    ("goal", put(0), "outside"),
    ("start", 1, "outside"),
    ("start", "0", "wrong type"),
    ("drivers", ["one"], "agents"),
    ("drivers", ["one", None], "names"),
    ("failed", {"2": "why"}, "outside"),
    ("failed", {"9" * 5000: "why"}, "by number"),
    ("failed", {"\u0661": "why"}, "by number"),
    ("log.valid", None, "missing"),
    ("log.position", put(np.inf), "not finite"),
    ("road.successors", lambda a: a[:, :1], r"expected int32 \[\d+, 2\]"),
    ("road.lanes.offsets", put(0), "offsets"),
    ("routes.offsets", lambda a: np.array([0, 2**63 - 1, -2, a[-1]], a.dtype), "offsets"),
    ("tree.score", put(np.inf), "infinite"),
    ("tree.state", put(np.nan), "not finite"),
    ("tree.parents", put(9), "outside"),
    ("tree.slots", lambda a: a[..., :1], "not 2 rollouts"),
    ("prune_every", 3, "periods"),
    ("prune_every", 0, "periods"),
    ("prune_every", 2.0, "wrong type"),
    ("dt", 0.0, "plausible"),
])  # fmt: skip
def test_what_breaks_the_format_is_named(field: str, change: Any, message: str) -> None:
    saved = played(crossing(3, steps=9), (0, 1), 2)
    trees = dataclasses.replace(random_trees(saved), there=np.ones((1, 4, 8, 2), bool))
    arrays, facts = tensors_of(dataclasses.replace(saved, trees=trees))
    if field in facts:
        facts[field] = change
    elif change is None:
        del arrays[field]
    else:
        arrays[field] = np.ascontiguousarray(change(arrays[field].copy()))
    with pytest.raises(DataError, match=message) as caught:
        read_tensors(save(arrays, {KEY: json.dumps(facts)}), Path("sim/file"), "crossing-0")
    error = caught.value
    assert (str(error.file), error.segment) == ("sim/file", "crossing-0")
    assert field.removeprefix("log.").removesuffix(".offsets") in str(error.field)


def test_damage_is_found_and_named(tmp_path: Path) -> None:
    folder = save_rollouts(tmp_path / "sim", ABOUT, [played(straight_road(seed=k)) for k in range(3)])
    files = [tmp_path / "sim" / entry.file for entry in folder.entries]
    data = bytearray(files[0].read_bytes())
    data[-5] ^= 1
    files[0].write_bytes(data)
    files[1].write_bytes(files[1].read_bytes()[:-100])
    files[2].unlink()
    for k, message in enumerate(["damaged", "damaged", "can't be read"]):
        with pytest.raises(DataError, match=message) as caught:
            RolloutFolder(tmp_path / "sim")[k]
        assert (caught.value.file, caught.value.segment) == (files[k], f"straight-{k}")
    broken = played(straight_road())
    broken.state[0, 3] = np.nan
    with pytest.raises(DataError, match="not finite"):  # nor is it written
        save_rollouts(tmp_path / "other", ABOUT, [broken])
    assert len(load_rollouts(tmp_path / "other")) == 0


def test_a_shape_that_nothing_could_hold_is_damage(tmp_path: Path) -> None:
    header = json.dumps({"state": {"dtype": "F32", "shape": [0, 2**62, 8], "data_offsets": [0, 0]}}).encode()
    header += b" " * (-len(header) % 8)
    with pytest.raises(DataError, match=r"one\.safetensors, segment one: damaged"):
        read_tensors(len(header).to_bytes(8, "little") + header, tmp_path / "one.safetensors", "one")


@pytest.mark.parametrize(("file", "change", "message"), [
    ("index.jsonl", {"file": ["segments/a"]}, "line 1 is damaged .file must be str"),
    ("index.jsonl", {"file": "segments/\0"}, "no file of this folder"),
    ("index.jsonl", {"file": "segments/../a"}, "no file of this folder"),
    ("index.jsonl", {"rollouts": 10**9}, "line 1: 1000000000 rollouts"),
    ("index.jsonl", {"failed": 3}, "line 1 is damaged .failed must be str"),
    ("index.jsonl", "3", "line 1 is damaged"),
    ("index.jsonl", "[" * 100_000, "line 1 is damaged"),
    *(("manifest.json", {name: [3]}, "must be") for name in ("agent", "seed", "drivers", "settings", "store")),
    ("manifest.json", {"format": 9}, "format 1"),
    ("manifest.json", "[" * 100_000, "not valid JSON"),
])  # fmt: skip
def test_an_index_or_a_manifest_that_lies_is_refused(
    file: str, change: Any, message: str, tmp_path: Path
) -> None:
    save_rollouts(tmp_path / "sim", ABOUT, [played(straight_road())])
    path = tmp_path / "sim" / file
    path.write_text(change if isinstance(change, str) else json.dumps(json.loads(path.read_text()) | change))
    with path.open("a") as lines:
        lines.write("\n")
    with pytest.raises(DataError, match=message):
        load_rollouts(tmp_path / "sim")


def test_a_simulation_is_kept_whatever_the_batch_and_the_interruptions(tmp_path: Path) -> None:
    agent, store = load_agent(AGENT), SegmentStore(builtin_store("test"))

    def dataset(count: int) -> SceneDataset:
        return SceneDataset(store, agent.interactive, agent.dynamics, range(count), routes=True, duration=2)

    config = EvaluateConfig(search="tree", rollouts=2, branches=4, batch=2)
    done: list[tuple[int, int]] = []
    save_simulation(tmp_path / "cut", agent, dataset(1), config)
    more = dataclasses.replace(config, batch=3)
    cut = save_simulation(tmp_path / "cut", agent, dataset(3), more, progress=lambda *at: done.append(at))
    whole = save_simulation(tmp_path / "whole", agent, dataset(3), config)
    assert done == [(3, 3)]
    assert cut.ids == whole.ids == store.ids[:3]
    for one, two in zip(cut, whole, strict=True):
        assert_same(one, two)
        assert one.trees is not None
        assert one.drivers == (AGENT, AGENT)
    log = save_simulation(tmp_path / "log", load_agent("playback"), dataset(1), config)
    np.testing.assert_allclose(log[0].state[0, :, 0, :2], store[0].position[log[0].agents[0], :11, :2])
    assert log[0].drivers == ("playback", "playback")
    bare = save_simulation(tmp_path / "bare", agent, dataset(1), config, keep_tree=False)
    assert bare[0].trees is None
    np.testing.assert_array_equal(bare[0].state, whole[0].state)
