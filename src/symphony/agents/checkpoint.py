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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from safetensors.torch import load as decode_tensors
from safetensors.torch import save as encode_tensors
from torch import Tensor, nn

from symphony.agents.codec import decode, encode
from symphony.agents.fitting import CheckpointError, check_random_states, match_module, match_optimizer

FORMAT = 1
MANIFEST = "checkpoint.json"
_NAME = re.compile(r"step-(\d{12})")
_PART = re.compile(r"[A-Za-z0-9_-]+")
_CHECKSUM = "sha256"


class Stateful(Protocol):
    """An optimizer, a learning-rate schedule, or whatever else keeps a state of tensors and plain values."""

    def state_dict(self) -> dict[str, Any]:
        """The state."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Take the state over."""
        ...


@dataclass(frozen=True)
class LoadedCheckpoint:
    """What a checkpoint holds besides the states that were restored.

    Attributes:
        path: folder of the checkpoint.
        step: the step it was saved at.
        extra: the caller's own values.
    """

    path: Path
    step: int
    extra: dict[str, Any] = field(default_factory=dict)


def save_checkpoint(
    folder: Path,
    *,
    step: int,
    modules: Mapping[str, nn.Module],
    optimizers: Mapping[str, Stateful] | None = None,
    generators: Mapping[str, torch.Generator] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write `folder/step-<step>`, with the global random states of Python, numpy and torch.

    The checkpoint appears complete or not at all; one of the same step is replaced. One process may write to
    a folder at a time.

    Args:
        folder: of all checkpoints of the run, made if absent.
        step: updates done so far.
        modules: by name (letters, digits, `-`, `_`), saved by their `state_dict`.
        optimizers: likewise, learning-rate schedules included.
        generators: torch generators other than the global ones.
        extra: JSON-like values (also tuples and tensors), handed back by :func:`load_checkpoint`.

    Raises:
        CheckpointError: if something can't be stored or the disk refuses; earlier checkpoints stay as they are.
    """
    folder = Path(folder)
    final = folder / f"step-{step:012d}"
    states = {"rng": _rng_state(generators or {}), "extra": dict(extra or {})}
    for kind, items in (("module", modules), ("optimizer", optimizers or {})):
        for name, item in items.items():
            if not _PART.fullmatch(name):
                raise CheckpointError(
                    "names are made of letters, digits, '-' and '_'", field=f"{kind} {name!r}"
                )
            states[f"{kind}.{name}"] = item.state_dict()
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
    manifest[_CHECKSUM] = _checksum(manifest)
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
    optimizers: Mapping[str, Stateful] | None = None,
    generators: Mapping[str, torch.Generator] | None = None,
    partial: bool = False,
    restore_rng: bool = True,
    widen: bool = False,
) -> LoadedCheckpoint:
    """Restore what is passed from the checkpoint folder `path`; nothing is changed unless everything fits.

    Args:
        path: one checkpoint, as returned by :func:`save_checkpoint` or :func:`latest`.
        modules: by the names they were saved under.
        optimizers: likewise.
        generators: likewise.
        partial: allow the checkpoint to hold more than is asked for (evaluation needs the policy only).
        restore_rng: also set the global random states of Python, numpy and torch.
        widen: let modules have further inputs after those that were saved: columns that a saved matrix lacks are 0,
            so that they change nothing at first, and buffers that it lacks are left as they are.

    Raises:
        CheckpointError: if the folder is no complete checkpoint of this format, a checksum fails, names, shapes or
            types differ, or a number is not finite; names the file and the field.
    """
    path = Path(path)
    manifest = _read_manifest(path)
    asked: dict[str, Any] = {f"module.{name}": item for name, item in (modules or {}).items()}
    asked |= {f"optimizer.{name}": item for name, item in (optimizers or {}).items()}
    held = {part for part in manifest["parts"] if part not in ("rng", "extra")}
    _match_names(path / MANIFEST, set(asked), held, partial, what="part")
    states = {part: _read_part(path, manifest, part) for part in ("rng", "extra", *asked)}
    rng = states["rng"]
    own = generators or {}
    check_random_states(path / MANIFEST, rng, own)
    _match_names(path / MANIFEST, set(own), set(rng["generators"]), partial, what="generator")
    if restore_rng and len(rng["cuda"]) not in (0, torch.cuda.device_count()):
        raise CheckpointError(
            f"random states of {len(rng['cuda'])} CUDA devices saved, {torch.cuda.device_count()} present; "
            "pass restore_rng=False to do without",
            file=path / MANIFEST,
            field="rng",
        )
    for part, item in asked.items():
        where = path / f"{part}.safetensors"
        if isinstance(item, nn.Module):
            if widen:
                states[part] = _widened(item, states[part])
            match_module(where, item, states[part])
        elif isinstance(item, torch.optim.Optimizer):
            match_optimizer(where, item, states[part])
    for part, item in asked.items():
        try:
            item.load_state_dict(states[part])
        except Exception as error:  # whatever a schedule, say, makes of values it did not write
            raise CheckpointError(f"does not fit: {error!r}", file=path / MANIFEST, field=part) from error
    for name, generator in own.items():
        generator.set_state(rng["generators"][name])
    if restore_rng:
        _set_rng_state(rng)
    return LoadedCheckpoint(path, manifest["step"], states["extra"])


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


def checkpoints(folder: Path) -> list[Path]:
    """All complete checkpoints in `folder`, by ascending step."""
    found: dict[int, Path] = {}
    folder = Path(folder)
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
    parts = _read_manifest(Path(path))["parts"]
    return {name.removeprefix("module.") for name in parts if name.startswith("module.")}


def latest(folder: Path) -> Path | None:
    """The complete checkpoint of the highest step in `folder`, or None."""
    found = checkpoints(folder)
    return found[-1] if found else None


def prune(folder: Path, keep: int, *, protect: Collection[int] = ()) -> list[Path]:
    """Delete all but the last `keep` checkpoints (at least one) and those of the steps in `protect`; return them.

    What a kill in an earlier deletion has left goes too.

    Raises:
        CheckpointError: if the disk refuses.
    """
    if keep < 1:
        raise ValueError(f"keep must be at least 1, is {keep}")
    gone = [path for path in checkpoints(folder)[:-keep] if int(path.name[-12:]) not in protect]
    try:
        for path in gone:
            # Without its manifest it counts no longer, however far the deletion gets.
            (path / MANIFEST).unlink()
            shutil.rmtree(path.with_name(f".old-{path.name}"), ignore_errors=True)
        for path in Path(folder).iterdir() if Path(folder).is_dir() else []:
            if _NAME.fullmatch(path.name) and path.is_dir() and not (path / MANIFEST).is_file():
                shutil.rmtree(path)
    except OSError as error:
        raise CheckpointError(f"can't delete the checkpoint: {error}", file=folder) from error
    return gone


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
        manifest = json.loads(file.read_text(encoding="utf-8"), parse_constant=_refuse)
        checksum = _checksum(manifest) if isinstance(manifest, dict) else ""
    except OSError as error:
        raise CheckpointError(f"no checkpoint here: {error.strerror}", file=file) from error
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"not JSON: {error}", file=file) from error
    version = manifest.get("format") if isinstance(manifest, dict) else None
    if type(version) is not int or version != FORMAT:
        raise CheckpointError(f"format {version!r}, this version reads {FORMAT}", file=file, field="format")
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
    for part, entry in parts.items():
        if not _is_entry(part, entry):
            raise CheckpointError("no part of a checkpoint", file=file, field=f"parts.{part[:80]}")
    # Earlier versions wrote none. Its own name may be what was changed, hence no others are known.
    strange = set(manifest) - {"format", "step", "torch", "parts", _CHECKSUM}
    if strange or manifest.get(_CHECKSUM, checksum) != checksum:
        raise CheckpointError(
            "damaged: its checksum differs from the recorded one", file=file, field=_CHECKSUM
        )
    return manifest


def _checksum(manifest: Mapping[str, Any]) -> str:
    """Of all other values that a manifest holds."""
    held = {name: value for name, value in manifest.items() if name != _CHECKSUM}
    return hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()


def _refuse(text: str) -> None:
    raise ValueError(f"{text} is no JSON")


def _is_entry(part: str, entry: Any) -> bool:
    """Whether this is how :func:`save_checkpoint` describes a part."""
    kind, _, name = part.partition(".")
    known = part in ("rng", "extra") or (kind in ("module", "optimizer") and _PART.fullmatch(name))
    if not known or not isinstance(entry, dict) or "state" not in entry:
        return False
    if "file" not in entry:
        return set(entry) == {"state"}
    checksum = entry.get("sha256")
    return entry["file"] == f"{part}.safetensors" and isinstance(checksum, str) and len(checksum) == 64


def _read_part(path: Path, manifest: dict[str, Any], part: str) -> Any:
    entry = manifest["parts"][part]
    file = path / f"{part}.safetensors"
    tensors: dict[str, Tensor] = {}
    try:
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


def _match_names(file: Path, asked: set[str], held: set[str], partial: bool, *, what: str) -> None:
    absent, surplus = sorted(asked - held), sorted(held - asked)
    if absent:
        raise CheckpointError(
            f"not in the checkpoint, which has {sorted(held)}", file=file, field=f"{what} {absent[0]}"
        )
    if surplus and not partial:
        raise CheckpointError("in the checkpoint but not asked for", file=file, field=f"{what} {surplus[0]}")


def _rng_state(generators: Mapping[str, torch.Generator]) -> dict[str, Any]:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - whoever uses the global state must get it back
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
        "generators": {name: generator.get_state() for name, generator in generators.items()},
    }


def _set_rng_state(state: dict[str, Any]) -> None:
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    if state["cuda"]:
        torch.cuda.set_rng_state_all(state["cuda"])
