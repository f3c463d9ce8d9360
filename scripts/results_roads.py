"""Tables of real roads."""

from __future__ import annotations

import json

import numpy as np

from results_base import COLUMNS, PLAYBACK, RECORDS, Grid, Record, figures, over, records

REAL = {"US101": "US-101", "Lanker": "Lankershim", "Peach": "Peachtree"}
ROAD_BASELINES = (("log playback", "playback"), ("constant velocity", "constant_velocity"), ("IDM", "idm"))
ROAD_AGENTS = {
    "paper": "BC, the paper's inputs",
    "bc": "BC",
    "bc_h": "BC+H",
    "bc_ts": "BC+TS",
    "none": "BC+TS+H without its search",
    "bc_ts_h": "BC+TS+H",
    "mgail_ts_h": "MGAIL+TS+H",
}
LEARNED_FROM = {
    "sumo": "SUMO",
    "ngsim": "NGSIM",
    "both": "SUMO, NGSIM",
    "included": "SUMO, NGSIM, longer",
    "rate": "SUMO, NGSIM, rate 0.01",
}
ELSEWHERE = {
    "2-constant_velocity": "driving/ngsim-constant-velocity",
    "2-included-none": "driving/ngsim-none",
    "2-included-bc_ts_h": "driving/ngsim-replace-branch",
    "2-rate-paper": "driving/ngsim-bc",
    "2-rate-mgail_ts_h": "half/ngsim-mgail_ts_h-40",
    **{f"2-rate-{method}": f"eight/ngsim-{method}-40" for method in ("bc", "bc_h", "bc_ts", "bc_ts_h")},
}
"""Records of the table on real roads that other tables have, too."""
UNSEEN = {"womd": "WOMD", "argoverse2": "Argoverse 2", "interaction": "INTERACTION", "nuscenes": "nuScenes"}
UNSEEN_ROWS = (
    ("log playback", "idm", "playback"),
    ("constant velocity", "idm", "constant_velocity"),
    ("IDM", "idm", ""),
    ("BC", "bc", ""),
    ("BC+TS+H without its search", "bc_h", ""),
    ("BC+TS+H", "bc_ts_h", ""),
    ("MGAIL+TS+H", "mgail_ts_h", ""),
)
KINDS = {
    "collision_rate": ("collisions %", 1),
    "collision_with_playback": ("with playback", 1),
    "collision_into_leader": ("into a leader", 1),
    "collision_rear_ended": ("rear-ended", 1),
    "collision_crossing": ("crossing", 1),
    "collision_oncoming": ("oncoming", 1),
    "collision_sideswipe": ("sideswipe", 1),
}
"""Collisions by kind: their headings, and the digits after their points."""
NO_CARS = {"collision_pedestrian": ("into a pedestrian", 1), "collision_cyclist": ("into a cyclist", 1)}
ROWS_IN_SHORT = (*(label for label, _ in ROAD_BASELINES), "BC", "BC+TS+H without its search", "BC+TS+H")
OTHERWISE = {name: COLUMNS[name] for name in ("offroad_time", "ade", "min_sade")}
IN_SHORT = {
    "collision_rate": ("collisions %", 1),
    "collision_with_playback": ("with playback %", 1),
} | OTHERWISE


def road_rows(count: int) -> list[tuple[str, str, Record]]:
    """What was learned from, agent and record on the NGSIM test part, as far as there are records, for a number of
    interactive agents.
    """
    names = [("", label, name) for label, name in ROAD_BASELINES]
    for data, source in LEARNED_FROM.items():
        for method, label in ROAD_AGENTS.items():
            names.append((source, label, f"{data}-{method}"))
    found = []
    for source, label, name in names:
        path = RECORDS / f"roads/{count}-{name}.json"
        if not path.is_file() and f"{count}-{name}" in ELSEWHERE:
            path = RECORDS / f"{ELSEWHERE[f'{count}-{name}']}.json"
        if path.is_file():
            found.append((source, label, json.loads(path.read_text())))
    return found


def by_place(count: int) -> Grid:
    """Each place of the NGSIM test part: collisions (in brackets those with playback vehicles) and ADE."""
    head = [f"{place}: {what}" for place in REAL.values() for what in ("collisions %", "ADE m")]
    grid = [["", "learned from", *head]]
    for source, label, record in road_rows(count):
        line = [label, source]
        for place in REAL:
            rows = [row for row in record["per_segment"] if place in row["group"]]
            ghosts = np.mean([row["collision_with_playback"] for row in rows])
            line += [f"{over(rows, 'collision_rate', 1)} ({ghosts:.1f})", over(rows, "ade", 2)]
        grid.append(line)
    return grid


def by_kind(count: int) -> Grid:
    """The NGSIM test part as a whole: collisions by kind."""
    columns = KINDS | OTHERWISE
    grid = [["", "learned from", *(heading for heading, _ in columns.values())]]
    return grid + [[label, source, *figures(record, columns)] for source, label, record in road_rows(count)]


def roads() -> Grid:
    """The NGSIM test part in short: the rows that answer what was learned from what."""
    grid = [["", "learned from", *(heading for heading, _ in IN_SHORT.values())]]
    for source, label, record in road_rows(2):
        if label in ROWS_IN_SHORT:
            grid.append([label, source, *figures(record, IN_SHORT)])
    return grid


def elsewhere() -> Grid:
    """Real roads that no agent has learned from, side by side: collisions and ADE."""
    columns = {name: COLUMNS[name] for name in ("collision_rate", "ade")}
    found = {
        (data, name): records(f"roads/{data}-{name}")[0] for data in UNSEEN for _, name, _ in UNSEEN_ROWS
    }
    grid = [["", *(f"{title}: {heading}" for title in UNSEEN.values() for heading, _ in columns.values())]]
    for label, name, part in UNSEEN_ROWS:
        rows = [found[data, name] for data in UNSEEN]
        cells = [cell for row in rows for cell in figures(row[part] if part else row, columns)]
        grid.append([label, *cells])
    return grid


def unseen() -> Grid:
    """Real roads that no agent has learned from, one set after the other."""
    columns = KINDS | NO_CARS | OTHERWISE
    grid = [["", "", *(heading for heading, _ in columns.values())]]
    for data, title in UNSEEN.items():
        for label, name, part in UNSEEN_ROWS:
            (record,) = records(f"roads/{data}-{name}")
            size = f"{title} ({record['segments']} segments, {record['groups']} recordings)"
            row = record[part] if part else record
            grid.append([size if label == PLAYBACK else "", label, *figures(row, columns)])
    return grid
