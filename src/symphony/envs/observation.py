"""The observation of an agent (paper, section III-C): the nearest objects, map points and lights, in its own frame.

Shapes: M rows (any flattened batch), N observing agents, A agents, O objects, P points of a scene, K points seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from symphony.envs.flags import road_distance
from symphony.envs.objects import OBJECT_FEATURES, Objects, Observers, everyone_at, frame, observed_objects
from symphony.envs.routes import ALONG_FEATURES, ROUTE_FEATURES, RouteWindow, route_ahead
from symphony.envs.scene import LIGHT_COLUMN, POINT_FEATURES, SceneBatch, Tables
from symphony.geometry.boxes import box_corners
from symphony.geometry.frames import levels_apart
from symphony.geometry.nearest import nearest, on_host

SELF_FEATURES = 4
REPAID = 2  # positions in a cell that repay a list of its points
_DISTANCES = 1 << 16  # distances held at a time


@dataclass(frozen=True)
class ObservationConfig:
    """The extent of an agent's observation, and how it is scaled to numbers near one.
    What is not asked for is neither computed nor an entry of a step, which makes a simulation much cheaper.
    """

    num_objects: int = 16  # nearest agents kept; 0 for no entries of objects
    num_points: int = 1000  # nearest map and light points kept; 0 for no entries of points
    num_lights: int = 0  # nearest lights seen beside the points, as a group of their own; 0 for none
    distance_scale: float = 20.0  # metres that become 1
    speed_scale: float = 10.0  # m/s that become 1
    size_scale: float = 5.0  # metres of a box side that become 1
    route: bool = False  # whether it observes the route that is its goal
    along: bool = False  # whether it observes where the objects are along that route
    gaps: bool = False  # whether it observes how far its box is from others
    #: whether it observes how far its box is from others and from the edge of the road
    clearance: bool = False
    #: seconds ahead at which it also observes how far it would be from others if all keep speed and course; with
    #: ``gaps`` or ``clearance`` only
    foresight: tuple[float, ...] = ()
    own: bool = True  # whether it observes its own speed and size

    @property
    def blind(self) -> bool:
        """Whether nothing is observed, except perhaps a route."""
        return not (self.num_objects or self.num_points or self.num_lights or self.own or self.clearance)

    @classmethod
    def nothing(cls) -> ObservationConfig:
        """Return the configuration of agents that observe only their own state."""
        return cls(num_objects=0, num_points=0, own=False)


def observation_spec(config: ObservationConfig, agents: int, device: torch.device | None = None) -> Composite:
    """Return the shapes of what each of N agents observes."""
    others, ahead = config.num_objects, len(config.foresight)
    measures = others if config.clearance or config.gaps else 0
    widths: dict[str, tuple[int, ...]] = {
        "own": (SELF_FEATURES * config.own,),
        "objects": (others, OBJECT_FEATURES),
        "points": (config.num_points, POINT_FEATURES),
        "lights": (config.num_lights, POINT_FEATURES),
        "route": (ROUTE_FEATURES * config.route,),
        "road": (5 * config.clearance,),
        "gap": (measures,),
        "gap_ahead": (measures, ahead),
        "along": (others, ALONG_FEATURES * config.along),
    }
    spec = Composite(shape=(agents,))
    for name, width in widths.items():
        if all(width):
            spec[name] = Unbounded(shape=(agents, *width), device=device, dtype=torch.float32)
            if name in ("objects", "points", "lights"):
                spec[f"{name}_mask"] = Binary(shape=(agents, width[0]), dtype=torch.bool, device=device)
    return spec


def observe(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    objects: Objects,
    index: Int[Tensor, "M N"],
    config: ObservationConfig,
    tables: Tables | None = None,
    routes: RouteWindow | None = None,
) -> dict[str, Tensor]:
    """Return what agents ``index`` among ``objects`` observe, by the last part of its key (see :mod:`symphony.keys`).

    Of itself an agent observes speed, length, width and whether its scene is at the last step (0 or 1); masked
    entries are zero, and what was not asked for is left out. Nearness is the distance between centres. Lanes share
    their end points, so ties are common: on the CPU they go to the elements that come first, whatever the padding,
    and elements are in the order of the scene.

    To observe a batch of scenes more than once, keep its ``tables``. Without ``routes``, what agents see of them,
    nothing of routes is observed.
    """
    if config.blind and not config.route:
        return {}
    tables = Tables(scenes, config) if tables is None else tables
    who = Observers.of(objects, scene, step, index)
    seen: dict[str, Tensor] = {}
    if config.own:
        ends = (step >= scenes.last_step[scene]).to(who.size.dtype)[:, None, None].expand(*index.shape, 1)
        speed = (who.speed / config.speed_scale)[..., None]
        seen["own"] = torch.cat([speed, who.size / config.size_scale, ends], -1)
    if config.num_objects:
        seen |= observed_objects(tables, objects, who, routes)
    if config.num_points:
        seen["points"], seen["points_mask"] = observed_points(tables, who)
    if config.num_lights:
        seen["lights"], seen["lights_mask"] = observed_lights(tables, who)
    if config.route and routes is not None:
        state = torch.cat([who.state[..., :3], who.speed[..., None]], -1)
        seen["route"] = route_ahead(state, routes, config.distance_scale)
    if config.clearance:
        corners = box_corners(who.origin, who.heading, who.size)
        queried = torch.cat([who.origin[..., None, :], corners], -2)
        of_each = None if who.height is None else who.height.repeat_interleave(queried.shape[2], 1)
        road = road_distance(scenes, scene, queried.flatten(1, 2), tables, of_each)
        seen["road"] = road.unflatten(1, queried.shape[1:3])
    return seen


def observe_states(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    state: Float[Tensor, "M N 4"],
    valid: Bool[Tensor, "M N"],
    config: ObservationConfig,
    *,
    goal: Int[Tensor, "M N"] | None = None,
    progress: Float[Tensor, "M N"] | None = None,
    tables: Tables | None = None,
) -> tuple[dict[str, Tensor], Objects]:
    """Return what interactive agents observe in given states, where they are ``valid``, and all objects that they
    could see. No environment is needed.

    Goals are the routes that they follow, -1 for none, ``progress`` the metres that they have come along them;
    without these nothing of routes is observed. Other arguments are those of :func:`observe`.
    """
    objects = everyone_at(scenes, scene, step, state, valid)
    routes = None
    if goal is not None and progress is not None:
        routes = scenes.routes.of(scene, goal).window(progress)
    index = scenes.interactive.index_select(0, scene)
    return observe(scenes, scene, step, objects, index, config, tables, routes), objects


def observed_points(tables: Tables, who: Observers) -> tuple[Float[Tensor, "M N K F"], Bool[Tensor, "M N K"]]:
    """Return features of the nearest points in each agent's frame, on its level, and which of them exist."""
    flat, mask = nearest_points(tables, who.scene, who.state.detach()[..., :2], who.height)
    return _features(tables, who, flat, mask), mask


def observed_lights(tables: Tables, who: Observers) -> tuple[Float[Tensor, "M N L F"], Bool[Tensor, "M N L"]]:
    """Return features of the nearest lights in each agent's frame, however far, on its level, and which exist."""
    position, number = tables.light_points
    with torch.no_grad():
        squared = (position[who.scene][:, None] - who.state[..., None, :2]).square().sum(-1)
        if who.height is not None:
            lights = tables.scenes.point_height.flatten(0, 1)[number[who.scene]]
            squared = squared.masked_fill(levels_apart(lights[:, None], who.height[:, :, None]), torch.inf)
        chosen, mask = nearest(squared, tables.config.num_lights)
        flat = number[who.scene].gather(1, chosen.flatten(1)).unflatten(1, chosen.shape[1:])
    return _features(tables, who, flat, mask), mask


@torch.no_grad()
def nearest_points(
    tables: Tables,
    scene: Int[Tensor, " M"],
    origin: Float[Tensor, "M N 2"],
    height: Float[Tensor, "M N 2"] | None = None,
) -> tuple[Int[Tensor, "M N K"], Bool[Tensor, "M N K"]]:
    """Return numbers of the nearest points among all points of all scenes, and which of them exist. With heights and
    levels, points on other levels do not (see :func:`symphony.geometry.levels_apart`).
    """
    count, total = tables.config.num_points, tables.position[0].shape[1]
    if not on_host(origin) or total <= count:
        return _among_all(tables, scene, origin, height)
    row, here = scene.repeat_interleave(origin.shape[1]), origin.reshape(-1, 2)
    level = None if height is None else height.reshape(-1, 1, 2)
    x, y = np.ascontiguousarray(here.numpy().T)
    cell = tables.point_cells.at(row.numpy(), x, y, REPAID)
    known = np.flatnonzero(cell >= 0)
    flat = torch.zeros(len(row), count, dtype=torch.int64)
    flat.numpy()[known] = tables.point_cells.nearest_points(cell[known], x[known], y[known])
    mask = tables.scenes.point_valid.flatten()[flat]
    rest = torch.from_numpy(cell < 0)
    if level is not None:
        # Cells do not know of levels: where one of the nearest is on another, all are searched.
        rest |= levels_apart(tables.scenes.point_height.flatten(0, 1)[flat], level).any(1)
    for some in rest.nonzero().squeeze(-1).split(max(_DISTANCES // total, 1)):
        found = _among_all(tables, row[some], here[some, None], None if level is None else level[some])
        flat[some], mask[some] = (value.squeeze(1) for value in found)
    return flat.view(*origin.shape[:2], count), mask.view(*origin.shape[:2], count)


def _among_all(
    tables: Tables, scene: Int[Tensor, " M"], origin: Float[Tensor, "M N 2"], height: Tensor | None
) -> tuple[Int[Tensor, "M N K"], Bool[Tensor, "M N K"]]:
    """Return the same as :func:`nearest_points`, from the distances to all points of a scene."""
    x, y = tables.position
    squared = (x[scene][:, None] - origin[..., :1]).square() + (y[scene][:, None] - origin[..., 1:]).square()
    if height is not None:
        away = levels_apart(tables.scenes.point_height[scene][:, None], height[:, :, None])
        squared = squared.masked_fill(away, torch.inf)
    index, mask = nearest(squared, tables.config.num_points)
    return index + (scene * x.shape[1])[:, None, None], mask


def _features(
    tables: Tables, who: Observers, flat: Int[Tensor, "M N K"], mask: Bool[Tensor, "M N K"]
) -> Float[Tensor, "M N K F"]:
    """Return features of the points ``flat`` as agents see them."""
    config, index = tables.config, flat.flatten()
    # A copy of the rows, which nothing else uses yet: what depends on the agent is written over it. That takes half
    # of the time of putting columns together.
    seen = tables.points.index_select(0, index).unflatten(0, flat.shape)
    x, y = seen[..., 0] - who.origin[..., :1], seen[..., 1] - who.origin[..., 1:]
    # Directions are kept apart, as a gradient may still ask for them.
    ahead = seen[..., 2:4].clone().unbind(-1)
    turned = frame(who.heading[..., None])
    written = (*turned(x, y, config.distance_scale), *turned(*ahead))
    for column, values in enumerate(written):
        seen[..., column] = values
    seen[..., 5] = (who.speed / config.speed_scale)[..., None]
    if tables.light is not None:
        light = tables.light.index_select(0, index).unflatten(0, flat.shape).long()
        scenes = tables.scenes
        # Places in the flattened [B, steps]; after the log its last state stays.
        row = who.scene * scenes.light.shape[1] + torch.minimum(who.step, scenes.last_step[who.scene])
        now = scenes.light.flatten(0, 1).index_select(0, row).long()
        state = now.gather(1, light.clamp_min(0).flatten(1)).unflatten(1, light.shape[1:])
        shown = (light >= 0).to(seen.dtype)[..., None]
        dark = torch.zeros_like(seen[..., LIGHT_COLUMN:])
        seen[..., LIGHT_COLUMN:] = dark.scatter(-1, state[..., None], shown)
    # Most maps have enough points, and then there is nothing to mask.
    return seen if on_host(mask) and bool(mask.all()) else seen * mask[..., None]
