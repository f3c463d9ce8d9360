"""The conformance checks: every reader passes, and each check fails on a reader that breaks its promise."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_segments import crossing, hide, straight_road, turned
from helpers_sources import ROAD, commonroad, driver, womd_scenario, write_records
from symphony.data.conformance import Conformance, ConformanceError, check_reader, check_segments
from symphony.data.segment import AgentType, Polylines, RunSegment
from symphony.data.sources import get_reader
from symphony.data.sources.base import Item, Reader
from symphony.errors import DataError

needs_pyarrow = pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None,
    reason="pyarrow is not installed (pip install 'symphony-traffic[argoverse2]')",
)


def failing(call: Callable[[], Conformance]) -> Conformance:
    """Return the findings of a check; something must be wrong."""
    with pytest.raises(ConformanceError) as caught:
        call()
    assert caught.value.report.failures
    assert all(check in str(caught.value) for check in caught.value.report.failures)
    return caught.value.report


def test_readers_conform(tmp_path: Path) -> None:
    """For those of the other formats see their tests."""
    records, path = tmp_path / "a.tfrecord", tmp_path / "a.xml"
    write_records(records, [womd_scenario(f"{n}", tracks=3 + n).SerializeToString() for n in range(3)])
    assert check_reader(get_reader("womd"), [records]).segments == 3
    path.write_text(commonroad(ROAD, driver(7), driver(8, x=20)))
    assert check_reader(get_reader("commonroad", egos="all"), [path]).segments == 2


@pytest.mark.samples
@pytest.mark.parametrize(("name", "pattern", "count"), [
    ("womd", "womd/*.tfrecord", 1), ("commonroad", "commonroad/*.xml", 5),
    ("scenarionet", "real/scenarionet/*.pkl", 2), ("commonroad", "commonroad/ngsim/USA_Lanker-2_10*.xml", 1),
    pytest.param("argoverse2", "argoverse2/*.parquet", 1, marks=needs_pyarrow),
])  # fmt: skip
def test_samples_conform(name: str, pattern: str, count: int, samples: Path) -> None:
    files = sorted(samples.glob(pattern))
    if name == "scenarionet":
        files = sorted(files, key=lambda file: file.stat().st_size)[:count]  # of both sources
        if not files:
            pytest.skip("the ScenarioNet samples are not among the samples")
    report = check_reader(get_reader(name), files)
    assert report.segments == count


def traffic() -> list[RunSegment]:
    """Good segments with turns, lights and neighbours."""
    return [crossing(), hide(straight_road(8), 2, slice(10, 20))]


def test_the_good_ones_pass() -> None:
    report = check_segments(traffic())
    assert (report.segments, report.failures) == (2, {})
    # Every number can be taken, so that every one below can be wrong.
    assert not np.isnan(list(report.numbers.values())).any()


def road(**changes: Any) -> Callable[[RunSegment], RunSegment]:
    """Change the map; values are arrays or functions of the old ones."""

    def change(segment: RunSegment) -> RunSegment:
        old = segment.road
        new = {k: v(getattr(old, k)) if callable(v) else v for k, v in changes.items()}
        return segment.replace(road=dataclasses.replace(old, **new))

    return change


def turned_around(lines: Polylines) -> Polylines:
    return Polylines.of([lines[k][::-1] for k in range(len(lines))])


def scaled(name: str, factor: float) -> Callable[[RunSegment], RunSegment]:
    return lambda s: s.replace(**{name: getattr(s, name) * np.float32(factor)})


def leftover(s: RunSegment) -> RunSegment:
    heading = s.heading.copy()
    heading[~s.valid] = 1.5
    return s.replace(heading=heading)


def parked(s: RunSegment) -> RunSegment:
    still = np.repeat(s.position[:, :1], s.num_steps, axis=1)
    return s.replace(position=still, velocity=np.zeros_like(s.velocity), valid=np.ones_like(s.valid))


def swapped(s: RunSegment) -> RunSegment:
    size = s.size[:, [1, 0, 2]]
    return s.replace(size=np.where((s.agent_type == AgentType.VEHICLE)[:, None], size, s.size))


def mirrored(s: RunSegment) -> RunSegment:
    """Tracks with y pointing down, the map as it was."""
    flip = np.float32([1, -1, 1])
    return s.replace(position=s.position * flip, velocity=s.velocity * flip[:2], heading=-s.heading)


def flipped(pairs: Any) -> Any:
    return pairs[:, ::-1].copy()


BROKEN: dict[str, tuple[Callable[[RunSegment], RunSegment], set[str]]] = {
    "seven times the time": (lambda s: s.replace(dt=s.dt * 7), {"time step", "speed"}),
    "velocity in mph": (scaled("velocity", 2.237), {"speed"}),
    "velocity backwards": (scaled("velocity", -1), {"speed", "heading"}),
    "all in feet": (
        lambda s: s.replace(position=s.position * np.float32(3.28), size=s.size * np.float32(3.28)),
        {"speed", "size", "lanes", "boundary"},
    ),
    "heading in degrees": (scaled("heading", 180 / np.pi), {"heading"}),
    "heading clockwise": (scaled("heading", -1), {"heading"}),
    "length is width": (swapped, {"size"}),
    "far away": (lambda s: turned(s, 0.0, [3000, 0]), {"re-centred"}),
    "left over numbers": (leftover, {"masked"}),
    "lanes against the traffic": (
        road(lanes=turned_around, successors=flipped, left_neighbors=flipped, right_neighbors=flipped),
        {"lanes"},
    ),
    "tracks mirrored": (mirrored, {"lanes", "boundary"}),
    "lane widths in cm": (road(lane_width=lambda old: old * np.float32(100)), {"lanes"}),
    "limits in km/h": (road(speed_limit=lambda old: old * np.float32(3.6)), {"lanes"}),
    "predecessors as successors": (road(successors=flipped), {"successors"}),
    "left is right": (road(left_neighbors=flipped, right_neighbors=flipped), {"neighbours"}),
    "boundary the other way": (road(boundary=turned_around), {"boundary"}),
    "no boundary": (road(boundary=Polylines.of([])), {"boundary"}),
    "nobody moves": (parked, {"speed", "heading", "lanes", "boundary"}),
    "outside the schema": (lambda s: s.replace(ego=99), {"schema"}),
    "all of one name": (lambda s: s.replace(segment_id="one"), {"ids"}),
    "numbers that are NumPy's": (lambda s: s.replace(dt=np.float64(s.dt)), {"store"}),
}


@pytest.mark.parametrize("name", BROKEN)
def test_segments_that_break_a_promise(name: str) -> None:
    change, expected = BROKEN[name]
    assert set(failing(lambda: check_segments(list(map(change, traffic())))).failures) == expected


class LinesReader(Reader):
    """A format of our own: the number of a scene on each line; with a fault, a promise is broken."""

    name = "lines"
    patterns = ("*.lines",)

    def __init__(self, fault: str = "") -> None:
        self.fault, self.calls = fault, 0

    def read(self, path: str | Path) -> Iterator[Item]:
        for item in super().read(path) if self.fault != "silent" else ():
            blames = self.fault == "blames another" and isinstance(item, DataError)
            yield DataError(item.message, file="elsewhere") if blames else item

    def _read(self, path: Path) -> Iterator[Item]:
        if self.fault == "raises":
            raise KeyError("lanes")
        for number, line in enumerate(path.read_text().splitlines()):
            if not line.isdigit():
                yield DataError("not a number", field="cars")
                continue
            self.calls += self.fault == "another each time"
            name = "segment" if self.fault == "one name" else f"{path.stem}-{number}"
            found = crossing(segment_id=name, source=self.name, file=path.name)
            found = found.replace(agent_id=found.agent_id + int(line) + self.calls)
            yield found.replace(file="", source="womd") if self.fault == "anonymous" else found


@pytest.mark.parametrize(("fault", "expected"), [
    ("", set()), ("another each time", {"determinism"}), ("one name", {"ids"}), ("anonymous", {"source"}),
    ("blames another", {"errors"}), ("silent", {"errors", "segments"}), ("raises", {"errors", "segments"}),
])  # fmt: skip
def test_readers_that_break_a_promise(fault: str, expected: set[str], tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.lines" for name in ("a", "b")]
    paths[0].write_text("3\n4\n")
    paths[1].write_text("none\n5\n")
    if expected:
        assert set(failing(lambda: check_reader(LinesReader(fault), paths)).failures) == expected
    else:
        report = check_reader(LinesReader(), paths)
        assert (report.segments, [str(error.file) for error in report.skipped]) == (3, [str(paths[1])])
