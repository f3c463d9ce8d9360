"""Copy a share of a store's run segments without speed limits: python benchmarks/hide_limits.py STORE OUT SHARE

An unknown limit is observed as 0. Agents that met it in real logs alone take it for a sign to drive slowly; with such
copies among simulated segments they learn to tell the speed of a road from its traffic.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from symphony import SegmentStore
from symphony.data.store_writer import StoreWriter

SUFFIX = "-nolimit"  # of the ids of the copies


def hide(store: SegmentStore, out: Path, share: float, seed: int = 0) -> SegmentStore:
    """Write copies of some segments, drawn one by one, and return their store."""
    rng = np.random.default_rng(seed)
    with StoreWriter(out) as writer:
        for number in range(len(store)):
            if rng.random() < share:
                segment = store[number]
                road = replace(segment.road, speed_limit=np.full_like(segment.road.speed_limit, np.nan))
                name = segment.segment_id + SUFFIX
                writer.append(segment.replace(segment_id=name, road=road), tags=store.tags(number))
    return SegmentStore(out)


def main() -> None:
    """Write the copies and say how many there are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("share", type=float, help="above 0, at most 1")
    given = parser.parse_args()
    if not 0 < given.share <= 1:
        parser.error(f"a share is above 0 and at most 1, not {given.share}")
    found = hide(SegmentStore(given.store), given.out, given.share)
    print(f"{len(found)} segments in {found.path}")


if __name__ == "__main__":
    main()
