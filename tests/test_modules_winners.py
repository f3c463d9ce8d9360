"""The gradient of a max-pool's winners is that of plain layers, in however many blocks it is made."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import nn

from symphony.modules import winners


def case(sets: int, widths: tuple[int, ...]):
    torch.manual_seed(sets)
    linears = [nn.Linear(into, out, dtype=torch.float64) for into, out in itertools.pairwise(widths)]
    chosen = torch.randn(sets, widths[-1], widths[0], dtype=torch.float64, requires_grad=True)
    return linears, chosen, torch.randn(sets, widths[-1], dtype=torch.float64)


def gradients(value, weights, chosen, linears, keep):
    leaves = [chosen, *(tensor for layer in linears for tensor in layer.parameters())]
    inputs = [leaf for leaf, wanted in zip(leaves, keep, strict=True) if wanted]
    return torch.autograd.grad((value * weights).sum(), inputs)


@pytest.mark.parametrize("widths", [(5, 4), (5, 7, 4), (3, 8, 6, 4)])
@pytest.mark.parametrize("rows", [4, 12, winners.ROWS])
@pytest.mark.parametrize("frozen", [None, 0, 1, 2])
def test_blocks_give_the_gradient_of_the_layers(monkeypatch, widths, rows, frozen):
    """`rows` of 4 and 12 make blocks of one and of three sets, the last of them not full."""
    monkeypatch.setattr(winners, "ROWS", rows)
    linears, chosen, weights = case(10, widths)
    leaves = [chosen, *(tensor for layer in linears for tensor in layer.parameters())]
    if frozen is not None:
        leaves[frozen].requires_grad_(False)
    keep = [leaf.requires_grad for leaf in leaves]
    plain = winners.own_channel(chosen, [(layer.weight, layer.bias) for layer in linears])
    found = gradients(winners.won(plain.detach(), chosen, linears), weights, chosen, linears, keep)
    wanted = gradients(plain, weights, chosen, linears, keep)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)
