"""The WOSAC score of an agent on any run segments, beside log playback and constant velocity."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from symphony.agents import Agent, load_agent
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
from symphony.evaluation.passing import PassingGaps, order_of, passing_gaps, passing_pairs
from symphony.metrics import OrderStatistics
from symphony.metrics.wosac import CHALLENGES, SimulatedRollouts, WosacScenario, WosacScores, score
from symphony.simulation.driving import search_kind
from symphony.simulation.workers import shared
from symphony.simulation.wosac import between_decisions, constant_velocity, wosac_rollouts

WOSAC_BASELINES = (*BASELINES, "random")
"""Scored beside every agent: log playback, constant velocity, and vehicles that act at random."""
THINNED = "playback_thinned"
"""Log playback of the steps at which the agent decides, interpolated between them as its rollouts are."""
_FIRST = (BASELINES[0], THINNED, *WOSAC_BASELINES[1:])

_AWAY, _APART = 1e5, 1e3
"""Metres from the origin, and from one another, at which agents do not meet anyone."""
_TIMED = ("position", "heading", "velocity", "valid", "signal_state")


@dataclass(frozen=True)
class WosacResult:
    """What was found of one agent.

    Attributes:
        scores: of every run segment.
        passing: who goes first there.
        seconds: CPU time of the simulation.
    """

    scores: list[WosacScores] = field(default_factory=list)
    passing: list[PassingGaps] = field(default_factory=list)
    seconds: float = 0.0

    def joined(self, other: WosacResult) -> WosacResult:
        """Of both."""
        return WosacResult(
            self.scores + other.scores, self.passing + other.passing, self.seconds + other.seconds
        )


@dataclass(frozen=True)
class WosacEvaluation:
    """Scores of an agent and of the baselines.

    Attributes:
        config: year of the challenge.
        agent: its name.
        how: what decides the rollouts, see :func:`simulated_how`.
        data: name and checksum of the store.
        segments: ids of the run segments.
        groups: [K] the recording of each.
        results: by agent.
    """

    config: str
    agent: str
    how: dict[str, Any]
    data: dict[str, str]
    segments: list[str]
    groups: list[str]
    results: dict[str, WosacResult]

    def numbers(self, agent: str) -> dict[str, tuple[float, float]]:
        """Mean of every number over run segments, and its standard error over recordings (NaN for a single one)."""
        rows = [scores.to_dict() for scores in self.results[agent].scores]
        groups = np.unique(self.groups, return_inverse=True)[1]
        return {name: clustered_mean(np.array([row[name] for row in rows]), groups) for name in rows[0]}

    def order(self, agent: str) -> OrderStatistics:
        """Who goes first, of all pairs of vehicles that merge or cross in the logs."""
        return order_of(self.results[agent].passing)

    def record(self) -> dict[str, Any]:
        """As JSON can hold it."""
        agents = {}
        for name, found in self.results.items():
            order = dataclasses.asdict(self.order(name))
            agents[name] = {
                **flat_numbers(self.numbers(name)),
                "order": {key: None if math.isnan(value) else value for key, value in order.items()},
                "seconds": found.seconds,
                "segments": {
                    segment: one.to_dict() for segment, one in zip(self.segments, found.scores, strict=True)
                },
            }
        return {
            "config": self.config,
            "agent": self.agent,
            "how": self.how,
            "data": self.data,
            "recordings": len(set(self.groups)),
            "agents": agents,
        }


def wosac_parts(found: WosacEvaluation, record: Mapping[str, Any]) -> dict[str, Any]:
    """What the score adds to the record of an evaluation (see :mod:`symphony.evaluation.records`).

    Args:
        found: of the same agent on the same store.
        record: the evaluation.

    Returns:
        ``wosac``: all of it; the numbers of the agent with ``wosac_`` before their names, and the parts of the
        baselines with theirs.
    """

    def named(agent: str) -> dict[str, Any]:
        return {f"wosac_{name}": value for name, value in flat_numbers(found.numbers(agent)).items()}

    parts = {name: record[name] | named(name) for name in found.results if name in BASELINES}
    return {"wosac": found.record(), **parts, **named(found.agent)}


def flat_numbers(numbers: dict[str, tuple[float, float]]) -> dict[str, float | None]:
    """Means, then standard errors with ``_se`` after their names, None where there is none."""
    return {
        **{name: mean for name, (mean, _) in numbers.items()},
        **{f"{name}_se": None if math.isnan(error) else error for name, (_, error) in numbers.items()},
    }


def simulated_how(agent: Agent, settings: WosacSettings) -> dict[str, Any]:
    """What decides the rollouts, with what was left to the agent filled in."""
    config = settings.config(ROLLOUTS, settings.seed)
    kind, pruning = search_kind(agent, config), config.pruning(agent.search)
    found: dict[str, Any] = {"search": kind, "seed": settings.seed}
    if agent.goals is not None:
        found["logged_goals"] = settings.logged_goals
    if kind != "none":
        found["branches"] = settings.branches or agent.search.test_branches
    if kind == "tree":
        found |= {"rule": pruning.rule, "prune_every": pruning.prune_every, "goals": settings.goals}
        found |= {"temperature": pruning.temperature} if pruning.rule == "systematic" else {}
        found |= {"threshold": pruning.threshold} if pruning.rule == "replace" else {}
        found |= {"retries": settings.retries} if settings.retries else {}
    return found


def evaluate_wosac(
    agent: Agent,
    store: SegmentStore,
    items: Sequence[int],
    settings: WosacSettings,
    config: str = "2025",
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    baselines: bool = True,
) -> WosacEvaluation:
    """Score an agent on run segments of a store, and beside it :data:`WOSAC_BASELINES`.

    Where the store has shorter steps than the agent decides in, there is also :data:`THINNED`: what the agent's rate
    costs by itself.

    Args:
        agent: drives the vehicles.
        store: of segments with any time step.
        items: numbers of the run segments.
        settings: how the agent is simulated.
        config: year of the challenge.
        progress: called with the segments done and their total.
        baselines: with them.

    Raises:
        ConfigError: no such year, or the agent can't be simulated so.
        DataError: the store is empty, or a segment can't be scored; names it.
        NotFiniteError: a network of the agent puts out a number that is not finite.
    """
    if config not in CHALLENGES:
        raise ConfigError(f"config must be one of {', '.join(CHALLENGES)}, is {config}")
    if not items:
        raise DataError("the store holds no run segments", file=store.path)
    how = simulated_how(agent, settings) if agent.policy is not None else {"search": "log"}
    others = [load_agent(name, settings.device) for name in WOSAC_BASELINES] if baselines else []
    everyone = [*(other for other in others if other.name != agent.name), agent]
    thinned = _thinned(agent, store, items) if baselines else 1
    names = [one.name for one in everyone] + [THINNED] * (thinned > 1)
    results = dict.fromkeys(sorted(names, key=_place), WosacResult())
    scorer, groups = _SegmentScorer(everyone, store, settings, config, thinned), []
    tasks = [[item] for item in items]
    with closing(shared(scorer, tasks, settings.config(1, 0))) as found:
        for done, (group, parts) in enumerate(found, 1):
            groups.append(group)
            results = {name: result.joined(parts[name]) for name, result in results.items()}
            progress(done, len(items))
    return WosacEvaluation(
        config=config,
        agent=agent.name,
        how=how,
        data={"name": store.path.resolve().name, "checksum": store.checksum()},
        segments=[store.ids[item] for item in items],
        groups=groups,
        results=results,
    )


def _place(name: str) -> int:
    return _FIRST.index(name) if name in _FIRST else len(_FIRST)


def _thinned(agent: Agent, store: SegmentStore, items: Sequence[int]) -> int:
    """Steps of 0.1 s to a decision of the agent, where the store has all of them and a rollout whole decisions; 1
    where not.
    """
    if agent.spec is None or (store.time_steps[list(items)] > DT + 1e-6).any():
        return 1
    every = round(agent.spec.dt / DT)
    return every if abs(every * DT - agent.spec.dt) < 1e-6 and FUTURE % every == 0 else 1


@dataclass(frozen=True)
class _SegmentScorer:
    """Simulates agents on a run segment and scores them."""

    agents: list[Agent]
    store: SegmentStore
    settings: WosacSettings
    config: str
    thinned: int

    def __call__(self, items: list[int]) -> tuple[str, dict[str, WosacResult]]:
        """The recording, and what was found of each agent."""
        segment = self.store[items[0]]
        window, scenario = wosac_window(segment), wosac_scenario(segment)
        pairs = passing_pairs(window)
        found = {}
        for name, make in self._makers(window).items():
            began = time.process_time()
            made = make()
            seconds = time.process_time() - began
            scores = score(scenario, SimulatedRollouts.of(**vars(made)), CHALLENGES[self.config])
            found[name] = WosacResult([scores], [passing_gaps(window, pairs, made)], seconds)
        return segment.group or segment.segment_id, found

    def _makers(self, window: RunSegment) -> dict[str, Callable[[], RolloutArrays]]:
        makers: dict[str, Callable[[], RolloutArrays]] = {}
        for agent in self.agents:
            if agent.policy is None:
                makers[agent.name] = partial(log_playback, window)
            elif agent.name == BASELINES[1]:
                makers[agent.name] = partial(constant_velocity, window)
            else:
                makers[agent.name] = partial(wosac_rollouts, agent, window, self.settings)
        if self.thinned > 1:
            makers[THINNED] = partial(log_playback, window, self.thinned)
        return makers


def wosac_window(segment: RunSegment) -> RunSegment:
    """The first 9 s of a segment as the challenge has them: 91 steps of 0.1 s, of which step 10 is the current one.

    Other time steps are brought to 0.1 s by :func:`symphony.data.resample.resample`. Of a segment between 8 and 9 s
    the future is kept whole and the history is shorter: its first steps are valid for nobody, and go back from the
    first logged one at its velocity, so that there is no jump in speed.

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

    found = {name: taken(getattr(tenth, name)) for name in _TIMED}
    back = np.arange(-missing, 0)[:, None] * DT
    found["position"][:, :missing] = tenth.position[:, :1]
    found["position"][:, :missing, :2] += tenth.velocity[:, :1] * back
    found["heading"][:, :missing] = tenth.heading[:, :1]
    return tenth.replace(dt=DT, current_step=CURRENT, **found)


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


def log_playback(window: RunSegment, every: int = 1) -> RolloutArrays:
    """32 times the log of a :func:`wosac_window`; agents that it does not see are far away from everyone.

    Args:
        window: the log.
        every: take one in so many steps, and between valid ones interpolate as in
            :func:`symphony.simulation.wosac.wosac_rollouts`; a divisor of 80.
    """
    rows = np.flatnonzero(window.valid[:, CURRENT])
    valid = window.valid[rows, CURRENT:]
    place = (window.position[rows, CURRENT:] + window.origin).astype(np.float64)
    heading = window.heading[rows, CURRENT:].astype(np.float64)
    if every > 1:
        states = np.concatenate([place[..., :2], heading[..., None]], -1).swapaxes(0, 1)
        between = between_decisions(states[None, ::every], every * DT)[0]
        steps = np.arange(1, FUTURE + 1)
        known = valid[:, steps // every * every] & valid[:, -(-steps // every) * every]
        place[:, 1:, :2] = np.where(known[..., None], between[..., :2], place[:, 1:, :2])
        heading[:, 1:] = np.where(known, between[..., 2], heading[:, 1:])
    away = np.zeros((len(rows), 1, 3))
    away[:, 0, 0] = _AWAY + _APART * np.arange(len(rows))
    place = np.where(valid[:, 1:, None], place[:, 1:], away + window.origin)
    states = np.concatenate([place, heading[:, 1:, None]], -1)
    return RolloutArrays(window.agent_id[rows], *np.moveaxis(np.repeat(states[None], ROLLOUTS, 0), -1, 0))
