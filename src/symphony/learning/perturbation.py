"""Displaced logged states, with the action that leads smoothly back: what a log alone never shows.

A policy that has only seen the log does not know what to do beside it (the cause of behavioural cloning's drift). The
labels are those of a critically damped return to the logged motion, along and across it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from symphony.envs.dynamics import Bicycle, Displacement, bicycle_inverse, bicycle_step
from symphony.geometry.frames import rotate, wrap

ALONG, ACROSS = 1.5, 1.0
"""Time constants of the return along and across the road, in seconds; after 2.3 of them a third is left."""
AHEAD, ASIDE, TURNED, FASTER = 1.5, 0.5, 0.1, 1.5
"""Standard deviations of displacements along the road and aside (metres), in heading (radians) and in speed (m/s)."""
SLOWEST = 2.0
"""m/s below which steering is not made harder, however slow the vehicle."""
STEERING, BRAKING, TIGHTEST = 0.5, 4.0, 0.2
"""Largest steering angle in radians, acceleration in m/s^2 and curvature of the log in 1/m of the way back."""


def displaced(logged: Float[Tensor, "M 4"], rng: torch.Generator) -> Float[Tensor, "M 4"]:
    """Return states x, y, heading, speed near logged ones.

    Errors are normal, times a number drawn uniformly from 0 to 1 for each state. Slow vehicles are moved less across,
    turned less and sped up less, fast ones are turned less, so that no vehicle starts off sideways. A standing one
    keeps its speed: else most slow states would be of those that wait, and a policy would brake when it starts.
    """
    normal = torch.randn(len(logged), 4, generator=rng)
    share = torch.rand(len(logged), generator=rng)
    speed = logged[:, 3].abs()
    slow = (speed / 4.0).clamp_max(1.0)
    shift = torch.stack([normal[:, 0] * AHEAD, normal[:, 1] * ASIDE * slow], -1)
    turn = normal[:, 2] * TURNED * slow * (8.0 / speed.clamp_min(8.0))
    faster = normal[:, 3] * FASTER * slow
    return torch.cat(
        [
            logged[:, :2] + rotate(share[:, None] * shift, logged[:, 2]),
            (logged[:, 2] + share * turn)[:, None],
            (logged[:, 3] + share * faster).clamp_min(0.0)[:, None],
        ],
        -1,
    )


def way_back(
    state: Float[Tensor, "M 4"],
    logged: Float[Tensor, "M 4"],
    following: Float[Tensor, "M 4"],
    length: Float[Tensor, " M"],
    dt: float,
) -> Float[Tensor, "M 4"]:
    """Return the state a step later on a smooth return to the log.

    Where ``state`` is the logged one, it keeps the log's acceleration and curvature.

    Args:
        state: x, y, heading, speed of the vehicle.
        logged: the same of the log at that time.
        following: the same of the log a step later.
        length: length of the boxes, metres.
        dt: seconds per step.
    """
    error = rotate(state[:, :2] - logged[:, :2], -logged[:, 2])
    turned, faster = wrap(state[:, 2] - logged[:, 2]), state[:, 3] - logged[:, 3]
    acceleration = (following[:, 3] - logged[:, 3]) / dt - 2.0 / ALONG * faster - error[:, 0] / ALONG**2
    acceleration = acceleration.clamp(-BRAKING, BRAKING)
    travelled = (0.5 * (logged[:, 3] + following[:, 3]) * dt).clamp_min(0.5 * dt)
    curvature = wrap(following[:, 2] - logged[:, 2]) / travelled
    after = (state[:, 3] + acceleration * dt).clamp_min(0.0)
    pace = 0.5 * (state[:, 3] + after)
    # In a bend the log's own way turns between the two; the headings of slow vehicles are too noisy to tell.
    bend = curvature.clamp(-TIGHTEST, TIGHTEST) * error[:, 0] * (pace / 4.0).clamp_max(1.0)
    turned, aside = turned - bend, error[:, 1] - 0.5 * bend * error[:, 0]
    turn = curvature * pace - 2.0 / ACROSS * turned - aside / (ACROSS**2 * pace.clamp_min(SLOWEST))
    target = torch.stack([state[:, 0], state[:, 1], state[:, 2] + turn * dt, after], -1)
    acceleration, steering = bicycle_inverse(state, target, length, dt)
    return bicycle_step(state, acceleration, steering.clamp(-STEERING, STEERING), length, dt)


def perturbed(
    state: Float[Tensor, "M 4"],
    action: Tensor,
    logged: Float[Tensor, "M 4"],
    following: Float[Tensor, "M 4"],
    size: Float[Tensor, "M 2"],
    dynamics: Bicycle | Displacement,
    dt: float,
    share: float,
    rng: torch.Generator,
) -> tuple[Float[Tensor, "M 4"], Tensor]:
    """Return expert states and actions, a share of them displaced and labelled with actions nearest to a way back.

    Args:
        state: x, y, heading, speed of the fitted experts.
        action: their actions [M] or [M, 2].
        logged: the same of the log at that time.
        following: the same of the log a step later.
        size: size of the boxes, metres.
        dynamics: the action space.
        dt: seconds per step.
        share: share of the states that are displaced.
        rng: generator of all draws.
    """
    chosen = (torch.rand(len(state), generator=rng) < share).nonzero()[:, 0]
    moved, before, size = displaced(logged, rng)[chosen], logged[chosen], size[chosen]
    target = way_back(moved, before, following[chosen], size[:, 0], dt)
    label = dynamics.towards(moved, target, size, dt).to(action.dtype)
    return state.index_copy(0, chosen, moved), action.index_copy(0, chosen, label)
