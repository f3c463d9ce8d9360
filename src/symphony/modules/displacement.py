"""Policies over displacements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn

from symphony.keys import ACTION, NOISE, OWN, STATE, VALID
from symphony.modules.bounded import BoundedDisplacement, DisplacementHistogram, positive
from symphony.modules.encoder import ElementGroup, EncoderClass, SceneEncoder, SceneNetwork, scene_module
from symphony.modules.policy import NoiseSampler

ACCELERATION, LATERAL = 4.0, 6.0
"""Largest accelerations in m/s^2, along and across; the second bounds the ratio of left to forward at speed."""
SLOPE, LEAST_SCALE = 0.3, 0.05
"""Largest ratio of left to forward at low speed, and smallest standard deviation of the Gaussian numbers."""
AXLE = 0.3  # distance from box centre to rear axle, as a share of the length


class _Parameters(nn.Module):
    """From the head's numbers, states [..., N, 4], own features and mask to the parameters.

    The numbers are the logits of cells [..., N, C], or the mean and the raw width of a Gaussian [..., N, 4].
    Padded agents, whose states may be anything, count as standing.
    """

    def __init__(self, cells: int, dt: float, size_scale: float) -> None:
        super().__init__()
        self.cells, self.dt, self.size_scale = cells, dt, size_scale

    def forward(
        self,
        head: Float[Tensor, "*b N H"],
        state: Float[Tensor, "*b N 4"],
        own: Float[Tensor, "*b N F"],
        valid: Bool[Tensor, "*b N"],
    ) -> tuple[Float[Tensor, "*_"], ...]:
        speed = torch.where(valid, state[..., 3], 0.0).clamp_min(0.0)
        # On a curve of curvature k the centre moves at an angle whose sine is k times its distance to the rear
        # axle; k v^2 is the lateral acceleration.
        arm = AXLE * self.size_scale * torch.where(valid, own[..., 1], 0.0)
        fast = speed.square() * SLOPE / (LATERAL * arm.clamp_min(0.1))
        bounds = speed * self.dt, SLOPE / (1.0 + fast.square()).sqrt()
        if self.cells:
            return head, *bounds
        return head[..., :2], LEAST_SCALE + positive(head[..., 2:], 1.0), *bounds


def displacement_policy(
    own_features: int,
    groups: Sequence[ElementGroup],
    *,
    hidden: int = 64,
    head: Sequence[int] = (128, 128),
    cells: int = 0,
    dt: float,
    size_scale: float = 5.0,
    own_keys: Sequence[NestedKey] = (OWN,),
    valid_key: NestedKey = VALID,
    state_key: NestedKey = STATE,
    action_key: NestedKey = ACTION,
    noise_key: NestedKey = NOISE,
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """Encoder, head and a :class:`BoundedDisplacement` (the action space the paper gives to MGAIL, section V-A), or a
    :class:`DisplacementHistogram` in its place.

    Weights follow `torch.manual_seed`. Writes actions `[..., N, 2]` in metres, sampled with gradient
    (reparameterised) according to TorchRL's exploration type; a pair of uniform numbers under `noise_key` decides
    them where there is one (see :class:`NoiseSampler`).

    Args:
        own_features: features under all `own_keys` together; the second of the first key is the box length.
        groups: types of elements.
        hidden: width of the encoders.
        head: widths of the head's hidden layers.
        cells: of the histogram, along and across; 0 for a Gaussian.
        dt: seconds per step.
        size_scale: metres of box length that the own feature counts as 1.
        own_keys: features of the agent itself, concatenated.
        valid_key: mask of the agents.
        state_key: `[..., N, 4]`, of which the speed is read.
        action_key: written.
        noise_key: `[..., N, 2]`, optional in the TensorDict.
        encoder: a class with the arguments of :class:`SceneEncoder`.
    """
    if cells and (cells < 3 or cells % 2 == 0):
        raise ValueError(f"cells must be odd and at least 3, or 0 for none, is {cells}")
    if not dt > 0.0:
        raise ValueError(f"dt must be positive, is {dt}")
    encoding = encoder(own_features, [group.features for group in groups], hidden=hidden)
    network = SceneNetwork(encoding, cells**2 or 4, head=head)
    names = ("logits", "pace", "slope") if cells else ("loc", "scale", "pace", "slope")
    parameters: list[NestedKey] = [("agents", name) for name in names]
    kind: dict[str, Any] = {"forward": cells} if cells else {}
    return ProbabilisticTensorDictSequential(
        scene_module(network, groups, ("agents", "head"), own_keys=own_keys, valid_key=valid_key),
        TensorDictModule(
            _Parameters(cells, dt, size_scale),
            in_keys=[("agents", "head"), state_key, own_keys[0], valid_key],
            out_keys=parameters,
        ),
        NoiseSampler(
            dict(zip(names, parameters, strict=True)),
            action_key,
            noise_key=noise_key,
            distribution_class=DisplacementHistogram if cells else BoundedDisplacement,
            distribution_kwargs={"reach": ACCELERATION * dt**2, **kind},
        ),
    )
