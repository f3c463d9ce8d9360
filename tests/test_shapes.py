"""Signatures tell the truth about tensors: shapes and kinds of numbers are checked where everything runs once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from jaxtyping import Bool, Float, Int, jaxtyped
from torch import Tensor

from helpers_shapes import tensors_only

TESTS = Path(__file__).parent


def test_steps_and_losses_take_and_return_what_their_signatures_say() -> None:
    # In a process of its own, as the package must be instrumented when it is first imported; on a device without
    # numbers, where nothing is computed.
    hook = "--jaxtyping-packages=symphony,helpers_shapes.tensors_only"
    given = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", hook]
    given += ["test_fake_device_learning.py", "-k", "losses"]
    done = subprocess.run(given, cwd=TESTS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:]


@jaxtyped(typechecker=tensors_only)
def counted(
    scores: Float[Tensor, "*b N"], valid: Bool[Tensor, "*b N"] | None, *more: Float[Tensor, "*b"]
) -> tuple[Int[Tensor, "*b"], dict[str, Float[Tensor, "*b"]]]:
    """Whatever the last argument is, comes back."""
    number = torch.zeros(scores.shape[:-1], dtype=torch.int64)
    return number, {"more": more[-1] if more else scores.mean(-1)}


def test_the_check_finds_what_is_wrong() -> None:
    scores, flags = torch.zeros(2, 3), torch.ones(2, 3, dtype=torch.bool)
    counted(scores, flags, scores[:, 0])
    counted(scores, None)
    for arguments in (
        [scores.long(), None],
        [scores, flags[:, :2]],
        [scores, flags.float()],
        [scores, None, scores],
    ):
        with pytest.raises(TypeError):
            counted(*arguments)
