"""Checkpoints that were tampered with: an error that names file and field, and nothing is changed."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from helpers_runs import tiny
from helpers_segments import crossing
from helpers_store import fill
from symphony.agents.checkpoint import (
    MANIFEST,
    CheckpointError,
    checkpoints,
    load_checkpoint,
    save_checkpoint,
)
from symphony.agents.choice import choose
from symphony.config import ValidationConfig
from symphony.recipes import train


def parts() -> dict[str, Any]:
    module = nn.Linear(3, 2)
    optimizer = torch.optim.Adam(module.parameters(), lr=0.1)
    module(torch.ones(4, 3)).sum().backward()
    optimizer.step()
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, 3)
    optimizers = {"adam": optimizer, "schedule": schedule}
    return {"modules": {"policy": module}, "optimizers": optimizers}


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


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in nested JSON but the inside of long lists of numbers."""
    yield at
    items = (
        value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    )
    for key, inner in items:
        yield from places(inner, (*at, key))


def put(value: Any, at: tuple[Any, ...], new: Any) -> Any:
    if not at:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[at[0]] = put(value[at[0]], at[1:], new)
    return copy


HOSTILE = [None, True, -1, 10**30, 1e308, "", "nan", [], {}, [[]], {"$": "tensor", "value": "x"}, {"$": []}]


def refusal(path: Path, module: nn.Module) -> CheckpointError | None:
    """Why the checkpoint of an agent is not loaded, if it isn't; nothing else is raised."""
    try:
        load_checkpoint(path, modules={"policy": module}, partial=True, restore_rng=False)
    except CheckpointError as error:
        return error
    return None


def test_no_other_value_is_taken(signed: Path) -> None:
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


def test_manifests_of_earlier_versions_are_read(saved: Path) -> None:
    assert load_checkpoint(saved, **parts()).extra["seen"] == (1, 2.5)


def test_no_manifest_makes_loading_fail_otherwise(saved: Path) -> None:
    file, module, errors = saved / MANIFEST, parts()["modules"]["policy"], 0
    good = json.loads(file.read_text())
    state = torch.get_rng_state()
    for k, at in enumerate(places(good)):
        for new in HOSTILE[k % 2 :: 2]:
            file.write_text(json.dumps(put(good, at, new)))
            before = [t.clone() for t in module.state_dict().values()]
            if (error := refusal(saved, module)) is not None:
                errors += 1
                assert error.file is not None
                assert all(map(torch.equal, before, module.state_dict().values()))
            assert torch.equal(state, torch.get_rng_state())
    assert errors > 100


@pytest.mark.parametrize(
    ("at", "new", "field"),
    [
        (("format",), True, "format"),
        (("step",), 1.0, "step"),
        (("step",), True, "step"),
        (("step",), 8, "step"),
        (("parts", "extra", "state"), [1], "extra"),
    ],
)
def test_fields_are_named(saved: Path, at: tuple[Any, ...], new: Any, field: str) -> None:
    file = saved / MANIFEST
    file.write_text(json.dumps(put(json.loads(file.read_text()), at, new)))
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(saved, **parts())
    assert (caught.value.field, Path(str(caught.value.file)).parent) == (field, saved)


def test_nesting_without_end(saved: Path) -> None:
    (saved / MANIFEST).write_text('{"format": 1, "step": 7, "parts": ' + "[" * 100_000 + "]" * 100_000 + "}")
    with pytest.raises(CheckpointError):
        load_checkpoint(saved, **parts())


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_not_finite_are_refused(value: float, tmp_path: Path) -> None:
    bad, own = parts(), parts()
    with torch.no_grad():
        bad["modules"]["policy"].weight[1, 2] = value
    path = save_checkpoint(tmp_path, step=1, **bad)
    before = own["modules"]["policy"].weight.clone()
    with pytest.raises(CheckpointError, match="1 of 6 numbers are not finite") as caught:
        load_checkpoint(path, **own)
    assert (caught.value.field, caught.value.file) == ("weight", path / "module.policy.safetensors")
    assert torch.equal(before, own["modules"]["policy"].weight)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    fill(tmp_path / "store", [crossing(seed=k, steps=8) for k in range(3)])
    return tmp_path / "store"


def test_what_a_run_keeps_is_looked_at_when_it_goes_on(store: Path, tmp_path: Path) -> None:
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


def test_equal_runs_write_equal_checkpoints(store: Path, tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        # Whatever the process did before.
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)
        train(tiny("bc_ts", store, tmp_path / name, seed=5))
    digests = [
        {
            (path.name, file.name): hashlib.sha256(file.read_bytes()).hexdigest()
            for path in checkpoints(tmp_path / name / "checkpoints")
            for file in path.iterdir()
        }
        for name in "ab"
    ]
    assert len(digests[0]) > 6
    assert digests[0] == digests[1]
