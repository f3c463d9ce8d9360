"""Convert or generate run segments into a store, and look into it."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from symphony.cli.shared import (
    ResultFile,
    at_least,
    print_facts,
    print_table,
    progress,
    say,
    warn,
    write_numbers,
)
from symphony.errors import ConfigError

if TYPE_CHECKING:
    from symphony.data.generate import Generation, Plan

WINDOWS = ("window", "stride", "motion")
"""Options of the INTERACTION reader alone."""
WITH_PRESET = {"out", "preset", "workers", "engine", "json"}
Store = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]

app = tyro.extras.SubcommandApp()


@app.command(name="generate")
@dataclass(frozen=True)
class Generate:
    """Make run segments with SUMO: random networks and traffic.

    A run that was interrupted, in whatever way, is continued by the same command; a finished store is left as it
    is. Equal arguments give equal stores (with the same version of SUMO), whatever the number of workers. At the
    end the driving is measured.
    """

    out: Path
    """Folder of the store; with a preset, of its stores `train`, `validation` and `test`."""
    count: int | None = None
    """Number of run segments; needed unless a preset says it."""
    preset: Literal["town-small", "town"] | None = None
    """A standard set: 2 000 + 200 + 500 run segments, or 10 000 + 200 + 1 000, of 10 s."""
    seed: int = 0
    """Seed of the networks: another one gives other networks."""
    split: Literal["train", "validation", "test"] = "train"
    """Use of the run segments: the three splits never share a network, except for roads of your own."""
    kinds: str = "town"
    """Kinds of network that take turns, with commas between: town, grid, ramp (freeways), or files with roads of
    your own: OpenDRIVE (.xodr), OpenStreetMap (.osm) or SUMO (.net.xml)."""
    duration: Literal[10, 20, 30] = 10
    """Seconds of a run segment."""
    interactive: int = 2
    """Vehicles that must be there and move at the first step."""
    workers: int = 1
    """Processes that make networks."""
    engine: Literal["local", "ray"] = "local"
    """Engine that runs these processes: `local`, on this machine, or `ray`, wherever Ray puts them."""
    json: ResultFile = None
    """File to write the measures to; - for standard output, the tables then go to standard error."""

    def __post_init__(self) -> None:
        if self.preset is None and self.count is None:
            raise ConfigError("give --count or --preset")
        given = {f.name for f in fields(self) if getattr(self, f.name) != f.default}
        if self.preset is not None and (extra := sorted(given - WITH_PRESET)):
            raise ConfigError(f"--preset decides --{extra[0]} itself: give one or the other")
        at_least(1, workers=self.workers)
        self._plans()

    def _plans(self) -> dict[str, tuple[Plan, Path]]:
        """The stores to make, by split, and where."""
        from symphony.data.generate import PRESETS, Plan

        if self.preset is not None:
            return {split: (plan, self.out / split) for split, plan in PRESETS[self.preset].plans.items()}
        kinds = tuple(kind.strip() for kind in self.kinds.split(","))
        more: Any = {"duration": self.duration, "interactive": self.interactive}
        return {self.split: (Plan(self.count or 0, self.seed, self.split, kinds, **more), self.out)}

    def run(self) -> None:
        """Make what is missing, measure, report."""
        from symphony.data.generate import MADE_WITH, PRESETS, generate
        from symphony.data.sources.sumo import sumo_version

        expected: dict[Any, str] = {} if self.preset is None else dict(PRESETS[self.preset].checksums)
        found = {}
        for split, (plan, path) in self._plans().items():
            with progress(f"generating {split}") as advance:

                def show(done: int, state: Generation, total: int = plan.segments, to: Any = advance) -> None:
                    to(done, total, f"from {state.networks} networks")

                made = generate(plan, path, workers=self.workers, engine=self.engine, progress=show)
            found[split] = entry = describe(path, plan, made)
            print_facts(entry, str(path), aside=str(self.json) == "-")
            if entry["checksum"] != expected.get(split, entry["checksum"]):
                warn(
                    f"{path}: the checksum differs from that of the standard set ({expected[split]}), which was "
                    f"made with {MADE_WITH}; yours was made with SUMO {sumo_version()}: results on it are not "
                    "comparable to the last digit"
                )
            entry["expected_checksum"] = expected.get(split)
        write_numbers(self.json, {"preset": self.preset, "stores": found})


@app.command(name="quality")
@dataclass(frozen=True)
class Quality:
    """Measure the driving in a store: is it physical, varied, and within reach of the action space?"""

    store: Store
    """Folder of the store."""
    interactive: int = 2
    """Interactive agents per run segment: they are what is measured."""
    json: ResultFile = None
    """File to write the measures to; - for standard output, the table then goes to standard error."""

    def __post_init__(self) -> None:
        at_least(1, interactive=self.interactive)

    def run(self) -> None:
        """Measure and print."""
        from symphony.evaluation.logs import shortfalls

        quality = measured(self.store, self.interactive)
        print_facts(quality, str(self.store), aside=str(self.json) == "-")
        for missed in shortfalls(quality):
            sys.stderr.write(f"below what generated sets must reach: {missed}\n")
        write_numbers(self.json, quality)


@app.command(name="hardest")
@dataclass(frozen=True)
class Hardest:
    """List the run segments of a store that are most critical for the ego, the hardest first.

    Four things make a segment critical, each with up to one point: a short time to collision, a short time between
    the ego and another who crosses its way, hard braking, and a small distance to the road's boundary.
    """

    data: Store
    """Folder of the store."""
    count: int = 20
    """Number of run segments that are listed."""
    ids: bool = False
    """Print only their ids, for the option --segments of other commands."""
    json: ResultFile = None
    """File to write the list to; - for standard output, in place of the table."""

    def __post_init__(self) -> None:
        at_least(1, count=self.count)

    def run(self) -> None:
        """Look at every run segment and print the hardest."""
        from rich.console import Console
        from rich.table import Table

        from symphony.bench.criticality import hardest
        from symphony.data.store import SegmentStore

        with progress("looking at the log") as advance:
            found = [one for _, one in hardest(SegmentStore(self.data), self.count, progress=advance)]
        write_numbers(self.json, [{**asdict(one), "score": one.score} for one in found])
        if self.ids:
            for one in found:
                say(one.segment)
        elif str(self.json) != "-":
            table = Table("segment", "critical", "TTC s", "PET s", "braking m/s²", "to the edge m")
            for one in found:
                numbers = (one.score, one.time_to_collision, one.encroachment, one.braking, one.margin)
                table.add_row(one.segment, *("–" if math.isinf(n) else f"{n:.2f}" for n in numbers))
            print_table(table, Console())


@app.command(name="convert")
@dataclass(frozen=True)
class Convert:
    """Convert logs into a store of run segments.

    A record that can't be used is skipped, counted and reported. The store appears once everything is converted;
    until then the work lies in OUT.partial. A conversion that was interrupted or killed goes on where it stopped when
    the same command is given again.
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
    """Interactive agents a run segment must have at its first step."""
    smooth: float = 0.0
    """Smoothing of the tracks before they are resampled: sigma in seconds, 0 for none."""
    egos: Literal["one", "all"] = "one"
    """CommonRoad and INTERACTION, which name no ego vehicle: make one run segment of each scenario or window, with
    the ego that has the most moving vehicles around it, or one for every moving vehicle seen throughout."""
    window: float = 10.0
    """INTERACTION: seconds of the run segments that recordings are cut into."""
    stride: float | None = None
    """INTERACTION: seconds between the starts of two windows; without it, one begins where another ends."""
    motion: Literal["logged", "positions"] = "logged"
    """INTERACTION: take velocities and headings as logged, or from the positions (for files that are refused because
    theirs don't fit)."""
    radius: float | None = None
    """Keep what comes within so many metres of the ego's path, of map and agents: for sources that give whole
    districts, whose maps would exceed the paper's limit (ScenarioNet)."""
    exclude_overlaps: bool = False
    """Leave out run segments in whose log a moving vehicle's box overlaps another box."""
    hold_lights: bool = False
    """Give lights the last state that the log knows (before the first: the first) where it knows none, instead of
    `unknown`: for logs that show their lights at a single step (see docs/formats.md)."""
    strict: bool = False
    """Skip a record of which something odd would be left out (an agent without a size, a state that no car can have,
    a node that the map lacks), instead of reading the rest of it."""
    workers: int = 1
    """Processes that convert files; the store does not depend on their number."""
    engine: Literal["local", "ray"] = "local"
    """Engine that runs these processes: `local`, on this machine, or `ray`, on the Ray cluster at RAY_ADDRESS (else a
    Ray on this machine), whose machines must share the files and the folder of the store."""

    def __post_init__(self) -> None:
        if not self.files:
            raise ConfigError("no files given")
        if not 0.2 <= self.rate <= 200:
            raise ConfigError(f"--rate must be between 0.2 and 200 steps per second, is {self.rate:g}")
        at_least(1, interactive=self.interactive, workers=self.workers)
        if not self.smooth >= 0:
            raise ConfigError(f"--smooth must not be negative, is {self.smooth}")
        if self.radius is not None and not self.radius > 0:
            raise ConfigError(f"--radius must be positive, is {self.radius}")
        if self.egos == "all" and self.format not in {"commonroad", "interaction"}:
            raise ConfigError(
                f"--egos all is for commonroad and interaction; {self.format} names its ego vehicle"
            )
        given = [f.name for f in fields(self) if f.name in WINDOWS and getattr(self, f.name) != f.default]
        if given and self.format != "interaction":
            raise ConfigError(f"--{given[0]} is for interaction")

    def run(self) -> None:
        """Convert, showing how far it is, and report."""
        from symphony.data.convert import convert

        settings = {f.name: getattr(self, f.name) for f in fields(self)}
        reader, files, out = (settings.pop(name) for name in ("format", "files", "out"))
        options = {name: settings.pop(name) for name in ("egos", *WINDOWS)}
        names = {"commonroad": ("egos",), "interaction": ("egos", *WINDOWS)}.get(self.format, ())
        settings["reader_options"] = {name: options[name] for name in names} or None
        with progress("converting", "files") as advance:
            try:
                report = convert(
                    reader,
                    files,
                    out,
                    progress=lambda done, total, so_far: advance(
                        done, total, f"{so_far.converted} converted, {len(so_far.skipped)} skipped"
                    ),
                    **settings,
                )
            except KeyboardInterrupt:
                sys.stderr.write("What is done is kept: the same command goes on with it.\n")
                raise
        firsts = {
            f"{reason} (first: {report.odd_examples[reason]})"
            if reason in report.odd_examples
            else reason: count
            for reason, count in report.odd.items()
        }
        rows = {
            "converted": report.converted,
            "excluded": _excluded(report.exclusions),
            "skipped": report.problems,
            "odd": firsts,
            "converted with boxes that overlap in the log": report.overlaps,
            "gaps between lanes joined": report.joined_gaps,
        }
        print_facts({name: count for name, count in rows.items() if count}, str(self.out))
        if report.warning:
            warn(report.warning)


@app.command(name="merge")
@dataclass(frozen=True)
class Merge:
    """Copy the run segments of several stores into a new one, to learn from all of them."""

    stores: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="DIR ...", help_behavior_hint="(required)"),
    ]
    """Folders of the stores; they must have the same time step and no run segment in common."""
    out: Path
    """Folder of the new store."""

    def __post_init__(self) -> None:
        if not self.stores:
            raise ConfigError("no stores given")

    def run(self) -> None:
        """Copy, showing how far it is, and print what there is."""
        from symphony.data.convert import info, merge

        with progress("copying") as advance:
            merge(self.stores, self.out, advance)
        _print_info(info(self.out))


@app.command(name="info")
@dataclass(frozen=True)
class Info:
    """Say what a store of run segments holds."""

    store: Store
    """Folder of the store."""
    json: ResultFile = None
    """File to write everything to, the skipped records included; - for standard output, and nothing else."""
    interactive: int = 2
    """Interactive agents that are chosen in each run segment, to count why the ego's partner was chosen; 0 leaves
    this out."""
    per_segment: bool = False
    """In the JSON, say for each run segment which agents were chosen, and why."""

    def __post_init__(self) -> None:
        at_least(0, interactive=self.interactive)
        if self.per_segment and not (self.json and self.interactive):
            raise ConfigError("--per-segment goes with --json and interactive agents")

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
        write_numbers(self.json, found)
        if str(self.json) != "-":
            _print_info(found)


@app.command(name="verify")
@dataclass(frozen=True)
class Verify:
    """Read a whole store and compare every segment with the hash that was written with it, and with the schema.

    Training and evaluation do so for each segment when they first read it.
    """

    store: Store
    """Folder of the store."""
    json: ResultFile = None
    """File to write the result to; - for standard output, and nothing else."""

    def run(self) -> None:
        """Verify, showing how far it is, and print."""
        from symphony.data.store import SegmentStore

        store = SegmentStore(self.store)
        with progress("verifying") as advance:
            store.verify(advance)
        found = {"path": str(store.path), "segments": len(store), "checksum": store.checksum()}
        write_numbers(self.json, found)
        if str(self.json) != "-":
            say(f"{len(store)} segments are what was written; checksum {found['checksum']}")


def _excluded(found: dict[str, int]) -> dict[str, int]:
    """The paper's exclusions that left something out, in words."""
    from symphony.data.selection import EXCLUSIONS

    return {EXCLUSIONS[name]: count for name, count in found.items() if count}


def _print_info(found: dict[str, Any]) -> None:
    excluded, chosen = found["exclusions"], found.get("interactive")
    shown = {name: found[name] for name in ("segments", "sources")} | {"recordings": found["groups"]}
    shown |= {
        name: found[name]
        for name in ("agents", "signals", "steps", "duration", "dt", "maps", "lanes", "map_points")
    }
    if chosen:
        partners = {f"partner: {context}": count for context, count in chosen["contexts"].items()}
        shown["interactive agents"] = {
            "each": chosen["count"],
            **partners,
            "too few vehicles": chosen["too_few"],
        }
    shown |= {"MiB on disk": found["bytes"] / 2**20, "checksum": found["checksum"]}
    shown |= {"excluded": sum(excluded.values()), **_excluded(excluded)}
    shown |= {"skipped": sum(found["problems"].values()), **found["problems"]}
    more = {"odd": found["odd"], "boxes overlap in the log of": found["overlaps"]}
    more |= {"gaps between lanes joined": found["joined_gaps"]}
    more |= {"unfinished": found["unfinished_generation"]}
    print_facts(shown | {name: value for name, value in more.items() if value}, found["path"])


def measured(path: Path, interactive: int) -> dict[str, Any]:
    """The measures of a store, with a progress bar."""
    from symphony.data.store import SegmentStore
    from symphony.evaluation.logs import measure

    with progress("measuring") as advance:
        return measure(SegmentStore(path), interactive=interactive, progress=advance)


def describe(path: Path, plan: Plan, made: Generation) -> dict[str, Any]:
    """What a generated store holds and how it was made; its measures are taken once and kept in its report."""
    from symphony.data.generate import add_to_report
    from symphony.data.store import SegmentStore

    store = SegmentStore(path)
    quality = store.report.get("quality")
    if quality is None:
        quality = measured(path, plan.interactive)
        add_to_report(path, "quality", quality)
    return {
        "path": str(path),
        "settings": store.report["settings"],
        "segments": len(store),
        "checksum": store.checksum(),
        "generation": asdict(made),
        "quality": quality,
    }
