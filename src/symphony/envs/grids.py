"""The grids of the maps in use, kept from batch to batch: made once a map has been asked often enough to repay it.

Scenes on one map share a grid. Whether there is one changes how fast an answer comes, never the answer.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial
from threading import Lock
from typing import Any

import torch
from numpy.typing import NDArray

from symphony.geometry.cells import Cells
from symphony.geometry.grid import CellGrid, edge_grid, point_grid

Arrays = tuple[NDArray[Any], ...]

POINT_QUERIES = 1000
"""Queries of nearest points on one map that cost about as much as its grid."""
EDGE_QUERIES = 500
"""Queries of distances to the edge of the road likewise."""
CALL = 25
"""Queries that cost as much as it costs to ask at all, without a grid."""
MEMORY = 256 * 2**20
"""Bytes of grids that are kept; those used longest ago go first."""


MAPS = 10_000
"""Maps that are remembered at all, with or without a grid."""


class _Kept:
    """What is known of a map: how often it was asked for, and its grid once there is one."""

    def __init__(self) -> None:
        self.asked, self.made = 0.0, False
        self.grid: CellGrid | None = None


class GridCache:
    """Grids by the content of their maps.

    Args:
        memory: bytes of grids that are kept.
    """

    def __init__(self, memory: int = MEMORY) -> None:
        self.memory, self.used = memory, 0
        self._kept: OrderedDict[bytes, _Kept] = OrderedDict()
        self._lock = Lock()

    def get(
        self, content: Arrays, kind: str, asked: float, worth: float, make: Callable[..., CellGrid | None]
    ) -> CellGrid | None:
        """The grid of a map, None if it has none or was not yet asked for ``worth`` times.

        Args:
            content: what the grid is made of.
            kind: of grid, with its settings.
            asked: queries that come now.
            worth: queries from which on it is made.
            make: called with the content.
        """
        digest = hashlib.blake2b(kind.encode(), digest_size=16)
        for part in content:
            digest.update(part.tobytes())
        with self._lock:
            kept = self._kept.setdefault(digest.digest(), _Kept())
            self._kept.move_to_end(digest.digest())
            kept.asked += asked
            if not kept.made and kept.asked >= worth:
                kept.grid, kept.made = make(*content), True
                self.used += _size(kept)
            while (self.used > self.memory and len(self._kept) > 1) or len(self._kept) > MAPS:
                _, oldest = self._kept.popitem(last=False)
                self.used -= _size(oldest)
            return kept.grid

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy of whatever holds it, here or in another process, uses the cache of its process.
        return _cache_of_the_process, ()


def _size(kept: _Kept) -> int:
    return 0 if kept.grid is None else kept.grid.nbytes


CACHE = GridCache()


def _cache_of_the_process() -> GridCache:
    return CACHE


class GridSource:
    """The grids of one batch of maps, all of them asked for alike.

    Args:
        maps: content of each map; None where it can have no grid.
        kind: of grid, with its settings.
        worth: queries per map from which on its grid is made.
        make: of the content.
        stride: elements per map, padding included.
        cache: where grids are kept.
    """

    def __init__(
        self,
        maps: Sequence[Arrays | None],
        kind: str,
        worth: float,
        make: Callable[..., CellGrid | None],
        stride: int,
        cache: GridCache | None = None,
    ) -> None:
        self.maps, self.kind, self.worth, self.make, self.stride = maps, kind, worth, make, stride
        self.cache = CACHE if cache is None else cache
        self.asked, self.complete = 0.0, False
        self.cells: Cells | None = None

    @classmethod
    def points(cls, maps: Sequence[Arrays | None], count: int, stride: int) -> GridSource:
        """Lists of points for the ``count`` nearest; content: points [P, 2]."""
        return cls(maps, f"points {count}", POINT_QUERIES, partial(point_grid, count=count), stride)

    @classmethod
    def edges(cls, maps: Sequence[Arrays | None], stride: int) -> GridSource:
        """Lists of edges; content: start, end, previous, following."""
        return cls(maps, "edges", EDGE_QUERIES, edge_grid, stride)

    def __call__(self, queries: int) -> Cells | None:
        """The grids there are, given that so many queries follow; None if there are none."""
        if self.complete:
            return self.cells
        if torch.is_grad_enabled():
            # What is simulated once more in the backward pass must take the same way as the first time.
            queries = max(queries, int(self.worth * max(len(self.maps), 1)) + 1)
        queries = max(queries, CALL)
        fresh, self.asked = self.asked == 0, self.asked + queries / max(len(self.maps), 1)
        # The cache is looked into at first and when every map is sure to have been asked often enough.
        if fresh or self.asked >= self.worth:
            self.complete = self.asked >= self.worth
            grids = [
                None
                if content is None
                else self.cache.get(content, self.kind, self.asked, self.worth, self.make)
                for content in self.maps
            ]
            some = any(grid is not None for grid in grids)
            self.cells = Cells(grids, self.stride) if some else None
        return self.cells
