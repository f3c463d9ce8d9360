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
from symphony.data.report import Skip
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation.evaluator import BASELINES
from symphony.metrics import OrderStatistics
from symphony.metrics.intervals import clustered_mean
from symphony.rollouts.workers import shared
from symphony.wosac.passing import PassingGaps, order_of, passing_gaps, passing_pairs
from symphony.wosac.records import DT
from symphony.wosac.rollouts import RolloutArrays
from symphony.wosac.scorer import CHALLENGES, SimulatedRollouts, WosacScores, check_scored, score
from symphony.wosac.segments import log_playback, wosac_scenario, wosac_window
from symphony.wosac.simulate import constant_velocity, wosac_rollouts
from symphony.wosac.submission import FUTURE, ROLLOUTS

WOSAC_BASELINES = (*BASELINES, "random")
"""Scored beside every agent: log playback, constant velocity, and vehicles that act at random."""
THINNED = "playback_thinned"
"""Log playback of the steps at which the agent decides, interpolated between them as its rollouts are."""
_FIRST = (BASELINES[0], THINNED, *WOSAC_BASELINES[1:])


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
        segments: ids of the run segments that were scored.
        groups: [K] the recording of each.
        results: by agent.
        left_out: run segments that can't be scored, and why.
    """

    config: str
    agent: str
    how: dict[str, Any]
    data: dict[str, str]
    segments: list[str]
    groups: list[str]
    results: dict[str, WosacResult]
    left_out: list[Skip] = field(default_factory=list)

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
            "left_out": [skip.to_json() for skip in self.left_out],
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
    kind, _, branches, _, pruning = agent.plan(config)
    found: dict[str, Any] = {"search": kind, "seed": settings.seed}
    found |= {"horizon": settings.horizon} if settings.future != FUTURE else {}
    if agent.goals is not None:
        found["logged_goals"] = settings.logged_goals
    if settings.action_temperature != 1.0:
        found["action_temperature"] = settings.action_temperature
    if kind != "none" and pruning.score != "discriminator":
        found["score"] = pruning.score
    if kind == "backtrack":
        found |= {"prune_every": pruning.prune_every, "threshold": pruning.threshold}
    if kind in ("tree", "best"):
        found["branches"] = branches
    if kind == "tree":
        found |= {"rule": pruning.rule, "prune_every": pruning.prune_every, "goals": pruning.goals}
        found |= {"temperature": pruning.temperature} if pruning.rule == "systematic" else {}
        found |= {"threshold": pruning.threshold} if pruning.rule == "replace" else {}
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
    strict: bool = False,
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
    others = [load_agent(name, settings.device) for name in WOSAC_BASELINES] if baselines else []
    everyone = [*(other for other in others if other.name != agent.name), agent]
    thinned = _thinned(agent, store, items, settings.future) if baselines else 1
    names = [one.name for one in everyone] + [THINNED] * (thinned > 1)
    results = dict.fromkeys(sorted(names, key=_place), WosacResult())
    scorer = _SegmentScorer(everyone, store, settings, config, thinned, strict)
    scored: list[tuple[int, str]] = []
    left_out: list[Skip] = []
    tasks = [[item] for item in items]
    with closing(shared(scorer, tasks, settings.config(1, 0))) as outcomes:
        for done, (item, found) in enumerate(zip(items, outcomes, strict=True), 1):
            if isinstance(found, Skip):
                left_out.append(found)
            else:
                scored.append((item, found[0]))
                results = {name: result.joined(found[1][name]) for name, result in results.items()}
            progress(done, len(items))
    if not scored:
        raise left_out[0].error
    return WosacEvaluation(
        config=config,
        agent=agent.name,
        how=how,
        data={"name": store.path.resolve().name, "checksum": store.checksum()},
        segments=[store.ids[item] for item, _ in scored],
        groups=[group for _, group in scored],
        results=results,
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
            return check_scored(wosac_scenario(store[item], future))
        except DataError as error:
            first = first or error
    if first is not None:
        raise first


def _place(name: str) -> int:
    return _FIRST.index(name) if name in _FIRST else len(_FIRST)


def _thinned(agent: Agent, store: SegmentStore, items: Sequence[int], future: int = FUTURE) -> int:
    """Steps of 0.1 s to a decision of the agent, where the store has all of them and a rollout whole decisions; 1
    where not.
    """
    if agent.spec is None or (store.time_steps[list(items)] > DT + 1e-6).any():
        return 1
    every = round(agent.spec.dt / DT)
    return every if abs(every * DT - agent.spec.dt) < 1e-6 and future % every == 0 else 1


@dataclass(frozen=True)
class _SegmentScorer:
    """Simulates agents on a run segment and scores them."""

    agents: list[Agent]
    store: SegmentStore
    settings: WosacSettings
    config: str
    thinned: int
    strict: bool

    def __call__(self, items: list[int]) -> tuple[str, dict[str, WosacResult]] | Skip:
        """The recording, and what was found of each agent; or why there is nothing."""
        segment = self.store[items[0]]
        future = self.settings.future
        try:
            window, scenario = wosac_window(segment, future), wosac_scenario(segment, future)
            check_scored(scenario, CHALLENGES[self.config])
        except DataError as error:
            if self.strict:
                raise
            return Skip.of(error, segment.file, segment.segment_id)
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
                makers[agent.name] = partial(constant_velocity, window, self.settings.future)
            else:
                makers[agent.name] = partial(wosac_rollouts, agent, window, self.settings)
        if self.thinned > 1:
            makers[THINNED] = partial(log_playback, window, self.thinned)
        return makers
