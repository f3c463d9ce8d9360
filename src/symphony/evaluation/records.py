"""Evaluations of runs on disk: each run keeps its own, as ``RUN/evaluations/<name>.json``; the name says how the run
was evaluated, so that an evaluation that is repeated replaces the earlier one.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symphony.agents.checkpoint import checkpoints
from symphony.agents.choice import PREFIX, choose, split_name
from symphony.config import EvaluateConfig
from symphony.errors import ConfigError, DataError
from symphony.files import read_object, write_json

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.data.store import SegmentStore
    from symphony.evaluation import Evaluation

FORMAT, FOLDER = 2, "evaluations"
_LONGEST = 200  # letters in a name; file systems allow 255 with what is added while a file is written
_MEMORY = ("batch", "device", "workers", "engine", "compile")  # settings that change no result
_NAMED = ("search", "trees", "branches", "rule", "prune_every", "temperature", "interactive", "rollouts")
_USUAL = {
    field.name: field.default
    for field in dataclasses.fields(EvaluateConfig)
    if field.name not in (*_NAMED, *_MEMORY, "duration", "seed", "metric")
} | {"score": "discriminator", "goals": "tree"}
"""Settings that the name of an evaluation leaves out."""
_PARTS: dict[str, tuple[str, ...]] = {
    "run": ("updates", "checkpoint", "named"),
    "data": ("name", "checksum"),
    "config": (*_NAMED, "duration", "seed", "metric"),
    "cost": ("simulation",),
} | dict.fromkeys(("playback", "constant_velocity", "curvature"), ())
"""Entries that a kept evaluation must have."""


def evaluation_record(agent: Agent, result: Evaluation, store: SegmentStore) -> dict[str, Any]:
    """Return an evaluation of an agent on a store as JSON can hold it.

    The numbers of ``result``; ``playback`` and ``constant_velocity``, those of the baselines; ``cost``, seconds of
    CPU time for the ``simulation`` of all rollouts and ``steps`` of rollouts or branches in it; ``run``, facts of a
    trained agent and which ``checkpoint`` was taken, and whether that is ``named``, not its own choice (None for a
    baseline); ``data``, ``name`` and ``checksum`` of the store; ``config``, the settings with what was left to the
    agent filled in; ``horizon``, seconds of the longest rollout; ``curvature``, histograms [201] of the regions
    visited, ``policy`` and ``log``, and ``parts``, pseudo-values of the divergence by recording; ``per_segment``, a
    row for each. :func:`symphony.wosac.evaluate.wosac_parts` adds the WOSAC score.
    """
    both = [(segment.histogram, segment.histogram_log) for segment in result.metrics.segments.values()]
    policy, log = (sum(counts[1:], counts[0]).tolist() for counts in zip(*both, strict=True))
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
        "curvature": {"policy": policy, "log": log, "parts": parts},
        "per_segment": result.metrics.rows(),
    }


def _run_facts(name: str) -> dict[str, Any] | None:
    folder, which = split_name(name)
    if not (folder / "config.json").is_file():
        return None
    config, chosen = read_run(folder), choose(folder, which)
    facts = {"method": config["method"], "seed": config.get("seed", 0), "updates": updates_done(folder)}
    return facts | {"checkpoint": int(chosen.name[-12:]), "named": chosen != choose(folder)}


def _filled_in(agent: Agent, result: Evaluation) -> dict[str, Any]:
    """Return the settings of an evaluation, with what the agent decided and without what its search does not use."""
    config, search, used = result.config, result.search, agent.plan(result.config).search
    tree = search == "tree"
    filled = dataclasses.asdict(config) | {
        "search": search,
        "score": "discriminator" if search in ("none", "log") else used.score,
        "interactive": result.interactive,
        "duration": config.duration or agent.duration,
        "goals": used.goals if tree else "tree",
        "branches": used.test_branches if tree else 0,
        "trees": config.trees if tree else 0,
        "rule": used.rule if tree else "",
        "prune_every": used.prune_every if search in ("tree", "backtrack") else 0,
        "temperature": used.temperature if tree and used.rule == "systematic" else 0.0,
        "threshold": used.threshold if search == "backtrack" or (tree and used.rule == "replace") else None,
    }
    return {name: value for name, value in filled.items() if name not in _MEMORY}


def evaluation_name(record: dict[str, Any]) -> str:
    """Return the name of an evaluation among those of its run; it is equal for equal data and settings only."""
    config, data = record["config"], record["data"]
    store = _plain(data["name"])[:60] or "store"
    parts = [store, data["checksum"][:12], *_search_words(config), f"{config['interactive']}agents"]
    parts += [f"{config['duration']}s"] if config["duration"] else []
    parts += [f"{config['rollouts']}rollouts", f"seed{config['seed']}"]
    parts += [f"step{record['run']['checkpoint']}"] if record["run"]["named"] else []
    parts += _unusual_words(config)
    parts += [_plain(path) for path in config.get("metric", ())]
    parts += [f"wosac{record['wosac']['config']}"] if "wosac" in record else []
    name = "-".join(parts)
    if len(name) > _LONGEST:
        name = f"{name[: _LONGEST - 13]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"
    return name


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._]+", "_", name)


def simulation_way(config: Mapping[str, Any]) -> str:
    """Return how rollouts were made: ``none``, ``tree-1x16-replace-every2-goals=branch``."""
    return "-".join([*_search_words(config), *_unusual_words(config)])


def _search_words(config: Mapping[str, Any]) -> list[str]:
    words = [config["search"]]
    words += [f"{config['trees']}x{config['branches']}", _plain(config["rule"])] if config["trees"] else []
    words += [f"every{config['prune_every']}"] if config.get("prune_every") else []
    return words + ([f"at{config['temperature']:g}"] if config.get("temperature") else [])


def _unusual_words(config: Mapping[str, Any]) -> list[str]:
    values = {name: config.get(name, usual) for name, usual in _USUAL.items()}
    return [n if v is True else f"{n}={v}" for n, v in values.items() if v != _USUAL[n]]


def keep_evaluation(agent: str, record: dict[str, Any]) -> Path | None:
    """Write the record of an evaluation into the folder of the run, where the user has one, and return the file."""
    if record["run"] is None or agent.startswith(PREFIX):
        return None
    file = split_name(agent)[0] / FOLDER / f"{evaluation_name(record)}.json"
    write_json(file, record)
    return file


def kept_evaluations(run: Path) -> dict[str, dict[str, Any]]:
    """Return the evaluations that a run keeps, by name, in the order of the names (see :func:`read_evaluation`)."""
    return {file.stem: read_evaluation(file) for file in sorted((run / FOLDER).glob("[!.]*.json"))}


def read_evaluation(file: Path) -> dict[str, Any]:
    """Read a kept evaluation (see :func:`evaluation_record`); a DataError says what it lacks."""
    record = read_object(file)
    if (found := record.get("format")) != FORMAT:
        raise DataError(f"format {found!r}, this version reads {FORMAT}", file=file, field="format")
    if not isinstance(record.get("segments"), int):
        raise DataError("is missing", file=file, field="segments")
    for part, names in _PARTS.items():
        if not isinstance(record.get(part), dict):
            raise DataError("is missing", file=file, field=part)
        if lost := set(names) - record[part].keys():
            raise DataError("is missing", file=file, field=f"{part}.{min(lost)}")
    # What was not a setting yet was as is usual.
    return record | {"config": _USUAL | record["config"]}


def fitting(kept: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Return the names that match the first pattern that any matches (with ``*`` and ``?``); all without patterns."""
    found = ([name for name in kept if fnmatchcase(name, pattern)] for pattern in patterns or "*")
    return next((names for names in found if names), [])


def choose_evaluation(run: Path, kept: Mapping[str, Any], patterns: Sequence[str] = ()) -> dict[str, Any]:
    """Return the one kept evaluation of a run that fits (see :func:`fitting`); a ConfigError names several."""
    names = fitting(kept, patterns)
    if not kept:
        raise ConfigError(f"{run} keeps no evaluation: symphony evaluate {run} --data DIR")
    if len(names) != 1:
        state = "was evaluated in several ways" if names else "was not evaluated in that way"
        raise ConfigError(f"{run} {state}, choose one with --evaluation: {', '.join(names or kept)}")
    return kept[names[0]]


def read_run(folder: Path) -> dict[str, Any]:
    """Read the configuration of a run as it is written; a DataError says that it can't be, or names no method."""
    config = read_object(folder / "config.json")
    if not isinstance(config.get("method"), str):
        raise DataError("is missing", file=folder / "config.json", field="method")
    return config


def updates_done(run: Path) -> int:
    """Return the updates up to the last checkpoint of a run; 0 where there is none."""
    return max((int(path.name[-12:]) for path in checkpoints(run / "checkpoints")), default=0)


def find_runs(folders: Iterable[Path]) -> list[Path]:
    """Return every run among folders, each once: a folder is a run or is searched for some, and has one at least."""
    found: dict[Path, Path] = {}
    for folder in folders:
        if not (runs := _runs_below(folder)):
            raise ConfigError(f"{folder} holds no run: none has a config.json")
        for run in runs:
            found.setdefault(run.resolve(), run)
    return [found[place] for place in sorted(found)]


def _runs_below(folder: Path) -> list[Path]:
    if (folder / "config.json").is_file():
        return [folder]
    inner = sorted(each for each in folder.iterdir() if each.is_dir()) if folder.is_dir() else []
    return [run for each in inner for run in _runs_below(each)]
