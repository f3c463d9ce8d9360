"""The WOSAC score of an agent on any run segments, beside log playback and constant velocity."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from symphony.agents import Agent
from symphony.config import WosacSettings
from symphony.data.resample import resample
from symphony.data.rollouts import RolloutArrays
from symphony.data.segment import RunSegment, SignalState
from symphony.data.sources.wosac import CURRENT, DT, STEPS
from symphony.data.store import SegmentStore
from symphony.data.submission import FUTURE, ROLLOUTS
from symphony.errors import ConfigError, DataError
from symphony.evaluation.evaluator import BASELINES
from symphony.evaluation.paired import clustered_mean
from symphony.metrics.wosac import CHALLENGES, SimulatedRollouts, WosacScenario, WosacScores, score
from symphony.simulation.wosac import constant_velocity, wosac_rollouts

_AWAY, _APART = 1e5, 1e3
"""Metres from the origin, and from one another, at which agents do not meet anyone."""
_TIMED = ("position", "heading", "velocity", "valid", "signal_state")


@dataclass
class WosacEvaluation:
    """Scores of an agent and of the baselines.

    Attributes:
        config: year of the challenge.
        segments: ids of the run segments.
        groups: [K] the recording of each, by number.
        scores: of every run segment, by agent.
        seconds: CPU time of each agent's simulation.
    """

    config: str
    segments: list[str] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)
    scores: dict[str, list[WosacScores]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def numbers(self, agent: str) -> dict[str, tuple[float, float]]:
        """Mean of every number over run segments, and its standard error over recordings (NaN for a single one)."""
        rows = [scores.to_dict() for scores in self.scores[agent]]
        groups = np.unique(self.groups, return_inverse=True)[1]
        return {name: clustered_mean(np.array([row[name] for row in rows]), groups) for name in rows[0]}

    def record(self) -> dict[str, Any]:
        """As JSON can hold it."""
        agents = {}
        for name, scores in self.scores.items():
            numbers = self.numbers(name)
            agents[name] = {
                **{key: mean for key, (mean, _) in numbers.items()},
                **{f"{key}_se": None if np.isnan(error) else error for key, (_, error) in numbers.items()},
                "seconds": self.seconds[name],
                "segments": {
                    segment: one.to_dict() for segment, one in zip(self.segments, scores, strict=True)
                },
            }
        return {"config": self.config, "recordings": len(set(self.groups)), "agents": agents}


def evaluate_wosac(
    agent: Agent,
    store: SegmentStore,
    items: Sequence[int],
    settings: WosacSettings,
    config: str = "2025",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> WosacEvaluation:
    """Score an agent and the baselines on run segments of a store.

    Args:
        agent: drives the vehicles.
        store: of segments with any time step.
        items: numbers of the run segments.
        settings: how the agent is simulated.
        config: year of the challenge.
        progress: called with the segments done and their total.

    Raises:
        ConfigError: no such year.
        DataError: the store is empty, or a segment can't be scored; names it.
        NotFiniteError: a network of the agent puts out a number that is not finite.
    """
    if config not in CHALLENGES:
        raise ConfigError(f"config must be one of {', '.join(CHALLENGES)}, is {config}")
    if not items:
        raise DataError("the store holds no run segments", file=store.path)
    found = WosacEvaluation(config)
    makers: dict[str, Callable[[RunSegment], RolloutArrays]] = {
        BASELINES[0]: log_playback,
        BASELINES[1]: constant_velocity,
    }
    if agent.name not in makers:
        makers[agent.name] = lambda window: wosac_rollouts(agent, window, settings)
    found.scores, found.seconds = {name: [] for name in makers}, dict.fromkeys(makers, 0.0)
    for done, item in enumerate(items):
        segment = store[item]
        window = wosac_window(segment)
        scenario = wosac_scenario(segment)
        for name, make in makers.items():
            began = time.process_time()
            rollouts = SimulatedRollouts.of(**vars(make(window)))
            found.seconds[name] += time.process_time() - began
            found.scores[name].append(score(scenario, rollouts, CHALLENGES[config]))
        found.segments.append(segment.segment_id)
        found.groups.append(segment.group or segment.segment_id)
        progress(done + 1, len(items))
    return found


def wosac_window(segment: RunSegment) -> RunSegment:
    """The first 9 s of a segment as the challenge has them: 91 steps of 0.1 s, of which step 10 is the current one.

    Other time steps are brought to 0.1 s by :func:`symphony.data.resample.resample`. Of a segment between 8 and 9 s
    the future is kept whole and the history is shorter: its first steps are valid for nobody.

    Raises:
        DataError: less than 8 s.
    """
    tenth = segment if abs(segment.dt - DT) < 1e-6 else resample(segment, DT)
    steps = min(tenth.num_steps, STEPS)
    if steps <= FUTURE:
        raise DataError(
            f"has {(tenth.num_steps - 1) * DT:g} s, the score needs {FUTURE * DT:g}",
            file=segment.file or None,
            segment=segment.segment_id,
            field="valid",
        )
    missing = STEPS - steps

    def taken(values: Any) -> Any:
        return np.pad(values[:, :steps], [(0, 0), (missing, 0), *[(0, 0)] * (values.ndim - 2)])

    return tenth.replace(
        dt=DT, current_step=CURRENT, **{name: taken(getattr(tenth, name)) for name in _TIMED}
    )


def wosac_scenario(segment: RunSegment) -> WosacScenario:
    """What is scored of a run segment, see :func:`wosac_window`.

    Scored are the ego and the agents the source marks for prediction, as far as they are valid at step 10; where it
    marks none, all agents that are. The road's boundary stands for road edges; lanes and lights are the segment's.

    Raises:
        DataError: it can't be scored; names the segment.
    """
    window = wosac_window(segment)
    present = window.valid[:, CURRENT]
    chosen = np.zeros(len(present), bool)
    chosen[[window.ego, *window.predict.tolist()]] = True
    scored = present & (chosen | (len(window.predict) == 0))
    road, origin = window.road, window.origin
    light, step = (window.signal_state != SignalState.UNKNOWN).nonzero()
    return WosacScenario.of(
        window.segment_id,
        object_id=window.agent_id.astype(np.int64),
        object_type=window.agent_type.astype(np.int64),
        position=window.position + origin,
        # Copies: what lies in a store can't be written to, which torch.as_tensor warns of.
        heading=window.heading.copy(),
        size=window.size.copy(),
        valid=window.valid.copy(),
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


def log_playback(window: RunSegment) -> RolloutArrays:
    """32 times the log of a :func:`wosac_window`; agents that it does not see are far away from everyone."""
    rows = np.flatnonzero(window.valid[:, CURRENT])
    seen = window.valid[rows, CURRENT + 1 :, None]
    away = np.zeros((len(rows), 1, 3))
    away[:, 0, 0] = _AWAY + _APART * np.arange(len(rows))
    place = np.where(seen, window.position[rows, CURRENT + 1 :], away) + window.origin
    heading = window.heading[rows, CURRENT + 1 :].astype(np.float64)
    states = np.repeat(np.concatenate([place, heading[..., None]], -1)[None], ROLLOUTS, 0)
    return RolloutArrays(window.agent_id[rows], *np.moveaxis(states, -1, 0))
