"""Checkpoints: exact resumption, atomic writing, strict reading of what was damaged or tampered with."""

from __future__ import annotations

import json
import os
import pickle
import random
import re
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from helpers_runs import tiny
from helpers_segments import CHARACTERS, crossing
from helpers_store import contents, stored
from symphony.agents import checkpoint as module
from symphony.agents.checkpoint import MANIFEST, CheckpointError, checkpoints, load_checkpoint, save_checkpoint
from symphony.agents.choice import choose
from symphony.config import ValidationConfig
from symphony.errors import DataError, SymphonyError
from symphony.recipes import train


class Run:
    """A small training run that uses every source of randomness."""

    def __init__(self, seed=0, width=5, kind=torch.optim.Adam, **options):
        torch.manual_seed(seed)
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        layers = nn.Linear(3, width), nn.BatchNorm1d(width), nn.Dropout(0.3), nn.Linear(width, 1)
        self.module = nn.Sequential(*layers)
        groups = [{"params": self.module[0].parameters(), "lr": 0.1}, {"params": self.module[3].parameters()}]
        self.optimizer = kind(groups, **options)
        self.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self.optimizer, 20)

    def step(self):
        x = torch.randn(8, 3) + random.random() + np.random.rand()  # noqa: NPY002
        loss = self.module(x).square().mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        return loss.item()

    def weights(self):
        return self.module.state_dict().values()

    def parts(self):
        optimizers = {"adam": self.optimizer, "schedule": self.schedule}
        return {"modules": {"policy": self.module}, "optimizers": optimizers}


KINDS = {"Adam": {}, "AdamW": {"amsgrad": True}, "SGD": {"lr": 0.1, "momentum": 0.9}}


@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_goes_on_to_the_last_bit(tmp_path, kind):
    how = {"kind": getattr(torch.optim, kind), **KINDS[kind]}
    run = Run(**how)
    for _ in range(4):
        run.step()
    path = save_checkpoint(tmp_path / "run", step=4, **run.parts(), extra={"best": 0.1, "seen": (1, None)})
    losses = [run.step() for _ in range(5)]
    again = Run(seed=9, **how)
    again.step()
    loaded = load_checkpoint(path, **again.parts())
    assert (loaded.step, loaded.extra) == (4, {"best": 0.1, "seen": (1, None)})
    assert [again.step() for _ in range(5)] == losses
    assert all(torch.equal(a, b) for a, b in zip(run.weights(), again.weights(), strict=True))
    ours, theirs = run.optimizer.state_dict(), again.optimizer.state_dict()
    assert ours["param_groups"] == theirs["param_groups"]
    torch.testing.assert_close(ours["state"], theirs["state"], rtol=0, atol=0)


def test_a_planted_pickle_is_never_read(tmp_path):
    run = Run()
    path = save_checkpoint(tmp_path, step=1, **run.parts())

    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "exploded"),))

    for name in ("other.pickle", "module.policy.pt"):
        (path / name).write_bytes(pickle.dumps(Bomb()))
    load_checkpoint(path, **run.parts())
    (path / "module.policy.safetensors").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(CheckpointError, match="checksum"):
        load_checkpoint(path, **run.parts())
    assert not (tmp_path / "exploded").exists()


def test_partial_loading_takes_one_module_and_leaves_the_random_states(tmp_path):
    run = Run()
    path = save_checkpoint(tmp_path, step=2, **run.parts())
    other = Run(seed=5)
    before = torch.get_rng_state()
    load_checkpoint(path, modules={"policy": other.module}, partial=True, restore_rng=False)
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(a, b) for a, b in zip(run.weights(), other.weights(), strict=True))
    with pytest.raises(CheckpointError, match=r"optimizer\.adam.*not asked for"):
        load_checkpoint(path, modules={"policy": other.module})


def mismatches():
    shape = Run(width=6)
    renamed, dtype = Run().parts(), Run()
    renamed["modules"] = {"critic": renamed["modules"]["policy"]}
    dtype.module.double()
    extra_layer = Run()
    extra_layer.module.append(nn.Linear(1, 1))
    fewer = Run()
    fewer.optimizer = torch.optim.Adam(fewer.module.parameters())
    fewer.schedule = torch.optim.lr_scheduler.CosineAnnealingLR(fewer.optimizer, 20)
    return {
        "shape": (shape.parts(), r"policy\.safetensors, field 0\.weight.*\(5, 3\), expected .*\(6, 3\)"),
        "dtype": (dtype.parts(), r"field 0\.weight.*float32.*expected torch\.float64"),
        "name": (renamed, r"checkpoint\.json, field module\.critic: not in the checkpoint"),
        "layer": (extra_layer.parts(), r"field 4\.weight: only the module has it"),
        "groups": (fewer.parts(), r"field optimizer\.adam: does not fit"),
    }


@pytest.mark.parametrize("case", ["shape", "dtype", "name", "layer", "groups"])
def test_what_does_not_fit_is_named_and_nothing_is_changed(tmp_path, case):
    run = Run(seed=3)
    run.step()
    path = save_checkpoint(tmp_path, step=1, **run.parts())
    target, message = mismatches()[case]
    before = [t.clone() for m in target["modules"].values() for t in m.state_dict().values()]
    state = torch.get_rng_state()
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint(path, **target)
    assert isinstance(caught.value, SymphonyError)
    assert str(path) in str(caught.value)
    after = [t for m in target["modules"].values() for t in m.state_dict().values()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize("name", ["module.policy", "optimizer.adam", "rng"])
@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_damage_is_noticed(tmp_path, name, damage):
    run = Run()
    run.step()
    file = save_checkpoint(tmp_path, step=1, **run.parts()) / f"{name}.safetensors"
    content = bytearray(file.read_bytes())
    if damage == "remove":
        file.unlink()
    else:
        content[-9] ^= 1
        file.write_bytes(content if damage == "flip" else content[:-1])
    with pytest.raises(CheckpointError, match=re.escape(file.name)):
        load_checkpoint(file.parent, **run.parts())


def test_a_full_disk_leaves_the_old_checkpoint_and_no_debris(tmp_path):
    run = Run()
    path = save_checkpoint(tmp_path, step=1, **run.parts())
    content = {file.name: file.read_bytes() for file in path.iterdir()}
    run.step()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limits[1]))  # the random states alone are larger
    try:
        for step in (1, 2):
            with pytest.raises(CheckpointError, match=f"step-{step:012d}: can't write"):
                save_checkpoint(tmp_path, step=step, **run.parts())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == [path]
    assert {file.name: file.read_bytes() for file in path.iterdir()} == content


def test_a_crash_at_any_rename_leaves_a_complete_checkpoint(tmp_path, monkeypatch):
    class Killed(BaseException):
        """Not an OSError: nothing gets to clean up, as after a power cut."""

    run, rename = Run(), Path.rename
    for crash_at in (0, 1):
        folder = tmp_path / str(crash_at)
        save_checkpoint(folder, step=7, **run.parts(), extra={"version": 1})
        calls = iter(range(10))

        def fail(path, target, calls=calls, crash_at=crash_at):
            if next(calls) == crash_at:
                raise Killed
            return rename(path, target)

        monkeypatch.setattr(Path, "rename", fail)
        with pytest.raises(Killed):
            save_checkpoint(folder, step=7, **run.parts(), extra={"version": 2})
        monkeypatch.undo()
        assert load_checkpoint(module.latest(folder), **run.parts()).extra == {"version": 1}
        save_checkpoint(folder, step=7, **run.parts(), extra={"version": 3})
        assert load_checkpoint(module.latest(folder), **run.parts()).extra == {"version": 3}
        assert [path.name for path in folder.iterdir()] == ["step-000000000007"]


def test_listing_and_pruning(tmp_path):
    assert module.latest(tmp_path / "absent") is None
    assert checkpoints(tmp_path) == []
    paths = {step: save_checkpoint(tmp_path, step=step, modules={}) for step in (20, 3, 100, 7)}
    (tmp_path / "step-000000000999").mkdir()  # without a manifest: not one, but the remains of one
    (tmp_path / "notes.txt").write_text("")
    assert checkpoints(tmp_path) == [paths[step] for step in (3, 7, 20, 100)]
    assert module.latest(tmp_path) == paths[100]
    module.prune(tmp_path, 1, protect=[7])
    assert checkpoints(tmp_path) == [paths[7], paths[100]]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", paths[7].name, paths[100].name]
    module.prune(tmp_path, 5)
    assert checkpoints(tmp_path) == [paths[7], paths[100]]


def test_what_cannot_be_stored_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"extra\.a\.1: a value of type object"):
        save_checkpoint(tmp_path, step=1, modules={}, extra={"a": [1, object()]})
    assert issubclass(CheckpointError, DataError)
    assert not list(tmp_path.iterdir())


text = st.text(CHARACTERS, max_size=4)


def nested(inner):
    several, keys = st.lists(inner, max_size=3), text | st.just("$") | st.integers()
    return several | several.map(tuple) | st.dictionaries(keys, inner, max_size=3)


def through_json(value, tensors):
    return module.decode(json.loads(json.dumps(module.encode(value, tensors, "x"), allow_nan=False)), tensors)


plain = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | text


@given(st.recursive(plain, nested, max_leaves=12))
def test_plain_values_survive_encoding(value):
    tensors = {}
    assert repr(through_json(value, tensors)) == repr(value)
    assert not tensors


def test_tensors_arrays_and_types_survive_encoding():
    half, numbers = torch.ones((), dtype=torch.bfloat16), np.arange(4, dtype=np.uint32)
    value = {"a.b": torch.arange(3), "a": {"b": half}, "n": numbers, "x": [float("inf"), float("nan")]}
    tensors = {}
    back = through_json(value, tensors)
    assert len(tensors) == 3
    for found, put_in in ((back["a.b"], value["a.b"]), (back["a"]["b"], half)):
        torch.testing.assert_close(found, put_in, rtol=0, atol=0)
    np.testing.assert_array_equal(back["n"], numbers, strict=True)
    np.testing.assert_equal(back["x"], value["x"])


def parts():
    run = Run()
    run.step()
    return run.parts()


@pytest.fixture
def signed(tmp_path: Path) -> Path:
    return save_checkpoint(tmp_path, step=7, **parts(), extra={"best": None, "seen": (1, 2.5)})


def unsigned(manifest: dict[str, Any]) -> dict[str, Any]:
    """As earlier versions wrote it: nothing is noticed by a checksum of the whole."""
    return {name: value for name, value in manifest.items() if name != "sha256"}


@pytest.fixture
def saved(signed: Path) -> Path:
    file = signed / MANIFEST
    file.write_text(json.dumps(unsigned(json.loads(file.read_text()))))
    return signed


def put(value: Any, at: tuple[Any, ...], new: Any) -> Any:
    if not at:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[at[0]] = put(value[at[0]], at[1:], new)
    return copy


def test_no_other_value_is_taken(signed):
    file = signed / MANIFEST
    good = json.loads(file.read_text())
    file.write_text(json.dumps(good))  # another layout, the same values
    load_checkpoint(signed, **parts())
    group = ("parts", "optimizer.adam", "state", "param_groups", 0)
    changes = [((*group, "lr"), 0.2), ((*group, "weight_decay"), 1), (("parts", "extra", "state", "seen"), 3)]
    changes += [(("parts", "rng", "state", "numpy", "state", "pos"), 5), (("torch",), "2.13")]
    altered = [put(good, at, new) for at, new in changes]
    for manifest in (*altered, {**unsigned(good), "sha257": good["sha256"]}):
        file.write_text(json.dumps(manifest))
        with pytest.raises(CheckpointError, match=f"{MANIFEST}.*checksum") as caught:
            load_checkpoint(signed, **parts())
        assert (caught.value.file, caught.value.field) == (file, "sha256")


def test_nesting_without_end(saved):
    (saved / MANIFEST).write_text('{"format": 1, "step": 7, "parts": ' + "[" * 100_000 + "]" * 100_000 + "}")
    with pytest.raises(CheckpointError):
        load_checkpoint(saved, **parts())


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_not_finite_are_refused(value, tmp_path):
    bad, own = parts(), parts()
    with torch.no_grad():
        bad["modules"]["policy"][0].weight[1, 2] = value
    path = save_checkpoint(tmp_path, step=1, **bad)
    before = own["modules"]["policy"][0].weight.clone()
    with pytest.raises(CheckpointError, match="1 of 15 numbers are not finite") as caught:
        load_checkpoint(path, **own)
    assert (caught.value.field, caught.value.file) == ("0.weight", path / "module.policy.safetensors")
    assert torch.equal(before, own["modules"]["policy"][0].weight)


store = stored(lambda: [crossing(seed=k, steps=5) for k in range(3)])


def test_what_a_run_keeps_is_looked_at_when_it_goes_on(store, tmp_path):
    evaluated = ValidationConfig(data=store, segments=1, rollouts=1)
    train(tiny("bc", store, tmp_path / "run", validation=evaluated))
    file = checkpoints(tmp_path / "run" / "checkpoints")[-1] / MANIFEST
    good = unsigned(json.loads(file.read_text()))
    assert good["parts"]["extra"]["state"]["best"] is not None
    for new in ("x", -1, {"step": "one", "infractions": 2}):
        file.write_text(json.dumps(put(good, ("parts", "extra", "state", "best"), new)))
        with pytest.raises(CheckpointError) as caught:
            train(tiny("bc", store, tmp_path / "run", steps=6, validation=evaluated, resume=True))
        assert (caught.value.file, caught.value.field) == (file, "extra.best")
        with pytest.raises(CheckpointError, match=MANIFEST):
            choose(tmp_path / "run")


def test_equal_runs_write_equal_checkpoints(store, tmp_path):
    for name, seed in (("a", 1), ("b", 2)):
        # Whatever the process did before.
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)
        train(tiny("bc_ts_h", store, tmp_path / name, seed=5))
    one, other = (contents(tmp_path / name / "checkpoints") for name in "ab")
    assert len(one) > 6
    assert one == other
