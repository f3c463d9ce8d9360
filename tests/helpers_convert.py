"""A log format of one word per record, to convert from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from helpers_segments import crossing, straight_road
from symphony.data.segment import RunSegment
from symphony.data.sources.base import Item, Reader
from symphony.errors import DataError


class FakeReader(Reader):
    """Each line of a file names a scene: ``straight 3``, ``crossing 5``, ``lonely 1``, ``broken``, ``stop``."""

    name = "fake"
    patterns = ("*.scene", "*.scene-*-of-*")
    _stops = True

    def _read(self, path: Path) -> Iterator[Item]:
        for line in path.read_text().splitlines():
            kind, _, seed = line.partition(" ")
            if kind == "broken":
                yield DataError("13 is not 7", segment=f"bad-{seed}", field="tracks")
            elif kind == "stop":
                raise DataError("checksum of record 4 does not match")
            elif kind == "interrupt":
                if self._stops:
                    raise KeyboardInterrupt
            else:
                yield scene(kind, int(seed)).replace(file=path.name)


def scene(kind: str, seed: int) -> RunSegment:
    if kind == "crossing":
        return crossing(seed=seed, dt=0.1, steps=91, source="other")
    cars = 1 if kind == "lonely" else 3
    return straight_road(cars, seed=seed, dt=0.1, steps=91, segment_id=f"{kind}-{seed}")
