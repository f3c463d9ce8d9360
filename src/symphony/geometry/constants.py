"""Small constant tensors, made once per device: making one from Python numbers at each step waits for the device."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from jaxtyping import Num
from torch import Tensor


def constant(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Num[Tensor, "*_"]:
    """A tensor of these (nested tuples of) numbers; shared, so never written to."""
    if torch.compiler.is_compiling():
        return torch.tensor(values, dtype=dtype, device=device)
    return made(values, dtype, device)


@cache
def made(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Num[Tensor, "*_"]:
    """What :func:`constant` keeps."""
    # Made outside of inference mode, or autograd could not save it.
    with torch.inference_mode(False), torch.no_grad():
        return torch.tensor(values, dtype=dtype).to(device)
