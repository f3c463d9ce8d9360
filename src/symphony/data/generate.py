"""Simulated run segments in any number: the generator, which can be killed and resumed.

A plan is a list of road networks, each with a seed of its own, from each of which a few segments are taken; many
networks with few segments each give the most variety. Networks are made by any number of processes and written in
the order of the plan, so a store depends on the plan alone.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
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
    """What one network gave.

    Attributes:
        task: the network.
        segments: those taken.
        accepted: how many could have been.
        reasons: how many windows were left out, and why.
        seconds: of one core that it took.
        error: why the network gave nothing at all, if it failed.
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
    """Of this process and the programs it ran: unlike the clock, it doesn't depend on who else uses the cores."""
    spent = os.times()
    # Windows does not know its children's.
    return sum(spent[:4]) if os.name == "posix" else time.perf_counter()


def _spread(segments: list[RunSegment], count: int, rng: np.random.Generator) -> list[RunSegment]:
    """At most ``count`` of the segments, each map giving one in turn, at random."""
    by_map: dict[int, list[RunSegment]] = {}
    for segment in segments:
        by_map.setdefault(id(segment.road), []).append(segment)
    groups = list(by_map.values())
    turns = [
        (turn, k, group[i]) for k, group in enumerate(groups) for turn, i in enumerate(_shuffled(group, rng))
    ]
    first = rng.permutation(len(groups))
    turns.sort(key=lambda entry: (entry[0], first[entry[1]]))
    return [segment for _, _, segment in turns[:count]]


def _shuffled(items: list[Any], rng: np.random.Generator) -> list[int]:
    return rng.permutation(len(items)).tolist()


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

    Args:
        plan: what to make.
        out: directory of the store.
        workers: processes; their number changes nothing in the store.
        engine: where they are, see :func:`symphony.parallel.ordered_map`.
        progress: told how far it is.

    Returns:
        How the store was made, from its beginning.

    Raises:
        ConfigError: the store is being made with other arguments; names the first that differs.
        DataError: ``out`` holds something else, SUMO is not installed, or the networks give no segments.
    """
    settings = plan.settings()
    if (Path(out) / store_format.HEADER).is_file():
        state = _begin(SegmentStore(out), settings)
        if state.complete:
            return state
    with StoreWriter(out, append=True) as writer:
        # Read once more under the lock: another run may have gone on in between.
        state = _begin(SegmentStore(out), settings)
        if state.complete:
            return state
        _report(writer, settings, state)
        barren = 0
        with _closing(
            ordered_map(harvest, plan.networks(state.networks), workers=workers, engine=engine)
        ) as found:
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
                barren = 0 if len(writer) > before or result.segments else barren + 1
                if state.complete:
                    break
                if barren == BARREN:
                    raise DataError(_in_vain(state), file=writer.path)
    return state


def _begin(store: SegmentStore, settings: Mapping[str, Any]) -> Generation:
    """Where to continue, after a look at whether this is the store of the same plan."""
    report = store.report
    if not report and not len(store):
        return Generation()
    there = report.get("settings")
    there = there if isinstance(there, dict) else {}
    if "generation" not in report or there.get("reader") != "generate":
        raise DataError(
            "is a segment store that was not generated: refusing to write into it", file=store.path
        )
    for name, value in {**_BEFORE, **settings}.items():
        made = there.get(name, _BEFORE.get(name))
        if made != value:
            raise ConfigError(
                f"{store.path} was made with {name} {_plain(made)}, not {_plain(value)}: "
                "give the same arguments to continue it, or choose another folder"
            )
    found, state = report["generation"], Generation()
    for name, value in vars(state).items():
        kind = (int, float) if isinstance(value, float) else type(value)
        if not isinstance(found, dict) or not isinstance(found.get(name, value), kind):
            raise DataError("not how far a generation is", file=store.path / store_format.REPORT, field=name)
    return Generation(**{name: found[name] for name in vars(state) if name in found})


def _plain(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


def _report(writer: StoreWriter, settings: Mapping[str, Any], state: Generation) -> None:
    writer.write_report(
        {
            "converted": len(writer),
            "files": state.networks,
            "settings": settings,
            "generation": asdict(state),
        }
    )


def _in_vain(state: Generation) -> str:
    why = [f"  {count} x {reason}" for reason, count in list(state.reasons.items())[:5]]
    why += [f"  {name}: {message}" for name, message in list(state.failed.items())[-2:]]
    return "\n".join([f"{BARREN} networks in a row gave no segment; windows were left out because:", *why])


@contextlib.contextmanager
def _closing(results: Iterable[Harvest]) -> Iterator[Iterable[Harvest]]:
    try:
        yield results
    finally:
        close = getattr(results, "close", None)
        if close is not None:
            close()


def add_to_report(path: str | Path, name: str, value: Any) -> None:
    """Keep something more in the report of a store."""
    store = SegmentStore(path)
    with StoreWriter(path, append=True) as writer:
        writer.write_report({**store.report, name: value})
