"""Evaluations of runs on disk: each run keeps its own, as ``RUN/evaluations/<name>.json``.

The name says how the run was evaluated, so that the same evaluation made again takes the place of the earlier one and
different ones lie side by side; of several one is chosen by its name.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symphony.agents.choice import choose, is_pretrained, split_name
from symphony.config import EvaluateConfig
from symphony.errors import ConfigError, DataError
from symphony.files import write_json

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.data.store import SegmentStore
    from symphony.evaluation import Evaluation

FORMAT = 2
"""Version of a kept evaluation."""
FOLDER = "evaluations"
_LONGEST = 200
"""Letters in the name of an evaluation; file systems allow 255 with what is added while a file is written."""

_MEMORY = ("batch", "device", "workers", "engine")
"""Settings that change no result."""
_USUAL = {
    "score": "discriminator",
    "threshold": None,
    "goals": "tree",
    "logged_goals": False,
    "action_temperature": 1.0,
    "persona": "",
}
"""What goes without saying in the name of a way to simulate."""
_NAMED = ("search", "trees", "branches", "rule", "interactive", "rollouts", "duration", "seed")
_PRUNING = ("prune_every", "temperature")
"""Part of the name of the simulation; evaluations from before they could be set have none."""
_PARTS = ("run", "data", "config", "playback", "constant_velocity", "curvature", "cost")
"""What a kept evaluation must have."""


def evaluation_record(agent: Agent, result: Evaluation, store: SegmentStore) -> dict[str, Any]:
    """An evaluation as JSON can hold it.

    Args:
        agent: that was evaluated.
        result: what the evaluator found, with its baselines.
        store: the run segments.

    Returns:
        The numbers of ``result`` themselves, and ``playback`` and ``constant_velocity``, those of the baselines.
        ``cost``: seconds of CPU time for the ``simulation`` of all rollouts, and the ``steps`` of single rollouts or
        branches in it. ``run``: ``method``, ``seed``, ``interactive``, ``duration`` and ``updates`` of a trained
        agent, which ``checkpoint`` was taken and whether that is ``named``, not its own choice; None for a baseline.
        ``data``: ``name`` and ``checksum`` of the store. ``config``: the settings of the evaluation, with what was
        left to the agent filled in. ``horizon``: seconds of the longest rollout. ``curvature``: histograms [201] of
        the branching regions visited, ``policy`` and ``log``, and ``parts``, pseudo-values of the divergence by
        recording (see :func:`symphony.metrics.sampled_divergence`). ``per_segment``: a row for each run segment.
        :func:`symphony.wosac.evaluate.wosac_parts` adds the WOSAC score.
    """
    visited, visited_log = result.metrics.curvature_histograms()
    divergence, names = result.metrics.curvature_divergence()
    parts = dict(zip(names, divergence.parts.tolist(), strict=True))
    return {
        "format": FORMAT,
        **result.numbers(),
        "run": _run_facts(agent.name),
        "data": {"name": store.path.resolve().name, "checksum": store.checksum()},
        "config": _filled_in(agent, result),
        "horizon": result.horizon,
        **{baseline.agent: baseline.numbers() for baseline in result.baselines},
        "cost": {"simulation": result.seconds, "steps": result.steps},
        "curvature": {"policy": visited.tolist(), "log": visited_log.tolist(), "parts": parts},
        "per_segment": result.metrics.rows(),
    }


def _run_facts(name: str) -> dict[str, Any] | None:
    folder, which = split_name(name)
    if not (folder / "config.json").is_file():
        return None
    config = read_run(folder)
    own, chosen = choose(folder), choose(folder, which)
    return {
        "method": config["method"],
        "seed": config.get("seed", 0),
        "interactive": run_interactive(config),
        "duration": config.get("duration", 0),
        "updates": updates_done(folder),
        "checkpoint": int(chosen.name[-12:]),
        "named": chosen != own,
    }


def _filled_in(agent: Agent, result: Evaluation) -> dict[str, Any]:
    config, used = result.config, agent.plan(result.config).search
    tree, searched = result.search == "tree", result.search not in ("none", "log")
    filled = dataclasses.asdict(config) | {
        "search": result.search,
        "score": used.score if searched else "discriminator",
        "interactive": result.interactive,
        "duration": config.duration or agent.duration,
        "goals": used.goals if tree else "tree",
        "branches": used.test_branches if result.search in ("tree", "best") else 0,
        "trees": config.trees if tree else 0,
        "rule": used.rule if tree else "",
        "prune_every": used.prune_every if result.search in ("tree", "backtrack") else 0,
        "temperature": used.temperature if tree and used.rule == "systematic" else 0.0,
        "threshold": used.threshold
        if result.search == "backtrack" or (tree and used.rule == "replace")
        else None,
    }
    return {name: value for name, value in filled.items() if name not in _MEMORY}


def evaluation_name(record: dict[str, Any]) -> str:
    """Name of an evaluation among those of its run; equal for equal data and settings only."""
    config, data = record["config"], record["data"]
    store = re.sub(r"[^A-Za-z0-9._]+", "_", data["name"])[:60] or "store"
    parts = [store, data["checksum"][:12], simulation_name(config), f"{config['interactive']}agents"]
    if config["duration"]:
        parts.append(f"{config['duration']}s")
    parts += [f"{config['rollouts']}rollouts", f"seed{config['seed']}"]
    if record["run"]["named"]:
        parts.append(f"step{record['run']['checkpoint']}")
    for field in dataclasses.fields(EvaluateConfig):
        usual = _USUAL.get(field.name, field.default)
        value = config.get(field.name, usual)
        if field.name not in (*_NAMED, *_PRUNING, *_MEMORY, "metric") and value != usual:
            parts.append(field.name if value is True else f"{field.name}={value}")
    parts += [re.sub(r"[^A-Za-z0-9._]+", "_", path) for path in config.get("metric", ())]
    if "wosac" in record:
        parts.append(f"wosac{record['wosac']['config']}")
    name = "-".join(parts)
    if len(name) > _LONGEST:
        name = f"{name[: _LONGEST - 13]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    return name


def simulation_name(config: dict[str, Any]) -> str:
    """How rollouts came about, such as ``none``, ``backtrack-every2`` or ``tree-1x16-best-every10``."""
    if config["search"] == "best":
        return f"best-of-{config['branches']}"
    words = [config["search"]]
    if config["trees"]:
        words += [f"{config['trees']}x{config['branches']}", config["rule"]]
    if config.get("prune_every"):
        words.append(f"every{config['prune_every']}")
    if config.get("temperature"):
        words.append(f"at{config['temperature']:g}")
    return "-".join(words)


def simulation_way(config: dict[str, Any]) -> str:
    """How rollouts came about, with all that tells searches apart: ``tree-1x16-replace-every2-goals=branch``."""
    words = [simulation_name(config)]
    for name, usual in _USUAL.items():
        value = config.get(name, usual)
        if value != usual:
            words.append(name if value is True else f"{name}={value}")
    return "-".join(words)


def keep_evaluation(agent: str, record: dict[str, Any]) -> Path | None:
    """Write an evaluation into the folder of its run and return the file.

    A baseline has no folder, and that of an agent that comes with the package is not the user's: nothing is written.

    Args:
        agent: its name.
        record: see :func:`evaluation_record`.
    """
    if record["run"] is None or is_pretrained(agent):
        return None
    file = split_name(agent)[0] / FOLDER / f"{evaluation_name(record)}.json"
    # An interrupted write must not leave half a file where a table looks for a whole one.
    write_json(file, record)
    return file


def kept_evaluations(run: Path) -> dict[str, dict[str, Any]]:
    """The evaluations that a run keeps, by name, in the order of the names.

    Raises:
        DataError: one that can't be read.
    """
    return {file.stem: read_evaluation(file) for file in sorted((run / FOLDER).glob("[!.]*.json"))}


def read_evaluation(file: Path) -> dict[str, Any]:
    """A kept evaluation (see :func:`evaluation_record`).

    Raises:
        DataError: it can't be read or lacks something.
    """
    record = read_object(file)
    if record.get("format") != FORMAT:
        raise DataError(
            f"format {record.get('format')!r}, this version reads {FORMAT}", file=file, field="format"
        )
    for part in _PARTS:
        if not isinstance(record.get(part), dict):
            raise DataError("is missing", file=file, field=part)
    return record


def fitting(kept: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Names of the evaluations that the first fitting pattern fits; all without patterns."""
    found = ([name for name in kept if fnmatchcase(name, pattern)] for pattern in patterns or "*")
    return next((names for names in found if names), [])


def choose_evaluation(
    run: Path, kept: Mapping[str, dict[str, Any]], patterns: Sequence[str] = ()
) -> tuple[str, dict[str, Any]]:
    """Name and record of the one evaluation of a run that fits.

    Args:
        run: its folder.
        kept: the evaluations to choose from.
        patterns: names (``*`` and ``?`` stand for anything); the first one that fits any decides.

    Raises:
        ConfigError: none or several do; names them.
    """
    names = fitting(kept, patterns)
    if not kept:
        raise ConfigError(f"{run} keeps no evaluation: symphony evaluate {run} --data DIR")
    if len(names) != 1:
        state = "was evaluated in several ways" if names else "was not evaluated in that way"
        raise ConfigError(f"{run} {state}, choose one with --evaluation: {', '.join(names or kept)}")
    return names[0], kept[names[0]]


def read_run(folder: Path) -> dict[str, Any]:
    """The configuration of a run as it is written, of any version.

    Raises:
        DataError: it can't be read or names no method.
    """
    config = read_object(folder / "config.json")
    if not isinstance(config.get("method"), str):
        raise DataError("is missing", file=folder / "config.json", field="method")
    return config


def run_interactive(config: Mapping[str, Any]) -> int:
    """Interactive agents per run segment, from the configuration of a run."""
    return config.get("agent", {}).get("interactive", 2)


def updates_done(run: Path) -> int:
    """Updates up to the last checkpoint of a run; 0 where there is none."""
    found = (re.fullmatch(r"step-(\d+)", path.name) for path in (run / "checkpoints").glob("step-*"))
    return max((int(match[1]) for match in found if match), default=0)


def find_runs(folders: Iterable[Path]) -> list[Path]:
    """Every run among folders, each once: a folder is a run or is searched for some.

    Raises:
        ConfigError: a folder without any.
    """
    found: dict[Path, Path] = {}
    for folder in folders:
        runs = _runs_below(folder)
        if not runs:
            raise ConfigError(f"{folder} holds no run: none has a config.json")
        for run in runs:
            found.setdefault(run.resolve(), run)
    return [found[place] for place in sorted(found)]


def _runs_below(folder: Path) -> list[Path]:
    if (folder / "config.json").is_file():
        return [folder]
    inner = sorted(folder.iterdir()) if folder.is_dir() else []
    return [run for each in inner if each.is_dir() for run in _runs_below(each)]


def read_object(file: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        DataError: it is none.
    """
    try:
        value = json.loads(file.read_text(encoding="utf-8", errors="replace"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"not valid JSON ({error})", file=file) from error
    if not isinstance(value, dict):
        raise DataError("not a JSON object", file=file)
    return value
