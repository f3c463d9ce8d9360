"""Policies over displacements: a Gaussian squeezed into what a vehicle can do within one step."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Distribution, Normal, constraints

from symphony.keys import ACTION, NOISE, OWN, STATE, VALID
from symphony.modules.encoder import ElementGroup, EncoderClass, SceneEncoder, SceneNetwork, scene_module
from symphony.modules.policy import NoiseSampler
from symphony.modules.pooling import PoolMode

SMOOTH = 0.02
"""Metres within which a displacement bends smoothly towards zero instead of turning negative."""
INSIDE = 0.95
"""Share of the bounds beyond which an action counts as lying there, so that its likelihood stays finite."""


def squash(x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """`x / sqrt(1 + x^2)`, in (-1, 1). Made of exactly rounded operations, unlike tanh, whose last bit on the CPU
    depends on an element's place in the batch.
    """
    return x * (1.0 + x.square()).rsqrt() if x.device.type != "cpu" else x / (1.0 + x.square()).sqrt()


def unsquash(y: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Inverse of :func:`squash`."""
    return y / (1.0 - y.square()).sqrt()


def positive(x: Float[Tensor, "*b"], smooth: float = SMOOTH) -> Float[Tensor, "*b"]:
    """A smooth `max(x, 0)`: `(x + sqrt(x^2 + smooth^2)) / 2`, above it by at most `smooth / 2`."""
    return 0.5 * (x + (x.square() + smooth**2).sqrt())


def positive_inverse(y: Float[Tensor, "*b"], smooth: float = SMOOTH) -> Float[Tensor, "*b"]:
    """Inverse of :func:`positive`, for `y > 0`."""
    return y - smooth**2 / (4.0 * y)


class BoundedDisplacement(Distribution):
    """Displacements [..., 2] (metres; forward, left) reachable within a step.

    From Gaussian numbers u: forward = positive(pace + reach squash(u1)), so the speed changes by at most
    reach / dt and never becomes negative; left = forward * slope * squash(u2), so nothing slides sideways or
    turns at standstill. Both are differentiable in u, in the parameters and in the bounds.

    Args:
        loc: [..., 2] mean of u.
        scale: [..., 2] standard deviation of u.
        pace: [...] metres covered at unchanged speed.
        slope: [...] largest ratio of left to forward.
        reach: metres that the largest acceleration adds.
    """

    arg_constraints = {}  # noqa: RUF012 - the type torch declares
    support = constraints.real_vector
    has_rsample = True

    def __init__(
        self,
        loc: Float[Tensor, "*b 2"],
        scale: Float[Tensor, "*b 2"],
        pace: Float[Tensor, "*b"],
        slope: Float[Tensor, "*b"],
        reach: float,
        validate_args: bool | None = None,
    ) -> None:
        self.loc, self.scale, self.pace, self.slope, self.reach = loc, scale, pace, slope, reach
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=validate_args)

    def expand(
        self, batch_shape: torch.Size | Sequence[int], _instance: Distribution | None = None
    ) -> BoundedDisplacement:
        """The same distribution for a larger batch."""
        shape = torch.Size(batch_shape)
        return BoundedDisplacement(
            self.loc.expand(*shape, 2),
            self.scale.expand(*shape, 2),
            self.pace.expand(shape),
            self.slope.expand(shape),
            self.reach,
            validate_args=False,
        )

    def displacement(self, u: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """The displacement that Gaussian numbers [..., 2] stand for."""
        forward = positive(self.pace + self.reach * squash(u[..., 0]))
        return torch.stack([forward, forward * self.slope * squash(u[..., 1])], -1)

    def latent(self, displacement: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """Inverse of :meth:`displacement`; what lies outside the bounds or next to them is moved to INSIDE them."""
        forward = displacement[..., 0].clamp_min(1e-4)
        first = (positive_inverse(forward) - self.pace) / self.reach
        second = displacement[..., 1] / (forward * self.slope)
        return unsquash(torch.stack([first, second], -1).clamp(-INSIDE, INSIDE))

    def rsample(
        self,
        sample_shape: torch.Size | Sequence[int] = torch.Size(),  # noqa: B008
    ) -> Float[Tensor, "*b 2"]:
        """Draw, with gradient to the parameters."""
        shape = self._extended_shape(torch.Size(sample_shape))
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return self.displacement(self.loc + self.scale * noise)

    def icdf(self, value: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        """The draw that independent uniform numbers [..., 2] in (0, 1) stand for, with gradient to the parameters."""
        return self.displacement(self.loc + self.scale * torch.special.ndtri(value))

    @property
    def mode(self) -> Float[Tensor, "*b 2"]:
        """The displacement of the mean of u (the median of either component)."""
        return self.displacement(self.loc)

    @property
    def deterministic_sample(self) -> Float[Tensor, "*b 2"]:
        """What TorchRL takes when it does not explore."""
        return self.mode

    def log_prob(self, value: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b"]:
        """Log-density [...]; that of the nearest displacement INSIDE the bounds where `value` is not."""
        u = self.latent(value)
        x = self.pace + self.reach * squash(u[..., 0])
        bend = 0.5 * (1.0 + x / (x.square() + SMOOTH**2).sqrt())
        width = self.reach * bend * positive(x) * self.slope
        # Both squashings have the derivative (1 + u^2)^(-3/2).
        volume = width.log() - 1.5 * (1.0 + u.square()).log().sum(-1)
        return Normal(self.loc, self.scale, validate_args=False).log_prob(u).sum(-1) - volume


class _Parameters(nn.Module):
    """From the head's numbers [..., N, 4], states [..., N, 4], own features and mask to the parameters.

    Padded agents, whose states may be anything, count as standing.
    """

    def __init__(
        self, dt: float, size_scale: float, min_scale: float, slope: float, lateral: float, axle: float
    ) -> None:
        super().__init__()
        self.dt, self.size_scale, self.min_scale = dt, size_scale, min_scale
        self.slope, self.lateral, self.axle = slope, lateral, axle

    def forward(
        self,
        head: Float[Tensor, "*b N 4"],
        state: Float[Tensor, "*b N 4"],
        own: Float[Tensor, "*b N F"],
        valid: Bool[Tensor, "*b N"],
    ) -> tuple[
        Float[Tensor, "*b N 2"], Float[Tensor, "*b N 2"], Float[Tensor, "*b N"], Float[Tensor, "*b N"]
    ]:
        scale = self.min_scale + positive(head[..., 2:], 1.0)
        speed = torch.where(valid, state[..., 3], 0.0).clamp_min(0.0)
        # On a curve of curvature k the centre moves at an angle whose sine is k times its distance to the rear
        # axle; k v^2 is the lateral acceleration.
        arm = self.axle * self.size_scale * torch.where(valid, own[..., 1], 0.0)
        fast = speed.square() * self.slope / (self.lateral * arm.clamp_min(0.1))
        return head[..., :2], scale, speed * self.dt, self.slope / (1.0 + fast.square()).sqrt()


def displacement_policy(
    own_features: int,
    groups: Sequence[ElementGroup],
    *,
    hidden: int = 64,
    head: Sequence[int] = (128, 128),
    dt: float,
    size_scale: float = 5.0,
    max_acceleration: float = 4.0,
    max_lateral: float = 6.0,
    max_slope: float = 0.3,
    min_scale: float = 0.05,
    axle: float = 0.3,
    own_keys: Sequence[NestedKey] = (OWN,),
    road_keys: Sequence[NestedKey] = (),
    valid_key: NestedKey = VALID,
    state_key: NestedKey = STATE,
    action_key: NestedKey = ACTION,
    noise_key: NestedKey = NOISE,
    pool: PoolMode = "auto",
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """Encoder, head and a :class:`BoundedDisplacement` (the action space the paper gives to MGAIL, section V-A).

    Weights follow `torch.manual_seed`. Writes actions `[..., N, 2]` in metres, sampled with gradient
    (reparameterised) according to TorchRL's exploration type; a pair of uniform numbers under `noise_key` decides
    them where there is one (see :class:`NoiseSampler`).

    Args:
        own_features: features under all `own_keys` together; the second of the first key is the box length.
        groups: types of elements.
        hidden: width of the encoders.
        head: widths of the head's hidden layers.
        dt: seconds per step.
        size_scale: metres of box length that the own feature counts as 1.
        max_acceleration: m/s^2, forward and backward.
        max_lateral: m/s^2; bounds the ratio of left to forward at speed.
        max_slope: largest ratio of left to forward at low speed.
        min_scale: smallest standard deviation of the Gaussian numbers.
        axle: distance from box centre to rear axle, as a share of the length.
        own_keys: features of the agent itself, concatenated.
        road_keys: see :func:`symphony.modules.scene_module`; counted by ``own_features``, too.
        valid_key: mask of the agents.
        state_key: `[..., N, 4]`, of which the speed is read.
        action_key: written.
        noise_key: `[..., N, 2]`, optional in the TensorDict.
        pool: see :func:`symphony.modules.pool_elements`.
        encoder: a class with the arguments of :class:`SceneEncoder`.
    """
    for name, value in (
        ("dt", dt),
        ("max_acceleration", max_acceleration),
        ("max_lateral", max_lateral),
        ("max_slope", max_slope),
        ("min_scale", min_scale),
    ):
        if not value > 0.0:
            raise ValueError(f"{name} must be positive, is {value}")
    encoding = encoder(own_features, [group.features for group in groups], hidden=hidden, pool=pool)
    network = SceneNetwork(encoding, 4, head=head)
    parameters: list[NestedKey] = [("agents", name) for name in ("loc", "scale", "pace", "slope")]
    return ProbabilisticTensorDictSequential(
        scene_module(
            network, groups, ("agents", "head"), own_keys=own_keys, road_keys=road_keys, valid_key=valid_key
        ),
        TensorDictModule(
            _Parameters(dt, size_scale, min_scale, max_slope, max_lateral, axle),
            in_keys=[("agents", "head"), state_key, own_keys[0], valid_key],
            out_keys=parameters,
        ),
        NoiseSampler(
            dict(zip(("loc", "scale", "pace", "slope"), parameters, strict=True)),
            action_key,
            noise_key=noise_key,
            distribution_class=BoundedDisplacement,
            distribution_kwargs={"reach": max_acceleration * dt**2},
        ),
    )
