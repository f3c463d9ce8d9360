"""Comparison of steps of the environment."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

IN_ANY_ORDER = ("objects", "objects_mask", "points", "points_mask", "gap", "gap_ahead")
"""Entries of elements that are seen, in the scene's order on the CPU and in any order elsewhere or compiled."""


def assert_same_step(found: TensorDictBase, expected: TensorDictBase, *, atol: float) -> None:
    """What came of one step is what came of the other, whatever the order of elements that are seen."""
    assert set(found.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        one, other = found[key], expected[key]
        if key[-1] in IN_ANY_ORDER:
            one, other = one.double().sum(2), other.double().sum(2)
        torch.testing.assert_close(one, other, atol=atol, rtol=0)
