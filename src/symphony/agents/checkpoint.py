"""Checkpoints of a training run: atomic on disk, free of pickle, resumed to the last bit.

A checkpoint is a folder `step-<number>` that holds one safetensors file per module, optimizer and for the random
number generators, and `checkpoint.json` with everything that is not a tensor, a checksum of each file and one of its
own.

Why not `torchrl.checkpoint` (0.14): it reads tensors through `tensordict.load`, which unpickles a file that the
manifest doesn't mention, if one is planted beside them; it never flushes to the disk before the rename that
publishes; and it restores component after component, so that a mismatch leaves the earlier ones overwritten.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import uuid
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load as decode_tensors
from safetensors.torch import save as encode_tensors
from torch import Tensor, nn

from symphony.agents.codec import decode, encode
from symphony.errors import DataError

FORMAT = 1
MANIFEST = "checkpoint.json"
_NAME = re.compile(r"step-(\d{12})")


class CheckpointError(DataError):
    """A checkpoint that can't be written, read, or fitted to what it is loaded into."""


@dataclass(frozen=True)
class LoadedCheckpoint:
    """The step that a checkpoint was saved at, and the caller's own values in it."""

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

    The checkpoint appears complete or not at all; one of the same step is replaced. One process may write to
    a folder at a time.

    Args:
        folder: of all checkpoints of the run, made if absent.
        step: updates done so far.
        modules: by name, saved by their `state_dict`.
        optimizers: by name, or whatever else keeps a state, such as a schedule of learning rates.
        extra: JSON-like values (also tuples and tensors), handed back by :func:`load_checkpoint`.

    Raises:
        CheckpointError: if something can't be stored or the disk refuses; earlier checkpoints stay as they are.
    """
    final = folder / f"step-{step:012d}"
    states: dict[str, Any] = {"rng": _rng_state(), "extra": dict(extra or {})}
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
    widen: bool = False,
) -> LoadedCheckpoint:
    """Restore what is passed from the checkpoint folder `path`; no module is changed unless all fit.

    Args:
        path: one checkpoint, as returned by :func:`save_checkpoint` or :func:`latest`.
        modules: by the names they were saved under.
        optimizers: by the names they were saved under.
        partial: allow the checkpoint to hold more than is asked for (evaluation needs the policy only).
        restore_rng: also set the global random states of Python, numpy and torch.
        widen: let modules have further inputs after those that were saved: columns that a saved matrix lacks are 0,
            so that they change nothing at first, and buffers that it lacks are left as they are.

    Raises:
        CheckpointError: if the folder is no complete checkpoint of this format, a checksum fails, names, shapes or
            types differ, or a weight is not finite; names the file and the field.
    """
    manifest, file = _read_manifest(path), path / MANIFEST
    asked: dict[str, Any] = {f"module.{name}": item for name, item in (modules or {}).items()}
    asked |= {f"optimizer.{name}": item for name, item in (optimizers or {}).items()}
    held = {part for part in manifest["parts"] if part not in ("rng", "extra")}
    if absent := sorted(asked.keys() - held):
        raise CheckpointError(f"not in the checkpoint, which has {sorted(held)}", file=file, field=absent[0])
    if not partial and (surplus := sorted(held - asked.keys())):
        raise CheckpointError("in the checkpoint but not asked for", file=file, field=surplus[0])
    states = {part: _read_part(path, manifest, part) for part in ("rng", "extra", *asked)}
    rng = states["rng"]
    if restore_rng and len(rng["cuda"]) not in (0, torch.cuda.device_count()):
        raise CheckpointError(
            f"random states of {len(rng['cuda'])} CUDA devices saved, {torch.cuda.device_count()} present",
            file=file,
            field="rng",
        )
    for part, item in asked.items():
        if isinstance(item, nn.Module):
            states[part] = _widened(item, states[part]) if widen else states[part]
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
    """All complete checkpoints in `folder`, by ascending step."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        # A parked one, which sorts first, counts only if the crash came before its successor took its place.
        match = _NAME.fullmatch(path.name.removeprefix(".old-"))
        if match and (path / MANIFEST).is_file():
            found[int(match[1])] = path
    return [found[step] for step in sorted(found)]


def parts_of(path: Path) -> set[str]:
    """Names of the modules that a checkpoint holds.

    Raises:
        CheckpointError: if the folder is no complete checkpoint of this format.
    """
    parts = _read_manifest(path)["parts"]
    return {name.removeprefix("module.") for name in parts if name.startswith("module.")}


def latest(folder: Path) -> Path | None:
    """The complete checkpoint of the highest step in `folder`, or None."""
    return next(reversed(checkpoints(folder)), None)


def prune(folder: Path, keep: int, *, protect: Collection[int] = ()) -> None:
    """Delete all but the last `keep` checkpoints (at least one) and those of the steps in `protect`.

    What a kill in an earlier deletion has left goes too.

    Raises:
        CheckpointError: if the disk refuses.
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
            with (new / name).open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        _flush_folder(new)
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
        _flush_folder(folder)
        shutil.rmtree(parked, ignore_errors=True)
    except OSError:
        shutil.rmtree(new, ignore_errors=True)
        raise


def _flush_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _read_manifest(path: Path) -> dict[str, Any]:
    file = path / MANIFEST
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
        checksum = _checksum(manifest) if isinstance(manifest, dict) else ""
    except OSError as error:
        raise CheckpointError(f"no checkpoint here: {error.strerror}", file=file) from error
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"not JSON: {error}", file=file) from error
    version = manifest.get("format") if isinstance(manifest, dict) else None
    if type(version) is not int or version != FORMAT:
        raise CheckpointError(f"format {version!r}, this version reads {FORMAT}", file=file, field="format")
    # Earlier versions wrote no checksum. Its own name may be what was changed, hence no others are known.
    strange = set(manifest) - {"format", "step", "torch", "parts", "sha256"}
    if strange or manifest.get("sha256", checksum) != checksum:
        raise CheckpointError(
            "damaged: its checksum differs from the recorded one", file=file, field="sha256"
        )
    step, parts = manifest.get("step"), manifest.get("parts")
    if type(step) is not int or not 0 <= step < 10**12:
        raise CheckpointError(f"no number of updates: {str(step)[:40]!r}", file=file, field="step")
    named = _NAME.fullmatch(path.name.removeprefix(".old-"))
    if named and int(named[1]) != step:
        raise CheckpointError(f"is {step} in the folder {path.name}", file=file, field="step")
    if not isinstance(parts, dict) or not {"rng", "extra"} <= set(parts):
        raise CheckpointError(
            "parts missing: at least rng and extra are in every checkpoint", file=file, field="parts"
        )
    return manifest


def _checksum(manifest: Mapping[str, Any]) -> str:
    """The checksum of all other values that a manifest holds."""
    held = {name: value for name, value in manifest.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()


def _read_part(path: Path, manifest: dict[str, Any], part: str) -> dict[str, Any]:
    file = path / f"{part}.safetensors"
    tensors: dict[str, Tensor] = {}
    try:
        entry = manifest["parts"][part]
        if "file" in entry:
            content = file.read_bytes()
            if hashlib.sha256(content).hexdigest() != entry["sha256"]:
                raise CheckpointError("damaged: its checksum differs from the recorded one", file=file)
            tensors = decode_tensors(content)
        state = decode(entry["state"], tensors)
    except OSError as error:
        raise CheckpointError(f"can't be read: {error.strerror}", file=file, field=part) from error
    except CheckpointError:
        raise
    except Exception as error:  # torch and the decoder raise much on what they did not write
        raise CheckpointError(
            f"can't be decoded: {error!r}"[:300], file=path / MANIFEST, field=part
        ) from error
    if not isinstance(state, dict):
        raise CheckpointError("no table of values", file=path / MANIFEST, field=part)
    return state


def _match(file: Path, own: Mapping[str, Any], saved: Mapping[str, Any]) -> None:
    """See that a saved state has the tensors of a module, and that all are finite."""
    for name in [*own, *saved]:
        if name not in saved or name not in own:
            where = "the module" if name in own else "the checkpoint"
            raise CheckpointError(f"only {where} has it", file=file, field=str(name))
        mine, other = own[name], saved[name]
        if not isinstance(other, Tensor) or mine.shape != other.shape or mine.dtype != other.dtype:
            found = (
                f"{other.dtype} {tuple(other.shape)}" if isinstance(other, Tensor) else type(other).__name__
            )
            raise CheckpointError(
                f"saved as {found}, expected {mine.dtype} {tuple(mine.shape)}", file=file, field=name
            )
        if bad := int((~torch.isfinite(other)).sum()):
            raise CheckpointError(f"{bad} of {other.numel()} numbers are not finite", file=file, field=name)


def _widened(module: nn.Module, saved: dict[str, Any]) -> dict[str, Any]:
    """A state with the columns and buffers that a module has beyond it."""
    found, buffers = dict(saved), {name for name, _ in module.named_buffers()}
    for name, own in module.state_dict().items():
        there = saved.get(name)
        if there is None and name in buffers:
            found[name] = own.clone()
        elif isinstance(there, Tensor) and there.ndim == own.ndim == 2:
            missing = own.shape[1] - there.shape[1]
            found[name] = nn.functional.pad(there, (0, missing)) if missing > 0 else there
    return found


def _rng_state() -> dict[str, Any]:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - whoever uses the global state must get it back
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
    }
