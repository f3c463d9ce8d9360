"""Small Lanelet2 maps and INTERACTION recordings, written by the tests themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

EARTH = 6_378_137.0
ORIGIN = (49.01, 8.43)
"""Latitude and longitude of the made recordings' origin."""

PLACES = [(0, 0), (50, 0), (0, 4), (50, 4), (0, 8), (50, 8), (100, 0), (100, 4), (100, 8)]
PLACES += [(46, -3), (46, 11), (50, -3), (50, 11)]
NODES = dict(enumerate(PLACES, start=1))
BORDER, DASHED = {"type": "road_border"}, {"type": "line_thin", "subtype": "dashed"}
WAYS = {
    21: ((1, 2), BORDER), 22: ((3, 4), DASHED),
    23: ((6, 5), BORDER),  # drawn against the traffic
    24: ((2, 7), BORDER), 25: ((4, 8), DASHED), 26: ((6, 9), BORDER),
    27: ((10, 11), {"type": "pedestrian_marking"}), 28: ((12, 13), {"type": "pedestrian_marking"}),
    29: ((2, 6), {"type": "stop_line"}), 30: ((7, 8), {"type": "traffic_sign", "subtype": "de206"}),
}  # fmt: skip
ROAD = {"type": "lanelet", "subtype": "road"}
LANELETS = {
    101: (22, 21, ROAD | {"maxspeed": "50"}, (201, 202)), 102: (23, 22, ROAD, ()), 103: (25, 24, ROAD, ()),
    104: (26, 25, ROAD, ()), 105: (27, 28, {"type": "lanelet", "subtype": "crosswalk"}, ()),
    106: (27, 28, {"type": "lanelet", "subtype": "walkway"}, ()),
}  # fmt: skip
RULES = {
    201: ({"subtype": "traffic_light"}, {"ref_line": 29}),
    202: ({"subtype": "speed_limit", "sign_type": "de274-30"}, {}),
}


def tag(tags: Mapping[str, str]) -> str:
    return "".join(f"<tag k='{k}' v='{v}'/>" for k, v in tags.items())


def degrees(x: float, y: float, origin: tuple[float, float] = ORIGIN) -> tuple[float, float]:
    """Latitude and longitude: the spherical Mercator undone."""
    scale = EARTH * np.cos(np.radians(origin[0]))
    north = np.arcsinh(np.tan(np.radians(origin[0]))) + y / scale
    return float(np.degrees(np.arctan(np.sinh(north)))), float(origin[1] + np.degrees(x / scale))


def node(name: int, x: float, y: float, how: str) -> str:
    if how == "xy":
        return f"<node id='{name}' x='{x}' y='{y}'/>"
    if how == "local":
        return f"<node id='{name}' lat='0' lon='0'>{tag({'local_x': str(x), 'local_y': str(y)})}</node>"
    lat, lon = degrees(x, y)
    return f"<node id='{name}' lat='{lat:.11f}' lon='{lon:.11f}'/>"


def osm(how="xy", nodes: Any = NODES, ways: Any = WAYS, lanelets: Any = LANELETS, rules: Any = RULES) -> str:
    """A map: by default two lanes of 100 m in two parts each, along +x, between y = 0 and 8."""
    parts = [node(name, *place, how) for name, place in nodes.items()]

    def element(kind: str, name: int, inner: Iterable[str], tags: Mapping[str, str]) -> None:
        parts.append(f"<{kind} id='{name}'>{''.join(inner)}{tag(tags)}</{kind}>")

    for name, (refs, tags) in ways.items():
        element("way", name, (f"<nd ref='{ref}'/>" for ref in refs), tags)
    for name, (left, right, tags, mine) in lanelets.items():
        inner = [member("way", left, "left"), member("way", right, "right")]
        element("relation", name, inner + [member("relation", r, "regulatory_element") for r in mine], tags)
    for name, (tags, lines) in rules.items():
        inner = [member("way", ref, role) for role, ref in lines.items()]
        element("relation", name, inner, {"type": "regulatory_element", **tags})
    return f"<?xml version='1.0' encoding='UTF-8'?>\n<osm version='0.6'>{''.join(parts)}</osm>\n"


def member(kind: str, ref: int | str, role: str) -> str:
    return f"<member type='{kind}' ref='{ref}' role='{role}'/>"


LOT = {41: (50, 8), 42: (50, 28), 43: (80, 28), 44: (80, 8), 51: (60, 15), 52: (70, 15), 53: (65, 25)}
"""Nodes of a parking lot beside the road, and of a house in it."""
FENCES = {61: (41, 42, 43), 62: (43, 44), 63: (44, 41), 64: (51, 52), 65: (52, 53, 51)}

PARKING = {"subtype": "parking"}


def with_area(tags: Any = PARKING, turned=(False,) * 5, members="61o 62o 63o 64i 65i") -> str:
    """The default map with a relation of type multipolygon, whose ways are drawn in either direction."""
    ways = {
        name: (refs[::-1] if turn else refs, {"type": "fence"})
        for (name, refs), turn in zip(FENCES.items(), turned, strict=True)
    }
    roles = {"o": "outer", "i": "inner"}
    inner = "".join(member("way", m[:-1], roles[m[-1]]) for m in members.split())
    relation = f"<relation id='301'>{inner}{tag({'type': 'multipolygon', **tags})}</relation>"
    return osm(nodes=NODES | LOT, ways=WAYS | ways).replace("</osm>", f"{relation}</osm>")


COLUMNS = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"
WALKERS = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy"


def track(name: Any, x=0.0, y=2.0, speed=10.0, steps=range(120), kind="car", logged=1.0) -> list[str]:
    """Rows of a car at constant speed along +x, its velocity logged that many times too large."""
    more = f"{y:.4f},{logged * speed:.4f},0.0,0.0,4.5,2.0"
    return [f"{name},{k + 1},{100 * k},{kind},{x + speed * k / 10:.4f},{more}" for k in steps]


def walker(name: str, speed: float = 1.5, steps: range = range(120)) -> list[str]:
    """Return rows of a person who crosses the road at x = 48, in the file of pedestrians and bicycles."""
    kind = "pedestrian/bicycle,48.0"
    return [f"{name},{k + 1},{100 * k},{kind},{-4 + speed * k / 10:.4f},0.0,{speed}" for k in steps]


def text(rows: Iterable[str], columns: str = COLUMNS) -> str:
    return "\n".join([columns, *rows, ""])


CARS = [*track(3), *track(5, x=-10, y=6, speed=9), *track(9, x=20, speed=0, y=2)]


def public(folder: Path, rows: Iterable[str] = CARS, walkers: Iterable[str] = (), scene="DR_X") -> Path:
    """A recording in the public layout; returns the file of tracks."""
    tracks, maps = folder / "recorded_trackfiles" / scene, folder / "maps"
    tracks.mkdir(parents=True, exist_ok=True)
    maps.mkdir(exist_ok=True)
    (maps / f"{scene}.osm_xy").write_text(osm())
    path = tracks / "vehicle_tracks_000.csv"
    path.write_text(text(rows))
    if walkers:
        (tracks / "pedestrian_tracks_000.csv").write_text(text(walkers, WALKERS))
    return path


META = [f"{part},10,{ORIGIN[0]},{ORIGIN[1]},{lit}" for part, lit in (("000", "no"), ("001", "yes"))]
META = text(META, "id,frameRate_hz,originLat,originLon,spatAvailible")


def place(source: int, point: tuple[float, float], sinks: str = "", groups: str = "") -> str:
    lat, lon = degrees(*point)
    values = {"Source": source, "Sink": sinks, "SignalGroup": groups}
    data = "".join(f"<Data name='{k}'><value>{v}</value></Data>" for k, v in values.items())
    points = f"{lon:.12f},{lat:.12f},0 {lon - 0.001:.12f},{lat:.12f},0"
    line = f"<LineString><coordinates>{points}</coordinates></LineString>"
    return f"<Placemark><name>Lane {source}</name>{line}<ExtendedData>{data}</ExtendedData></Placemark>"


PLACEMARKS = place(1, (49, 2), "11, 12", "7, 8") + place(2, (49, 6), "12", "8")
PLACEMARKS += place(11, (101, 2)) + place(12, (101, 6))
KML = f"<kml xmlns='http://www.opengis.net/kml/2.2'><Document>{PLACEMARKS}</Document></kml>\n"
STATES = {7: ("STOP_AND_REMAIN", "PERMISSIVE_MOVEMENT_ALLOWED"), 8: ("DARK", "PRE_MOVEMENT")}
PHASES = [f"{k},{t},{states[t >= 2000]}" for k, states in STATES.items() for t in range(0, 12000, 1000)]
PHASES = text(PHASES, "signal_group_id,timestamp_ms,movement_state")


def taf(folder: Path, part: str = "001", rows: Iterable[str] = CARS) -> Path:
    """A recording in the layout of the Test Area, with signal phases; returns the file of tracks."""
    tracks, maps = folder / "recorded_trackfiles" / "k1", folder / "maps"
    tracks.mkdir(parents=True, exist_ok=True)
    maps.mkdir(exist_ok=True)
    (maps / "k1.osm").write_text(osm("degrees"))
    (tracks / "meta_data.csv").write_text(META)
    if part == "001":
        (tracks / f"signal_phases_{part}.csv").write_text(PHASES)
        (tracks / "k1_map.kml").write_text(KML)
    path = tracks / f"vehicle_tracks_{part}.csv"
    path.write_text(text(rows))
    return path
