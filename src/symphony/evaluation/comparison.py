"""The paper's tables from evaluated runs: means over seeds, the best of each family, notes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from symphony.config import EvaluateConfig, PaperData, Setting, TableColumns
from symphony.errors import ConfigError
from symphony.evaluation.entries import (
    AT_STATES,
    BASELINES,
    ROWS,
    SETTINGS,
    Entry,
    family,
    method_name,
    number,
    setting_seconds,
)
from symphony.evaluation.paper import METRICS, paper_figures
from symphony.evaluation.records import (
    simulation_way,
    updates_done,
)

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


_TRAFFIC = ("interactive", "others", "open_traffic", "radius")
"""Settings of an evaluation that decide what agents meet: rows of a table share them."""
AT_A_DISTANCE = ("ade", "min_sade", "curvature_jsd", "curvature_jsd_floor", "curvature_jsd_corrected")
"""What says nothing of the log itself."""
FLOOR = Column("curvature_jsd_floor", "JSD floor", "10⁻³", 1000.0, optional=True)
"""What the finite size of the log alone gives, beside the divergence."""
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
        ConfigError: no runs, runs evaluated on different segments or in other traffic, seeds of a method evaluated
            in different ways, or figures that the paper does not have.
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
    where = entry.record[part] if part else entry.record
    if column.less is not None:
        # Kinds are of all collisions, those between states included.
        begin, taken = (where.get(key) for key in column.less)
        return math.nan if begin is None or taken is None else float(begin) - float(taken)
    return math.nan if column.optional and column.key not in where else number(entry, where, column.key)


def _check_comparable(entries: Sequence[Entry]) -> None:
    first = entries[0]
    known: dict[tuple[str, str], Entry] = {}
    for entry in entries:
        if entry.record["data"].get("checksum") != first.record["data"].get("checksum"):
            raise ConfigError(
                f"evaluated on different run segments, choose with --evaluation: {first.folder} ({first.name}), "
                f"{entry.folder} ({entry.name})"
            )
        differing = [
            name
            for name in _TRAFFIC
            if len(
                {each.record["config"].get(name, getattr(EvaluateConfig, name)) for each in (first, entry)}
            )
            > 1
        ]
        # 0 seconds are all of a segment: whether those are as many, only what was found tells.
        if entry.record["config"]["duration"] != first.record["config"]["duration"]:
            far = [number(each, each.record["constant_velocity"], "ade") for each in (first, entry)]
            differing += [] if math.isclose(*far, rel_tol=1e-3) else ["duration"]
        if differing:
            raise ConfigError(
                f"evaluated in other traffic ({', '.join(differing)}), choose with --evaluation: {first.folder} "
                f"({first.name}), {entry.folder} ({entry.name})"
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
    horizons = sorted({round(entry.record["horizon"], 1) for entry in entries if "horizon" in entry.record})
    if any(each != setting_seconds(record) for each in horizons):
        notes.append(f"rollouts last {' or '.join(f'{each:g}' for each in horizons)} s")
    more = {
        f"{method_name(entry.method)} {entry.record['collision_rate']:.2f} %": None
        for entry in entries
        if entry.record.get(AT_STATES, entry.record["collision_rate"]) != entry.record["collision_rate"]
    }
    found = f"; with those between states: {', '.join(more)}" if more else ""
    notes.append(f"collisions are counted at states only, as the paper counts them{found}")
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
        if entry.record["run"].get("named"):
            at = entry.record["run"]["checkpoint"]
            notes.append(
                f"{entry.folder} was evaluated at its checkpoint {at}, which it would not choose itself"
            )
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
