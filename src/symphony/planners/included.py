"""Two planners: one that follows its route and the vehicle ahead (``idm``), and the log itself (``log``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symphony.planners.interface import Pose, Scenario, Traffic

BEFORE, BEYOND = 50.0, 10_000.0
"""Metres by which a route goes straight on before its start and past its end."""
VIEW = 100.0
"""Metres ahead within which the route's bends and limits, and other agents, count."""
BACK = 5.0
"""Metres of the route behind a place within which it is sought."""
AT_STOP = 1.5
"""Metres of a stop point from a route that it is on."""


class LogPlanner:
    """Plays back the ego's log, in a straight line across its gaps; the run fails where the log ends."""

    def reset(self, scenario: Scenario) -> None:
        """Remember the log, its gaps filled."""
        known = np.flatnonzero(scenario.log_valid)
        self.log, self.last = scenario.log.copy(), int(known[-1])
        self.log[known, 2] = np.unwrap(self.log[known, 2])
        holes = np.flatnonzero(~scenario.log_valid)
        for column in self.log.T:
            column[holes] = np.interp(holes, known, column[known])

    def plan(self, traffic: Traffic) -> Pose:
        """Return the next logged state."""
        if traffic.step >= self.last:
            raise ValueError(f"the log of the ego ends at step {self.last}")
        return Pose(*self.log[traffic.step + 1].tolist())


@dataclass(frozen=True)
class IDMPlanner:
    """Follows its route by pure pursuit at the speed of the intelligent driver model.

    Acceleration a (1 - (v / v0)^4 - (s* / s)^2) with s* = s0 + max(0, v T + v dv / (2 sqrt(a b))), s the gap to the
    nearest box that reaches into the route's corridor ahead, or to a stop line that is red (Treiber, Hennecke,
    Helbing, "Congested traffic states in empirical observations and microscopic simulations", Phys. Rev. E 62, 2000).
    v0 is the lanes' speed limit, less where a bend or a lower limit comes near. Steering leads the rear axle to a
    point ahead (Coulter, "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992). It
    does not yield to crossing traffic that is not on its route yet.

    It is not asked step by step: the rule that also drives background traffic moves the egos of all rollouts at once,
    :class:`symphony.rollouts.background.CarFollower`, with these parameters. Others are given by
    ``functools.partial(IDMPlanner, headway=1.0)``; a subclass with ``reset`` and ``plan`` is asked like any planner.

    Args:
        speed: v0 in m/s where no speed limit is known.
        headway: T, seconds.
        gap: s0, metres kept at standstill.
        acceleration: a, m/s^2.
        braking: b, m/s^2, comfortable.
        lateral: m/s^2 in bends.
        margin: metres that the corridor is wider than the ego on each side.
    """

    speed: float = 13.9
    headway: float = 1.5
    gap: float = 2.0
    acceleration: float = 1.5
    braking: float = 2.0
    lateral: float = 2.5
    margin: float = 0.3
