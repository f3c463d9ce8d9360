"""What an agent observes (paper, section IV-C): nearest objects and nearest map and light points, in its own frame.

Shapes: M rows (any flattened batch), N observing agents, A agents of the scene, O objects, P points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from symphony.envs.flags import road_distance
from symphony.envs.objects import OBJECT_FEATURES, Objects, Observers, everyone_at, observed_objects
from symphony.envs.points import observed_lights, observed_points
from symphony.envs.routes import ALONG_FEATURES, ROUTE_FEATURES, RouteWindow, route_ahead
from symphony.envs.scene import POINT_FEATURES, SceneBatch, Tables
from symphony.geometry.boxes import box_corners

__all__ = ["OBJECT_FEATURES", "POINT_FEATURES"]

SELF_FEATURES = 4


@dataclass(frozen=True)
class ObservationConfig:
    """How much an agent observes and how it is scaled to numbers near one.

    What is not asked for is neither computed nor an entry of a step: simulation without observation costs a fraction.

    Attributes:
        num_objects: nearest agents kept; 0 for no entries of objects.
        num_points: nearest map and light points kept; 0 for no entries of points.
        distance_scale: metres that become 1.
        speed_scale: m/s that become 1.
        size_scale: metres of a box side that become 1.
        num_lights: nearest lights seen beside the points, as a group of their own; 0 for none.
        route: whether it observes the route that is its goal.
        turns: whether whoever chooses a route observes where routes turn and change lanes.
        along: whether it observes where the objects are along that route.
        gaps: whether it observes how far its box is from others.
        persona: whether it knows the style in which it drives, a part of its state.
        clearance: whether it observes how far its box is from others and from the edge of the road.
        foresight: seconds ahead at which it also observes how far it would be from others, were everyone to keep
            speed and course; with ``gaps`` or ``clearance`` only.
        own: whether it observes its own speed and size.
    """

    num_objects: int = 16
    num_points: int = 1000
    num_lights: int = 0
    distance_scale: float = 20.0
    speed_scale: float = 10.0
    size_scale: float = 5.0
    route: bool = False
    turns: bool = False
    along: bool = False
    gaps: bool = False
    persona: bool = False
    clearance: bool = False
    foresight: tuple[float, ...] = ()
    own: bool = True

    @property
    def blind(self) -> bool:
        """Whether nothing is asked for, a route aside."""
        counts = self.num_objects, self.num_points, self.num_lights
        return not (any(counts) or self.own or self.clearance)

    @classmethod
    def nothing(cls) -> ObservationConfig:
        """Of agents that look at nothing but their state."""
        return cls(num_objects=0, num_points=0, own=False)


def observation_spec(config: ObservationConfig, agents: int, device: torch.device | None = None) -> Composite:
    """Shapes of what each of N agents observes."""
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
            spec[name] = Unbounded(shape=(agents, *width), device=device)
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
    """What the agents ``index`` among ``objects`` observe, by the last part of its key (see :mod:`symphony.keys`).

    Of itself an agent observes speed, length, width and whether the last logged step is reached (0 or 1); masked
    entries are zero, and what was not asked for has none. Nearness is the distance between centres. Lanes share their
    end points, so ties are common: on the CPU they go to the elements that come first, whatever the padding, and
    elements are in the order of the scene.

    Args:
        scenes: the static part.
        scene: rows of ``scenes``.
        step: logged step.
        objects: all agents of each row.
        index: those that observe.
        config: what they see.
        tables: of ``scenes`` and ``config``; whoever observes a batch of scenes more than once keeps them.
        routes: what agents see of their routes; without, nothing of routes is observed.
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
        origin = who.origin
        corners = box_corners(origin, who.heading, who.size)
        queried = torch.cat([origin[..., None, :], corners], -2)
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
    """What interactive agents observe in given states, and everyone whom they could see. No environment is needed.

    Args:
        scenes: the static part.
        scene: rows of ``scenes``.
        step: logged step.
        state: x, y, heading, speed of the interactive agents.
        valid: which of them are there.
        config: what they see.
        goal: routes that they follow, -1 for none; without them nothing of routes is observed.
        progress: metres that they have come along them.
        tables: of ``scenes`` and ``config``; whoever observes a batch of scenes more than once keeps them.
    """
    objects = everyone_at(scenes, scene, step, state, valid)
    routes = None
    if goal is not None and progress is not None:
        routes = scenes.routes.of(scene, goal).window(progress)
    index = scenes.interactive.index_select(0, scene)
    return observe(scenes, scene, step, objects, index, config, tables, routes), objects
