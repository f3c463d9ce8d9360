"""Whether what a checkpoint holds fits what it is loaded into: names, types, shapes and ranges."""

from __future__ import annotations

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from symphony.errors import DataError

MOST = 1e3
"""Of a rate of learning, or another number that an optimizer is set to."""
_ADAM = {"step", "exp_avg", "exp_avg_sq"}


class CheckpointError(DataError):
    """A checkpoint that can't be written, read, or fitted to what it is loaded into."""


def match_module(file: Path, module: nn.Module, saved: dict[str, Any]) -> None:
    """See that a state has the tensors of a module, and that all are finite.

    Raises:
        CheckpointError: naming the first that differs.
    """
    own = module.state_dict()
    for name in [*own, *saved]:
        if name not in saved or name not in own:
            where = "the module" if name in own else "the checkpoint"
            raise CheckpointError(f"only {where} has it", file=file, field=str(name))
        _match_tensor(file, name, own[name], saved[name])


def _match_tensor(file: Path, name: str, own: Any, saved: Any) -> None:
    if isinstance(own, Tensor) != isinstance(saved, Tensor):
        raise CheckpointError("a tensor on one side only", file=file, field=name)
    if isinstance(own, Tensor) and (own.shape != saved.shape or own.dtype != saved.dtype):
        raise CheckpointError(
            f"saved as {saved.dtype} {tuple(saved.shape)}, expected {own.dtype} {tuple(own.shape)}",
            file=file,
            field=name,
        )
    if isinstance(saved, Tensor):
        _check_finite(file, name, saved)


def _check_finite(file: Path, name: str, saved: Tensor) -> None:
    bad = int((~torch.isfinite(saved)).sum()) if saved.is_floating_point() or saved.is_complex() else 0
    if bad:
        raise CheckpointError(f"{bad} of {saved.numel()} numbers are not finite", file=file, field=name)


def match_optimizer(file: Path, optimizer: torch.optim.Optimizer, saved: dict[str, Any]) -> None:
    """See that a state is one of this kind of optimizer for parameters of these shapes, and finite.

    Raises:
        CheckpointError: naming the first value that is not.
    """
    groups, state = saved.get("param_groups"), saved.get("state")
    if not isinstance(state, dict) or not isinstance(groups, list):
        raise CheckpointError("no state of an optimizer", file=file, field="param_groups")
    for group in groups:
        if not isinstance(group, dict) or not isinstance(group.get("params"), list):
            raise CheckpointError("no group of parameters", file=file, field="param_groups")
    sizes, own_sizes = [len(g["params"]) for g in groups], [len(g["params"]) for g in optimizer.param_groups]
    if sizes != own_sizes:
        raise CheckpointError(
            f"saved for groups of {sizes} parameters, expected {own_sizes}", file=file, field="param_groups"
        )
    indices = [index for group in groups for index in group["params"]]
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    if any(type(index) is not int for index in indices) or indices != list(range(len(parameters))):
        raise CheckpointError("parameters in another order", file=file, field="param_groups")
    if any(type(index) is not int or not 0 <= index < len(parameters) for index in state):
        raise CheckpointError("a state of no parameter", file=file, field="state")
    for group, own in zip(groups, optimizer.param_groups, strict=True):
        _match_group(file, own, group)
    for index, values in state.items():
        _match_state(file, f"state.{index}", optimizer, parameters[index], values)


def _match_group(file: Path, own: dict[str, Any], group: dict[str, Any]) -> None:
    if set(group) - {"initial_lr"} != set(own) - {"initial_lr"}:
        names = sorted(map(str, set(group) ^ set(own)))
        raise CheckpointError(f"another kind of optimizer: {names} differ", file=file, field="param_groups")
    for name, value in group.items():
        if name != "params" and not _is_setting(own.get(name, 0.0), value):
            message = f"{str(value)[:40]!r}, expected something like {own.get(name, 0.0)!r}"
            raise CheckpointError(message, file=file, field=f"param_groups.{name}")


def _is_setting(own: Any, value: Any) -> bool:
    """Whether a value is of the kind of an optimizer's own: the same flag, numbers from 0 to :data:`MOST`."""
    if own is None or isinstance(own, bool):  # another one would need other moments, or climb the loss
        return value is own
    if isinstance(own, tuple | list):
        return (
            isinstance(value, tuple | list)
            and len(value) == len(own)
            and all(map(_is_setting, own, value))
            and all(item < 1 for item in value)  # Adam's decay rates
        )
    if isinstance(own, Tensor):
        return isinstance(value, Tensor) and value.shape == own.shape and bool((value >= 0).all())
    if isinstance(own, int | float):
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number and 0 <= value <= MOST
    return type(value) is type(own)


def _match_state(file: Path, field: str, optimizer: Any, parameter: Tensor, values: Any) -> None:
    adam = isinstance(optimizer, torch.optim.Adam | torch.optim.AdamW)
    if not isinstance(values, dict) or (adam and not set(values) >= _ADAM):
        raise CheckpointError("no state of a parameter", file=file, field=field)
    for name, value in values.items():
        where = f"{field}.{name}"
        if isinstance(value, Tensor):
            if value.ndim and value.shape != parameter.shape:
                message = f"saved with shape {tuple(value.shape)}, expected {tuple(parameter.shape)}"
                raise CheckpointError(message, file=file, field=where)
            _check_finite(file, where, value)
        if name in _ADAM and not (
            isinstance(value, Tensor)
            and value.is_floating_point()
            and (value.ndim == 0 if name == "step" else value.shape == parameter.shape)
            and (name == "exp_avg" or bool((value >= 0).all()))
        ):
            raise CheckpointError("no such moment of gradients", file=file, field=where)


def check_random_states(
    file: Path, state: Mapping[str, Any], generators: Mapping[str, torch.Generator]
) -> None:
    """Try random states on generators of no consequence, so that nothing is changed if one is none.

    Raises:
        CheckpointError: naming the first that is none.
    """
    trials = {
        "python": lambda value: random.Random().setstate(value),  # noqa: S311 - no secret
        "numpy": _try_numpy,
        "torch": lambda value: torch.Generator().set_state(value),
        "cuda": _check_cuda,
        "generators": lambda value: _try_generators(value, generators),
    }
    for name, trial in trials.items():
        try:
            trial(state[name])
        except Exception as error:  # each library has its own
            raise CheckpointError(
                f"no random state: {error!r}"[:200], file=file, field=f"rng.{name}"
            ) from error


def _try_numpy(value: Any) -> None:
    # numpy believes any place in its table, and reads there.
    if type(value["state"]["pos"]) is not int or not 0 <= value["state"]["pos"] <= 624:
        raise ValueError("a place outside the table")
    np.random.RandomState().set_state(value)


def _check_cuda(value: Any) -> None:
    if not isinstance(value, list) or not all(
        isinstance(each, Tensor) and each.dtype == torch.uint8 and each.ndim == 1 for each in value
    ):
        raise TypeError("not bytes")


def _try_generators(value: Any, generators: Mapping[str, torch.Generator]) -> None:
    if not isinstance(value, dict):
        raise TypeError("no table")
    for name, generator in generators.items():
        if name in value:
            torch.Generator(generator.device).set_state(value[name])
