"""The gradient of a max-pool's winners is that of plain layers, in however many blocks it is made."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import nn

from symphony.modules import winners


@pytest.mark.parametrize("widths", [(5, 4), (5, 7, 4), (3, 8, 6, 4)])
@pytest.mark.parametrize("rows", [4, 12, winners.ROWS])
@pytest.mark.parametrize("frozen", [None, 0, 1, 2])
def test_blocks_give_the_gradient_of_the_layers(monkeypatch, widths, rows, frozen):
    """`rows` of 4 and 12 make blocks of one and of three sets, the last of them not full."""
    monkeypatch.setattr(winners, "ROWS", rows)
    torch.manual_seed(0)
    linears = [nn.Linear(into, out, dtype=torch.float64) for into, out in itertools.pairwise(widths)]
    chosen = torch.randn(10, widths[-1], widths[0], dtype=torch.float64, requires_grad=True)
    weights = torch.randn(10, widths[-1], dtype=torch.float64)
    leaves = [chosen, *(tensor for layer in linears for tensor in layer.parameters())]
    if frozen is not None:
        leaves.pop(frozen).requires_grad_(False)
    plain = winners.own_channel(chosen, [(layer.weight, layer.bias) for layer in linears])
    won = winners.won(plain.detach(), chosen, linears)
    found, wanted = (torch.autograd.grad((value * weights).sum(), leaves) for value in (won, plain))
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)
