"""The shared parts of commands: options, run segments by name, progress, results on the terminal and as JSON."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, dataclass_transform

from tyro.conf import Positional, arg

import symphony
from symphony import errors, files
from symphony.config import EvaluateConfig, checks, evaluation


class Result(str):
    """Marks the option of a file that a command writes once everything is done."""


Paths = Annotated[tuple[Path, ...], checks.Bounds(1), arg(help_behavior_hint="(required)")]
Names = Annotated[tuple[str, ...], arg(metavar="NAME ...")]
Folder = Annotated[Path | None, arg(metavar="DIR")]
ResultFile = Annotated[Path | None, Result(), arg(metavar="FILE")]
_JSON = "File to write all results to as JSON; with -, standard output gets the JSON and nothing else."
Json = Annotated[Path | None, Result(), arg(metavar="FILE", help=_JSON)]
Picture = Annotated[Path, Result(), arg(metavar="FILE", help="Picture to write (.png, .pdf or .svg).")]
Store = Annotated[Positional[Path], arg(metavar="DIR", help="Folder of the store.")]
_SAVED = "Folders of rollouts (`symphony simulate`), such as those of several planners."
SavedFolders = Annotated[Positional[Paths], checks.Bounds(distinct=True), arg(metavar="SIM ...", help=_SAVED)]
Saved = Annotated[Positional[Path], arg(metavar="SIM", help="Folder of rollouts (`symphony simulate`).")]
_SEGMENTS = "Use only these run segments, named by id or by number in the store."
Segments = Annotated[tuple[str, ...], arg(metavar="ID ...", help=_SEGMENTS)]
Ids = Annotated[tuple[str, ...], arg(metavar="ID ...", help="Use only the run segments with these ids.")]
_TRUST = "Run the code that the agent's folder names by import paths; without it such a folder is refused."
TrustCode = Annotated[bool, arg(help=_TRUST)]
Workers = Annotated[checks.Count, arg(help="Number of processes; it changes the speed, not the results.")]
_ENGINE = "Engine that runs the processes: `local`, on this machine, or `ray`, on a Ray cluster."
EngineName = Annotated[evaluation.Engine, arg(help=_ENGINE)]


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
class Command:
    """A command: a frozen dataclass of arguments, whose comments are their help; a call does the work."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)


class SimulationOptions(Command):
    """The options of a simulation: an agent on run segments."""

    #: Folder of a run (see `symphony train`), `pretrained:NAME` (an agent of the package), `playback` (the log
    #: itself), `constant_velocity` or `idm` (the intelligent driver model, along the route of the log).
    agent: Annotated[Positional[str], arg(metavar="RUN")]
    data: Path  # Store of run segments to simulate.
    segments: Segments = ()
    trust_code: TrustCode = False
    config: Annotated[EvaluateConfig, arg(name="")] = field(default_factory=EvaluateConfig)


def check_search(agent: symphony.Agent, config: EvaluateConfig) -> None:
    """Raise a ConfigError for an option that has no effect on the search with which an agent is simulated."""
    kind = agent.plan(config).kind
    if config.logged_goals and agent.goals is None:
        raise errors.ConfigError(f"--logged-goals has no effect: {agent.name} follows none")
    if agent.policy is None and config.search not in {"agent", "none"}:
        raise errors.ConfigError(f"--search has no effect on {agent.name}: there is nothing to search")
    for name in {"tree": (), "backtrack": evaluation.OF_TREES}.get(kind, evaluation.OF_SEARCHES):
        if getattr(config, name) != getattr(EvaluateConfig, name):
            raise errors.ConfigError(f"--{name.replace('_', '-')} has no effect on search '{kind}': see --search")


def segment_indices(store: symphony.SegmentStore, names: Sequence[str]) -> list[int]:
    """Return the places of run segments in a store; each must be named once, by its id or its number."""
    found: dict[int, str] = {}
    for name in names:
        place = store.index_of(int(name) if name not in store.ids and name.isdecimal() else name)
        if place in found:
            raise errors.ConfigError(f"segment {store.ids[place]} is named twice: {found[place]}, {name}")
        found[place] = name
    return list(found)


@contextmanager
def progress(description: str, unit: str = "segments") -> Iterator[Callable[..., None]]:
    """Show a progress bar on standard error; yield a function of the number done, the total, and an optional note."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, TextColumn

    note = TextColumn("{task.fields[note]}")
    with Progress(*Progress.get_default_columns(), note, console=Console(stderr=True)) as bar:
        task = bar.add_task(escape(description), total=None, note="")

        def advance(done: int, total: int | None, note: str = "") -> None:
            bar.update(task, completed=done, total=total, note=f"{done} of {total} {unit} {note}")

        yield advance


def say(text: str) -> None:
    """Print lines on standard output, with what a terminal would act on escaped."""
    print(errors.printable(text, keep="\n"))  # noqa: T201


def tell(text: str) -> None:
    """Print a line on standard error, apart from the results."""
    sys.stderr.write(f"{errors.printable(text)}\n")


def write_numbers(path: Path | None, numbers: Any) -> bool:
    """Write numbers as JSON to a file, or to standard output for -; return whether a text may still be printed."""
    if str(path) == "-":
        sys.stdout.write(files.json_text(numbers))
    elif path is not None:
        files.write_json(path, numbers)
    return str(path) != "-"


def write_text(path: Path | None, text: str) -> None:
    """Write a text to a file, or to standard output where none is given."""
    if path is None:
        sys.stdout.write(text)
    else:
        files.write_file(path, text)


def print_table(rows: Sequence[Sequence[str]], title: str = "", *, heads: int = 0) -> None:
    """Print rows of cells in columns, the first one flush left, with a rule below those that are headings."""
    shown = [[errors.printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
    forms = [f"{{:{'>' if k else '<'}{width}}}" for k, width in enumerate(widths)]
    lines = ["  ".join(map(str.format, forms, row)) for row in shown]
    lines[heads:heads] = ["-" * max(map(len, lines))] * bool(heads)
    say("\n".join([title] * bool(title) + lines))


def print_facts(found: Mapping[str, Any], title: str = "") -> None:
    """Print a record as rows of a name and a value."""
    rows = list(_rows(found))
    width = max((len(name) for name, _ in rows), default=0)
    say("\n".join([title] * bool(title) + [f"{name:<{width}}  {value}".rstrip() for name, value in rows]))


def _rows(found: Mapping[str, Any], indent: str = "") -> Iterator[tuple[str, str]]:
    for key, value in found.items():
        name = indent + errors.printable(str(key).replace("_", " "))
        if isinstance(value, Mapping) and {"mean", "max"} <= value.keys():
            yield name, ", ".join(f"{part} {_number(number)}" for part, number in value.items())
        elif isinstance(value, Mapping) and value:
            yield name, ""
            yield from _rows(value, f"{indent}  ")
        else:
            values = value if isinstance(value, list | tuple) else [value]
            yield name, "none" if value in ({}, [], ()) else ", ".join(map(_number, values))


def _number(value: Any) -> str:
    if isinstance(value, float):
        return "–" if math.isnan(value) else f"{value:.4g}"
    return "–" if value is None else errors.printable(str(value))


COLUMNS = (
    ("collision_rate", "collision\n%", 1), ("offroad_time", "off-road\n%", 1), ("ade", "ADE\nm", 2),
    ("min_sade", "minSADE\nm", 2), ("curvature_jsd", "JSD\nnats", 3),
)  # fmt: skip
"""Numbers in the table of agents, with the two lines of their headings, and digits."""


def print_metrics(rows: Sequence[dict[str, Any]], title: str = "", *, details: bool = False) -> None:
    """Print records of agents as one table and a line that says what they are of; with details, all their numbers."""
    heads = ["agent\n", *(heading for _, heading, _ in COLUMNS)]
    table = [[heading.split("\n")[k] for heading in heads] for k in range(2)]
    named = [{**row, "agent": short_name(str(row["agent"]))} for row in rows]
    for row in named:
        numbers = ((row[n], row.get(f"{n}_se"), digits, row.get(f"{n}_bound")) for n, _, digits in COLUMNS)
        table.append([row["agent"], *(number_cell(*number) for number in numbers)])
    print_table(table, title, heads=2)
    for row in named:
        for name in (name for name in row if ":" in name and not name.endswith("_se")):  # the user's own
            say(f"{row['agent']}: {name} {number_cell(row[name], row.get(f'{name}_se'), 4)}")
        if details:
            print_facts({name: value for name, value in row.items() if name != "agent"}, row["agent"])
    first, most = rows[0], max(row["rollouts"] for row in rows)
    driven = "all vehicles" if first["interactive"] == "all" else f"{first['interactive']} interactive agents"
    if first["interactive"] not in ("all", 1, 2):  # a segment with fewer has all of them
        driven = f"up to {driven}"
    text = f"{first['segments']} run segments of {first['groups']} recordings, {driven} each, up to {most} rollouts"
    say(f"{text}; ± standard error over recordings, ≤ exact bound of a zero (95 %); seed {first['seed']}")


def short_name(agent: str) -> str:
    """Return an agent's name as tables show it, or that of a planner among agents: the folders' names alone."""
    return " among ".join(part.rpartition("/")[2] or part for part in agent.split(" among "))


def number_cell(value: float | None, error: float | None, digits: int, bound: float | None = None) -> str:
    """Return a number with its standard error, or zero with a known bound; a dash if there is no number."""
    if value is None or math.isnan(value):
        return "–"
    text = f"{value:.{digits}f}"
    if bound is not None and not math.isnan(bound):
        return f"{text} (≤ {bound:.{digits}f})"
    return text if error is None or math.isnan(error) else f"{text} ± {error:.{digits}f}"
