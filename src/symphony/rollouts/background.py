"""Background traffic: vehicles that are not evaluated, driven by a rule, all rollouts at a time.

Legend: B scenes, N driven agents, K points of a route, P background agents that are present, in any rollout.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import normalize, pad

from symphony import keys
from symphony.data.segment import AMBER, RED, SignalState
from symphony.envs.driving import DrivingEnv
from symphony.envs.dynamics import WHEELBASE, bicycle_step
from symphony.envs.objects import Objects
from symphony.envs.routes import SPACING
from symphony.envs.scene import PointType, SceneBatch
from symphony.geometry.frames import wrap
from symphony.geometry.nearest import nearest, places
from symphony.geometry.polylines import NEAR
from symphony.planners import included
from symphony.planners.interface import MAX_BRAKING, MAX_STEERING

_LEADERS = 16
"""Nearest others ahead of which one is followed."""
_WITH = 0.25
"""Cosine of the largest angle between a vehicle and the part of its route that it is on."""


def constant_speed(env: DrivingEnv) -> TensorDictModule:
    """Build a module with which background agents keep speed and heading."""

    def onward(state: Float[Tensor, "*b N 4"]) -> Float[Tensor, "*b N 4"]:
        moved = state[..., :2] + state[..., 3:] * env.dt * _unit(state[..., 2])
        return torch.cat([moved, state[..., 2:]], -1)

    return TensorDictModule(onward, [keys.STATE], [keys.BACKGROUND])


class CarFollower(TensorDictModuleBase):
    """Drives background agents along the routes of the log at the speed of the intelligent driver model.

    It does what :class:`symphony.planners.included.IDMPlanner` does for one vehicle, with its parameters, for many at
    a time: boxes of others are taken by their extent along and across the route, and only the nearest ones ahead
    count. One without a route goes straight on.

    Args:
        env: an environment whose scenes have routes.
        driver: the parameters, if they are not the usual ones.
    """

    in_keys = [keys.SCENE, keys.STEP, keys.STATE, keys.VALID, keys.PROGRESS]  # noqa: RUF012
    out_keys = [keys.BACKGROUND]  # noqa: RUF012

    def __init__(self, env: DrivingEnv, driver: included.IDMPlanner | None = None) -> None:
        super().__init__()
        self.env, self.driver = env, driver or included.IDMPlanner()
        self.routes = _routes(env.scenes, self.driver)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next states [..., N, 4]; those of other agents stay."""
        scenes, lead = self.env.scenes, tensordict.ndim
        row, at = tensordict.get(keys.SCENE).flatten(), tensordict.get(keys.STEP).flatten()
        state, valid = (tensordict.get(key).flatten(0, lead - 1) for key in (keys.STATE, keys.VALID))
        drives = scenes.background[row] & valid
        m, n = places(drives)  # on a device all: those not driven are moved, too, and put back
        everyone = self.env.objects(row, at, state, valid)
        agent = scenes.interactive[row[m], n]
        own, size = state[m, n], scenes.box_size[row[m], agent]
        line, speed = _Lines(*(r[row[m], n] for r in self.routes)), own[:, 3]
        come = tensordict.get(keys.PROGRESS).flatten(0, lead - 1)[m, n]
        station = _own_station(line, own, come)
        hidden = ~everyone.others(scenes.interactive[row])[m, n]
        gap, other = self._leader(line, everyone, m, hidden, own, size, station)
        red = self._red(line, row[m], at[m], station + 0.5 * size[:, 0], speed)
        gap, other = torch.minimum(gap, red), torch.where(red < gap, 0.0, other)
        pull = self._acceleration(speed, self._free_speed(line, station), gap, other)
        after = bicycle_step(own, pull, _steering(line, own, size[:, 0], station), size[:, 0], self.env.dt)
        moved = state.index_put((m, n), torch.where(drives[m, n, None], after, own))
        return tensordict.set(keys.BACKGROUND, moved.reshape(tensordict.get(keys.STATE).shape))

    def _acceleration(self, speed: Tensor, free: Tensor, gap: Tensor, other: Tensor) -> Float[Tensor, " P"]:
        driver = self.driver
        approach = speed * (speed - other) / (2.0 * math.sqrt(driver.acceleration * driver.braking))
        wanted = driver.gap + (speed * driver.headway + approach).clamp_min(0.0)
        # No fourth power, and no angle from atan2: their last bit on the CPU depends on the place in the batch.
        found = 1.0 - (speed / free.clamp_min(0.1)).square().square() - (wanted / gap.clamp_min(0.1)).square()
        return (driver.acceleration * found).clamp_min(-MAX_BRAKING)

    def _free_speed(self, line: _Lines, station: Tensor) -> Float[Tensor, " P"]:
        away = line.arc - station[:, None]
        ahead = (away > -SPACING) & (away < included.VIEW)
        allowed = (line.limit.square() + 2.0 * self.driver.braking * away.clamp_min(0.0)).sqrt()
        free = torch.where(ahead, allowed, torch.inf).amin(-1)
        return torch.where(ahead.any(-1), free, self.driver.speed)

    def _leader(
        self, line: _Lines, now: Objects, m: Tensor, hidden: Tensor, own: Tensor, size: Tensor, station: Tensor
    ) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
        """Return the gap to what is next in front, infinite for nothing, and its speed along the route."""
        delta = now.state[m, :, :2] - own[:, None, :2]
        squared = delta.square().sum(-1)
        # Behind is what is behind on any bend that a vehicle can take within its own length.
        behind = (delta * _unit(own[:, 2])[:, None]).sum(-1) < -size[:, :1]
        hidden = hidden | behind | (squared > included.VIEW**2)
        chosen, there = (part[:, 0] for part in nearest(squared.masked_fill(hidden, torch.inf)[:, None], _LEADERS))
        pose, box = now.state[m[:, None], chosen], now.size[m[:, None], chosen]
        along, aside, way = _project(line, pose[..., :2], _within(line, station - size[:, 0], included.VIEW))
        facing = _unit(pose[..., 2])
        cos = (facing * way).sum(-1).abs()
        sin = (facing[..., 1] * way[..., 0] - facing[..., 0] * way[..., 1]).abs()
        reach = 0.5 * (cos * box[..., 0] + sin * box[..., 1])
        across = 0.5 * (sin * box[..., 0] + cos * box[..., 1])
        corridor = 0.5 * size[:, 1:] + self.driver.margin
        ahead = there & (along > station[:, None]) & (aside.abs() - across < corridor)
        gaps = torch.where(ahead, along - reach - (station + 0.5 * size[:, 0])[:, None], torch.inf)
        gap, which = gaps.min(-1)
        speed = (pose[..., 3:] * way).sum(-1)
        return gap, speed.gather(-1, which[:, None])[:, 0].clamp_min(0.0)

    def _red(self, line: _Lines, row: Tensor, at: Tensor, front: Tensor, speed: Tensor) -> Float[Tensor, " P"]:
        """Return the gap to the route's next light that is red, or amber with room to stop; infinite for none."""
        scenes = self.env.scenes
        shown = scenes.light[row, at.clamp(max=scenes.light.shape[1] - 1)]
        gap = line.stop - front[:, None]
        in_time = gap > (speed.square() / (2.0 * self.driver.braking))[:, None]
        stops = _among(shown, RED) | (_among(shown, AMBER) & in_time)
        return pad(torch.where(stops & (gap > -2.0), gap, torch.inf), (0, 1), value=torch.inf).amin(-1)


class _Lines(NamedTuple):
    """Routes [B, N] or [P], straight on past both of their ends: points; metres along, 0 at the first point of the
    route; m/s that lanes and bends allow; metres at which lights stop the front, infinite for those of other ways.
    """

    points: Float[Tensor, "*b K+2 2"]
    arc: Float[Tensor, "*b K+2"]
    limit: Float[Tensor, "*b K+2"]
    stop: Float[Tensor, "*b Q"]


def _routes(scenes: SceneBatch, driver: included.IDMPlanner) -> _Lines:
    """Return the log's routes of all agents [B, N]; without one, straight on from where an agent enters."""
    row = torch.arange(len(scenes), device=scenes.route_point.device)
    points, exist = scenes.routes.of(row, scenes.route_logged).lines()
    enters = scenes.log_state[row[:, None], scenes.enter, scenes.interactive]
    place = torch.arange(points.shape[2], device=row.device)
    straight = enters[..., None, :2] + SPACING * place[:, None] * _unit(enters[..., 2])[..., None, :]
    points = torch.where((exist > 1)[..., None, None], points, straight)
    last = torch.where(exist > 1, exist, points.shape[2])[..., None] - 1
    ends = [points.gather(2, k[..., None].expand(*k.shape, 2))[:, :, 0] for k in (last - 1, last)]
    onward = normalize(ends[1] - ends[0], dim=-1, eps=1e-6)
    past = (place - last).clamp_min(0)[..., None]
    points = torch.where(past > 0, ends[1][:, :, None] + SPACING * past * onward[:, :, None], points)
    first = normalize(points[:, :, 1] - points[:, :, 0], dim=-1, eps=1e-6)
    before, beyond = points[:, :, 0] - included.BEFORE * first, points[:, :, -1] + included.BEYOND * onward
    points = torch.cat([before[:, :, None], points, beyond[:, :, None]], 2)
    pieces = points.diff(dim=2)
    length = pieces.norm(dim=-1)
    arc = pad(length.cumsum(-1), (1, 0)) - included.BEFORE
    angle, near = torch.atan2(pieces[..., 1], pieces[..., 0]), length.clamp_max(SPACING)
    bend = wrap(angle.diff(dim=-1)).abs() / (0.5 * (near[..., 1:] + near[..., :-1])).clamp_min(1e-3)
    bends = (driver.lateral / pad(bend, (1, 1)).clamp_min(1e-6)).sqrt()
    limit = torch.minimum(_limits(scenes, points, driver.speed), bends)
    lines = _Lines(points, arc, limit, arc[..., :0])
    return lines._replace(stop=_stops(scenes, lines))


def _limits(scenes: SceneBatch, points: Tensor, unknown: float) -> Float[Tensor, "B N K"]:
    lane = scenes.point_valid & (scenes.point_type == PointType.LANE)
    found = torch.full_like(points[..., 0], unknown)
    for b in range(len(scenes)):
        lanes, speed = scenes.point[b, lane[b]], scenes.point_speed[b, lane[b]]
        if len(lanes):
            away = torch.cdist(points[b].flatten(0, 1), lanes, compute_mode="donot_use_mm_for_euclid_dist")
            limit = speed[away.argmin(-1)].reshape(points.shape[1:3])  # the quicker cdist cancels far from the origin
            found[b] = torch.where(limit > 0, limit, unknown)
    return found


def _stops(scenes: SceneBatch, lines: _Lines) -> Float[Tensor, "B N Q"]:
    """Return metres along the routes at which lights stop them. A light is on a route if its stop point is; of
    several at one, that whose lane ends nearest to the route.
    """
    out = torch.full((*lines.arc.shape[:2], scenes.light.shape[2]), torch.inf, device=lines.arc.device)
    for b in range(len(scenes)):
        which = (scenes.point_light[b] >= 0).nonzero()[:, 0]
        if not len(which):
            continue
        light, point = scenes.point_light[b, which].long(), scenes.point[b, which]
        line = _Lines(*(part[b] for part in lines))
        places = (each.expand(len(line.arc), -1, -1) for each in (point, scenes.light_end[b, light]))
        (station, aside, _), (end, away, _) = (_project(line, each) for each in places)
        mine = (aside.abs() <= included.AT_STOP) & (station >= -5.0) & (end > station - 1.0)
        away = away.abs().masked_fill(~mine, torch.inf)
        same = (point[:, None] - point[None]).norm(dim=-1) < 1.0
        mine &= away <= torch.where(same, away[:, None, :], torch.inf).amin(-1)
        out[b][:, light] = torch.where(mine, station, torch.inf)
    return out


def _own_station(line: _Lines, own: Float[Tensor, "P 4"], come: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
    """Return the metres along of agents that follow the lines: of the almost nearest places in their direction the
    one nearest to where they have ``come``, as routes lead around blocks.
    """
    way = line.points.diff(dim=1)
    with_it = (way * _unit(own[:, 2])[:, None]).sum(-1) > _WITH * way.norm(dim=-1)
    with_it = with_it | ~with_it.any(-1, keepdim=True)
    return _project(line, own[:, None, :2], with_it, come)[0][:, 0]


def _steering(line: _Lines, own: Tensor, length: Tensor, station: Tensor) -> Float[Tensor, " P"]:
    base, (x, y, heading, speed) = WHEELBASE * length, own.unbind(-1)
    rear = torch.stack([x - 0.5 * base * heading.cos(), y - 0.5 * base * heading.sin()], -1)
    ahead = (3.0 + 0.5 * speed.abs()).clamp_max(20.0)
    near = _within(line, station - base - included.BACK, base + 2 * included.BACK)
    to = _at(line, _project(line, rear[:, None], near)[0][:, 0] + ahead) - rear
    angle = torch.atan2(to[:, 1], to[:, 0]) - heading
    found = torch.atan(2.0 * base * angle.sin() / to.norm(dim=-1).clamp_min(0.1))
    return found.clamp(-MAX_STEERING, MAX_STEERING)


def _within(line: _Lines, low: Float[Tensor, " P"], length: Tensor | float) -> Bool[Tensor, "P pieces"]:
    """Return which pieces of the lines reach into the ``length`` metres from `low` metres along on."""
    return (line.arc[:, 1:] >= low[:, None]) & (line.arc[:, :-1] <= (low + length)[:, None])


def _project(
    line: _Lines,
    places: Float[Tensor, "P J 2"],
    pieces: Bool[Tensor, "P pieces"] | None = None,
    about: Float[Tensor, " P"] | None = None,
) -> tuple[Float[Tensor, "P J"], Float[Tensor, "P J"], Float[Tensor, "P J 2"]]:
    """Return metres along, metres to the left, and direction of the line at its places nearest to ``places``: of
    several passes of ``pieces`` the earliest (see :mod:`symphony.geometry.polylines`), or that nearest to ``about``.
    """
    start, length = line.points[:, :-1], line.arc.diff(dim=-1)
    ahead = line.points.diff(dim=1) / length.clamp_min(1e-6)[..., None]
    x, y = (places[:, :, None, k] - start[:, None, :, k] for k in (0, 1))
    cos, sin = ahead[:, None, :, 0], ahead[:, None, :, 1]
    share = (x * cos + y * sin).clamp_min(0.0).minimum(length[:, None])
    squared = (x - share * cos).square() + (y - share * sin).square()
    if pieces is not None:
        squared = squared.masked_fill(~pieces[:, None], torch.inf)
    distance = squared.sqrt()
    beside = pad(distance, (1, 1), value=torch.inf)
    lowest = (distance <= beside[..., :-2]) & (distance <= beside[..., 2:])
    lowest &= distance <= distance.amin(-1, keepdim=True) + NEAR
    which = lowest.to(torch.uint8).argmax(-1, keepdim=True)
    if about is not None:
        off = (line.arc[:, None, :-1] + share - about[:, None, None]).abs()
        which = off.masked_fill(~lowest, torch.inf).argmin(-1, keepdim=True)

    def of(values: Tensor) -> Tensor:
        return values.expand_as(squared).gather(-1, which)[..., 0]

    cos, sin, away = of(cos), of(sin), of(distance)
    left = cos * of(y) - sin * of(x)
    return of(line.arc[:, None, :-1]) + of(share), torch.where(left < 0, -away, away), torch.stack([cos, sin], -1)


def _at(line: _Lines, station: Float[Tensor, " P"]) -> Float[Tensor, "P 2"]:
    piece = (torch.searchsorted(line.arc.contiguous(), station[:, None], right=True) - 1)[:, 0]
    piece, row = piece.clamp(0, line.arc.shape[-1] - 2), torch.arange(len(piece), device=piece.device)
    (start, end), (low, high) = ((part[row, piece], part[row, piece + 1]) for part in (line.points, line.arc))
    return start + ((station - low) / (high - low).clamp_min(1e-6))[:, None] * (end - start)


def _unit(heading: Tensor) -> Tensor:
    return torch.stack([heading.cos(), heading.sin()], -1)


def _among(shown: Tensor, states: tuple[SignalState, ...]) -> Tensor:
    return torch.stack([shown == int(state) for state in states]).any(0)
