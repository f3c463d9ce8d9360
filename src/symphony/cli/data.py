"""Convert or generate run segments into a store, and look into it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from symphony.cli.generate import Generate, Quality
from symphony.cli.hardest import Hardest
from symphony.cli.tables import print_table, write_numbers
from symphony.errors import ConfigError, printable

_WINDOWS = ("window", "stride", "motion")
"""Options of the INTERACTION reader alone."""

app = tyro.extras.SubcommandApp()
app.command(name="generate")(Generate)
app.command(name="quality")(Quality)
app.command(name="hardest")(Hardest)


@app.command(name="convert")
@dataclass(frozen=True)
class Convert:
    """Convert logs into a store of run segments.

    A record that can't be used is skipped, counted and reported. The store appears, or changes, once everything is
    converted; until then the work lies in OUT.partial. A conversion that was interrupted or killed goes on where it
    stopped when the same command is given again.
    """

    format: tyro.conf.Positional[Literal["womd", "commonroad", "argoverse2", "interaction", "scenarionet"]]
    """Format of the logs: Waymo Open Motion Dataset (TFRecord), CommonRoad (XML), Argoverse 2 motion forecasting
    (Parquet, each with its map beside it), INTERACTION (CSV with Lanelet2 maps), ScenarioNet (pickle)."""
    files: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="FILE ...", help_behavior_hint="(required)"),
    ]
    """Files of that format, or folders to search for them."""
    out: Path
    """Folder of the store."""
    rate: float = 5.0
    """Steps per second in the store (the paper's 5)."""
    interactive: int = 2
    """Interactive agents a segment must have at its first step."""
    smooth: float = 0.0
    """Smoothing of the tracks before they are resampled: sigma in seconds, 0 for none."""
    egos: Literal["one", "all"] = "one"
    """CommonRoad and INTERACTION, which name no ego vehicle: make one segment of each scenario or window, with the
    ego that has the most moving vehicles around it, or one for every moving vehicle seen throughout."""
    window: float = 10.0
    """INTERACTION: seconds of the segments that recordings are cut into."""
    stride: float | None = None
    """INTERACTION: seconds between the starts of two such segments; without it, one begins where another ends."""
    motion: Literal["logged", "positions"] = "logged"
    """INTERACTION: take velocities and headings as logged, or from the positions (for files that are refused because
    theirs don't fit)."""
    radius: float | None = None
    """Keep what comes within so many metres of the ego's path, of map and agents: for sources that give whole
    districts, whose maps would exceed the paper's limit (ScenarioNet)."""
    exclude_overlaps: bool = False
    """Leave out segments in whose log a moving vehicle's box overlaps another box."""
    hold_lights: bool = False
    """Give lights the last state that the log knows (before the first: the first) where it knows none, instead of
    `unknown`: for scenes that show their lights at a single step (see docs/formats.md)."""
    strict: bool = False
    """Skip a record of which something odd would be left out (an agent without a size, a state that no car can have,
    a node that the map lacks), instead of reading the rest of it."""
    append: bool = False
    """Add to a store that exists; what it holds already is left as it is."""
    workers: int = 1
    """Processes that convert files; the store does not depend on their number."""
    engine: Literal["local", "ray"] = "local"
    """Where they are: on this machine, or on the Ray cluster at RAY_ADDRESS (else a Ray on this machine), whose
    machines must share the files and the folder of the store."""

    def __post_init__(self) -> None:
        if not self.files:
            raise ConfigError("no files given")
        if not self.rate > 0:
            raise ConfigError(f"--rate must be positive, is {self.rate}")
        if not 0.2 <= self.rate <= 200:
            raise ConfigError(f"--rate must be between 0.2 and 200 steps per second, is {self.rate:g}")
        if self.interactive < 1:
            raise ConfigError(f"--interactive must be at least 1, is {self.interactive}")
        if not self.smooth >= 0:
            raise ConfigError(f"--smooth must not be negative, is {self.smooth}")
        if self.workers < 1:
            raise ConfigError(f"--workers must be at least 1, is {self.workers}")
        if self.radius is not None and not self.radius > 0:
            raise ConfigError(f"--radius must be positive, is {self.radius}")
        if self.egos == "all" and self.format not in {"commonroad", "interaction"}:
            raise ConfigError(
                f"--egos all is for commonroad and interaction; {self.format} names its ego vehicle"
            )
        given = [f.name for f in fields(self) if f.name in _WINDOWS and getattr(self, f.name) != f.default]
        if given and self.format != "interaction":
            raise ConfigError(f"--{given[0]} is for interaction")

    def _options(self) -> dict[str, Any] | None:
        """Arguments of the reader."""
        names = {"commonroad": ("egos",), "interaction": ("egos", *_WINDOWS)}.get(self.format)
        return None if names is None else {name: getattr(self, name) for name in names}

    def run(self) -> None:
        """Convert, showing how far it is, and report."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from symphony.data.convert import Report, convert

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("files"))
        counts = TextColumn("{task.fields[converted]} converted, {task.fields[skipped]} skipped")
        with Progress(*columns, counts, TimeRemainingColumn(), console=Console(stderr=True)) as bar:
            task = bar.add_task("Converting", total=None, converted=0, skipped=0)

            def show(done: int, total: int, so_far: Report) -> None:
                skipped = len(so_far.skipped)
                bar.update(task, completed=done, total=total, converted=so_far.converted, skipped=skipped)

            try:
                report = convert(
                    self.format,
                    self.files,
                    self.out,
                    rate=self.rate,
                    interactive=self.interactive,
                    smooth=self.smooth,
                    append=self.append,
                    workers=self.workers,
                    engine=self.engine,
                    exclude_overlaps=self.exclude_overlaps,
                    radius=self.radius,
                    hold_lights=self.hold_lights,
                    strict=self.strict,
                    reader_options=self._options(),
                    progress=show,
                )
            except KeyboardInterrupt:
                bar.console.print("What is done is kept: the same command goes on with it.", highlight=False)
                raise
        _print_report(report, self.out)


@app.command(name="merge")
@dataclass(frozen=True)
class Merge:
    """Copy the run segments of several stores into a new one, to learn from all of them."""

    stores: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="DIR ...", help_behavior_hint="(required)"),
    ]
    """Folders of the stores; they must have the same time step and no segment in common."""
    out: Path
    """Folder of the new store."""

    def __post_init__(self) -> None:
        if not self.stores:
            raise ConfigError("no stores given")

    def run(self) -> None:
        """Copy, showing how far it is, and print what there is."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        from symphony.data.convert import info
        from symphony.data.merge import merge

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task("Copying", total=None)
            merge(self.stores, self.out, lambda done, total: bar.update(task, completed=done, total=total))
        _print_info(info(self.out))


@app.command(name="info")
@dataclass(frozen=True)
class Info:
    """Say what a store of run segments holds."""

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder of the store."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write everything to, the skipped records included; - for standard output, and nothing else."""
    interactive: int = 2
    """Choose that many interactive agents in each segment and count why the ego's partner was chosen; 0 for not
    doing so."""
    per_segment: bool = False
    """In the JSON, say for each segment which agents were chosen, and why."""
    routes: bool = False
    """Count the routes of the interactive agents, too: whether they can be driven, where they end, and whether the
    log follows one. This takes about 20 ms for each segment."""

    def __post_init__(self) -> None:
        if self.interactive < 0:
            raise ConfigError(f"--interactive must not be negative, is {self.interactive}")
        if self.per_segment and not (self.json and self.interactive):
            raise ConfigError("--per-segment goes with --json and interactive agents")
        if self.routes and not self.interactive:
            raise ConfigError("--routes goes with interactive agents")

    def run(self) -> None:
        """Print it."""
        from symphony.data.convert import info
        from symphony.data.selection import choices
        from symphony.data.store import SegmentStore

        found = info(self.store)
        if self.interactive:
            found["interactive"] = choices(SegmentStore(self.store), self.interactive)
            if not self.per_segment:
                del found["interactive"]["segments"]
        if self.routes:
            found["routes"] = _counted_routes(self.store, self.interactive) | {
                "joined_gaps": found["joined_gaps"]
            }
        if self.json is not None:
            write_numbers(self.json, found)
        if str(self.json) != "-":
            _print_info(found)


@app.command(name="verify")
@dataclass(frozen=True)
class Verify:
    """Read a whole store and compare every segment with the hash that was written with it, and with the schema.

    Training and evaluation do so for each segment when they first read it.
    """

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder of the store."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write the result to; - for standard output, and nothing else."""

    def run(self) -> None:
        """Verify, showing how far it is, and print."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from symphony.data.store import SegmentStore

        store = SegmentStore(self.store)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("segments"),
        )
        with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as bar:
            task = bar.add_task("Verifying", total=len(store))
            store.verify(lambda done, total: bar.update(task, completed=done, total=total))
        found = {"path": str(store.path), "segments": len(store), "checksum": store.checksum()}
        if self.json is not None:
            write_numbers(self.json, found)
        if str(self.json) != "-":
            _write(f"{len(store)} segments are what was written; checksum {found['checksum']}")


def _write(text: str) -> None:
    # Not through rich, which would wrap and colour what another program is going to read.
    print(text)  # noqa: T201


def _shown(text: str) -> str:
    """Text from files for a table: neither markup nor what a terminal acts on."""
    from rich.markup import escape

    return escape(printable(text))


def _print_report(report: Any, out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "segments", title=_shown(str(out)), title_justify="left", title_style="bold")
    table.columns[1].justify = "right"
    table.add_row("converted", str(report.converted))
    if report.present:
        table.add_row("there already", str(report.present))
    for reason, count in _exclusions(report.exclusions):
        table.add_row(f"excluded: {reason}", str(count))
    for reason, count in report.problems.items():
        table.add_row(f"skipped: {_shown(reason)}", str(count))
    for reason, count in report.odd.items():
        example = report.odd_examples.get(reason)
        table.add_row(_shown(f"odd: {reason}" + (f" (first: {example})" if example else "")), str(count))
    if report.overlaps:
        table.add_row("converted with boxes that overlap in the log", str(report.overlaps))
    if report.joined_gaps:
        table.add_row("gaps between lanes joined", str(report.joined_gaps))
    print_table(table, Console())
    if report.warning:
        Console(stderr=True).print(f"[yellow]warning:[/] {_shown(report.warning)}", soft_wrap=True)


def _exclusions(found: dict[str, int]) -> list[tuple[str, int]]:
    """The paper's exclusions that left something out."""
    from symphony.data.selection import EXCLUSIONS

    return [(EXCLUSIONS[name], count) for name, count in found.items() if count]


def _unfinished_row(found: dict[str, int] | None) -> list[tuple[str, str]]:
    if found is None:
        return []
    return [("unfinished", f"a conversion that adds to it: {found['files']} of {found['of']} files done")]


def _print_info(found: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    def span(name: str, unit: str = "") -> str:
        values = found[name]
        if not values:
            return "none"
        if values["min"] == values["max"]:
            return f"{values['min']:g}{unit}"
        return f"{values['min']:g} to {values['max']:g}{unit} (mean {values['mean']:.4g})"

    sources = ", ".join(f"{count} from {source}" for source, count in found["sources"].items())
    rows = [
        ("segments", f"{found['segments']}" + (f" ({sources})" if sources else "")),
        ("recordings", f"{found['groups']}"),
        ("agents", f"{found['agents']}"),
        ("traffic lights", f"{found['signals']}"),
        ("steps", span("steps")),
        ("duration", span("duration", " s")),
        ("time step", span("dt", " s")),
        ("maps", f"{found['maps']}"),
        ("lanes per segment", span("lanes")),
        ("map points per segment", span("map_points")),
        *_interactive_rows(found.get("interactive")),
        *_route_rows(found.get("routes")),
        ("size on disk", f"{found['bytes'] / 2**20:.1f} MiB"),
        ("checksum", f"{found['checksum'][:16]}… (in full with --json)"),
        ("excluded", f"{sum(found['exclusions'].values())}"),
        *((f"  {reason}", str(count)) for reason, count in _exclusions(found["exclusions"])),
        ("skipped", f"{sum(found['problems'].values())}"),
        *((f"  {reason}", str(count)) for reason, count in found["problems"].items()),
        *(("odd: " + what, str(count)) for what, count in found["odd"].items()),
        *([("boxes overlap in the log of", str(found["overlaps"]))] if found["overlaps"] else []),
        *([("gaps between lanes joined", str(found["joined_gaps"]))] if found["joined_gaps"] else []),
        *_unfinished_row(found["unfinished"]),
        *([("unfinished", found["unfinished_generation"])] if found["unfinished_generation"] else []),
    ]
    table = Table(
        show_header=False, box=None, pad_edge=False, title=_shown(found["path"]), title_style="bold"
    )
    table.title_justify = "left"
    for name, value in rows:
        table.add_row(_shown(name), _shown(value))
    print_table(table, Console())


def _counted_routes(path: Path, interactive: int) -> dict[str, Any]:
    from symphony.cli.evaluate import segments_bar
    from symphony.data.store import SegmentStore
    from symphony.envs.route_report import route_counts

    with segments_bar("looking at routes") as advance:
        return route_counts(SegmentStore(path), interactive, advance)


def _route_rows(found: dict[str, Any] | None) -> list[tuple[str, str]]:
    if found is None:
        return []
    share = found["logged_within_2m"]
    failed = [("  failed", f"{found['failed']}, such as: {found['example']}")] if found["failed"] else []
    return [
        ("routes", f"{found['routes']} of {found['agents']} agents; {found['without']} agents on no lane"),
        ("  kinked beyond the lanes' own", str(found["kinked"])),
        ("  end inside the map", str(found["ends_inside"])),
        ("  log within 2 m of the route taken", "–" if share is None else f"{100 * share:.1f} %"),
        *failed,
    ]


def _interactive_rows(found: dict[str, Any] | None) -> list[tuple[str, str]]:
    if found is None:
        return []
    rows = [(f"  partner: {context}", str(count)) for context, count in found["contexts"].items()]
    too_few = [("  too few vehicles", str(found["too_few"]))] if found["too_few"] else []
    return [("interactive agents", str(found["count"])), *rows, *too_few]
