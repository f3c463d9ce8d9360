"""Make an agent that comes with the package from a run: ``python benchmarks/make_pretrained.py RUN NAME``.

Writes ``src/symphony/pretrained/NAME``: configuration, the weights of the checkpoint that is the run's agent, the
evaluations that were given, and a model card made of these, ``card.json`` (which `symphony agents` prints) and
``README.md``. The same run and evaluations give the same bytes.

    symphony evaluate RUN --data town-small/test
    symphony evaluate RUN --data ngsim
    python benchmarks/make_pretrained.py RUN NAME --scores RUN/evaluations/{test,ngsim}-*.json

Scores of an existing agent on further data (the same data's are replaced):

    symphony evaluate pretrained:NAME --data ngsim --json ngsim.json
    python benchmarks/make_pretrained.py pretrained:NAME NAME --scores ngsim.json
"""

from __future__ import annotations

import argparse
import random
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from symphony.agents import build_agent
from symphony.agents.agent import FILE, read_spec
from symphony.agents.checkpoint import load_checkpoint, save_checkpoint
from symphony.agents.choice import CARD, FOLDER, PREFIX, choose, read_card, split_name
from symphony.cli.shared import COLUMNS
from symphony.config import AgentSpec, EvaluateConfig, TrainConfig, read_json, to_json
from symphony.data.generate import PRESETS
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, SymphonyError
from symphony.evaluation.records import FOLDER as EVALUATIONS
from symphony.evaluation.records import choose_evaluation, evaluation_name, kept_evaluations, read_evaluation
from symphony.evaluation.table import method_name
from symphony.files import write_json

SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class Source:
    """A run and what is known about it.

    Attributes:
        config: as the run has it.
        spec: of its agent.
        step: updates after which its agent was saved.
        before: what it started from, in words; empty for new networks.
        data: checksum of what it learned from.
        scores: records of evaluations, each on data of its own.
        holds: what its data is, in words.
        limits: of what it has learned, in words.
    """

    config: TrainConfig
    spec: AgentSpec
    step: int
    before: str
    data: str
    scores: Sequence[dict[str, Any]]
    holds: str = ""
    limits: str = ""


def make(
    run: str,
    name: str,
    scores: Sequence[Path] = (),
    pruning: EvaluateConfig = EvaluateConfig(),  # noqa: B008  (frozen)
    folder: Path = FOLDER,
    *,
    holds: str = "",
    limits: str = "",
) -> Path:
    """Write the folder of an agent and return it.

    Args:
        run: ``RUN`` or ``RUN@WHICH`` (see :func:`symphony.agents.load_agent`).
        name: of the agent.
        scores: evaluations of the run as ``symphony evaluate`` writes them; by default the one that the run keeps.
        pruning: its `rule`, `prune_every`, `temperature`, `threshold` and `goals` say how the agent is searched from
            now on; by default as it was trained.
        folder: of all these agents.
        holds: what its training data is, in words, where that is no standard set.
        limits: of what it has learned, in words, where that is no standard set.

    Raises:
        ConfigError: if the run has no such checkpoint, its data is unknown, or the evaluation is of something else.
        DataError: if one of the files can't be read.
    """
    source, which = split_name(run)
    config, spec, checkpoint = read_run(source), read_spec(source), choose(source, which)
    step = int(checkpoint.name[-12:])
    records = _read_scores(source, scores)
    known = Source(config, spec, step, _before(source, config), _checksum(config.data), records, holds, limits)
    out = replace(config, search=pruning.pruning(config.search))
    for record in records:
        _check_scores(record, out, step)
    changed = replace(spec, search=out.search)
    modules = build_agent(name, changed).modules
    load_checkpoint(checkpoint, modules=modules, partial=True, restore_rng=False)

    place = folder / name
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    (place / "config.json").write_text(to_json(without_paths(out)), encoding="utf-8")
    (place / FILE).write_text(to_json(changed), encoding="utf-8")
    # A checkpoint holds random states too: always the same ones here, as no run goes on from it.
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002
    torch.manual_seed(0)
    save_checkpoint(place / "checkpoints", step=step, modules=modules)
    for given in records:
        _keep(place, name, given, step)
    parameters = {part: sum(weights.numel() for weights in module.parameters()) for part, module in modules.items()}
    facts = card_of(name, known, out, parameters)
    write_json(place / CARD, facts)
    (place / "README.md").write_text(page(facts), encoding="utf-8")
    return place


def add_scores(name: str, scores: Sequence[Path], folder: Path = FOLDER) -> Path:
    """Add evaluations to an existing agent, or replace those on the same data, and renew its card.

    Args:
        name: of the agent.
        scores: evaluations of it as ``symphony evaluate`` writes them.
        folder: of all these agents.

    Raises:
        ConfigError: if an evaluation is of something else.
        DataError: if one of the files can't be read.
    """
    place = folder / name
    facts, config = read_card(place), read_run(place)
    given = [read_evaluation(file) for file in scores]
    for record in given:
        _check_scores(record, config, facts["training"]["updates"])
        for kept in (place / EVALUATIONS).glob("*.json"):
            if read_evaluation(kept)["data"]["checksum"] == record["data"]["checksum"]:
                kept.unlink()
        _keep(place, name, record, facts["training"]["updates"])
    records = [read_evaluation(file) for file in sorted((place / EVALUATIONS).glob("*.json"))]
    facts["scores"] = [_scores_of(record) for record in _in_order(records)]
    write_json(place / CARD, facts)
    (place / "README.md").write_text(page(facts), encoding="utf-8")
    return place


def _keep(place: Path, name: str, record: dict[str, Any], step: int) -> None:
    kept = {key: value for key, value in record.items() if key != "per_segment"}
    kept |= {"agent": PREFIX + name, "run": {**record["run"], "updates": step, "named": False}}
    (place / EVALUATIONS).mkdir(exist_ok=True)
    write_json(place / EVALUATIONS / f"{evaluation_name(kept)}.json", kept)


def _in_order(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the records, those on standard sets first."""
    return sorted(records, key=lambda one: (_standard(one["data"]) is None, one["data"]["name"]))


def read_run(folder: Path) -> TrainConfig:
    """Return the configuration a run was started with."""
    return read_json(TrainConfig, folder / "config.json")


def without_paths(config: TrainConfig) -> TrainConfig:
    """Return the configuration with names in place of paths of the machine it was used on."""
    evaluated = config.validation
    if evaluated.data is not None:
        evaluated = replace(evaluated, data=Path(data_name(evaluated.data)))
    before = config.warm_start
    return replace(
        config,
        data=Path(data_name(config.data)),
        out=Path(config.out.name),
        # The last part also where a checkpoint is named.
        warm_start=None if before is None else Path(before.name),
        validation=evaluated,
        resume=False,
        wandb="disabled",
        device="cpu",
    )


def data_name(path: Path) -> str:
    """Return a store's name: that of its folder, after the name of the set if it is a split of one."""
    parts = [part for part in path.parts if part not in ("/", ".", "..")]
    return "/".join(parts[-2:] if parts[-1] in SPLITS else parts[-1:])


def _checksum(data: Path) -> str:
    if (data / "store.json").is_file():
        return SegmentStore(data).checksum()
    name, _, split = data_name(data).partition("/")
    if name in PRESETS and split in PRESETS[name].checksums:
        return PRESETS[name].checksums[split]
    raise ConfigError(f"{data}: neither there nor a standard set, so that its checksum is unknown")


def _before(run: Path, config: TrainConfig) -> str:
    """Return what a run started from, as far as the runs beside it tell."""
    if config.warm_start is None:
        return ""
    name = config.warm_start.name.partition("@")[0]
    words = f"the networks of the run `{name}`"
    beside = run.resolve().parent / name
    folder = beside if (beside / "config.json").is_file() else split_name(str(config.warm_start))[0]
    if not (folder / "config.json").is_file():
        return words
    earlier = read_run(folder)
    # An included agent may have gone on from the one that it replaces, of which nothing is left.
    further = "" if earlier.warm_start == config.warm_start else _before(folder, earlier)
    origin = f", itself from {further}" if further else ""
    return f"{words} ({method_name(earlier.method)}, {_count(earlier.steps)} updates{origin})"


def _read_scores(run: Path, files: Sequence[Path]) -> list[dict[str, Any]]:
    if files:
        return _in_order([read_evaluation(file) for file in files])
    kept = kept_evaluations(run)
    return [choose_evaluation(run, kept)] if kept else []


def _check_scores(record: dict[str, Any], config: TrainConfig, step: int) -> None:
    """Refuse an evaluation of something else."""
    found, how = record["run"], record["config"]
    pairs: list[tuple[str, Any, Any]] = [
        ("method", found["method"], config.method),
        ("seed", found.get("seed"), config.seed),
        ("checkpoint", found.get("checkpoint", step), step),
    ]
    if how["search"] == "tree":
        search = config.search
        pairs += [(name, how[name], getattr(search, name)) for name in ("rule", "prune_every")]
        pairs.append(("goals", how.get("goals", "tree"), search.goals))
        if search.rule == "systematic":
            pairs.append(("temperature", how["temperature"], search.temperature))
        if search.rule == "replace":
            pairs.append(("threshold", how["threshold"], search.threshold))
    for what, evaluated, own in pairs:
        if evaluated != own:
            raise ConfigError(f"the evaluation is of another agent: {what} {evaluated}, not {own}")


def card_of(name: str, source: Source, config: TrainConfig, parameters: dict[str, int]) -> dict[str, Any]:
    """Return the model card, as ``card.json`` has it.

    Args:
        name: of the agent.
        source: the run.
        config: what the agent is simulated with from now on.
        parameters: number of weights of each network.
    """
    method = method_name(config.method)
    return {
        "format": 1,
        "name": PREFIX + name,
        "method": method,
        "about": f"{method} (see the methods in the documentation of Symphony): {_method_words(source.spec)} It "
        f"drives {config.agent.interactive} vehicles of a run segment at {1 / source.spec.dt:g} Hz while all others "
        "follow their log.",
        "training": {
            "data": data_name(source.config.data),
            "checksum": source.data,
            "seed": source.config.seed,
            "updates": source.step,
            "words": _training(source, config),
        },
        "settings": _settings(config, source.spec, parameters),
        "scores": [_scores_of(record) for record in source.scores],
        "limits": _limits(source, method),
    }


def page(facts: dict[str, Any]) -> str:
    """Return the model card as a page."""
    rows = ["| setting | value |", "| --- | --- |"]
    rows += [f"| {key} | {value} |" for key, value in facts["settings"].items()]
    parts = [
        f"# {facts['name']}",
        facts["about"],
        f"```sh\nsymphony evaluate {facts['name']} --data DIR\n```",
        "## Training",
        facts["training"]["words"],
        "\n".join(rows),
        "## Scores",
        *([_score_page(facts["name"], found) for found in facts["scores"]] or ["It has not been evaluated."]),
        "## Limits",
        facts["limits"],
        "## Files",
        "`agent.json`: what the networks are and how it is simulated. `card.json`: this page for `symphony agents`. "
        "`config.json`: all settings of the training, with names in place of paths. `checkpoints/`: the weights as "
        "safetensors, each with its checksum in `checkpoint.json`, without the state of the optimizers. "
        + ("`evaluations/`: the scores above. " if facts["scores"] else "")
        + "Licence: that of the package, Apache-2.0. Made by `benchmarks/make_pretrained.py`.",
    ]
    return "\n\n".join(parts) + "\n"


def _method_words(spec: AgentSpec) -> str:
    adversarial = spec.action_space == "displacement"
    words = "adversarial imitation through the model" if adversarial else "behavioural cloning"
    extras = []
    if spec.goals:
        extras.append("routes that a goal policy draws from the first state")
    judge = "a rule" if spec.search.score == "rule" else "a discriminator"
    if spec.searches and spec.search.way == "backtrack":
        extras.append(f"rollouts that go back and try again where {judge} finds them bad")
    elif spec.searches:
        extras.append(f"a beam search that {judge} prunes")
    return words + (f", with {' and '.join(extras)}." if extras else ".")


def _training(source: Source, config: TrainConfig) -> str:
    own = source.config
    update = f"{own.segments} run segments and {_count(own.states)} expert states"
    if source.spec.action_space == "displacement":
        regression = min(own.mgail.regression, source.step)
        update = f"regression ({update}) in {_count(regression)} of them" if regression else ""
        rollouts = f"{own.mgail.rollouts} rollouts"
        update = f"{update}, {rollouts} in the rest" if update else rollouts
    text = (
        f"Learned from `{data_name(own.data)}` (checksum `{source.data}`"
        + (f": {source.holds}" if source.holds else "")
        + f") with seed {own.seed}: "
        f"{_count(source.step)} updates of {update}"
        + (f", starting from {source.before}." if source.before else ", starting from new networks.")
    )
    if source.step != own.steps:
        text += f" The run went on to {_count(own.steps)} updates."
    if own.validation.data is not None:
        text += (
            f" The checkpoint was chosen by {own.validation.segments} segments of `{data_name(own.validation.data)}`."
        )
    if source.spec.searches:
        text += f" Searches in training had {own.search.branches} branches, pruned {_pruning(asdict(own.search))}."
        if config.search != own.search:
            text += (
                f" From now on its trees are pruned {_pruning(asdict(config.search))}, which it was not trained with."
            )
    return text


def _pruning(search: dict[str, Any]) -> str:
    words = f"every {search['prune_every']} steps by rule `{search['rule']}`"
    words += f" (temperature {search['temperature']:g})" if search["rule"] == "systematic" else ""
    words += f" (threshold {search['threshold']:g})" if search["rule"] == "replace" else ""
    return words + (", each branch with goals of its own" if search.get("goals") == "branch" else "")


def _settings(config: TrainConfig, spec: AgentSpec, parameters: dict[str, int]) -> dict[str, str]:
    rows: list[tuple[str, Any]] = [(f"weights of the {part}", _count(number)) for part, number in parameters.items()]
    rows += [(f"`agent.{key}`", value) for key, value in asdict(config.agent).items()]
    rows += [("`learning_rate`", config.learning_rate)]
    if spec.discriminator is not None:
        rows += [("`discriminator.features`", config.discriminator.features)]
    if spec.action_space == "displacement":
        rows += [
            (f"`mgail.{key}`", getattr(config.mgail, key))
            for key in ("regression", "rollouts", "learning_rate", "cost", "expert_weight")
        ]
    if spec.searches:
        rows += [
            (f"`search.{key}`", getattr(config.search, key))
            for key in ("test_branches", "prune_every", "rule", "goals")
        ]
    return {key: str(value) for key, value in rows}


def _scores_of(record: dict[str, Any]) -> dict[str, Any]:
    """Return an evaluation as a card has it."""
    how, data = record["config"], record["data"]
    trees = "one search tree" if how["trees"] == 1 else f"{how['trees']} search trees"
    ways = {
        "none": f"{how['rollouts']} independent rollouts",
        "tree": f"{how['rollouts']} leaves of {trees} of {how['branches']} branches, pruned {_pruning(how)}",
        "backtrack": f"{how['rollouts']} rollouts that go back where they are bad",
        "best": f"the best of {how['branches']} independent rollouts by the discriminator",
    }
    numbers = [name for key, _, _ in COLUMNS for name in (key, f"{key}_se")]
    rows = {"": record, "constant velocity": record["constant_velocity"], "log playback": record["playback"]}
    return {
        "data": _standard(data) or data["name"],
        "checksum": data["checksum"],
        "segments": record["segments"],
        "groups": record["groups"],
        "interactive": how["interactive"],
        "how": ways[how["search"]],
        "seed": how["seed"],
        "rows": {label: {name: row.get(name) for name in numbers} for label, row in rows.items()},
    }


def _standard(data: dict[str, Any]) -> str | None:
    """Return the name of the standard set that a store is, by its checksum."""
    for preset, made in PRESETS.items():
        for split, checksum in made.checksums.items():
            if checksum == data["checksum"]:
                return f"{preset}/{split}"
    return None


def _score_page(name: str, found: dict[str, Any]) -> str:
    heads = ["agent", *(heading.replace("\n", " ") for _, heading, _ in COLUMNS)]
    lines = [f"| {' | '.join(heads)} |", "| --- " * len(heads) + "|"]
    lines += [_row(label or name, row) for label, row in found["rows"].items()]
    text = (
        f"{found['segments']} run segments of `{found['data']}` (checksum `{found['checksum']}`), "
        f"{found['interactive']} interactive agents each; per segment {found['how']}; ± standard error over "
        f"{found['groups']} recordings; seed {found['seed']}."
    )
    return "\n".join([*lines, "", text])


def _row(name: str, numbers: dict[str, Any]) -> str:
    cells = []
    for key, _, digits in COLUMNS:
        value, error = numbers.get(key), numbers.get(f"{key}_se")
        if value is None:
            cells.append("–")
        else:
            cells.append(f"{value:.{digits}f}" + ("" if error is None else f" ± {error:.{digits}f}"))
    return f"| {' | '.join([name, *cells])} |"


def _limits(source: Source, method: str) -> str:
    made, spec = data_name(source.config.data).partition("/")[0] in PRESETS, source.spec
    knows = (
        "It knows only simulated towns: rule-made driving below about 13 m/s without freeways, pedestrians, "
        "cyclists, parked cars or mistakes. On real logs expect several times more collisions and, on roads "
        "unlike those, a poor fit; it is no safe driver."
        if made
        else source.limits or "It knows only driving and maps like those it learned from."
    )
    parts = [
        knows,
        f"It is one run of one seed, much smaller than the paper's {method}, and no figure of the paper.",
    ]
    if spec.searches:
        parts.append(
            "It is meant to be simulated with its search, which runs many branches at once and keeps those that look "
            "most like the log. Leaves of one tree share ancestors and are less diverse than independent rollouts, "
            "so minSADE is not comparable between the two."
        )
    parts.append("It is meant for research on traffic simulation, not for driving a vehicle.")
    return " ".join(parts)


def _count(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def main(args: Sequence[str] | None = None) -> None:
    """Write one agent and say how large it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="folder of a run, or RUN@WHICH")
    parser.add_argument("name", help="of the agent, such as bc_ts_h")
    parser.add_argument(
        "--scores",
        type=Path,
        nargs="+",
        default=[],
        help="evaluations of it, each on data of its own (default: the one that the run keeps)",
    )
    parser.add_argument(
        "--rule",
        default="agent",
        help="prune its trees so (default: as it was trained)",
    )
    parser.add_argument("--prune-every", type=int, default=0, help="steps between prunings, likewise")
    parser.add_argument("--temperature", type=float, default=0.0, help="of rule systematic, likewise")
    parser.add_argument("--threshold", type=float, help="of rule replace, likewise")
    parser.add_argument("--goals", default="agent", help="who draws goals together, likewise")
    parser.add_argument("--holds", default="", help="what its training data is, in words")
    parser.add_argument("--limits", default="", help="of what it has learned, in words")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of all these agents")
    arguments = parser.parse_args(args)
    try:
        pruning = EvaluateConfig(
            rule=arguments.rule,
            prune_every=arguments.prune_every,
            temperature=arguments.temperature,
            threshold=arguments.threshold,
            goals=arguments.goals,
        )
        if arguments.run == PREFIX + arguments.name:
            place = add_scores(arguments.name, arguments.scores, arguments.folder)
        else:
            words = {"holds": arguments.holds, "limits": arguments.limits}
            place = make(arguments.run, arguments.name, arguments.scores, pruning, arguments.folder, **words)
    except SymphonyError as error:
        parser.exit(1, f"error: {error}\n")
    size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
    print(f"{place}: {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
