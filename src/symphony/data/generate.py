"""Simulated run segments in any number: the generator, which can be killed and resumed.

A plan is a list of road networks, each with a seed of its own, from each of which a few segments are taken; many
networks with few segments each give the most variety. Networks are made by any number of processes and written in
the order of the plan, so a store depends on the plan alone.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from symphony.data import store_format
from symphony.data.plans import Plan, Task
from symphony.data.segment import RunSegment
from symphony.data.selection import usable
from symphony.data.sources.sumo import crop_rule, generate_run
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.parallel import Engine, ordered_map

_BEFORE = {"parked": 0.0, "pedestrians": 0}
"""What settings that are gone must have been in a store that is continued."""
PER_NETWORK = 8
"""Segments taken from one network."""
RECORDED = 90.0
"""Simulated seconds per network, for segments of 10 s."""
STRAIGHT = 5.0
"""How many times likelier routes go straight on than they take one of the turns; walks without a preference would
turn far more often than people do."""
TURN_INTEREST = 0.2
"""What a turn adds to a vehicle's chance of being the ego (see ``CropRule``)."""
BARREN = 50
"""Networks in a row that may give nothing before the plan is given up."""


@dataclass(frozen=True)
class Harvest:
    """What one network gave: the segments taken, how many could have been, and why windows were left out.

    ``error`` is why it gave nothing at all, if it failed; ``seconds`` of one core is what it took.
    """

    task: Task
    segments: list[RunSegment]
    accepted: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    error: str = ""


def harvest(task: Task) -> Harvest:
    """Make one network, simulate it, and take :data:`PER_NETWORK` segments from as many of its maps as there are."""
    begin = _cpu_seconds()
    rule = replace(crop_rule(task.kind, task.duration, task.interactive), turn_interest=TURN_INTEREST)
    recorded = max(RECORDED, 5 * task.duration)
    try:
        run = generate_run(task.kind, task.seed, recorded, rule=rule, straight=STRAIGHT)
    except DataError as error:
        return Harvest(task, [], seconds=_cpu_seconds() - begin, error=error.message)
    good = []
    for segment in run.segments:
        try:
            usable(segment, task.interactive)
            good.append(segment)
        except DataError as error:
            run.reasons[f"{error.field}: excluded by the paper's limits"] += 1
    taken = _spread(good, PER_NETWORK, np.random.default_rng(task.seed))
    taken = [segment.replace(group=task.name) for segment in taken]
    return Harvest(task, taken, len(good), run.reasons, _cpu_seconds() - begin)


def _cpu_seconds() -> float:
    """Seconds of this process and the programs it ran: unlike the clock, they don't depend on who else is there."""
    # Windows does not know its children's.
    return sum(os.times()[:4]) if os.name == "posix" else time.perf_counter()


def _spread(segments: list[RunSegment], count: int, rng: np.random.Generator) -> list[RunSegment]:
    """At most ``count`` of the segments, each map giving one in turn, at random."""
    by_map: dict[int, list[RunSegment]] = {}
    for segment in segments:
        by_map.setdefault(id(segment.road), []).append(segment)
    groups = [[group[i] for i in rng.permutation(len(group))] for group in by_map.values()]
    first = rng.permutation(len(groups))
    turns = [
        (turn, first[k], segment) for k, group in enumerate(groups) for turn, segment in enumerate(group)
    ]
    return [segment for *_, segment in sorted(turns, key=lambda entry: entry[:2])[:count]]


@dataclass
class Generation:
    """How far a plan is, as kept in its store's report.

    Attributes:
        networks: simulated, all their segments written.
        accepted: segments they gave, of which some were taken.
        reasons: how many windows gave none, and why.
        failed: networks that gave nothing, and why.
        seconds: of one core spent on networks.
        complete: all segments are there.
    """

    networks: int = 0
    accepted: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    complete: bool = False

    def add(self, found: Harvest) -> None:
        """Count one more network."""
        self.networks += 1
        self.accepted += found.accepted
        self.reasons = dict((Counter(self.reasons) + found.reasons).most_common())
        self.seconds = round(self.seconds + found.seconds, 3)
        if found.error:
            self.failed[found.task.name] = found.error


Progress = Callable[[int, Generation], None]
"""Called with the segments in the store, and how far the plan is, after each network."""


def generate(
    plan: Plan,
    out: str | Path,
    *,
    workers: int = 1,
    engine: Engine = "local",
    progress: Progress | None = None,
) -> Generation:
    """Carry out a plan, or continue one that was interrupted at any moment; a finished store is left as it is.

    The number of workers changes nothing in the store; for where they are, see :func:`symphony.parallel.ordered_map`.
    Returns how the store was made, from its beginning.

    Raises:
        ConfigError: the store is being made with other arguments; names the first that differs.
        DataError: ``out`` holds something else, SUMO is not installed, or the networks give no segments.
    """
    settings = plan.settings()
    if (Path(out) / store_format.HEADER).is_file():
        state = _begun(SegmentStore(out), settings)
        if state.complete:
            return state
    with StoreWriter(out, append=True) as writer:
        # Read once more under the lock: another run may have gone on in between.
        state = _begun(SegmentStore(out), settings)
        if state.complete:
            return state
        _report(writer, settings, state)
        barren = 0
        tasks = plan.networks(state.networks)
        with closing(ordered_map(harvest, tasks, workers=workers, engine=engine)) as found:
            for result in found:
                before = len(writer)
                for segment in result.segments:
                    # A network under way when a run was killed is made anew: what is there of it is skipped.
                    if len(writer) < plan.segments and not writer.has(segment.segment_id):
                        tags = {"kind": result.task.kind, "network": result.task.name}
                        writer.append(segment, tags=tags)
                state.add(result)
                state.complete = len(writer) == plan.segments
                _report(writer, settings, state)
                if progress is not None:
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
    """Where to continue, after a look at whether this is the store of the same plan."""
    report = store.report
    if not report and not len(store):
        return Generation()
    there = report.get("settings") or {}
    if "generation" not in report or there.get("reader") != "generate":
        message = "is a segment store that was not generated: refusing to write into it"
        raise DataError(message, file=store.path)
    for name, value in {**_BEFORE, **settings}.items():
        made = there.get(name, _BEFORE.get(name))
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


def add_to_report(path: str | Path, name: str, value: Any) -> None:
    """Keep something more in the report of a store."""
    store = SegmentStore(path)
    with StoreWriter(path, append=True) as writer:
        writer.write_report({**store.report, name: value})
