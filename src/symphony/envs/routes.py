"""Routes as tables of points: what a goal looks like to a policy.

Legend: B scenes, G feasible routes of a vehicle, R points of all routes of a scene, K points of a route, W points of
the part of it that is seen, N agents, M rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.data.segment import RunSegment
from symphony.errors import DataError, DataWarning
from symphony.geometry.frames import LEVEL, constant, rotate
from symphony.geometry.nearest import on_host
from symphony.geometry.polylines import stations_along
from symphony.roadgraph import LaneGraph, ground_truth_routes, route_lines, routes, starting_lanes
from symphony.roadgraph.routes import HORIZON, SAME, carried_on, resampled
from symphony.streams import stream_of

SPACING = 3.0  # metres between the points of a route; its last piece may be shorter
POINTS = 64  # points of a route, from its beginning on, by which it is chosen: 189 m
BEHIND, WINDOW = 12, 56
"""Points of a route that are seen: those behind the agent, and all of them (36 m behind to 129 m ahead)."""
AHEAD = (0, 1, 2, 3, 4, 6, 8, 11, 15, 20, 27)
"""Points of its route that a vehicle observes, counted from the one nearest to it."""
ROUTE_FEATURES = 4 + 3 * (len(AHEAD) - 1)
ALONG_FEATURES = 11
BESIDE = 20.0  # metres beside its route within which an agent sees where along it something is
STRIDE = 4  # the goal policy observes every STRIDE-th point of a route
CHOICE_FEATURES = 5 * (POINTS // STRIDE) + 2 + (POINTS - 2) + 1
"""What it observes there, where a route begins, the turn at each point but the first and the last, and how near it
changes lanes."""
MAGNIFIED = 20.0  # times that sines of turns are magnified: those of a change of lanes are a few hundredths
CHANGE_SCALE = 30.0  # metres to a change of lanes at which its nearness is one half
MOVING, WIDE = 2.0, 6.0
"""Speed (m/s) above which a vehicle on no lane is on one as far away (m) as some cut a corner."""
ONWARD = 200.0  # metres that routes reach beyond what the fastest agent can drive
_FASTER, _FASTEST, _LATER = 1.1, 45.0, 15.0
"""Factor by which vehicles may be faster than the fastest of the log, the m/s up to which they may, and m/s that
they may have past its end, if it stands still."""
_BACK, _SEARCHED = 4, 16
"""Points before the last place along a route from which on the next one is sought, and points searched."""
_CUT, _SLACK = 1.5, 3.0
"""Metres along a route to a metre driven (cutting a corner is faster), and metres besides."""


@dataclass(frozen=True)
class RouteTable:
    """The feasible routes of one vehicle from its first position."""

    points: NDArray[np.float32]  # [P, 2] of all, SPACING apart from beside the vehicle on
    count: NDArray[np.int64]  # [G] points of each
    right: NDArray[np.bool_]  # [G] those nearest to the log; several where they part beyond its end
    change: NDArray[np.float32]  # [G] metres until each changes lanes; infinite for those that don't
    logged: int  # one of the right ones, drawn from segment and agent alone; -1 where the vehicle is on no lane
    carried: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)
    """What vehicles follow [K, 2] of routes that end beside lanes that go on, by number of the route."""

    def line(self, route: int) -> NDArray[np.float32]:
        """Return points [K, 2] of one route."""
        begin = int(self.count[:route].sum())
        return self.points[begin : begin + int(self.count[route])]

    def followed(self, route: int) -> NDArray[np.float32]:
        """Return points [K, 2] of what a vehicle on a route follows."""
        return self.carried[route] if route in self.carried else self.line(route)


_NONE = np.zeros(0, np.float32)
NO_ROUTES = RouteTable(_NONE.reshape(0, 2), np.zeros(0, np.int64), np.zeros(0, np.bool_), _NONE, -1)


def drivable(segment: RunSegment, steps: int) -> float:
    """Return the metres that the fastest agent of a segment can drive in ``steps`` steps, or a little more."""
    speed = np.linalg.norm(segment.velocity[segment.valid], axis=-1).max(initial=0.0)
    least = _LATER if steps > segment.log_steps else 0.0
    return max(min(_FASTER * float(speed), _FASTEST), least) * (steps - 1) * segment.dt


def route_table(segment: RunSegment, graph: LaneGraph, agent: int, begin: int = 0) -> RouteTable:
    """Return the routes that an agent of a segment can take, and which of them it took (paper, section III-B).

    They follow every branch for :data:`symphony.roadgraph.routes.HORIZON` metres, or as far as agents can drive in
    the log, and reach :data:`ONWARD` metres beyond what can be driven in the segment, unless the map ends. Where they
    can't be built, a :class:`~symphony.errors.DataWarning` says so, and there are none.

    An ego with a goal took one that comes past it. Routes begin with the agent's first valid state from step
    ``begin``, at which it enters, on; those of an agent that enters later with its first state on a lane.
    """
    steps, starts, first = begin + np.flatnonzero(segment.valid[agent, begin:]), [], 0
    for first in steps.tolist() if begin else steps[:1].tolist():
        if starts := _starts(segment, graph, agent, first):
            break
    reach, speed = drivable(segment, segment.num_steps), float(np.linalg.norm(segment.velocity[agent, first]))
    horizon, length = max(HORIZON, drivable(segment, segment.log_steps)), max(HORIZON, reach + ONWARD)
    found = routes(graph, starts, horizon=horizon, onward=max(reach + ONWARD - horizon, 0.0))
    try:
        found, lines = route_lines(graph, found, dict(starts), spacing=SPACING, length=length, speed=speed)
        if not all(np.isfinite(line).all() for line in lines):
            raise ValueError("points that are not finite")
    except (ValueError, IndexError, ArithmeticError) as error:
        what = f"the routes of agent {int(segment.agent_id[agent])} can't be built: {error}; it has none"
        where = DataError(what, segment=segment.segment_id, field="road.lanes")
        warnings.warn(str(where), DataWarning, stacklevel=2)
        return NO_ROUTES
    if not lines:
        return NO_ROUTES
    path, there = segment.position[agent, first:, :2], segment.valid[agent, first:]
    if segment.goal is not None and agent == segment.ego:
        path, there = np.concatenate([path, [segment.goal]]), np.append(there, True)
    way = [graph.length[[*r.lanes[: max(r.change - 1, 0)]]].sum() - dict(starts)[r.lanes[0]] for r in found]
    change = np.array([w + r.begins if r.change else np.inf for w, r in zip(way, found, strict=True)], np.float32)
    right, plain = ground_truth_routes(lines, path, there), np.isinf(change)
    # Who hardly moved may be about to change lanes, but rarely is, though more routes change lanes than do not.
    right &= plain | ~(right & plain).any()
    tied = np.flatnonzero(right)
    draw = stream_of(f"route {segment.segment_id} {segment.agent_id[agent]}") % len(tied)
    count = np.array([len(line) for line in lines], np.int64)
    kept = [line.astype(np.float32) for line in lines]
    carried = _carried(graph, kept, length, speed)
    return RouteTable(np.concatenate(kept), count, right, change, int(tied[draw]), carried)


def _carried(
    graph: LaneGraph, lines: Sequence[NDArray[np.float32]], length: float, speed: float
) -> dict[int, NDArray[np.float32]]:
    """Return what is followed of lines that end beside lanes that go on, by number (see :func:`carried_on`)."""
    ends, found = np.array([graph.lines[lane][-1] for lane in graph.drops], np.float32).reshape(-1, 2), {}
    for number, line in enumerate(lines):
        if len(line) < 2 or np.abs(ends - line[-1]).max(1).min(initial=np.inf) >= SAME:
            continue
        try:
            more = carried_on(graph, line.astype(np.float64), length, speed)
        except (ValueError, IndexError, ArithmeticError):
            continue  # a lane that can't be followed: the route ends where it did
        if more is not None:
            # Up to where it changes a route keeps its very points.
            same = max(int((more[: len(line)] == line[: len(more)]).all(-1).argmin()) - 1, 0)
            rest = resampled(more[same:], SPACING, length - SPACING * same)
            found[number] = np.concatenate([line[:same], rest]).astype(np.float32)
    return found


def _starts(segment: RunSegment, graph: LaneGraph, agent: int, step: int) -> list[tuple[int, float]]:
    """Return lanes that an agent may be on, and metres along them: those of its height, where the map has any."""
    position, lanes = segment.position[agent, step], segment.road.lanes
    pose = position[:2], float(segment.heading[agent, step])
    starts = starting_lanes(graph, *pose)
    if not starts and np.linalg.norm(segment.velocity[agent, step]) > MOVING:
        starts = starting_lanes(graph, *pose, tolerance=WIDE)
    if len(starts) < 2 or np.ptp(lanes.points[:, 2]) < LEVEL:
        return starts
    ground, kept = position[2] - 0.5 * segment.size[agent, 2], []
    for lane, along in starts:
        arc = np.append(0.0, np.hypot(*np.diff(lanes[lane][:, :2], axis=0).T).cumsum())
        if abs(np.interp(along, arc, lanes[lane][:, 2]) - ground) < LEVEL:
            kept.append((lane, along))
    return kept or starts


class Packed(NamedTuple):
    """All routes of N agents in one list of points; G is that of the agent with the most, the rest padding."""

    point: NDArray[np.float32]  # [R, 2]
    first: NDArray[np.int64]  # [N, G] place in the list of the first point of each route
    length: NDArray[np.int64]  # [N, G] points of each; 0 for padding
    follow_first: NDArray[np.int64]  # [N, G] the same of what is followed of each
    follow_length: NDArray[np.int64]  # [N, G]
    change: NDArray[np.float32]  # [N, G] metres until each changes lanes


def packed(tables: Sequence[RouteTable], least: int = 0) -> Packed:
    """Return the routes of N agents; G is at least ``least``."""
    most = max([least, *(len(table.count) for table in tables)])
    count, change = np.zeros((len(tables), most), np.int64), np.zeros((len(tables), most), np.float32)
    for k, table in enumerate(tables):
        count[k, : len(table.count)], change[k, : len(table.count)] = table.count, table.change
    first = (count.cumsum() - count.ravel()).reshape(count.shape) * (count > 0)
    follow_first, follow_count = first.copy(), count.copy()
    parts, begin = [np.zeros((0, 2), np.float32), *(t.points for t in tables)], int(count.sum())
    for k, table in enumerate(tables):
        for number, line in table.carried.items():
            follow_first[k, number], follow_count[k, number] = begin, len(line)
            parts.append(line)
            begin += len(line)
    return Packed(np.concatenate(parts), first, count, follow_first, follow_count, change)


def logged_progress(
    tables: Sequence[RouteTable], position: Float[NDArray[np.floating], "N T 2"], valid: Bool[NDArray, "N T"]
) -> Float[NDArray[np.float32], "N T"]:
    """Return the metres that agents have come along the routes that they took, at each step; 0 if unknown."""
    found = np.zeros(valid.shape, np.float32)
    rows = [row for row, table in enumerate(tables) if table.logged >= 0]
    if rows:
        lines = [tables[row].followed(tables[row].logged) for row in rows]
        most = max(2, *map(len, lines))
        padded = np.stack([np.pad(line, ((0, most - len(line)), (0, 0)), "edge") for line in lines])
        places = stations_along(padded.astype(np.float64), position[rows].astype(np.float64), valid[rows])
        found[rows] = np.nan_to_num(places)
    return found


class Routes(NamedTuple):
    """Routes of the agents of some scenes, all points of a scene in one list."""

    point: Tensor  # [B, R, 2]
    first: Tensor  # [B, N, G] int64 place in the list of the first point of each route
    length: Tensor  # [B, N, G] int64 points of each; 0 for padding
    followed: tuple[Tensor, Tensor]  # [B, N, G] the same of what agents follow, see :class:`RouteTable`
    change: Tensor  # [B, N, G] metres until each changes lanes; infinite for those that don't

    def of(self, scene: Int[Tensor, " M"], goal: Int[Tensor, "M N"]) -> FollowedRoutes:
        """Return the routes that agents follow: none where there is no route of that number."""
        _, agents, number = self.length.shape
        if number == 0:
            none = torch.zeros_like(goal)
            return FollowedRoutes(self.point.flatten(0, 1), none, none)
        agent = torch.arange(agents, device=goal.device)
        # Places in the flattened [B, N, G], and then in the flattened [B, R].
        row = ((scene[:, None] * agents + agent) * number + goal.clamp(0, number - 1)).flatten()
        first, count = (part.flatten().index_select(0, row).unflatten(0, goal.shape) for part in self.followed)
        exists = (goal >= 0) & (goal < number)
        begin = first + (scene * self.point.shape[1])[:, None]
        return FollowedRoutes(self.point.flatten(0, 1), begin, torch.where(exists, count, 0))

    def among(self, scene: Int[Tensor, " M"]) -> FollowedRoutes:
        """Return all routes [M, N, G] that the agents of scenes can choose from."""
        begin = self.first[scene] + (scene * self.point.shape[1])[:, None, None]
        return FollowedRoutes(self.point.flatten(0, 1), begin, self.length[scene])


class FollowedRoutes(NamedTuple):
    """Routes such as the one that each agent follows; leading dimensions [*b], such as [M, N]."""

    point: Tensor  # [Q, 2] points of many routes
    begin: Tensor  # [*b] int64 place of the first point of each
    length: Tensor  # [*b] int64 points of each; 0 for none

    def points(self, place: Int[Tensor, "*b K"] | int) -> Float[Tensor, "*b K 2"]:
        """Return points at places of each route, or the first ones; past its end the last one, zeros for none."""
        if isinstance(place, int):
            place = torch.arange(place, device=self.begin.device).expand(*self.begin.shape, place)
        if not len(self.point):
            return self.point.new_zeros(*place.shape, 2)
        row = self.begin[..., None] + place.minimum((self.length[..., None] - 1).clamp_min(0))
        found = self.point.index_select(0, row.clamp_max(len(self.point) - 1).flatten())
        return found.unflatten(0, place.shape) * (self.length > 0)[..., None, None]

    def lines(self) -> tuple[Float[Tensor, "*b K 2"], Int[Tensor, "*b"]]:
        """Return all points of the routes, padded with the last one, and their number. On a device this waits."""
        return self.points(max(2, int(self.length.max())) if self.length.numel() else 2), self.length

    def window(self, progress: Float[Tensor, "M N"]) -> RouteWindow:
        """Return what agents see of their routes, given the metres that they have come along them."""
        own = (progress / SPACING).round().long().minimum((self.length - 2).clamp_min(0))
        start = (own - BEHIND).clamp_min(0)
        place = start[..., None] + torch.arange(WINDOW, device=start.device)
        return RouteWindow(self.points(place), place < self.length[..., None], own - start)

    def progress(
        self, position: Float[Tensor, "M N 2"], about: Float[Tensor, "M N"], moved: Float[Tensor, "M N"]
    ) -> Float[Tensor, "M N"]:
        """Return metres along the routes of the places nearest to agents, sought around where they were before
        (``about``, in metres along), given the metres that they have ``moved`` since.
        """
        moved, about = moved[..., None], about[..., None]
        reach = _CUT * moved + _SLACK
        # Of a step beyond 30 m the last part is searched; what is not finite leads nowhere.
        onward = about + (moved - 30.0).clamp_min(0.0)
        place = ((onward / SPACING).long() - _BACK).clamp(0, 1 << 40) + torch.arange(_SEARCHED, device=about.device)
        x, y = self.points(place).unbind(-1)
        way_x, way_y = x.diff(dim=-1), y.diff(dim=-1)
        length = (way_x.square() + way_y.square()).sqrt()
        away_x, away_y = position[..., :1] - x[..., :-1], position[..., 1:] - y[..., :-1]
        some = length.clamp_min(1e-6)
        along = ((away_x * way_x + away_y * way_y) / some).clamp_min(0.0).minimum(length)
        share = along / some
        squared = (away_x - share * way_x).square() + (away_y - share * way_y).square()
        arc = SPACING * place[..., :-1].to(about.dtype)
        near = (arc <= about + reach) & (arc + SPACING >= about - reach)
        near &= place[..., 1:] < self.length[..., None]
        which = squared.masked_fill(~near, torch.inf).argmin(-1, keepdim=True)
        return torch.where(near.any(-1, keepdim=True), (arc + along).gather(-1, which), about).squeeze(-1)


class RouteWindow(NamedTuple):
    """The part of their routes that agents see."""

    points: Tensor  # [M, N, W, 2] points, SPACING apart
    exists: Tensor  # [M, N, W] which of them are there
    own: Tensor  # [M, N] int64 the one that is nearest to where the agent has come to, or the last but one


def route_ahead(state: Float[Tensor, "M N 4"], routes: RouteWindow, distance_scale: float) -> Float[Tensor, "M N F"]:
    """Return what each agent observes of its route, in its own frame.

    Whether it has one, how far to the left the route lies (metres / 5), its direction, then position and existence of
    points ahead. All zero without a route. ``distance_scale`` are the metres that become 1.
    """
    position, heading = state[..., :2], state[..., 2]
    which = routes.own[..., None] + constant(AHEAD, torch.int64, position.device)
    there = routes.exists.gather(2, which)
    seen = routes.points.gather(2, which[..., None].expand(*which.shape, 2))
    local = rotate(seen - position[..., None, :], -heading[..., None])
    along = local[..., 1, :] - local[..., 0, :]
    along = along / along.norm(dim=-1, keepdim=True).clamp_min(1e-3)
    offset = along[..., 0] * local[..., 0, 1] - along[..., 1] * local[..., 0, 0]
    has = routes.exists[..., 1:2].to(state.dtype)
    ahead = torch.cat([local / distance_scale, there[..., None].to(state.dtype)], -1)
    ahead = ahead[..., 1:, :] * there[..., 1:, None]
    beside = (offset / 5.0).clamp(-2.0, 2.0)[..., None]
    return torch.cat([torch.ones_like(has), beside, along, ahead.flatten(-2)], -1) * has


def along_route(
    own: Float[Tensor, "M N 5"],
    own_size: Float[Tensor, "M N 2"],
    others: Float[Tensor, "M N O 5"],
    size: Float[Tensor, "M N O 2"],
    routes: RouteWindow,
) -> Float[Tensor, "M N O F"]:
    """Return where others are along each agent's route (Frenet coordinates), as bounded numbers.

    Whether this is known; the gap along the route between the boxes (three scales, positive ahead, 0 while they are
    side by side); how far to the left of the route (two scales) and how far beside the agent's own width; how much
    faster along the route (two scales); the share d / (d + 2) of the deceleration d in m/s^2 that keeps the agent
    behind what it closes in on; whether it is ahead. All zero beyond what is seen of the route, more than
    :data:`BESIDE` metres from it, and without one. Every number is within [-1, 1] at any speed. States are x, y,
    heading and velocity, sizes length and width.
    """
    # Component by component: operations on a last dimension of 2 are slow.
    x, y, speed_x, speed_y = (torch.cat([own[..., k, None], others[..., k]], -1) for k in (0, 1, 3, 4))
    points_x, points_y = routes.points.unbind(-1)
    count = routes.exists.sum(-1)[..., None]
    with torch.no_grad():
        # |p - q|^2 less |p|^2, about the agent so that numbers stay small: [M, N, 1 + O, K]
        here = torch.stack([x - x[..., :1], y - y[..., :1]], -1)
        line = torch.stack([points_x - x[..., :1], points_y - y[..., :1]], -2)
        own_part = line.square().sum(-2).masked_fill(~routes.exists, torch.inf)
        # The agent's own place is where it has come to, which on a route that passes itself is not the nearest one.
        nearest = (own_part[..., None, :] - 2.0 * here[..., 1:, :] @ line).argmin(-1)
        nearest = torch.cat([routes.own[..., None], nearest], -1)
        start = nearest.minimum((count - 2).clamp_min(0))
        following = (start + 1).clamp_max(routes.points.shape[2] - 1)
    first_x, first_y = points_x.gather(2, start), points_y.gather(2, start)
    along_x, along_y = points_x.gather(2, following) - first_x, points_y.gather(2, following) - first_y
    length = (along_x.square() + along_y.square()).sqrt().clamp_min(1e-3)
    along_x, along_y = along_x / length, along_y / length
    away_x, away_y = x - first_x, y - first_y
    along = SPACING * start.to(x.dtype) + (away_x * along_x + away_y * along_y)
    left = along_x * away_y - along_y * away_x
    speed = speed_x * along_x + speed_y * along_y
    end = SPACING * (count - 1)
    known = (along > -SPACING) & (along < end + SPACING) & (left.abs() < BESIDE) & (count > 1)
    known = known[..., 1:] & known[..., :1]
    ahead, left, faster = along[..., 1:] - along[..., :1], left[..., 1:], speed[..., 1:] - speed[..., :1]
    half = 0.5 * (size[..., 0] + own_size[..., None, 0])
    gap = ahead - half * (ahead / half).clamp(-1.0, 1.0)
    beside = left.abs() - 0.5 * (size[..., 1] + own_size[..., None, 1])
    brake = (-faster).clamp_min(0.0).square() / (2.0 * gap.clamp_min(0.5))
    in_front = (ahead > 0).to(own.dtype)
    scales = ((gap, (3.0, 12.0, 50.0)), (left, (1.5, 6.0)), (beside, (0.5,)), (faster, (2.0, 8.0)))
    bounded = [(value / scale).tanh() for value, each in scales for scale in each]
    features = [torch.ones_like(gap), *bounded, brake / (brake + 2.0) * in_front, in_front]
    return torch.where(known[..., None], torch.stack(features, -1), 0.0)


def route_choices(
    state: Float[Tensor, "M N 4"], routes: FollowedRoutes, change: Float[Tensor, "M N G"], distance_scale: float
) -> tuple[Float[Tensor, "M N G F"], Bool[Tensor, "M N G"]]:
    """Return every feasible route as features in the agent's frame, and which of them exist.

    A feature vector is position, direction and existence of every :data:`STRIDE`-th of the first :data:`POINTS`
    points; where the route begins, resolved to decimetres near the agent; the sine of the turn at every point,
    :data:`MAGNIFIED` and bounded; and how near it changes lanes, given the metres until then (infinite: never), from
    1 for at once to 0 for never. ``distance_scale`` are the metres that become 1.
    """
    (point, first, count), mask = routes, routes.length > 1
    state = state[..., None, :].expand(*count.shape, state.shape[-1])
    if not on_host(count):
        return _shape_of_routes(state, routes, change, distance_scale), mask
    # Some agents have ten times as many routes as most.
    there = (count > 0).flatten().nonzero().squeeze(-1)
    some = FollowedRoutes(point, first.flatten()[there], count.flatten()[there])
    found = _shape_of_routes(state.flatten(0, -2)[there], some, change.flatten()[there], distance_scale)
    features = found.new_zeros(count.numel(), found.shape[-1]).index_copy(0, there, found)
    return features.unflatten(0, count.shape), mask


def _shape_of_routes(
    state: Float[Tensor, "*b 4"], routes: FollowedRoutes, change: Float[Tensor, "*b"], distance_scale: float
) -> Float[Tensor, "*b F"]:
    """Return features of routes, each in the frame of its agent."""
    points, count = routes.points(POINTS), routes.length.clamp_max(POINTS)[..., None]
    kept, angle = points[..., ::STRIDE, :], -state[..., None, 2]
    local = rotate(kept - state[..., None, :2], angle)
    following = points[..., 1::STRIDE, :] - kept
    direction = rotate(following / following.norm(dim=-1, keepdim=True).clamp_min(1e-3), angle)
    place = torch.arange(POINTS, device=points.device)
    there = (place[::STRIDE] < count)[..., None].to(state.dtype)
    seen = torch.cat([local / distance_scale, direction, torch.ones_like(there)], -1) * there
    step = points.diff(dim=-2)
    x, y = (step / step.norm(dim=-1, keepdim=True).clamp_min(1e-3)).unbind(-1)
    turn = x[..., :-1] * y[..., 1:] - y[..., :-1] * x[..., 1:]
    turn = torch.where(place[2:] < count, (MAGNIFIED * turn).tanh(), 0.0)
    begin, near = (local[..., 0, :] / 3.0).tanh(), 1.0 / (1.0 + change[..., None] / CHANGE_SCALE)
    return torch.cat([seen.flatten(-2), begin * (count > 0), turn, near * (count > 0)], -1)
