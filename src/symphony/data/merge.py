"""Several stores as one, such as simulated towns and real freeways to learn from together."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from symphony.data import store_format
from symphony.data.convert import folder_of, read_job
from symphony.data.report import Report
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError


def merge(
    paths: Sequence[Path], out: Path, progress: Callable[[int, int], None] | None = None
) -> SegmentStore:
    """Copy all segments of some stores, in their order, into a new one, which appears once it is complete.

    Its report joins theirs. ``progress`` is told how many segments are done, of how many.

    Raises:
        DataError: ``out`` exists or is being made, a segment is in two stores, the generation of one is not
            finished, or stores differ in their time step; names the store.
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
    if read_job(folder_of(out)) is not None:
        raise DataError(f"an unfinished conversion to that name lies in {folder_of(out)}", file=out)
    draft = out.with_name(f"{out.name}.merging")
    if (draft / store_format.HEADER).is_file():  # of a merge that was killed, or goes on, which is told
        with store_format.lock(draft):
            shutil.rmtree(draft)
    total, done = sum(map(len, stores)), 0
    with StoreWriter(draft) as writer:
        report = Report()
        for store in stores:
            report = Report.from_json(store.report).after(report)
            for index in range(len(store)):
                writer.copy(store, index)
                done += 1
                if progress is not None:
                    progress(done, total)
        report = replace(report, converted=total, settings={"merged": [store.path.name for store in stores]})
        writer.write_report(report.to_json())
    draft.rename(out)
    return SegmentStore(out)
