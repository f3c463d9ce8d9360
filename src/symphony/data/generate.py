"""Simulated run segments in any number: the generator, which can be killed and resumed.

A plan is a list of road networks, each with a seed of its own, from each of which a few segments are taken; many
networks with few segments each give the most variety. Networks are made by any number of processes and written in
the order of the plan, so a store depends on the plan alone.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from symphony.data.segment import RunSegment
from symphony.data.selection import exclusion
from symphony.data.sources.sumo import KINDS, crop_rule, generate_run, is_own, kind_name, sumo_version
from symphony.data.store import SegmentStore
from symphony.data.store_format import HEADER, PARTIAL
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.parallel import Engine, ordered_map

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
DURATIONS = (10, 20, 30)  # seconds a segment may last

VERSION = 4
"""Version of this generator: another may give other segments for the same plan, and does not continue a store."""
FIRST_NETWORK = 1_000_000  # seeds of networks below this are left to the built-in set and to experiments
BLOCK = 100_000  # networks that a seed has for each split
MAX_SEED = 9_999


class Task(NamedTuple):
    """One network: its kind and seed, the seconds of a segment, and N_I."""

    kind: str
    seed: int
    duration: float
    interactive: int

    @property
    def name(self) -> str:
        """The name of the network in the segments' tags."""
        return f"{kind_name(self.kind)}-{self.seed}"


@dataclass(frozen=True)
class Plan:
    """The settings that determine a generated store.

    Raises a :class:`ConfigError` for a value out of range; names the field.
    """

    segments: int  # how many
    seed: int = 0  # another seed is another set of networks
    split: Split = "train"  # training, validation and test sets never share a network, whatever their seeds
    #: of networks, which take turns; one named twice comes twice as often. A file of your own roads is a kind, too;
    #: its roads are the same for every split and seed, the traffic is another.
    kinds: tuple[str, ...] = ("town",)
    duration: int = 10  # seconds of a segment, one of :data:`DURATIONS`
    interactive: int = 2  # moving vehicles a segment must have at its first step (N_I)

    def __post_init__(self) -> None:
        unknown = [kind for kind in self.kinds if kind not in KINDS and not is_own(kind)]
        missing = [kind for kind in self.kinds if is_own(kind) and not Path(kind).is_file()]
        known = f"(known: {', '.join(KINDS)}, and files of roads: .xodr, .osm, .net.xml)"
        for wrong, message in (
            (self.segments < 1, f"segments must be at least 1, is {self.segments}"),
            (not 0 <= self.seed <= MAX_SEED, f"seed must be between 0 and {MAX_SEED}, is {self.seed}"),
            (self.split not in SPLITS, f"unknown split {self.split!r} (known: {', '.join(SPLITS)})"),
            (unknown or not self.kinds, f"kinds: unknown kind of network {', '.join(unknown)!r} {known}"),
            (self.duration not in DURATIONS, f"duration must be one of {DURATIONS}, is {self.duration}"),
            (self.interactive < 2, f"interactive must be at least 2, is {self.interactive}"),
            (missing, f"kinds: there is no file {', '.join(missing)}"),
        ):
            if wrong:
                raise ConfigError(message)

    def networks(self, start: int = 0) -> Iterator[Task]:
        """Yield the plan's networks from one number on, counted from 0."""
        first = FIRST_NETWORK + (self.seed * len(SPLITS) + SPLITS.index(self.split)) * BLOCK
        for number in range(start, BLOCK):
            kind = self.kinds[number % len(self.kinds)]
            yield Task(kind, first + number, float(self.duration), self.interactive)
        raise ConfigError(f"one seed has {BLOCK} networks for each split: make more stores instead")

    def settings(self) -> dict[str, Any]:
        """Return what is kept with the store: the arguments, and the versions that decide what they give."""
        own = {kind: sha256(Path(kind).read_bytes()).hexdigest() for kind in self.kinds if is_own(kind)}
        found = {**asdict(self), "kinds": list(self.kinds), **({"roads": own} if own else {})}
        return found | {"reader": "generate", "generator": VERSION, "sumo": sumo_version()}


class Preset(NamedTuple):
    """A standard set: its three plans, and the checksums of the stores they give."""

    plans: dict[Split, Plan]
    checksums: dict[Split, str]


MADE_WITH = "SUMO 1.28.0 on Linux, x86-64"
"""The simulator that gave the checksums of the standard sets: other versions or processors may give others."""


def _preset(counts: tuple[int, int, int], *checksums: str) -> Preset:
    plans = {split: Plan(count, split=split) for split, count in zip(SPLITS, counts, strict=True)}
    return Preset(plans, dict(zip(SPLITS, checksums, strict=True)))


# Both use seed 0, so the smaller set is the beginning of the larger one.
PRESETS: dict[str, Preset] = {
    "town-small": _preset(
        (2_000, 200, 500),
        "fc678848f95ed70b36191f6ae5ba8ac51747df4da5e2ee38f396f8ad8e87ae98",
        "33383d075ad99ffe68dffc191d76512f80ce9490d0cc4e503b5edf2c2a671ce0",
        "2a5b2abe4e4463a6b4b4efe18a799c30d9c1844ee58fa5e7528d9e57ff5b31ba",
    ),
    "town": _preset(
        (10_000, 200, 1_000),
        "9906f2832c2e670f91cff1f618e9031f54e5913095b225dc7d309fa73d4a22f0",
        "33383d075ad99ffe68dffc191d76512f80ce9490d0cc4e503b5edf2c2a671ce0",
        "6f32affb6a206b2a9c858ead75a8fd4aa2a37a63d85fe5168ed2a347d013e782",
    ),
}
"""The standard sets: towns with signals, all kinds of unsignalled control and roundabouts, 10 s, N_I = 2."""

PER_NETWORK = 8  # segments taken from one network
RECORDED = 90.0  # simulated seconds per network, for segments of 10 s
STRAIGHT = 5.0  # how many times likelier routes go straight on than they take one of the turns
TURN_INTEREST = 0.2  # what a turn adds to a vehicle's chance of being the ego (see ``CropRule``)
BARREN = 50  # networks in a row that may give nothing before the plan is given up


@dataclass(frozen=True)
class Harvest:
    """The yield of one network: the segments taken, how many there could have been, and why windows were left out.
    ``error`` says why it gave nothing at all, if it failed; ``seconds`` is the time it took on one core.
    """

    task: Task
    segments: list[RunSegment]
    accepted: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    error: str = ""


def harvest(task: Task) -> Harvest:
    """Make one network, simulate it, and take :data:`PER_NETWORK` segments from as many of its maps as there are."""
    begin = sum(os.times()[:4])  # of this process and the programs it ran, whatever else runs
    rule = replace(crop_rule(task.kind, task.duration, task.interactive), turn_interest=TURN_INTEREST)
    recorded = max(RECORDED, 5 * task.duration)
    try:
        every, reasons = generate_run(task.kind, task.seed, recorded, rule=rule, straight=STRAIGHT)
    except DataError as error:
        return Harvest(task, [], seconds=sum(os.times()[:4]) - begin, error=error.message)
    found = [exclusion(segment, task.interactive) for segment in every]
    reasons.update(f"{error.field}: excluded by the paper's limits" for _, error in filter(None, found))
    good = [segment for segment, excluded in zip(every, found, strict=True) if excluded is None]
    taken = _spread(good, PER_NETWORK, np.random.default_rng(task.seed))
    taken = [segment.replace(group=task.name) for segment in taken]
    return Harvest(task, taken, len(good), reasons, sum(os.times()[:4]) - begin)


def _spread(segments: list[RunSegment], count: int, rng: np.random.Generator) -> list[RunSegment]:
    """Return at most ``count`` of the segments, one from each map in turn, at random."""
    by_map: dict[int, list[RunSegment]] = {}
    for segment in segments:
        by_map.setdefault(id(segment.road), []).append(segment)
    groups = [[group[i] for i in rng.permutation(len(group))] for group in by_map.values()]
    first = rng.permutation(len(groups))
    turns = [(turn, first[k], each) for k, group in enumerate(groups) for turn, each in enumerate(group)]
    return [segment for *_, segment in sorted(turns, key=lambda entry: entry[:2])[:count]]


@dataclass
class Generation:
    """The progress of a plan, as kept in its store's report."""

    networks: int = 0  # simulated, all their segments written
    accepted: int = 0  # segments they gave, of which some were taken
    reasons: dict[str, int] = field(default_factory=dict)  # how many windows gave none, and why
    failed: dict[str, str] = field(default_factory=dict)  # networks that gave nothing, and why
    seconds: float = 0.0  # of one core spent on networks
    complete: bool = False  # all segments are there

    def add(self, found: Harvest, complete: bool) -> None:
        """Count one more network, and note whether it was the last."""
        self.networks, self.complete = self.networks + 1, complete
        self.accepted += found.accepted
        self.reasons = dict((Counter(self.reasons) + found.reasons).most_common())
        self.seconds = round(self.seconds + found.seconds, 3)
        if found.error:
            self.failed[found.task.name] = found.error


def generate(
    plan: Plan,
    out: str | Path,
    *,
    workers: int = 1,
    engine: Engine = "local",
    progress: Callable[[int, Generation], None] = lambda *_: None,
) -> Generation:
    """Carry out a plan, or continue one that was interrupted at any moment; a finished store is left as it is.

    The number of workers changes nothing in the store; for where they run, see :func:`symphony.parallel.ordered_map`.
    ``progress`` is told the segments in the store, and how far the plan is, after each network. Returns how the store
    was made, from its beginning.

    Raises:
        ConfigError: the store is being made with other arguments; names the first that differs.
        DataError: ``out`` holds something else, SUMO is missing, networks give no segments, or roads are damaged.
    """
    settings = plan.settings()
    if (Path(out) / HEADER).is_file() and (state := _begun(SegmentStore(out), settings)).complete:
        return state
    if (folder := Path(out).with_name(Path(out).name + PARTIAL)).is_dir():
        raise DataError(f"an unfinished conversion to that name lies in {folder}", file=Path(out))
    with StoreWriter(out, append=True) as writer:
        state = _begun(SegmentStore(out), settings)
        if state.complete:  # another run went on with it in between
            return state
        _report(writer, settings, state)
        barren = 0
        tasks = plan.networks(state.networks)
        with closing(ordered_map(harvest, tasks, workers=workers, engine=engine)) as found:
            for result in found:
                before = len(writer)
                for segment in result.segments:
                    # A network under way when a run was killed is made again: what exists of it is skipped.
                    if len(writer) < plan.segments and not writer.has(segment.segment_id):
                        writer.append(segment, tags={"kind": result.task.kind, "network": result.task.name})
                if result.error and is_own(result.task.kind) and state.networks < len(plan.kinds):
                    raise DataError(result.error, file=result.task.kind)
                state.add(result, len(writer) == plan.segments)
                _report(writer, settings, state)
                progress(len(writer), state)
                if state.complete:
                    break
                barren = 0 if len(writer) > before or result.segments else barren + 1
                if barren == BARREN:
                    why = [f"  {count} x {reason}" for reason, count in list(state.reasons.items())[:5]]
                    why += [f"  {name}: {message}" for name, message in list(state.failed.items())[-2:]]
                    text = f"{BARREN} networks in a row gave no segment; windows were left out because:"
                    raise DataError("\n".join([text, *why]), file=writer.path)
    return state


def _begun(store: SegmentStore, settings: Mapping[str, Any]) -> Generation:
    """Return where to continue, after checking that the store is of the same plan."""
    report = store.report
    if not len(store) and (not report or (report.get("generation") or {}).get("networks") == 0):
        return Generation()
    there = report.get("settings") or {}
    if "generation" not in report or there.get("reader") != "generate":
        message = "is a segment store that was not generated: refusing to write into it"
        raise DataError(message, file=store.path)
    for name, value in settings.items():
        made = there.get(name)
        if made != value:
            old, new = (",".join(map(str, v)) if isinstance(v, list) else v for v in (made, value))
            raise ConfigError(
                f"{store.path} was made with {name} {old}, not {new}: "
                "give the same arguments to continue it, or choose another folder"
            )
    found = report["generation"]
    return Generation(**{item.name: found[item.name] for item in fields(Generation) if item.name in found})


def _report(writer: StoreWriter, settings: Mapping[str, Any], state: Generation) -> None:
    counts = {"converted": len(writer), "files": state.networks}
    writer.write_report({**counts, "settings": settings, "generation": asdict(state)})
