"""The PDM score of NAVSIM, from its published definition; no code of others.

Source: Dauner et al., "NAVSIM: Data-driven non-reactive autonomous vehicle simulation and benchmarking", NeurIPS
2024, section 3.2 and its supplement; limits of comfort as in nuPlan (Karnchanachari et al., ICRA 2024). Four things
differ: progress is relative to the log's, not to that of the planner PDM-Closed; whether the planner is at fault
is decided by the rules of ``docs/metrics.md``; its centre must stay on the road, not its corners; derivatives are
fitted over 1.5 s of whatever step a segment has.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType
from symphony.saved.rollouts import SavedRollouts

Reals = NDArray[np.float64]

LEAST_TTC = 0.95
"""Seconds to a collision that must be left at every step."""
STANDS = 5.0
"""Metres of the log's progress below which a run has no progress to make."""
MOST_ACCELERATION, MOST_BRAKING, MOST_SIDEWAYS = 2.40, 4.05, 4.89
"""m/s² that are comfortable: along the heading, against it, across."""
MOST_JERK, MOST_JERK_ALONG = 8.37, 4.13
"""m/s³ that are comfortable: in all, along the heading."""
MOST_YAW_RATE, MOST_YAW_ACCELERATION = 0.95, 1.93
"""rad/s and rad/s² that are comfortable."""
WINDOW = 1.5
"""Seconds over which derivatives are fitted."""
_OBJECT_HIT = 0.5
"""Share of the score left after a collision at fault with an object that is not a road user."""


class PDM(NamedTuple):
    """Terms of the score, each from 0 to 1: no collision at fault (half for one with an object), the centre within
    the drivable area, enough time to collision at every step, all limits of comfort kept, progress to the log's.
    """

    no_collision: float
    on_road: float
    time_to_collision: float
    comfort: float
    progress: float

    @property
    def score(self) -> float:
        """The score from 0 to 100."""
        weighted = 5 * self.progress + 5 * self.time_to_collision + 2 * self.comfort
        return 100.0 * self.no_collision * self.on_road * weighted / 12


def pdm(run: Mapping[str, Any], saved: SavedRollouts, collisions: list[int]) -> PDM | None:
    """Return the terms of one run of the ego; None if it failed, or the boundary or its progress is not defined.

    Args:
        run: the run's row of :class:`symphony.evaluation.report.Report`.
        saved: the rollouts that it is one of.
        collisions: rows of the agents that it ran into, at fault.
    """
    if run["failed"] or run["offroad_time"] is None:
        return None
    segment, ratio = saved.segment, run["progress_ratio"]
    if ratio is None and (run["beyond_route"] or run["no_route"] or not run["logged_steps"]):
        return None
    # Where the log makes no progress there is none to make.
    stands = ratio is None or run["log_progress"] < STANDS
    users = (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST)
    hits = [1.0 if segment.agent_type[row] in users else _OBJECT_HIT for row in collisions]
    ego = int(np.flatnonzero(saved.agents == segment.ego)[0])
    counted = saved.counted[run["rollout"]][:, ego]
    path = saved.state[run["rollout"]][: int(counted.sum()) + 1, ego].astype(np.float64)
    return PDM(
        no_collision=1.0 - max(hits, default=0.0),
        on_road=float(not run["offroad_time"]),
        time_to_collision=float(run["min_ttc"] is None or run["min_ttc"] >= LEAST_TTC),
        comfort=float(comfortable(path[:, 2], path[:, 3], segment.dt)),
        progress=1.0 if stands else min(max(float(ratio), 0.0), 1.0),
    )


def comfortable(heading: Reals, speed: Reals, dt: float) -> bool:
    """Return whether a drive of headings [U] (radians) and speeds [U] (m/s), dt seconds apart, keeps all limits."""
    if len(speed) < 3:
        return True
    turned = np.unwrap(heading)
    yaw_rate, yaw_acceleration = derivative(turned, dt, 1), derivative(turned, dt, 2)
    along, across = derivative(speed, dt, 1), speed * yaw_rate
    # In the frame of the vehicle, which turns.
    jerk_along = derivative(speed, dt, 2) - across * yaw_rate
    jerk_across = derivative(across, dt, 1) + along * yaw_rate
    limited = (
        (along, MOST_ACCELERATION),
        (-along, MOST_BRAKING),
        (np.abs(across), MOST_SIDEWAYS),
        (np.hypot(jerk_along, jerk_across), MOST_JERK),
        (np.abs(jerk_along), MOST_JERK_ALONG),
        (np.abs(yaw_rate), MOST_YAW_RATE),
        (np.abs(yaw_acceleration), MOST_YAW_ACCELERATION),
    )
    return all(bool(values.max() <= most) for values, most in limited)


def derivative(values: Reals, dt: float, order: int) -> Reals:
    """Return the derivative [U] of values [U]: of the polynomial of second degree (third for a second derivative)
    that fits best within :data:`WINDOW` around each (Savitzky and Golay 1964); at the ends, of the last whole window.
    """
    width = min(len(values), max(order + 2, 2 * round(0.5 * WINDOW / dt) + 1))
    degree = min(order + 1, width - 1)
    if degree < order:
        return np.zeros(len(values))
    first = np.clip(np.arange(len(values)) - width // 2, 0, len(values) - width)
    fits = np.linalg.pinv(np.vander(np.arange(width) * dt, degree + 1, increasing=True))
    coefficients = values[first[:, None] + np.arange(width)] @ fits.T
    at = (np.arange(len(values)) - first) * dt
    if order == 1:
        return sum(k * coefficients[:, k] * at ** (k - 1) for k in range(1, degree + 1))
    return sum(k * (k - 1) * coefficients[:, k] * at ** (k - 2) for k in range(2, degree + 1))
