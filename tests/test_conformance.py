"""The conformance checks: every reader passes, and each check fails on a reader that breaks its promise."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from helpers_segments import LANE_WIDTH, crossing, hide, make_segment, straight_road
from helpers_sources import ROAD, commonroad, driver, womd_scenario
from symphony.data.builtin import builtin_store
from symphony.data.conformance import Conformance, ConformanceError, check_reader, check_segments
from symphony.data.plausibility import RANGES
from symphony.data.segment import AgentType, Polylines, RoadMap, RunSegment
from symphony.data.sources import get_reader
from symphony.data.sources.base import Item, Reader
from symphony.data.sources.tfrecord import write_records
from symphony.data.store import SegmentStore
from symphony.errors import DataError

needs_pyarrow = pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None,
    reason="pyarrow is not installed (pip install 'symphony-traffic[argoverse2]')",
)


def failing(call: Callable[[], Conformance]) -> Conformance:
    """What a check finds; something must be wrong."""
    with pytest.raises(ConformanceError) as caught:
        call()
    assert caught.value.report.failures
    assert all(check in str(caught.value) for check in caught.value.report.failures)
    return caught.value.report


# Our readers


def test_womd_conforms(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.tfrecord", "b.tfrecord")]
    for k, file in enumerate(files):
        records = [womd_scenario(f"{k}{n}", tracks=3 + n).SerializeToString() for n in range(2 + k)]
        write_records(file, records)
    report = check_reader(get_reader("womd"), files)
    assert (report.segments, report.skipped) == (5, [])
    assert report.damaged > 30


@pytest.mark.parametrize("version", ["2018b", "2020a"])
def test_commonroad_conforms(version: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(commonroad(ROAD, driver(7, version), driver(8, version, x=20), version=version))
    assert check_reader(get_reader("commonroad"), [path]).segments == 1
    assert check_reader(get_reader("commonroad", egos="all"), [path]).segments == 2


@needs_pyarrow
def test_argoverse2_conforms(tmp_path: Path) -> None:
    from helpers_argoverse2 import write

    report = check_reader(get_reader("argoverse2"), [write(tmp_path)], flips=20)
    assert report.segments == 1
    # Of the scenario and of its map.
    assert report.damaged > 2 * 20


def test_simulated_segments_conform() -> None:
    segments = list(SegmentStore(builtin_store("test")))
    report = check_segments(segments)
    assert report.segments == len(segments)
    assert report.numbers["off_road"] == 0


@pytest.mark.samples
@pytest.mark.parametrize(
    ("name", "pattern", "count"),
    [
        ("womd", "womd/*.tfrecord", 1),
        ("commonroad", "commonroad/*.xml", 5),
        ("commonroad", "commonroad/ngsim/USA_Lanker-2_1[01]*.xml", 2),
        pytest.param("argoverse2", "argoverse2/*.parquet", 1, marks=needs_pyarrow),
    ],
)
def test_samples_conform(name: str, pattern: str, count: int, samples: Path) -> None:
    report = check_reader(get_reader(name), sorted(samples.glob(pattern)), flips=2)
    assert report.segments == count


# Segments that break a promise


def traffic() -> list[RunSegment]:
    """Good segments with turns, lights, neighbours, and everybody a check looks at."""
    straight = straight_road(8)
    types, size = straight.agent_type.copy(), straight.size.copy()
    types[6:] = AgentType.PEDESTRIAN, AgentType.CYCLIST
    size[6:] = (0.6, 0.7, 1.7), (1.8, 0.7, 1.7)
    mixed = straight.replace(agent_type=types, size=size)
    return [crossing(), hide(mixed, 2, slice(10, 20))]


def test_the_good_ones_pass() -> None:
    report = check_segments(traffic())
    assert report.segments == 2
    assert not report.failures
    # Every number can be taken, so that every one below can be wrong.
    assert not [name for name, value in report.numbers.items() if np.isnan(value)]
    assert str(report) == "2 segments, 0 skipped, 0 damaged copies"


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


def only(kind: AgentType, size: tuple[float, float, float]) -> Callable[[RunSegment], RunSegment]:
    def change(s: RunSegment) -> RunSegment:
        return s.replace(size=np.where((s.agent_type == kind)[:, None], np.float32(size), s.size))

    return change


def moved(s: RunSegment, by: float) -> RunSegment:
    """The whole world somewhere else."""
    shift = np.float32([by, 0, 0])

    def lines(old: Polylines) -> Polylines:
        return Polylines(old.points + shift, old.offsets)

    position = np.where(s.valid[..., None], s.position + shift, 0).astype(np.float32)
    return road(lanes=lines, boundary=lines, marks=lines)(s.replace(position=position))


def oncoming(s: RunSegment) -> RunSegment:
    """Each lane's left neighbour is one beside it that comes the other way."""
    both = Polylines.of(
        [line for k in range(len(s.road.lanes)) for line in (s.road.lanes[k], beside(s.road, k))]
    )
    old = s.road
    twice = {name: np.repeat(getattr(old, name), 2) for name in ("lane_type", "speed_limit", "lane_width")}
    pairs = np.arange(len(both), dtype=np.int32).reshape(-1, 2)
    new = dataclasses.replace(
        old,
        lanes=both,
        lane_id=np.arange(len(both), dtype=np.int64),
        successors=2 * old.successors,
        left_neighbors=pairs,
        right_neighbors=pairs[:0],
        **twice,
    )
    return s.replace(road=new)


def beside(road: RoadMap, k: int) -> np.ndarray[Any, Any]:
    line = road.lanes[k][:, :2]
    along = np.gradient(line, axis=0)
    left = np.stack([-along[:, 1], along[:, 0]], -1) / np.hypot(*along.T)[:, None]
    return (line + LANE_WIDTH * left)[::-1]


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


def loop(pairs: Any) -> Any:
    return np.concatenate([pairs, [[0, 0]]]).astype(np.int32)


def flipped(pairs: Any) -> Any:
    return pairs[:, ::-1].copy()


BROKEN: dict[str, tuple[Callable[[RunSegment], RunSegment], set[str]]] = {
    "milliseconds": (lambda s: s.replace(dt=s.dt * 1000), {"schema"}),
    "seven times the time": (lambda s: s.replace(dt=s.dt * 7), {"time step", "speed"}),
    "twice the time": (lambda s: s.replace(dt=s.dt * 2), {"speed"}),
    "velocity in mph": (scaled("velocity", 2.237), {"speed"}),
    "velocity in km/h": (scaled("velocity", 3.6), {"speed"}),
    "velocity backwards": (scaled("velocity", -1), {"speed", "heading"}),
    "velocity in the agent's frame": (
        lambda s: s.replace(velocity=np.stack([np.hypot(*s.velocity.T).T, 0 * s.heading], -1)),
        {"heading"},
    ),
    "all in feet": (
        lambda s: moved(s, 0).replace(position=s.position * np.float32(3.28), size=s.size * np.float32(3.28)),
        {"speed", "size", "lanes", "boundary"},
    ),
    "rockets": (lambda s: scaled("position", 9)(scaled("velocity", 9)(s)), {"speed", "lanes", "boundary"}),
    "heading in degrees": (scaled("heading", 180 / np.pi), {"heading"}),
    "heading clockwise": (scaled("heading", -1), {"heading"}),
    "heading from north": (
        lambda s: s.replace(heading=np.where(s.valid, np.float32(np.pi / 2) - s.heading, 0)),
        {"heading", "lanes"},
    ),
    "half sizes": (scaled("size", 0.5), {"size"}),
    "length is width": (swapped, {"size"}),
    "tall vehicles": (lambda s: s.replace(size=s.size * np.float32([1, 1, 4])), {"size"}),
    "wide pedestrians": (only(AgentType.PEDESTRIAN, (2, 2, 2)), {"size"}),
    "long bicycles": (only(AgentType.CYCLIST, (4, 1, 2)), {"size"}),
    "far away": (lambda s: moved(s, 3000), {"re-centred"}),
    "left over numbers": (leftover, {"masked"}),
    "lanes against the traffic": (
        road(lanes=turned_around, successors=flipped, left_neighbors=flipped, right_neighbors=flipped),
        {"lanes"},
    ),
    "map of another place": (
        road(lanes=lambda old: Polylines(old.points + np.float32([0, 40, 0]), old.offsets)),
        {"lanes"},
    ),
    "tracks mirrored": (mirrored, {"lanes", "boundary"}),
    "lane widths in cm": (road(lane_width=lambda old: old * np.float32(100)), {"lanes"}),
    "limits in km/h": (road(speed_limit=lambda old: old * np.float32(3.6)), {"lanes"}),
    "predecessors as successors": (road(successors=flipped), {"successors"}),
    "a lane after itself": (road(successors=loop), {"successors"}),
    "no successors": (road(successors=lambda old: old[:0]), {"successors"}),
    "left is right": (road(left_neighbors=flipped, right_neighbors=flipped), {"neighbours"}),
    "oncoming neighbours": (oncoming, {"neighbours"}),
    "boundary the other way": (road(boundary=turned_around), {"boundary"}),
    "no boundary": (road(boundary=Polylines.of([])), {"boundary"}),
    "nobody moves": (parked, {"speed", "heading", "lanes", "boundary"}),
    "outside the schema": (lambda s: s.replace(ego=99), {"schema"}),
    "all of one name": (lambda s: s.replace(segment_id="one"), {"ids"}),
    "numbers that are NumPy's": (lambda s: s.replace(dt=np.float64(s.dt)), {"store"}),
    "single origin": (lambda s: s.replace(origin=s.origin.astype(np.float32)), {"store"}),
}


@cache
def broken(name: str) -> Conformance:
    return failing(lambda: check_segments([BROKEN[name][0](segment) for segment in traffic()]))


@pytest.mark.parametrize("name", BROKEN)
def test_segments_that_break_a_promise(name: str) -> None:
    assert set(broken(name).failures) == BROKEN[name][1]


def test_every_number_has_been_seen_out_of_range() -> None:
    found = [report.numbers for report in map(broken, BROKEN) if report.numbers]
    for name, limits in RANGES.items():
        values = [numbers[name] for numbers in found]
        assert not all(limits.low <= value <= limits.high for value in values if not np.isnan(value)), name


def test_nothing_is_not_good() -> None:
    assert set(failing(lambda: check_segments([])).failures) == {"segments"}


def test_one_wild_track_is_no_failure() -> None:
    """Real logs have spikes: the numbers are pooled."""
    segments = [*traffic(), straight_road(30, segment_id="more")]
    position = segments[2].position.copy()
    position[5, 20:22] += 50
    check_segments([*segments[:2], segments[2].replace(position=position)])


# Readers that break a promise


class LinesReader(Reader):
    """A format of our own: ``cars N`` on the first line of a file, then N lines of ``x lane speed``.

    The sidecar ``*.road`` holds the number of lanes.
    """

    name = "lines"
    patterns = ("*.lines",)

    def companions(self, path: Path) -> tuple[Path, ...]:
        return (path.with_suffix(".road"),)

    def _read(self, path: Path) -> Iterator[Item]:
        head, *lines = path.read_text(encoding="ascii", errors="replace").splitlines() or [""]
        if not path.read_bytes().endswith(b"\n"):
            raise DataError("cut short", field="cars")
        lanes = self._lanes(path.with_suffix(".road"))
        try:
            count = int(head.removeprefix("cars "))
            table = np.array([[float(x) for x in line.split()] for line in lines], np.float64)
        except ValueError as error:
            raise DataError(f"not a number: {error}", field="cars") from error
        if not self._complete(table, count):
            raise DataError(f"{len(table)} of {count} cars", field="cars")
        if table.ndim != 2 or table.shape[1] != 3 or not np.isfinite(table).all():
            raise DataError("expected three numbers per car", field="cars")
        yield self._segment(table, lanes, path)

    def _lanes(self, path: Path) -> int:
        try:
            text = path.read_text(encoding="ascii")
            if text[-1:] == "\n" and 1 <= int(text) <= 9:
                return int(text)
        except (OSError, ValueError) as error:
            raise DataError(f"bad road: {error}", file=path) from error
        raise DataError("not 1 to 9 lanes", file=path)

    def _complete(self, table: Any, count: int) -> bool:
        return len(table) == count and count > 0

    def _segment(self, table: Any, lanes: int, path: Path) -> RunSegment:
        made = straight_road(3, num_lanes=lanes, steps=21)
        x, lane, speed = (np.clip(column, -1e6, 1e6).astype(np.float32) for column in table.T)
        time = np.arange(21, dtype=np.float32) * np.float32(0.2)
        # One successor, so that the lane graph can be checked.
        ahead = [made.road.lanes[k] + np.float32([400, 0, 0]) for k in range(lanes)]
        graph = dataclasses.replace(
            made.road,
            lanes=Polylines.of([*(self._until(made.road.lanes[k], ahead[k]) for k in range(lanes)), *ahead]),
            lane_id=np.arange(2 * lanes),
            successors=np.stack([np.arange(lanes), np.arange(lanes) + lanes], -1).astype(np.int32),
            **{
                name: np.tile(getattr(made.road, name), 2)
                for name in ("lane_type", "speed_limit", "lane_width")
            },
        )
        position = np.stack([x[:, None] + speed[:, None] * time, 0 * time + LANE_WIDTH * lane[:, None]], -1)
        velocity = np.stack([np.repeat(speed[:, None], 21, 1), np.zeros((len(x), 21))], -1)
        return make_segment(
            graph,
            np.clip(position, -1e4, 1e4),
            np.zeros((len(x), 21)),
            velocity,
            segment_id=path.stem,
            source=self.name,
            file=path.name,
        )

    @staticmethod
    def _until(line: Any, following: Any) -> Any:
        return np.concatenate([line[line[:, 0] < following[0, 0]], following[:1]])


class Nondeterministic(LinesReader):
    calls: ClassVar[int] = 0

    def _segment(self, table: Any, lanes: int, path: Path) -> RunSegment:
        type(self).calls += 1
        return super()._segment(table + np.array([0.001 * self.calls, 0, 0]), lanes, path)


class ByFolder(LinesReader):
    def _segment(self, table: Any, lanes: int, path: Path) -> RunSegment:
        made = super()._segment(table, lanes, path)
        return made.replace(segment_id=f"{path.parent.name}-{path.stem}")


class OneName(LinesReader):
    def _segment(self, table: Any, lanes: int, path: Path) -> RunSegment:
        return super()._segment(table, lanes, path).replace(segment_id="segment")


class Anonymous(LinesReader):
    def _segment(self, table: Any, lanes: int, path: Path) -> RunSegment:
        return super()._segment(table, lanes, path).replace(file="", source="womd")


class HidesItsMap(LinesReader):
    def companions(self, path: Path) -> tuple[Path, ...]:
        return ()


class HalfReads(LinesReader):
    def _complete(self, table: Any, count: int) -> bool:
        return len(table) > 0

    def _read(self, path: Path) -> Iterator[Item]:
        whole = path.read_bytes()
        # What is left of the last line goes, and the cars before it are taken.
        lines = whole.split(b"\n")[:-1]
        table = np.array([[float(x) for x in line.split()] for line in lines[1:] if line[:1].isdigit()])
        if not table.size or table.ndim != 2 or table.shape[1] != 3:
            raise DataError("no cars", field="cars")
        yield self._segment(table, self._lanes(path.with_suffix(".road")), path)


class HalfReadsAndTells(HalfReads):
    def _read(self, path: Path) -> Iterator[Item]:
        yield from super()._read(path)
        if not path.read_bytes().endswith(b"\n"):
            raise DataError("cut short", field="cars")


class OnePerLine(HalfReads):
    """Each car is a record of its own, and those that are gone are not missed."""

    def _segment(self, table: Any, lanes: int, path: Path) -> RunSegment:
        made = super()._segment(table[:1], lanes, path)
        return made.replace(segment_id=f"{path.stem}-{table[0, 0]:.0f}")

    def _read(self, path: Path) -> Iterator[Item]:
        lines = path.read_bytes().split(b"\n")[:-1]
        for number in range(1, len(lines)):
            table = np.array([[float(x) for x in lines[number].split()]])
            yield self._segment(table, self._lanes(path.with_suffix(".road")), path)
        if len(lines) < 2:
            raise DataError("no cars", field="cars")


class Silent(LinesReader):
    def read(self, path: str | Path) -> Iterator[Item]:
        yield from (item for item in super().read(path) if isinstance(item, RunSegment))


class Crashes(LinesReader):
    def _lanes(self, path: Path) -> int:
        return int(path.read_text())


class BlamesAnother(LinesReader):
    def read(self, path: str | Path) -> Iterator[Item]:
        for item in super().read(path):
            yield DataError(item.message, file="elsewhere") if isinstance(item, DataError) else item


class Optimist(LinesReader):
    """Makes something up where it can't read, and nobody looks at it."""

    def read(self, path: str | Path) -> Iterator[Item]:
        for item in super().read(path):
            made = straight_road(3, source=self.name, file=Path(path).name)
            yield item if isinstance(item, RunSegment) else made.replace(ego=-1)


class Unchecked(LinesReader):
    """Damaged records come out as they are."""

    def read(self, path: str | Path) -> Iterator[Item]:
        for item in super().read(path):
            damaged = isinstance(item, DataError) and Path(path).exists() and Path(path).stat().st_size > 0
            yield straight_road(3, dt=0.2).replace(dt=-1.0) if damaged else item


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{name}.lines" for name in ("a", "b")]
    for k, path in enumerate(paths):
        cars = [f"{20 + 15 * n} {n % 3} {rng.uniform(5, 12):.3f}" for n in range(6 + k)]
        path.write_text("\n".join([f"cars {len(cars)}", *cars, ""]))
        path.with_suffix(".road").write_text("3\n")
    return paths


def test_a_reader_of_a_new_format_conforms(files: list[Path]) -> None:
    report = check_reader(LinesReader(), files, damage=2, flips=24)
    assert report.segments == 2
    assert report.damaged > 4 * 24


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (Nondeterministic, {"determinism"}),
        (ByFolder, {"determinism"}),
        (OneName, {"ids"}),
        (Anonymous, {"source"}),
        (HidesItsMap, {"determinism"}),
        (HalfReads, {"truncated"}),
        (HalfReadsAndTells, {"truncated"}),
        (Silent, {"truncated", "damaged", "foreign"}),
        (Crashes, {"truncated", "damaged", "foreign"}),
        (BlamesAnother, {"truncated", "damaged", "foreign"}),
        (Optimist, {"truncated", "damaged", "foreign"}),
        (Unchecked, {"truncated", "damaged", "foreign"}),
    ],
)
def test_readers_that_break_a_promise(kind: type[Reader], expected: set[str], files: list[Path]) -> None:
    assert expected <= set(failing(lambda: check_reader(kind(), files, flips=8)).failures)


@pytest.mark.parametrize(
    ("kind", "message"),
    [(HalfReadsAndTells, "gives a segment that the whole file does not"), (OnePerLine, "no error, though")],
)
def test_half_read_files_are_told_from_lost_records(
    kind: type[Reader], message: str, files: list[Path]
) -> None:
    found = failing(lambda: check_reader(kind(), files, flips=0)).failures["truncated"]
    assert all(message in text for text in found)


def test_good_files_that_raise_are_reported(files: list[Path]) -> None:
    class Raises(LinesReader):
        def _read(self, path: Path) -> Iterator[Item]:
            raise KeyError("lanes")

    found = failing(lambda: check_reader(Raises(), files)).failures
    assert set(found) == {"errors", "segments"}
    assert "KeyError" in found["errors"][0]


def test_skipped_records_are_told(files: list[Path]) -> None:
    bad = files[0].with_name("bad.lines")
    bad.write_text("cars 3\n")
    bad.with_suffix(".road").write_text("3\n")
    report = check_reader(LinesReader(), [*files, bad], flips=0)
    assert [str(error.file) for error in report.skipped] == [str(bad)]
    assert json.dumps(report.numbers)
