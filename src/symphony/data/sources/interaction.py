"""Reader of recordings in the format of the INTERACTION dataset: tracks in CSV with a Lanelet2 map.

Three layouts are known, SCENE being the place:

- ``recorded_trackfiles/SCENE/vehicle_tracks_<N>.csv`` with ``pedestrian_tracks_<N>.csv`` where there are any
  (INTERACTION 1.0 and 1.1), and ``maps/SCENE.osm_xy`` or ``maps/SCENE.osm`` beside ``recorded_trackfiles``;
- the same with ``meta_data.csv``, ``signal_phases_<N>.csv`` and ``*_map.kml`` in the folder of the tracks (Test Area
  Autonomous Driving Baden-Württemberg);
- ``train/SCENE_train.csv`` and ``val/SCENE_val.csv`` with many cases each (INTERACTION 1.2), maps as before.

Everything may also lie in one folder, if it has a single map.

How the format maps onto :class:`~symphony.data.segment.RunSegment`:

- A recording is cut into windows; a case is one segment, whose ``current_step`` is the tenth (its first second is
  history). ``segment_id`` is the map's name, the file's number or split, the case or the window's first second, and
  the ego. ``group`` is the file.
- Nobody is the ego: it is picked as in the CommonRoad reader. Agents are in order of id.
- Coordinates are relative to the middle of the map, so that all windows share one map; z is 0, height unknown.
- A map in degrees is projected: by a spherical Mercator, true to length at the origin that ``meta_data.csv`` names,
  where there is one; else by UTM relative to latitude and longitude 0, as INTERACTION's own scripts do.
- ``pedestrian/bicycle`` is one type in the format: see :data:`.interaction_tracks.CYCLING`. Sizes that are not given
  are :data:`.interaction_tracks.NOMINAL`, headings not given are the direction of motion.
- Lights: see :mod:`.interaction_signals`.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import check_counts
from symphony.data.resample import MAX_GAP, evened
from symphony.data.segment import Bools, RoadMap, RunSegment
from symphony.data.sources.base import Item, Reader, busiest_first, to_float32
from symphony.data.sources.geodesy import mercator, utm
from symphony.data.sources.interaction_signals import Lights, read_lights, states_at
from symphony.data.sources.interaction_tracks import (
    NOMINAL,
    Rows,
    check_motion,
    from_positions,
    headings,
    joined,
    merged,
    read_rows,
    resolved,
    stepped,
)
from symphony.data.sources.lanelet2 import (
    Projection,
    lane_lanelets,
    middle,
    read_lanelet2,
    road_map,
    stop_line,
    successors,
)
from symphony.data.sources.lines import Doubles, lights
from symphony.data.sources.xml_files import number
from symphony.errors import ConfigError, DataError

FAR = 200.0
"""Metres between a recording and the box around its map beyond which the two don't belong together."""
HISTORY = 9
"""The last step of a case's first second."""
MAX_STEPS = 360_000
"""Steps of a recording, which is cut into windows: ten hours at 10 Hz."""


class InteractionReader(Reader):
    """Reads INTERACTION-format recordings.

    Args:
        egos: ``"one"`` picks an ego per window, ``"all"`` gives a segment for each vehicle that moves and is seen at
            every step, as in :class:`~symphony.data.sources.commonroad.CommonRoadReader`.
        window: seconds of a segment. The rest of a recording counts if it is at least half as long.
        stride: seconds between the starts of windows; by default ``window``, so that they don't overlap.
        motion: ``"logged"`` takes velocities and headings as they are, and refuses a file where they are not those of
            its positions; ``"positions"`` computes velocities, replaces headings that are far off the motion, and
            takes the mean of states logged twice.

    Raises:
        ConfigError: a value out of range.
    """

    name = "interaction"
    patterns = ("vehicle_tracks_*.csv", "*_train.csv", "*_val.csv")

    def __init__(
        self,
        egos: Literal["one", "all"] = "one",
        window: float = 10.0,
        stride: float | None = None,
        motion: Literal["logged", "positions"] = "logged",
    ) -> None:
        if egos not in {"one", "all"}:
            raise ConfigError(f"egos must be 'one' or 'all', is {egos!r}")
        if motion not in {"logged", "positions"}:
            raise ConfigError(f"motion must be 'logged' or 'positions', is {motion!r}")
        self.egos, self.motion, self.window = egos, motion, window
        self.stride = window if stride is None else stride
        for name, seconds in (("window", self.window), ("stride", self.stride)):
            if not 0 < seconds <= 600:
                raise ConfigError(f"{name} must be above 0 and at most 600 s, is {seconds}")

    def companions(self, path: Path) -> tuple[Path, ...]:
        """The map, and whatever else the recording has."""
        try:
            found = find_files(path)
        except DataError:
            return ()
        more = (found.map, found.walkers, found.meta, found.phases, found.topology)
        return tuple(file for file in more if file is not None)

    def _read(self, path: Path) -> Iterator[Item]:
        rows = read_rows(path)
        files = find_files(path)
        if files.walkers is not None:
            rows = joined(rows, read_rows(files.walkers))
        rows, dt, start = stepped(rows)
        if self.motion == "positions":
            rows = merged(rows)
        else:
            check_motion(rows, dt, start)
        # Absurd numbers may overflow on the way: the result is not finite, which validation reports.
        with np.errstate(over="ignore", invalid="ignore"):
            known = resolved(rows, dt, by_positions=self.motion == "positions")
            yield from self._segments(known, _scene(files, rows, dt, start))

    def _segments(self, rows: Rows, scene: _Scene) -> Iterator[Item]:
        files = scene.files
        cases = np.unique(rows.case)
        for case in cases:
            mine = rows.take(slice(*np.searchsorted(rows.case, [case, case + 1])))
            first = int(mine.time[0])
            steps = int(mine.time[-1]) - first + 1
            if steps > MAX_STEPS:
                raise DataError(f"{steps} steps, at most {MAX_STEPS} can be read", field="timestamp_ms")
            single = files.tracks.name.startswith("vehicle_tracks_")
            for start, stop in self._windows(steps, scene.dt) if single else [(0, steps)]:
                begin = first + start
                part = mine.take(slice(*np.searchsorted(mine.time, [begin, first + stop])))
                what = f"t{round(start * scene.dt, 3):g}" if single else f"case{case}"
                name = f"{files.map.stem}_{files.part}_{what}"
                try:
                    yield from self._window(part, scene, name, begin, stop - start, 0 if single else HISTORY)
                except DataError as error:
                    yield error.at(segment=name)

    def _windows(self, steps: int, dt: float) -> list[tuple[int, int]]:
        """First step and the one after the last of each window."""
        length, stride = (max(round(s / dt), 1) for s in (self.window, self.stride))
        found = []
        for start in range(0, max(steps - 1, 1), stride):
            stop = min(start + length + 1, steps)
            if start == 0 or 2 * (stop - start - 1) >= length:
                found.append((start, stop))
        return found

    def _window(
        self, rows: Rows, scene: _Scene, name: str, begin: int, steps: int, current: int
    ) -> Iterator[RunSegment]:
        if not len(rows):
            raise DataError("nobody is there", field="track_id")
        ids, row = np.unique(rows.track, return_inverse=True)
        check_counts(len(ids), steps, "track_id")
        first = np.unique(row, return_index=True)[1]
        kind = rows.kind[first]
        if (rows.kind != kind[row]).any():
            wrong = rows.track[np.argmax(rows.kind != kind[row])]
            raise DataError(f"track {wrong} has more than one", field="agent_type")
        state = np.zeros((len(ids), steps, 5))
        valid = np.zeros((len(ids), steps), np.bool_)
        step = rows.time - begin
        state[row, step], valid[row, step] = rows.state[:, :5], True
        state[valid, :2] -= scene.origin
        if self.motion == "positions":
            state = from_positions(state, valid, scene.dt)
        state = headings(state, valid)
        there = np.flatnonzero(~_lost(valid, scene.dt))
        candidates = busiest_first(ids, kind.astype(np.uint8), state[:, there, :2], valid[:, there])
        if not len(candidates):
            raise DataError("no moving vehicle is observed at every step", field="track_id")
        times = np.rint(scene.start + 1000 * scene.dt * (begin + there)).astype(np.int64)
        shown = {k: (place, states_at(since, s, times)) for k, (place, since, s) in scene.lights.items()}
        segment = RunSegment(
            segment_id=name,
            source=self.name,
            dt=scene.dt,
            ego=int(candidates[0]),
            agent_id=ids,
            agent_type=kind.astype(np.uint8),
            size=_sizes(rows, row, kind),
            position=to_float32(np.pad(state[:, there, :2], ((0, 0), (0, 0), (0, 1)))),
            heading=to_float32(state[:, there, 4]),
            velocity=to_float32(state[:, there, 2:4]),
            valid=valid[:, there],
            road=scene.road,
            **lights(shown, len(there), scene.origin),
            origin=np.array([*scene.origin, 0.0]),
            current_step=min(int(np.searchsorted(there, current)), len(there) - 1),
            predict=np.unique(row[rows.marks[:, 0]]).astype(np.int32),
            interest=np.unique(row[rows.marks[:, 1]]).astype(np.int32),
            file=scene.files.tracks.name,
            group=name.rpartition("_")[0],
            odd=scene.odd,
        )
        segment = evened(segment, there.astype(np.float64) * scene.dt)
        if self.egos == "one":
            yield segment
            return
        for ego in sorted(candidates.tolist()):
            yield segment.replace(ego=ego, segment_id=f"{name}_ego{ids[ego]}")


def _lost(valid: Bools, dt: float) -> Bools:
    """[T] steps at which a recording lost the frame: nobody is seen for at most :data:`.resample.MAX_GAP`."""
    there = np.flatnonzero(valid.any(axis=0))
    lost = np.zeros(valid.shape[1], np.bool_)
    for before, after in pairwise(there.tolist()):
        lost[before + 1 : after] = (after - before) * dt <= MAX_GAP
    return lost


def _sizes(rows: Rows, row: NDArray[np.int64], kind: NDArray[np.int64]) -> NDArray[np.float32]:
    """[A, 3] the first size given of each agent, else the nominal one; height 0."""
    size = np.zeros((len(kind), 3))
    for k, (length, width) in NOMINAL.items():
        size[kind == k, :2] = length, width
    given = np.flatnonzero((rows.state[:, 5:7] > 0).all(axis=1))[::-1]
    size[row[given], :2] = rows.state[given, 5:7]  # the first one is written last
    return to_float32(size)


@dataclass(frozen=True)
class _Scene:
    """What the windows of one file share; ``start`` is the time of step 0 in milliseconds."""

    files: Files
    dt: float
    start: float
    road: RoadMap
    lights: Lights
    origin: Doubles
    odd: Mapping[str, str]


def _scene(files: Files, rows: Rows, dt: float, start: float) -> _Scene:
    projection: Projection = partial(utm, origin=np.zeros(2))
    has_phases = files.phases is not None
    if files.meta is not None:
        origin, has_phases = read_meta(files.meta, files.part)
        projection = partial(mercator, origin=origin)
    source = read_lanelet2(files.map, projection)
    try:
        lanes = lane_lanelets(source)
        origin, links = middle(source), successors(lanes)
        road = road_map(source, origin)
    except DataError as error:
        raise error.at(file=files.map) from error
    found: Lights = {}
    if has_phases:
        if files.phases is None or files.topology is None:
            raise DataError("its signal phases, or the one *_map.kml that goes with them, are missing")
        entered = {lane: lanes[lane].center for lane in np.unique(links[:, 1]).tolist()}
        until = int(start + 1000 * dt * rows.time.max())
        found = read_lights(files.phases, files.topology, entered, projection, until)
        # A stop line that the map names is better than the end of a KML lane.
        for before, after in links.tolist():
            line = stop_line(lanes[before], source.rules)
            if after in found and line is not None:
                found[after] = (line, *found[after][1:])
    reach = np.abs(np.concatenate([lane.ring for lane in lanes]) - origin).max(axis=0)
    away = np.hypot(*np.maximum(np.abs(rows.state[:, :2] - origin) - reach, 0).T)
    if float(np.median(away)) > FAR:
        message = f"the tracks are {np.median(away):.0f} m away from the map: another origin or projection"
        raise DataError(message, field="x, y")
    return _Scene(files, dt, start, road, found, origin, source.odd)


_NUMBERED = re.compile(r"vehicle_tracks_(\w+)\.csv")
_SPLIT = re.compile(r"(\w.*)_(train|val)\.csv")


@dataclass(frozen=True)
class Files:
    """A file of tracks and what it is read with."""

    tracks: Path
    part: str
    map: Path
    walkers: Path | None = None
    meta: Path | None = None
    phases: Path | None = None
    topology: Path | None = None


def find_files(path: Path) -> Files:
    """The files a file of tracks is read with; a :class:`DataError` if it is named otherwise, or has no map."""
    numbered, split = _NUMBERED.fullmatch(path.name), _SPLIT.fullmatch(path.name)
    if numbered is None:
        if split is None:
            raise DataError("expected a name like vehicle_tracks_000.csv or SCENE_train.csv", file=path)
        # Its name says which map it needs: another place's would fit nowhere, and nobody would be told.
        return Files(path, split[2], _map(path, split[1], alone=False))
    folder, number_ = path.parent, numbered[1]

    def beside(name: str) -> Path | None:
        return folder / name if (folder / name).is_file() else None

    topology = sorted(folder.glob("*_map.kml"))
    return Files(
        path,
        number_,
        _map(path, folder.resolve().name),
        beside(f"pedestrian_tracks_{number_}.csv"),
        beside("meta_data.csv"),
        beside(f"signal_phases_{number_}.csv"),
        topology[0] if len(topology) == 1 else None,
    )


def _map(path: Path, scene: str, *, alone: bool = True) -> Path:
    """The map of a place; if ``alone``, a single map beside the tracks does, whatever its name."""
    folders = (path.parent, path.parent.parent / "maps", path.parent.parent.parent / "maps")
    for folder in folders:
        for suffix in ("osm_xy", "osm"):
            if (folder / f"{scene}.{suffix}").is_file():
                return folder / f"{scene}.{suffix}"
    if not alone:
        raise DataError(f"the map is missing: no maps/{scene}.osm_xy or .osm", file=path)
    maps = sorted(path.parent.glob("*.osm")) + sorted(path.parent.glob("*.osm_xy"))
    if len(maps) != 1:
        raise DataError(
            f"the map is missing: no maps/{scene}.osm, and not one map beside the tracks", file=path
        )
    return maps[0]


def read_meta(path: Path, part: str) -> tuple[Doubles, bool]:
    """(latitude and longitude of the origin [2], whether there are signal phases) of a recording."""
    try:
        data = path.read_bytes()
        if not data.endswith(b"\n") or len(data) > 1 << 20:
            raise DataError("empty, cut short, or larger than 1 MiB")
        table = csv.DictReader(io.StringIO(data.decode("ascii", errors="replace")))
        found = [row for row in table if row.get("id") == part]
        if len(found) != 1:
            raise DataError(f"{len(found)} rows for recording {part}, expected one", field="id")
        origin = np.array([number(found[0].get(name), name) for name in ("originLat", "originLon")])
        # Both spellings occur.
        spat = found[0].get("spatAvailable") or found[0].get("spatAvailible") or "no"
        if spat not in {"yes", "no"}:
            raise DataError(f"{spat[:20]!r} is neither yes nor no", field="spatAvailable")
        return origin, spat == "yes"
    except csv.Error as error:
        raise DataError(f"not a CSV file: {error}", file=path) from error
    except DataError as error:
        raise error.at(file=path) from error
