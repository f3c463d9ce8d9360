"""Any run segment as a scenario of the Waymo Open Sim Agents Challenge, and its log as rollouts."""

from __future__ import annotations

from typing import Any

import numpy as np

from symphony.data.resample import resample
from symphony.data.segment import RunSegment, SignalState
from symphony.errors import DataError
from symphony.wosac.scorer import SimulatedRollouts, WosacScenario
from symphony.wosac.scorer.config import CURRENT, DT, FUTURE, ROLLOUTS

_AWAY, _APART = 1e5, 1e3
"""Metres from the origin, and from one another, at which agents do not meet anyone."""
_FAR = 1e5
"""Metres from the world's origin beyond which float32, in which all is scored, has steps of a centimetre and more."""
_TIMED = ("position", "heading", "velocity", "valid", "signal_state")


def wosac_window(segment: RunSegment, future: int = FUTURE) -> RunSegment:
    """The first 9 s of a segment as the challenge has them: 91 steps of 0.1 s, of which step 10 is the current one.

    Other time steps are brought to 0.1 s by :func:`symphony.data.resample.resample`. Of a segment between 8 and 9 s
    the future is kept whole and the history is shorter: its first steps are valid for nobody, and go back from the
    first logged one at its velocity, so that there is no jump in speed. Where the world's origin is more than 100 km
    away, as in maps with UTM coordinates, that of the segment takes its place.

    Args:
        segment: of any time step.
        future: steps of the future, 80 or fewer; with fewer all of the above is so much shorter.

    Raises:
        DataError: less than 8 s.
    """
    tenth = segment if abs(segment.dt - DT) < 1e-6 else resample(segment, DT)
    steps = min(tenth.num_steps, CURRENT + 1 + future)
    if steps <= future:
        message = f"has {(tenth.num_steps - 1) * DT:g} s, the score needs {future * DT:g}"
        raise DataError(message, file=segment.file or None, segment=segment.segment_id, field="valid")
    missing = CURRENT + 1 + future - steps

    def taken(values: Any) -> Any:
        return np.pad(values[:, :steps], [(0, 0), (missing, 0), *[(0, 0)] * (values.ndim - 2)])

    found = {name: taken(getattr(tenth, name)) for name in _TIMED}
    back = np.arange(-missing, 0)[:, None] * DT
    found["position"][:, :missing] = tenth.position[:, :1]
    found["position"][:, :missing, :2] += tenth.velocity[:, :1] * back
    found["heading"][:, :missing] = tenth.heading[:, :1]
    origin = np.where(np.abs(tenth.origin).max() > _FAR, 0.0, tenth.origin)
    return tenth.replace(dt=DT, current_step=CURRENT, origin=origin, **found)


def wosac_scenario(window: RunSegment) -> WosacScenario:
    """What is scored of a :func:`wosac_window`.

    Scored are the ego and the agents the source marks for prediction, as far as they are valid at step 10; where it
    marks none, all agents that are. The road's boundary stands for road edges; lanes and lights are the segment's.

    Raises:
        DataError: it can't be scored; names the segment.
    """
    present = window.valid[:, CURRENT]
    chosen = np.zeros(len(present), bool)
    chosen[[window.ego, *window.predict.tolist()]] = True
    scored = present & (chosen | (len(window.predict) == 0))
    road, origin = window.road, window.origin
    light, step = (window.signal_state != SignalState.UNKNOWN).nonzero()
    return WosacScenario(
        window.segment_id,
        future=window.num_steps - CURRENT - 1,
        object_id=window.agent_id.astype(np.int64),
        object_type=window.agent_type.astype(np.int64),
        position=window.position + origin,
        heading=window.heading,
        size=window.size,
        valid=window.valid,
        evaluated=np.sort(window.agent_id[scored]).astype(np.int64),
        road_edges=[road.boundary[k] + origin for k in range(len(road.boundary))],
        lanes=[road.lanes[k] + origin for k in range(len(road.lanes))],
        lane_id=road.lane_id.astype(np.int64),
        lane_type=road.lane_type.astype(np.int64),
        signal_step=step,
        signal_lane=road.lane_id[window.signal_lane[light]].astype(np.int64),
        signal_state=window.signal_state[light, step].astype(np.int64),
        signal_point=window.signal_point[light, :2] + origin[:2],
    )


def log_playback(window: RunSegment) -> SimulatedRollouts:
    """32 times the log of a :func:`wosac_window`; agents that it does not see are far away from everyone."""
    rows, later = np.flatnonzero(window.valid[:, CURRENT]), slice(CURRENT + 1, None)
    place = (window.position[rows, later] + window.origin).astype(np.float64)
    away = np.zeros((len(rows), 1, 3))
    away[:, 0, 0] = _AWAY + _APART * np.arange(len(rows))
    place = np.where(window.valid[rows, later, None], place, away + window.origin)
    states = np.concatenate([place, window.heading[rows, later, None].astype(np.float64)], -1)
    return SimulatedRollouts(window.agent_id[rows], *np.moveaxis(np.repeat(states[None], ROLLOUTS, 0), -1, 0))
