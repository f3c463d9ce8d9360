"""Several stores as one, such as simulated towns and real freeways to learn from together."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError


def merge(
    paths: Sequence[Path], out: Path, progress: Callable[[int, int], None] | None = None
) -> SegmentStore:
    """Copy all segments of some stores, in their order, into a new one, which appears once it is complete.

    Args:
        paths: the stores.
        out: folder of the new store; must not exist.
        progress: told how many segments are done, of how many.

    Raises:
        DataError: ``out`` exists, a segment is in two stores, the generation of one is not finished, or stores differ
            in their time step; names the store.
    """
    if out.exists():
        raise DataError("exists already; choose another folder", file=out)
    stores = [SegmentStore(path) for path in paths]
    for store in stores:
        store.check_complete()
    steps = {float(dt) for store in stores for dt in store.time_steps}
    if len(steps) > 1:
        listed = ", ".join(f"{dt:g} s" for dt in sorted(steps))
        raise DataError(f"stores with different time steps don't go together: {listed}", file=paths[0])
    draft = out.with_name(f"{out.name}.partial")
    if draft.exists():  # of a merge that was killed
        shutil.rmtree(draft)
    total, done = sum(map(len, stores)), 0
    with StoreWriter(draft) as writer:
        for store in stores:
            for index in range(len(store)):
                writer.copy(store, index)
                done += 1
                if progress is not None:
                    progress(done, total)
    draft.rename(out)
    return SegmentStore(out)
