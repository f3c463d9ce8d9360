"""Convert or generate run segments into a store, and inspect it."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import symphony
from symphony.cli import shared
from symphony.config import Method
from symphony.config.checks import Bounds, Count, Natural, NotNegative, Positive
from symphony.errors import ConfigError

READER_OPTIONS = {"interaction": ("egos", "window", "stride", "motion"), "commonroad": ("egos",)}
"""Options of `data convert` that only some readers take; the first takes all of them."""
LISTS = {"path", "files", "settings", "reasons", "odd_examples", "skipped", "skipped_details"}
"""Entries that `data info` shows in its JSON only."""


class Generate(shared.Command):
    """Make run segments with SUMO: random networks and traffic.

    An interrupted run is continued by the same command; a finished store is left as it is. Equal arguments give equal
    stores (with the same version of SUMO), whatever the number of workers.
    """

    out: Path  # Folder of the store; with a preset, of its stores `train`, `validation` and `test`.
    count: Annotated[int | None, Bounds(1)] = None  # Number of run segments; needed unless a preset gives it.
    #: Standard set to make: 2 000 + 200 + 500 run segments, or 10 000 + 200 + 1 000, of 10 s.
    preset: Literal["town-small", "town"] | None = None
    seed: int = 0  # Seed of the networks: another one gives other networks.
    #: Use of the run segments: the three splits never share a network, except for roads of your own.
    split: Literal["train", "validation", "test"] = "train"
    #: Kinds of network that take turns, with commas between: town, grid, ramp (freeways), street (towns where cars
    #: are parked and people walk and cycle), or files with your own roads: OpenDRIVE (.xodr), OpenStreetMap (.osm) or
    #: SUMO (.net.xml).
    kinds: str = "town"
    duration: Literal[10, 20, 30] = 10  # Seconds of a run segment.
    interactive: int = 2  # Vehicles that must be present and move at the first step.
    workers: shared.Workers = 1
    engine: shared.EngineName = "local"
    json: shared.Json = None

    def __post_init__(self) -> None:
        if (self.preset is None) == (self.count is None):
            raise ConfigError("give --count or --preset, one of them")
        given = {f.name for f in fields(self) if getattr(self, f.name) != f.default}
        if self.preset is not None and (own := given & {"seed", "split", "kinds", "duration", "interactive"}):
            raise ConfigError(f"--preset decides --{min(own)} itself: give one or the other")
        self._plans()

    def _plans(self) -> list[Any]:
        from symphony.data.generate import PRESETS, Plan

        if self.preset is not None:
            return list(PRESETS[self.preset].plans.values())
        kinds = tuple(map(str.strip, self.kinds.split(",")))
        return [Plan(self.count or 0, self.seed, self.split, kinds, self.duration, self.interactive)]

    def __call__(self) -> None:
        from symphony.data.generate import MADE_WITH, PRESETS
        from symphony.data.sources.sumo import sumo_version

        expected: dict[Any, str] = {} if self.preset is None else dict(PRESETS[self.preset].checksums)
        found = {plan.split: self._make(plan, expected.get(plan.split)) for plan in self._plans()}
        told = shared.write_numbers(self.json, {"preset": self.preset, "stores": found})
        for one in found.values():
            if told:
                shared.print_facts(one)
            if one["expected_checksum"] not in (None, one["checksum"]):
                text = f"symphony: warning: {one['path']}: the checksum is not that of the standard set, which was"
                shared.tell(f"{text} made with {MADE_WITH}; yours was made with SUMO {sumo_version()}")

    def _make(self, plan: Any, expected: str | None) -> dict[str, Any]:
        from symphony.data.generate import generate

        path = self.out if self.preset is None else self.out / plan.split
        how: dict[str, Any] = {"workers": self.workers, "engine": self.engine}
        with shared.progress(f"generating {plan.split}") as advance:
            how["progress"] = lambda done, at: advance(done, plan.segments, f"from {at.networks} networks")
            made = asdict(generate(plan, path, **how))
        store = symphony.SegmentStore(path)
        found = {"split": plan.split, "path": str(path), "segments": len(store), "checksum": store.checksum()}
        more = {"expected_checksum": expected, "settings": store.report["settings"], "generation": made}
        return found | more


class Quality(shared.Command):
    """Measure the driving in a store: is it physical, varied, and within reach of the action space?"""

    store: shared.Store
    interactive: Count = 2  # Interactive agents per run segment, which are measured.
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.evaluation.logs import measure, shortfalls

        store = symphony.SegmentStore(self.store)
        with shared.progress("measuring") as advance:
            quality = measure(store, interactive=self.interactive, progress=advance)
        if shared.write_numbers(self.json, quality):
            shared.print_facts(quality, str(self.store))
        for missed in shortfalls(quality):
            shared.tell(f"below what generated sets must reach: {missed}")


class Hardest(shared.Command):
    """List the run segments of a store, or the rollouts in a folder, that are most critical for the ego.

    The hardest come first. Four things make one critical, each with up to one point: a short time to collision, a
    short time between the ego and another that crosses its path, hard braking, a small distance to the road boundary.
    """

    store: Annotated[Positional[Path], arg(metavar="DIR")]  # Folder of the store, or of rollouts.
    count: Count = 20  # Number of run segments, or of rollouts, to list.
    ids: bool = False  # Print only the ids of their segments, for the option --segments of other commands.
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.bench.criticality import hardest
        from symphony.saved.folder import MANIFEST, load_rollouts

        opened = load_rollouts if (self.store / MANIFEST).is_file() else symphony.SegmentStore
        with shared.progress("looking at each") as advance:
            found = [one for _, one in hardest(opened(self.store), self.count, progress=advance)]
        told = shared.write_numbers(self.json, [{**asdict(one), "score": one.score} for one in found])
        if self.ids and told:
            shared.say("\n".join(dict.fromkeys(one.segment for one in found)))
        elif told:
            rows = [["segment", "rollout", "critical", "TTC s", "PET s", "braking m/s²", "to the edge m"]]
            for one in found:
                numbers = (one.score, one.time_to_collision, one.encroachment, one.braking, one.margin)
                cells = ("–" if math.isinf(n) else f"{n:.2f}" for n in numbers)
                rows.append([one.segment, "log" if one.rollout is None else str(one.rollout), *cells])
            shared.print_table(rows, heads=1)


class Convert(shared.Command):
    """Convert logs into a store of run segments.

    A record that can't be used is skipped, counted and reported. Until everything is converted, the work lies in
    OUT.partial; a conversion that was interrupted or killed is continued by the same command.
    """

    #: Format of the logs: Waymo Open Motion Dataset (TFRecord), CommonRoad (XML), Argoverse 2 motion
    #: forecasting (Parquet, each with its map beside it), INTERACTION (CSV with Lanelet2 maps), ScenarioNet (pickle).
    format: Positional[Literal["womd", "commonroad", "argoverse2", "interaction", "scenarionet"]]
    #: Files of that format, or folders to search for them (links in them to folders are not followed).
    files: Annotated[Positional[shared.Paths], arg(metavar="FILE ...")]
    out: Path  # Folder of the store.
    rate: Positive = 5.0  # Steps per second in the store (the paper's 5).
    interactive: Count = 2  # Interactive agents a run segment must have at its first step.
    smooth: NotNegative = 0.0  # Smoothing of the tracks before they are resampled: its sigma in seconds.
    #: Egos of a CommonRoad scenario or INTERACTION window. `one`: the vehicle with the most moving vehicles around
    #: it; with `all`, every moving vehicle that is seen throughout, each in its own run segment; with `problem`, the
    #: ego of each CommonRoad planning problem, which has no log.
    egos: Literal["one", "all", "problem"] = "one"
    window: Positive = 10.0  # Seconds of the run segments that recordings of INTERACTION are cut into.
    #: Seconds between the starts of two windows of INTERACTION; without it, one begins where another ends.
    stride: Annotated[float | None, Bounds(sys.float_info.min)] = None
    #: Source of velocities and headings of INTERACTION: as logged, or the positions, where the logged ones don't fit.
    motion: Literal["logged", "positions"] = "logged"
    #: Metres from the ego's path within which map and agents are kept: for sources of whole districts (ScenarioNet).
    radius: Annotated[float | None, Bounds(sys.float_info.min)] = None
    exclude_overlaps: bool = False  # Leave out run segments in which a moving vehicle's box overlaps another.
    hold_lights: bool = False  # Lights keep their last known state where the log has none (docs/formats.md).
    strict: bool = False  # Skip a record with anything odd, which is else left out or filled in.
    workers: shared.Workers = 1
    engine: shared.EngineName = "local"

    def __post_init__(self) -> None:
        given = {f.name for f in fields(self) if getattr(self, f.name) != f.default}
        if wrong := given & {*READER_OPTIONS["interaction"]} - {*READER_OPTIONS.get(self.format, ())}:
            raise ConfigError(f"--{min(wrong)} is not for {self.format}")

    def __call__(self) -> None:
        from symphony.data.convert import convert

        given = dict(vars(self))
        reader, files, out = (given.pop(name) for name in ("format", "files", "out"))
        options = {name: given.pop(name) for name in READER_OPTIONS["interaction"]}
        given["reader_options"] = {name: options[name] for name in READER_OPTIONS.get(reader, ())}
        with shared.progress("converting", "files") as advance:
            told = "{} converted, {} skipped".format
            given["progress"] = lambda n, of, at: advance(n, of, told(at.converted, len(at.skipped)))
            report = convert(reader, files, out, **given)
        Info(store=out, interactive=0)()
        if report.warning:
            shared.tell(f"symphony: warning: {report.warning}")


class Prepare(shared.Command):
    """Fit actions to the vehicles of a store in advance, so that `symphony train` need not do it.

    The results are kept in the store's folder `experts`; an interrupted preparation is continued by the same command,
    and equal arguments give equal files, whatever the number of workers.
    """

    store: shared.Store
    method: Method = "bc_ts_h"  # Method to train, which decides the actions and whether there are routes.
    duration: Natural = 0  # Seconds of each run segment to use; 0: all.
    accelerations: Annotated[int, Bounds(3, 1001)] = 7  # Levels of acceleration of the agent (methods bc*).
    workers: shared.Workers = 1
    engine: shared.EngineName = "local"

    def __call__(self) -> None:
        from symphony.envs.dynamics import Bicycle, Displacement
        from symphony.learning.preparation import prepare

        cloned = self.method.startswith("bc")
        dynamics = Bicycle(num_acceleration=self.accelerations) if cloned else Displacement()
        how: Any = {"routes": self.method.endswith("_h"), "duration": self.duration}
        how |= {"workers": self.workers, "engine": self.engine}
        with shared.progress("preparing") as advance:
            for done, total in prepare(self.store, dynamics, **how):
                advance(done, total)
        shared.say(f"{total} run segments are prepared for {self.method} in {self.store}")


class Merge(shared.Command):
    """Copy the run segments of several stores into a new one, to train on all of them."""

    #: Folders of the stores; they must have the same time step and no run segment in common.
    stores: Annotated[Positional[shared.Paths], arg(metavar="DIR ...")]
    out: Path  # Folder of the new store.
    mirrored: bool = False  # Add each run segment mirrored, too: agents learn to drive on either side of the road.

    def __call__(self) -> None:
        from symphony.data.convert import merge

        with shared.progress("copying") as advance:
            merge(self.stores, self.out, advance, mirror=self.mirrored)
        Info(store=self.out, interactive=0)()


class Info(shared.Command):
    """Show what a store of run segments holds; the JSON also lists skipped records and the interactive agents."""

    store: shared.Store
    json: shared.Json = None
    interactive: Natural = 2  # Interactive agents to choose in each segment, with counts of the reasons; 0: none.

    def __call__(self) -> None:
        from symphony.data.convert import info
        from symphony.data.selection import choices

        found = info(self.store)
        if self.interactive:
            found["interactive"] = choices(symphony.SegmentStore(self.store), self.interactive)
        if shared.write_numbers(self.json, found):
            found.get("interactive", {}).pop("segments", None)
            facts = {name: value for name, value in found.items() if name not in LISTS}
            shared.print_facts(facts, found["path"])


class Verify(shared.Command):
    """Read a whole store and compare every segment with the hash that was written with it, and with the schema.

    Training and evaluation do so for each segment when they first read it.
    """

    store: shared.Store
    json: shared.Json = None

    def __call__(self) -> None:
        store = symphony.SegmentStore(self.store)
        with shared.progress("verifying") as advance:
            store.verify(advance)
        found = {"path": str(store.path), "segments": len(store), "checksum": store.checksum()}
        if shared.write_numbers(self.json, found):
            shared.say(f"{len(store)} segments are as they were written; checksum {found['checksum']}")
