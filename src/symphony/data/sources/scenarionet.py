"""Reader of ScenarioNet scenarios: one pickle per scenario, converted from nuScenes, nuPlan, Waymo and others.

Pickles can do anything; these are read by :mod:`.safe_pickle`, which admits plain containers and arrays only.

- ``group`` is dataset, map and date or log where the file has them (scenes of one nuScenes drive share them), else
  the id. The ego is the recording vehicle (``sdc_id``). Agents are in file order; their ids are the track's names if
  all are numbers, else their place in the file.
- A box size is the median over the valid states. An ego wider than long (ScenarioNet swaps the two for nuScenes) is
  turned. NuScenes logs the ego's rear axle (see :func:`.base.from_rear_axle`). Its velocities are differences to
  the next position; at the last state of a track, where ScenarioNet writes 0, that of the state before is taken.
- Coordinates are relative to the ego's first position in whole metres; z is as logged, 0 in maps without road edges.
- Successors and neighbours are the source's, or derived from the geometry where it has none (nuScenes) or names all
  lanes of a road (MetaDrive; neighbours of nuPlan): see :func:`_successors`, :func:`_neighbors`. The boundary is the
  road edges, or goes round the union of the drivable areas (``boundary_…``, if all are closed) and the lanes' areas,
  open where no lane goes on. The speed limits of nuScenes and Argoverse 2 are made up, and not taken.
- A light is one row per lane, at the stop point logged, or where the lane begins: so, too, for nuPlan, for which
  ScenarioNet names a place 8 m further on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from symphony.data import segment as schema
from symphony.data.resample import evened, wrap
from symphony.data.segment import AgentType, Bools, LaneType, MarkType, RoadMap, RunSegment, SignalState
from symphony.data.sources import base, lines
from symphony.data.sources.base import Doubles, Item, Reader, located, motion, refuse
from symphony.data.sources.lines import Lane, Lights, Links
from symphony.data.sources.safe_pickle import Array, load_plain
from symphony.errors import DataError

MEETS = 0.5  # metres within which a lane's end meets another's start
TURN = np.deg2rad(60)  # largest angle between the two there
HALF_WIDTH = 1.75  # metres on either side of a centre line that are drivable where the map has no area
MAX_WIDTH = 20.0  # metres on either side of a line in which the edge of its area is sought
BESIDE = (2.0, 5.5)  # metres between the centre lines of neighbours

_STATE = {"valid": 1, "position": 3, "heading": 1, "velocity": 2, "length": 1, "width": 1, "height": 1}
"""Entries of a track's state, and how many numbers each has at a step."""
_TYPES = {kind.name: kind for kind in AgentType}
_COLORS = {"GREEN": SignalState.GO, "YELLOW": SignalState.CAUTION, "RED": SignalState.STOP}
_LIGHTS = {f"LANE_STATE_{state.name}": state for state in SignalState}
_LIGHTS |= {f"TRAFFIC_LIGHT_{color}": state for color, state in _COLORS.items()}
_LIGHTS |= dict.fromkeys(("TRAFFIC_LIGHT_UNKNOWN", "None"), SignalState.UNKNOWN)
_LANES = {f"LANE_{kind.name}": kind for kind in LaneType}
_LANES |= {"LANE_UNKNOWN": LaneType.UNDEFINED, "LANE_SURFACE_UNSTRUCTURE": LaneType.SURFACE_STREET}
_AREAS = {kind.name: kind for kind in (MarkType.CROSSWALK, MarkType.SPEED_BUMP, MarkType.DRIVEWAY)}
_REAR_AXLE = _NO_LIMITS = frozenset({"nuscenes", "av2"})
"""Datasets without speed limits: ScenarioNet writes 100 km/h for connectors, and 85 mph for all lanes."""


class ScenarioNetReader(Reader):
    """Reads ScenarioNet pickles."""

    name = "scenarionet"
    patterns = ("sd_*.pkl", "[0-9]*.pkl")

    def _read(self, path: Path) -> Iterator[Item]:
        scenario = load_plain(path)
        name = scenario.get("id") if isinstance(scenario, dict) else None
        if not isinstance(name, str) or not name:
            raise DataError("missing; is this a ScenarioNet scenario?", field="id")
        with located(segment=name[:200]):
            yield _segment(scenario, name, path.name)


def _segment(scenario: Mapping[Any, Any], name: str, file: str) -> RunSegment:
    with located(field="metadata"):
        metadata = scenario["metadata"]
        times = _numbers(metadata["ts"], "ts", scenario["length"], 1)[:, 0]
        steps, ego, dataset = len(times), metadata["sdc_id"], _text(metadata.get("dataset"))
        place, date = metadata.get("map"), metadata.get("date", metadata.get("log_name"))
        refuse(not 2 <= steps <= schema.MAX_STEPS, f"{steps} steps, expected 2 … {schema.MAX_STEPS}")
        refuse(not dataset, "names no dataset", "metadata: dataset")
        current = int(metadata.get("current_time_index") or 0)
        refuse(not 0 <= current < steps, f"{current} outside the {steps} steps", "metadata: current_time_index")
        marked = [list(metadata.get(name) or ()) for name in ("objects_of_interest", "tracks_to_predict")]
        dt = base.time_step(times, "metadata: ts")
    names, kinds, states, valid = _tracks(scenario, steps)
    refuse(ego not in names, "names no track that is valid at some step", "metadata: sdc_id")
    row = names.index(ego)
    origin = np.append(np.round(states[row, np.argmax(valid[row]), :2]), 0.0)
    road, lanes = _map(scenario, dataset, origin)
    found = _signals(scenario.get("dynamic_map_states") or {}, lanes, steps, dataset)
    if dataset == "nuscenes":
        # The last of consecutive valid states gets the velocity of the one before.
        last = valid[:, 1:] & valid[:, :-1] & ~np.pad(valid[:, 2:], ((0, 0), (0, 1)))
        states[:, 1:, 4:6][last] = states[:, :-1, 4:6][last]
    if dataset in _REAR_AXLE:
        states[row] = base.from_rear_axle(states[row], (0, 1, 3, 4, 5), valid[row], dt)
    interest, predict = (np.array([names.index(k) for k in each if k in names], np.int32) for each in marked)
    numeric = all(each.isdecimal() and len(each) < 18 for each in names)
    segment = RunSegment(
        segment_id=name.replace("/", "_"),
        source=ScenarioNetReader.name,
        dt=dt,
        ego=row,
        agent_id=np.array([int(each) for each in names] if numeric else range(len(names)), np.int64),
        agent_type=np.array(kinds, np.uint8),
        size=_sizes(states[..., 6:], valid, row),
        **motion(states[..., :3] - origin, states[..., 3], states[..., 4:6], valid),
        road=road,
        **lines.lights(found, steps, origin),
        origin=origin,
        current_step=current,
        interest=interest,
        predict=predict,
        file=file,
        group=f"{dataset} {place} {date}" if isinstance(place, str) and isinstance(date, str) else "",
    )
    return evened(segment, times)


def _tracks(scenario: Mapping[Any, Any], steps: int) -> tuple[list[str], list[int], Doubles, Bools]:
    """Return names [A], types [A], states [A, T, 9] and where they are valid [A, T], of tracks valid at some step."""
    found: list[tuple[str, int, Doubles, Bools]] = []
    nothing = Array()  # the sides of what names none: the cones of MetaDrive
    nothing.value = np.zeros(steps)
    with located(field="tracks"):
        tracks = scenario["tracks"].items()
        schema.check_counts(len(tracks), steps, "tracks")
    for key, track in tracks:
        with located(field=f"tracks {str(key)[:60]}"):
            state = dict.fromkeys(("length", "width", "height"), nothing) | track["state"]
            parts = [_numbers(state[name], name, steps, width) for name, width in _STATE.items()]
            valid = parts[0][:, 0] > 0
            states = np.where(valid[:, None], np.concatenate(parts[1:], axis=1), 0.0)
            if valid.any():
                found.append((str(key), _TYPES.get(_text(track["type"]), AgentType.OTHER), states, valid))
    refuse(not found, "has no agents", "tracks")
    names, kinds, all_states, masks = zip(*found, strict=True)
    return list(names), list(kinds), np.stack(all_states), np.stack(masks)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""  # not str(): what holds itself many times has no end


def _numbers(value: Array, name: str, steps: Any, width: int) -> Doubles:
    """Return [T, width] from an array of numbers [T, width], or [T] for a width of 1; refuse any other. More numbers
    than one a step may be followed by others: a height, where only x and y are asked for.
    """
    found = value.value
    columns = found.shape[1] if found.ndim == 2 else 2 - found.ndim
    fits = columns >= width > 1 or columns == width == 1
    fits &= found.dtype.kind in "bfiu" and found.shape[:1] == (steps,)
    refuse(not fits, f"{name}: {found.dtype} {found.shape} for {width} numbers at {str(steps)[:20]} steps")
    return found.astype(np.float64).reshape(-1, columns)[:, :width]


def _sizes(sizes: Doubles, valid: Bools, ego: int) -> schema.Floats:
    """Return [A, 3] from [A, T, 3]; the ego is at least as long as wide."""
    found = np.array([np.median(size[mask], axis=0) for size, mask in zip(sizes, valid, strict=True)])
    found[ego, :2] = np.sort(found[ego, :2])[::-1]
    return base.to_float32(found)


def _signals(states: Any, lanes: Sequence[Lane], steps: int, dataset: str) -> Lights:
    index = {lane.name: k for k, lane in enumerate(lanes)}
    found: Lights = {}
    with located(field="dynamic_map_states"):
        for key, light in states.items():
            lane = index.get(str(light.get("lane", key)))
            logged = light["state"]["object_state"]
            logged = [_LIGHTS[str(state)] for state in getattr(logged, "value", logged)]
            here, count = f"dynamic_map_states {key}", len(logged)
            refuse(count != steps, f"{count} states for {steps} steps", here)
            if lane is None or lane in found:
                continue
            stop = light.get("stop_point")
            place = np.zeros((0, 3)) if stop is None else _points([stop])
            # Zeros are what ScenarioNet begins with, for a point that is never named.
            if not place.any() or dataset == "nuplan":
                place = lanes[lane].line[:1]
            found[lane] = np.pad(place[0], (0, 3 - place.shape[1])), logged
    return found


def _map(scenario: Mapping[Any, Any], dataset: str, origin: Doubles) -> tuple[RoadMap, list[Lane]]:
    """Return the map relative to an origin [3], and its lanes in the source's coordinates."""
    lanes: list[Lane] = []
    areas: list[Doubles | None] = []
    edges: list[Doubles] = []
    outlines: list[Doubles] = []
    pieces: list[Doubles] = []
    marks: list[tuple[Doubles, MarkType]] = []
    told = False
    with located(field="map_features"):
        features = scenario["map_features"].items()
    for key, node in features:
        with located(field=f"map_features {str(key)[:60]}"):
            kind = _text(node["type"])
            line, area = (_points(node.get(name, ())) for name in ("polyline", "polygon"))
            if dataset == "nuscenes":
                line = line[:, :2]  # the third number is a heading
            if kind in _LANES and len(line):
                told |= node.get("exit_lanes") is not None and dataset != "metadrive"
                areas.append(area[:, :2] if len(area) > 2 else None)
                lanes.append(_lane(str(key), node, line, areas[-1], dataset))
            elif kind.startswith("ROAD_EDGE") and len(line) > 1:
                edges.append(line)
            elif kind in _AREAS and len(area if len(area) else line) > 2:
                ring = area if len(area) else line
                marks.append((np.concatenate([ring, ring[:1]]), _AREAS[kind]))
            elif kind == "STOP_SIGN":
                marks.append((_points([node.get("position", ())]), MarkType.STOP_SIGN))
            elif str(key).startswith("boundary_") and len(line) > 1:
                closed = len(line) > 3 and bool((np.abs(line[0] - line[-1]) < 0.01).all())
                (outlines if closed else pieces).append(line[:, :2])
            elif kind.startswith("ROAD_LINE") and len(line) > 1:
                marks.append((line, MarkType.ROAD_LINE))
    refuse(not lanes, "has no lanes", "map_features")
    if pieces:
        # Long rings were cut up (Argoverse 2): without them, the islands that are whole would be all the road.
        marks += [(line, MarkType.ROAD_LINE) for line in outlines + pieces]
        outlines = []
    links = [(a, b) for a, b in lines.named(lanes, "successors") if a != b] if told else _successors(lanes)
    beside = None if any(lane.left or lane.right for lane in lanes) else _neighbors(lanes, areas)
    flow = base.pairs(links)
    if not edges:  # the boundary made here has no heights: lanes that kept theirs would be other levels
        lanes = [replace(lane, line=lane.line[:, :2]) for lane in lanes]
        edges = lines.opened(_rings(lanes, areas, outlines), _cuts(lanes, flow))
    numbers = range(len(lanes))
    return lines.road_map(lanes, origin, edges, marks, links=flow, beside=beside, ids=numbers), lanes


def _lane(name: str, node: Mapping[Any, Any], line: Doubles, area: Doubles | None, dataset: str) -> Lane:
    limit = node.get("speed_limit_kmh")
    known = isinstance(limit, int | float) and 0 < limit < 300 and dataset not in _NO_LIMITS
    # Of these, ScenarioNet names all lanes of a road, of nuPlan in an order that need not be theirs.
    told = {} if dataset in {"nuplan", "metadrive"} else node
    left, right = (_references(told.get(f"{side}_neighbor") or ()) for side in ("left", "right"))
    return Lane(
        name=name,
        line=line,
        kind=_LANES[str(node["type"])],
        width=_width(line, area),
        speed_limit=float(limit) / 3.6 if known and limit is not None else np.nan,
        successors=_references(node.get("exit_lanes") or ()),
        left=left,
        right=right,
    )


def _references(values: Any) -> tuple[str, ...]:
    if isinstance(values, Array):
        values = values.value.ravel().tolist()
    refuse(not isinstance(values, list | tuple), "links that are no list")
    return tuple(str(v.get("feature_id")) if isinstance(v, dict) else str(v) for v in values)


def _successors(lanes: Sequence[Lane]) -> list[tuple[int, int]]:
    """Return which lanes succeed others: those within :data:`MEETS` of an end, turned by less than :data:`TURN`."""
    starts, ends = (shapely.points(np.array([lane.line[row, :2] for lane in lanes])) for row in (0, -1))
    before, after = shapely.STRtree(starts).query(ends, predicate="dwithin", distance=MEETS)
    out, into = (np.array([_course(lane.line, row) for lane in lanes]) for row in (-1, 0))
    good = (np.abs(wrap(into[after] - out[before])) < TURN) & (before != after)
    return list(zip(before[good].tolist(), after[good].tolist(), strict=True))


def _course(line: Doubles, row: int) -> float:
    """Return the direction of the first or last piece; NaN, which is near no angle, of a single point."""
    step = np.diff(line[:, :2], axis=0)
    step = step[np.hypot(*step.T) > 1e-6]
    return float(np.arctan2(*step[row][::-1])) if len(step) else np.nan


def _neighbors(lanes: Sequence[Lane], areas: Sequence[Doubles | None]) -> tuple[Links, Links]:
    """Return left and right neighbours: lanes whose areas touch and whose lines lie side by side."""
    flat = [k for k, area in enumerate(areas) if area is not None and len(lanes[k].line) > 1]
    shapes = shapely.make_valid(np.array([shapely.Polygon(areas[k]) for k in flat]))
    one, two = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=0.2)
    found: list[tuple[int, int]] = []
    for a, b in ((flat[i], flat[j]) for i, j in zip(one.tolist(), two.tolist(), strict=True) if i < j):
        side = _side(lanes[a].line, lanes[b].line)
        if side:
            found.append((a, b) if side > 0 else (b, a))
    return base.pairs(found), base.pairs([(b, a) for a, b in found])


def _side(one: Doubles, two: Doubles) -> int:
    """Return 1 if the second line runs along on the left of the first, -1 on its right, else 0. At the middle of the
    shorter one they must be :data:`BESIDE` apart and run the same way.
    """
    both = [shapely.LineString(line[:, :2]) for line in (one, two)]
    short, long = sorted(both, key=lambda line: line.length)
    if short.length < 1:
        return 0
    half = short.length / 2
    spot = short.interpolate(half)
    there = long.project(spot)
    if not BESIDE[0] <= spot.distance(long) <= BESIDE[1] or not 0.5 < there < long.length - 0.5:
        return 0
    places = ((short, half), (long, there))
    pieces = [np.array([line.interpolate(at + d).coords[0] for d in (-0.5, 0.5)]) for line, at in places]
    along, onward = (piece[1] - piece[0] for piece in pieces)
    across = pieces[1].mean(axis=0) - pieces[0].mean(axis=0)
    if along @ onward < np.cos(TURN / 2) * np.hypot(*along) * np.hypot(*onward):
        return 0
    turn = 1 if along[0] * across[1] - along[1] * across[0] > 0 else -1
    return turn if short is both[0] else -turn


def _width(line: Doubles, outline: Doubles | None) -> float:
    """Return the metres of the area across the middle of the line; NaN where there is no area there."""
    if outline is None or len(line) < 2:
        return np.nan
    shape = shapely.LineString(line[:, :2])
    half = shape.length / 2
    if half < 0.1:
        return np.nan
    before, middle, after = (np.array(shape.interpolate(half + d).coords[0]) for d in (-0.1, 0, 0.1))
    along = (after - before) / np.hypot(*(after - before))
    aside = MAX_WIDTH * np.array([-along[1], along[0]])
    area = shapely.make_valid(shapely.Polygon(outline))
    parts = shapely.get_parts(area.intersection(shapely.LineString([middle - aside, middle + aside])))
    here = [part.length for part in parts if part.distance(shapely.Point(middle)) < 0.1]
    return float(max(here, default=np.nan))


def _rings(
    lanes: Sequence[Lane], areas: Sequence[Doubles | None], outlines: Sequence[Doubles]
) -> tuple[Doubles, ...]:
    """Return rings around the outlined areas, where one inside another is a hole, and those of lanes. Without
    outlines, lanes that have no area are :data:`HALF_WIDTH` wide on either side.
    """
    try:
        area = shapely.Polygon()
        for outline in outlines:
            area = area.symmetric_difference(shapely.make_valid(shapely.Polygon(outline)))
        if not outlines:
            bare = [lane.line[:, :2] for lane, own in zip(lanes, areas, strict=True) if own is None]
            strips = [shapely.LineString(line).buffer(HALF_WIDTH) for line in bare if len(line) > 1]
            area = shapely.union_all(strips)
    except shapely.errors.ShapelyError as error:
        raise DataError(f"the union of the areas can't be formed: {error}", field="map_features") from error
    parts = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon"]
    return lines.drivable_rings([*(own for own in areas if own is not None), *parts], field="map_features")


def _cuts(lanes: Sequence[Lane], links: Links) -> Doubles:
    """Return lines across the ends where no lane goes on, as wide as the lane and a little more."""
    bounds = []
    for lane in lanes:
        half = lane.width / 2 if lane.width > 0 else HALF_WIDTH
        courses = [_course(lane.line, row) for row in (0, -1)]
        aside = (min(half, 4.0) + 1.0) * np.array([(-np.sin(course), np.cos(course)) for course in courses])
        bounds.append((lane.line[[0, -1], :2] + aside, lane.line[[0, -1], :2] - aside))
    cuts = lines.cut_ends(bounds, links)
    return cuts[np.isfinite(cuts).all(axis=(1, 2))]


def _points(value: Any) -> Doubles:
    """Return [P, 2 or 3] points in any notation; refuse what are no points, or not finite."""
    if isinstance(value, list | tuple):
        rows = [row.value.tolist() if isinstance(row, Array) else row for row in value]
        # Checked one by one: lists in lists may be larger than any memory.
        fine = (len(row) in {2, 3} and all(isinstance(n, int | float) for n in row) for row in rows)
        refuse(not all(fine), "not a list of points")
        found = np.array(rows, np.float64)
    else:
        refuse(value.value.dtype.kind not in "bfiu", f"{value.value.dtype}, expected points")
        found = value.value.astype(np.float64)
    if found.size == 0:
        return np.zeros((0, 2))
    refuse(found.ndim != 2 or found.shape[1] not in {2, 3}, f"shape {found.shape}, expected [points, 2 or 3]")
    return base.finite(found)
