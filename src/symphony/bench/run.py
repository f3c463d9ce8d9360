"""Drive a suite: simulate, judge, and stop where the verdict can't change any more."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from symphony.agents.agent import load_agent
from symphony.bench.measures import MEASURES, Estimate, estimate, paired
from symphony.bench.published import pdm
from symphony.bench.suite import Crowd, Suite, SuitePlanner, Threshold
from symphony.errors import AllFailedError, DataError
from symphony.evaluation.planners import run_score
from symphony.evaluation.report import Report, report
from symphony.files import Lock, write_file, write_json
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
EVENTS = {
    "failed": "fails",
    "at_fault_collision": "collides, at fault",
    "red_lights": "runs a red light",
    "offroad_time": "leaves the road",
}
"""What a run of the baseline's did not show, for a regression; in words."""

Status = Literal["passes", "fails", "undecided"]


@dataclass(frozen=True)
class Verdict:
    """Whether a planner keeps a threshold in a crowd.

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
    """A planner in a crowd.

    Attributes:
        report: its runs so far, and what happened in them.
        planned: runs that the suite asks for.
        folder: of its rollouts.
    """

    planner: SuitePlanner
    crowd: Crowd
    planned: int
    folder: Path
    report: Report = field(default_factory=lambda: Report("", "ego"))
    seconds: float = 0.0

    @property
    def runs(self) -> list[dict[str, Any]]:
        """A row for each run."""
        return self.report.rows

    @property
    def stopped(self) -> bool:
        """Whether its verdict was clear before all runs were simulated."""
        return len(self.runs) < self.planned


@dataclass
class Result:
    """What a suite found."""

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
        """All of it, as JSON can hold it."""
        return {
            "format": FORMAT,
            "suite": self.suite.name,
            "passed": self.passed,
            "store": {"path": str(self.suite.store.path), "checksum": self.suite.store.checksum()},
            "seconds": round(self.seconds, 1),
            "verdicts": [
                {
                    "planner": one.planner,
                    "crowd": one.crowd,
                    "threshold": str(one.threshold),
                    "metric": one.threshold.metric,
                    "compared": one.threshold.compared,
                    "status": one.status,
                    "value": one.found.mean,
                    "bound": one.bound,
                    "limit": one.threshold.limit,
                    "runs": one.found.runs,
                    "groups": one.found.groups,
                }
                for one in self.verdicts
            ],
            "regressions": self.regressions,
            "pairs": [
                {
                    "planner": pair.planner.name,
                    "crowd": pair.crowd.name,
                    "planned": pair.planned,
                    "stopped": pair.stopped,
                    "seconds": round(pair.seconds, 1),
                    "numbers": {name: _mean(pair.runs, name) for name in MEASURES},
                    "per_run": [{**run, "score": run_score(run)} for run in pair.runs],
                }
                for pair in self.pairs
            ],
        }


def _mean(runs: Sequence[dict[str, Any]], name: str) -> float | None:
    return estimate([MEASURES[name].of(run) for run in runs], [run["group"] for run in runs], 0.95).mean


def run_suite(
    suite: Suite, out: Path, progress: Callable[[str, int, int], None] | None = None, *, view: bool = True
) -> Result:
    """Simulate and judge a suite; what was interrupted goes on where it stopped.

    Args:
        suite: all of it.
        out: folder of the results: ``result.json``, and the rollouts below ``PLANNER/CROWD``.
        progress: called with a pair's name, the runs done and their total.
        view: whether each pair gets a page that plays its rollouts.

    Raises:
        AllFailedError: every run failed.
        SymphonyError: it could not run; names what stands in the way.
    """
    began = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    with Lock(out / "suite.lock"):
        earlier = _earlier(suite)
        pairs: dict[tuple[str, str], Pair] = {}
        # The baseline comes first: others are compared with it.
        for planner in sorted(suite.planners, key=lambda one: one.name != suite.baseline):
            for crowd in suite.crowds:
                pair = Pair(
                    planner,
                    crowd,
                    len(suite.items) * crowd.config.rollouts,
                    out / planner.name / crowd.name,
                )
                pairs[planner.name, crowd.name] = pair
                _drive(suite, pair, progress)
        ordered = [pairs[one.name, crowd.name] for crowd in suite.crowds for one in suite.planners]
        if all(run["failed"] for pair in ordered for run in pair.runs):
            why = next(run["failed"] for pair in ordered for run in pair.runs)
            raise AllFailedError(f"every run failed, the first: {why}")
        verdicts, regressions = [], []
        for pair in ordered:
            base = _base(suite, pairs, earlier, pair)
            verdicts += judged(suite, pair, base)
            regressions += find_regressions(pair, base)
            if view:
                _write_view(pair)
        result = Result(suite, ordered, verdicts, regressions, time.perf_counter() - began)
        write_json(out / "result.json", result.plain())
    return result


def _drive(
    suite: Suite,
    pair: Pair,
    progress: Callable[[str, int, int], None] | None,
) -> None:
    """Simulate a pair part by part, until its verdict is clear."""
    began, config = time.perf_counter(), pair.crowd.config
    agent = load_agent(pair.crowd.agent, config.device)
    # Beside log playback nobody else is simulated.
    others = 1 if agent.policy is None else agent.interactive
    name = f"{pair.planner.name} among {pair.crowd.name}"
    for part in range(ROUNDS):
        items = suite.items[part::ROUNDS]
        if not items:
            break
        dataset = crowd_dataset(suite.store, agent, config, items, default=others, routes=True)
        done = len(pair.runs)

        def tell(segments: int, total: int, done: int = done) -> None:
            if progress is not None:
                progress(name, done + segments * config.rollouts, pair.planned)

        folder = save_simulation(
            pair.folder,
            agent,
            dataset,
            config,
            planner=pair.planner.planner,
            planner_seconds=pair.planner.seconds,
            progress=tell,
        ).only(suite.store.ids[i] for i in items)
        found = report(folder, "ego")
        pair.report.rows += _with_pdm(found, folder)
        pair.report.events |= found.events
        if pair.planner.name != suite.baseline and _lost(suite, pair):
            break
    pair.report.agent = name
    pair.seconds = time.perf_counter() - began


def _with_pdm(found: Report, folder: RolloutFolder) -> list[dict[str, Any]]:
    """The rows of a report with the PDM score of each run."""
    rows = {(row["segment"], row["rollout"]): row for row in found.rows}
    for saved in folder:
        name = saved.segment.segment_id
        for k in range(saved.rollouts):
            events = [one for one in found.events[name] if one.rollout == k and one.kind == "collision"]
            terms = pdm(rows[name, k], saved, [one.other for one in events if one.fault])
            rows[name, k]["pdm_score"] = None if terms is None else terms.score
    return [{"pdm_score": 0.0 if row["failed"] else None, **row} for row in found.rows]


def _lost(suite: Suite, pair: Pair) -> bool:
    """Whether some threshold can't be kept any more, so that the rest need not be simulated."""
    return any(_beyond(one, pair) for one in _thresholds(suite, pair))


def _beyond(one: Threshold, pair: Pair) -> bool:
    """Whether a rate will be beyond its limit even if nothing happens in the runs that are left.

    The mean of all runs is beyond the limit then, and so is its bound: stopping changes no verdict.
    """
    measure = MEASURES[one.metric]
    if one.compared or one.side != "at_most" or measure.kind != "rate":
        return False
    values = [measure.of(run) for run in pair.runs]
    hits = sum(value for value in values if value is not None)
    # The runs that are left may all count.
    known = sum(value is not None for value in values) + pair.planned - len(pair.runs)
    return known > 0 and hits / known > one.limit


def _thresholds(suite: Suite, pair: Pair) -> list[Threshold]:
    """Those of a pair. A failed run is no good run: if nothing is said of them, none may fail."""
    found = [
        one
        for one in suite.thresholds
        if pair.planner.name in one.planners
        and pair.crowd.name in one.crowds
        # The baseline is not compared with itself.
        and not (one.compared and pair.planner.name == suite.baseline)
    ]
    if all(one.metric != "failed_rate" for one in found):
        found.append(Threshold("failed_rate", 0.0, "at_most", None, (pair.planner.name,), (pair.crowd.name,)))
    return found


def judged(suite: Suite, pair: Pair, base: Sequence[dict[str, Any]] | None) -> list[Verdict]:
    """The verdicts of a pair.

    Args:
        suite: its thresholds.
        pair: after its runs.
        base: the baseline's runs in this crowd; None for none.
    """
    found = []
    for one in _thresholds(suite, pair):
        measure = MEASURES[one.metric]
        if one.compared:
            values, groups = paired(pair.runs, base or (), measure.of)
            known = estimate(values, groups, one.confidence or 0.95)
        else:
            values = [measure.of(run) for run in pair.runs]
            known = estimate(
                values, [run["group"] for run in pair.runs], one.confidence or 0.95, measure.kind
            )
        bound = known.high if one.side == "at_most" else known.low
        if one.confidence is None:
            bound = known.mean
        # A pair that was stopped has lost one threshold, and leaves the others open.
        if bound is None or (pair.stopped and not _beyond(one, pair)):
            status: Status = "undecided"
        else:
            keeps = bound <= one.limit if one.side == "at_most" else bound >= one.limit
            status = "passes" if keeps else "fails"
        found.append(Verdict(one, pair.planner.name, pair.crowd.name, status, known, bound))
    return found


def find_regressions(pair: Pair, base: Sequence[dict[str, Any]] | None) -> list[dict[str, Any]]:
    """Runs that were worse than the baseline's of the same segment and rollout, and how."""
    before = {(run["segment"], run["rollout"]): run for run in base or ()}
    found = []
    for run in pair.runs:
        other = before.get((run["segment"], run["rollout"]))
        if other is None or other is run:
            continue
        what = [text for name, text in EVENTS.items() if run[name] and not other[name]]
        here, there = run_score(run), run_score(other)
        if not what and here is not None and there is not None and there - here > DROP:
            what = [f"scores {here:.0f}, not {there:.0f}"]
        if what:
            found.append(
                {
                    "planner": pair.planner.name,
                    "crowd": pair.crowd.name,
                    "segment": run["segment"],
                    "rollout": run["rollout"],
                    "seed": pair.crowd.config.seed,
                    "what": ", ".join(what),
                }
            )
    return found


def _base(
    suite: Suite,
    pairs: Mapping[tuple[str, str], Pair],
    earlier: Mapping[tuple[str, str], list[dict[str, Any]]],
    pair: Pair,
) -> Sequence[dict[str, Any]] | None:
    """The baseline's runs in the same crowd."""
    if isinstance(suite.baseline, Path):
        return earlier.get((pair.planner.name, pair.crowd.name))
    if not suite.baseline or pair.planner.name == suite.baseline:
        return None
    return pairs[suite.baseline, pair.crowd.name].runs


def _earlier(suite: Suite) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Runs of an earlier result, by planner and crowd."""
    if not isinstance(suite.baseline, Path):
        return {}
    try:
        found = json.loads(suite.baseline.read_text(encoding="utf-8"))
        if found["format"] != FORMAT:
            raise DataError(f"has format {found['format']}, not {FORMAT}", file=suite.baseline)
        if found["store"]["checksum"] != suite.store.checksum():
            raise DataError("is of other run segments", file=suite.baseline, field="store")
        return {(one["planner"], one["crowd"]): list(one["per_run"]) for one in found["pairs"]}
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"is no result of a suite: {error!r}", file=suite.baseline) from error


def _write_view(pair: Pair) -> None:
    folder = RolloutFolder(pair.folder)
    replays = ((saved, pair.report.events.get(saved.segment.segment_id, [])) for saved in folder)
    write_file(pair.folder / "view.html", view_page(pair.report.agent, replays, folder.about.settings))
