"""The WOSAC score of an agent on any run segments, beside log playback and constant velocity."""

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
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation.evaluator import BASELINES
from symphony.metrics import OrderStatistics
from symphony.metrics.intervals import clustered_mean
from symphony.rollouts.workers import shared
from symphony.wosac.passing import PassingGaps, order_of, passing_gaps, passing_pairs
from symphony.wosac.scorer import (
    CHALLENGES,
    SimulatedRollouts,
    WosacConfig,
    WosacScenario,
    check_scored,
    score,
)
from symphony.wosac.scorer.config import FUTURE, ROLLOUTS
from symphony.wosac.segments import log_playback, wosac_scenario, wosac_window
from symphony.wosac.simulate import constant_velocity, wosac_rollouts

WOSAC_BASELINES = (*BASELINES, "idm", "random")
"""Scored beside every agent: log playback, constant velocity, the intelligent driver model along the lanes, and
vehicles that act at random."""


class SegmentResult(NamedTuple):
    """What was found of an agent on a run segment: its scores (see :func:`symphony.wosac.scorer.score`), who goes
    first there, and CPU seconds of the simulation.
    """

    scores: dict[str, float]
    passing: PassingGaps
    seconds: float


@dataclass(frozen=True)
class WosacEvaluation:
    """Scores of an agent and of the baselines.

    Attributes:
        config: year of the challenge.
        agent: its name.
        how: what decides the rollouts, see :func:`simulated_how`.
        data: name and checksum of the store.
        segments: [K] ids of the run segments that were scored.
        groups: [K] the recording of each.
        objects: [K] how many of its objects are scored.
        rates: [K] steps per second of its log in the store; the score brings all to 10.
        results: [K] by agent.
        left_out: run segments that can't be scored, and why.
    """

    config: str
    agent: str
    how: dict[str, Any]
    data: dict[str, str]
    segments: list[str]
    groups: list[str]
    objects: list[int]
    rates: list[float]
    results: dict[str, list[SegmentResult]]
    left_out: list[Skip]

    def numbers(self, agent: str) -> dict[str, tuple[float, float]]:
        """Mean of every number over run segments, and its standard error over recordings (NaN for a single one)."""
        rows = [one.scores for one in self.results[agent]]
        groups = np.unique(self.groups, return_inverse=True)[1]
        return {name: clustered_mean(np.array([row[name] for row in rows]), groups) for name in rows[0]}

    def flat(self, agent: str) -> dict[str, float | None]:
        """Means, then standard errors with ``_se`` after their names, None where there is none."""
        numbers = self.numbers(agent)
        errors = {f"{name}_se": None if math.isnan(error) else error for name, (_, error) in numbers.items()}
        return {**{name: mean for name, (mean, _) in numbers.items()}, **errors}

    def order(self, agent: str) -> OrderStatistics:
        """Who goes first, of all pairs of vehicles that merge or cross in the logs."""
        return order_of([one.passing for one in self.results[agent]])

    def record(self) -> dict[str, Any]:
        """As JSON can hold it."""
        agents = {}
        for name, found in self.results.items():
            order = dataclasses.asdict(self.order(name))
            agents[name] = {
                **self.flat(name),
                "order": {key: None if math.isnan(value) else value for key, value in order.items()},
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
    """What the score adds to the record of an evaluation of the same agent on the same store (see
    :mod:`symphony.evaluation.records`): ``wosac``, all of it; the numbers of the agent with ``wosac_`` before their
    names, and the parts of the baselines with theirs.
    """

    def named(agent: str) -> dict[str, Any]:
        return {f"wosac_{name}": value for name, value in found.flat(agent).items()}

    parts = {name: record[name] | named(name) for name in found.results if name in BASELINES}
    return {"wosac": found.record(), **parts, **named(found.agent)}


def simulated_how(agent: Agent, settings: WosacSettings) -> dict[str, Any]:
    """What decides the rollouts, with what was left to the agent filled in."""
    config = settings.config(ROLLOUTS, settings.seed)
    kind, _, branches, _, pruning = agent.plan(config)
    replaces = kind == "backtrack" or (kind == "tree" and pruning.rule == "replace")
    said: dict[str, tuple[bool, Any]] = {
        "search": (True, kind),
        "seed": (True, settings.seed),
        "horizon": (settings.future != FUTURE, settings.horizon),
        "logged_goals": (agent.goals is not None, settings.logged_goals),
        "action_temperature": (settings.action_temperature != 1.0, settings.action_temperature),
        "score": (kind != "none" and pruning.score != "discriminator", pruning.score),
        "branches": (kind in ("tree", "best"), branches),
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
    """Score an agent on run segments of a store, and beside it :data:`WOSAC_BASELINES`.

    Args:
        agent: drives the vehicles.
        store: of segments with any time step.
        items: numbers of the run segments.
        settings: how the agent is simulated.
        config: year of the challenge.
        progress: called with the segments done and their total.
        baselines: with them.
        strict: a run segment that can't be scored (too short, without road edges, vehicles or a future) is an error
            instead of being left out.

    Raises:
        ConfigError: no such year, or the agent can't be simulated so.
        DataError: the store is empty, or no segment can be scored; names the first.
        NotFiniteError: a network of the agent puts out a number that is not finite.
    """
    if config not in CHALLENGES:
        raise ConfigError(f"config must be one of {', '.join(CHALLENGES)}, is {config}")
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
    """See that some run segment can be scored.

    Raises:
        DataError: none can; names the first.
    """
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
    """The window of a segment and what is scored of it, if it can be."""
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
        """What was found, or why there is nothing."""
        segment = self.store[items[0]]
        try:
            window, scenario = _prepared(segment, self.settings.future, CHALLENGES[self.config])
        except DataError as error:
            if self.strict:
                raise
            return Skip.of(error, segment.file, segment.segment_id)
        pairs = passing_pairs(window)
        found = {}
        for agent in self.agents:
            began = time.process_time()
            made = self._made(agent, window)
            seconds = time.process_time() - began
            scores = score(scenario, made, CHALLENGES[self.config])
            found[agent.name] = SegmentResult(scores, passing_gaps(window, pairs, made), seconds)
        return _Scored(segment.group or segment.segment_id, len(scenario.evaluated), found)

    def _made(self, agent: Agent, window: RunSegment) -> SimulatedRollouts:
        if agent.policy is None:
            return log_playback(window)
        if agent.name == BASELINES[1]:
            return constant_velocity(window, self.settings.future)
        # What a search is told concerns the agent alone, which is the last one.
        plain = dataclasses.replace(self.settings, search="none")
        return wosac_rollouts(agent, window, self.settings if agent is self.agents[-1] else plain)
