"""A table of WOSAC scores from the records that `symphony wosac evaluate` wrote."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symphony.errors import ConfigError, DataError

Grid = list[list[str]]


@dataclass(frozen=True)
class WosacColumn:
    """A number as it is shown: times ``scale``, with ``digits`` after the point."""

    key: str
    title: str
    digits: int = 3
    scale: float = 1.0


COLUMNS = (
    WosacColumn("metametric", "metametric"),
    WosacColumn("kinematic_metrics", "kinematic"),
    WosacColumn("interactive_metrics", "interactive"),
    WosacColumn("map_based_metrics", "map"),
    WosacColumn("simulated_collision_rate", "collide %", 1, 100.0),
    WosacColumn("simulated_offroad_rate", "off-road %", 1, 100.0),
    WosacColumn("min_ade", "minADE m", 2),
)
HORIZON = 8.0
"""Seconds that the challenge has simulated; a record with others says so."""
_WORDS = {
    "playback": "log playback",
    "playback_thinned": "log playback at the agent's rate",
    "constant_velocity": "constant velocity",
    "random": "random",
}


def read_wosac(file: Path) -> dict[str, Any]:
    """A record of `symphony wosac evaluate`.

    Raises:
        DataError: it is none; names file and field.
    """
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"not valid JSON ({error})", file=file) from error
    for name, kind in (("config", str), ("agent", str), ("how", dict), ("data", dict), ("agents", dict)):
        if not isinstance(record, dict) or not isinstance(record.get(name), kind):
            raise DataError("is missing; is this a record of symphony wosac evaluate?", file=file, field=name)
    if record["agent"] not in record["agents"]:
        raise DataError(f"without the agent {record['agent']}", file=file, field="agents")
    _demand(record, ("recordings", "how.search", "data.name", "data.checksum"), file)
    numbers = [name for column in COLUMNS for name in (column.key, f"{column.key}_se")]
    for name, held in record["agents"].items():
        _demand(held, ("segments", "order.kept", "order.pairs", *numbers), file, f"agents.{name}.")
    return record


def _demand(held: Any, names: Sequence[str], file: Path, where: str = "") -> None:
    for name in names:
        part, _, inner = name.partition(".")
        found = isinstance(held, dict) and part in held
        if not found or (inner and (not isinstance(held[part], dict) or inner not in held[part])):
            raise DataError("is missing", file=file, field=f"{where}{name}")


def wosac_grid(records: Sequence[dict[str, Any]], names: Sequence[str] = ()) -> Grid:
    """A heading, the baselines of the first record that has them, and a line for the agent of each record.

    Args:
        records: see :func:`read_wosac`.
        names: of the agents; by default what the records call them, and how they were simulated.

    Returns:
        Cells of text; ± standard error over recordings.

    Raises:
        ConfigError: of different run segments, years or horizons, or not a name for each.
    """
    if not records:
        raise ConfigError("no records")
    if names and len(names) != len(records):
        raise ConfigError(f"{len(names)} names for {len(records)} records")
    first = records[0]
    for record in records:
        if _what(record) != _what(first):
            raise ConfigError(
                f"records of different run segments, years or horizons: {first['agent']}, {record['agent']}; "
                "a table is of the same ones"
            )
    order: dict[str, Any] = next((one["agents"] for one in records if len(one["agents"]) > 1), {})
    rows = [(_WORDS[name], numbers) for name, numbers in order.items() if name in _WORDS]
    for k, record in enumerate(records):
        name = names[k] if names else f"{record['agent']}, {how_in_words(record['how'])}"
        rows.append((name, record["agents"][record["agent"]]))
    grid = [["", *(column.title for column in COLUMNS), "order kept %"]]
    for name, numbers in rows:
        kept = numbers["order"]["kept"]
        cells = [_cell(numbers, column) for column in COLUMNS]
        grid.append([name, *cells, "–" if kept is None else f"{100 * kept:.0f}"])
    return grid


def how_in_words(how: dict[str, Any]) -> str:
    """How rollouts came about, such as ``32 trees of 4, systematic every 2, sampled goals``."""
    goals = {True: ", logged goals", False: ", sampled goals", None: ""}[how.get("logged_goals")]
    if how["search"] == "tree":
        way = f"32 trees of {how['branches']}, {how['rule']} every {how['prune_every']}"
    elif how["search"] == "best":
        way = f"the best of {how['branches']}"
    elif how["search"] == "backtrack":
        way = f"back where bad, every {how['prune_every']}"
    else:
        way = "no search"
    return way + (f", by {how['score']}" if "score" in how else "") + goals


def grid_note(records: Sequence[dict[str, Any]]) -> str:
    """What the table is of."""
    record = records[0]
    count = len(record["agents"][record["agent"]]["segments"])
    pairs = record["agents"][record["agent"]]["order"]["pairs"]
    horizon = record["how"].get("horizon", HORIZON)
    short = "" if horizon == HORIZON else f" over {horizon:g} s (the challenge has {HORIZON:g})"
    return (
        f"WOSAC {record['config']}{short}: {count} run segments of {record['recordings']} recordings in "
        f"{record['data']['name']} ({record['data']['checksum'][:12]}), 32 rollouts each; ± standard error over "
        f"recordings; order of {pairs} pairs that merge or cross in the log"
    )


def _what(record: dict[str, Any]) -> tuple[Any, ...]:
    segments = list(record["agents"][record["agent"]]["segments"])
    return record["config"], record["data"].get("checksum"), segments, record["how"].get("horizon", HORIZON)


def _cell(numbers: dict[str, Any], column: WosacColumn) -> str:
    mean, error = numbers[column.key], numbers[f"{column.key}_se"]
    if mean is None or math.isnan(mean):
        return "–"
    text = f"{mean * column.scale:.{column.digits}f}"
    return text if error is None else f"{text} ± {error * column.scale:.{column.digits}f}"


def markdown_table(grid: Grid) -> str:
    """A grid in Markdown, its first line the heading."""
    lines = [f"| {' | '.join(line)} |" for line in grid]
    return "\n".join([lines[0], "| --- " * len(grid[0]) + "|", *lines[1:]]) + "\n"
