"""A table of WOSAC scores from the records that `symphony wosac evaluate` wrote."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from symphony.errors import ConfigError, DataError


class Column(NamedTuple):
    """A number as it is shown: times ``scale``, with ``digits`` after the point."""

    key: str
    title: str
    digits: int = 3
    scale: float = 1.0


COLUMNS = (
    Column("metametric", "metametric"),
    Column("kinematic_metrics", "kinematic"),
    Column("interactive_metrics", "interactive"),
    Column("map_based_metrics", "map"),
    Column("simulated_collision_rate", "collide %", 1, 100.0),
    Column("simulated_offroad_rate", "off-road %", 1, 100.0),
    Column("min_ade", "minADE m", 2),
)
HORIZON = 8.0  # seconds that the challenge has simulated; a record with others says so
_WORDS = {
    "playback": "log playback",
    "constant_velocity": "constant velocity",
    "idm": "intelligent driver model",
    "random": "random",
}


def read_wosac(file: Path) -> dict[str, Any]:
    """A record of `symphony wosac evaluate`. Raises a :class:`DataError` where it is none; names the file."""
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        record["agents"][record["agent"]]["segments"], record["how"], record["data"]["checksum"]
    except (ValueError, TypeError, LookupError) as error:
        text = f"not a record of symphony wosac evaluate ({type(error).__name__}: {error})"
        raise DataError(text, file=file) from error
    return dict(record)


def wosac_table(records: Sequence[dict[str, Any]], names: Sequence[str] = ()) -> str:
    """A table in Markdown: the baselines of the first record that has them, a line for the agent of each record, by
    its name or what the record calls it and how it was simulated, and what the table is of. Raises a
    :class:`ConfigError` for different run segments, years or horizons, or too few names.
    """
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
    lines = [["", *(column.title for column in COLUMNS), "order kept %"], ["---"] * (len(COLUMNS) + 2)]
    for name, numbers in rows:
        kept = numbers["order"]["kept"]
        cells = [_cell(numbers, column) for column in COLUMNS]
        lines.append([name, *cells, "–" if kept is None else f"{100 * kept:.0f}"])
    table = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return f"{table}\n{_note(first)}.\n"


def how_in_words(how: dict[str, Any]) -> str:
    """How rollouts came about, such as ``32 trees of 4, systematic every 2, sampled goals``."""
    way = {
        "tree": "32 trees of {branches}, {rule} every {prune_every}",
        "best": "the best of {branches}",
        "backtrack": "back where bad, every {prune_every}",
    }.get(how["search"], "no search")
    goals = {True: ", logged goals", False: ", sampled goals", None: ""}[how.get("logged_goals")]
    return way.format(**how) + (f", by {how['score']}" if "score" in how else "") + goals


def _note(record: dict[str, Any]) -> str:
    numbers = record["agents"][record["agent"]]
    horizon = record["how"].get("horizon", HORIZON)
    short = "" if horizon == HORIZON else f" over {horizon:g} s (the challenge has {HORIZON:g})"
    objects = f" with {record['objects']} scored objects" if "objects" in record else ""
    rates = f" at {', '.join(f'{rate:g}' for rate in record['hertz'])} Hz" if "hertz" in record else ""
    return (
        f"WOSAC {record['config']}{short}: {len(numbers['segments'])} run segments of {record['recordings']} "
        f"recordings{objects} in {record['data']['name']} ({record['data']['checksum'][:12]}){rates}, 32 rollouts "
        f"each; ± standard error over recordings; order of {numbers['order']['pairs']} pairs that merge or cross in "
        "the log"
    )


def _what(record: dict[str, Any]) -> tuple[Any, ...]:
    segments = list(record["agents"][record["agent"]]["segments"])
    return record["config"], record["data"]["checksum"], segments, record["how"].get("horizon", HORIZON)


def _cell(numbers: dict[str, Any], column: Column) -> str:
    mean, error = numbers[column.key], numbers[f"{column.key}_se"]
    text = f"{mean * column.scale:.{column.digits}f}"
    return text if error is None else f"{text} ± {error * column.scale:.{column.digits}f}"
