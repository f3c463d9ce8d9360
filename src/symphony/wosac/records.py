"""The parts of a WOMD ``Scenario`` record that the Waymo Open Sim Agents Challenge uses, as logged: nothing
re-centred, rounded or left out, and headings as they are.
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
from symphony.data.sources.womd import WomdReader, read_records
from symphony.errors import DataError
from symphony.wosac.scorer import WosacScenario
from symphony.wosac.scorer.config import CURRENT, DT, FUTURE

STEPS = CURRENT + 1 + FUTURE  # steps of a scenario

_STATE = attrgetter("center_x", "center_y", "center_z", "heading", "valid")
_POINT = attrgetter("x", "y", "z")


def read_scenarios(path: Path) -> Iterator[tuple[Path, int, bytes]]:
    """Yield (file, number of the record in it, payload) of every record of the scenario files meant by a file, a
    folder (searched) or a pattern with ``*``. A :class:`DataError` says if there are none, or names what is damaged.
    """
    if path.is_dir():
        files = sorted({file for pattern in WomdReader.patterns for file in path.rglob(pattern)})
    else:
        files = [path] if path.exists() else [Path(name) for name in sorted(glob.glob(str(path)))]
    if not files:
        raise DataError("no scenario files", file=path)
    for file in files:
        for index, payload in enumerate(read_records(file)):
            if isinstance(payload, DataError):
                raise payload
            yield file, index, payload


def parse_scenario(payload: bytes, file: Path, record: int) -> pb.Scenario:
    """Decode a record. Raises a :class:`DataError` where it is not a scenario; names file and record."""
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
    """Return the ids of the objects that rollouts must hold: all that are valid at step 10, in the record's order.

    Raises a :class:`DataError` that names scenario and field.
    """
    _check_steps(scenario, CURRENT + 1)
    return [track.id for track in scenario.tracks if track.states[CURRENT].valid]


def logged_scenario(scenario: pb.Scenario) -> WosacScenario:
    """Return a record as it is scored; positions float64, world frame.

    Raises a :class:`DataError` where it can't be scored; names scenario and field.
    """
    check_times(scenario)
    _check_steps(scenario, STEPS)
    tracks = scenario.tracks
    numbers = chain.from_iterable(map(_STATE, chain.from_iterable(track.states for track in tracks)))
    states = np.fromiter(numbers, np.float64, len(tracks) * STEPS * 5).reshape(len(tracks), STEPS, 5)
    now = [track.states[CURRENT] for track in tracks]
    lanes = [(f.id, f.lane) for f in scenario.map_features if f.WhichOneof("feature_data") == "lane"]
    edges = [f.road_edge for f in scenario.map_features if f.WhichOneof("feature_data") == "road_edge"]
    # A light without a stop point has it at the world's origin, as the format says.
    seen = [(step, light) for step, shown in enumerate(scenario.dynamic_map_states) for light in shown.lane_states]
    stops = [(light.stop_point.x, light.stop_point.y) for _, light in seen]
    return WosacScenario(
        scenario_id=scenario.scenario_id,
        object_id=np.array([track.id for track in tracks], np.int64),
        object_type=np.array([track.object_type for track in tracks], np.int64),
        position=states[..., :3],
        heading=states[..., 3].astype(np.float32),
        size=np.array([(s.length, s.width, s.height) for s in now], np.float32).reshape(-1, 3),
        valid=states[..., 4] != 0,
        evaluated=np.array(_evaluated(scenario), np.int64),
        road_edges=[_points(edge.polyline) for edge in edges],
        lanes=[_points(lane.polyline) for _, lane in lanes],
        lane_id=np.array([lane_id for lane_id, _ in lanes], np.int64),
        lane_type=np.array([lane.type for _, lane in lanes], np.int64),
        signal_step=np.array([step for step, _ in seen], np.int64),
        signal_lane=np.array([light.lane for _, light in seen], np.int64),
        signal_state=np.array([light.state for _, light in seen], np.int64),
        signal_point=np.array(stops, np.float64).reshape(-1, 2),
    )


def check_times(scenario: pb.Scenario, least: int = STEPS) -> None:
    """Check that a scenario has at least so many steps, each of 0.1 s. Raises a :class:`DataError` that names it."""
    times = np.array(scenario.timestamps_seconds, np.float64)
    gaps, problem = np.diff(times), ""
    if not least <= len(times) <= STEPS:
        problem = f"{len(times)} steps, needs {least}"
        if len(times) == CURRENT + 1:
            problem += "; the test set's future is not public, so it can't be scored"
    # The score takes every step for 0.1 s. Recordings jitter; a step left out or another rate is something else.
    elif not ((np.abs(gaps - DT) <= 0.5 * DT).all() and abs(gaps.mean() - DT) <= 0.02 * DT):
        problem = f"steps are not of {DT} s"
    if problem:
        raise DataError(problem, segment=scenario.scenario_id, field="timestamps_seconds")


def _check_steps(scenario: pb.Scenario, steps: int) -> None:
    """Check that the current step is the challenge's, and that agents and lights have at least ``steps`` steps."""

    def error(message: str, field: str) -> DataError:
        return DataError(message, segment=scenario.scenario_id, field=field)

    if scenario.current_time_index != CURRENT:
        message = f"is {scenario.current_time_index}, the challenge's scenarios have {CURRENT}"
        raise error(message, "current_time_index")
    for track in scenario.tracks:
        if not steps <= len(track.states) <= STEPS:
            raise error(f"agent {track.id} has {len(track.states)} states for {steps} steps", "tracks.states")
    if steps == STEPS and len(scenario.dynamic_map_states) not in {0, STEPS}:
        message = f"{len(scenario.dynamic_map_states)} entries for {STEPS} steps"
        raise error(message, "dynamic_map_states")


def _evaluated(scenario: pb.Scenario) -> list[int]:
    """Return the ids of the recording vehicle and of the objects to predict, ascending."""
    predicted = [("tracks_to_predict", one.track_index) for one in scenario.tracks_to_predict]
    chosen = set()
    for field, index in (("sdc_track_index", scenario.sdc_track_index), *predicted):
        if not 0 <= index < len(scenario.tracks):
            message = f"track index {index} outside the {len(scenario.tracks)} tracks"
            raise DataError(message, segment=scenario.scenario_id, field=field)
        chosen.add(scenario.tracks[index].id)
    return sorted(chosen)


def _points(points: Any) -> NDArray[np.float64]:
    return np.fromiter(chain.from_iterable(map(_POINT, points)), np.float64).reshape(-1, 3)
