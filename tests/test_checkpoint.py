"""Checkpoints: exact resumption, atomic writing, strict reading."""

from __future__ import annotations

import json
import os
import pickle
import random
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from symphony.agents.checkpoint import (
    CheckpointError,
    checkpoints,
    decode,
    encode,
    latest,
    load_checkpoint,
    prune,
    save_checkpoint,
)
from symphony.errors import DataError, SymphonyError


class Run:
    """A small training run that uses every source of randomness."""

    def __init__(self, seed=0, width=5, kind=torch.optim.Adam, **options):
        torch.manual_seed(seed)
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        self.module = nn.Sequential(
            nn.Linear(3, width), nn.BatchNorm1d(width), nn.Dropout(0.3), nn.Linear(width, 1)
        )
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

    def parts(self):
        return {
            "modules": {"policy": self.module},
            "optimizers": {"adam": self.optimizer, "schedule": self.schedule},
        }


def bits(run):
    return [t.clone() for t in run.module.state_dict().values()]


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (torch.optim.Adam, {}),
        (torch.optim.AdamW, {"amsgrad": True}),
        (torch.optim.SGD, {"lr": 0.1, "momentum": 0.9}),
    ],
)
def test_a_resumed_run_goes_on_to_the_last_bit(tmp_path, kind, options):
    run = Run(kind=kind, **options)
    for _ in range(4):
        run.step()
    path = save_checkpoint(tmp_path / "run", step=4, **run.parts(), extra={"best": 0.1, "seen": (1, None)})
    losses = [run.step() for _ in range(5)]
    again = Run(seed=9, kind=kind, **options)
    again.step()
    loaded = load_checkpoint(path, **again.parts())
    assert (loaded.step, loaded.extra) == (4, {"best": 0.1, "seen": (1, None)})
    assert [again.step() for _ in range(5)] == losses
    assert all(torch.equal(a, b) for a, b in zip(bits(run), bits(again), strict=True))
    ours, theirs = run.optimizer.state_dict(), again.optimizer.state_dict()
    assert ours["param_groups"] == theirs["param_groups"]
    for index, state in ours["state"].items():
        assert state.keys() == theirs["state"][index].keys()
        for name, value in state.items():
            assert value is theirs["state"][index][name] or torch.equal(value, theirs["state"][index][name])


def test_saving_disturbs_nothing(tmp_path):
    run, other = Run(), Run()
    other_losses = [other.step() for _ in range(3)]
    # Global random states are shared: start the first one over.
    run = Run()
    losses = [run.step()]
    save_checkpoint(tmp_path, step=1, **run.parts())
    assert [*losses, run.step(), run.step()] == other_losses


def test_no_file_holds_a_pickle(tmp_path):
    run = Run()
    run.step()
    path = save_checkpoint(tmp_path, step=1, **run.parts(), extra={"t": torch.ones(2)})
    names = {file.name for file in path.iterdir()}
    assert names == {
        "checkpoint.json",
        "module.policy.safetensors",
        "optimizer.adam.safetensors",
        "rng.safetensors",
        "extra.safetensors",
    }
    for file in path.iterdir():
        with pytest.raises(
            (pickle.UnpicklingError, KeyError, ValueError, EOFError, IndexError, AttributeError)
        ):
            pickle.loads(file.read_bytes())  # noqa: S301
    json.loads((path / "checkpoint.json").read_text(), parse_constant=pytest.fail)


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
    assert all(torch.equal(a, b) for a, b in zip(bits(run), bits(other), strict=True))
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


@pytest.mark.parametrize(
    "name", ["module.policy.safetensors", "optimizer.adam.safetensors", "rng.safetensors"]
)
@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_damage_is_noticed(tmp_path, name, damage):
    run = Run()
    run.step()
    file = save_checkpoint(tmp_path, step=1, **run.parts()) / name
    content = bytearray(file.read_bytes())
    if damage == "remove":
        file.unlink()
    else:
        content[-9] ^= 1
        file.write_bytes(content if damage == "flip" else content[:-1])
    with pytest.raises(CheckpointError, match=name.replace(".", r"\.")):
        load_checkpoint(file.parent, **run.parts())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not JSON"),
        ("[]", "format None"),
        ('{"format": 99}', "format 99, this version reads 1"),
        ('{"format": 1, "step": 1}', "parts missing"),
        (None, "no checkpoint here"),
    ],
)
def test_a_bad_manifest_is_refused(tmp_path, content, message):
    path = save_checkpoint(tmp_path, step=1, modules={})
    manifest = path / "checkpoint.json"
    manifest.unlink()
    if content is not None:
        manifest.write_text(content)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint(path)
    assert caught.value.file == manifest


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


def test_a_folder_that_cannot_be_written_gives_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="can't write the checkpoint"):
        save_checkpoint(tmp_path / "file", step=1, modules={})
    if os.geteuid() != 0:
        tmp_path.chmod(0o555)
        with pytest.raises(CheckpointError, match="Permission denied"):
            save_checkpoint(tmp_path, step=1, modules={})


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
        assert load_checkpoint(latest(folder), **run.parts()).extra == {"version": 1}
        save_checkpoint(folder, step=7, **run.parts(), extra={"version": 3})
        assert load_checkpoint(latest(folder), **run.parts()).extra == {"version": 3}
        assert [path.name for path in folder.iterdir()] == ["step-000000000007"]


def test_listing_and_pruning(tmp_path):
    assert latest(tmp_path / "absent") is None
    assert checkpoints(tmp_path) == []
    paths = {step: save_checkpoint(tmp_path, step=step, modules={}) for step in (20, 3, 100, 7)}
    (tmp_path / "step-000000000999").mkdir()  # without a manifest: not one, but the remains of one
    (tmp_path / "notes.txt").write_text("")
    assert checkpoints(tmp_path) == [paths[step] for step in (3, 7, 20, 100)]
    assert latest(tmp_path) == paths[100]
    prune(tmp_path, 1, protect=[7])
    assert checkpoints(tmp_path) == [paths[7], paths[100]]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", paths[7].name, paths[100].name]
    prune(tmp_path, 5)
    assert checkpoints(tmp_path) == [paths[7], paths[100]]


def test_what_cannot_be_stored_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"extra\.a\.1: a value of type object"):
        save_checkpoint(tmp_path, step=1, modules={}, extra={"a": [1, object()]})
    assert issubclass(CheckpointError, DataError)
    assert not list(tmp_path.iterdir())


def test_tied_and_strided_weights_survive(tmp_path):
    a, b = nn.Linear(4, 4), nn.Linear(4, 4)
    b.weight = a.weight
    a.bias = nn.Parameter(torch.arange(8.0)[::2])
    module = nn.ModuleDict({"a": a, "b": b})
    path = save_checkpoint(tmp_path, step=0, modules={"m": module})
    other = nn.ModuleDict({"a": nn.Linear(4, 4), "b": nn.Linear(4, 4)})
    load_checkpoint(path, modules={"m": other})
    assert all(
        torch.equal(x, y)
        for x, y in zip(module.state_dict().values(), other.state_dict().values(), strict=True)
    )


keys = st.text(max_size=4) | st.just("$") | st.integers()
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(keys, inner, max_size=3)
    ),
    max_leaves=12,
)


@given(plain)
def test_plain_values_survive_encoding(value):
    tensors = {}
    text = json.dumps(encode(value, tensors, "x"), allow_nan=False)
    back = decode(json.loads(text), tensors)
    assert repr(back) == repr(value)
    assert not tensors


def test_tensors_arrays_and_types_survive_encoding():
    value = {
        "a.b": torch.arange(3),
        "a": {"b": torch.ones((), dtype=torch.bfloat16)},
        "n": np.arange(4, dtype=np.uint32),
        "x": [float("inf"), float("nan")],
    }
    tensors = {}
    back = decode(json.loads(json.dumps(encode(value, tensors, "x"), allow_nan=False)), tensors)
    assert len(tensors) == 3
    assert torch.equal(back["a.b"], value["a.b"])
    assert back["a"]["b"].dtype == torch.bfloat16
    assert back["n"].dtype == np.uint32
    assert back["n"].tolist() == [0, 1, 2, 3]
    assert back["x"][0] == float("inf")
    assert back["x"][1] != back["x"][1]
