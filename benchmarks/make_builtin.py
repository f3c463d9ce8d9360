"""Make the built-in data set with SUMO: ``python benchmarks/make_builtin.py``.

Writes ``src/symphony/data/builtin/train`` and ``.../test`` again and prints what is in them. The two share no road
network: each network has a seed of its own. Needs the extra ``symphony-traffic[sumo]``.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from symphony.data.builtin import builtin_store
from symphony.data.segment import RunSegment
from symphony.data.selection import interactive_agents
from symphony.data.sources.sumo import generate_run
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs.routes import route_table
from symphony.evaluation.logs import measure
from symphony.roadgraph import LaneGraph, route_errors

SplitName = Literal["train", "test"]
DURATION = 150.0
MAPS = 2
"""Maps taken from each network."""


@dataclass(frozen=True)
class Split:
    """The contents of one of the two stores."""

    segments: int
    networks: tuple[tuple[str, int], ...]


# Seeds of the small test set were picked so that every kind of control is in it.
SPLITS: dict[SplitName, Split] = {
    "train": Split(
        64,
        (
            *(("town", seed) for seed in range(12)),
            *(("grid", seed) for seed in range(5)),
            *(("ramp", seed) for seed in range(3)),
        ),
    ),
    "test": Split(
        24,
        (
            *(("town", seed) for seed in (1000, 1001, 1002, 1003, 1005, 1007)),
            *(("grid", seed) for seed in (1001, 1003)),
            ("ramp", 1000),
        ),
    ),
}


def choose(segments: list[RunSegment], count: int, rng: np.random.Generator) -> list[RunSegment]:
    """Return some of a network's segments, spread evenly over :data:`MAPS` of its maps."""
    by_map: dict[int, list[RunSegment]] = {}
    for segment in segments:
        by_map.setdefault(id(segment.road), []).append(segment)
    share = -(-count // MAPS)
    groups = list(by_map.values())
    # In random order, maps with enough segments first.
    groups = sorted((groups[k] for k in rng.permutation(len(groups))), key=lambda group: len(group) < share)
    chosen: list[RunSegment] = []
    for group in groups[:MAPS]:
        take = min(share, count - len(chosen))
        chosen += [group[i] for i in sorted(rng.permutation(len(group))[:take])]
    return chosen


def make(name: SplitName, split: Split) -> tuple[int, Counter[str], float]:
    """Write one store; returns how many segments were accepted, why others were not, and the seconds taken."""
    path = builtin_store(name)
    shutil.rmtree(path, ignore_errors=True)
    accepted, reasons, seconds = 0, Counter[str](), 0.0
    with StoreWriter(path) as writer:
        for k, (kind, seed) in enumerate(split.networks):
            begin = time.perf_counter()
            found, why = generate_run(kind, seed, DURATION)
            seconds += time.perf_counter() - begin
            accepted += len(found)
            reasons += why
            count = -(-(split.segments - len(writer)) // (len(split.networks) - k))
            for segment in choose(found, count, np.random.default_rng(seed)):
                writer.append(segment, tags={"kind": kind, "network": f"{kind}-{seed}"})
    return accepted, reasons, seconds


def describe(store: SegmentStore) -> dict[str, Any]:
    """Return the quality of the logged driving, and how far paths of egos and partners are from a feasible route."""
    errors = [e for segment in store for e in _route_errors(segment, interactive_agents(segment, 2))]
    return {
        **measure(store),
        "distance to the best feasible route, mean / largest (m)": f"{np.mean(errors):.2f} / {np.max(errors):.2f}",
    }


def _route_errors(segment: RunSegment, pair: NDArray[np.int64]) -> list[float]:
    """Return the metres between each logged path and the feasible route that fits it best."""
    graph = LaneGraph(segment.road)
    errors = []
    for agent in pair:
        path, table = segment.position[agent, :, :2][segment.valid[agent]], route_table(segment, graph, agent)
        lines = [table.line(route) for route in range(len(table.count))]
        errors.append(float(route_errors(lines, path).min()) if lines else np.inf)
    return errors


def main() -> None:
    """Make both stores, or only describe existing ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--describe", action="store_true", help="only print what the stores hold")
    only_describe = parser.parse_args().describe
    total = 0
    for name, split in SPLITS.items():
        print(f"{name}:")
        if not only_describe:
            accepted, reasons, seconds = make(name, split)
            print(f"  accepted {accepted} segments in {seconds:.0f} s: {accepted / seconds * 60:.0f} per minute")
            print(f"  windows left out: {dict(reasons.most_common())}")
        store = SegmentStore(builtin_store(name))
        total += sum(file.stat().st_size for file in Path(store.path).rglob("*") if file.is_file())
        summary = store.summary() | {"checksum": store.checksum()} | describe(store)
        print("\n".join(f"  {key}: {value}" for key, value in summary.items()))
    print(f"{total / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
