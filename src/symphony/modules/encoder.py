"""Encoding of an observation as one vector: the agent's own features and pooled sets of elements around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from symphony.geometry.nearest import on_host
from symphony.keys import OWN, VALID
from symphony.modules.pooling import pool_elements

FORESIGHT = (0.5, 1.0, 2.0)
"""Seconds ahead at which gaps and distances to the edge of the road are observed, too."""


@dataclass(frozen=True)
class ElementGroup:
    """A type of element that an agent observes (objects, road points, a route): an encoder and a pool of its own."""

    key: NestedKey  # float `[..., N, K, features]`; K may differ from call to call
    mask_key: NestedKey  # bool `[..., N, K]`, True where an element is valid
    features: int  # features of one element, those under further keys included
    more_keys: tuple[NestedKey, ...] = ()  # further features `[..., N, K, F]` of the same elements
    #: signed gaps `[..., N, K]` or `[..., N, K, H]` to them in metres, of which :func:`gap_features` makes
    #: three features each
    gap_keys: tuple[NestedKey, ...] = ()


def mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Return linear layers of the given widths (input first) with ReLU between them and none after the last."""
    if len(sizes) < 2:
        raise ValueError(f"a network needs an input and an output width, got {tuple(sizes)}")
    layers: list[nn.Module] = []
    for width_in, width_out in pairwise(sizes):
        # In place: nothing reads what comes out of a linear layer, and fresh memory costs more than the maximum.
        layers += [nn.Linear(width_in, width_out), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def gap_features(gap: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
    """Return signed gaps in metres as numbers of order one: fine near contact, coarse farther away."""
    return torch.stack([(gap / 0.5).tanh(), (gap / 3.0).tanh(), (gap / 10.0).tanh()], -1)


EncoderClass = Callable[..., Any]
"""Called with the arguments of :class:`SceneEncoder`; returns a module that is called like it, with a `width`."""


class SceneEncoder(nn.Module):
    """Encode each element by an MLP, max-pool per group, concatenate with the encoded own features (paper, III-C).

    Masked elements, padded agents (`valid` False: all their inputs count as absent) and the other agents of
    the batch have no influence on an agent's vector. Features should come scaled to order one.
    Takes how many features the agent itself has, and one element of each group; ``hidden`` is the width of every
    encoder, ``width`` the size D of the vector, `hidden * (1 + number of groups)`.
    """

    def __init__(self, own_features: int, group_features: Sequence[int], *, hidden: int = 64) -> None:
        super().__init__()
        self.own = mlp((own_features, hidden, hidden))
        self.groups = nn.ModuleList(mlp((features, hidden, hidden)) for features in group_features)
        self.width = hidden * (1 + len(self.groups))

    def forward(
        self, own: Float[Tensor, "*b n own"], valid: Bool[Tensor, "*b n"], *elements_and_masks: Tensor
    ) -> Float[Tensor, "*b n width"]:
        """Encode own features under a mask, then elements `[..., N, K, F]` and mask `[..., N, K]` of each group."""
        if len(elements_and_masks) != 2 * len(self.groups):
            raise ValueError(
                f"expected elements and mask of {len(self.groups)} groups, got {len(elements_and_masks)} tensors"
            )
        everyone = on_host(valid) and bool(valid.all())
        parts = [self.own(own if everyone else torch.where(valid[..., None], own, 0.0))]
        pairs = zip(elements_and_masks[::2], elements_and_masks[1::2], strict=True)
        for encoder, (elements, mask) in zip(self.groups, pairs, strict=True):
            seen = mask if everyone else mask & valid[..., None]
            parts.append(pool_elements(encoder, elements, seen))
        # ReLU is monotone: after the maximum it is the same as before it, and far cheaper.
        return torch.relu(torch.cat(parts, -1))


class SceneNetwork(nn.Module):
    """A :class:`SceneEncoder` and an MLP head on its vector, giving `[..., N, outputs]`. Only networks that are
    passed the same encoder share it; ``head`` is the widths of the head's hidden layers.
    """

    def __init__(self, encoder: SceneEncoder, outputs: int, *, head: Sequence[int] = (128, 128)) -> None:
        super().__init__()
        self.encoder = encoder
        self.head = mlp((encoder.width, *head, outputs))

    def forward(
        self, own: Float[Tensor, "*b n own"], valid: Bool[Tensor, "*b n"], *elements_and_masks: Tensor
    ) -> Float[Tensor, "*b n outputs"]:
        """Compute the outputs; inputs are as for :class:`SceneEncoder`."""
        return self.head(self.encoder(own, valid, *elements_and_masks))


class _Join(nn.Module):
    """Concatenates features that come under several keys: the agents' own, and those of each group's elements."""

    def __init__(self, network: nn.Module, owns: int, groups: Sequence[ElementGroup]) -> None:
        super().__init__()
        self.network, self.owns = network, owns
        self.parts = [(len(group.more_keys), len(group.gap_keys)) for group in groups]

    def forward(self, *inputs: Tensor) -> Tensor:
        waiting = iter(inputs)
        own = [next(waiting) for _ in range(self.owns)]
        joined = [torch.cat(own, -1), next(waiting)]
        for more, gaps in self.parts:
            elements, mask = next(waiting), next(waiting)
            parts = [elements, *(next(waiting) for _ in range(more))]
            # A gap without a dimension of times gives three features, one with H times 3 H.
            parts += [gap_features(next(waiting)).flatten(elements.ndim - 1) for _ in range(gaps)]
            # To concatenate a single part would copy it.
            joined += [torch.cat(parts, -1) if len(parts) > 1 else elements, mask]
        return self.network(*joined, *waiting)


def scene_module(
    network: nn.Module,
    groups: Sequence[ElementGroup],
    out_key: NestedKey,
    *,
    own_keys: Sequence[NestedKey] = (OWN,),
    valid_key: NestedKey = VALID,
    more_keys: Sequence[NestedKey] = (),
) -> TensorDictModule:
    """Wrap a network over scenes so that it reads its inputs, in order, from a TensorDict.

    It is called with the own features (under all ``own_keys``, concatenated), the agents' mask, the elements and mask
    of each group, and what ``more_keys`` hold.
    """
    read = [key for group in groups for key in (group.key, group.mask_key, *group.more_keys, *group.gap_keys)]
    apart = len(own_keys) > 1 or any(group.more_keys or group.gap_keys for group in groups)
    joined = _Join(network, len(own_keys), groups) if apart else network
    return TensorDictModule(joined, in_keys=[*own_keys, valid_key, *read, *more_keys], out_keys=[out_key])
