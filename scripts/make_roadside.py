"""Copy a store and give its run segments parked cars and people beside the road.

    python scripts/make_roadside.py town-small/test --every 2 --parked 0.5 --pedestrians 10 --out lined-test

A segment that would have more than 250 agents is left out. The seed of a segment is the given one plus its number in
the store, so that the same command gives the same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from symphony.data.roadside import Roadside, add_roadside
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter

MOST = 250
"""Agents of a segment."""


def main() -> None:
    """Write the copy."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1, help="take one in so many")
    parser.add_argument("--parked", type=float, default=0.5, help="share of the places along kerbs")
    parser.add_argument("--pedestrians", type=int, default=10, help="at most, in each segment")
    parser.add_argument("--seed", type=int, default=100_000)
    given = parser.parse_args()
    store, roadside, kept = SegmentStore(given.store), Roadside(given.parked, given.pedestrians), 0
    with StoreWriter(given.out) as writer:
        for number in range(0, len(store), given.every):
            segment = add_roadside(store[number], roadside, given.seed + number)
            if segment.num_agents <= MOST:
                writer.append(segment)
                kept += 1
    print(f"{kept} run segments in {given.out}")


if __name__ == "__main__":
    main()
