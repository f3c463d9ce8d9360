"""The paper's tables from evaluated runs: which evaluations count, means over seeds, the best of each family."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, get_args

from symphony.config import EvaluateConfig, Method, PaperData, Setting, TableColumns
from symphony.errors import ConfigError, DataError
from symphony.evaluation.paper import METRICS, paper_figures
from symphony.evaluation.records import (
    choose_evaluation,
    find_runs,
    fitting,
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
AT_STATES = "collision_rate_at_states"
"""The paper's reading of collisions; records from before it had a name have no other."""
WHOLE_LOG = 10
"""Seconds that the whole of the segments counts as, where nothing says how many they are."""
_TRAFFIC = ("interactive", "others", "open_traffic", "radius")
"""Settings of an evaluation that decide what agents meet: rows of a table share them."""
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
"""What may differ between runs of one method: which seed, where things lie, how it was run."""
_AT_A_DISTANCE = ("ade", "min_sade", "curvature_jsd", "curvature_jsd_floor", "curvature_jsd_corrected")
"""Distances from the log, of which the log itself has none."""


# --- which evaluations count ---


@dataclass(frozen=True)
class Entry:
    """A run and the evaluation that stands for it, or one of several by the way it was simulated.

    Attributes:
        folder: of the run.
        config: of the run.
        name: of the evaluation.
        record: the evaluation.
        way: how it was simulated, where a run has a row for each way.
    """

    folder: Path
    config: Mapping[str, Any]
    name: str
    record: Mapping[str, Any]
    way: str = ""

    @property
    def method(self) -> str:
        """The row that the run belongs to."""
        return self.config["method"]

    @property
    def seed(self) -> int:
        """The seed of the training."""
        return self.config.get("seed", 0)

    def __str__(self) -> str:
        return f"{self.folder} ({self.name})"


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
    interactive, seconds = SETTINGS[setting]
    for folder in find_runs(folders):
        config, kept, reason = read_run(folder), {}, ""
        acting, lasting = run_interactive(config), config.get("duration", 0)
        if config["method"] not in ROWS[1:]:
            reason = f"unknown method {config['method']}"
        elif acting != interactive or lasting not in (0, seconds):
            reason = f"trained with {acting} interactive agents for {lasting or WHOLE_LOG:g} s"
        else:
            kept = {
                name: record
                for name, record in kept_evaluations(folder).items()
                if record["config"]["interactive"] == interactive
                and setting_seconds(record) == seconds
                and record["config"]["duration"] in (0, config.get("duration") or WHOLE_LOG)
            }
            if not kept:
                reason = "not evaluated (symphony evaluate RUN --data DIR)"
            elif not fitting(kept, patterns):
                reason = "only evaluated in other ways"
        if reason:
            left_out.setdefault(reason, []).append(folder)
        elif each:
            names = [name for name in kept if any(fnmatchcase(name, pattern) for pattern in patterns or "*")]
            entries += [Entry(folder, config, n, kept[n], simulation_way(kept[n]["config"])) for n in names]
        else:
            entries.append(Entry(folder, config, *choose_evaluation(folder, kept, patterns)))
    seen: dict[tuple[str, int, str], Entry] = {}
    for entry in entries:
        other = seen.setdefault((entry.method, entry.seed, entry.way), entry)
        if other.folder != entry.folder:
            raise ConfigError(
                f"two runs of {method_name(entry.method)} with seed {entry.seed}: {other.folder}, {entry.folder}"
            )
        if other is not entry:
            raise ConfigError(
                f"{entry.folder} was simulated twice as {entry.way}, choose with --evaluation: {other.name}, "
                f"{entry.name}"
            )
    return entries, left_out


def setting_seconds(record: Mapping[str, Any]) -> float:
    """Seconds of the setting that an evaluation belongs to.

    Those asked for; of one over the whole of the segments those of the setting that is nearest to its horizon: logs
    of 9.1 s belong to the one of 10.
    """
    horizon: float = record.get("horizon", WHOLE_LOG)
    nearest = min((seconds for _, seconds in SETTINGS.values()), key=lambda seconds: abs(seconds - horizon))
    return record["config"]["duration"] or nearest


def number(entry: Entry, where: Mapping[str, Any], key: str) -> float:
    """A number of an evaluation, from its record or a part of it; NaN for a mean over nothing.

    Collisions are those at states only, as the paper and all evaluations of before count them.

    Raises:
        DataError: it is none.
    """
    value = where.get(AT_STATES, where.get(key, "")) if key == "collision_rate" else where.get(key, "")
    # JSON has no NaN, which stands for a mean over nothing.
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError("is no number", file=f"{entry.folder}: {entry.name}", field=key)
    return float(value)


# --- numbers ---


@dataclass(frozen=True)
class Column:
    """A metric as it is shown: times ``scale``, with ``digits`` after the point.

    Attributes:
        key: its name in a record; that of a difference where ``less`` says of which two.
        title: its heading.
        unit: after scaling.
        scale: what it is multiplied with.
        digits: after the point.
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
COST = Column("cost", "CPU", "s/segment")
"""CPU time of the simulation of all rollouts of a segment."""
FLOOR = Column("curvature_jsd_floor", "JSD floor", "10⁻³", 1000.0, optional=True)
"""What the finite size of the log alone gives, beside the divergence."""
_SPLIT = ("collision_rate", "collision_with_playback")
ASKED: dict[TableColumns, tuple[Column, ...]] = {
    "split": (
        Column("collision_with_playback", "with playback", "%", optional=True),
        Column("collision_with_agents", "the rest", "%", optional=True, less=_SPLIT),
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


@dataclass(frozen=True)
class Cell:
    """One metric of one method.

    Attributes:
        values: of every seed.
        mean: over them; NaN where one of them is.
        error: standard error of the mean; NaN for a single seed.
        best: whether no method of its family is better.
    """

    values: tuple[float, ...] = ()
    mean: float = math.nan
    error: float = math.nan
    best: bool = False

    @classmethod
    def of(cls, values: Sequence[float]) -> Cell:
        """The cell of some seeds."""
        count, mean = len(values), math.fsum(values) / len(values)
        squares = math.fsum((value - mean) ** 2 for value in values)
        error = math.sqrt(squares / (count - 1) / count) if count > 1 else math.nan
        return cls(tuple(values), mean, error)


ABSENT = Cell()


@dataclass(frozen=True)
class Row:
    """A method, or one way of simulating it.

    Attributes:
        method: its name.
        way: how it was simulated, where a method has a row for each way.
        seeds: in ascending order.
        evaluations: names of the evaluations of each seed.
        cells: ours by metric.
        paper: the paper's by metric.
    """

    method: str
    way: str
    seeds: tuple[int, ...]
    evaluations: tuple[str, ...]
    cells: Mapping[str, Cell]
    paper: Mapping[str, Cell]

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
    figures = paper_figures(setting, dataset) if dataset else {}
    if dataset is not None and not figures:
        raise ConfigError(f"the paper has no figures for setting '{setting}' on {dataset}")
    if not entries:
        raise ConfigError(f"no evaluated runs of setting '{setting}'")
    entries = sorted(entries, key=lambda entry: (ROWS.index(entry.method), entry.way, entry.seed))
    _check_comparable(entries)
    columns = (*COLUMNS, *(column for name in dict.fromkeys(asked) for column in ASKED[name]))
    if not figures:  # beside the paper's figures stand only what the paper has
        floor = (FLOOR,) if all(FLOOR.key in entry.record for entry in entries) else ()
        paths = [set(entry.record["config"].get("metric", ())) for entry in entries]
        own = [
            Column(path, path.rpartition(":")[2], "", digits=3) for path in sorted(set.intersection(*paths))
        ]
        wosac = WOSAC if _wosac_year(entries) else ()
        columns = (*COLUMNS, *floor, *columns[len(COLUMNS) :], *wosac, *own, COST)
    found: dict[tuple[str, str], list[Entry]] = {(name, ""): [] for name in BASELINES}
    for entry in entries:
        found.setdefault((entry.method, entry.way), []).append(entry)
    theirs = _with_best(
        {
            (method, ""): {key: Cell((), *figure) for key, figure in row.items()}
            for method, row in figures.items()
        }
    )
    ours = _with_best(
        {
            name: {column.key: _cell(mine, column, name[0], entries[0]) for column in columns}
            for name, mine in found.items()
        }
    )
    rows = [
        Row(
            *name,
            tuple(entry.seed for entry in mine),
            tuple(entry.name for entry in mine),
            ours[name],
            theirs.get((name[0], ""), {}),
        )
        for name, mine in found.items()
    ]
    return Comparison(setting, dataset, columns, tuple(rows), tuple(_notes(entries, dataset)))


def _wosac_year(entries: Sequence[Entry]) -> str | None:
    """The year of the WOSAC scores, where all evaluations have one."""
    years = {entry.record.get("wosac", {}).get("config") for entry in entries}
    if len(years) > 1 and None not in years:
        raise ConfigError(f"WOSAC scores of {', '.join(sorted(years))}, choose with --evaluation")
    return None if None in years else years.pop()


def _number(entry: Entry, column: Column, part: str = "") -> float:
    if column.key == COST.key:
        return float(entry.record["cost"]["simulation"]) / max(1, entry.record["segments"])
    where = entry.record[part] if part else entry.record
    if column.less is not None:
        # Kinds are of all collisions, those between states included.
        begin, taken = (where.get(key) for key in column.less)
        return math.nan if begin is None or taken is None else float(begin) - float(taken)
    return math.nan if column.optional and column.key not in where else number(entry, where, column.key)


def _cell(mine: Sequence[Entry], column: Column, name: str, first: Entry) -> Cell:
    """A metric of a method over its seeds; of a baseline what the first evaluation says of it."""
    if mine:
        return Cell.of([_number(entry, column) for entry in mine])
    at_log = name == "playback" and column.key in _AT_A_DISTANCE
    known = not at_log and (column.key in METRICS or column.optional)
    return Cell.of([_number(first, column, name)]) if known else ABSENT


def _with_best(
    table: Mapping[tuple[str, str], Mapping[str, Cell]],
) -> dict[tuple[str, str], dict[str, Cell]]:
    """Mark the lowest value of the paper's metrics in each family of two methods or more.

    What looks equal in the table is equally good.
    """
    done = {name: dict(cells) for name, cells in table.items()}
    for column in COLUMNS:
        for group in {family(method) for method, _ in table if method not in BASELINES}:
            rivals = {name: table[name][column.key] for name in table if family(name[0]) == group}
            known = [cell.mean for cell in rivals.values() if not math.isnan(cell.mean)]
            for name, cell in rivals.items():
                best = len(known) > 1 and column.shown(cell.mean) == column.shown(min(known))
                done[name][column.key] = replace(cell, best=best)
    return done


def _check_comparable(entries: Sequence[Entry]) -> None:
    first, defaults = entries[0], EvaluateConfig()
    known: dict[tuple[str, str], Entry] = {}
    for entry in entries:
        both, other = (first, entry), known.setdefault((entry.method, entry.way), entry)
        configs = [each.record["config"] for each in both]
        differing = [
            name
            for name in _TRAFFIC
            if len({config.get(name, getattr(defaults, name)) for config in configs}) > 1
        ]
        # 0 seconds are all of a segment: whether those are as many, only what was found tells.
        if configs[0]["duration"] != configs[1]["duration"]:
            far = [number(each, each.record["constant_velocity"], "ade") for each in both]
            differing += [] if math.isclose(*far, rel_tol=1e-3) else ["duration"]
        ways = [each.record["config"] | {"seed": 0} for each in (other, entry)]
        if first.record["data"].get("checksum") != entry.record["data"].get("checksum"):
            wrong = "evaluated on different run segments"
        elif differing:
            wrong = f"evaluated in other traffic ({', '.join(differing)})"
        elif ways[0] != ways[1]:
            wrong, both = f"seeds of {method_name(entry.method)} evaluated in different ways", (other, entry)
        else:
            continue
        raise ConfigError(f"{wrong}, choose with --evaluation: {both[0]}, {both[1]}")


def _notes(entries: Sequence[Entry], dataset: PaperData | None) -> list[str]:
    record = entries[0].record
    notes = [
        f"{record['segments']} run segments of {record.get('groups', record['segments'])} recordings in "
        f"{record['data']['name']} ({record['data']['checksum'][:12]}); ± standard error over seeds; bold: best of "
        f"the BC methods and of the MGAIL methods"
    ]
    horizons = sorted({round(entry.record["horizon"], 1) for entry in entries if "horizon" in entry.record})
    if any(each != setting_seconds(record) for each in horizons):
        notes.append(f"rollouts last {' or '.join(f'{each:g}' for each in horizons)} s")
    between = [
        f"{method_name(entry.method)} {entry.record['collision_rate']:.2f} %"
        for entry in entries
        if entry.record.get(AT_STATES, entry.record["collision_rate"]) != entry.record["collision_rate"]
    ]
    found = f"; with those between states: {', '.join(dict.fromkeys(between))}" if between else ""
    notes.append(f"collisions are counted at states only, as the paper counts them{found}")
    ways: dict[str, dict[str, None]] = {}
    for entry in entries:
        config = entry.record["config"]
        way = f"{simulation_way(config)}, {config['rollouts']} rollouts"
        ways.setdefault(way, {})[method_name(entry.method)] = None
    notes += [f"simulated {way}: {', '.join(methods)}" for way, methods in ways.items()]
    for method in dict.fromkeys(entry.method for entry in entries):
        mine = [_flat(entry.config) for entry in entries if entry.method == method]
        names = dict.fromkeys(name for config in mine for name in config)
        differing = [name for name in names if len({json.dumps(config.get(name)) for config in mine}) > 1]
        if differing:
            notes.append(f"runs of {method_name(method)} differ in {', '.join(differing)}")
    if dataset is None and (year := _wosac_year(entries)):
        notes.append(f"WOSAC {year}: 32 rollouts of 8 s of all vehicles; higher is better")
    for entry in entries:
        run, now = entry.record["run"], updates_done(entry.folder)
        if run["updates"] and now and run["updates"] != now:
            notes.append(f"{entry.folder} was evaluated after {run['updates']} updates and has {now} now")
        if run.get("named"):
            at = run["checkpoint"]
            notes.append(
                f"{entry.folder} was evaluated at its checkpoint {at}, which it would not choose itself"
            )
    if dataset is not None:
        notes.append(f"paper: Igl et al. 2022, {dataset} dataset, five seeds")
    return notes


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        elif prefix + name not in _FREE:
            flat[prefix + name] = value
    return flat
