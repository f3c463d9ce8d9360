"""A table of WOSAC scores."""

from __future__ import annotations

from typing import Any, NamedTuple


class Column(NamedTuple):
    """A number as shown: times ``scale``, with ``digits`` after the point."""

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


def wosac_table(record: dict[str, Any]) -> str:
    """Return a table in Markdown: the baselines of a record that has them, its agent, and what the table is of."""
    name, found = record["agent"], record["agents"]
    rows = [(_WORDS[other], numbers) for other, numbers in found.items() if other in _WORDS and other != name]
    rows.append((f"{name}, {how_in_words(record['how'])}", found[name]))
    lines = [["", *(column.title for column in COLUMNS)], ["---"] * (len(COLUMNS) + 1)]
    lines += [[row, *(_cell(numbers, column) for column in COLUMNS)] for row, numbers in rows]
    table = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return f"{table}\n{_note(record)}.\n"


def how_in_words(how: dict[str, Any]) -> str:
    """Return how rollouts were made, such as ``32 trees of 4, systematic every 2, sampled goals, pace 0.25``."""
    way = {
        "tree": "32 trees of {branches}, {rule} every {prune_every}",
        "backtrack": "back where bad, every {prune_every}",
    }.get(how["search"], "no search")
    goals = {True: ", logged goals", False: ", sampled goals", None: ""}[how.get("logged_goals")]
    pace = f", pace {how['pace']:g}" if "pace" in how else ""
    return way.format(**how) + (f", by {how['score']}" if "score" in how else "") + goals + pace


def _note(record: dict[str, Any]) -> str:
    numbers = record["agents"][record["agent"]]
    horizon = record["how"].get("horizon", HORIZON)
    short = "" if horizon == HORIZON else f" over {horizon:g} s (the challenge has {HORIZON:g})"
    objects = f" with {record['objects']} scored objects" if "objects" in record else ""
    rates = f" at {', '.join(f'{rate:g}' for rate in record['hertz'])} Hz" if "hertz" in record else ""
    return (
        f"WOSAC {record['config']}{short}: {len(numbers['segments'])} run segments of {record['recordings']} "
        f"recordings{objects} in {record['data']['name']} ({record['data']['checksum'][:12]}){rates}, 32 rollouts "
        "each; ± standard error over recordings"
    )


def _cell(numbers: dict[str, Any], column: Column) -> str:
    mean, error = numbers[column.key], numbers[f"{column.key}_se"]
    text = f"{mean * column.scale:.{column.digits}f}"
    return text if error is None else f"{text} ± {error * column.scale:.{column.digits}f}"
