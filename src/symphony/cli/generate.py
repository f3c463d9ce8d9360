"""Make run segments by simulation, and measure what the driving in a store is like."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from symphony.cli.tables import print_table, write_numbers
from symphony.errors import ConfigError

if TYPE_CHECKING:
    from symphony.data.generate import Generation
    from symphony.data.plans import Plan

_WITH_PRESET = frozenset({"out", "preset", "workers", "engine", "json"})
_TARGETS = {"collision_rate": "≤ 0.5", "offroad_time": "≤ 0.5", "directions": "each ≥ 15"}


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
    """How many segments; needed unless a preset says it."""
    preset: Literal["town-small", "town"] | None = None
    """A standard set: 2 000 + 200 + 500 segments, or 10 000 + 200 + 1 000, of 10 s."""
    seed: int = 0
    """Another seed gives other networks."""
    split: Literal["train", "validation", "test"] = "train"
    """What the segments are for: the three never share a network, except for roads of your own."""
    kinds: str = "town"
    """Kinds of network that take turns, with commas between: town, grid, ramp (freeways), random (no grid), or files
    with roads of your own: OpenDRIVE (.xodr), OpenStreetMap (.osm) or SUMO (.net.xml)."""
    duration: Literal[10, 20, 30] = 10
    """Seconds of a segment."""
    interactive: int = 2
    """Vehicles that must be there and move at the first step."""
    workers: int = 1
    """Processes that make networks."""
    engine: Literal["local", "ray"] = "local"
    """Where they are: on this machine, or wherever Ray puts them."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write the measures to; - for standard output, the tables then go to standard error."""

    def __post_init__(self) -> None:
        if self.preset is None and self.count is None:
            raise ConfigError("give --count or --preset")
        if self.preset is not None:
            given = [f.name for f in fields(self) if getattr(self, f.name) != f.default]
            extra = sorted(set(given) - _WITH_PRESET)
            if extra:
                raise ConfigError(f"--preset decides --{extra[0]} itself: give one or the other")
        if self.workers < 1:
            raise ConfigError(f"--workers must be at least 1, is {self.workers}")
        self._plans()

    def _plans(self) -> dict[str, tuple[Plan, Path]]:
        """The stores to make, by split, and where."""
        from symphony.data.plans import PRESETS, Plan

        if self.preset is not None:
            return {split: (plan, self.out / split) for split, plan in PRESETS[self.preset].plans.items()}
        kinds = tuple(kind.strip() for kind in self.kinds.split(","))
        segments = 0 if self.count is None else self.count
        plan = Plan(
            segments,
            seed=self.seed,
            split=self.split,
            kinds=kinds,
            duration=self.duration,
            interactive=self.interactive,
        )
        return {self.split: (plan, self.out)}

    def run(self) -> None:
        """Make what is missing, measure, report."""
        from rich.console import Console
        from rich.markup import escape

        from symphony.data.plans import MADE_WITH, PRESETS
        from symphony.data.sources.sumo import sumo_version

        expected: dict[Any, str] = {} if self.preset is None else dict(PRESETS[self.preset].checksums)
        aside = str(self.json) == "-"
        console = Console(stderr=aside)
        found = {}
        for split, (plan, path) in self._plans().items():
            made = self._make(plan, path, split)
            found[split] = entry = describe(path, plan, made)
            print_quality(entry["quality"], title=str(path), rows=_generation_rows(entry), aside=aside)
            console.print(f"checksum {entry['checksum']}", soft_wrap=True)
            if entry["checksum"] != expected.get(split, entry["checksum"]):
                text = (
                    f"{path}: the checksum differs from that of the standard set ({expected[split]}), which was "
                    f"made with {MADE_WITH}; yours was made with SUMO {sumo_version()}: results on it are not "
                    "comparable to the last digit"
                )
                Console(stderr=True).print(f"[yellow]warning:[/] {escape(text)}", soft_wrap=True)
            entry["expected_checksum"] = expected.get(split)
        if self.json is not None:
            write_numbers(self.json, {"preset": self.preset, "stores": found})

    def _make(self, plan: Plan, path: Path, name: str) -> Generation:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from symphony.data.generate import generate

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("segments"),
        )
        networks = TextColumn("from {task.fields[networks]} networks")
        with Progress(*columns, networks, TimeRemainingColumn(), console=Console(stderr=True)) as bar:
            task = bar.add_task(f"Generating {name}", total=plan.segments, networks=0)

            def show(done: int, state: Generation) -> None:
                bar.update(task, completed=done, networks=state.networks)

            made = generate(plan, path, workers=self.workers, engine=self.engine, progress=show)
            show(plan.segments, made)
        return made


@dataclass(frozen=True)
class Quality:
    """Measure the driving in a store: is it physical, varied, and within reach of the action space?"""

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder of the store."""
    interactive: int = 2
    """Interactive agents per segment: they are what is measured."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write the measures to; - for standard output, the tables then go to standard error."""

    def __post_init__(self) -> None:
        if self.interactive < 1:
            raise ConfigError(f"--interactive must be at least 1, is {self.interactive}")

    def run(self) -> None:
        """Measure and print."""
        from symphony.evaluation.logs import shortfalls

        quality = measured(self.store, self.interactive)
        print_quality(quality, title=str(self.store), aside=str(self.json) == "-")
        for missed in shortfalls(quality):
            sys.stderr.write(f"below what generated sets must reach: {missed}\n")
        if self.json is not None:
            write_numbers(self.json, quality)


def measured(path: Path, interactive: int) -> dict[str, Any]:
    """Measures of a store, with a progress bar."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from symphony.data.store import SegmentStore
    from symphony.evaluation.logs import measure

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("segments"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("Measuring", total=None)
        return measure(
            SegmentStore(path),
            interactive=interactive,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )


def describe(path: Path, plan: Plan, made: Generation) -> dict[str, Any]:
    """What a generated store holds and how it was made; its measures are taken once and kept in its report."""
    from dataclasses import asdict

    from symphony.data.generate import add_to_report
    from symphony.data.store import SegmentStore

    store = SegmentStore(path)
    quality = store.report.get("quality")
    if quality is None:
        quality = measured(path, plan.interactive)
        add_to_report(path, "quality", quality)
    minutes = max(made.seconds, 1e-9) / 60
    return {
        "path": str(path),
        "settings": store.report["settings"],
        "segments": len(store),
        "maps": store.num_maps,
        "bytes_per_segment": round(store.summary()["bytes"] / len(store)),
        "checksum": store.checksum(),
        "generation": asdict(made),
        "per_minute_and_core": round(len(store) / minutes, 1),
        "accepted_per_minute_and_core": round(made.accepted / minutes, 1),
        "quality": quality,
    }


def _generation_rows(entry: dict[str, Any]) -> list[tuple[str, str, str]]:
    made = entry["generation"]
    return [
        ("networks", f"{made['networks']}, of which {len(made['failed'])} failed", ""),
        ("maps", f"{entry['maps']}", ""),
        ("size", f"{entry['bytes_per_segment'] / 1000:.1f} kB per segment", ""),
        ("taken per minute and core", f"{entry['per_minute_and_core']:.0f}", "≥ 100"),
        ("accepted per minute and core", f"{entry['accepted_per_minute_and_core']:.0f}", ""),
        *((f"left out: {reason}", f"{count}", "") for reason, count in made["reasons"].items()),
    ]


_SPREADS = (
    ("speed", "speed, m/s"),
    ("acceleration", "acceleration, m/s²"),
    ("yaw_rate", "yaw rate, rad/s"),
    ("lateral_offset", "left of centre, m"),
    ("fit_error", "error of the fit, m"),
    ("agents", "agents"),
    ("moving", "moving vehicles"),
)


def print_quality(
    quality: dict[str, Any],
    title: str = "",
    rows: list[tuple[str, str, str]] | None = None,
    *,
    aside: bool = False,
) -> None:
    """Print measures, and before them rows (name, value, target) of one's own; to stderr if ``aside``."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(title) or None, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for name in ("", "value", "target"):
        table.add_column(name, justify="left" if not name else "right")
    choices = " / ".join(f"{name} {_number(share, 1)}" for name, share in quality["directions"].items())
    lines = [
        ("segments", f"{quality['segments']}", ""),
        *(rows or []),
        ("collision rate, %", _number(quality["collision_rate"], 2), _TARGETS["collision_rate"]),
        ("off-road time, %", _number(quality["offroad_time"], 2), _TARGETS["offroad_time"]),
        (f"{quality['choices']} choices at branching lanes, %", choices, _TARGETS["directions"]),
        ("agents that turn, %", _number(quality["turning"], 1), ""),
        ("segments with lights, %", _number(quality["lights"], 1), ""),
    ]
    if quality["skipped"]:
        lines.append(("segments left out: too few agents", f"{quality['skipped']}", ""))
    for line in lines:
        table.add_row(*map(escape, line))
    columns = ("mean", "std", "p1", "p50", "p95", "p99", "max")
    spreads = Table("", *columns, box=SIMPLE_HEAD, pad_edge=False)
    for column in spreads.columns[1:]:
        column.justify = "right"
    for key, name in _SPREADS:
        spreads.add_row(name, *(_number(quality[key][column], 2) for column in columns))
    console = Console(stderr=aside)
    print_table(table, console)
    print_table(spreads, console)
    console.print(
        f"The log of {quality['interactive']} interactive agents per segment. Error of the fit: metres at the end of "
        "the greedy fit to 7x21 bicycle actions. Moving vehicles: at the first step.",
        style="dim",
    )


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}f}"
