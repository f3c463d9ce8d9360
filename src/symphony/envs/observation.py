"""What an agent observes (paper, section IV-C): nearest objects and nearest map and light points, in its own frame.

Shapes: M rows (any flattened batch), N observing agents, A agents of the scene, O objects, P points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad
from torchrl.data import Binary, Composite, Unbounded

from symphony.envs.points import observed_lights, observed_points
from symphony.envs.road import road_distance
from symphony.envs.routes import ALONG_FEATURES, ROUTE_FEATURES, along_route, route_ahead
from symphony.envs.scene import SceneBatch
from symphony.envs.tables import AGENT_FEATURES, POINT_FEATURES, Tables
from symphony.geometry.boxes import box_corners, gap_between
from symphony.geometry.constants import constant
from symphony.geometry.frames import rotate, wrap
from symphony.geometry.nearest import nearest, on_host

__all__ = [
    "OBJECT_FEATURES",
    "POINT_FEATURES",
    "SELF_FEATURES",
    "Objects",
    "Observation",
    "ObservationConfig",
    "objects_at",
    "observe",
    "road_distance",
]

SELF_FEATURES = 4
OBJECT_FEATURES = 8 + AGENT_FEATURES


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
        road: whether it observes how far its box is from the edge of the road, and how far its centre would be ahead.
        clearance: whether it observes how far its box is from others and from the edge of the road.
        foresight: seconds ahead at which it also observes how far it would be from others, were everyone to keep
            speed and course; with ``gaps`` or ``clearance`` only, and with ``road`` likewise from the edge.
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
    road: bool = False
    clearance: bool = False
    foresight: tuple[float, ...] = ()
    own: bool = True

    @property
    def blind(self) -> bool:
        """Whether nothing is asked for, a route aside."""
        counts = self.num_objects, self.num_points, self.num_lights
        return not (any(counts) or self.own or self.road or self.clearance)

    @classmethod
    def nothing(cls) -> ObservationConfig:
        """Of agents that look at nothing but their state."""
        return cls(num_objects=0, num_points=0, own=False)


class Objects(NamedTuple):
    """All agents of a scene at one step.

    Attributes:
        state: [M, A, 5] x, y, heading, velocity x, velocity y.
        valid: [M, A].
        size: [M, A, 2].
        kind: [M, A] int64, ``AgentType``.
    """

    state: Tensor
    valid: Tensor
    size: Tensor
    kind: Tensor


class Observation(NamedTuple):
    """Features of the observing agents; masked entries are zero, and what was not asked for is None.

    Attributes:
        own: [M, N, 4] speed, length, width, last logged step reached (0 or 1).
        objects: [M, N, O, 15].
        objects_mask: [M, N, O].
        points: [M, N, P, 23].
        points_mask: [M, N, P].
        lights: [M, N, L, 23] likewise.
        lights_mask: [M, N, L].
        gap: [M, N, O] metres between boxes, negative where they overlap, 0 where masked.
        gap_ahead: [M, N, O, H] likewise at H times ahead.
        road: [M, N, 5] metres of centre and corners off the road, negative on it.
        road_ahead: [M, N, H] likewise of the centre at H times ahead.
        route: [M, N, Fr], see :func:`symphony.envs.routes.route_ahead`.
        along: [M, N, O, Fa], see :func:`symphony.envs.routes.along_route`.
    """

    own: Tensor | None = None
    objects: Tensor | None = None
    objects_mask: Tensor | None = None
    points: Tensor | None = None
    points_mask: Tensor | None = None
    lights: Tensor | None = None
    lights_mask: Tensor | None = None
    gap: Tensor | None = None
    gap_ahead: Tensor | None = None
    road: Tensor | None = None
    road_ahead: Tensor | None = None
    route: Tensor | None = None
    along: Tensor | None = None


def observation_spec(config: ObservationConfig, agents: int, device: torch.device | None = None) -> Composite:
    """Shapes of what each of N agents observes, under the names of :class:`Observation`."""
    widths: dict[str, tuple[int, ...]] = {}
    if config.own:
        widths["own"] = (SELF_FEATURES,)
    if config.num_objects:
        widths["objects"] = (config.num_objects, OBJECT_FEATURES)
    if config.num_points:
        widths["points"] = (config.num_points, POINT_FEATURES)
    if config.num_lights:
        widths["lights"] = (config.num_lights, POINT_FEATURES)
    masks = {f"{name}_mask": width[:1] for name, width in widths.items() if len(width) > 1}
    if config.route:
        widths["route"] = (ROUTE_FEATURES,)
    if config.clearance or config.road:
        widths["road"] = (5,)
    if config.road and config.foresight:
        widths["road_ahead"] = (len(config.foresight),)
    if config.num_objects and (config.clearance or config.gaps):
        widths["gap"] = (config.num_objects,)
        if config.foresight:
            widths["gap_ahead"] = (config.num_objects, len(config.foresight))
    if config.num_objects and config.along:
        widths["along"] = (config.num_objects, ALONG_FEATURES)
    numbers = {name: Unbounded(shape=(agents, *width), device=device) for name, width in widths.items()}
    flags = {
        name: Binary(shape=(agents, *width), dtype=torch.bool, device=device) for name, width in masks.items()
    }
    return Composite({**numbers, **flags}, shape=(agents,))


def objects_at(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    state: Float[Tensor, "M N 4"] | None = None,
    index: Int[Tensor, "M N"] | None = None,
    index_valid: Bool[Tensor, "M N"] | None = None,
) -> Objects:
    """The agents of each row's scene at a step: log playback, with simulated ones put in their place.

    Args:
        scenes: the static part.
        scene: rows of ``scenes``.
        step: logged step (past the end of the log nothing is valid).
        state: x, y, heading, speed of the simulated agents.
        index: their rows among the scene's agents.
        index_valid: which of them are real.
    """
    steps = scenes.log_state.shape[1]
    row = scene * steps + step.clamp(max=steps - 1)
    logged = scenes.log_state.flatten(0, 1).index_select(0, row)
    valid = scenes.log_valid.flatten(0, 1).index_select(0, row)
    valid = valid & (step <= scenes.last_step[scene])[:, None]
    if state is not None and index is not None and index_valid is not None:
        x, y, heading, speed = state.unbind(-1)
        simulated = torch.stack([x, y, heading, speed * heading.cos(), speed * heading.sin()], -1)
        wide = index[..., None].expand(*index.shape, 5)
        if on_host(state) and bool(index_valid.all()):
            logged, valid = logged.scatter(1, wide, simulated), valid.scatter(1, index, True)
        else:
            # Those not there are written to a column past the last one, which is cut off again.
            agents = logged.shape[1]
            column = torch.where(index_valid, index, agents)
            wide = column[..., None].expand_as(wide)
            logged = pad(logged, (0, 0, 0, 1)).scatter(1, wide, simulated)[:, :agents]
            valid = pad(valid, (0, 1)).scatter(1, column, True)[:, :agents]
    return Objects(logged, valid, scenes.box_size[scene], scenes.agent_type[scene])


def observe(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    objects: Objects,
    index: Int[Tensor, "M N"],
    config: ObservationConfig,
    tables: Tables | None = None,
    routes: tuple[Float[Tensor, "M N K 2"], Int[Tensor, "M N"]] | None = None,
) -> Observation:
    """Observation of the agents ``index`` among ``objects``.

    Nearness is the distance between centres. Lanes share their end points, so ties are common: on the CPU they go to
    the elements that come first, whatever the padding, and elements are in the order of the scene.

    Args:
        scenes: the static part.
        scene: rows of ``scenes``.
        step: logged step.
        objects: all agents of each row.
        index: those that observe.
        config: what they see.
        tables: of ``scenes`` and ``config``; whoever observes a batch of scenes more than once keeps them.
        routes: points of the agents' routes and how many of them exist; without, nothing of routes is observed.
    """
    if config.blind and not config.route:
        return Observation()
    tables = Tables(scenes, config) if tables is None else tables
    own = _take(objects.state, index)
    own_size = _take(objects.size, index)
    origin, heading = own[..., :2], own[..., 2]
    speed = rotate(own[..., 3:], -heading)[..., 0]
    features, points, points_mask, road, route = None, None, None, None, None
    lights, lights_mask, road_ahead = None, None, None
    if config.own:
        ends = (step >= scenes.last_step[scene]).to(own.dtype)
        features = torch.cat(
            [
                (speed / config.speed_scale)[..., None],
                own_size / config.size_scale,
                ends[:, None, None].expand(*index.shape, 1),
            ],
            -1,
        )
    seen = _Seen()
    if config.num_objects:
        seen = _observed_objects(tables, scene, objects, index, own, own_size, routes)
    if config.num_points:
        points, points_mask = observed_points(tables, scene, step, origin, heading, speed)
    if config.num_lights:
        lights, lights_mask = observed_lights(tables, scene, step, origin, heading, speed)
    if config.route and routes is not None:
        pose = torch.cat([own[..., :3], speed[..., None]], -1)
        route = route_ahead(pose, *routes, config.distance_scale)
    if config.clearance or config.road:
        places = [origin[..., None, :], box_corners(origin, heading, own_size)]
        if config.road and config.foresight:
            times = constant(config.foresight, own.dtype, own.device)[:, None]
            places.append(origin[..., None, :] + times * own[..., None, 3:])
        queried = torch.cat(places, -2)
        away = road_distance(scenes, scene, queried.flatten(1, 2), tables).unflatten(1, queried.shape[1:3])
        road, ahead = away[..., :5], away[..., 5:]
        road_ahead = ahead if config.road and config.foresight else None
    return Observation(
        own=features,
        objects=seen.features,
        objects_mask=seen.mask,
        points=points,
        points_mask=points_mask,
        lights=lights,
        lights_mask=lights_mask,
        gap=seen.gap,
        gap_ahead=seen.gap_ahead,
        road=road,
        road_ahead=road_ahead,
        route=route,
        along=seen.along,
    )


class _Seen(NamedTuple):
    features: Tensor | None = None
    mask: Tensor | None = None
    gap: Tensor | None = None
    gap_ahead: Tensor | None = None
    along: Tensor | None = None


def _observed_objects(
    tables: Tables,
    scene: Int[Tensor, " M"],
    objects: Objects,
    index: Int[Tensor, "M N"],
    own: Float[Tensor, "M N 5"],
    own_size: Float[Tensor, "M N 2"],
    routes: tuple[Tensor, Tensor] | None,
) -> _Seen:
    config = tables.config
    origin, heading = own[..., :2], own[..., 2]
    agents = objects.state.shape[1]
    with torch.no_grad():
        x, y = (objects.state[:, None, :, k] - origin[..., k, None] for k in (0, 1))
        hidden = ~objects.valid[:, None] | (torch.arange(agents, device=index.device) == index[..., None])
        squared = (x.square() + y.square()).masked_fill(hidden, torch.inf)
        chosen, mask = nearest(squared, config.num_objects)
    shape, flat = chosen.shape, chosen.flatten(1)
    row = (flat + (scene * agents)[:, None]).flatten()
    # Places among all agents there are now, and among those of all scenes.
    now = (flat + torch.arange(0, objects.valid.numel(), agents, device=flat.device)[:, None]).flatten()
    state = objects.state.flatten(0, 1).index_select(0, now).unflatten(0, shape)
    # Whoever is not seen may hold anything, and neither its numbers nor their gradient may get through.
    state = torch.where(mask[..., None], state, 0.0)
    static = tables.agents.index_select(0, row).unflatten(0, shape)
    # Component by component: operations on a last dimension of 2 are slow.
    angle, (_, _, _, own_x, own_y) = -heading[..., None], own[..., None, :].unbind(-1)
    cos, sin = angle.cos(), angle.sin()

    def turned(x: Float[Tensor, "M N O"], y: Float[Tensor, "M N O"], scale: float) -> list[Tensor]:
        return [(cos * x - sin * y) / scale, (sin * x + cos * y) / scale]

    x, y, course, speed_x, speed_y = state.unbind(-1)
    relative = wrap(course + angle)
    dynamic = [
        *turned(x - origin[..., None, 0], y - origin[..., None, 1], config.distance_scale),
        relative.cos(),
        relative.sin(),
        *turned(speed_x, speed_y, config.speed_scale),
        # Elements are encoded one by one, so each must tell how fast it is approached.
        *turned(speed_x - own_x, speed_y - own_y, config.speed_scale),
    ]
    features = torch.cat([torch.stack(dynamic, -1), static], -1) * mask.to(own.dtype)[..., None]
    follows = config.along and routes is not None
    measures = config.clearance or config.gaps
    if not follows and not measures:
        return _Seen(features, mask)
    size = objects.size.flatten(0, 1).index_select(0, now).unflatten(0, shape)
    along = None
    if follows and routes is not None:
        along = along_route(own, own_size, state, size, *routes) * mask[..., None]
    if not measures:
        return _Seen(features, mask, along=along)
    gap = _gaps(config.foresight, own, own_size, state, size)
    gap = torch.where(mask[..., None], gap, 0.0)
    return _Seen(features, mask, gap[..., 0], gap[..., 1:] if config.foresight else None, along)


def _gaps(
    foresight: tuple[float, ...],
    own: Float[Tensor, "M N 5"],
    own_size: Float[Tensor, "M N 2"],
    state: Float[Tensor, "M N O 5"],
    size: Float[Tensor, "M N O 2"],
) -> Float[Tensor, "M N O H"]:
    """Gaps between boxes now and at times ahead, were everyone to keep speed and course."""
    # Times come first, and components apart, so that operations run along everything else.
    times = constant((0.0, *foresight), own.dtype, own.device)[:, None, None, None]
    wide = own[..., None, :]
    x, y = (
        (state[..., k] + times * state[..., 3 + k]) - (wide[..., k] + times * wide[..., 3 + k])
        for k in (0, 1)
    )
    gap = gap_between(x, y, wide[..., 2], own_size[..., None, :], state[..., 2], size)
    return gap.movedim(0, -1).contiguous()


def _take(values: Float[Tensor, "M A F"], index: Int[Tensor, "M K"]) -> Float[Tensor, "M K F"]:
    """Each row's values at its own index."""
    return values.gather(1, index[..., None].expand(*index.shape, values.shape[-1]))
