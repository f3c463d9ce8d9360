"""Reader of the Waymo Open Motion Dataset: ``Scenario`` records in TFRecord files.

- ``segment_id`` is the scenario id; the ego is the recording vehicle (``sdc_track_index``). Coordinates are relative
  to its first valid position, rounded to metres, before they become float32.
- A box size is the one logged at ``current_time_index``, or the median over the valid states where the track is not
  valid then. Tracks that are valid at no step are left out.
- Road edges of either kind are the boundary; they come oriented with the drivable side on the left. Polygons become
  closed rings among the marks.
- Lanes without points and road edges of fewer than two are left out, as are references (exits, neighbours, lights,
  objects of interest) to anything that is not in the record.
- A light is one row per lane that has a state at any step; its stop point is the first one logged.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from google.protobuf.message import DecodeError

from symphony.data import segment as schema
from symphony.data.resample import evened
from symphony.data.segment import AgentType, Bools, LaneType, MarkType, RunSegment, SignalState
from symphony.data.sources import base, lines
from symphony.data.sources import womd_pb2 as pb
from symphony.data.sources.base import Doubles, Item, Reader, motion, refuse
from symphony.data.sources.lines import Codes, Lane, Lights, Mark
from symphony.errors import DataError

MAX_RECORD = 32 << 20
"""Bytes of a record; a scenario has about one million, and takes many times as much once it is parsed."""
_HEADER, _CHECK = struct.Struct("<QI"), struct.Struct("<I")


def masked_crc32c(data: bytes) -> int:
    """Return the CRC-32C rotated right by 15 bits plus a constant: a CRC of data that holds CRCs stays sound."""
    crc = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def read_records(path: Path) -> Iterator[bytes | DataError]:
    """Yield the payload of each record; both checksums are verified.

    A payload with a wrong checksum, or of more than :data:`MAX_RECORD` bytes, is yielded as a :class:`DataError`, and
    reading goes on with the next record. One is raised where the file is empty or cut short, or a length has a wrong
    checksum, so that there is no telling where the next record begins.
    """
    with path.open("rb") as file:
        left = os.fstat(file.fileno()).st_size
        if left == 0:
            raise DataError("the file is empty", file=path)
        index = 0
        while left > 0:
            where = f"record {index}"
            header = file.read(_HEADER.size)
            if len(header) < _HEADER.size:
                message = f"cut short: {len(header)} of {_HEADER.size} header bytes"
                raise DataError(message, file=path, field=where)
            length, check = _HEADER.unpack(header)
            if masked_crc32c(header[:8]) != check:
                kind = "not a TFRecord file, or damaged" if index == 0 else "damaged"
                message = f"{kind}: the checksum of the record's length is wrong"
                raise DataError(message, file=path, field=where)
            size = length + _CHECK.size
            left -= _HEADER.size + size
            if left < 0:
                raise DataError(f"cut short: {left + size} of {size} payload bytes", file=path, field=where)
            index += 1
            if length > MAX_RECORD:
                file.seek(size, os.SEEK_CUR)
                yield DataError(f"{length} bytes, at most {MAX_RECORD} are read", file=path, field=where)
                continue
            payload, tail = file.read(length), file.read(_CHECK.size)
            good = masked_crc32c(payload) == int.from_bytes(tail, "little")
            message = "damaged: the checksum of the payload is wrong"
            yield payload if good else DataError(message, file=path, field=where)


MAX_FEATURES, MAX_LINKS = 100_000, 1_000_000
"""Entries of a map, and references between lanes or states of lights: far more than a scenario has."""
MPS_PER_MPH = 0.44704

_SIZE, _VELOCITY = ("length", "width", "height"), ("velocity_x", "velocity_y")
_STATE = attrgetter("center_x", "center_y", "center_z", *_SIZE, "heading", *_VELOCITY, "valid")
_POINT = attrgetter("x", "y", "z")
_MARKS = {
    "road_line": ("polyline", MarkType.ROAD_LINE),
    "crosswalk": ("polygon", MarkType.CROSSWALK),
    "speed_bump": ("polygon", MarkType.SPEED_BUMP),
    "driveway": ("polygon", MarkType.DRIVEWAY),
}


class WomdReader(Reader):
    """Reads WOMD ``Scenario`` files; the ``tf.Example`` flavour is not supported (its map is cut)."""

    name = "womd"
    patterns = ("*.tfrecord", "*.tfrecord-*-of-*")

    def _read(self, path: Path) -> Iterator[Item]:
        for index, payload in enumerate(read_records(path)):
            yield payload if isinstance(payload, DataError) else self._convert(payload, path, index)

    def _convert(self, payload: bytes, path: Path, index: int) -> Item:
        name, record = None, f"record {index}"
        try:
            scenario = pb.Scenario.FromString(payload)
            name = _name(scenario)
            return scenario_to_segment(scenario, file=path.name)
        except (DecodeError, UnicodeDecodeError) as error:
            return DataError(f"not a Scenario message: {error}", file=path, segment=name, field=record)
        except DataError as error:
            field = f"{record}, {error.field}" if error.field else record
            return DataError(error.message, file=path, segment=name, field=field)
        except Exception as error:  # the other records of the file are still to be read
            return base.unexpected(error, file=path, segment=name)


def scenario_to_segment(scenario: pb.Scenario, file: str = "") -> RunSegment:
    """Convert one decoded record, not validated yet; a :class:`DataError` names the format's field."""
    name = _name(scenario)
    times = np.array(scenario.timestamps_seconds, np.float64)
    steps = len(times)
    fine = steps >= 2 and np.isfinite(times).all()
    refuse(not fine, f"{steps} steps, needs at least 2 finite ones", "timestamps_seconds")
    dt = base.time_step(times, "timestamps_seconds")
    states, kept, renumber = _tracks(scenario, steps)
    ego = _index(scenario.sdc_track_index, renumber, "sdc_track_index")
    refuse(ego < 0, "the recording vehicle is valid at no step", "sdc_track_index")
    valid = states[..., 9] != 0
    origin = np.round(states[ego, np.argmax(valid[ego]), :3])
    lanes, boundary, marks = _features(scenario.map_features)
    for field in ("tracks_to_predict", "objects_of_interest"):
        _check_count(len(getattr(scenario, field)), schema.MAX_AGENTS, field)
    tracks = [scenario.tracks[i] for i in kept]
    ids = np.array([track.id for track in tracks], np.int64)
    predict = [_index(p.track_index, renumber, "tracks_to_predict") for p in scenario.tracks_to_predict]
    where = {track: i for i, track in enumerate(ids.tolist())}
    interest = [where[track] for track in scenario.objects_of_interest if track in where]
    segment = RunSegment(
        segment_id=name,
        source=WomdReader.name,
        dt=dt,
        ego=ego,
        agent_id=ids,
        agent_type=_codes([track.object_type for track in tracks], len(AgentType), "tracks.object_type"),
        size=base.to_float32(_sizes(states[..., 3:6], valid, scenario.current_time_index)),
        **motion(states[..., :3] - origin, states[..., 6], states[..., 7:9], valid),
        origin=origin,
        road=lines.road_map(lanes, origin, boundary, marks),
        **lines.lights(_signals(scenario, steps, lanes), steps, origin),
        current_step=scenario.current_time_index,
        interest=np.array(interest, np.int32),
        predict=np.array([p for p in predict if p >= 0], np.int32),
        file=file,
    )
    return evened(segment, times)


def _check_count(count: int, most: int, field: str) -> None:
    refuse(count > most, f"{count} entries, at most {most} are read", field)


def _codes(numbers: Sequence[int], count: int, field: str) -> Codes:
    """Return enumeration values as uint8; a :class:`DataError` where one is outside 0 … count - 1."""
    values = np.array(numbers, np.int64)
    bad = values[(values < 0) | (values >= count)]
    refuse(len(bad), f"unknown value {bad[:1]}, expected 0 … {count - 1}", field)
    return values.astype(np.uint8)


def _name(scenario: pb.Scenario) -> str:
    name: str | bytes = scenario.scenario_id
    refuse(not name, "missing; is this a WOMD Scenario record?", "scenario_id")
    # Where a string is not UTF-8, protobuf's runtimes either refuse the record or hand over its bytes.
    refuse(isinstance(name, bytes), f"{name!r} is not UTF-8", "scenario_id")
    return str(name)


def _tracks(scenario: pb.Scenario, steps: int) -> tuple[Doubles, list[int], dict[int, int]]:
    """Return states [A, T, 10], the tracks they are, and track index in the record -> row, -1 where left out."""
    tracks = scenario.tracks
    refuse(not tracks, "has no agents", "tracks")
    schema.check_counts(len(tracks), steps, "tracks")
    for track in tracks:
        count = len(track.states)
        refuse(count != steps, f"track {track.id} has {count} states for {steps} steps", "tracks.states")
    numbers = chain.from_iterable(map(_STATE, chain.from_iterable(track.states for track in tracks)))
    states = np.fromiter(numbers, np.float64, len(tracks) * steps * 10).reshape(len(tracks), steps, 10)
    seen = (states[..., 9] != 0).any(axis=1)
    rows = np.where(seen, np.cumsum(seen) - 1, -1)
    return states[seen], np.flatnonzero(seen).tolist(), dict(enumerate(rows.tolist()))


def _index(track: int, renumber: dict[int, int], field: str) -> int:
    refuse(track not in renumber, f"track index {track} outside the {len(renumber)} tracks", field)
    return renumber[track]


def _sizes(sizes: Doubles, valid: Bools, current: int) -> Doubles:
    steps = valid.shape[1]
    refuse(not 0 <= current < steps, f"{current} outside the {steps} steps", "current_time_index")
    result = sizes[:, current].copy()
    for agent in np.flatnonzero(~valid[:, current]):
        result[agent] = np.median(sizes[agent, valid[agent]], axis=0)
    return result


def _points(points: Iterable[pb.MapPoint]) -> Doubles:
    return np.fromiter(chain.from_iterable(map(_POINT, points)), np.float64).reshape(-1, 3)


def _features(features: Sequence[pb.MapFeature]) -> tuple[list[Lane], list[Doubles], list[Mark]]:
    """Return lanes, road edges and marks."""
    _check_count(len(features), MAX_FEATURES, "map_features")
    found: list[tuple[int, Any]] = []
    edges: list[Doubles] = []
    marks: list[Mark] = []
    for feature in features:
        kind = feature.WhichOneof("feature_data")
        if kind == "lane" and len(feature.lane.polyline) >= 1:
            found.append((feature.id, feature.lane))
        elif kind == "road_edge" and len(feature.road_edge.polyline) >= 2:
            edges.append(_points(feature.road_edge.polyline))
        elif kind == "stop_sign" and feature.stop_sign.HasField("position"):
            marks.append((_points([feature.stop_sign.position]), MarkType.STOP_SIGN))
        elif kind in _MARKS:
            attribute, mark = _MARKS[kind]
            points = _points(getattr(getattr(feature, kind), attribute))
            if len(points):
                ring = np.concatenate([points, points[:1]])
                marks.append((ring if attribute == "polygon" else points, mark))
    for name in ("exit_lanes", "left_neighbors", "right_neighbors"):
        _check_count(sum(len(getattr(lane, name)) for _, lane in found), MAX_LINKS, "map_features.lane")
    types = _codes([lane.type for _, lane in found], len(LaneType), "map_features.lane.type")
    lanes = [
        Lane(
            name=lane_id,
            line=_points(lane.polyline),
            kind=kind,
            speed_limit=lane.speed_limit_mph * MPS_PER_MPH or np.nan,
            successors=lane.exit_lanes,
            left=[neighbor.feature_id for neighbor in lane.left_neighbors],
            right=[neighbor.feature_id for neighbor in lane.right_neighbors],
        )
        for (lane_id, lane), kind in zip(found, types.tolist(), strict=True)
    ]
    return lanes, edges, marks


def _signals(scenario: pb.Scenario, steps: int, lanes: Sequence[Lane]) -> Lights:
    logged = scenario.dynamic_map_states
    refuse(logged and len(logged) != steps, f"{len(logged)} entries for {steps} steps", "dynamic_map_states")
    _check_count(sum(len(now.lane_states) for now in logged), MAX_LINKS, "dynamic_map_states")
    index = {lane.name: k for k, lane in enumerate(lanes)}
    stops: dict[int, Doubles] = {}
    entries: list[tuple[int, int, int]] = []
    for step, now in enumerate(logged):
        for light in now.lane_states:
            lane = index.get(light.lane)
            if lane is not None:
                if lane not in stops:
                    given = light.HasField("stop_point")
                    stops[lane] = _points([light.stop_point])[0] if given else lanes[lane].line[0]
                entries.append((lane, step, light.state))
    schema.check_signals(len(stops), steps, "dynamic_map_states")
    states = _codes([state for *_, state in entries], len(SignalState), "dynamic_map_states.state")
    found = {lane: np.full(steps, SignalState.UNKNOWN, np.uint8) for lane in stops}
    for (lane, step, _), state in zip(entries, states.tolist(), strict=True):
        found[lane][step] = state
    return {lane: (stops[lane], found[lane]) for lane in stops}
