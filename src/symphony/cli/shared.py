"""What commands share: help texts, run segments by name, progress, results on the terminal and as JSON."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from symphony.errors import ConfigError, printable
from symphony.files import json_text, write_json

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from symphony.data.store import SegmentStore
    from symphony.evaluation import Evaluation

TrustCode = Annotated[
    bool,
    tyro.conf.arg(
        help="Run the code that the agent's folder names by import paths; without it such a folder is refused."
    ),
]
ResultFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
"""A file that a command writes once everything is done (see `results_of` of the command line)."""
Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...")]

PARAGRAPHS = ConstructorRegistry()
"""For `tyro.cli`, which by itself keeps the line breaks of an attribute's docstring where its lines are indented."""
_under_way: list[object] = []


@PARAGRAPHS.struct_rule
def _joined(info: StructTypeInfo) -> StructConstructorSpec | None:
    """What tyro makes of a dataclass, with the lines of every paragraph of its help texts joined."""
    if any(info is one for one in _under_way):
        return None
    _under_way.append(info)
    try:
        found = ConstructorRegistry.get_struct_spec(info)
    finally:
        _under_way.pop()
    if not isinstance(found, StructConstructorSpec):
        return None
    fields = [replace(field, helptext=_paragraphs(field.helptext)) for field in found.fields]
    return replace(found, fields=tuple(fields))


def _paragraphs(told: str | Callable[[], str | None] | None) -> Callable[[], str | None]:
    """What gives the text: docstrings are read only when help is asked for."""

    def text() -> str | None:
        found = told() if callable(told) else told
        return found and re.sub(r"(?<!\n)\n(?!\s*\n) *", " ", found)

    return text


def at_least(least: int, **options: int) -> None:
    """Raise ConfigError for an option that is less."""
    for name, value in options.items():
        if value < least:
            bound = f"be at least {least}" if least else "not be negative"
            raise ConfigError(f"--{name.replace('_', '-')} must {bound}, is {value}")


def segment_index(store: SegmentStore, name: str) -> int:
    """The place in a store of a run segment that is named by its id or its number.

    Raises:
        DataError: there is no such segment.
    """
    return store.index_of(int(name) if name not in store.ids and name.isdecimal() else name)


def segment_indices(store: SegmentStore, names: Sequence[str]) -> list[int]:
    """The places in a store of some run segments, each named once.

    Raises:
        ConfigError: one is named twice, by its id or its number.
        DataError: there is no such segment.
    """
    found: dict[int, str] = {}
    for name in names:
        place = segment_index(store, name)
        if place in found:
            raise ConfigError(f"segment {store.ids[place]} is named twice: {found[place]}, {name}")
        found[place] = name
    return list(found)


@contextmanager
def progress(description: str, unit: str = "segments") -> Iterator[Callable[..., None]]:
    """A progress bar on standard error, as long as the work takes.

    Gives a function of how much is done, the total, and (if there is more to tell) a note.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(escape(description)), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
    note, left = TextColumn("{task.fields[note]}"), TimeRemainingColumn()
    with Progress(*columns, note, left, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=None, note="")
        yield lambda done, total, note="": bar.update(task, completed=done, total=total, note=note)


def say(text: str) -> None:
    """Print lines as they are, neither wrapped nor coloured."""
    print(printable(text, keep="\n"))  # noqa: T201


def warn(text: str) -> None:
    """Print a warning on standard error."""
    sys.stderr.write(f"symphony: warning: {printable(text)}\n")


def write_numbers(path: Path | None, numbers: Any) -> None:
    """Write numbers as JSON to a file, or to standard output where the file is called -; without a file nowhere."""
    if str(path) == "-":
        sys.stdout.write(json_text(numbers))
    elif path is not None:
        write_json(path, numbers)


COLUMNS = (
    ("collision_rate", "collision\n%", 1),
    ("offroad_time", "off-road\n%", 1),
    ("ade", "ADE\nm", 2),
    ("min_sade", "minSADE\nm", 2),
    ("curvature_jsd", "JSD\nnats", 3),
)


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


def print_facts(found: Mapping[str, Any], title: str = "", *, aside: bool = False) -> None:
    """Print a record as rows of a name and a value, to standard error if ``aside``."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(show_header=False, box=None, pad_edge=False, title=escape(printable(title)) or None)
    for name, value in _rows(found):
        table.add_row(escape(printable(name)), escape(printable(value)))
    print_table(table, Console(stderr=aside, highlight=False))


def _rows(found: Mapping[str, Any], indent: str = "") -> Iterator[tuple[str, str]]:
    for key, value in found.items():
        name = indent + str(key).replace("_", " ")
        if isinstance(value, Mapping) and {"mean", "max"} <= value.keys():
            yield name, ", ".join(f"{part} {_number(number)}" for part, number in value.items())
        elif isinstance(value, Mapping) and value:
            yield name, ""
            yield from _rows(value, f"{indent}  ")
        elif isinstance(value, list | tuple):
            yield name, ", ".join(map(_number, value)) or "none"
        else:
            yield name, "none" if value == {} else _number(value)


def _number(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def print_metrics(
    rows: Sequence[dict[str, Any]], title: str = "", *, aside: bool = False, details: bool = False
) -> None:
    """Print results of agents as one table and a line of what they are of.

    Args:
        rows: a record for each agent.
        title: of the table.
        aside: print to standard error.
        details: also print every number of each agent.
    """
    from rich.console import Console

    console = Console(stderr=aside, highlight=False)
    # Narrow enough for 80 columns, so the divergence goes without its error.
    shown = [{**row, "curvature_jsd_se": None, "agent": short_name(str(row["agent"]))} for row in rows]
    print_table(metrics_table(shown, title), console)
    for row in shown:
        for name in (name for name in row if ":" in name and not name.endswith("_se")):  # the user's own
            line = f"{row['agent']}: {name} {number_cell(row[name], row.get(f'{name}_se'), 4)}"
            console.print(line, style="dim", markup=False)
    if details:
        for row in rows:
            print_facts(
                {name: value for name, value in row.items() if name != "agent"}, row["agent"], aside=aside
            )
    first, most = rows[0], max(row["rollouts"] for row in rows)
    driven = "all vehicles" if first["interactive"] == "all" else f"{first['interactive']} interactive agents"
    if first["interactive"] not in ("all", 1, 2):  # a segment with fewer has those that there are
        driven = f"up to {driven}"
    console.print(
        f"{first['segments']} run segments of {first['groups']} recordings, {driven} each, up to {most} rollouts; "
        f"± standard error over recordings, ≤ exact bound of a zero (95 %); seed {first['seed']}",
        style="dim",
        soft_wrap=True,
    )


def print_evaluation(found: Evaluation, data: Path, *, aside: bool = False, details: bool = False) -> None:
    """Print the baselines and the agent of an evaluation as :func:`print_metrics` does."""
    others = [baseline.numbers() for baseline in found.baselines if baseline.agent != found.agent]
    print_metrics([*others, found.numbers()], str(data), aside=aside, details=details)


def metrics_table(rows: Sequence[Mapping[str, Any]], title: str = "", first: str = "agent") -> Table:
    """The table of some agents' records, each with its name as `agent`; the first column has the heading `first`."""
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title) or None, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column(escape(first), no_wrap=True)
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        cells = [
            number_cell(row[name], row.get(f"{name}_se"), digits, row.get(f"{name}_bound"))
            for name, _, digits in COLUMNS
        ]
        table.add_row(escape(row["agent"]), *cells)
    return table


def short_name(agent: str) -> str:
    """An agent's name as tables show it: that of its folder."""
    return agent.rpartition("/")[2] or agent


def number_cell(value: float | None, error: float | None, digits: int, bound: float | None = None) -> str:
    """A number with its standard error, or zero with a bound that is known; a dash for none."""
    if value is None or math.isnan(value):
        return "–"
    text = f"{value:.{digits}f}"
    if bound is not None and not math.isnan(bound):
        return f"{text} (≤ {bound:.{digits}f})"
    return text if error is None or math.isnan(error) else f"{text} ± {error:.{digits}f}"
