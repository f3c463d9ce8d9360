"""Tables of results on the terminal."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symphony.files import json_text, write_json

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

COLUMNS = (
    ("collision_rate", "collision\n%", 1),
    ("offroad_time", "off-road\n%", 1),
    ("ade", "ADE\nm", 2),
    ("min_sade", "minSADE\nm", 2),
    ("curvature_jsd", "JSD\nnats", 3),
)

KINDS = (
    ("into_leader", "into a leader"),
    ("rear_ended", "rear-ended"),
    ("crossing", "crossing"),
    ("oncoming", "oncoming"),
    ("sideswipe", "sideswipe"),
    ("pedestrian", "into a pedestrian"),
    ("cyclist", "into a cyclist"),
    ("other", "other"),
)
"""Kinds of first collision (see :class:`symphony.metrics.CollisionKind`) and their words."""


def print_table(table: Table, console: Console) -> None:
    """Print a table as wide as what is in it: a name is neither cut nor broken, however narrow the terminal."""
    from rich.measure import Measurement

    if table.title:
        # Beside the table, or it would be broken to its width.
        console.print(table.title, style=table.title_style or "italic", soft_wrap=True)
        table.title = None
    if not table.row_count:
        return  # nothing has no width
    options = console.options.update(max_width=sys.maxsize)
    before, needed = console.width, Measurement.get(console, options, table).maximum
    console.width = max(before, needed)
    try:
        console.print(table, crop=False)
    finally:
        console.width = before


def print_metrics(
    rows: Sequence[dict[str, Any]], title: str = "", *, aside: bool = False, details: bool = False
) -> None:
    """Print results of agents as one table and a line of what they are of.

    Args:
        rows: a record for each agent.
        title: of the table.
        aside: print to stderr.
        details: also tell kinds of collision, what the divergence owes to sampling, goals, and single agents.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    # Narrow enough for 80 columns, so the divergence goes without its error.
    table = Table(
        title=escape(title) or None,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("agent", no_wrap=True)
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        errors = {name: row.get(f"{name}_se") for name, _, _ in COLUMNS if name != "curvature_jsd"}
        cells = [
            number_cell(row[name], errors.get(name), digits, row.get(f"{name}_bound"))
            for name, _, digits in COLUMNS
        ]
        table.add_row(escape(short_name(str(row["agent"]))), *cells)
    console = Console(stderr=aside)
    print_table(table, console)
    first = rows[0]
    for row in rows:
        if details and row["collision_rate"] > 0 and "collision_into_leader" in row:
            kinds = ((row[name], text) for name, text in _kinds_of(row))
            parts = ", ".join(f"{value:.1f} {text}" for value, text in kinds if value > 0)
            console.print(
                f"{escape(short_name(str(row['agent'])))}: collisions, % of rollouts: {parts}", style="dim"
            )
        for line in [*_own_metrics(row), *(_more(row) if details else [])]:
            console.print(f"{escape(short_name(str(row['agent'])))}: {line}", style="dim")
    for row in rows:
        if details and first["interactive"] not in (1, 2) and row.get("agent_collision_rate", math.nan) > 0:
            console.print(
                f"{escape(short_name(str(row['agent'])))}: {_agents_of(row)}", style="dim", highlight=False
            )
    most = max(row["rollouts"] for row in rows)
    driven = "all vehicles" if first["interactive"] == "all" else f"{first['interactive']} interactive agents"
    if first["interactive"] not in ("all", 1, 2):  # a segment with fewer has those that there are
        driven = f"up to {driven}"
    console.print(
        f"{first['segments']} run segments of {first['groups']} recordings, {driven} each, up to {most} rollouts; "
        f"± standard error over recordings, ≤ exact bound of a zero (95 %); seed {first['seed']}",
        style="dim",
        soft_wrap=True,
    )


def write_numbers(path: Path, numbers: Any) -> None:
    """Write numbers as JSON to a file, or to standard output where the file is called -."""
    if str(path) == "-":
        sys.stdout.write(json_text(numbers))
    else:
        write_json(path, numbers)


def _own_metrics(row: dict[str, Any]) -> list[str]:
    """Metrics of the user's own, in lines."""
    own = (name for name in row if ":" in name and not name.endswith("_se"))
    return [f"{name} {number_cell(row[name], row.get(f'{name}_se'), 4)}" for name in own]


def _more(row: dict[str, Any]) -> list[str]:
    """What else there is to say of an agent, in lines."""
    lines, at_states = [], row.get("collision_rate_at_states", math.nan)
    if not math.isnan(at_states) and at_states != row["collision_rate"]:
        lines.append(
            f"collisions between states count; at states only, as the paper and WOSAC count: {at_states:.1f} %"
        )
    bounded = row.get("offroad_segments", row.get("segments"))
    if bounded != row.get("segments"):
        lines.append(
            f"off-road time is of {bounded} of {row['segments']} segments: other maps have no boundary"
        )
    if row.get("search") == "log":
        return lines
    if not math.isnan(row.get("curvature_jsd_floor", math.nan)):
        corrected = number_cell(row["curvature_jsd_corrected"], row["curvature_jsd_se"], 4)
        lines.append(
            f"JSD {row['curvature_jsd']:.4f}, corrected for sampling {corrected}; "
            f"the log's finite size alone gives {row['curvature_jsd_floor']:.4f}"
        )
    if not math.isnan(row.get("standing", math.nan)):
        lines.append(f"{row['standing']:.1f} % stand at the end, {row['standing_log']:.1f} % in the log")
    if "goals_founders" in row:
        turns = ("left", "straight", "right")
        each = (
            " / ".join(f"{row[f'goals_{kind}_{turn}']:.0f}" for turn in turns) for kind in ("drawn", "kept")
        )
        lines.append(
            f"goals {' / '.join(turns)}, %: drawn {next(each)}, kept {next(each)}; moved by the search: turns "
            f"{row['goals_turn_variation']:.2f}, goals {row['goals_variation']:.2f}; first branches left "
            f"{row['goals_founders']:.1f}"
        )
    return lines


def short_name(agent: str) -> str:
    """An agent's name as tables show it: that of its folder."""
    return agent.rpartition("/")[2] or agent


def _kinds_of(row: dict[str, Any]) -> list[tuple[str, str]]:
    """Names and words of the kinds a row has; older results know no pedestrians and cyclists."""
    return [(f"collision_{kind}", text) for kind, text in KINDS if f"collision_{kind}" in row]


def _agents_of(row: dict[str, Any]) -> str:
    """What becomes of single agents, in words."""
    found = ((row[f"agent_collision_{kind}"], text) for kind, text in KINDS)
    kinds = ", ".join(f"{value:.1f} {text}" for value, text in found if value > 0)
    rate = number_cell(
        row["agent_collision_rate"], row["agent_collision_rate_se"], 1, row.get("agent_collision_rate_bound")
    )
    return (
        f"{rate} % of agents collide while their log exists: {kinds}; they drive {row['agent_progress']:.0f} % of "
        f"the log's way, at speeds {row['agent_speed_distance']:.2f} m/s from the log's"
    )


def number_cell(value: float | None, error: float | None, digits: int, bound: float | None = None) -> str:
    """A number with its standard error, or zero with a bound that is known; a dash for none."""
    if value is None or math.isnan(value):
        return "–"
    text = f"{value:.{digits}f}"
    if bound is not None and not math.isnan(bound):
        return f"{text} (≤ {bound:.{digits}f})"
    return text if error is None or math.isnan(error) else f"{text} ± {error:.{digits}f}"
