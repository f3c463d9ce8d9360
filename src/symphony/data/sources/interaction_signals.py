"""Signal phases beside INTERACTION-format tracks, as the Test Area Autonomous Driving Baden-Württemberg has them.

``signal_phases_<N>.csv`` gives the state of each signal group by time (names of SAE J2735's movement phases); a KML
file says which signal group lets traffic from the end of one lane into another. Both lanes are KML lines that begin
at the junction.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import SignalState
from symphony.data.sources.interaction_tracks import MAX_BYTES
from symphony.data.sources.lanelet2 import Projection
from symphony.data.sources.lines import Doubles
from symphony.data.sources.xml_files import integer, load_xml, number
from symphony.errors import DataError

START, END = 3.0, 8.0
"""Metres by which a lane's start and end may miss those of a connection."""
LATE = 5000
"""Milliseconds by which the phases may end before the tracks (in the one real recording: 1200)."""

_KML = "{http://www.opengis.net/kml/2.2}"
_STATES = {
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
_COLUMNS = ("signal_group_id", "timestamp_ms", "movement_state")


class Connection(NamedTuple):
    """A way through the junction: from a stop point [2] to an exit [2], let go by a signal group."""

    start: Doubles
    end: Doubles
    group: int


Lights = dict[int, tuple[Doubles, NDArray[np.int64], NDArray[np.uint8]]]
"""Lane -> (its stop point [2] in metres, milliseconds [N] from which a state holds, that state [N])."""


def states_at(
    since: NDArray[np.int64], states: NDArray[np.uint8], times: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """[T] states of a light at times in milliseconds: the latest known, UNKNOWN before the first."""
    last = np.searchsorted(since, times, side="right") - 1
    return np.where(last >= 0, states[last], SignalState.UNKNOWN).astype(np.uint8)


def read_lights(
    phases: Path, topology: Path, lanes: Mapping[int, Doubles], projection: Projection, until: int
) -> Lights:
    """Read both files and find the lane of each connection.

    As in WOMD, a light belongs to the lane behind it. Of the lanes that are entered from another, each gets the
    nearest connection that begins and ends where it does, within :data:`START` and :data:`END`; pedestrians' lights
    find none.

    Args:
        phases: the CSV file.
        topology: the KML file.
        lanes: centre lines [P, 2] in metres of the lanes that are entered from another.
        projection: of the map.
        until: milliseconds at which the tracks end.

    Raises:
        DataError: a file can't be read, the phases end more than :data:`LATE` before the tracks, or no light belongs
            to any lane.
    """
    groups = read_phases(phases)
    end = min(int(times[-1]) for times, _ in groups.values())
    if end < until - LATE:
        raise DataError(f"end at {end} ms, the tracks at {until} ms", file=phases, field="timestamp_ms")
    connections = read_connections(topology, projection)
    found: Lights = {}
    for lane, line in lanes.items():
        near = [(_miss(c, line), k) for k, c in enumerate(connections) if c.group in groups]
        miss, best = min(near, default=(np.inf, 0))
        if np.isfinite(miss):
            found[lane] = (connections[best].start, *groups[connections[best].group])
    if not found:
        raise DataError("no connection with a signal group fits a lane of the map", file=topology)
    return found


def _miss(connection: Connection, line: Doubles) -> float:
    begin, end = np.hypot(*(line[0] - connection.start)), np.hypot(*(line[-1] - connection.end))
    return float(begin + end) if begin <= START and end <= END else np.inf


def read_phases(path: Path) -> dict[int, tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """Signal group -> (times [N] in milliseconds, rising; states [N] from then on)."""
    if path.stat().st_size > MAX_BYTES:
        raise DataError(f"more than {MAX_BYTES} bytes", file=path)
    data = path.read_bytes()
    if not data.endswith(b"\n"):
        raise DataError("the last line is not complete: the file was cut short", file=path)
    head, *lines = data.decode("ascii", errors="replace").split("\n")[:-1]
    if tuple(name.strip() for name in head.split(",")) != _COLUMNS or not lines:
        raise DataError(f"expected rows of {', '.join(_COLUMNS)}", file=path, field="line 1")
    entries: dict[int, dict[int, int]] = {}
    for k, line in enumerate(lines, start=2):
        fields = [field.strip() for field in line.split(",")]
        if len(fields) != len(_COLUMNS) or fields[2] not in _STATES:
            raise DataError(f"{line[:60]!r} is no phase", file=path, field=f"line {k}")
        group = integer(fields[0], f"line {k}: {_COLUMNS[0]}")
        time = integer(fields[1], f"line {k}: {_COLUMNS[1]}")
        if entries.setdefault(group, {}).setdefault(time, _STATES[fields[2]]) != _STATES[fields[2]]:
            raise DataError(f"signal group {group} has two states", file=path, field=f"line {k}")
    found = {}
    for group, states in entries.items():
        times = np.array(sorted(states), np.int64)
        found[group] = times, np.array([states[time] for time in times.tolist()], np.uint8)
    return found


def read_connections(path: Path, projection: Projection) -> list[Connection]:
    """The connections that a signal group controls."""
    try:
        root = load_xml(path, "KML")
        starts: dict[int, Doubles] = {}
        wanted: list[tuple[int, int, int]] = []
        for place in root.iter(f"{_KML}Placemark"):
            line = place.find(f"{_KML}LineString/{_KML}coordinates")
            data = {node.get("name"): node.findtext(f"{_KML}value") for node in place.iter(f"{_KML}Data")}
            if line is None or "Source" not in data:
                continue
            sources = _integers(data["Source"], "Source")
            if len(sources) != 1:
                raise DataError(f"{str(data['Source'])[:40]!r} is not one lane", field="Source")
            source = sources[0]
            starts[source] = _start(line.text, f"lane {source}", projection)
            field = f"lane {source}"
            sinks, groups = (
                _integers(data.get(name), f"{field}: {name}") for name in ("Sink", "SignalGroup")
            )
            if len(sinks) != len(groups):
                raise DataError(f"{len(groups)} for {len(sinks)} sinks", field=f"lane {source}: SignalGroup")
            wanted += [(source, sink, group) for sink, group in zip(sinks, groups, strict=True)]
        if not wanted:
            raise DataError("has no lanes with a signal group", field="Placemark")
        return [Connection(starts[a], starts[b], group) for a, b, group in wanted if b in starts]
    except DataError as error:
        raise error.at(file=path) from error


def _integers(text: str | None, field: str) -> list[int]:
    return [integer(part, field) for part in (text or "").split(",") if part.strip()]


def _start(text: str | None, field: str, projection: Projection) -> Doubles:
    """[2] the first point of a line of ``longitude,latitude,height``."""
    first = (text or "").split()[:1]
    if not first or first[0].count(",") < 1:
        raise DataError("has no points", field=f"{field}: coordinates")
    longitude, latitude = (number(part, f"{field}: coordinates") for part in first[0].split(",")[:2])
    return projection(np.array([[latitude, longitude]]))[0]
