"""Models of an agent's motion, discrete bicycle and continuous displacement, and policies that need no learning.

State: x, y, heading, speed of the box centre (metres, radians, m/s). Everything is differentiable and out of
place. Shapes: ``...`` any batch, T steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from symphony import keys
from symphony.errors import ConfigError
from symphony.geometry.frames import constant, rotate, wrap

WHEELBASE = 0.6  # wheelbase as a fraction of the box length; the axles lie symmetrically about the centre
STEEPEST = 0.3  # largest ratio of sideways to distance that a displacement is made up with
BOUNDS = (-10.0, -15.0), (50.0, 15.0)
"""m/s forward and to the left between which the action spec has displacements; a step takes any."""

States = Float[Tensor, "*#b 4"]
Sizes = Float[Tensor, "*b 2"]
Reals = Float[Tensor, "*#b"]


def bicycle_step(state: States, acceleration: Reals, steering: Reals, length: Reals, dt: float) -> States:
    """Advance the kinematic bicycle about the box centre by one step.

    With slip angle tan(beta) = tan(steering) / 2 (axles at equal distance from the centre), mean speed u of the
    step and wheelbase W: dheading = 2 u dt sin(beta) / W, and the centre moves u dt along heading +
    dheading / 2 + beta. Speed never becomes negative. Acceleration in m/s^2, steering in radians of the front wheel,
    positive to the left, length of the box in metres.
    """
    x, y, heading, speed = state.unbind(-1)
    after = (speed + acceleration * dt).clamp_min(0.0)
    travel = 0.5 * (speed + after) * dt
    slip = torch.atan(0.5 * torch.tan(steering))
    turn = 2.0 * travel * torch.sin(slip) / (WHEELBASE * length)
    course = heading + 0.5 * turn + slip
    x, y = x + travel * torch.cos(course), y + travel * torch.sin(course)
    return torch.stack([x, y, heading + turn, after], dim=-1)


def bicycle_inverse(state: States, after: States, length: Reals, dt: float) -> tuple[Reals, Reals]:
    """Return acceleration and steering that take the speed and heading of ``state`` to those of ``after``.

    Exact where :func:`bicycle_step` produced ``after`` and the agent moved; steering is 0 at standstill and
    saturates at a turn no bicycle can make.
    """
    acceleration = (after[..., 3] - state[..., 3]) / dt
    travel = 0.5 * (state[..., 3] + after[..., 3]) * dt
    moving = travel > 1e-6
    turn = wrap(after[..., 2] - state[..., 2])
    sine = turn * WHEELBASE * length / (2.0 * torch.where(moving, travel, 1.0))
    slip = torch.asin(sine.clamp(-0.999, 0.999))
    return acceleration, torch.where(moving, torch.atan(2.0 * torch.tan(slip)), 0.0)


def displacement_step(state: States, displacement: Float[Tensor, "*#b 2"], length: Reals, dt: float) -> States:
    """Move the box centre by ``displacement`` (x forward, y left, metres, in the agent's own frame).

    The rear axle, half a wheelbase r behind the centre, is dragged along (a tractrix, dheading = sin(phi) / r
    per metre at an angle phi between motion and heading), here by the implicit midpoint rule: a turn of
    atan(y / (r + x / 2)). So heading errors die out instead of swinging, and a step too small to have a direction
    hardly turns the agent. Reversing, at a negative speed, turns it as the step sideways alone would.
    """
    forward, left = displacement.unbind(-1)
    distance = (forward.square() + left.square() + 1e-12).sqrt()
    speed = torch.where(forward < 0, -distance, distance) / dt
    arm = 0.5 * WHEELBASE * length
    # Not atan2, whose last bit on the CPU depends on an element's place in the batch.
    turn = torch.atan(left / (arm + 0.5 * forward.clamp_min(0.0)))
    moved = state[..., :2] + rotate(displacement, state[..., 2])
    return torch.cat([moved, (state[..., 2] + turn)[..., None], speed[..., None]], dim=-1)


def displacement_inverse(state: States, after: States) -> Float[Tensor, "*b 2"]:
    """Return the displacement in the frame of ``state`` that leads to the position of ``after`` (exact)."""
    return rotate(after[..., :2] - state[..., :2], -state[..., 2])


def _quadratic(largest: float, count: int) -> list[float]:
    """Return an odd number of values up to ``largest`` either way, dense about the middle one, which is exactly 0."""
    half = count // 2
    unit = (np.arange(count) - half).astype(np.float32) / np.float32(half)
    return (np.float32(largest) * (unit * np.abs(unit))).tolist()


@dataclass(frozen=True)
class Bicycle:
    """Kinematic bicycle with a grid of discrete actions (paper, section III-C: 7 accelerations x 21 steering angles).

    The joint index of an action is ``acceleration_index * num_steering + steering_index``. Both grids are spaced
    quadratically, dense near coasting straight ahead: on real logs the greedy fit swings least, at equal error.

    Raises a :class:`ConfigError` for a grid of another size.
    """

    max_acceleration: float = 4.0  # m/s^2, the grid is symmetric
    num_acceleration: int = 7  # size of the acceleration grid (odd, so that 0 is in it, and at least 3)
    max_steering: float = 0.5  # radians
    num_steering: int = 21  # size of the steering grid (odd and at least 3, too)
    heading_weight: float = 1.0  # metres that one radian of heading error counts for in the greedy fit
    speed_weight: float = 0.3  # metres that one m/s of speed error counts for in the greedy fit
    #: metres that an acceleration of 1 m/s^2 counts for in the greedy fit, and a tenth of a radian of
    #: steering; small, it decides where actions hardly differ, as at standstill, for the gentlest
    effort: float = 0.002
    discrete: Literal[True] = True
    numbers: Literal[0] = 0
    _joint: tuple[tuple[float, ...], tuple[float, ...]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("num_acceleration", "num_steering"):
            if getattr(self, name) < 3 or getattr(self, name) % 2 == 0:
                raise ConfigError(f"{name} must be odd and at least 3, is {getattr(self, name)}")
        steering = _quadratic(self.max_steering, self.num_steering)
        pairs = [(a, s) for a in _quadratic(self.max_acceleration, self.num_acceleration) for s in steering]
        object.__setattr__(self, "_joint", tuple(zip(*pairs, strict=True)))

    @property
    def num_actions(self) -> int:
        """Return number of joint actions."""
        return self.num_acceleration * self.num_steering

    def grid(self, like: Float[Tensor, "*_"]) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
        """Return acceleration and steering of every joint action, like ``like``; they are shared, so unchanged."""
        acceleration, steering = self._joint
        return constant(acceleration, like.dtype, like.device), constant(steering, like.dtype, like.device)

    def step(
        self, state: Float[Tensor, "*b 4"], action: Int[Tensor, "*b"], size: Sizes, dt: float
    ) -> Float[Tensor, "*b 4"]:
        """Apply joint action indices; an invalid index is an IndexError."""
        # Not by brackets, for which -1 is the last one.
        acceleration, steering = (
            values.index_select(0, action.flatten()).reshape(action.shape) for values in self.grid(state)
        )
        return bicycle_step(state, acceleration, steering, size[..., 0], dt)

    @torch.no_grad()
    def fit(
        self, log: Float[Tensor, "*b T 4"], valid: Bool[Tensor, "*b T"], size: Sizes, dt: float
    ) -> tuple[Int[Tensor, "*b Tm1"], Float[Tensor, "*b T 4"]]:
        """Fit logged states greedily: at each step take the action whose next state is nearest the logged one.

        Continues from the *fitted* state, so errors do not accumulate unseen. Where the next logged step is not valid
        the agent keeps its speed and course, and where it reappears the fit starts again from the log. Returns joint
        action indices [*b, T - 1] and fitted states [*b, T, 4]; T is at least 2.
        """
        acceleration, steering = self.grid(log)
        effort = self.effort**2 * (acceleration.square() + (10.0 * steering).square())

        def nearest(state: Tensor, target: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
            every = state[..., None, :].expand(*state.shape[:-1], self.num_actions, 4)
            after = bicycle_step(every, acceleration, steering, size[..., :1], dt)
            target = target[..., None, :]
            error = (
                (after[..., :2] - target[..., :2]).square().sum(-1)
                + (self.heading_weight * wrap(after[..., 2] - target[..., 2])).square()
                + (self.speed_weight * (after[..., 3] - target[..., 3])).square()
                + effort
            )
            action = error.argmin(-1).masked_fill(~known, self.num_actions // 2)
            index = action[..., None, None].expand(*action.shape, 1, 4)
            return action, after.gather(-2, index).squeeze(-2)

        return _follow(torch.cat([log[..., :3], log[..., 3:].clamp_min(0.0)], -1), valid, nearest)

    def towards(self, state: States, after: States, size: Sizes, dt: float) -> Int[Tensor, "*b"]:
        """Return the action whose next state is nearest to ``after``, a step of :func:`bicycle_step` away."""
        pair = torch.stack([state, after], -2)
        return self.fit(pair, torch.ones_like(pair[..., 0], dtype=torch.bool), size, dt)[0].squeeze(-1)


@dataclass(frozen=True)
class Displacement:
    """Continuous displacement in the agent's own frame (the action space the paper uses for MGAIL)."""

    discrete: Literal[False] = False
    numbers: Literal[2] = 2

    def step(
        self, state: Float[Tensor, "*b 4"], action: Float[Tensor, "*b 2"], size: Sizes, dt: float
    ) -> Float[Tensor, "*b 4"]:
        """Apply displacements in metres."""
        return displacement_step(state, action.to(state.dtype), size[..., 0], dt)

    @torch.no_grad()
    def fit(
        self, log: Float[Tensor, "*b T 4"], valid: Bool[Tensor, "*b T"], size: Sizes, dt: float
    ) -> tuple[Float[Tensor, "*b Tm1 2"], Float[Tensor, "*b T 4"]]:
        """Return displacements reaching each valid logged position exactly, headings along them; T is at least 2."""

        def exact(state: Tensor, target: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
            coast = torch.stack([state[..., 3] * dt, torch.zeros_like(state[..., 3])], -1)
            action = torch.where(known[..., None], displacement_inverse(state, target), coast)
            return action, displacement_step(state, action, size[..., 0], dt)

        return _follow(log, valid, exact)

    def towards(self, state: States, after: States, size: Sizes, dt: float) -> Float[Tensor, "*b 2"]:
        """Return the action that leads to heading and speed of ``after``, a step of :func:`bicycle_step` away.

        Not to its position, which is that of the mean speed: here the whole step has the speed after it. Exact unless
        the turn is too sharp for the distance: then the steepest step to that side, :data:`STEEPEST`.
        """
        distance, arm = after[..., 3].clamp_min(0.0) * dt, 0.5 * WHEELBASE * size[..., 0]
        # :func:`displacement_step` backwards: left = s (arm + forward / 2), both together as long as the distance.
        most = STEEPEST * distance / (arm + 0.5 * distance)
        s = torch.maximum(torch.minimum(torch.tan(wrap(after[..., 2] - state[..., 2])), most), -most)
        square = s.square()
        half, a = 0.5 * square * arm, 1.0 + 0.25 * square
        root = (half.square() - a * (square * arm.square() - distance.square())).clamp_min(0.0).sqrt()
        forward = (root - half) / a
        return torch.stack([forward, s * (arm + 0.5 * forward)], -1)


def _follow(
    log: Float[Tensor, "*b T 4"],
    valid: Bool[Tensor, "*b T"],
    advance: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
) -> tuple[Shaped[Tensor, "*_"], Float[Tensor, "*b T 4"]]:
    """Step through a log: ``advance(state, target, known)`` gives an action and the state it leads to. ``known`` says
    where the target and the logged state before it are valid. After a gap in the log it starts anew.
    """
    time, state = log.ndim - 2, log[..., 0, :]
    states, actions = [state], []
    for t in range(1, log.shape[-2]):
        action, state = advance(state, log[..., t, :], valid[..., t - 1] & valid[..., t])
        restart = valid[..., t] & ~valid[..., t - 1]
        state = torch.where(restart[..., None], log[..., t, :], state)
        states.append(state)
        actions.append(action)
    return torch.stack(actions, time), torch.stack(states, time)


class ConstantVelocity(TensorDictModuleBase):
    """Keeps speed and heading, the least an agent must beat."""

    in_keys = [keys.STATE]  # noqa: RUF012 - the type TensorDictModuleBase declares
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self, dynamics: Bicycle) -> None:
        super().__init__()
        self.dynamics = dynamics

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [..., N]."""
        speed = tensordict.get(keys.STATE)[..., 3]
        action = torch.full_like(speed, self.dynamics.num_actions // 2, dtype=torch.int64)
        return tensordict.set(keys.ACTION, action)


class RandomActions(TensorDictModuleBase):
    """Accelerates and steers at random, every action as likely as any other."""

    in_keys = [keys.NOISE]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self, dynamics: Bicycle) -> None:
        super().__init__()
        self.count = dynamics.num_actions

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [..., N]."""
        action = (tensordict.get(keys.NOISE) * self.count).long()
        return tensordict.set(keys.ACTION, action.clamp(max=self.count - 1))
