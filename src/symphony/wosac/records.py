"""What the Waymo Open Sim Agents Challenge takes from a WOMD ``Scenario`` record, as logged: nothing re-centred,
rounded or left out, and headings as they are.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from symphony.data.sources import womd_pb2 as pb
from symphony.data.sources.tfrecord import read_records
from symphony.data.sources.womd import WomdReader
from symphony.errors import DataError

STEPS, CURRENT, DT = 91, 10, 0.1
"""Steps of a scenario, the last one a simulator may know, seconds per step."""

_STATE = attrgetter("center_x", "center_y", "center_z", "heading", "valid")
_POINT = attrgetter("x", "y", "z")


def scenario_files(path: Path) -> list[Path]:
    """The scenario files meant by a file, a folder (searched) or a pattern with ``*``, sorted.

    Raises:
        DataError: there are none.
    """
    if path.is_dir():
        files = sorted({file for pattern in WomdReader.patterns for file in path.rglob(pattern)})
    elif path.exists():
        files = [path]
    else:
        files = [Path(name) for name in sorted(glob.glob(str(path)))]
    if not files:
        raise DataError("no scenario files", file=path)
    return files


def read_scenario_payloads(files: list[Path]) -> Iterator[tuple[Path, int, bytes]]:
    """Yield (file, number of the record in it, payload) of every record.

    Raises:
        DataError: a file or record is damaged; names it.
    """
    for file in files:
        for index, payload in enumerate(read_records(file)):
            if isinstance(payload, DataError):
                raise payload
            yield file, index, payload


def parse_scenario(payload: bytes, file: Path, record: int) -> pb.Scenario:
    """Decode a record.

    Raises:
        DataError: it is no scenario; names file and record.
    """
    try:
        scenario = pb.Scenario.FromString(payload)
        name: str | bytes = scenario.scenario_id
    except (DecodeError, UnicodeDecodeError) as error:
        raise DataError(f"not a Scenario message: {error}", file=file, field=f"record {record}") from None
    if not name or isinstance(name, bytes):
        message = "missing, or not UTF-8; is this a WOMD Scenario record?"
        raise DataError(message, file=file, field=f"record {record}, scenario_id")
    return scenario


def simulated_ids(scenario: pb.Scenario) -> list[int]:
    """Ids of the objects that rollouts must hold: all that are valid at step 10, in the record's order.

    Raises:
        DataError: naming scenario and field.
    """
    _check_current(scenario)
    for track in scenario.tracks:
        if len(track.states) <= CURRENT:
            message = f"agent {track.id} has {len(track.states)} states, needs more than {CURRENT}"
            raise DataError(message, segment=scenario.scenario_id, field="tracks.states")
    return [track.id for track in scenario.tracks if track.states[CURRENT].valid]


def scenario_arrays(scenario: pb.Scenario) -> dict[str, Any]:
    """The arguments of :meth:`symphony.wosac.scorer.WosacScenario.of`; positions float64, world frame.

    Raises:
        DataError: naming scenario and field.
    """
    _check_current(scenario)
    _check_steps(scenario)
    tracks = scenario.tracks
    numbers = chain.from_iterable(map(_STATE, chain.from_iterable(track.states for track in tracks)))
    states = np.fromiter(numbers, np.float64, len(tracks) * STEPS * 5).reshape(len(tracks), STEPS, 5)
    now = [track.states[CURRENT] for track in tracks]
    lanes = [(f.id, f.lane) for f in scenario.map_features if f.WhichOneof("feature_data") == "lane"]
    edges = [f.road_edge for f in scenario.map_features if f.WhichOneof("feature_data") == "road_edge"]
    return {
        "scenario_id": scenario.scenario_id,
        "object_id": np.array([track.id for track in tracks], np.int64),
        "object_type": np.array([track.object_type for track in tracks], np.int64),
        "position": states[..., :3],
        "heading": states[..., 3].astype(np.float32),
        "size": np.array([(s.length, s.width, s.height) for s in now], np.float32).reshape(-1, 3),
        "valid": states[..., 4] != 0,
        "evaluated": np.array(_evaluated(scenario), np.int64),
        "road_edges": [_points(edge.polyline) for edge in edges],
        "lanes": [_points(lane.polyline) for _, lane in lanes],
        "lane_id": np.array([lane_id for lane_id, _ in lanes], np.int64),
        "lane_type": np.array([lane.type for _, lane in lanes], np.int64),
        **_signals(scenario),
    }


def _check_current(scenario: pb.Scenario) -> None:
    if scenario.current_time_index != CURRENT:
        message = f"is {scenario.current_time_index}, the challenge's scenarios have {CURRENT}"
        raise DataError(message, segment=scenario.scenario_id, field="current_time_index")


def _check_steps(scenario: pb.Scenario) -> None:
    name = scenario.scenario_id
    times = np.array(scenario.timestamps_seconds, np.float64)
    if len(times) != STEPS:
        hint = (
            "; the test set's future is not public, so it can't be scored"
            if len(times) == CURRENT + 1
            else ""
        )
        raise DataError(f"{len(times)} steps, needs {STEPS}{hint}", segment=name, field="timestamps_seconds")
    # The score takes every step for 0.1 s. Recordings jitter; a step left out or another rate is something else.
    gaps = np.diff(times)
    if not ((np.abs(gaps - DT) <= 0.5 * DT).all() and abs(gaps.mean() - DT) <= 0.02 * DT):
        raise DataError(f"steps are not of {DT} s", segment=name, field="timestamps_seconds")
    for track in scenario.tracks:
        if len(track.states) != STEPS:
            message = f"agent {track.id} has {len(track.states)} states for {STEPS} steps"
            raise DataError(message, segment=name, field="tracks.states")
    logged = len(scenario.dynamic_map_states)
    if logged not in {0, STEPS}:
        raise DataError(f"{logged} entries for {STEPS} steps", segment=name, field="dynamic_map_states")


def _evaluated(scenario: pb.Scenario) -> list[int]:
    """Ids of the recording vehicle and of the objects to predict, ascending."""
    chosen = set()
    for field, index in (
        ("sdc_track_index", scenario.sdc_track_index),
        *(("tracks_to_predict", prediction.track_index) for prediction in scenario.tracks_to_predict),
    ):
        if not 0 <= index < len(scenario.tracks):
            message = f"track index {index} outside the {len(scenario.tracks)} tracks"
            raise DataError(message, segment=scenario.scenario_id, field=field)
        chosen.add(scenario.tracks[index].id)
    return sorted(chosen)


def _points(points: Any) -> NDArray[np.float64]:
    return np.fromiter(chain.from_iterable(map(_POINT, points)), np.float64).reshape(-1, 3)


def _signals(scenario: pb.Scenario) -> dict[str, NDArray[Any]]:
    """Observations of traffic lights; one without a stop point has it at the world's origin, as the format says."""
    seen = [
        (step, light) for step, now in enumerate(scenario.dynamic_map_states) for light in now.lane_states
    ]
    points = [(light.stop_point.x, light.stop_point.y) for _, light in seen]
    return {
        "signal_step": np.array([step for step, _ in seen], np.int64),
        "signal_lane": np.array([light.lane for _, light in seen], np.int64),
        "signal_state": np.array([light.state for _, light in seen], np.int64),
        "signal_point": np.array(points, np.float64).reshape(-1, 2),
    }
