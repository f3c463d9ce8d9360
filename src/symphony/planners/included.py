"""Two planners: one that follows its route and whoever is in front (``idm``), and the log itself (``log``)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import SignalState
from symphony.envs.dynamics import WHEELBASE
from symphony.geometry.stations import earliest_pass, to_pieces
from symphony.planners.interface import MAX_BRAKING, Control, Pose, Reals, Scenario, Traffic

RED = (SignalState.STOP, SignalState.ARROW_STOP)
AMBER = (SignalState.CAUTION, SignalState.ARROW_CAUTION)
BEFORE, BEYOND = 50.0, 10_000.0
"""Metres by which a route goes straight on before its start and past its end."""
VIEW = 100.0
"""Metres ahead within which the route's bends and limits, and others, are looked at."""
BACK, _ON = 5.0, 15.0
"""Metres of the route around where the ego last was, within which it is now. The nearest place of all may be another
pass: routes lead around blocks.
"""
AT_STOP, STOP_CHORD = 1.5, 15.0
"""Metres of a stop point from a route that it is on, and metres behind it for which the route follows its lane."""


class LogPlanner:
    """Plays back what the ego did, in a straight line over holes of the log; the run fails where the log ends."""

    def reset(self, scenario: Scenario) -> None:
        """Remember the log, its holes filled."""
        known = np.flatnonzero(scenario.log_valid)
        self.log, self.last = scenario.log.copy(), int(known[-1])
        holes = np.flatnonzero(~scenario.log_valid)
        logged = scenario.log[known]
        logged[:, 2] = np.unwrap(logged[:, 2])
        for column in range(self.log.shape[1]):
            self.log[holes, column] = np.interp(holes, known, logged[:, column])

    def plan(self, traffic: Traffic) -> Pose:
        """The next logged state."""
        if traffic.step >= self.last:
            raise ValueError(f"the log of the ego ends at step {self.last}")
        return Pose(*self.log[traffic.step + 1].tolist())


class IDMPlanner:
    """Follows its route by pure pursuit at the speed of the intelligent driver model.

    Acceleration a (1 - (v / v0)^4 - (s* / s)^2) with s* = s0 + max(0, v T + v dv / (2 sqrt(a b))), s the gap to the
    nearest box that reaches into the route's corridor ahead, or to a stop line that is red (Treiber, Hennecke,
    Helbing, "Congested traffic states in empirical observations and microscopic simulations", Phys. Rev. E 62,
    2000). v0 is the lanes' speed limit, less where a bend or a lower limit comes near. Steering leads the rear axle
    to a point ahead (Coulter, "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01, 1992).
    It gives no way to crossing traffic that is not on its route yet.

    Args:
        speed: v0 in m/s where no speed limit is known.
        headway: T, seconds.
        gap: s0, metres kept at standstill.
        acceleration: a, m/s^2.
        braking: b, m/s^2, comfortable.
        lateral: m/s^2 in bends.
        margin: metres that the corridor is wider than the ego on each side.
    """

    def __init__(
        self,
        speed: float = 13.9,
        headway: float = 1.5,
        gap: float = 2.0,
        acceleration: float = 1.5,
        braking: float = 2.0,
        lateral: float = 2.5,
        margin: float = 0.3,
    ) -> None:
        self.speed, self.headway, self.gap = speed, headway, gap
        self.acceleration, self.braking, self.lateral, self.margin = acceleration, braking, lateral, margin

    def reset(self, scenario: Scenario) -> None:
        """Lay out the route.

        Raises:
            ValueError: the ego is on no lane.
        """
        if len(scenario.route) < 2:
            raise ValueError("the ego is on no lane that it could follow")
        self.length, self.width = scenario.size.tolist()
        self.dt, self.before = scenario.dt, 0.0
        self.route = RouteLine(scenario.route)
        self.limit = np.minimum(
            _limits(scenario, self.route.points, self.speed),
            np.sqrt(self.lateral / np.maximum(self.route.curvature, 1e-6)),
        )
        lights = np.arange(len(scenario.signal_lane))
        stops = [_stops_along(scenario, self.route, int(q)) for q in lights]
        self.lights = np.repeat(lights, [len(found) for found in stops])
        self.stops = np.array([station for found in stops for station in found], np.float64)
        self.station = float(self.route.project(scenario.state[None, :2])[0][0])

    def plan(self, traffic: Traffic) -> Control:
        """Speed by the leader, steering by the route."""
        x, y, heading, speed = traffic.state.tolist()
        # Where steps are long, the way of one may be longer than that.
        driven = self.dt * max(speed, self.before)
        self.before = speed
        within = self.station - BACK, self.station + max(_ON, 2.0 * driven)
        self.station = station = float(self.route.project(np.array([[x, y]]), *within)[0][0])
        pull = self._acceleration(speed, self._free_speed(station), self._leader(traffic, station, speed))
        return Control(pull, self._steering(x, y, heading, speed))

    def _acceleration(self, speed: float, free: float, leader: tuple[float, float]) -> float:
        gap, other = leader
        approach = speed * (speed - other) / (2.0 * math.sqrt(self.acceleration * self.braking))
        wanted = self.gap + max(0.0, speed * self.headway + approach)
        found = 1.0 - (speed / max(free, 0.1)) ** 4 - (wanted / max(gap, 0.1)) ** 2
        return max(self.acceleration * found, -MAX_BRAKING)

    def _free_speed(self, station: float) -> float:
        """v0, from which the slower places ahead can be reached at comfortable braking."""
        away = self.route.arc - station
        ahead = (away > -self.route.spacing) & (away < VIEW)
        allowed = np.sqrt(self.limit[ahead] ** 2 + 2.0 * self.braking * np.maximum(away[ahead], 0.0))
        return float(allowed.min(initial=self.speed if not ahead.any() else np.inf))

    def _leader(self, traffic: Traffic, station: float, speed: float) -> tuple[float, float]:
        """Gap to what is next in front and its speed along the route; infinite for nothing."""
        front = station + 0.5 * self.length
        others = traffic.valid.copy()
        others[traffic.ego] = False
        within = station - self.length, station + VIEW
        centre, aside, direction = self.route.project(traffic.position[others], *within)
        reach = 0.5 * self.width + self.margin
        # Only boxes that could reach into the corridor are looked at by their corners.
        near = (centre > station) & (np.abs(aside) < reach + 0.5 * np.hypot(*traffic.size[others].T))
        which = np.flatnonzero(others)[near]
        corners = _corners(traffic.position[which], traffic.heading[which], traffic.size[which])
        along, aside, _ = self.route.project(corners, *within)
        along, aside = along.reshape(-1, 4), aside.reshape(-1, 4)
        ahead = (aside.min(-1) < reach) & (aside.max(-1) > -reach)
        found = (math.inf, 0.0)
        if ahead.any():
            gaps = np.where(ahead, along.min(-1) - front, np.inf)
            nearest = int(gaps.argmin())
            speed_along = float((traffic.velocity[which[nearest]] * direction[near][nearest]).sum())
            found = (float(gaps[nearest]), max(speed_along, 0.0))
        for stop, light in zip(self.stops.tolist(), traffic.lights[self.lights].tolist(), strict=True):
            gap = stop - front
            in_time = gap > speed**2 / (2.0 * self.braking)
            if (light in RED or (light in AMBER and in_time)) and -2.0 < gap < found[0]:
                found = (gap, 0.0)
        return found

    def _steering(self, x: float, y: float, heading: float, speed: float) -> float:
        base = WHEELBASE * self.length
        rear = np.array([x - 0.5 * base * math.cos(heading), y - 0.5 * base * math.sin(heading)])
        ahead = min(3.0 + 0.5 * abs(speed), 20.0)
        within = self.station - base - BACK, self.station + BACK
        goal = self.route.at(float(self.route.project(rear[None], *within)[0][0]) + ahead)
        dx, dy = (goal - rear).tolist()
        angle = math.atan2(dy, dx) - heading
        return math.atan(2.0 * base * math.sin(angle) / max(math.hypot(dx, dy), 0.1))


class RouteLine:
    """A route as a line that goes straight on past both of its ends.

    Args:
        points: [P, 2], P >= 2.

    Attributes:
        points: [P', 2] both ends included.
        arc: [P'] metres of each, 0 at the first point given.
        curvature: [P'] 1/m, not signed.
        spacing: the largest distance between two of the points given.
    """

    def __init__(self, points: NDArray[np.floating]) -> None:
        line = points[np.r_[True, np.linalg.norm(np.diff(points, axis=0), axis=-1) > 1e-3]].astype(np.float64)
        if len(line) < 2:
            raise ValueError("a route needs two points that differ")
        steps = np.linalg.norm(np.diff(line, axis=0), axis=-1)
        first, last = (line[1] - line[0]) / steps[0], (line[-1] - line[-2]) / steps[-1]
        self.points = np.concatenate([line[:1] - BEFORE * first, line, line[-1:] + BEYOND * last])
        pieces = np.diff(self.points, axis=0)
        self._length = np.linalg.norm(pieces, axis=-1)
        self.direction = pieces / self._length[:, None]
        self.arc = np.concatenate([[0.0], self._length.cumsum()]) - BEFORE
        angle = np.arctan2(self.direction[:, 1], self.direction[:, 0])
        turn = np.abs((np.diff(angle) + np.pi) % (2 * np.pi) - np.pi)
        self.spacing = float(steps.max())
        near = np.minimum(self._length, self.spacing)
        self.curvature = np.concatenate([[0.0], turn / (0.5 * (near[1:] + near[:-1])), [0.0]])

    def at(self, station: float) -> Reals:
        """The point [2] so many metres along."""
        return np.array([np.interp(station, self.arc, self.points[:, k]) for k in (0, 1)])

    def project(
        self, points: NDArray[np.floating], low: float = -math.inf, high: float = math.inf
    ) -> tuple[Reals, Reals, Reals]:
        """Metres along [M], distance to the left [M] and direction [M, 2] of the places nearest to points [M, 2], of
        the pieces between two points of the line that reach into what lies from `low` to `high` metres along. Of
        several passes it is the earliest.
        """
        share, away, distance = self._to_pieces(points)
        outside = (self.arc[1:] < low) | (self.arc[:-1] > high)
        which = earliest_pass(np.where(outside, np.inf, distance))
        row = np.arange(len(points))
        direction, away = self.direction[which], away[row, which]
        side = np.where(direction[:, 0] * away[:, 1] - direction[:, 1] * away[:, 0] < 0, -1.0, 1.0)
        return self.arc[which] + share[row, which], side * distance[row, which], direction

    def passes(self, point: NDArray[np.floating], within: float) -> list[float]:
        """Metres along of all places at which the line passes a point [2] so closely."""
        share, _, distance = self._to_pieces(point[None])
        beside = np.pad(distance[0], 1, constant_values=np.inf)
        lowest = (distance[0] <= beside[:-2]) & (distance[0] < beside[2:]) & (distance[0] < within)
        return (self.arc[:-1] + share[0])[lowest].tolist()

    def _to_pieces(self, points: NDArray[np.floating]) -> tuple[Reals, Reals, Reals]:
        return to_pieces(self.points[:-1], self.direction, self._length, points[:, None])


def _corners(
    position: NDArray[np.floating], heading: NDArray[np.floating], size: NDArray[np.floating]
) -> NDArray[np.floating]:
    """[4 M, 2] of boxes."""
    ahead = 0.5 * size[:, :1] * np.stack([np.cos(heading), np.sin(heading)], -1)
    left = 0.5 * size[:, 1:] * np.stack([-np.sin(heading), np.cos(heading)], -1)
    return np.stack(
        [position + a * ahead + b * left for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))], 1
    ).reshape(-1, 2)


def _limits(scenario: Scenario, points: Reals, unknown: float) -> Reals:
    """Speed limit [P] of the lane nearest to each point."""
    lanes = scenario.road.lanes
    away = np.linalg.norm(points[:, None] - lanes.points[None, :, :2], axis=-1)
    limit = scenario.road.speed_limit[lanes.line_index[away.argmin(-1)]].astype(np.float64)
    return np.where(np.isnan(limit), unknown, limit)


def _stops_along(scenario: Scenario, route: RouteLine, light: int) -> list[float]:
    """Metres along the route at which a light stops it: where it follows the lane of the light, from the stop point
    on for up to 15 m.
    """
    stop = scenario.signal_point[light]
    lane = scenario.road.lanes[int(scenario.signal_lane[light])][:, :2].astype(np.float64)
    nearest = int(np.linalg.norm(lane - stop, axis=-1).argmin())
    path = lane[nearest:]
    path = np.concatenate([stop[None], path[np.linalg.norm(path - stop, axis=-1) < STOP_CHORD]])
    found = []
    for station in route.passes(stop, AT_STOP):
        along, aside, _ = route.project(path, station - BACK, station + STOP_CHORD + 2 * BACK)
        if (np.abs(aside) < AT_STOP).all() and station > -BACK and along[-1] - along[0] > -1.0:
            found.append(station)
    return found
