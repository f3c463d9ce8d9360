"""Reader of ScenarioNet scenarios: one pickle per scenario, converted from nuScenes, nuPlan, Waymo and others.

Pickles can do anything; these are read by :mod:`.safe_pickle`, which admits plain containers and arrays only.

How the format maps onto :class:`~symphony.data.segment.RunSegment`:

- ``segment_id`` is the scenario's ``id``. ``group`` is dataset, map and date or log where the file has them (scenes
  of one nuScenes drive share them, scenarios of one nuPlan log), else the id.
- The ego is the recording vehicle (``sdc_id``). Agents are in file order; their ids are the track's names if all are
  numbers, else their place in the file, as the ego's is. Tracks that are valid at no step are left out.
- A box size is the median over the valid states. An ego wider than long (ScenarioNet swaps the two for nuScenes) is
  turned. The position of nuScenes' ego is that of its rear axle, as logged. Cones, barriers and other things are of
  type OTHER.
- Velocities of nuScenes are differences to the next position; at the last state of a track, where ScenarioNet writes
  0, that of the state before is taken.
- Coordinates are taken relative to the ego's first position, rounded to metres, z as logged; maps of nuScenes have
  none.
- Successors and neighbours are the source's, or derived from the geometry where it has none (nuScenes): see
  :func:`.scenarionet_map.successors` and :func:`.scenarionet_map.neighbors`.
- The boundary is the road edges, or goes round the union of the drivable areas (``boundary_…``, if all are closed)
  and the lanes' areas, open where no lane goes on. nuScenes and Argoverse 2 have no speed limits; the 100 km/h and
  85 mph in their files are not taken.
- A light is one row per lane, at the stop point logged, or where the lane begins: so, too, for nuPlan, for which
  ScenarioNet names a place 8 m further on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import MAX_STEPS, check_counts
from symphony.data.resample import evened
from symphony.data.segment import AgentType, Bools, RunSegment, SignalState
from symphony.data.sources.base import Item, Reader, time_step, to_float32
from symphony.data.sources.lines import Doubles, Lane, lights
from symphony.data.sources.safe_pickle import Array, load_plain
from symphony.data.sources.scenarionet_map import mapping, points, read_map
from symphony.errors import DataError

_TYPES = {
    "VEHICLE": AgentType.VEHICLE,
    "PEDESTRIAN": AgentType.PEDESTRIAN,
    "CYCLIST": AgentType.CYCLIST,
    "UNSET": AgentType.UNSET,
}
_LIGHTS = {f"LANE_STATE_{state.name}": state for state in SignalState} | {
    "TRAFFIC_LIGHT_GREEN": SignalState.GO,
    "TRAFFIC_LIGHT_YELLOW": SignalState.CAUTION,
    "TRAFFIC_LIGHT_RED": SignalState.STOP,
    "TRAFFIC_LIGHT_UNKNOWN": SignalState.UNKNOWN,
    "None": SignalState.UNKNOWN,
}


class ScenarioNetReader(Reader):
    """Reads ScenarioNet pickles."""

    name = "scenarionet"
    patterns = ("sd_*.pkl", "[0-9]*.pkl")

    def _read(self, path: Path) -> Iterator[Item]:
        scenario = mapping(load_plain(path), "the file")
        name = scenario.get("id")
        if not isinstance(name, str) or not name:
            raise DataError("missing; is this a ScenarioNet scenario?", field="id")
        try:
            # Absurd numbers may overflow on the way: the result is not finite, which validation reports.
            with np.errstate(over="ignore", invalid="ignore"):
                yield _segment(scenario, name, path.name)
        except DataError as error:
            raise error.at(segment=name[:200]) from error


def _segment(scenario: Mapping[Any, Any], name: str, file: str) -> RunSegment:
    metadata = mapping(scenario.get("metadata"), "metadata")
    times = _numbers(metadata.get("ts"), "metadata: ts", 1)[:, 0]
    steps = len(times)
    if scenario.get("length") != steps or not 2 <= steps <= MAX_STEPS:
        raise DataError(f"{steps} for {str(scenario.get('length'))[:20]} steps", field="metadata: ts")
    dt = time_step(times, "metadata: ts")
    names, kinds, states, valid = _tracks(mapping(scenario.get("tracks"), "tracks"), steps)
    ego = metadata.get("sdc_id")
    if not isinstance(ego, str) or ego not in names:
        raise DataError("names no track that is valid at some step", field="metadata: sdc_id")
    row = names.index(ego)
    origin = np.round(states[row, np.argmax(valid[row]), :3])
    origin[2] = 0
    dataset = str(metadata.get("dataset", ""))
    road, lanes = read_map(mapping(scenario.get("map_features"), "map_features"), dataset, origin)
    found = _signals(scenario.get("dynamic_map_states") or {}, lanes, steps, dataset)
    if dataset == "nuscenes":
        _carry_velocity(states[..., 4:6], valid)
    numeric = all(each.isdecimal() and len(each) < 18 for each in names)
    segment = RunSegment(
        segment_id=name.replace("/", "_"),
        source=ScenarioNetReader.name,
        dt=dt,
        ego=row,
        agent_id=np.array([int(each) for each in names] if numeric else range(len(names)), np.int64),
        agent_type=np.array(kinds, np.uint8),
        size=_sizes(states[..., 6:], valid, row),
        position=to_float32(np.where(valid[..., None], states[..., :3] - origin, 0.0)),
        heading=to_float32(states[..., 3]),
        velocity=to_float32(states[..., 4:6]),
        valid=valid,
        road=road,
        **lights(found, steps, origin),
        origin=origin,
        file=file,
        group=_group(metadata, dataset),
    )
    return evened(segment, times)


def _group(metadata: Mapping[Any, Any], dataset: str) -> str:
    place, date = metadata.get("map"), metadata.get("date", metadata.get("log_name"))
    return f"{dataset} {place} {date}" if isinstance(place, str) and isinstance(date, str) else ""


_STATE = (("position", 3), ("heading", 1), ("velocity", 2), ("length", 1), ("width", 1), ("height", 1))


def _tracks(tracks: Mapping[Any, Any], steps: int) -> tuple[list[str], list[int], Doubles, Bools]:
    """(names [A], types [A], states [A, T, 9] with 0 where not valid, valid [A, T]) of those valid at some step."""
    check_counts(len(tracks), steps, "tracks")
    names: list[str] = []
    kinds: list[int] = []
    states: list[Doubles] = []
    masks: list[Bools] = []
    for key, value in tracks.items():
        field = f"tracks {str(key)[:60]}"
        track = mapping(value, field)
        state = mapping(track.get("state"), f"{field}: state")
        valid = _numbers(state.get("valid"), f"{field}: valid", 1)[:, 0] > 0
        parts = [_numbers(state.get(name), f"{field}: {name}", width) for name, width in _STATE]
        for (name, _), part in zip((("valid", 1), *_STATE), (valid, *parts), strict=True):
            if len(part) != steps:
                raise DataError(f"{len(part)} states for {steps} steps", field=f"{field}: {name}")
        if valid.any():
            names.append(str(key))
            kinds.append(_TYPES.get(str(track.get("type")), AgentType.OTHER))
            states.append(np.where(valid[:, None], np.concatenate(parts, axis=1), 0.0))
            masks.append(valid)
    if not names:
        raise DataError("has no agents", field="tracks")
    return names, kinds, np.stack(states), np.stack(masks)


def _numbers(value: Any, field: str, width: int) -> Doubles:
    """[N, width] of an array of numbers, [N] or [N, width or more]; a :class:`DataError` if it is none."""
    found = value.value if isinstance(value, Array) else value
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "bfiu" or found.ndim not in {1, 2}:
        raise DataError(f"expected an array of numbers, is {type(found).__name__}", field=field)
    found = found.reshape(len(found), -1) if found.size else found.reshape(0, width)
    if found.shape[1] < width:
        raise DataError(f"{found.shape[1]} numbers a step, expected {width}", field=field)
    return found[:, :width].astype(np.float64)


def _sizes(sizes: Doubles, valid: Bools, ego: int) -> NDArray[np.float32]:
    """[A, 3] from [A, T, 3]; the ego is at least as long as wide."""
    found = np.array([np.median(size[mask], axis=0) for size, mask in zip(sizes, valid, strict=True)])
    found[ego, :2] = np.sort(found[ego, :2])[::-1]
    return to_float32(found)


def _carry_velocity(velocity: Doubles, valid: Bools) -> None:
    """Give the last of consecutive valid states the velocity [A, T, 2] of the one before."""
    last = valid[:, 1:] & valid[:, :-1] & ~np.pad(valid[:, 2:], ((0, 0), (0, 1)))
    velocity[:, 1:][last] = velocity[:, :-1][last]


def _signals(
    states: Any, lanes: Sequence[Lane], steps: int, dataset: str
) -> dict[int, tuple[Doubles, list[int]]]:
    """Lane -> (stop point [3], state [T])."""
    index = {lane.name: k for k, lane in enumerate(lanes)}
    found: dict[int, tuple[Doubles, list[int]]] = {}
    for key, value in mapping(states, "dynamic_map_states").items():
        field = f"dynamic_map_states {str(key)[:60]}"
        light = mapping(value, field)
        lane = index.get(str(light.get("lane", key)))
        logged = mapping(light.get("state"), f"{field}: state").get("object_state")
        logged = logged.value.tolist() if isinstance(logged, Array) else logged
        if not isinstance(logged, list | tuple) or len(logged) != steps:
            raise DataError(f"expected {steps} states", field=f"{field}: object_state")
        unknown = [state for state in logged if str(state) not in _LIGHTS]
        if unknown:
            raise DataError(f"unknown value {str(unknown[0])[:40]!r}", field=f"{field}: object_state")
        if lane is None or lane in found:
            continue
        stop = light.get("stop_point")
        place = np.zeros((0, 3)) if stop is None else points([stop], f"{field}: stop_point")
        # Zeros are what ScenarioNet begins with, for a point that is never named.
        if not place.any() or dataset == "nuplan":
            place = lanes[lane].line[:1]
        found[lane] = np.pad(place[0], (0, 3 - place.shape[1])), [_LIGHTS[str(state)] for state in logged]
    return found
