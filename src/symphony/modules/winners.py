"""The gradient of a max-pool through its winners: output channel c of an encoder for the element that won it.

Shapes: n sets, H channels and so many winners per set, F features of an element.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear

ROWS = 1024
"""Elements whose gradients are made at a time: what lies between the layers stays in a core's L2 cache."""

Layers = Sequence[tuple[Tensor, Tensor]]
"""Weight [out, in] and bias [out] of the layers, with a ReLU between each two."""


def own_channel(chosen: Float[Tensor, "n H F"], layers: Layers) -> Float[Tensor, "n H"]:
    """Output channel c of element c, differentiable to any order."""
    *before, (weight, bias) = layers
    hidden = chosen
    for inner, shift in before:
        hidden = torch.relu(linear(hidden, inner, shift))
    # Of the last layer one output in H is needed, so only that one is computed.
    return (hidden * weight).sum(-1) + bias


def won(
    pooled: Float[Tensor, "n H"], chosen: Float[Tensor, "n H F"], linears: Sequence[nn.Linear]
) -> Float[Tensor, "n H"]:
    """``pooled``, with the gradient of :func:`own_channel`.

    Args:
        pooled: the maxima, known already.
        chosen: the elements that won them.
        linears: layers of the encoder, each with a bias, with a ReLU between each two.
    """
    parameters = [tensor for layer in linears for tensor in (layer.weight, layer.bias)]
    result: Tensor = _Won.apply(pooled, chosen, *parameters)
    return result


class _Won(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, pooled: Tensor, chosen: Tensor, *parameters: Tensor) -> Tensor:
        ctx.save_for_backward(chosen, *parameters)
        return pooled.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        chosen, *parameters = ctx.saved_tensors
        layers = list(zip(parameters[::2], parameters[1::2], strict=True))
        needed = ctx.needs_input_grad[1:]
        if not torch.is_grad_enabled():
            return None, *_gradients(chosen, layers, grad, needed)
        # A gradient of the gradient will be asked for.
        inputs = [tensor for tensor, need in zip(ctx.saved_tensors, needed, strict=True) if need]
        found = iter(torch.autograd.grad(own_channel(chosen, layers), inputs, grad, create_graph=True))
        return None, *(next(found) if need else None for need in needed)


def _gradients(
    chosen: Float[Tensor, "n H F"], layers: Layers, grad: Float[Tensor, "n H"], needed: Sequence[bool]
) -> list[Tensor | None]:
    """Of the elements, and of each weight and bias, block by block."""
    channels, features = chosen.shape[1:]
    *before, (last, _) = layers
    # [in, out] but for the last layer: a product whose result has few columns takes twice as long.
    weights = [*(weight.new_zeros(weight.shape[::-1]) for weight, _ in before), torch.zeros_like(last)]
    biases = [torch.zeros_like(bias) for _, bias in layers]
    of_chosen = torch.empty_like(chosen) if needed[0] else None
    sets = max(1, ROWS // channels)
    for a in range(0, len(chosen), sets):
        known = [chosen[a : a + sets].reshape(-1, features)]
        for weight, bias in before:
            known.append(torch.addmm(bias, known[-1], weight.t()).relu_())
        part = grad[a : a + sets]
        above = (part[..., None] * last).view(len(known[-1]), -1)
        if before:
            above = torch.ops.aten.threshold_backward(above, known[-1], 0.0)
        weights[-1].add_((known[-1].view(*part.shape, -1) * part[..., None]).sum(0))
        biases[-1].add_(part.sum(0))
        for k in reversed(range(len(before))):
            weights[k].addmm_(known[k].t(), above)
            biases[k].add_(above.sum(0))
            if k:
                above = torch.ops.aten.threshold_backward(above @ before[k][0], known[k], 0.0)
            elif of_chosen is not None:
                above = above @ before[0][0]
        if of_chosen is not None:
            of_chosen[a : a + sets] = above.view(-1, channels, features)
    weights[:-1] = (weight.t().contiguous() for weight in weights[:-1])
    each = [of_chosen, *(tensor for pair in zip(weights, biases, strict=True) for tensor in pair)]
    return [tensor if need else None for tensor, need in zip(each, needed, strict=True)]
