"""Rollouts in files, made by anything, and their scores against the scenarios that they belong to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from symphony.data.npz import read_npz
from symphony.data.report import Skip
from symphony.errors import ConfigError, DataError
from symphony.parallel import ordered_map
from symphony.wosac import scorer
from symphony.wosac.records import logged_scenario, parse_scenario, read_scenarios
from symphony.wosac.scorer.config import ROLLOUTS
from symphony.wosac.scorer.scenario import STATES

_NAMED = 5

Packed = tuple[Path, int, bytes, Path]
"""A scenario's file, its number in it, its record, and the file of its rollouts."""


def read_rollouts(file: Path) -> scorer.SimulatedRollouts:
    """Read an ``.npz`` with ``object_id`` [n] and ``x``, ``y``, ``z``, ``heading`` [R, n, 80]; more is ignored.

    Raises:
        DataError: the file is damaged or something is missing or of the wrong kind; names file and field.
    """
    held = read_npz(file, ("object_id", *STATES))
    arrays: dict[str, Any] = {}
    for name in ("object_id", *STATES):
        if name not in held:
            raise DataError("missing", file=file, field=name)
        whole = name == "object_id"
        if not np.issubdtype(held[name].dtype, np.integer if whole else np.floating):
            wanted = "whole numbers" if whole else "floating-point numbers"
            raise DataError(f"holds {held[name].dtype}, expected {wanted}", file=file, field=name)
        # Whatever width and byte order they come in.
        plain = np.int64 if whole else np.float32 if held[name].dtype.itemsize <= 4 else np.float64
        with np.errstate(over="ignore"):
            arrays[name] = held[name].astype(plain)
    return scorer.SimulatedRollouts(**arrays)


@dataclass(frozen=True)
class ScoreFile:
    """Scores one scenario by its rollouts, with settings of :func:`score_files`."""

    config: str
    per_object: bool
    strict: bool

    def __call__(self, packed: Packed) -> dict[str, Any] | Skip:
        """Return ``scenario_id``, the :func:`.scorer.score` and ``objects`` if wanted; or why there is no score."""
        file, record, payload, rollouts = packed
        parsed, config = parse_scenario(payload, file, record), scorer.CHALLENGES[self.config]
        name = parsed.scenario_id
        try:
            scenario = logged_scenario(parsed)
            scorer.check_scored(scenario, config)
        except DataError as error:
            if self.strict:
                raise error.at(file=file, segment=name) from None
            return Skip.of(error, file, name)
        try:
            made = read_rollouts(rollouts)
            made.check(scenario.sim_agents, count=ROLLOUTS)
        except DataError as error:
            raise error.at(file=rollouts, segment=name) from None
        found = scorer.compute_features(scenario, made)
        objects = {"objects": scorer.object_scores(found, config)} if self.per_object else {}
        return {"scenario_id": name, **scorer.score_features(found, config), **objects}


def score_files(
    scenarios: Path,
    rollouts: Path,
    config: str = "2025",
    *,
    workers: int = 1,
    partial: bool = False,
    per_object: bool = False,
    strict: bool = False,
    progress: Callable[[int, int | None], None] = lambda done, total: None,
) -> tuple[dict[str, Any], list[Skip]]:
    """Score the rollouts of one or many scenarios, in the order of the scenario files.

    One scenario is in memory at a time, a few for each worker. Scenarios that can't be scored, such as one without
    road edges, vehicles or a future, are left out.

    Scenarios are a WOMD scenario file, a folder of them, or a pattern; rollouts the ``.npz`` of the only scenario, or
    a folder with ``SCENARIO_ID.npz`` for each, of which with ``partial`` some may be missing. ``config`` is the year
    of the challenge. With ``per_object`` the scores of each object are included; where ``strict``, a scenario that
    can't be scored is an error. ``progress`` is called with the scenarios done and, where known, all there are.

    Returns the mean over scenarios, their own scores and what was left out, for JSON; and what was left out. A
    :class:`DataError` names file, scenario, agent and field where rollouts don't fit, or no scenario can be scored.
    """
    if config not in scorer.CHALLENGES:
        raise ConfigError(f"config must be one of {', '.join(scorer.CHALLENGES)}, is {config}")
    total = len(list(rollouts.glob("*.npz"))) if rollouts.is_dir() else 1
    results: list[dict[str, Any]] = []
    skipped: list[Skip] = []
    work = ScoreFile(config, per_object, strict)
    for result in ordered_map(work, _packed(scenarios, rollouts, partial), workers=workers):
        if isinstance(result, Skip):
            skipped.append(result)
        else:
            results.append(result)
        progress(len(results) + len(skipped), total)
    if not results:
        raise skipped[0].error if skipped else DataError("no scenario has rollouts", file=scenarios)
    numbers = [{k: v for k, v in one.items() if isinstance(v, float)} for one in results]
    return {
        "config": config,
        "scenario_count": len(results),
        **scorer.mean_scores(numbers),
        "scenarios": results,
        "left_out": [skip.to_json() for skip in skipped],
    }, skipped


def _packed(scenarios: Path, rollouts: Path, partial: bool) -> Iterator[Packed]:
    """Yield every scenario to score, still packed, with the file of its rollouts."""
    many = rollouts.is_dir()
    unused = {file.stem: file for file in rollouts.glob("*.npz")} if many else {}
    if many and not unused:
        raise DataError("no .npz files in the folder", file=rollouts)
    seen: set[str] = set()
    for file, record, payload in read_scenarios(scenarios):
        name = parse_scenario(payload, file, record).scenario_id
        if name in seen:
            raise DataError("more than once", file=file, segment=name, field="scenario_id")
        seen.add(name)
        if not many and len(seen) > 1:
            message = f"is one scenario's, but there are several, {name} among them; give a folder of rollouts"
            raise DataError(message, file=rollouts)
        if not many or name in unused:
            yield file, record, payload, unused.pop(name) if many else rollouts
        elif not partial:
            raise DataError(f"no rollouts of scenario {name}", file=rollouts, segment=name)
    if unused:
        names = ", ".join(sorted(unused)[:_NAMED]) + (" …" if len(unused) > _NAMED else "")
        raise DataError(f"rollouts of scenarios that are not in {scenarios}: {names}", file=rollouts)
