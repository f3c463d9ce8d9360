"""Scoring rollouts that lie in files, against the scenarios they are of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from symphony.data.report import Skip
from symphony.errors import DataError
from symphony.files import Lock
from symphony.parallel import ordered_map
from symphony.wosac.records import parse_scenario, read_scenario_payloads, scenario_arrays, scenario_files
from symphony.wosac.rollouts import read_rollouts
from symphony.wosac.scorer import (
    CHALLENGES,
    SimulatedRollouts,
    WosacFeatures,
    WosacScenario,
    WosacScores,
    check_scored,
    compute_features,
    mean_scores,
    object_scores,
    score_features,
)
from symphony.wosac.scorer.config import ROLLOUTS

_NAMED = 5


@dataclass(frozen=True)
class ScoreTask:
    """A scenario, still packed, and where its rollouts lie."""

    file: Path
    record: int
    payload: bytes
    rollouts: Path
    config: str
    per_object: bool
    features: Path | None
    strict: bool


@dataclass(frozen=True)
class ScenarioScore:
    """Scores of a scenario.

    Attributes:
        scenario_id: its id.
        scores: of the scenario.
        objects: of each scored object, where asked for.
    """

    scenario_id: str
    scores: WosacScores
    objects: list[dict[str, Any]] | None = None

    def record(self) -> dict[str, Any]:
        """As JSON can hold it."""
        objects = {} if self.objects is None else {"objects": self.objects}
        return {"scenario_id": self.scenario_id, **self.scores.to_dict(), **objects}


def score_files(
    scenarios: Path,
    rollouts: Path,
    config: str = "2025",
    *,
    workers: int = 1,
    partial: bool = False,
    per_object: bool = False,
    features: Path | None = None,
    strict: bool = False,
    progress: Callable[[int, int | None], None] = lambda done, total: None,
) -> tuple[list[ScenarioScore], list[Skip]]:
    """Score the rollouts of one or many scenarios, in the order of the scenario files.

    One scenario is in memory at a time, a few for each worker. Scenarios that can't be scored, such as one without
    road edges, vehicles or a future, are left out.

    Args:
        scenarios: WOMD scenario file, folder of them, or pattern.
        rollouts: ``.npz`` of the only scenario's rollouts, or a folder with ``SCENARIO_ID.npz`` for each.
        config: year of the challenge.
        workers: processes.
        partial: leave out scenarios without rollouts, instead of an error.
        per_object: with the scores of each object.
        features: folder to write each scenario's features to, as ``SCENARIO_ID.npz``.
        strict: a scenario that can't be scored is an error.
        progress: called with the scenarios done and, where known, all there are.

    Returns:
        The scores, and the scenarios that were left out.

    Raises:
        DataError: rollouts don't fit, or no scenario can be scored; names file, scenario, agent and field.
    """

    held: AbstractContextManager[object] = nullcontext()
    if features is not None:
        features.mkdir(parents=True, exist_ok=True)
        held = Lock(features / "features.lock")
    total = len(list(rollouts.glob("*.npz"))) if rollouts.is_dir() else 1
    pairs = _pairs(scenarios, rollouts, partial)
    tasks = (ScoreTask(*pair, config, per_object, features, strict) for pair in pairs)
    results: list[ScenarioScore] = []
    skipped: list[Skip] = []
    with held:
        for result in ordered_map(score_task, tasks, workers=workers):
            if isinstance(result, ScenarioScore):
                results.append(result)
            else:
                skipped.append(result)
            progress(len(results) + len(skipped), total)
    if not results:
        raise skipped[0].error if skipped else DataError("no scenario has rollouts", file=scenarios)
    return results, skipped


def score_task(task: ScoreTask) -> ScenarioScore | Skip:
    """Score one scenario, or say why it can't be."""

    record = parse_scenario(task.payload, task.file, task.record)
    scenario_id = record.scenario_id
    config = CHALLENGES[task.config]
    try:
        scenario = WosacScenario.of(**scenario_arrays(record))
        check_scored(scenario, config)
    except DataError as error:
        if task.strict:
            raise error.at(file=task.file, segment=scenario_id) from None
        return Skip.of(error, task.file, scenario_id)
    try:
        rollouts = SimulatedRollouts.of(**vars(read_rollouts(task.rollouts)))
        rollouts.check(scenario, ROLLOUTS)
        found = compute_features(scenario, rollouts)
    except DataError as error:
        raise error.at(file=task.rollouts, segment=scenario_id) from None
    scores = score_features(found, config)
    if task.features is not None:
        write_features(task.features / f"{scenario_id}.npz", found)
    return ScenarioScore(
        scenario.scenario_id, scores, object_scores(found, config) if task.per_object else None
    )


def summary(results: list[ScenarioScore], skipped: list[Skip], config: str) -> dict[str, Any]:
    """The mean over scenarios, every scenario's own scores, and what was left out, as JSON can hold it."""

    return {
        "config": config,
        "scenario_count": len(results),
        **mean_scores(result.scores for result in results).to_dict(),
        "scenarios": [result.record() for result in results],
        "left_out": [skip.to_json() for skip in skipped],
    }


def write_features(file: Path, features: WosacFeatures) -> None:
    """Write features as arrays: ``eval_object_id`` [E], ``log_valid`` [E, 80], and each feature of the log
    (``log_NAME``) and of the rollouts (``sim_NAME``, with a leading dimension of rollouts).
    """

    arrays = {
        f"{prefix}_{field.name}": getattr(source, field.name).numpy()
        for prefix, source in (("log", features.log), ("sim", features.simulated))
        for field in fields(source)
    }
    with file.open("wb") as out:
        np.savez_compressed(
            out,
            eval_object_id=features.object_id.numpy(),
            eval_object_type=features.object_type.numpy(),
            log_valid=features.log_valid.numpy(),
            **arrays,
        )


def _pairs(scenarios: Path, rollouts: Path, partial: bool) -> Iterator[tuple[Path, int, bytes, Path]]:
    """(file, record, payload, rollouts) of every scenario to score."""

    many = rollouts.is_dir()
    unused = {file.stem: file for file in rollouts.glob("*.npz")} if many else {}
    if many and not unused:
        raise DataError("no .npz files in the folder", file=rollouts)
    seen: set[str] = set()
    for file, record, payload in read_scenario_payloads(scenario_files(scenarios)):
        name = parse_scenario(payload, file, record).scenario_id
        if name in seen:
            raise DataError("more than once", file=file, segment=name, field="scenario_id")
        seen.add(name)
        if not many:
            if len(seen) > 1:
                message = (
                    f"is one scenario's, but there are several, {name} among them; give a folder of rollouts"
                )
                raise DataError(message, file=rollouts)
            yield file, record, payload, rollouts
        elif name in unused:
            yield file, record, payload, unused.pop(name)
        elif not partial:
            raise DataError(f"no rollouts of scenario {name}", file=rollouts, segment=name)
    if unused:
        names = ", ".join(sorted(unused)[:_NAMED]) + (" …" if len(unused) > _NAMED else "")
        raise DataError(f"rollouts of scenarios that are not in {scenarios}: {names}", file=rollouts)
