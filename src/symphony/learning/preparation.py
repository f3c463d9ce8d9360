"""Demonstrations of a store that worker processes make in advance, where training finds them."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path

from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.errors import DataError
from symphony.learning.demonstrations import SceneDataset
from symphony.parallel import Engine, ordered_map

TOGETHER = 16  # run segments of a task, which are fitted together


def prepare(
    path: Path,
    dynamics: Bicycle | Displacement,
    *,
    routes: bool = False,
    duration: int = 0,
    workers: int = 1,
    engine: Engine = "local",
) -> Iterator[tuple[int, int]]:
    """Fit the vehicles of all run segments of a store, and keep the result with the store. Existing files are left as
    they are; the files do not depend on the workers.

    Args:
        path: the folder of the store.
        dynamics: the action space.
        routes: whether their routes are found, too.
        duration: seconds of each run segment that are used; 0 for all.
        workers: number of processes.
        engine: the engine that runs them.

    Yields:
        Run segments done, and their total.

    Raises:
        DataError: for a store in which nothing can be kept, or a segment that can't be used.
    """
    store = SegmentStore(path)
    data = SceneDataset(store, dynamics=dynamics, routes=routes, duration=duration)
    if not data.kept.writable:
        raise DataError("can't keep demonstrations there", file=store.path / "experts")
    missing = [i for i in range(len(data)) if data.kept.load(store.content(i)) is None]
    yield len(data) - len(missing), len(data)
    sent, done = pickle.dumps(data), len(data) - len(missing)
    tasks = ((sent, missing[first : first + TOGETHER]) for first in range(0, len(missing), TOGETHER))
    with closing(ordered_map(_prepared, tasks, workers=workers, engine=engine)) as results:
        for count in results:
            done += count
            yield done, len(data)


@lru_cache(1)
def _opened(sent: bytes) -> SceneDataset:
    data: SceneDataset = pickle.loads(sent)  # noqa: S301  (from our own parent)
    return data


def _prepared(task: tuple[bytes, list[int]]) -> int:
    """Prepare some run segments, none of which stays in memory."""
    data, items = _opened(task[0]), task[1]
    data.fit(items)
    if not data.kept.writable:
        raise DataError("can't keep demonstrations there", file=data.store.path / "experts")
    return len(items)
