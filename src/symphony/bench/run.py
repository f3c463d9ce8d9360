"""Drive a suite: simulate, judge, and stop where the verdict can't change any more."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from symphony.agents.agent import load_agent
from symphony.bench.measures import MEASURES, Estimate, Kind, Run, estimate, measured, paired
from symphony.bench.published import pdm
from symphony.bench.suite import Crowd, Suite, SuitePlanner, Threshold
from symphony.errors import AllFailedError, DataError
from symphony.evaluation.planners import Record, crowd_differences, run_score
from symphony.evaluation.report import Report, report
from symphony.files import Lock, read_object, write_file, write_json
from symphony.render.viewer import view_page
from symphony.rollouts.crowd import crowd_dataset
from symphony.saved.folder import RolloutFolder
from symphony.saved.saving import save_simulation

FORMAT = 1
"""Version of a result."""
ROUNDS = 4
"""Parts in which the segments of a pair are simulated; after each the verdict may be clear."""
DROP = 10.0
"""Points of score that a run must lose against the baseline's to be called a regression."""
EVENTS = {"failed": "fails", "at_fault_collision": "collides, at fault"}
EVENTS |= {"red_lights": "runs a red light", "offroad_time": "leaves the road"}
"""Events that are a regression if the baseline's run did not show them, in words."""

Status = Literal["passes", "fails", "undecided"]


Progress = Callable[[str, int, int], None]
"""Called with a pair's name, the runs done and their total."""


@dataclass(frozen=True)
class Verdict:
    """The verdict on whether a planner keeps a threshold in a crowd.

    Attributes:
        status: ``undecided`` where the metric is not defined, or the pair was stopped before it was known.
        found: the metric.
        bound: what was compared with the limit: the mean, or its bound.
    """

    threshold: Threshold
    planner: str
    crowd: str
    status: Status
    found: Estimate
    bound: float | None


@dataclass
class Pair:
    """A planner in a crowd: how many runs are planned, where they are kept, and what happened in them so far."""

    planner: SuitePlanner
    crowd: Crowd
    planned: int
    folder: Path
    report: Report = field(default_factory=lambda: Report("", "ego"))
    traffic: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def name(self) -> str:
        """The names of the planner and the crowd."""
        return f"{self.planner.name} among {self.crowd.name}"

    @property
    def runs(self) -> list[Run]:
        """The report's row for each run."""
        return self.report.rows

    @property
    def stopped(self) -> bool:
        """Whether its verdict was clear before all runs were simulated."""
        return len(self.runs) < self.planned


@dataclass
class Result:
    """The result of a suite."""

    suite: Suite
    pairs: list[Pair]
    verdicts: list[Verdict]
    regressions: list[dict[str, Any]]
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether every threshold is kept."""
        return all(one.status == "passes" for one in self.verdicts)

    def plain(self) -> dict[str, Any]:
        """Return all of it in types that JSON can hold."""

        def verdict(one: Verdict) -> dict[str, Any]:
            limit, found = one.threshold, one.found
            who = {"planner": one.planner, "crowd": one.crowd, "threshold": str(limit), "metric": limit.metric}
            what = {"compared": limit.compared, "status": one.status, "value": found.mean, "bound": one.bound}
            return {**who, **what, "limit": limit.limit, "runs": found.runs, "groups": found.groups}

        def pair(one: Pair) -> dict[str, Any]:
            return {
                **{"planner": one.planner.name, "crowd": one.crowd.name, "planned": one.planned},
                **{"stopped": one.stopped, "seconds": round(one.seconds, 1)},
                "numbers": {name: measured(one.runs, measure).mean for name, measure in MEASURES.items()},
                **one.traffic,
                "per_run": [{**run, "score": run_score(run)} for run in one.runs],
            }

        return {
            "format": FORMAT,
            "suite": self.suite.name,
            "passed": self.passed,
            "store": {"path": str(self.suite.store.path), "checksum": self.suite.store.checksum()},
            "seconds": round(self.seconds, 1),
            "verdicts": [verdict(one) for one in self.verdicts],
            "regressions": self.regressions,
            "pairs": [pair(one) for one in self.pairs],
        }


def run_suite(suite: Suite, out: Path, progress: Progress = lambda *_: None, *, view: bool = True) -> Result:
    """Simulate and judge a suite; an interrupted one continues where it stopped. The folder ``out`` receives
    ``result.json`` and, below ``PLANNER/CROWD``, the rollouts, with a page that plays them if ``view`` is true.

    Raises:
        AllFailedError: every run failed.
        SymphonyError: it could not run; names what stands in the way.
    """
    began = time.perf_counter()
    with Lock(out / "suite.lock"):
        earlier, pairs = _earlier(suite), []
        # The baseline comes first: others are compared with it.
        for planner in sorted(suite.planners, key=lambda one: one.name != suite.baseline):
            for crowd in suite.crowds:
                planned = len(suite.items) * crowd.config.rollouts
                pairs.append(Pair(planner, crowd, planned, out / planner.name / crowd.name))
                _drive(suite, pairs[-1], earlier.get((planner.name, crowd.name), {}), progress)
        order = [one.name for one in suite.planners]
        pairs.sort(key=lambda pair: (suite.crowds.index(pair.crowd), order.index(pair.planner.name)))
        runs = [run for pair in pairs for run in pair.runs]
        if all(run["failed"] for run in runs):
            raise AllFailedError(f"every run failed, the first: {runs[0]['failed']}")
        base = {names: one["per_run"] for names, one in earlier.items()}
        for pair in pairs:
            if pair.planner.name == suite.baseline:
                base |= {(one, pair.crowd.name): pair.runs for one in order if one != suite.baseline}
        verdicts, regressions = [], []
        for pair in pairs:
            before = base.get((pair.planner.name, pair.crowd.name), [])
            verdicts += judged(suite, pair, before)
            regressions += find_regressions(pair, before)
            if view:
                folder = RolloutFolder(pair.folder)
                replays = ([pair.report.replay(one)] for one in folder)
                write_file(pair.folder / "view.html", view_page([pair.name], replays))
        result = Result(suite, pairs, verdicts, regressions, time.perf_counter() - began)
        write_json(out / "result.json", result.plain())
    return result


def _drive(suite: Suite, pair: Pair, before: Record, progress: Progress) -> None:
    """Simulate a pair part by part, until its verdict is clear. A :class:`DataError` says what differs if it did not
    meet the traffic that it met ``before``.
    """
    began, config = time.perf_counter(), pair.crowd.config
    agent = load_agent(pair.crowd.agent, config.device)
    # Beside log playback no other agent is simulated.
    others = 1 if agent.policy is None else agent.interactive
    pair.report.agent = pair.name
    for part in range(min(ROUNDS, len(suite.items))):
        items = suite.items[part::ROUNDS]

        def tell(count: int, _: int, done: int = len(pair.runs)) -> None:
            progress(pair.name, done + count * config.rollouts, pair.planned)

        folder = save_simulation(
            pair.folder,
            agent,
            crowd_dataset(suite.store, agent, config, items, default=others, routes=True),
            config,
            planner=pair.planner.planner,
            planner_seconds=pair.planner.seconds,
            progress=tell,
        ).only(suite.store.ids[i] for i in items)
        about, found = folder.about, report(folder, "ego")
        pair.traffic = {"driver": about.drivers["interactive"], "settings": dict(about.settings)}
        if before:
            now = before | pair.traffic
            both = ({**one, "crowd": one["driver"], "store": dict(about.store)} for one in (now, before))
            if differing := crowd_differences(*both):
                what = f"{pair.name} met other traffic then: {', '.join(differing)} differ"
                raise DataError(what, file=Path(suite.baseline), field="pairs")
        pair.report.rows += with_pdm(found, folder)
        pair.report.events |= found.events
        pair.report.collision_in |= found.collision_in
        # The rest need not be simulated where some threshold can't be kept any more.
        if pair.planner.name != suite.baseline and any(_beyond(one, pair) for one in _thresholds(suite, pair)):
            break
    pair.seconds = time.perf_counter() - began


def with_pdm(found: Report, folder: RolloutFolder) -> list[Run]:
    """Return the rows of a report with the PDM score of each run."""
    rows = {(row["segment"], row["rollout"]): row for row in found.rows}
    for saved in folder:
        name = saved.segment.segment_id
        for k in range(saved.rollouts):
            events = [one for one in found.events[name] if one.rollout == k and one.kind == "collision"]
            terms = pdm(rows[name, k], saved, [one.other for one in events if one.fault])
            rows[name, k]["pdm_score"] = None if terms is None else terms.score
    return [{"pdm_score": 0.0 if row["failed"] else None, **row} for row in found.rows]


def _beyond(one: Threshold, pair: Pair) -> bool:
    """Return whether a rate will be beyond its limit even if nothing happens in the remaining runs. The mean of all
    runs is beyond the limit then, and so is its bound: stopping changes no verdict.
    """
    measure = MEASURES[one.metric]
    if one.compared or one.side != "at_most" or measure.kind != "rate":
        return False
    known = [value for run in pair.runs if (value := measure.of(run)) is not None]
    # The runs that are left may all count.
    count = len(known) + pair.planned - len(pair.runs)
    return count > 0 and sum(known) / count > one.limit


def _thresholds(suite: Suite, pair: Pair) -> list[Threshold]:
    """Return the thresholds of a pair. Failed runs are bad: if no threshold allows them, none may fail."""
    planner, crowd = pair.planner.name, pair.crowd.name
    found = [one for one in suite.thresholds if planner in one.planners and crowd in one.crowds]
    # The baseline is not compared with itself.
    found = [one for one in found if not (one.compared and planner == suite.baseline)]
    if all(one.metric != "failed_rate" for one in found):
        found.append(Threshold("failed_rate", 0.0, "at_most", None, (planner,), (crowd,)))
    return found


def judged(suite: Suite, pair: Pair, base: Sequence[Run]) -> list[Verdict]:
    """Return the verdicts of a pair after its runs, compared with the baseline's in this crowd."""
    found = []
    for one in _thresholds(suite, pair):
        measure, sure = MEASURES[one.metric], one.confidence or 0.95
        if one.compared:
            kind: Kind = "mean" if measure.kind == "mean" else "difference"
            known = estimate(*paired(pair.runs, base, measure.of), sure, kind)
        else:
            known = measured(pair.runs, measure, sure)
        bound = known.mean if one.confidence is None else known.high if one.side == "at_most" else known.low
        # A pair that was stopped has lost one threshold, and leaves the others open.
        if bound is None or (pair.stopped and not _beyond(one, pair)):
            status: Status = "undecided"
        else:
            keeps = bound <= one.limit if one.side == "at_most" else bound >= one.limit
            status = "passes" if keeps else "fails"
        found.append(Verdict(one, pair.planner.name, pair.crowd.name, status, known, bound))
    return found


def find_regressions(pair: Pair, base: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the runs that were worse than the baseline's of the same segment and rollout, and how."""
    before = {(run["segment"], run["rollout"]): run for run in base}
    found = []
    for run in pair.runs:
        other = before.get((run["segment"], run["rollout"]))
        if other is None:
            continue
        what = [text for name, text in EVENTS.items() if run[name] and not other[name]]
        here, there = run_score(run), run_score(other)
        if not what and here is not None and there is not None and there - here > DROP:
            what = [f"scores {here:.0f}, not {there:.0f}"]
        if what:
            who = {"planner": pair.planner.name, "crowd": pair.crowd.name, "seed": pair.crowd.config.seed}
            where = {"segment": run["segment"], "rollout": run["rollout"], "what": ", ".join(what)}
            found.append({**who, **where})
    return found


def _earlier(suite: Suite) -> dict[tuple[str, str], Record]:
    """Return the pairs of an earlier result that is the baseline, by planner and crowd."""
    if not isinstance(suite.baseline, Path):
        return {}
    try:
        found = read_object(suite.baseline)
        if found["format"] != FORMAT:
            raise DataError(f"has format {found['format']}, not {FORMAT}", file=suite.baseline)
        if found["store"]["checksum"] != suite.store.checksum():
            raise DataError("is of other run segments", file=suite.baseline, field="store")
        return {(one["planner"], one["crowd"]): one for one in found["pairs"] if list(one["per_run"])}
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"is not the result of a suite: {error!r}", file=suite.baseline) from error
