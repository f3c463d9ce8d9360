"""The paper's tables from evaluated runs: which evaluations count, means over seeds, the best of each family."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import numpy as np

from symphony.config import Method, PaperData, Setting
from symphony.errors import ConfigError, DataError
from symphony.evaluation import records

BASELINES = {"playback": "Playback", "constant_velocity": "Constant velocity"}  # every table begins with them
ROWS: tuple[str, ...] = (*BASELINES, *get_args(Method))
SETTINGS: dict[Setting, tuple[int, int]] = {"main": (2, 10), "long": (2, 20), "many": (8, 10)}
"""Interactive agents and seconds."""
WHOLE_LOG = 10  # seconds of a run that was trained on the whole of its segments
METRICS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")
"""The paper's metrics; collisions are those at states only, as the paper counts them."""
_TRAFFIC = ("interactive", "others", "open_traffic", "radius")
"""Settings of an evaluation that decide what agents meet: rows of a table share them."""
_PLACES = ("data", "validation.data", "out", "warm_start", "device", "wandb")
_FREE = ("seed", "resume", "checkpoint_every", "log_every", *_PLACES)
"""Settings that may differ between runs of one method: the seed, and where things lie."""


@dataclass(frozen=True)
class Entry:
    """A run, by its folder and configuration, and one of its evaluations, by its name and record."""

    folder: Path
    config: Mapping[str, Any]
    name: str
    record: Mapping[str, Any]

    @property
    def method(self) -> str:
        """The method of the run."""
        return self.config["method"]

    @property
    def way(self) -> str:
        """The way in which the run was simulated."""
        return records.simulation_way(self.record["config"])

    @property
    def seed(self) -> int:
        """The seed of the training."""
        return self.config.get("seed", 0)

    def number(self, key: str, where: Mapping[str, Any] | None = None) -> float:
        """Return a number of the record, or of a part of it; NaN for a mean over nothing.

        Raises a :class:`DataError` where it is not a number.
        """
        where = self.record if where is None else where
        if key == "cost":
            return where[key]["simulation"] / max(1, where["segments"])
        key = "collision_rate_at_states" if key == "collision_rate" else key
        value = where.get(key, "")
        if value is None:  # JSON has no NaN
            return math.nan
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DataError("is not a number", file=str(self), field=key)
        return float(value)

    def baseline(self, name: str, key: str) -> float:
        """Return a number of a baseline; NaN where it has none, as the log has no distance from itself."""
        known = key in self.record[name] and not (name == "playback" and key in DISTANCES)
        return self.number(key, self.record[name]) if known else math.nan

    def __str__(self) -> str:
        return f"{self.folder} ({self.name})"


def method_name(method: str) -> str:
    """Return a method as the paper writes it, such as BC+TS+H."""
    return BASELINES.get(method) or method.upper().replace("_", "+")


def collect(
    folders: Sequence[Path], setting: Setting, patterns: Sequence[str] = ()
) -> tuple[list[Entry], dict[str, list[Path]]]:
    """Return the evaluated runs of a setting, and the runs that are left out by the reason.

    With ``patterns`` (``*`` is anything), only evaluations count whose names match the first pattern that any
    matches. Raises a :class:`ConfigError` for no runs, two runs of one method and seed, or two evaluations of a run
    that were simulated in one way, a :class:`DataError` where a file can't be read.
    """
    entries, runs = dict[tuple[str, str, int], Entry](), dict[tuple[str, int], Path]()
    left_out: dict[str, list[Path]] = {}
    interactive, seconds = SETTINGS[setting]
    for folder in records.find_runs(folders):
        config, kept, names = records.read_run(folder), records.kept_evaluations(folder), list[str]()
        acting, lasting = config.get("agent", {}).get("interactive", 2), config.get("duration", 0)
        if config["method"] not in get_args(Method):
            reason = f"unknown method {config['method']}"
        elif acting != interactive or lasting not in (0, seconds):
            reason = f"trained with {acting} interactive agents for {lasting or WHOLE_LOG:g} s"
        else:
            wanted = {(interactive, duration) for duration in (0, lasting or WHOLE_LOG)}
            how = {n: (one["config"]["interactive"], one["config"]["duration"]) for n, one in kept.items()}
            fits = [n for n, one in kept.items() if how[n] in wanted and setting_seconds(one) == seconds]
            names = records.fitting(fits, patterns)
            reason = "only evaluated in other ways" if kept else "not evaluated by symphony evaluate"
        if not names:
            left_out.setdefault(reason, []).append(folder)
        for name in names:
            entry = Entry(folder, config, name, kept[name])
            if (run := runs.setdefault((entry.method, entry.seed), folder)) != folder:
                two = f"{method_name(entry.method)} with seed {entry.seed}"
                raise ConfigError(f"two runs of {two}: {run}, {folder}")
            other = entries.setdefault((entry.method, entry.way, entry.seed), entry)
            if other is not entry:
                what = f"{method_name(entry.method)} with seed {entry.seed} was simulated twice"
                raise ConfigError(f"{what} as {entry.way}, choose with --evaluation: {other}, {entry}")
    return list(entries.values()), left_out


def setting_seconds(record: Mapping[str, Any]) -> float:
    """Return the seconds of the setting of an evaluation: those asked for, or the nearest to its whole segments."""
    away = {seconds: abs(seconds - record.get("horizon", WHOLE_LOG)) for _, seconds in SETTINGS.values()}
    return record["config"]["duration"] or min(away, key=away.__getitem__)


@dataclass(frozen=True)
class Column:
    """A metric as it is shown: times ``scale``, with ``digits`` after the point."""

    title: str
    unit: str
    digits: int = 2
    scale: float = 1.0

    def shown(self, value: float) -> str:
        """Return the value as text."""
        return f"{value * self.scale:.{self.digits}f}"


COLUMNS = {
    "collision_rate": Column("collision", "%"),
    "offroad_time": Column("off-road", "%"),
    "ade": Column("ADE", "m"),
    "min_sade": Column("minSADE", "m"),
    "curvature_jsd": Column("curvature JSD", "10⁻³", 2, 1000.0),
    "curvature_jsd_floor": Column("JSD floor", "10⁻³", 2, 1000.0),
    "wosac_metametric": Column("WOSAC", "", 3),
    "wosac_kinematic_metrics": Column("kinematic", "", 3),
    "wosac_interactive_metrics": Column("interactive", "", 3),
    "wosac_map_based_metrics": Column("map", "", 3),
    "wosac_min_ade": Column("minADE", "m"),
    "cost": Column("CPU", "s/segment"),
}
"""Columns by their keys in a record; a user's own metrics, by import path, have none."""
WOSAC = tuple(key for key in COLUMNS if key.startswith("wosac"))
"""Columns of evaluations with `--metrics wosac`; the metametric and the three means of its components are 0 to 1."""
DISTANCES = ("ade", "min_sade", "curvature_jsd", "curvature_jsd_floor")
"""Distances from the log, of which the log itself has none."""


def paper_figures(setting: Setting, dataset: PaperData) -> dict[str, dict[str, tuple[float, float]]]:
    """Return the paper's figures (Igl et al., ICRA 2022, tables I and II) by method and metric; empty if it has none.
    Each is a mean and its standard error, NaN where there is none; ``paper.csv`` has thousandths of a nat.
    """
    found = {}
    for line in files("symphony.evaluation").joinpath("paper.csv").read_text().splitlines():
        *of, method = (words := line.split(","))[:3]
        if of == [setting, dataset]:
            values = [float(word or "nan") for word in words[3:]]
            values[-2:] = [value / 1000 for value in values[-2:]]
            found[method] = dict(zip(METRICS, zip(values[::2], values[1::2], strict=True), strict=True))
    return found


def compare(entries: Sequence[Entry], setting: Setting, dataset: PaperData | None = None) -> dict[str, Any]:
    """Return the table of some evaluated runs of a setting; their order does not matter.

    There is one run of a method with a seed for each way to simulate. With a dataset, the paper's figures on it stand
    beside ours, and nothing that the paper does not have.

    As JSON can hold it: ``columns``, the metrics; ``rows`` in the paper's order, each with a cell for each metric
    (``mean``, ``se`` over seeds, ``values``), the paper's cells in ``paper``, and ``way`` where its method has a row
    for each way to simulate; ``notes``. Raises a
    :class:`ConfigError` for no runs, runs evaluated on different segments or in other traffic, seeds of a method
    evaluated in different ways, or figures that the paper does not have, a :class:`DataError` where an evaluation
    lacks a number that is needed.
    """
    figures = paper_figures(setting, dataset) if dataset else {}
    if not entries or (dataset is not None and not figures):
        what = f"the paper has no figures for setting '{setting}' on {dataset}"
        raise ConfigError(what if entries else f"no evaluated runs of setting '{setting}'")
    entries = sorted(entries, key=lambda entry: (ROWS.index(entry.method), entry.way, entry.seed))
    _check_comparable(entries)
    first, keys = entries[0], list(METRICS)
    if not figures:
        own = set.intersection(*(set(entry.record["config"]["metric"]) for entry in entries))
        keys += ["curvature_jsd_floor", *(WOSAC if _wosac_year(entries) else ()), *sorted(own), "cost"]
    found: dict[tuple[str, str], list[Entry]] = {(name, ""): [] for name in BASELINES}
    for entry in entries:
        found.setdefault((entry.method, entry.way), []).append(entry)
    methods = [method for method, _ in found]
    paper = {m: {key: {"mean": a, "se": b} for key, (a, b) in cells.items()} for m, cells in figures.items()}
    rows: list[dict[str, Any]] = []
    for (method, way), mine in found.items():
        row: dict[str, Any] = {"method": method, "way": way if methods.count(method) > 1 else ""}
        row["name"] = f"{method_name(method)} {row['way']}".strip()
        row |= {"seeds": [one.seed for one in mine], "evaluations": [one.name for one in mine]}
        for key in keys:
            row[key] = _cell([one.number(key) for one in mine] or [first.baseline(method, key)])
        rows.append(row | {"paper": paper.get(method, {})})
    about = {"setting": setting, "paper": dataset, "columns": keys, "rows": rows, "notes": _notes(entries, dataset)}
    return about | dict(zip(("interactive", "duration"), SETTINGS[setting], strict=True))


def _cell(values: Sequence[float]) -> dict[str, Any]:
    """Return the mean of some seeds, NaN where one of them is, and its standard error, NaN for a single seed."""
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return {"mean": float(np.mean(values)), "se": error, "values": list(values)}


def _wosac_year(entries: Sequence[Entry]) -> str | None:
    """Return the year of the WOSAC scores, where all evaluations have one."""
    years = {entry.record.get("wosac", {}).get("config") for entry in entries}
    if len(years) > 1 and None not in years:
        raise ConfigError(f"WOSAC scores of {', '.join(sorted(years))}, choose with --evaluation")
    return None if None in years else years.pop()


def _check_comparable(entries: Sequence[Entry]) -> None:
    first, known = entries[0], dict[tuple[str, str], Entry]()
    for entry in entries:
        both, other = (first, entry), known.setdefault((entry.method, entry.way), entry)
        one, two = (each.record["config"] for each in both)
        differing = [name for name in _TRAFFIC if one[name] != two[name]]
        # 0 seconds are all of a segment: whether those are as many, only what was found tells.
        far = [each.number("ade", each.record["constant_velocity"]) for each in both]
        if one["duration"] != two["duration"] and not math.isclose(*far, rel_tol=1e-3):
            differing.append("duration")
        if first.record["data"]["checksum"] != entry.record["data"]["checksum"]:
            wrong = "evaluated on different run segments"
        elif differing:
            wrong = f"evaluated in other traffic ({', '.join(differing)})"
        elif other.record["config"] | {"seed": 0} != two | {"seed": 0}:
            wrong, both = f"seeds of {method_name(entry.method)} evaluated in different ways", (other, entry)
        else:
            continue
        raise ConfigError(f"{wrong}, choose with --evaluation: {both[0]}, {both[1]}")


def _leaves(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run by their names, such as ``search.branches``."""
    parts = ((part, value if isinstance(value, dict) else {"": value}) for part, value in config.items())
    return {f"{part}.{name}".rstrip("."): value for part, values in parts for name, value in values.items()}


def _notes(entries: Sequence[Entry], dataset: PaperData | None) -> list[str]:
    """Return what else must be known to read a table."""
    record = entries[0].record
    where = f"{record['segments']} run segments in {record['data']['name']} ({record['data']['checksum'][:12]})"
    notes = [where, "± standard error over seeds"]
    notes.append("collisions are counted at states only, as the paper counts them")
    horizons = sorted({round(entry.record["horizon"], 1) for entry in entries if "horizon" in entry.record})
    if any(each != setting_seconds(record) for each in horizons):
        notes.append(f"rollouts last {' or '.join(f'{each:g}' for each in horizons)} s")
    ways: dict[str, dict[str, None]] = {}
    for entry in entries:
        way = f"{entry.way}, {entry.record['config']['rollouts']} rollouts"
        ways.setdefault(way, {})[method_name(entry.method)] = None
    notes += [f"simulated {way}: {', '.join(methods)}" for way, methods in ways.items()]
    every = {entry.way for entry in entries}
    for method in dict.fromkeys(entry.method for entry in entries):
        mine = [_leaves(entry.config) for entry in entries if entry.method == method]
        names = dict.fromkeys(name for config in mine for name in config if name not in _FREE)
        differing = [name for name in names if len({json.dumps(config.get(name)) for config in mine}) > 1]
        seeds = {way: sorted(e.seed for e in entries if (e.method, e.way) == (method, way)) for way in every}
        if len(set(map(tuple, filter(None, seeds.values())))) > 1:
            differing.append("the ways that seeds are simulated")
        if differing:
            notes.append(f"runs of {method_name(method)} differ in {', '.join(differing)}")
    for entry in entries:
        run, now = entry.record["run"], records.updates_done(entry.folder)
        if run["updates"] and now and run["updates"] != now:
            notes.append(f"{entry.folder} was evaluated after {run['updates']} updates and has {now} now")
        if run["named"]:
            notes.append(f"{entry.folder} was evaluated at checkpoint {run['checkpoint']}, not its own")
    if dataset is not None:
        notes.append(f"paper: Igl et al. 2022, {dataset} dataset, five seeds")
    elif year := _wosac_year(entries):
        notes.append(f"WOSAC {year}: 32 rollouts of 8 s of all vehicles; higher is better")
    return notes


def markdown(grid: Sequence[Sequence[str]]) -> str:
    """Return lines of cells, the heading first, as a table in Markdown that reads well as it is."""
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    lines = []
    for first, *others in [grid[0], rule, *grid[1:]]:
        cells = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
        lines.append(f"| {' | '.join([first.ljust(widths[0]), *cells])} |\n")
    return "".join(lines)


def table_text(table: Mapping[str, Any]) -> str:
    """Return a table in Markdown, with the paper's figures in columns of their own."""

    def shown(cell: Mapping[str, Any], column: Column) -> str:
        if math.isnan(cell.get("mean", math.nan)):
            return "–"
        error = "" if math.isnan(cell["se"]) else f" ± {column.shown(cell['se'])}"
        return column.shown(cell["mean"]) + error

    paper, grid = table["paper"] is not None, [["method", "seeds"]]
    # Of a metric of a user's own the name in its module.
    columns = {key: COLUMNS.get(key) or Column(key.rpartition(":")[2], "", 3) for key in table["columns"]}
    for column in columns.values():
        grid[0] += [f"{column.title} {column.unit}".strip(), *["paper"] * paper]
    for row in table["rows"]:
        grid.append([row["name"], str(len(row["seeds"]) or "")])
        for key, column in columns.items():
            cells = (row[key], row["paper"].get(key, {}))
            grid[-1] += [shown(cell, column) for cell in cells[: 1 + paper]]
    notes = "".join(f"\\{letter}" if letter in "_*|" else letter for letter in "; ".join(table["notes"]))
    return f"{markdown(grid)}\n{table['interactive']} interactive agents, {table['duration']} s: {notes}.\n"
