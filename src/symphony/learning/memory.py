"""Prepared run segments held in memory, as many as there is room for."""

from __future__ import annotations

import os
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from symphony.errors import DataWarning

T = TypeVar("T")

SHARE = 0.125
"""Of the machine's memory that one cache may take; a data set has two."""
UNKNOWN = 8 << 30
"""Bytes a machine is taken to have that does not say."""


def room() -> int:
    """Bytes a cache may hold; processes of one training share the machine."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        total = UNKNOWN
    beside = os.environ.get("LOCAL_WORLD_SIZE", "1")
    return int(SHARE * total) // max(1, int(beside) if beside.isdigit() else 1)


class ItemCache(Generic[T]):
    """What is made of items, made when first asked for, several at a time; those used longest ago go first.

    Warns once when items asked for have to go although fewer than ``keep`` are held.

    Args:
        make: what belongs to some items, in their order.
        size: bytes of one.
        keep: items held at most; None for no bound.
        limit: bytes held at most, beyond what was asked for last; :func:`room` by default.
        name: of what is held, for the warning.
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
        self.held = 0
        self._kept: OrderedDict[int, tuple[T, int]] = OrderedDict()
        self._warned = False

    def __len__(self) -> int:
        return len(self._kept)

    def __contains__(self, item: int) -> bool:
        return item in self._kept

    def __call__(self, item: int) -> T:
        """What belongs to one item."""
        return self.many([item])[0]

    def many(self, items: Sequence[int]) -> list[T]:
        """What belongs to several items, in their order."""
        missing = [item for item in dict.fromkeys(items) if item not in self._kept]
        made = dict(zip(missing, self.make(missing), strict=True)) if missing else {}
        found = [made[item] if item in made else self._kept[item][0] for item in items]
        for item, value in made.items():
            self._kept[item] = value, self.size(value)
            self.held += self._kept[item][1]
        for item in items:
            self._kept.move_to_end(item)
        most = len(self._kept) if self.keep is None else self.keep
        while len(self._kept) > most:
            self._forget()
        while self.held > self.limit and len(self._kept) > 1:
            if not self._warned:
                self._warned = True
                warnings.warn(
                    f"{self.name} take more than {self.limit / 2**30:.2g} GiB of memory: {len(self._kept)} are kept, "
                    "others are prepared anew each time they are drawn",
                    DataWarning,
                    stacklevel=2,
                )
            self._forget()
        return found

    def _forget(self) -> None:
        _, (_, size) = self._kept.popitem(last=False)
        self.held -= size
