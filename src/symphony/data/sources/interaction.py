"""Reader of recordings in the format of the INTERACTION dataset: tracks in CSV with a Lanelet2 map.

Three layouts are known, SCENE being the place; everything may also lie in one folder, if it has a single map:

- ``recorded_trackfiles/SCENE/vehicle_tracks_<N>.csv`` with ``pedestrian_tracks_<N>.csv`` where there are any
  (INTERACTION 1.0 and 1.1), and ``maps/SCENE.osm_xy`` or ``maps/SCENE.osm`` beside ``recorded_trackfiles``;
- the same with ``meta_data.csv``, ``signal_phases_<N>.csv`` and ``*_map.kml`` in the folder of the tracks (Test Area
  Autonomous Driving Baden-Württemberg);
- ``train/SCENE_train.csv`` and ``val/SCENE_val.csv`` with many cases each (INTERACTION 1.2), maps as before.

A recording is cut into windows; a case is one segment, whose first second is history. ``segment_id`` is the map's
name, the file's number or split, the case or the window's first second, and the ego, which is picked as in the
CommonRoad reader; ``group`` is the file. Coordinates are relative to the middle of the map, so that all windows share
one map. A map in degrees is projected: by a spherical Mercator, true to length at the origin that ``meta_data.csv``
names, where there is one; else by UTM relative to latitude and longitude 0, as INTERACTION's own scripts do.

``signal_phases_<N>.csv`` gives the state of each signal group by time (names of SAE J2735's movement phases); the KML
file says which signal group lets traffic from the end of one lane into another, both of them lines that begin at the
junction. As in WOMD, a light belongs to the lane behind it: of the lanes that are entered from another, each gets the
nearest such connection that begins and ends where it does; pedestrians' lights find none. A stop line that the map
names is better than the end of a KML lane.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.resample import MAX_GAP, evened
from symphony.data.segment import AgentType, Bools, Floats, RoadMap, RunSegment, SignalState, check_counts
from symphony.data.sources import base, lanelet2, lines
from symphony.data.sources import interaction_tracks as tracks
from symphony.data.sources.base import Doubles, Item, Reader, check_choice, located, read_whole, refuse
from symphony.data.sources.interaction_tracks import NOMINAL, Rows
from symphony.errors import ConfigError, DataError

FAR = 200.0  # metres between a recording and the box around its map beyond which they don't belong together
HISTORY = 9  # the last step of a case's first second
MAX_STEPS = 360_000  # steps of a recording, which is cut into windows: ten hours at 10 Hz
START, END = 3.0, 8.0  # metres by which a lane's start and end may miss those of a connection
LATE = 5000  # milliseconds by which the phases may end before the tracks (in the one real recording: 1200)

_KML = "{http://www.opengis.net/kml/2.2}"
_PHASES = {
    "UNAVAILABLE": SignalState.UNKNOWN,
    "DARK": SignalState.UNKNOWN,
    "STOP_THEN_PROCEED": SignalState.FLASHING_STOP,
    "STOP_AND_REMAIN": SignalState.STOP,
    "PRE_MOVEMENT": SignalState.STOP,
    "PERMISSIVE_MOVEMENT_ALLOWED": SignalState.GO,
    "PROTECTED_MOVEMENT_ALLOWED": SignalState.ARROW_GO,
    "PERMISSIVE_CLEARANCE": SignalState.CAUTION,
    "PROTECTED_CLEARANCE": SignalState.ARROW_CAUTION,
    "CAUTION_CONFLICTING_TRAFFIC": SignalState.FLASHING_CAUTION,
}
_PHASE_COLUMNS = ("signal_group_id", "timestamp_ms", "movement_state")
_NUMBERED = re.compile(r"vehicle_tracks_(\w+)\.csv")
_SPLIT = re.compile(r"(\w.*)_(train|val)\.csv")

Times = NDArray[np.int64]  # milliseconds
Lights = dict[int, tuple[Doubles, Times, lines.Codes]]
"""Lane -> (its stop point [2] in metres, milliseconds [N] from which a state holds, that state [N])."""


class InteractionReader(Reader):
    """Reads INTERACTION-format recordings.

    Args:
        egos: ``"one"`` picks an ego per window, ``"all"`` gives a segment for each vehicle that moves and is seen at
            every step, as in :class:`~symphony.data.sources.commonroad.CommonRoadReader`.
        window: seconds of a segment. The rest of a recording counts if it is at least half as long; so does the
            time for which a vehicle is seen, where none is seen throughout a window.
        stride: seconds between the starts of windows; by default ``window``, so that they don't overlap.
        motion: ``"logged"`` takes velocities and headings as they are, and refuses a file where they are not those of
            its positions; ``"positions"`` computes velocities, replaces headings that are far off the motion, and
            takes the mean of states logged twice.

    Raises a :class:`ConfigError` for a value out of range.
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
        check_choice("egos", egos, "one", "all")
        check_choice("motion", motion, "logged", "positions")
        self.egos, self.by_positions, self.window = egos, motion == "positions", window
        self.stride = window if stride is None else stride
        for name, seconds in (("window", self.window), ("stride", self.stride)):
            if not 0 < seconds <= 600:
                raise ConfigError(f"{name} must be above 0 and at most 600 s, is {seconds}")

    def companions(self, path: Path) -> tuple[Path, ...]:
        """Return the map, and whatever else the recording has."""
        try:
            found = find_files(path)
        except DataError:
            return ()
        more = (found.map, found.walkers, found.meta, found.phases, found.topology)
        return tuple(file for file in more if file is not None)

    def _read(self, path: Path) -> Iterator[Item]:
        rows = tracks.read_rows(path)
        files = find_files(path)
        if files.walkers is not None:
            rows = tracks.joined(rows, tracks.read_rows(files.walkers))
        rows, dt, start = tracks.stepped(rows)
        if self.by_positions:
            rows = tracks.merged(rows)
        else:
            tracks.check_motion(rows, dt, start)
        rows = tracks.resolved(rows, dt, by_positions=self.by_positions)
        scene = _scene(files, rows, dt, start)
        for case in np.unique(rows.case):
            mine = rows.take(slice(*np.searchsorted(rows.case, [case, case + 1])))
            first = int(mine.time[0])
            steps = int(mine.time[-1]) - first + 1
            refuse(steps > MAX_STEPS, f"{steps} steps, at most {MAX_STEPS} can be read", "timestamp_ms")
            mine, seen = tracks.completed(mine, dt, by_positions=self.by_positions), set[tuple[int, int]]()
            for at, end in self._windows(steps, dt) if files.single else [(0, steps)]:
                window = first + at, first + end
                what = f"t{round(at * dt, 3):g}" if files.single else f"case{case}"
                # A map may have another name than the folder, which those of other recordings have, too.
                place = [files.tracks.parent.name] * files.single + [files.map.stem]
                name = "_".join([*dict.fromkeys(place), files.part, what])
                begin, stop = _observed(mine.between(*window), *window, dt) if files.single else window
                if (begin, stop) in seen:  # windows that overlap, cut to the same part
                    continue
                seen.add((begin, stop))
                try:
                    yield from self._window(mine.between(begin, stop), scene, name, begin, stop - begin)
                except DataError as error:
                    yield error.at(segment=name)

    def _windows(self, steps: int, dt: float) -> Iterator[tuple[int, int]]:
        """Yield the first step and the one after the last of each window."""
        length, stride = (max(round(s / dt), 1) for s in (self.window, self.stride))
        for start in range(0, max(steps - 1, 1), stride):
            stop = min(start + length + 1, steps)
            if start == 0 or 2 * (stop - start - 1) >= length:
                yield start, stop

    def _window(self, rows: Rows, scene: _Scene, name: str, begin: int, steps: int) -> Iterator[RunSegment]:
        refuse(not len(rows), "no agent is present", "track_id")
        ids, first, row = np.unique(rows.track, return_index=True, return_inverse=True)
        check_counts(len(ids), steps, "track_id")
        kind = rows.kind[first]
        mixed = rows.track[rows.kind != kind[row]]
        refuse(len(mixed), f"track {mixed[:1]} has more than one", "agent_type")
        state, valid = np.zeros((len(ids), steps, 5)), np.zeros((len(ids), steps), np.bool_)
        step = rows.time - begin
        state[row, step], valid[row, step] = rows.state[:, :5], True
        state[valid, :2] -= scene.origin
        there = np.flatnonzero(~_lost(valid, scene.dt))
        state, valid = state[:, there], valid[:, there]
        kinds = kind.astype(np.uint8)
        candidates = base.busiest_first(ids, kinds, state[..., :2], valid)
        refuse(not len(candidates), "no moving vehicle is observed at every step", "track_id")
        times = np.rint(scene.start + 1000 * scene.dt * (begin + there)).astype(np.int64)
        shown = {k: (place, _states_at(since, s, times)) for k, (place, since, s) in scene.lights.items()}
        current = 0 if scene.files.single else HISTORY - begin * (begin <= HISTORY)
        segment = RunSegment(
            segment_id=name,
            source=self.name,
            dt=scene.dt,
            ego=int(candidates[0]),
            agent_id=ids,
            agent_type=kinds,
            size=_sizes(rows, row, kinds),
            **base.motion(state[..., :2], state[..., 4], state[..., 2:4], valid),
            origin=np.array([*scene.origin, 0.0]),
            road=scene.road,
            **lines.lights(shown, len(there), scene.origin),
            current_step=min(int(np.searchsorted(there, current)), len(there) - 1),
            predict=np.unique(row[rows.marks[:, 0]]).astype(np.int32),
            interest=np.unique(row[rows.marks[:, 1]]).astype(np.int32),
            file=scene.files.tracks.name,
            group=name.rpartition("_")[0],
            odd=scene.odd,
        )
        segment = evened(segment, there.astype(np.float64) * scene.dt)
        yield from base.by_ego(segment, candidates, self.egos)


def _observed(rows: Rows, begin: int, stop: int, dt: float) -> tuple[int, int]:
    """Return the window, or its longest part, at least half of it, in which one vehicle that moves is always seen."""
    times, step = np.unique(rows.time, return_inverse=True)  # at others the frame may be lost
    best = times[:0]
    for track in np.unique(rows.track[rows.kind == AgentType.VEHICLE]):
        mine = np.flatnonzero(rows.track == track)
        unseen = (np.diff(step[mine]) != 1) | (np.diff(rows.time[mine]) * dt > MAX_GAP + 1e-6)
        for part in np.split(mine, np.flatnonzero(unseen) + 1):
            moves = np.linalg.norm(rows.state[part, :2] - rows.state[part[0], :2], axis=-1).max() > base.MOVING
            best = times[step[part]] if moves and len(part) > len(best) else best
    whole = not len(best) or 2 * (best[-1] - best[0]) < stop - begin - 1
    return (begin, stop) if whole else (int(best[0]), int(best[-1]) + 1)


def _lost(valid: Bools, dt: float) -> Bools:
    """Return [T] steps at which a recording lost the frame: no agent for at most :data:`.resample.MAX_GAP`."""
    lost = np.zeros(valid.shape[1], np.bool_)
    for before, after in pairwise(np.flatnonzero(valid.any(axis=0)).tolist()):
        lost[before + 1 : after] = (after - before) * dt <= MAX_GAP
    return lost


def _sizes(rows: Rows, row: NDArray[np.int64], kind: NDArray[np.uint8]) -> Floats:
    """Return [A, 3] the first size given of each agent, else the nominal one; height 0."""
    size = np.zeros((len(kind), 3))
    for k, sides in NOMINAL.items():
        size[kind == k, :2] = sides
    given = np.flatnonzero((rows.state[:, 5:7] > 0).all(axis=1))[::-1]
    size[row[given], :2] = rows.state[given, 5:7]  # the first one is written last
    return base.to_float32(size)


@dataclass(frozen=True)
class _Scene:
    """The data that the windows of one file share; ``start`` is the time of step 0 in milliseconds."""

    files: Files
    dt: float
    start: float
    road: RoadMap
    lights: Lights
    origin: Doubles
    odd: Mapping[str, str]


def _scene(files: Files, rows: Rows, dt: float, start: float) -> _Scene:
    projection: lanelet2.Projection = partial(lanelet2.utm, origin=np.zeros(2))
    has_phases = files.phases is not None
    if files.meta is not None:
        origin, has_phases = _read_meta(files.meta, files.part)
        projection = partial(lanelet2.mercator, origin=origin)
    source = lanelet2.read_lanelet2(files.map, projection)
    with located(file=files.map):
        lanes = lanelet2.lane_lanelets(source)
        origin, links = lanelet2.middle(source), lanelet2.successors(lanes)
        road = lanelet2.road_map(source, origin)
    found: Lights = {}
    if has_phases:
        if files.phases is None or files.topology is None:
            raise DataError("its signal phases, or the one *_map.kml that goes with them, are missing")
        entered = {lane: lanes[lane].center for lane in np.unique(links[:, 1]).tolist()}
        until = int(start + 1000 * dt * rows.time.max())
        found = _read_lights(files.phases, files.topology, entered, projection, until)
        for before, after in links.tolist():
            line = lanelet2.stop_line(lanes[before], source.rules)
            if after in found and line is not None:
                found[after] = (line, *found[after][1:])
    reach = np.abs(np.concatenate([lane.ring for lane in lanes]) - origin).max(axis=0)
    away = np.hypot(*np.maximum(np.abs(rows.state[:, :2] - origin) - reach, 0).T)
    far = float(np.median(away))
    refuse(far > FAR, f"the tracks are {far:.0f} m away from the map: another origin or projection", "x, y")
    return _Scene(files, dt, start, road, found, origin, source.odd)


@dataclass(frozen=True)
class Files:
    """A file of tracks and the files that it is read with; ``single`` means one recording, not many cases."""

    tracks: Path
    part: str
    map: Path
    single: bool
    walkers: Path | None = None
    meta: Path | None = None
    phases: Path | None = None
    topology: Path | None = None


def find_files(path: Path) -> Files:
    """Return the files that a file of tracks is read with; a :class:`DataError` for an odd name or a missing map."""
    path = Path(os.path.abspath(path))  # from which one can climb; links stay
    numbered, split = _NUMBERED.fullmatch(path.name), _SPLIT.fullmatch(path.name)
    if numbered is None:
        if split is None:
            raise DataError("expected a name like vehicle_tracks_000.csv or SCENE_train.csv", file=path)
        # Its name says which map it needs: another place's would not fit, and no error would say so.
        return Files(path, split[2], _map(path, split[1], alone=False), single=False)
    folder, part = path.parent, numbered[1]
    names = f"pedestrian_tracks_{part}.csv", "meta_data.csv", f"signal_phases_{part}.csv"
    beside = [folder / name if (folder / name).is_file() else None for name in names]
    topology = sorted(folder.glob("*_map.kml"))
    beside.append(topology[0] if len(topology) == 1 else None)
    return Files(path, part, _map(path, folder.name, alone=True), True, *beside)


def _map(path: Path, scene: str, *, alone: bool) -> Path:
    """Return the map of a place; if ``alone``, a single map beside the tracks is taken, whatever its name."""
    for folder in (path.parent, path.parent.parent / "maps", path.parent.parent.parent / "maps"):
        for suffix in ("osm_xy", "osm"):
            if (folder / f"{scene}.{suffix}").is_file():
                return folder / f"{scene}.{suffix}"
    maps = [*path.parent.glob("*.osm"), *path.parent.glob("*.osm_xy")] if alone else []
    refuse(len(maps) != 1, f"the map is missing: no maps/{scene}.osm or .osm_xy, or one alone", file=path)
    return maps[0]


def _lines(path: Path, most: int) -> list[list[str]]:
    """Return the fields of each line of a small table of comma-separated values."""
    data = read_whole(path, most)
    refuse(not data.endswith(b"\n"), "the last line is not complete: the file was cut short")
    text = data.decode("ascii", errors="replace")
    return [[field.strip() for field in line.split(",")] for line in text.split("\n")[:-1]]


def _read_meta(path: Path, part: str) -> tuple[Doubles, bool]:
    """Return latitude and longitude of a recording's origin [2], and whether there are signal phases."""
    with located(file=path):
        head, *rows = _lines(path, 1 << 20)
        found = [row for row in (dict(zip(head, row, strict=False)) for row in rows) if row.get("id") == part]
        refuse(len(found) != 1, f"{len(found)} rows for recording {part}, expected one", "id")
        origin = np.array([base.number(found[0].get(name), name) for name in ("originLat", "originLon")])
        # Both spellings occur.
        spat = found[0].get("spatAvailable") or found[0].get("spatAvailible") or ""
        refuse(spat not in {"yes", "no"}, f"{spat[:20]!r} is neither yes nor no", "spatAvailable")
        return origin, spat == "yes"


def _states_at(since: Times, states: lines.Codes, times: Times) -> lines.Codes:
    """Return [T] states of a light at times in milliseconds: the latest known, UNKNOWN before the first."""
    last = np.searchsorted(since, times, side="right") - 1
    return np.where(last >= 0, states[last], SignalState.UNKNOWN).astype(np.uint8)


def _read_lights(
    phases: Path, topology: Path, lanes: Mapping[int, Doubles], projection: lanelet2.Projection, until: int
) -> Lights:
    """Return the lights of lanes [P, 2] that are entered from another, for tracks that end at ``until`` ms."""
    groups = _read_phases(phases)
    end = min(int(times[-1]) for times, _ in groups.values())
    refuse(end < until - LATE, f"end at {end} ms, the tracks at {until} ms", "timestamp_ms", file=phases)
    connections = [each for each in _read_connections(topology, projection) if each.group in groups]
    found: Lights = {}
    for lane, line in lanes.items():
        misses = [(np.hypot(*(line[0] - one.start)), np.hypot(*(line[-1] - one.end))) for one in connections]
        near = [(a + b, k) for k, (a, b) in enumerate(misses) if a <= START and b <= END]
        if near:
            best = connections[min(near)[1]]
            found[lane] = (best.start, *groups[best.group])
    refuse(not found, "no connection with a signal group fits a lane of the map", file=topology)
    return found


def _read_phases(path: Path) -> dict[int, tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """Return signal group -> (times [N] in milliseconds, rising; states [N] from then on)."""
    with located(file=path):
        head, *rows = _lines(path, tracks.MAX_BYTES)
        empty = tuple(head) != _PHASE_COLUMNS or not rows
        refuse(empty, f"expected rows of {', '.join(_PHASE_COLUMNS)}", "line 1")
        entries: dict[int, dict[int, int]] = {}
        for k, row in enumerate(rows, start=2):
            if len(row) != len(_PHASE_COLUMNS) or row[2] not in _PHASES:
                raise DataError(f"{','.join(row)[:60]!r} is not a phase", field=f"line {k}")
            group, time = (base.integer(entry, f"line {k}") for entry in row[:2])
            state = _PHASES[row[2]]
            if entries.setdefault(group, {}).setdefault(time, state) != state:
                raise DataError(f"signal group {group} has two states", field=f"line {k}")
    ordered = {group: np.array(sorted(states.items()), np.int64) for group, states in entries.items()}
    return {group: (states[:, 0], states[:, 1].astype(np.uint8)) for group, states in ordered.items()}


class _Connection(NamedTuple):
    """A way through the junction: from a stop point [2] to an exit [2], let go by a signal group."""

    start: Doubles
    end: Doubles
    group: int


def _read_connections(path: Path, projection: lanelet2.Projection) -> list[_Connection]:
    """Return the connections that a signal group controls."""
    with located(file=path):
        starts: dict[int, Doubles] = {}
        wanted: list[tuple[int, int, int]] = []
        for place in base.load_xml(path, "KML").iter(f"{_KML}Placemark"):
            line = place.find(f"{_KML}LineString/{_KML}coordinates")
            data = {node.get("name"): node.findtext(f"{_KML}value") for node in place.iter(f"{_KML}Data")}
            if line is None or "Source" not in data:
                continue
            sources, sinks, groups = (
                [base.integer(part, name) for part in (data.get(name) or "").split(",") if part.strip()]
                for name in ("Source", "Sink", "SignalGroup")
            )
            refuse(len(sources) != 1, f"{str(data['Source'])[:40]!r} is not one lane", "Source")
            refuse(len(sinks) != len(groups), f"{len(groups)} for {len(sinks)} sinks", "SignalGroup")
            # A line of longitude,latitude,height, of which the first point counts.
            first = ((line.text or "").split() or [""])[0].split(",")
            refuse(len(first) < 2, "has no points", f"lane {sources[0]}: coordinates")
            longitude, latitude = (base.number(part, f"lane {sources[0]}: coordinates") for part in first[:2])
            starts[sources[0]] = projection(np.array([[latitude, longitude]]))[0]
            wanted += [(sources[0], sink, group) for sink, group in zip(sinks, groups, strict=True)]
        refuse(not wanted, "has no lanes with a signal group", "Placemark")
        return [_Connection(starts[a], starts[b], group) for a, b, group in wanted if b in starts]
