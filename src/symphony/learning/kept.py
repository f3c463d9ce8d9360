"""Prepared run segments held in memory, as many as there is room for, and demonstrations kept with their store."""

from __future__ import annotations

import hashlib
import io
import os
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import torch

import symphony
from symphony.data.npz import read_npz
from symphony.envs.routes import RouteTable
from symphony.errors import DataError, DataWarning
from symphony.files import replacing
from symphony.learning.experts import Experts

T = TypeVar("T")

SHARE = 0.125
"""Part of the machine's memory that one cache may take; a data set has two."""
VERSION = 3
"""Version of the fit: raised when it gives other numbers or routes for the same segment (a test says when)."""
PACKAGE = Path(symphony.__file__).parent
_TENSORS = ("agent", "states", "actions", "valid", "error", "progress")


def room() -> int:
    """Bytes a cache may hold; processes of one training share the machine."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return int(SHARE * total) // max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


class ItemCache(Generic[T]):
    """A cache of values made from items when first asked for, several at a time; those used longest ago go first.

    Warns once when items asked for have to go although fewer than ``keep`` are held.

    Args:
        make: gives the values of some items, in their order.
        size: gives the bytes of a value.
        keep: items held at most; None for no bound.
        limit: bytes held at most, beyond what was asked for last; :func:`room` by default.
        name: of what is held, for the warning.

    Attributes:
        kept: what is held, with its bytes, by item.
    """

    def __init__(
        self,
        make: Callable[[Sequence[int]], list[T]],
        size: Callable[[T], int],
        *,
        keep: int | None = None,
        limit: int | None = None,
        name: str = "items",
    ) -> None:
        self.make, self.size, self.keep, self.name = make, size, keep, name
        self.limit = room() if limit is None else limit
        self.kept: OrderedDict[int, tuple[T, int]] = OrderedDict()
        self._held, self._warned = 0, False

    def __call__(self, item: int) -> T:
        """The value of one item."""
        return self.many([item])[0]

    def many(self, items: Sequence[int]) -> list[T]:
        """The values of several items, in their order."""
        missing = [item for item in dict.fromkeys(items) if item not in self.kept]
        for item, value in zip(missing, self.make(missing) if missing else [], strict=True):
            self.kept[item] = value, self.size(value)
            self._held += self.kept[item][1]
        found = [self.kept[item][0] for item in items]
        for item in items:
            self.kept.move_to_end(item)
        while self.keep is not None and len(self.kept) > self.keep:
            self._held -= self.kept.popitem(last=False)[1][1]
        while self._held > self.limit and len(self.kept) > 1:
            if not self._warned:
                self._warned = True
                warnings.warn(
                    f"{self.name} take more than {self.limit / 2**30:.2g} GiB of memory: {len(self.kept)} are kept, "
                    "others are prepared anew each time they are drawn",
                    DataWarning,
                    stacklevel=2,
                )
            self._held -= self.kept.popitem(last=False)[1][1]
        return found


class KeptExperts:
    """Demonstrations kept in a folder of their store, so that a segment is fitted once and not once a run.

    Files of arrays, nothing pickled, are named after all that they depend on. They are a cache: one that is missing
    or damaged is made anew, and where the folder can't be written or belongs to the package, nothing is kept.

    Args:
        store: the store's folder.
        settings: what the fit depends on beside the segment's content.
    """

    def __init__(self, store: Path, settings: str) -> None:
        self.settings = settings
        self.folder: Path | None = None if PACKAGE in store.resolve().parents else store / "experts"
        try:
            if self.folder is not None:
                self.folder.mkdir(exist_ok=True)
        except OSError:
            self.folder = None

    def _path(self, content: str) -> Path | None:
        key = hashlib.sha256(f"{VERSION} {content} {self.settings}".encode()).hexdigest()
        return None if self.folder is None else self.folder / f"{key[:32]}.npz"

    def load(self, content: str) -> Experts | None:
        """The demonstrations of the segment with this hash; None where there are none that can be read."""
        path = self._path(content)
        if path is None or not path.is_file():
            return None
        try:
            arrays = read_npz(path)
            ends = arrays["route_number"].cumsum()
            # Points of the routes of each agent end where those of its last route do.
            point_ends = np.append(0, arrays["route_count"].cumsum())[np.append(0, ends)]
            tables = tuple(
                RouteTable(
                    arrays["route_points"][point_ends[k] : point_ends[k + 1]],
                    arrays["route_count"][end - count : end],
                    arrays["route_right"][end - count : end],
                    int(arrays["route_logged"][k]),
                )
                for k, (end, count) in enumerate(zip(ends, arrays["route_number"], strict=True))
            )
            return Experts(**{name: torch.from_numpy(arrays[name]) for name in _TENSORS}, routes=tables)
        except (DataError, OSError, ValueError, KeyError, IndexError):
            return None

    def save(self, content: str, experts: Experts) -> None:
        """Keep the demonstrations of a segment, if the folder can be written and the disk has room."""
        path, routes = self._path(content), experts.routes
        if path is None or not os.access(path.parent, os.W_OK):
            return
        arrays = {name: getattr(experts, name).numpy() for name in _TENSORS} | {
            "route_number": np.array([len(table.count) for table in routes], np.int64),
            "route_points": np.concatenate([np.zeros((0, 2), np.float32), *(t.points for t in routes)]),
            "route_count": np.concatenate([np.zeros(0, np.int64), *(t.count for t in routes)]),
            "route_right": np.concatenate([np.zeros(0, np.bool_), *(t.right for t in routes)]),
            "route_logged": np.array([table.logged for table in routes], np.int64),
        }
        try:
            with replacing(path) as draft, zipfile.ZipFile(draft, "w") as file:
                for name, array in arrays.items():
                    part = io.BytesIO()
                    np.save(part, array)
                    # Of no date, so that equal arrays are equal files.
                    file.writestr(zipfile.ZipInfo(f"{name}.npy"), part.getvalue())
        except OSError:
            self.folder = None
