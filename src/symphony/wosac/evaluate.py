"""The WOSAC score of an agent on any run segments, and the scores of baselines."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from symphony.agents import Agent, load_agent
from symphony.config import WosacSettings
from symphony.data.report import Skip
from symphony.data.resample import resample
from symphony.data.segment import TIMED, RunSegment, SignalState
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation.evaluator import BASELINES
from symphony.metrics.intervals import clustered_mean
from symphony.rollouts.workers import shared
from symphony.wosac.scorer import CHALLENGES, SimulatedRollouts, WosacConfig, WosacScenario, check_scored, score
from symphony.wosac.scorer.config import CURRENT, DT, FUTURE, ROLLOUTS
from symphony.wosac.simulate import wosac_rollouts

_AWAY, _APART = 1e5, 1e3  # metres from the origin, and from one another, at which agents do not meet anyone
_FAR = 1e5
"""Metres from the world's origin beyond which float32, in which all is scored, has steps of a centimetre and more."""


def wosac_window(segment: RunSegment, future: int = FUTURE) -> RunSegment:
    """Return the first 9 s of a segment as the challenge has them: 91 steps of 0.1 s, with step 10 the current one.

    Other time steps are brought to 0.1 s by :func:`symphony.data.resample.resample`. Of a segment between 8 and 9 s
    the future is kept whole and the history is shorter: its first steps are valid for no agent, and go back from the
    first logged one at its velocity, so that there is no jump in speed. Where the world's origin is more than 100 km
    away, as in maps with UTM coordinates, that of the segment takes its place.

    With fewer than 80 steps of the future all of this is shorter by as much. Raises :class:`DataError` below 8 s.
    """
    tenth = segment if abs(segment.dt - DT) < 1e-6 else resample(segment, DT)
    steps = min(tenth.num_steps, CURRENT + 1 + future)
    if steps <= future:
        message = f"has {(tenth.num_steps - 1) * DT:g} s, the score needs {future * DT:g}"
        raise DataError(message, file=segment.file or None, segment=segment.segment_id, field="valid")
    missing = CURRENT + 1 + future - steps

    def taken(values: Any) -> Any:
        return np.pad(values[:, :steps], [(0, 0), (missing, 0), *[(0, 0)] * (values.ndim - 2)])

    found = {name: taken(getattr(tenth, name)) for name in TIMED}
    back = np.arange(-missing, 0)[:, None] * DT
    found["position"][:, :missing] = tenth.position[:, :1]
    found["position"][:, :missing, :2] += tenth.velocity[:, :1] * back
    found["heading"][:, :missing] = tenth.heading[:, :1]
    origin = np.where(np.abs(tenth.origin).max() > _FAR, 0.0, tenth.origin)
    return tenth.replace(dt=DT, current_step=CURRENT, origin=origin, **found)


def wosac_scenario(window: RunSegment) -> WosacScenario:
    """Return the scored part of a :func:`wosac_window`.

    Scored are the ego and the agents the source marks for prediction, as far as they are valid at step 10; where it
    marks none, all valid agents. The road's boundary stands for road edges; lanes and lights are the segment's.
    Raises a :class:`DataError` where it can't be scored; names the segment.
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
    """Return 32 copies of the log of a :func:`wosac_window`; agents that it does not see are far from all others."""
    rows, later = np.flatnonzero(window.valid[:, CURRENT]), slice(CURRENT + 1, None)
    away = np.zeros((len(rows), 1, 3))
    away[:, 0, 0] = _AWAY + _APART * np.arange(len(rows))
    place = np.where(window.valid[rows, later, None], window.position[rows, later], away) + window.origin
    states = np.concatenate([place, window.heading[rows, later, None]], -1)
    return SimulatedRollouts(window.agent_id[rows], *np.moveaxis(np.repeat(states[None], ROLLOUTS, 0), -1, 0))


WOSAC_BASELINES = (*BASELINES, "idm", "random")
"""Baselines scored beside every agent: log playback, constant velocity, the intelligent driver model along the lanes,
and vehicles that act at random."""


class SegmentResult(NamedTuple):
    """An agent on a run segment: its scores (:func:`.scorer.score`) and CPU seconds of simulation."""

    scores: dict[str, float]
    seconds: float


@dataclass(frozen=True)
class WosacEvaluation:
    """The scores of an agent and of the baselines."""

    config: str  # year of the challenge
    agent: str  # its name
    how: dict[str, Any]  # what decides the rollouts, see :func:`simulated_how`
    data: dict[str, str]  # name and checksum of the store
    segments: list[str]  # [K] ids of the run segments that were scored
    groups: list[str]  # [K] the recording of each
    objects: list[int]  # [K] how many of its objects are scored
    rates: list[float]  # [K] steps per second of its log in the store; the score brings all to 10
    results: dict[str, list[SegmentResult]]  # [K] by agent
    left_out: list[Skip]  # run segments that can't be scored, and why

    def numbers(self, agent: str) -> dict[str, tuple[float, float]]:
        """Return the mean of every number over run segments, and its standard error over recordings (NaN for one)."""
        rows = [one.scores for one in self.results[agent]]
        groups = np.unique(self.groups, return_inverse=True)[1]
        return {name: clustered_mean(np.array([row[name] for row in rows]), groups) for name in rows[0]}

    def flat(self, agent: str) -> dict[str, float | None]:
        """Return means, then standard errors with ``_se`` after their names, None where there is none."""
        numbers = self.numbers(agent)
        errors = {f"{name}_se": None if math.isnan(error) else error for name, (_, error) in numbers.items()}
        return {**{name: mean for name, (mean, _) in numbers.items()}, **errors}

    def record(self) -> dict[str, Any]:
        """Return the record in types that JSON can hold."""
        agents = {}
        for name, found in self.results.items():
            agents[name] = {
                **self.flat(name),
                "seconds": sum(one.seconds for one in found),
                "segments": {segment: one.scores for segment, one in zip(self.segments, found, strict=True)},
            }
        return {
            "config": self.config,
            "agent": self.agent,
            "how": self.how,
            "data": self.data,
            "recordings": len(set(self.groups)),
            "objects": sum(self.objects),
            "hertz": sorted(set(self.rates)),
            "agents": agents,
            "left_out": [skip.to_json() for skip in self.left_out],
        }


def wosac_parts(found: WosacEvaluation, record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the additions of the score to the record of an evaluation of the same agent on the same store (see
    :mod:`symphony.evaluation.records`): ``wosac``, all of it; the numbers of the agent with ``wosac_`` before their
    names, and the parts of the baselines with theirs.
    """

    def named(agent: str) -> dict[str, Any]:
        return {f"wosac_{name}": value for name, value in found.flat(agent).items()}

    parts = {name: record[name] | named(name) for name in found.results if name in BASELINES}
    return {"wosac": found.record(), **parts, **named(found.agent)}


def simulated_how(agent: Agent, settings: WosacSettings) -> dict[str, Any]:
    """Return the settings that decide the rollouts, with the agent's choices filled in."""
    config = settings.config(ROLLOUTS, settings.seed)
    kind, _, branches, _, pruning = agent.plan(config)
    replaces = kind == "backtrack" or (kind == "tree" and pruning.rule == "replace")
    said: dict[str, tuple[bool, Any]] = {
        "search": (True, kind),
        "seed": (True, settings.seed),
        "horizon": (settings.future != FUTURE, settings.horizon),
        "logged_goals": (agent.goals is not None, settings.logged_goals),
        "pace": (agent.spec is not None, settings.pace),
        "score": (kind != "none" and pruning.score != "discriminator", pruning.score),
        "branches": (kind == "tree", branches),
        "rule": (kind == "tree", pruning.rule),
        "prune_every": (kind in ("tree", "backtrack"), pruning.prune_every),
        "goals": (kind == "tree", pruning.goals),
        "temperature": (kind == "tree" and pruning.rule == "systematic", pruning.temperature),
        "threshold": (replaces, pruning.threshold),
    }
    return {name: value for name, (matters, value) in said.items() if matters}


def evaluate_wosac(
    agent: Agent,
    store: SegmentStore,
    items: Sequence[int],
    settings: WosacSettings,
    config: str = "2025",
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    baselines: bool = True,
    strict: bool = False,
) -> WosacEvaluation:
    """Score an agent on run segments of a store, and :data:`WOSAC_BASELINES` beside it.

    Takes the numbers of the run segments, which may have any time step, and the year of the challenge. Where
    ``strict`` a run segment that can't be scored (too short, without road edges, vehicles or a future) is an error
    instead of being left out. ``progress`` is called with the segments done and their total.

    Raises:
        ConfigError: no such year, or the agent can't be simulated in this way.
        DataError: the store is empty, or no segment can be scored; names the first.
        NotFiniteError: a network of the agent returns a number that is not finite.
    """
    if config not in CHALLENGES:
        raise ConfigError(f"config must be one of {', '.join(CHALLENGES)}, is {config}")
    if len(set(items)) < len(items):
        raise ConfigError("items name a run segment twice")
    if not items:
        raise DataError("the store holds no run segments", file=store.path)
    how = simulated_how(agent, settings) if agent.policy is not None else {"search": "log"}
    names = [name for name in WOSAC_BASELINES if baselines and name != agent.name]
    agents = [*(load_agent(name, settings.device) for name in names), agent]
    scorer = _SegmentScorer(agents, store, settings, config, strict)
    scored: list[tuple[int, _Scored]] = []
    left_out: list[Skip] = []
    with closing(shared(scorer, [[item] for item in items], settings.config(1, 0))) as outcomes:
        for done, (item, found) in enumerate(zip(items, outcomes, strict=True), 1):
            if isinstance(found, Skip):
                left_out.append(found)
            else:
                scored.append((item, found))
            progress(done, len(items))
    if not scored:
        raise left_out[0].error
    order = sorted((one.name for one in agents), key=lambda name: (*WOSAC_BASELINES, name).index(name))
    return WosacEvaluation(
        config=config,
        agent=agent.name,
        how=how,
        data={"name": store.path.resolve().name, "checksum": store.checksum()},
        segments=[store.ids[item] for item, _ in scored],
        groups=[found.group for _, found in scored],
        objects=[found.objects for _, found in scored],
        rates=[round(1 / float(store.time_steps[item]), 3) for item, _ in scored],
        results={name: [found.results[name] for _, found in scored] for name in order},
        left_out=left_out,
    )


def scorable(store: SegmentStore, items: Sequence[int], future: int = FUTURE) -> None:
    """Check that some run segment can be scored. Raises a :class:`DataError` where none can; names the first."""
    first: DataError | None = None
    for item in items:
        try:
            _prepared(store[item], future, CHALLENGES["2025"])
            return
        except DataError as error:
            first = first or error
    if first is not None:
        raise first


def _prepared(segment: RunSegment, future: int, config: WosacConfig) -> tuple[RunSegment, WosacScenario]:
    """Return the window of a segment and its scored part, if it can be scored."""
    window = wosac_window(segment, future)
    scenario = wosac_scenario(window)
    check_scored(scenario, config)
    return window, scenario


class _Scored(NamedTuple):
    """The recording of a run segment, how many of its objects are scored, and the results by agent."""

    group: str
    objects: int
    results: dict[str, SegmentResult]


@dataclass(frozen=True)
class _SegmentScorer:
    """Simulates agents on a run segment and scores them."""

    agents: list[Agent]
    store: SegmentStore
    settings: WosacSettings
    config: str
    strict: bool

    def __call__(self, items: list[int]) -> _Scored | Skip:
        """Return the scores, or why there are none."""
        segment = self.store[items[0]]
        try:
            window, scenario = _prepared(segment, self.settings.future, CHALLENGES[self.config])
        except DataError as error:
            if self.strict:
                raise
            return Skip.of(error, segment.file, segment.segment_id)
        found = {}
        for agent in self.agents:
            began = time.process_time()
            made = self._made(agent, window)
            seconds = time.process_time() - began
            found[agent.name] = SegmentResult(score(scenario, made, CHALLENGES[self.config]), seconds)
        return _Scored(segment.group or segment.segment_id, len(scenario.evaluated), found)

    def _made(self, agent: Agent, window: RunSegment) -> SimulatedRollouts:
        if agent.policy is None:
            return log_playback(window)
        # What a search is told concerns the agent alone, which is the last one.
        plain = dataclasses.replace(self.settings, search="none")
        return wosac_rollouts(agent, window, self.settings if agent is self.agents[-1] else plain)
