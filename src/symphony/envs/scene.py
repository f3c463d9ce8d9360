"""The padded tensors that a simulation reads of run segments: the static part, stored once per segment.

Shapes: B scenes, A agents, N interactive agents, T logged steps, P map and light points, Q lights, E boundary
segments. World frame of the segment, SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import NDArray
from tensordict import TensorClass
from torch import Tensor

from symphony.data.levels import Levels, agent_heights, levels_of
from symphony.data.segment import AgentType, LaneType, MarkType, Polylines, RunSegment, SignalState
from symphony.data.selection import interactive_agents
from symphony.envs.routes import NO_ROUTES, Routes, packed, route_table
from symphony.errors import DataError
from symphony.geometry.cells import EdgeCells, PointCells
from symphony.geometry.nearest import spans
from symphony.geometry.polylines import has_length, segments_of
from symphony.roadgraph import LaneGraph
from symphony.streams import stream_of

if TYPE_CHECKING:
    from symphony.envs.observation import ObservationConfig

SPACING = 2.0  # metres between the points that stand for a polyline in the observation
BOUNDARY_TOLERANCE = 0.02  # metres by which the simplified road boundary may depart from the given one
LONGEST = 20.0  # metres of a piece of boundary where there are levels, unless its points are farther apart
MARGIN = 5.0  # metres beyond the convex hull of the lanes that still belong to the map
COORDINATES = 5  # of a logged state: no field has more of them
BESIDE = 2.5  # metres to either side of the end of a lane within which an agent leaves by it


class PointType(IntEnum):
    """The kind of a point in the observation."""

    LANE = 0
    BIKE_LANE = 1
    BOUNDARY = 2
    ROAD_LINE = 3
    CROSSWALK = 4
    STOP_SIGN = 5
    OTHER = 6
    LIGHT = 7


_MARKS = {
    MarkType.ROAD_LINE: PointType.ROAD_LINE,
    MarkType.CROSSWALK: PointType.CROSSWALK,
    MarkType.STOP_SIGN: PointType.STOP_SIGN,
}


class MapEdge(NamedTuple):
    """The place where a map ends."""

    exits: NDArray[np.float32]  # [X, 4] ends of lanes that go nowhere: x, y and the direction of travel
    # [H, 3] outward normal and offset of the sides of the convex hull of all lanes, MARGIN added: a point p is
    # beyond where normal @ p > offset for one of them
    hull: NDArray[np.float32]


def map_edge(graph: LaneGraph) -> MapEdge:
    """Return where the map of a lane graph ends. A lane goes nowhere if neither it nor a lane beside it has a
    successor: an on-ramp is left by a lane change.
    """
    exits = []
    for lane in graph.usable_lanes.tolist():
        together = (lane, *graph.left[lane], *graph.right[lane])
        if not any(graph.successors[other] for other in together):
            before, end = graph.lines[lane][-2:]
            exits.append(np.concatenate([end, (end - before) / np.linalg.norm(end - before)]))
    outline = shapely.MultiPoint(graph.lane_points[0]).convex_hull
    outline = outline.buffer(MARGIN, join_style="mitre", cap_style="square")
    corners = np.asarray(shapely.orient_polygons(outline).exterior.coords)
    side = np.diff(corners, axis=0)
    normal = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=-1, keepdims=True)
    hull = np.concatenate([normal, (normal * corners[:-1]).sum(-1, keepdims=True)], -1).astype(np.float32)
    # Without lanes nobody is beyond a side of zeros, which says that traffic is open there, too.
    hull = hull if len(hull) else np.zeros((1, 3), np.float32)
    return MapEdge(np.array(exits, np.float32).reshape(-1, 4), hull)


def beyond(position: NDArray[np.floating], edge: MapEdge) -> NDArray[np.bool_]:
    """Return whether positions [..., 2] lie outside of the hull."""
    return np.asarray((position @ edge.hull[:, :2].T > edge.hull[:, 2]).any(-1))


def leaving(before: Tensor, after: Tensor, exits: Tensor, hull: Tensor) -> Bool[Tensor, "M N"]:
    """Return whether a step of agents [M, N, 2] led out of the map: over the end of an exit [M, X, 4], or out of the
    hull [M, H, 3]. Padding is all zeros.
    """
    end, ahead = exits[:, None, :, :2], exits[:, None, :, 2:]
    start, stop = before[:, :, None] - end, after[:, :, None] - end
    along, along_after = (start * ahead).sum(-1), (stop * ahead).sum(-1)
    crosses = (along <= 0) & (along_after > 0)
    share = along / torch.where(crosses, along - along_after, -torch.ones_like(along))
    where = start + share[..., None] * (stop - start)
    aside = where[..., 0] * ahead[..., 1] - where[..., 1] * ahead[..., 0]
    outside = (after[:, :, None] * hull[:, None, :, :2]).sum(-1) > hull[:, None, :, 2]
    return (crosses & (aside.abs() <= BESIDE)).any(-1) | outside.any(-1)


class SceneSource(Protocol):
    """A source from which an environment draws its scenes, such as a store that is larger than memory."""

    interactive: int  # N, interactive agents per scene

    @property
    def dt(self) -> float:
        """Seconds per step of all its scenes; displacements are bounded by it."""
        ...

    @property
    def open_traffic(self) -> bool:
        """Whether its scenes say where their maps end."""
        ...

    def draw(self, count: int, rng: torch.Generator) -> list[int]:
        """Return numbers of different run segments at random (all, if there are fewer)."""
        ...

    def scenes(self, items: Sequence[int]) -> SceneBatch:
        """Return the run segments of these numbers as one batch, which names them in ``segment``."""
        ...


class SceneBatch(TensorClass):
    """B run segments as padded tensors; a mask travels with every padded field. Fields are commented in the source.

    Fields begin with the batch dimension, which their comments leave out. Routes are empty (R = 0) where not asked
    for. Heights and levels, see :mod:`symphony.data.levels`, are empty where no map has roads above each other; exits
    and hull, see :class:`MapEdge`, where the same agents are driven throughout.
    """

    log_state: Tensor  # [T, A, 5] x, y, heading, velocity x, velocity y
    log_valid: Tensor  # [T, A]
    box_size: Tensor  # [A, 2] length, width
    agent_type: Tensor  # [A] int64
    interactive: Tensor  # [N] int64 rows of A; 0 for padding
    interactive_valid: Tensor  # [N]
    enter: Tensor  # [N] int64 step at which the log brings an agent in; 0 for those there from the start
    background: Tensor  # [N] agents that a rule drives, which are not evaluated
    exits: Tensor  # [X, 4] where agents leave the map; zeros for padding
    hull: Tensor  # [H, 3] outline of the map
    last_step: Tensor  # [] int64, the segment's last step
    log_end: Tensor  # [] int64, its last logged step: an earlier one where it goes on past its log
    point: Tensor  # [P, 2]
    point_direction: Tensor  # [P, 2] unit vector along the line, of a light along its lane
    point_type: Tensor  # [P] uint8, PointType
    point_speed: Tensor  # [P] speed limit of the lane, m/s, 0 where unknown
    point_light: Tensor  # [P] int16 row of Q for lights, else -1
    point_valid: Tensor  # [P]
    light: Tensor  # [T, Q] uint8, SignalState
    light_end: Tensor  # [Q, 2] end of the lane that each controls
    edge_start: Tensor  # [E, 2] boundary segments, the drivable side on their left
    edge_end: Tensor  # [E, 2]
    edge_previous: Tensor  # [E] int32 segment that ends where this one starts, -1 if none
    edge_following: Tensor  # [E] int32
    edge_valid: Tensor  # [E]
    agent_height: Tensor  # [T, A, 2] height on the ground and level
    point_height: Tensor  # [P, 2]
    edge_height: Tensor  # [E, 2] of the middle of boundary segments
    stream: Tensor  # [] int64 hash of the segment id, the root of the scene's random numbers
    segment: Tensor  # [] int64 number of the run segment among those that scenes are drawn from
    dt: Tensor  # [] float64 seconds per step, the same in all scenes of a batch
    route_point: Tensor  # [R, 2] points of the feasible routes of the interactive agents, one after the other
    route_first: Tensor  # [N, G] int64 place of the first point of each route
    route_count: Tensor  # [N, G] int64 points of each; 0 for padding
    follow_first: Tensor  # [N, G] the same of the line that is followed, which goes on where lanes beside it do
    follow_count: Tensor  # [N, G]
    route_change: Tensor  # [N, G] metres until each changes lanes; infinite for those that don't
    route_logged: Tensor  # [N] int64 the route nearest to what the log shows, -1 for none

    @property
    def open_traffic(self) -> bool:
        """Whether agents enter and leave, as they do where the scenes say where their maps end."""
        return self.exits.shape[1] + self.hull.shape[1] > 0

    @property
    def routes(self) -> Routes:
        """The feasible routes of the interactive agents."""
        lines = self.follow_first, self.follow_count
        return Routes(self.route_point, self.route_first, self.route_count, lines, self.route_change)

    def whole_route(self, scene: int, agent: int, route: int) -> Tensor:
        """Return points [K, 2] of one route of an interactive agent, as it is followed."""
        begin = int(self.follow_first[scene, agent, route])
        return self.route_point[scene, begin : begin + int(self.follow_count[scene, agent, route])]


def scene(
    segment: RunSegment,
    interactive: int | Sequence[int] = 2,
    graph: LaneGraph | None = None,
    *,
    number: int = 0,
    edge: MapEdge | None = None,
    background: Sequence[bool] | NDArray[np.bool_] | None = None,
) -> SceneBatch:
    """Return one run segment as a batch of one scene, without padding.

    Interactive agents are as many as given, by the paper's rule, or those of given rows, of which a rule drives the
    ``background`` [N]. With the lanes' graph the scene holds their routes; with the edge of the map the traffic is
    open: they enter where the log first has them within the map, and leave at its edge. ``number`` is the segment's
    among those that scenes are drawn from. Raises a :class:`DataError` if the segment has fewer usable agents.
    """
    if isinstance(interactive, int):
        interactive = interactive_agents(segment, interactive).tolist()
    chosen = np.asarray(interactive, np.int64)
    there = segment.valid[chosen] if edge else segment.valid[chosen, :1]
    if edge:
        there = there & ~beyond(segment.position[chosen, :, :2], edge)
    if not there.any(1).all():
        where = "never within the map" if edge else "not valid at the first step"
        raise DataError(f"an interactive agent is {where}", segment=segment.segment_id, field="interactive")
    enter = there.argmax(1)
    tables = [NO_ROUTES] * len(chosen)
    if graph is not None:
        pairs = zip(chosen.tolist(), enter.tolist(), strict=True)
        tables = [route_table(segment, graph, agent, at) for agent, at in pairs]
    taken = packed(tables)
    moving = segment.position[..., :2], segment.heading[..., None], segment.velocity
    levels = levels_of(segment)
    fields: dict[str, Any] = {
        "log_state": np.concatenate(moving, axis=-1).swapaxes(0, 1),
        "log_valid": segment.valid.T,
        "box_size": segment.size[:, :2],
        "agent_type": segment.agent_type.astype(np.int64),
        "interactive": chosen,
        "interactive_valid": np.ones(len(chosen), bool),
        "enter": enter,
        "background": np.zeros(len(chosen), bool) if background is None else np.asarray(background, bool),
        "exits": np.zeros((0, 4), np.float32) if edge is None else edge.exits,
        "hull": np.zeros((0, 3), np.float32) if edge is None else edge.hull,
        "last_step": segment.num_steps - 1,
        "log_end": segment.log_steps - 1,
        "light": segment.signal_state.T.astype(np.uint8),
        "agent_height": agent_heights(segment, levels),
        "stream": stream_of(segment.segment_id),
        "segment": number,
        "dt": np.float64(segment.dt),
        **_edges(segment.road.boundary, levels),
        **_points(segment, levels),
        "route_point": taken.point,
        "route_first": taken.first,
        "route_count": taken.length,
        "follow_first": taken.follow_first,
        "follow_count": taken.follow_length,
        "route_change": taken.change,
        "route_logged": np.array([table.logged for table in tables], np.int64),
    }
    return SceneBatch(
        **{name: torch.from_numpy(np.array(value))[None] for name, value in fields.items()}, batch_size=[1]
    )


def few(size: int) -> int:
    """Return the next of few sizes: multiples of 8, from 32 on four in every doubling; coordinates are kept."""
    step = 1 << max(3, (size - 1).bit_length() - 3)
    return size if size <= COORDINATES else -(-size // step) * step


def collate(scenes: Sequence[SceneBatch], *, shapes: dict[str, list[int]] | None = None) -> SceneBatch:
    """Stack scenes into one batch, padded to the largest of each size.

    Padded steps repeat nothing: they are masked by ``log_valid`` and lie past ``last_step``. ``shapes`` of batches so
    far, by field, let this one be no smaller, and its sizes :func:`few`, for programs that are compiled for shapes:
    their number is at most one, and four for every doubling of a size since the first batch. Agents that are driven
    and steps (:func:`with_few_steps`) are as many as there are. A :class:`DataError` says if time steps differ.
    """
    steps = torch.cat([item.dt for item in scenes])
    if bool((steps != steps[0]).any()):
        lengths = ", ".join(f"{dt:g} s" for dt in sorted(set(steps.tolist())))
        raise DataError(f"segments of different time steps in one batch: {lengths}", field="dt")
    parts, fields = [dict(item.items()) for item in scenes], {}
    if any(part["point_height"].shape[1] for part in parts) or (shapes or {}).get("point_height", [0])[0]:
        like = {"agent": "log_valid", "point": "point_valid", "edge": "edge_valid"}.items()
        for part in (part for part in parts if not part["point_height"].shape[1]):
            part |= {f"{name}_height": torch.zeros(*part[of].shape, 2) for name, of in like}
        if shapes:  # those before may have been of flat maps
            shapes |= {f"{name}_height": [*shapes[of], 2] for name, of in like}
    for name in SceneBatch.__annotations__:
        values = [part[name] for part in parts]
        each = {value.shape[1:] for value in values}
        shape = [max(sizes) for sizes in zip(*each, strict=True)]
        if shapes is not None:
            known = name in (*_AGENT_FIELDS, *_TIMED_FIELDS)
            shape = [*shape[:known], *map(few, shape[known:])]
            before = shapes.get(name, shape)
            timed = name in _TIMED_FIELDS
            shape = shapes[name] = [*shape[:timed], *map(max, shape[timed:], before[timed:])]
        if each == {tuple(shape)}:
            fields[name] = torch.cat(values)
            continue
        fill = -1 if name in _INDEX_FIELDS else 0
        fields[name] = out = values[0].new_full((sum(v.shape[0] for v in values), *shape), fill)
        # Written by NumPy where it can be: some thousand small copies, of which each costs torch a few microseconds.
        host = out.device.type == "cpu"
        into, row = out.numpy() if host else out, 0
        for value in values:
            block = into[row : row + value.shape[0]]
            block[tuple(map(slice, value.shape))] = value.numpy() if host else value
            row += value.shape[0]
    return SceneBatch(**fields, batch_size=[len(fields["stream"])])


def with_few_steps(scenes: SceneBatch) -> SceneBatch:
    """Return scenes with a number of logged steps out of :func:`few`, the last ones padding."""
    found, more = scenes.clone(recurse=False), few(scenes.log_valid.shape[1]) - scenes.log_valid.shape[1]
    for name in _TIMED_FIELDS:
        value = getattr(scenes, name)
        if value.shape[1]:
            setattr(found, name, torch.nn.functional.pad(value, (*(0, 0) * (value.ndim - 2), 0, more)))
    return found


_TIMED_FIELDS = ("log_state", "log_valid", "light", "agent_height")
_INDEX_FIELDS = ("point_light", "edge_previous", "edge_following")
_AGENT_FIELDS = ["interactive", "interactive_valid", "enter", "background"]
_AGENT_FIELDS += ["route_first", "route_count", "follow_first", "follow_count", "route_change", "route_logged"]


def _edges(boundary: Polylines, levels: Levels) -> dict[str, NDArray[Any]]:
    """Return the simplified boundary as segments, with the heights of their middles where there are levels."""
    every = np.column_stack([boundary.points[:, :2].astype(np.float64), np.arange(len(boundary.points))])
    lines = shapely.simplify(shapely.linestrings(every, indices=boundary.line_index), BOUNDARY_TOLERANCE)
    kept = shapely.get_coordinates(lines, include_z=True)[:, 2].astype(np.int64)
    if not levels.flat:  # a bridge that is straight from above rises and falls
        way = np.cumsum(np.hypot(*np.diff(every[:, :2], axis=0, prepend=every[:1, :2]).T))
        kept = np.union1d(kept, np.flatnonzero(np.diff(way // LONGEST)))
    points, line = boundary.points[kept, : 2 if levels.flat else 3].astype(np.float32), boundary.line_index[kept]
    start, end, previous, following = segments_of(points, np.searchsorted(line, np.arange(len(boundary) + 1)))
    # Of two points of a line that differ one after the other.
    pair = np.flatnonzero((line[1:] == line[:-1]) & (points[1:, :2] != points[:-1, :2]).any(-1))
    middle = (points[pair] + points[pair + 1]) / 2
    return {
        **{"edge_start": start, "edge_end": end},
        "edge_previous": previous.astype(np.int32),
        "edge_following": following.astype(np.int32),
        "edge_valid": np.ones(len(start), bool),
        "edge_height": np.zeros((0, 2), np.float32) if levels.flat else levels.at(middle),
    }


def _points(segment: RunSegment, levels: Levels) -> dict[str, NDArray[Any]]:
    """Return lanes, boundary and marks as evenly spaced points, then one point per light."""
    road = segment.road
    bike = np.where(road.lane_type == LaneType.BIKE_LANE, PointType.BIKE_LANE, PointType.LANE)
    marks = np.array([_MARKS.get(MarkType(kind), PointType.OTHER) for kind in road.mark_type], np.int64)
    edge = np.full(len(road.boundary), PointType.BOUNDARY)
    groups: list[tuple[Polylines, NDArray[Any], NDArray[Any]]]
    groups = [(road.lanes, bike, np.nan_to_num(road.speed_limit))]
    groups += [(lines, kind, np.zeros(len(lines))) for lines, kind in ((road.boundary, edge), (road.marks, marks))]
    lights = len(segment.signal_lane)
    ends = np.array([road.lanes[int(lane)][-1, :2] for lane in segment.signal_lane], np.float32)
    ahead = _unit(ends.reshape(-1, 2) - segment.signal_point[:, :2])
    parts = []
    for lines, types, limits in groups:
        where, along, line = _resampled(lines)
        parts.append((where, along, types[line], limits[line], np.full(len(line), -1)))
    number = np.arange(lights)
    parts.append((segment.signal_point, ahead, np.full(lights, PointType.LIGHT), np.zeros(lights), number))
    point, direction, kind, speed, light = map(np.concatenate, zip(*parts, strict=True))
    place = point.astype(np.float32)
    return {
        "point": place[:, :2],
        "point_height": np.zeros((0, 2), np.float32) if levels.flat else levels.at(place),
        "point_direction": direction.astype(np.float32),
        "point_type": kind.astype(np.uint8),
        "point_speed": speed.astype(np.float32),
        "point_light": light.astype(np.int16),
        "point_valid": np.ones(len(light), bool),
        "light_end": ends.reshape(-1, 2),
    }


def _resampled(lines: Polylines) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
    """Return points [P, 3] at most :data:`SPACING` apart along each line (ends included), unit directions [P, 2] and
    the line each belongs to [P]. A line without length is one point with direction 0.
    """
    xy = lines.points.astype(np.float64)
    owner = lines.line_index
    if len(xy) == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    # One running arc length over all lines, a metre apart, lets one interpolation serve all.
    inside, steps = owner[1:] == owner[:-1], np.linalg.norm(np.diff(xy[:, :2], axis=0), axis=-1)
    arc = np.append(0.0, np.where(inside, steps, 1.0)).cumsum()
    first, last = arc[lines.offsets[:-1]], arc[lines.offsets[1:] - 1]
    length = last - first
    # A length within a thousandth of a multiple counts as that multiple, so that rounding adds no point.
    pieces = np.maximum(np.ceil(length / SPACING - 1e-3).astype(np.int64), 1)
    count = np.where(length > 0, pieces + 1, 1)
    line = np.repeat(np.arange(len(lines)), count)
    share = spans(0, count) / np.maximum(count[line] - 1, 1)
    place = first[line] + share * length[line]
    half = np.minimum(0.5 * SPACING, 0.5 * length[line])
    ends = np.minimum(place + half, last[line]), np.maximum(place - half, first[line])

    def at(where: NDArray[np.float64], axes: int) -> NDArray[np.float64]:
        return np.stack([np.interp(where, arc, xy[:, axis]) for axis in range(axes)], -1)

    chord = at(ends[0], 2) - at(ends[1], 2)
    return at(place, 3).astype(np.float32), _unit(chord).astype(np.float32), line


def _unit(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(norm > 1e-6, norm, 1.0)


POINT_FEATURES = 6 + len(PointType) + len(SignalState)
AGENT_FEATURES = 2 + len(AgentType)
LIGHT_COLUMN = 6 + len(PointType)


class Tables:
    """Rows of features, flat indices and cells of scenes, each made when first used; the scenes must not change."""

    def __init__(self, scenes: SceneBatch, config: ObservationConfig) -> None:
        self.scenes, self.config = scenes, config

    def __reduce__(self) -> tuple[type[Tables], tuple[SceneBatch, ObservationConfig]]:
        # A copy, or what travels to another process, makes its own when it needs them.
        return Tables, (self.scenes, self.config)

    @cached_property
    def points(self) -> Float[Tensor, "BP 23"]:
        """A point's features, with its position and direction in the frame of the world, in metres, in the first four
        columns and zeros where they depend on the agent or the time.
        """
        scenes = self.scenes
        rows = scenes.point.new_zeros(scenes.point_valid.numel(), POINT_FEATURES)
        rows[:, :2], rows[:, 2:4] = scenes.point.flatten(0, 1), scenes.point_direction.flatten(0, 1)
        rows[:, 4] = scenes.point_speed.flatten() / self.config.speed_scale
        rows.scatter_(1, 6 + scenes.point_type.flatten().long()[:, None], 1.0)
        return rows

    @cached_property
    def light(self) -> Int[Tensor, " BP"] | None:
        """Row of the lights, -1 for other points; None if there are no lights."""
        return self.scenes.point_light.flatten() if self.scenes.light.shape[2] else None

    @cached_property
    def light_points(self) -> tuple[Tensor, Tensor]:
        """Positions [B, Q, 2] of lights, infinity where a scene has fewer, and numbers [B, Q] among points; Q > 0."""
        scenes = self.scenes
        is_light = (scenes.point_light >= 0) & scenes.point_valid
        # A light is one point; lights come first, each kind in the order of the scene.
        most = max(1, scenes.light.shape[2])
        order = is_light.to(torch.int8).argsort(stable=True, dim=1, descending=True)[:, :most]
        position = scenes.point.gather(1, order[..., None].expand(*order.shape, 2))
        position = position.masked_fill(~is_light.gather(1, order)[..., None], torch.inf)
        first = torch.arange(len(order), device=order.device)[:, None] * scenes.point.shape[1]
        return position, order + first

    @cached_property
    def position(self) -> tuple[Tensor, Tensor]:
        """x and y [B, P] of the points; infinity where there is none."""
        x, y = self.scenes.point.masked_fill(~self.scenes.point_valid[..., None], torch.inf).unbind(-1)
        return x.contiguous(), y.contiguous()

    @cached_property
    def agents(self) -> Float[Tensor, "BA 7"]:
        """The size and kind of agents as they are seen [B * A, 7]."""
        scenes = self.scenes
        size = scenes.box_size.flatten(0, 1) / self.config.size_scale
        rows = size.new_zeros(len(size), AGENT_FEATURES)
        rows[:, :2] = size
        return rows.scatter_(1, 2 + scenes.agent_type.flatten().long()[:, None], 1.0)

    @cached_property
    def edges(self) -> dict[str, Shaped[Tensor, "1 BE ..."]]:
        """The boundary as one scene of B * E segments: start, end, valid, previous, following."""
        scenes = self.scenes
        count, each = scenes.edge_valid.shape
        base = each * torch.arange(count, device=scenes.edge_valid.device)[:, None]

        def flat(index: Int[Tensor, "B E"]) -> Int[Tensor, "1 BE"]:
            return torch.where(index >= 0, index + base, -1).flatten()[None]

        start, end = scenes.edge_start, scenes.edge_end
        return {
            "start": start.flatten(0, 1)[None],
            "end": end.flatten(0, 1)[None],
            "valid": (scenes.edge_valid & has_length(start, end)).flatten()[None],
            "previous": flat(scenes.edge_previous),
            "following": flat(scenes.edge_following),
        }

    @cached_property
    def point_cells(self) -> PointCells:
        """Cells for the nearest points (CPU)."""
        x, y = self.position
        return PointCells(x.numpy(), y.numpy(), self.config.num_points)

    @cached_property
    def edge_cells(self) -> EdgeCells:
        """Cells for the nearest edge of the road (CPU)."""
        start, end, valid, previous, following = (value[0].numpy() for value in self.edges.values())
        return EdgeCells(start, end, valid.reshape(self.scenes.edge_valid.shape), previous, following)
