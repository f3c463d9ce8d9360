"""Routes as tables of points: what a goal looks like to a policy.

Legend: G feasible routes of one vehicle, K points of a route, N agents, M rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.data.segment import RunSegment
from symphony.geometry.constants import constant
from symphony.geometry.frames import rotate
from symphony.geometry.nearest import first_smallest, on_host
from symphony.roadgraph import (
    LaneGraph,
    ground_truth_routes,
    route_polyline,
    routes,
    starting_lanes,
)
from symphony.streams import stream_of

SPACING = 3.0
"""Metres between the points of a route."""
POINTS = 64
"""Points of a route: 189 m, past what a fast vehicle drives in 10 s."""
AHEAD = (0, 1, 2, 3, 4, 6, 8, 11, 15, 20, 27)
"""Points of its route that a vehicle observes, counted from the one nearest to it."""
ROUTE_FEATURES = 4 + 3 * (len(AHEAD) - 1)
ALONG_FEATURES = 11
BESIDE = 20.0
"""Metres beside its route within which an agent sees where along it something is."""
STRIDE = 4
"""Of the points of a route, the share (one in so many) by which the goal policy observes it."""
CHOICE_FEATURES = 5 * (POINTS // STRIDE)
TURN_FEATURES = 2 + (POINTS - 2)
"""Where a route begins, and a turn at each of its points but the first and the last."""


@dataclass(frozen=True)
class RouteTable:
    """Feasible routes of one vehicle from where it begins.

    Attributes:
        points: [G, K, 2] float32, :data:`SPACING` apart from beside the vehicle on; past the end the last one again.
        count: [G] int64 points before the end.
        right: [G] bool the routes nearest to the logged trajectory; several where they part beyond its end.
        logged: one of these, drawn uniformly from segment and agent alone; -1 where the vehicle is on no lane.
    """

    points: NDArray[np.float32]
    count: NDArray[np.int64]
    right: NDArray[np.bool_]
    logged: int


def route_table(segment: RunSegment, graph: LaneGraph, agent: int, begin: int = 0) -> RouteTable:
    """Routes that an agent of a segment can take, and which of them it took (paper, section IV-B).

    Args:
        segment: with the agent's log.
        graph: of its lanes.
        agent: row of the segment.
        begin: step at which the agent comes in; routes begin with its first valid state from there on, of one that
            comes in later with the first on a lane.
    """
    steps = begin + np.flatnonzero(segment.valid[agent, begin:])
    for first in steps if begin else steps[:1]:
        position, heading = segment.position[agent, first, :2], float(segment.heading[agent, first])
        starts = starting_lanes(graph, position, heading)
        if starts:
            break
    else:
        return RouteTable(
            np.zeros((0, POINTS, 2), np.float32), np.zeros(0, np.int64), np.zeros(0, np.bool_), -1
        )
    choices, along = routes(graph, starts), dict(starts)
    # A route that begins with a lane change starts on the neighbour, beside the lane the vehicle is on.
    default = next(iter(along.values()), 0.0)
    points = np.empty((len(choices), POINTS, 2), np.float32)
    count = np.empty(len(choices), np.int64)
    for k, route in enumerate(choices):
        line = route_polyline(
            graph,
            route,
            spacing=SPACING,
            start=along.get(route[0], default),
            length=SPACING * (POINTS - 1),
        )[:POINTS]
        points[k, : len(line)] = line
        points[k, len(line) :] = line[-1]
        count[k] = len(line)
    path, valid = segment.position[agent, :, :2], segment.valid[agent]
    right = ground_truth_routes(graph, choices, path, valid)
    tied = np.flatnonzero(right)
    draw = stream_of(f"route {segment.segment_id} {segment.agent_id[agent]}") % len(tied)
    return RouteTable(points, count, right, int(tied[draw]))


def route_ahead(
    state: Float[Tensor, "M N 4"],
    points: Float[Tensor, "M N K 2"],
    count: Int[Tensor, "M N"],
    distance_scale: float,
) -> Float[Tensor, "M N F"]:
    """What each agent observes of its route, in its own frame.

    Whether it has one, how far to the left the route lies (metres / 5), its direction, then position and existence of
    points ahead. All zero without a route.

    Args:
        state: x, y, heading, speed.
        points: the agents' routes.
        count: points of each route that exist; 0 for none.
        distance_scale: metres that become 1.
    """
    position, heading = state[..., :2], state[..., 2]
    exists = torch.arange(points.shape[2], device=points.device) < count[..., None]
    with torch.no_grad():
        # Component by component: sums over a last dimension of 2 are slow.
        x, y = (points - position[..., None, :]).square().unbind(-1)
        squared = x + y
        # The last point has nothing ahead of it, so the one before gives the direction.
        nearest = first_smallest(squared.masked_fill(~exists, torch.inf))
        nearest = nearest.minimum((count - 2).clamp_min(0))
        which = nearest[..., None] + constant(AHEAD, torch.int64, points.device)
        there = which < count[..., None]
        which = which.clamp_max(points.shape[2] - 1)
    seen = points.gather(2, which[..., None].expand(*which.shape, 2))
    local = rotate(seen - position[..., None, :], -heading[..., None])
    along = local[..., 1, :] - local[..., 0, :]
    length = along.norm(dim=-1, keepdim=True)
    along = along / length.clamp_min(1e-3)
    offset = along[..., 0] * local[..., 0, 1] - along[..., 1] * local[..., 0, 0]
    has = (count > 1).to(state.dtype)[..., None]
    ahead = torch.cat([local / distance_scale, there[..., None].to(state.dtype)], -1)
    ahead = ahead[..., 1:, :] * there[..., 1:, None]
    features = torch.cat(
        [torch.ones_like(has), (offset / 5.0).clamp(-2.0, 2.0)[..., None], along, ahead.flatten(-2)], -1
    )
    return features * has


def along_route(
    own: Float[Tensor, "M N 5"],
    own_size: Float[Tensor, "M N 2"],
    others: Float[Tensor, "M N O 5"],
    size: Float[Tensor, "M N O 2"],
    points: Float[Tensor, "M N K 2"],
    count: Int[Tensor, "M N"],
) -> Float[Tensor, "M N O F"]:
    """Where others are along each agent's route (Frenet coordinates), as bounded numbers.

    Whether it can be said; the gap along the route between the boxes (three scales, positive ahead, 0 while they are
    side by side); how far to the left of the route (two scales) and how far beside the agent's own width; how much
    faster along the route (two scales); the share d / (d + 2) of the deceleration d in m/s^2 that keeps the agent
    behind what it closes in on; whether it is ahead. All zero beyond the ends of the route, more than
    :data:`BESIDE` metres from it, and without one. Every number is within [-1, 1] at any speed.

    Args:
        own: x, y, heading, velocity of the agents.
        own_size: length and width of their boxes.
        others: likewise.
        size: likewise.
        points: the agents' routes, :data:`SPACING` apart.
        count: points of each route that exist; 0 for none.
    """
    # Component by component: operations on a last dimension of 2 are slow.
    x, y, speed_x, speed_y = (torch.cat([own[..., k, None], others[..., k]], -1) for k in (0, 1, 3, 4))
    points_x, points_y = points.unbind(-1)
    with torch.no_grad():
        exists = torch.arange(points.shape[2], device=points.device) < count[..., None]
        # |p - q|^2 less |p|^2, about the agent so that numbers stay small: [M, N, 1 + O, K]
        here = torch.stack([x - x[..., :1], y - y[..., :1]], -1)
        line = torch.stack([points_x - x[..., :1], points_y - y[..., :1]], -2)
        own_part = line.square().sum(-2).masked_fill(~exists, torch.inf)
        nearest = first_smallest(own_part[..., None, :] - 2.0 * here @ line)
        start = nearest.minimum((count[..., None] - 2).clamp_min(0))
        following = (start + 1).clamp_max(points.shape[2] - 1)
    first_x, first_y = points_x.gather(2, start), points_y.gather(2, start)
    along_x, along_y = points_x.gather(2, following) - first_x, points_y.gather(2, following) - first_y
    length = (along_x.square() + along_y.square()).sqrt().clamp_min(1e-3)
    along_x, along_y = along_x / length, along_y / length
    away_x, away_y = x - first_x, y - first_y
    along = SPACING * start + (away_x * along_x + away_y * along_y)
    left = along_x * away_y - along_y * away_x
    speed = speed_x * along_x + speed_y * along_y
    end = SPACING * (count[..., None] - 1)
    known = (along > -SPACING) & (along < end + SPACING) & (left.abs() < BESIDE) & (count[..., None] > 1)
    known = known[..., 1:] & known[..., :1]
    ahead = along[..., 1:] - along[..., :1]
    half = 0.5 * (size[..., 0] + own_size[..., None, 0])
    gap = ahead - half * (ahead / half).clamp(-1.0, 1.0)
    beside = left[..., 1:].abs() - 0.5 * (size[..., 1] + own_size[..., None, 1])
    faster = speed[..., 1:] - speed[..., :1]
    brake = (-faster).clamp_min(0.0).square() / (2.0 * gap.clamp_min(0.5))
    in_front = (ahead > 0).to(own.dtype)
    features = torch.stack(
        [
            torch.ones_like(gap),
            (gap / 3.0).tanh(),
            (gap / 12.0).tanh(),
            (gap / 50.0).tanh(),
            (left[..., 1:] / 1.5).tanh(),
            (left[..., 1:] / 6.0).tanh(),
            (beside / 0.5).tanh(),
            (faster / 2.0).tanh(),
            (faster / 8.0).tanh(),
            brake / (brake + 2.0) * in_front,
            in_front,
        ],
        -1,
    )
    return torch.where(known[..., None], features, 0.0)


def route_choices(
    state: Float[Tensor, "M N 4"],
    points: Float[Tensor, "M N G K 2"],
    count: Int[Tensor, "M N G"],
    distance_scale: float,
    *,
    turns: bool = False,
) -> tuple[Float[Tensor, "M N G F"], Bool[Tensor, "M N G"]]:
    """Every feasible route as features in the agent's frame, and which of them exist.

    A feature vector is position, direction and existence of every :data:`STRIDE`-th point. With ``turns`` also where
    the route begins, resolved to decimetres near the agent, and the sine of the turn at every point: a route jumps
    where it changes lanes, which points 12 m apart hardly show.
    """
    state = state[..., None, :].expand(*count.shape, state.shape[-1])
    there = (count > 0).flatten().nonzero().squeeze(-1) if on_host(count) else None
    if there is None:
        return _shape_of_routes(state, points, count, distance_scale, turns=turns), count > 1
    # Some agents have ten times as many routes as most.
    lead = count.ndim - 1
    chosen, line, number = (part.flatten(0, lead)[there] for part in (state, points, count))
    found = _shape_of_routes(chosen, line, number, distance_scale, turns=turns)
    features = found.new_zeros(count.numel(), found.shape[-1]).index_copy(0, there, found)
    return features.unflatten(0, count.shape), count > 1


def _shape_of_routes(
    state: Float[Tensor, "*b 4"],
    points: Float[Tensor, "*b K 2"],
    count: Int[Tensor, "*b"],
    distance_scale: float,
    *,
    turns: bool,
) -> Float[Tensor, "*b F"]:
    """Features of routes, each in the frame of its agent."""
    kept = points[..., ::STRIDE, :]
    angle = -state[..., None, 2]
    local = rotate(kept - state[..., None, :2], angle)
    following = points[..., 1::STRIDE, :] - kept
    direction = rotate(following / following.norm(dim=-1, keepdim=True).clamp_min(1e-3), angle)
    order = torch.arange(0, points.shape[-2], STRIDE, device=points.device)
    there = (order < count[..., None])[..., None].to(state.dtype)
    seen = torch.cat([local / distance_scale, direction, torch.ones_like(there)], -1) * there
    features = seen.flatten(-2)
    if turns:
        step = points[..., 1:, :] - points[..., :-1, :]
        x, y = (step / step.norm(dim=-1, keepdim=True).clamp_min(1e-3)).unbind(-1)
        exists = count[..., None]
        turn = x[..., :-1] * y[..., 1:] - y[..., :-1] * x[..., 1:]
        inner = torch.arange(2, points.shape[-2], device=points.device) < exists
        begin = (local[..., 0, :] / 3.0).tanh()
        features = torch.cat([features, begin * (exists > 0), torch.where(inner, turn, 0.0)], -1)
    return features


def pick_routes(
    route: Float[Tensor, "B N G K 2"],
    count: Int[Tensor, "B N G"],
    scene: Int[Tensor, " M"],
    goal: Int[Tensor, "M N"],
) -> tuple[Float[Tensor, "M N K 2"], Int[Tensor, "M N"]]:
    """The points of one route per agent and how many of them exist: none where there is no route of that number."""
    _, agents, routes = count.shape
    if routes == 0:
        return route.new_zeros(*goal.shape, POINTS, 2), torch.zeros_like(goal)
    place = torch.arange(agents, device=goal.device)
    # Places in the flattened [B, A, G].
    row = ((scene[:, None] * agents + place) * routes + goal.clamp(0, routes - 1)).flatten()
    points = route.flatten(0, 2).index_select(0, row).unflatten(0, goal.shape)
    exists = count.flatten().index_select(0, row).unflatten(0, goal.shape)
    return points, torch.where((goal >= 0) & (goal < routes), exists, 0)
