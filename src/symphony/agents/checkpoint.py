"""Checkpoints of a training run: atomic on disk, free of pickle, resumed to the last bit.

A checkpoint is a folder `step-<number>` that holds one safetensors file per module, optimizer and for the random
number generators, and `checkpoint.json` with everything that is not a tensor, a checksum of each file and one of its
own. `torchrl.checkpoint` (0.14) would unpickle a planted file, flushes nothing before it publishes, and overwrites
component after component where a later one does not fit.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import random
import re
import shutil
import uuid
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors.torch import load as decode_tensors
from safetensors.torch import save as encode_tensors
from torch import Tensor, nn

from symphony.errors import DataError

FORMAT = 1
MANIFEST = "checkpoint.json"
TAG = "$"  # key of a JSON object that stands for something JSON lacks
_NAME = re.compile(r"step-(\d{12})")


class CheckpointError(DataError):
    """A checkpoint that can't be written, read, or fitted to what it is loaded into."""


class LoadedCheckpoint(NamedTuple):
    """The step at which a checkpoint was saved, and the caller's own values in it."""

    step: int
    extra: dict[str, Any]


def save_checkpoint(
    folder: Path,
    *,
    step: int,
    modules: Mapping[str, nn.Module],
    optimizers: Mapping[str, Any] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write `folder/step-<step>`, with the global random states of Python, numpy and torch.

    The checkpoint appears complete or not at all; one of the same step is replaced. One process writes at a time.

    The folder is that of all checkpoints of the run, and created if absent. Modules are saved by name, by their
    `state_dict`, and so is whatever else keeps a state (optimizers, a schedule of learning rates); ``extra`` are
    JSON-like values, also tuples and tensors, that :func:`load_checkpoint` hands back.

    Raises a :class:`CheckpointError` if something can't be stored or the disk refuses; earlier ones stay as they are.
    """
    final = folder / f"step-{step:012d}"
    numbers = {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - whoever uses the global state must get it back
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
    }
    states: dict[str, Any] = {"rng": numbers, "extra": dict(extra or {})}
    states |= {f"module.{name}": module.state_dict() for name, module in modules.items()}
    states |= {f"optimizer.{name}": item.state_dict() for name, item in (optimizers or {}).items()}
    manifest: dict[str, Any] = {"format": FORMAT, "step": step, "torch": torch.__version__, "parts": {}}
    files: dict[str, bytes] = {}
    for part, state in states.items():
        tensors: dict[str, Tensor] = {}
        try:
            entry = {"state": encode(state, tensors, part)}
        except TypeError as error:
            raise CheckpointError(str(error), file=final) from error
        if tensors:
            content = encode_tensors(tensors)
            files[f"{part}.safetensors"] = content
            entry |= {"file": f"{part}.safetensors", "sha256": hashlib.sha256(content).hexdigest()}
        manifest["parts"][part] = entry
    manifest["sha256"] = _checksum(manifest)
    files[MANIFEST] = (json.dumps(manifest, indent=1, allow_nan=False) + "\n").encode()
    try:
        _publish(folder, final, files)
    except OSError as error:
        raise CheckpointError(f"can't write the checkpoint: {error}", file=final) from error
    return final


def load_checkpoint(
    path: Path,
    *,
    modules: Mapping[str, nn.Module] | None = None,
    optimizers: Mapping[str, Any] | None = None,
    partial: bool = False,
    restore_rng: bool = True,
) -> LoadedCheckpoint:
    """Restore what is passed from the checkpoint folder `path`; no module is changed unless all fit.

    Modules and optimizers go by the names they were saved under; ``partial`` lets the checkpoint hold more than is
    asked for. With ``restore_rng`` the global random states of Python, numpy and torch are set, too.

    Raises a :class:`CheckpointError` if the folder is not a complete checkpoint of this format, a checksum fails,
    names, shapes or types differ, or a weight is not finite; names the file and the field.
    """
    manifest, file = _read_manifest(path), path / MANIFEST
    asked: dict[str, Any] = {f"module.{name}": item for name, item in (modules or {}).items()}
    asked |= {f"optimizer.{name}": item for name, item in (optimizers or {}).items()}
    held = manifest["parts"].keys() - {"rng", "extra"}
    if absent := sorted(asked.keys() - held):
        raise CheckpointError(f"not in the checkpoint, which has {sorted(held)}", file=file, field=absent[0])
    if not partial and (surplus := sorted(held - asked.keys())):
        raise CheckpointError("in the checkpoint but not asked for", file=file, field=surplus[0])
    states = {part: _read_part(path, manifest, part) for part in ("rng", "extra", *asked)}
    rng = states["rng"]
    if restore_rng and (saved := len(rng["cuda"])) not in (0, torch.cuda.device_count()):
        found = f"random states of {saved} CUDA devices saved, {torch.cuda.device_count()} present"
        raise CheckpointError(found, file=file, field="rng")
    for part, item in asked.items():
        if isinstance(item, nn.Module):
            _match(path / f"{part}.safetensors", item.state_dict(), states[part])
    for part, item in reversed(asked.items()):  # optimizers first, of which one may still dislike its state
        try:
            item.load_state_dict(states[part])
        except Exception as error:  # each kind of optimizer has its own
            raise CheckpointError(f"does not fit: {error!r}", file=file, field=part) from error
    if restore_rng:
        random.setstate(rng["python"])
        np.random.set_state(rng["numpy"])  # noqa: NPY002
        torch.set_rng_state(rng["torch"])
        if rng["cuda"]:
            torch.cuda.set_rng_state_all(rng["cuda"])
    return LoadedCheckpoint(manifest["step"], states["extra"])


def checkpoints(folder: Path) -> list[Path]:
    """Return all complete checkpoints in `folder`, by ascending step."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        # A parked one, which sorts first, counts only if the crash came before its successor took its place.
        match = _NAME.fullmatch(path.name.removeprefix(".old-"))
        if match and (path / MANIFEST).is_file():
            found[int(match[1])] = path
    return [found[step] for step in sorted(found)]


def parts_of(path: Path) -> set[str]:
    """Return the names of the modules in a checkpoint."""
    parts = _read_manifest(path)["parts"]
    return {name.removeprefix("module.") for name in parts if name.startswith("module.")}


def latest(folder: Path) -> Path | None:
    """Return the complete checkpoint of the highest step in `folder`, or None."""
    return next(reversed(checkpoints(folder)), None)


def prune(folder: Path, keep: int, *, protect: Collection[int] = ()) -> None:
    """Delete all but the last `keep` checkpoints (at least one) and those of the steps in `protect`, and what an
    interrupted deletion has left; a CheckpointError if the disk refuses.
    """
    try:
        for path in checkpoints(folder)[:-keep]:
            if int(path.name[-12:]) not in protect:
                # Without its manifest it counts no longer, however far the deletion gets.
                (path / MANIFEST).unlink()
                shutil.rmtree(path.with_name(f".old-{path.name}"), ignore_errors=True)
        for path in folder.iterdir() if folder.is_dir() else []:
            if _NAME.fullmatch(path.name) and path.is_dir() and not (path / MANIFEST).is_file():
                shutil.rmtree(path)
    except OSError as error:
        raise CheckpointError(f"can't delete the checkpoint: {error}", file=folder) from error


def _publish(folder: Path, final: Path, files: Mapping[str, bytes]) -> None:
    """Write all files to a new folder, flush them, and put it in place of `final` by renaming."""
    folder.mkdir(parents=True, exist_ok=True)
    parked = folder / f".old-{final.name}"
    for stale in folder.glob(".new-*"):
        shutil.rmtree(stale, ignore_errors=True)
    new = folder / f".new-{uuid.uuid4().hex}"
    try:
        new.mkdir()
        for name, content in files.items():
            (new / name).write_bytes(content)
            _flush(new / name)
        _flush(new)
        if final.exists():
            if parked.exists():
                shutil.rmtree(parked)
            final.rename(parked)
        try:
            new.rename(final)
        except OSError:
            if parked.exists() and not final.exists():
                parked.rename(final)
            raise
        _flush(folder)
        shutil.rmtree(parked, ignore_errors=True)
    except OSError:
        shutil.rmtree(new, ignore_errors=True)
        raise


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _read_manifest(path: Path) -> dict[str, Any]:
    """Return the manifest of a checkpoint, checked except for the states inside."""
    file = path / MANIFEST

    def refused(what: str, field: str | None = None) -> CheckpointError:
        return CheckpointError(what, file=file, field=field)

    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
        checksum = _checksum(manifest) if isinstance(manifest, dict) else ""
    except OSError as error:
        raise refused(f"no checkpoint here: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise refused(f"not JSON: {error}") from error
    version = manifest.get("format") if isinstance(manifest, dict) else None
    if type(version) is not int or version != FORMAT:
        raise refused(f"format {version!r}, this version reads {FORMAT}", "format")
    # Earlier versions wrote no checksum. Its own name may be what was changed, hence no others are known.
    strange = set(manifest) - {"format", "step", "torch", "parts", "sha256"}
    if strange or manifest.get("sha256", checksum) != checksum:
        raise refused("damaged: its checksum differs from the recorded one", "sha256")
    step, parts = manifest.get("step"), manifest.get("parts")
    if type(step) is not int or not 0 <= step < 10**12:
        raise refused(f"not a number of updates: {str(step)[:40]!r}", "step")
    named = _NAME.fullmatch(path.name.removeprefix(".old-"))
    if named and int(named[1]) != step:
        raise refused(f"is {step} in the folder {path.name}", "step")
    if not isinstance(parts, dict) or not {"rng", "extra"} <= set(parts):
        raise refused("parts missing: at least rng and extra are in every checkpoint", "parts")
    return manifest


def _checksum(manifest: Mapping[str, Any]) -> str:
    """Return the checksum of all other values that a manifest holds."""
    held = {name: value for name, value in manifest.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()


def _read_part(path: Path, manifest: dict[str, Any], part: str) -> dict[str, Any]:
    """Return the state of a module or an optimizer, the random states, or the caller's values."""
    file, tensors = path / f"{part}.safetensors", {}
    try:
        entry = manifest["parts"][part]
        if "file" in entry:
            content = file.read_bytes()
            if hashlib.sha256(content).hexdigest() != entry["sha256"]:
                raise CheckpointError("damaged: its checksum differs from the recorded one", file=file)
            tensors = decode_tensors(content)
        state = decode(entry["state"], tensors)
        if not isinstance(state, dict):
            raise TypeError("not a table of values")
    except OSError as error:
        raise CheckpointError(f"can't be read: {error.strerror}", file=file, field=part) from error
    except CheckpointError:
        raise
    except Exception as error:  # torch and the decoder raise much on what they did not write
        what = f"can't be decoded: {error!r}"[:300]
        raise CheckpointError(what, file=path / MANIFEST, field=part) from error
    return state


def _match(file: Path, own: Mapping[str, Any], saved: Mapping[str, Any]) -> None:
    """Check that a saved state has the tensors of a module, and that all are finite."""
    for name in [*own, *saved]:
        if name not in saved or name not in own:
            where = "the module" if name in own else "the checkpoint"
            raise CheckpointError(f"only {where} has it", file=file, field=str(name))
        mine, other = own[name], saved[name]
        is_tensor = isinstance(other, Tensor)
        if not is_tensor or mine.shape != other.shape or mine.dtype != other.dtype:
            found = f"{other.dtype} {tuple(other.shape)}" if is_tensor else type(other).__name__
            what = f"saved as {found}, expected {mine.dtype} {tuple(mine.shape)}"
            raise CheckpointError(what, file=file, field=name)
        if bad := int((~torch.isfinite(other)).sum()):
            raise CheckpointError(f"{bad} of {other.numel()} numbers are not finite", file=file, field=name)


def encode(value: Any, tensors: dict[str, Tensor], name: str) -> Any:
    """Turn nested values into JSON; tensors and arrays go to `tensors` (copies on the CPU), named by their place. A
    TypeError names the place of a value that can't be stored.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Mapping):
        items = {key: encode(item, tensors, f"{name}.{key}") for key, item in value.items()}
        plain = all(isinstance(key, str) for key in value) and TAG not in value
        keys = [] if plain else encode(list(value), tensors, f"{name} (keys)")
        return items if plain else {TAG: "dict", "keys": keys, "items": list(items.values())}
    if isinstance(value, list):
        return [encode(item, tensors, f"{name}.{index}") for index, item in enumerate(value)]
    if isinstance(value, tuple):
        return {TAG: "tuple", "items": encode(list(value), tensors, name)}
    if isinstance(value, float):
        # JSON knows no infinity. (A numpy float64 is a float too: hence the conversion.)
        return float(value) if math.isfinite(value) else {TAG: "float", "value": repr(float(value))}
    if not isinstance(value, Tensor | np.ndarray):
        raise TypeError(f"{name}: a value of type {type(value).__name__} can't be stored")
    kind = "tensor" if isinstance(value, Tensor) else "array"
    unique, count = name, 1
    while unique in tensors:  # {"a.b": x, "a": {"b": y}} gives two tensors one name
        unique, count = f"{name}#{count}", count + 1
    tensors[unique] = torch.as_tensor(value).detach().to("cpu", copy=True).contiguous()
    return {TAG: kind, "value": unique}


def decode(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Reverse :func:`encode`; mappings become plain dicts."""
    if isinstance(value, list):
        return [decode(item, tensors) for item in value]
    if not isinstance(value, dict):
        return value
    kind = value.get(TAG)
    if kind is None:
        return {key: decode(item, tensors) for key, item in value.items()}
    if kind in ("float", "tensor", "array"):
        held = value["value"] if kind == "float" else tensors[value["value"]]
        return float(held) if kind == "float" else held.numpy() if kind == "array" else held
    items = decode(value["items"], tensors)
    if kind == "dict":
        return dict(zip(decode(value["keys"], tensors), items, strict=True))
    if kind != "tuple":
        raise ValueError(f"unknown kind {kind!r}")
    return tuple(items)
