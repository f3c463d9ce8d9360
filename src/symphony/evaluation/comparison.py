"""The paper's tables from evaluated runs: which evaluations count, means over seeds, the best of each family."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, get_args

from symphony.config import Method, PaperData, Setting, TableColumns
from symphony.errors import ConfigError, DataError
from symphony.evaluation.paper import METRICS, paper_figures
from symphony.evaluation.records import (
    find_runs,
    kept_evaluations,
    read_run,
    run_interactive,
    simulation_way,
    updates_done,
)

BASELINES = {"playback": "Playback", "constant_velocity": "Constant velocity"}
"""Rows that every table begins with."""
ROWS: tuple[str, ...] = (*BASELINES, *get_args(Method))
SETTINGS: dict[Setting, tuple[int, int]] = {"main": (2, 10), "long": (2, 20), "many": (8, 10)}
"""Interactive agents and seconds."""
WHOLE_LOG = 10
"""Seconds that a run counts as where it was trained on the whole of the segments."""

# What may differ between runs of one method: which seed, where things lie, how it was run.
_FREE = (
    "seed",
    "data",
    "validation.data",
    "out",
    "warm_start",
    "resume",
    "device",
    "wandb",
    "checkpoint_every",
    "log_every",
)


@dataclass(frozen=True)
class Column:
    """A metric as it is shown: times ``scale``, with ``digits`` after the point.

    Attributes:
        key: its name in a record; that of a difference where ``less`` says of which two.
        title: its heading.
        unit: after scaling.
        optional: not all records have it; where it is absent there is no number.
        less: names of the metric it begins with and of the one that is taken away.
    """

    key: str
    title: str
    unit: str
    scale: float = 1.0
    digits: int = 2
    optional: bool = False
    less: tuple[str, str] | None = None

    def shown(self, value: float) -> str:
        """The value as text."""
        return f"{value * self.scale:.{self.digits}f}"


COLUMNS = (
    Column("collision_rate", "collision", "%"),
    Column("offroad_time", "off-road", "%"),
    Column("ade", "ADE", "m"),
    Column("min_sade", "minSADE", "m"),
    Column("curvature_jsd", "curvature JSD", "10⁻³", 1000.0),
)
"""In the paper's order and units."""
WOSAC = (
    Column("wosac_metametric", "WOSAC", "", digits=3, optional=True),
    Column("wosac_kinematic_metrics", "kinematic", "", digits=3, optional=True),
    Column("wosac_interactive_metrics", "interactive", "", digits=3, optional=True),
    Column("wosac_map_based_metrics", "map", "", digits=3, optional=True),
    Column("wosac_min_ade", "minADE", "m", optional=True),
)
"""Of evaluations with `--metrics wosac`; the metametric and the three means of its components, 0 to 1."""
COST = Column("cost", "CPU", "s/segment", digits=2)
"""Of the simulation of all rollouts of a segment."""


AT_A_DISTANCE = ("ade", "min_sade", "curvature_jsd", "curvature_jsd_floor", "curvature_jsd_corrected")
"""What says nothing of the log itself."""
FLOOR = Column("curvature_jsd_floor", "JSD floor", "10⁻³", 1000.0, optional=True)
"""What another log of the same size would score, beside the divergence."""
ASKED: dict[TableColumns, tuple[Column, ...]] = {
    "split": (
        Column("collision_with_playback", "with playback", "%", optional=True),
        Column(
            "collision_with_agents",
            "the rest",
            "%",
            optional=True,
            less=("collision_rate", "collision_with_playback"),
        ),
    ),
    "standing": (
        Column("standing", "standing", "%", digits=1, optional=True),
        Column("standing_log", "in the log", "%", digits=1, optional=True),
    ),
    "corrected": (Column("curvature_jsd_corrected", "JSD corrected", "10⁻³", 1000.0, optional=True),),
    "goals": (
        Column("goals_turn_variation", "turns moved", "TV", optional=True),
        Column("goals_variation", "goals moved", "TV", optional=True),
        Column("goals_founders", "first branches", "left", digits=1, optional=True),
    ),
}
"""Columns on request."""
METHOD_COLUMNS = {column.key: column for column in (*COLUMNS, *(c for each in ASKED.values() for c in each))}
"""All but those of a user's own, by key."""


@dataclass(frozen=True)
class Cell:
    """One metric of one method.

    Attributes:
        values: of every seed.
        mean: over them; NaN where one of them is.
        error: standard error of the mean; NaN for a single seed.
        best: whether no method of its family is better.
    """

    values: tuple[float, ...]
    mean: float
    error: float
    best: bool = False

    @classmethod
    def of(cls, values: Sequence[float]) -> Cell:
        """The cell of some seeds."""
        count, mean = len(values), math.fsum(values) / len(values)
        squares = math.fsum((value - mean) ** 2 for value in values)
        error = math.sqrt(squares / (count - 1) / count) if count > 1 else math.nan
        return cls(tuple(values), mean, error)


@dataclass(frozen=True)
class Row:
    """A method: its seeds in ascending order, our cells and the paper's by metric.

    ``way`` says how it was simulated, where a method has a row for each.
    """

    method: str
    seeds: tuple[int, ...]
    cells: Mapping[str, Cell]
    paper: Mapping[str, Cell] = field(default_factory=dict)
    evaluations: tuple[str, ...] = ()
    way: str = ""

    @property
    def name(self) -> str:
        """As in the paper, then the way."""
        return " ".join(filter(None, (method_name(self.method), self.way)))


@dataclass(frozen=True)
class Comparison:
    """A table of the paper from our runs.

    Attributes:
        setting: which of the paper's.
        dataset: whose figures stand beside ours; None for none.
        columns: the paper's metrics, metrics of the user's own, the cost.
        rows: in the paper's order, of the methods there are.
        notes: what else must be known to read it.
    """

    setting: Setting
    dataset: PaperData | None
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]

    @property
    def title(self) -> str:
        """The setting in words."""
        interactive, seconds = SETTINGS[self.setting]
        return f"{interactive} interactive agents, {seconds} s"


@dataclass(frozen=True)
class Entry:
    """A run and the evaluation that stands for it, or one of several by the way it was simulated."""

    folder: Path
    config: Mapping[str, Any]
    name: str
    record: Mapping[str, Any]
    way: str = ""

    @property
    def method(self) -> str:
        """Row it belongs to."""
        return self.config["method"]

    @property
    def seed(self) -> int:
        """Of its training."""
        return self.config.get("seed", 0)


def method_name(method: str) -> str:
    """A method as the paper writes it, such as BC+TS+H."""
    return BASELINES.get(method) or method.upper().replace("_", "+")


def family(method: str) -> str:
    """Methods that compete for the best value: ``bc`` or ``mgail``."""
    return method.partition("_")[0]


def collect(
    folders: Sequence[Path], setting: Setting, patterns: Sequence[str] = (), *, each: bool = False
) -> tuple[list[Entry], dict[str, list[Path]]]:
    """The evaluated runs of a setting.

    Args:
        folders: runs, or folders of runs.
        setting: of the runs that are wanted.
        patterns: names of evaluations (``*`` and ``?`` stand for anything); of those of a run, the ones that the
            first fitting pattern fits count. Without patterns all do.
        each: take every evaluation that any pattern fits, as a row for each way of simulation.

    Returns:
        The runs, each with its one evaluation (or with each), and those that are left out by the reason.

    Raises:
        ConfigError: no runs, a run with several evaluations, or two runs of the same method and seed.
        DataError: a file that can't be read.
    """
    entries: list[Entry] = []
    left_out: dict[str, list[Path]] = {}
    for folder in find_runs(folders):
        config = read_run(folder)
        reason = _unfit(config, setting)
        if reason:
            left_out.setdefault(reason, []).append(folder)
            continue
        interactive, seconds = SETTINGS[setting]
        kept = {
            name: record
            for name, record in kept_evaluations(folder).items()
            if record["config"]["interactive"] == interactive
            and (record["config"]["duration"] or WHOLE_LOG) == seconds
        }
        if not fitting(kept, patterns):
            reason = (
                "only evaluated in other ways" if kept else "not evaluated (symphony evaluate RUN --data DIR)"
            )
            left_out.setdefault(reason, []).append(folder)
            continue
        if each:
            names = [name for name in kept if any(fitting([name], [p]) for p in patterns or "*")]
            entries += [Entry(folder, config, n, kept[n], simulation_way(kept[n]["config"])) for n in names]
        else:
            entries.append(Entry(folder, config, *choose_evaluation(folder, kept, patterns)))
    _check_distinct(entries)
    return entries, left_out


def _unfit(config: Mapping[str, Any], setting: Setting) -> str:
    if config["method"] not in ROWS[1:]:
        return f"unknown method {config['method']}"
    found = run_interactive(dict(config)), config.get("duration") or WHOLE_LOG
    if found != SETTINGS[setting]:
        return f"trained with {found[0]} interactive agents for {found[1]:g} s"
    return ""


def fitting(kept: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Names of the evaluations that the first fitting pattern fits; all without patterns."""
    if not patterns:
        return list(kept)
    found = ([name for name in kept if fnmatchcase(name, pattern)] for pattern in patterns)
    return next((names for names in found if names), [])


def choose_evaluation(
    run: Path, kept: Mapping[str, dict[str, Any]], patterns: Sequence[str] = ()
) -> tuple[str, dict[str, Any]]:
    """Name and record of the one evaluation of a run that fits (see :func:`collect`).

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


def _check_distinct(entries: Sequence[Entry]) -> None:
    seen: dict[tuple[str, int, str], Entry] = {}
    for entry in entries:
        other = seen.setdefault((entry.method, entry.seed, entry.way), entry)
        if other is entry:
            continue
        if other.folder == entry.folder:
            names = f"{other.name}, {entry.name}"
            raise ConfigError(
                f"{entry.folder} was simulated twice as {entry.way}, choose with --evaluation: {names}"
            )
        raise ConfigError(
            f"two runs of {method_name(entry.method)} with seed {entry.seed}: {other.folder}, {entry.folder}"
        )


def compare(
    entries: Sequence[Entry],
    setting: Setting,
    dataset: PaperData | None = None,
    asked: Sequence[TableColumns] = (),
) -> Comparison:
    """The table of some evaluated runs; their order does not matter.

    Args:
        entries: the runs, of one method with one seed one for each way of simulation.
        setting: theirs.
        dataset: whose figures from the paper stand beside ours.
        asked: columns on request.

    Raises:
        ConfigError: no runs, runs evaluated on different segments, seeds of a method evaluated in different ways, or
            figures that the paper does not have.
        DataError: an evaluation without a number that is needed.
    """
    figures = None if dataset is None else paper_figures(setting, dataset)
    if dataset is not None and figures is None:
        raise ConfigError(f"the paper has no figures for setting '{setting}' on {dataset}")
    if not entries:
        raise ConfigError(f"no evaluated runs of setting '{setting}'")
    entries = sorted(entries, key=lambda entry: (ROWS.index(entry.method), entry.way, entry.seed))
    _check_comparable(entries)
    # Beside the paper's figures stand only what the paper has.
    floor = () if any(FLOOR.key not in entry.record for entry in entries) else (FLOOR,)
    more = [column for name in dict.fromkeys(asked) for column in ASKED[name]]
    columns = (
        (*COLUMNS, *more)
        if figures
        else (*COLUMNS, *floor, *more, *_wosac_columns(entries), *_own_columns(entries), COST)
    )
    rows = [_baseline_row(entries[0], name, columns) for name in BASELINES]
    for method, way in dict.fromkeys((entry.method, entry.way) for entry in entries):
        mine = [entry for entry in entries if (entry.method, entry.way) == (method, way)]
        cells = {column.key: Cell.of([_number(entry, column) for entry in mine]) for column in columns}
        seeds, names = tuple(entry.seed for entry in mine), tuple(entry.name for entry in mine)
        rows.append(Row(method, seeds, cells, evaluations=names, way=way))
    ours = _with_best({(row.method, row.way): row.cells for row in rows}, columns)
    theirs = _with_best(
        {(method, ""): cells for method, cells in _paper_cells(figures or {}).items()}, COLUMNS
    )
    rows = [
        replace(row, cells=ours[row.method, row.way], paper=theirs.get((row.method, ""), {})) for row in rows
    ]
    return Comparison(setting, dataset, columns, tuple(rows), tuple(_notes(entries, dataset)))


def _wosac_columns(entries: Sequence[Entry]) -> tuple[Column, ...]:
    """The WOSAC score where all evaluations have it, of one year."""
    years = {entry.record.get("wosac", {}).get("config") for entry in entries}
    if len(years) > 1 and None not in years:
        raise ConfigError(f"WOSAC scores of {', '.join(sorted(years))}, choose with --evaluation")
    return () if None in years else WOSAC


def _own_columns(entries: Sequence[Entry]) -> list[Column]:
    """A column for each metric of a user's own that all evaluations have."""
    paths = [set(entry.record["config"].get("metric", ())) for entry in entries]
    return [Column(path, path.rpartition(":")[2], "", digits=3) for path in sorted(set.intersection(*paths))]


def _baseline_row(entry: Entry, name: str, columns: Sequence[Column]) -> Row:
    """What the evaluations say of the log or of constant velocity."""
    cells = {column.key: Cell((), math.nan, math.nan) for column in columns}
    # The log is at no distance from itself.
    known = [column for column in columns if not (name == "playback" and column.key in AT_A_DISTANCE)]
    for column in known:
        if column.key in METRICS or column.optional:
            cells[column.key] = Cell.of([_number(entry, column, name)])
    return Row(name, (), cells)


def _paper_cells(figures: Mapping[str, Mapping[str, tuple[float, float]]]) -> dict[str, dict[str, Cell]]:
    return {
        method: {key: Cell((), mean, error) for key, (mean, error) in row.items()}
        for method, row in figures.items()
    }


def _with_best(
    table: Mapping[tuple[str, str], Mapping[str, Cell]], columns: Sequence[Column]
) -> dict[tuple[str, str], dict[str, Cell]]:
    """Mark the lowest value of every metric in each family of two methods or more.

    What looks equal in the table is equally good.
    """
    shown = {column.key: column.shown for column in columns}
    ranked = {column.key for column in COLUMNS}
    done: dict[tuple[str, str], dict[str, Cell]] = {}
    for (method, way), cells in table.items():
        rivals = [other for other in table if family(other[0]) == family(method)]
        done[method, way] = {}
        for key, cell in cells.items():
            means = [table[other][key].mean for other in rivals if not math.isnan(table[other][key].mean)]
            rated = key in ranked and method not in BASELINES and len(means) > 1
            best = rated and shown[key](cell.mean) == shown[key](min(means))
            done[method, way][key] = Cell(cell.values, cell.mean, cell.error, best)
    return done


def _number(entry: Entry, column: Column, part: str = "") -> float:
    if column.key == COST.key:
        return float(entry.record["cost"]["simulation"]) / max(1, entry.record["segments"])
    if column.less is not None:
        begin, taken = (replace(column, key=key, less=None) for key in column.less)
        return _number(entry, begin, part) - _number(entry, taken, part)
    where = entry.record[part] if part else entry.record
    return math.nan if column.optional and column.key not in where else number(entry, where, column.key)


def number(entry: Entry, where: Mapping[str, Any], key: str) -> float:
    """A number of an evaluation, from its record or a part of it; NaN for a mean over nothing.

    Raises:
        DataError: it is none.
    """
    value = where.get(key, "")
    # JSON has no NaN, which stands for a mean over nothing.
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError("is no number", file=f"{entry.folder}: {entry.name}", field=key)
    return float(value)


def _check_comparable(entries: Sequence[Entry]) -> None:
    first = entries[0]
    known: dict[tuple[str, str], Entry] = {}
    for entry in entries:
        if entry.record["data"].get("checksum") != first.record["data"].get("checksum"):
            raise ConfigError(
                f"evaluated on different run segments, choose with --evaluation: {first.folder} ({first.name}), "
                f"{entry.folder} ({entry.name})"
            )
        other = known.setdefault((entry.method, entry.way), entry)
        if _way(other) != _way(entry):
            raise ConfigError(
                f"seeds of {method_name(entry.method)} evaluated in different ways, choose with --evaluation: "
                f"{other.folder} ({other.name}), {entry.folder} ({entry.name})"
            )


def _way(entry: Entry) -> dict[str, Any]:
    return {name: value for name, value in entry.record["config"].items() if name != "seed"}


def _notes(entries: Sequence[Entry], dataset: PaperData | None) -> list[str]:
    record = entries[0].record
    notes = [
        f"{record['segments']} run segments of {record.get('groups', record['segments'])} recordings in "
        f"{record['data']['name']} "
        f"({record['data']['checksum'][:12]}); ± standard error over seeds; bold: best of the BC methods and "
        f"of the MGAIL methods"
    ]
    ways: dict[str, list[str]] = {}
    for entry in entries:
        config = entry.record["config"]
        ways.setdefault(f"{simulation_way(config)}, {config['rollouts']} rollouts", []).append(entry.method)
    for way, methods in ways.items():
        notes.append(f"simulated {way}: {', '.join(dict.fromkeys(map(method_name, methods)))}")
    for method in dict.fromkeys(entry.method for entry in entries):
        mine = [_flat(entry.config) for entry in entries if entry.method == method]
        names = dict.fromkeys(name for config in mine for name in config)
        differing = [name for name in names if len({json.dumps(c.get(name)) for c in mine}) > 1]
        if differing:
            notes.append(f"runs of {method_name(method)} differ in {', '.join(differing)}")
    if dataset is None and _wosac_columns(entries):
        notes.append(
            f"WOSAC {record['wosac']['config']}: 32 rollouts of 8 s of all vehicles; higher is better"
        )
    for entry in entries:
        then, now = entry.record["run"]["updates"], updates_done(entry.folder)
        if then and now and then != now:
            notes.append(f"{entry.folder} was evaluated after {then} updates and has {now} now")
    if dataset is not None:
        notes.append(f"paper: Igl et al. 2022, {dataset} dataset, five seeds")
    return notes


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in config.items():
        if prefix + name in _FREE:
            continue
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat
