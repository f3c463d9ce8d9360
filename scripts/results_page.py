"""Write the tables of the pages from the records in `results/`, between their markers.

    python scripts/results_page.py            # rewrites the pages
    python scripts/results_page.py --check    # says what differs, and fails if anything does

A block is `<!-- table NAME -->`, the table, `<!-- end table -->`. What a name stands for is in TABLES below.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from symphony.evaluation.comparison import Entry
from symphony.evaluation.paired import clustered_mean
from symphony.evaluation.paper import paper_figures
from symphony.evaluation.planners import crowd_name, paired_difference, planner_grid, planner_title
from symphony.evaluation.relations import grid, relations
from symphony.evaluation.wosac_table import read_wosac, wosac_grid

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "results"
PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("results", "appendix", "wosac", "planners", "rollouts")),
)
BLOCK = re.compile(r"(<!-- table ([a-z-]+) -->\n)(.*?)(<!-- end table -->)", re.DOTALL)

Record = dict[str, Any]
Grid = list[list[str]]

COLUMNS = {
    "collision_rate": ("collisions %", 1),
    "offroad_time": ("off-road %", 2),
    "ade": ("ADE m", 2),
    "min_sade": ("minSADE m", 2),
    "curvature_jsd": ("curvature JSD", 3),
}
"""Figures of a table: their headings, and the digits after their points."""

BC = (
    ("BC", "bc/bc-*-none"),
    ("BC+H", "bc/bc_h-*-none"),
    ("BC+TS", "bc/bc_ts-*-often"),
    ("BC+TS+H", "bc/bc_ts_h-*-often"),
)
MGAIL = (
    ("MGAIL", "mgail/mgail-*-none"),
    ("MGAIL+H", "mgail/mgail_h-*-none"),
    ("MGAIL+TS", "mgail/mgail_ts-*-often"),
    ("MGAIL+TS+H", "mgail/mgail_ts_h-*-often"),
)
FEATURES = (
    ("`paper`: positions, headings, speeds, sizes, map points", "features/paper/bc_ts_h-0-often"),
    (
        "`clearance`: also gaps between boxes, distance to the road's edge",
        "features/clearance/bc_ts_h-0-often",
    ),
    ("`foresight`: also the gaps of the next 2 s", "bc/bc_ts_h-0-often"),
)
HALVING = (
    ("BC+TS, halved every 2 s", "bc/bc_ts-*-tree"),
    ("BC+TS, resampled every 2 s", "bc/bc_ts-*-systematic"),
    ("BC+TS, resampled every 0.4 s", "bc/bc_ts-*-often"),
    ("BC+TS+H, halved every 2 s", "bc/bc_ts_h-*-tree"),
    ("BC+TS+H, resampled every 2 s", "bc/bc_ts_h-*-systematic"),
    ("BC+TS+H, resampled every 0.4 s", "bc/bc_ts_h-*-often"),
    ("MGAIL+TS, halved every 2 s", "mgail/mgail_ts-*-tree"),
    ("MGAIL+TS, resampled every 0.4 s", "mgail/mgail_ts-*-often"),
    ("MGAIL+TS+H, halved every 2 s", "mgail/mgail_ts_h-*-tree"),
    ("MGAIL+TS+H, resampled every 0.4 s", "mgail/mgail_ts_h-*-often"),
)
WAYS = (
    ("one tree of 16, halved every 2 s", "bc/bc_ts_h-0-tree"),
    ("the same, pruned by the true flags", "bc/bc_ts_h-0-oracle"),
    ("one tree of 16, resampled every 0.4 s", "bc/bc_ts_h-0-often"),
    ("a leaf each of 16 trees of 4, resampled every 0.4 s", "bc/bc_ts_h-0-forest"),
    ("the leaves of 4 trees of 4, resampled every 2 s", "bc/bc_ts_h-0-small"),
    ("the best of 16 independent rollouts", "bc/bc_ts_h-0-best"),
    ("learned with resampling too: independent rollouts", "bc-resampled/bc_ts_h-0-none"),
    ("learned with resampling too: one tree, every 0.4 s", "bc-resampled/bc_ts_h-0-often"),
)
SEARCH = (
    ("log playback", "none", "playback"),
    ("constant velocity", "none", "constant_velocity"),
    ("no search", "none", ""),
    ("resampled, goals of the tree", "systematic-tree", ""),
    ("resampled, goals of each branch", "systematic-branch", ""),
    ("only the bad replaced, goals of each branch", "replace-branch", ""),
)
"""Ways to simulate one agent: label, end of the record's name, and the part of it that the row is of."""
REAL = {"US101": "US-101", "Lanker": "Lankershim", "Peach": "Peachtree"}
ROAD_BASELINES = (("log playback", "playback"), ("constant velocity", "constant_velocity"), ("IDM", "idm"))
ROAD_AGENTS = {
    "bc": "BC",
    "bc_h": "BC+H",
    "bc_ts": "BC+TS",
    "none": "BC+TS+H without its search",
    "bc_ts_h": "BC+TS+H",
    "mgail_ts_h": "MGAIL+TS+H",
}
LEARNED_FROM = {"sumo": "SUMO", "ngsim": "NGSIM", "both": "SUMO, NGSIM"}
ELSEWHERE = {
    "2-constant_velocity": "driving/ngsim-constant-velocity",
    "2-both-bc": "driving/ngsim-bc",
    "2-both-none": "driving/ngsim-none",
    "2-both-bc_ts_h": "driving/ngsim-replace-branch",
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
OTHERWISE = {name: COLUMNS[name] for name in ("offroad_time", "ade", "min_sade")}
WITH_ERROR = ("collision_rate", "ade", "min_sade")
DRIVEN = {"town": "towns", "ngsim": "real roads"}
INCLUDED = (
    ("log playback", "none", "playback"),
    ("constant velocity", "none", "constant_velocity"),
    ("BC", "bc", ""),
    ("BC+TS+H without its search", "none", ""),
    ("BC+TS+H", "replace-branch", ""),
)
LABELS = (
    ("BC+H, one route taught (seed 0)", "bc/bc_h-0-none"),
    ("BC+H, the set of open routes", "labels/bc_h-0-none"),
    ("BC+TS+H, one route taught (seed 0)", "bc/bc_ts_h-0-often"),
    ("BC+TS+H, the set of open routes", "labels/bc_ts_h-0-systematic"),
)
SEEDS = (("BC+TS+H without its search", "driving/{}-none*"), ("BC+TS+H", "driving/{}-replace-branch*"))
"""The included agent (seed 0) and those trained likewise of two more seeds."""
PLAYBACK = "log playback"
NGSIM = (
    (PLAYBACK, "ngsim/{}/playback"),
    ("constant velocity", "ngsim/{}/constant_velocity"),
    ("BC", "ngsim/{}/bc-0-none"),
    ("BC+H", "ngsim/{}/bc_h-0-none"),
    ("BC+TS", "ngsim/{}/bc_ts-0-often"),
    ("BC+TS+H", "ngsim/{}/bc_ts_h-0-often"),
    ("BC+TS+H, freeways among the simulated data", "ngsim-mixed/{}/bc_ts_h-0-often"),
)
WOSAC = (
    ("BC", "bc"),
    ("BC+H", "bc_h"),
    ("BC+H, goals of the log", "bc_h-logged"),
    ("BC+TS+H", "bc_ts_h"),
    ("BC+TS+H, goals of the log", "bc_ts_h-logged"),
    ("MGAIL+TS+H", "mgail_ts_h"),
    ("MGAIL+TS+H, goals of the log", "mgail_ts_h-logged"),
)
"""Rows of the WOSAC score, as far as there are records: label, end of the record's name."""
WOSAC_LOGS = (("sumo", "playback"), ("ngsim", "playback"), ("ngsim", "playback_thinned"))
OFFICIAL = (79.0, 139.0, 2.5)
"""Of the official code on the reference scenario: seconds on two cores, CPU seconds, GB."""
NAMES = {"mgail_h": "MGAIL+H", "mgail": "MGAIL"}


def records(pattern: str) -> list[Record]:
    """Those whose path below ``results/`` fits, by name.

    Raises:
        FileNotFoundError: if there is none.
    """
    found = [json.loads(path.read_text()) for path in sorted(RECORDS.glob(f"{pattern}.json"))]
    if not found:
        raise FileNotFoundError(f"no record fits results/{pattern}.json")
    return found


def means(rows: Sequence[tuple[str, str]], columns: Sequence[str] = tuple(COLUMNS)) -> Grid:
    """A line per row: means over seeds, with standard errors if there are several; the lowest simulated in bold."""
    values = [[[row[name] for row in records(pattern)] for name in columns] for _, pattern in rows]
    average = np.array([[np.mean(cell) for cell in line] for line in values])
    digits = [COLUMNS[name][1] for name in columns]
    simulated = average[[label != PLAYBACK for label, _ in rows]]
    lowest = [np.round(simulated[:, k], digits[k]).min() for k in range(len(columns))]
    grid = [["", *(COLUMNS[name][0] for name in columns)]]
    for (label, _), line in zip(rows, values, strict=True):
        cells = [_mean(cell, number) for cell, number in zip(line, digits, strict=True)]
        bold = [
            label != PLAYBACK and round(float(np.mean(cell)), digits[k]) == lowest[k]
            for k, cell in enumerate(line)
        ]
        grid.append([label, *(f"**{text}**" if b else text for text, b in zip(cells, bold, strict=True))])
    return grid


def beside(rows: Sequence[tuple[str, str]], groups: dict[str, str], columns: Sequence[str]) -> Grid:
    """The same rows for several folders (their names stand for ``{}``), side by side under headings of their own."""
    parts = {
        title: means([(label, pattern.format(folder)) for label, pattern in rows], columns)
        for folder, title in groups.items()
    }
    for title, part in parts.items():
        part[0][1] = f"{title}: {part[0][1]}"
    labels = ["", *(label for label, _ in rows)]
    lines = zip(*parts.values(), strict=True)
    return [
        [label, *(cell for part in line for cell in part[1:])]
        for label, line in zip(labels, lines, strict=True)
    ]


def setting(folder: str) -> Grid:
    """The eight methods in one of the paper's other settings."""
    rows = [(label, f"{folder}/{Path(pattern).name.replace('*', '0')}") for label, pattern in (*BC, *MGAIL)]
    return means(rows)


def held() -> Grid:
    """The paper's relations as `symphony table --relations` has them, those that the records can tell."""
    entries = []
    for _, pattern in (*BC, *MGAIL):
        entries += [_entry(record, pattern) for record in records(pattern)]
    return grid([relation for relation in relations(entries) if relation.held is not None])


def _entry(record: Record, pattern: str) -> Entry:
    """A record as the comparison reads it; older ones keep a list per metric instead of a row per run segment."""
    facts = record.get("run") or record
    rows = record["per_segment"]
    if isinstance(rows, dict):
        columns = {name: json.loads(values) for name, values in rows.items()}
        each = zip(*columns.values(), strict=True)
        rows = [{"segment": f"{k:04d}"} | dict(zip(columns, row, strict=True)) for k, row in enumerate(each)]
    config = {"method": facts["method"], "seed": facts["seed"]}
    return Entry(RECORDS, config, pattern, {"curvature": {}} | record | {"per_segment": rows})


def against_paper() -> Grid:
    """Collisions, time off the road and ADE beside the paper's on WOMD."""
    columns = ("collision_rate", "offroad_time", "ade")
    figures = paper_figures("main", "womd") or {}
    grid = [["", *(head for name in columns for head in (COLUMNS[name][0], "paper"))]]
    for label, pattern in (*BC, *MGAIL):
        line = [label]
        for name in columns:
            line.append(_mean([row[name] for row in records(pattern)], COLUMNS[name][1]))
            mean, error = figures[Path(pattern).name.split("-")[0]][name]
            line.append(f"{mean:.2f} ± {error:.2f}")
        grid.append(line)
    return grid


def sweep() -> Grid:
    """What every change of the adversarial settings did, paired over segments with the base."""
    grid = [["", "change", *(heading for heading, _ in COLUMNS.values()), "collisions against base", "AUC"]]
    for method, title in NAMES.items():
        rows = {row["name"]: row for row in records(f"sweep/{method}-*")}
        for name in sorted(rows, key=lambda name: (name != "start", name != "base", name)):
            row = rows[name]
            cells = [_mean([row[key]], digits) for key, (_, digits) in COLUMNS.items()]
            apart = "–" if name == "base" else paired([rows["base"]], [row], "collision_rate", 1)
            what = "the regression alone" if name == "start" else name
            grid.append([title, what, *cells, apart, f"{row['auc']:.2f}" if "auc" in row else "–"])
    return grid


def paired(before: Sequence[Record], after: Sequence[Record], name: str, digits: int) -> str:
    """By how much the second are above the first: mean over seeds and segments, standard error over segments."""
    rows = [
        np.array(json.loads(b["per_segment"][name])) - np.array(json.loads(a["per_segment"][name]))
        for a, b in zip(before, after, strict=True)
    ]
    each = np.mean(rows, 0)
    return f"{each.mean():+.{digits}f} ± {each.std(ddof=1) / len(each) ** 0.5:.{digits}f}"


def _mean(values: Sequence[float], digits: int) -> str:
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    error = np.std(values, ddof=1) / len(values) ** 0.5
    return f"{np.mean(values):.{digits}f} ± {error:.{digits}f}"


def searched(folder: str, data: str) -> Grid:
    """One agent simulated in several ways: errors over recordings, and CPU seconds per segment."""
    grid = [["", *(heading for heading, _ in COLUMNS.values()), "CPU s"]]
    for label, name, part in SEARCH:
        (record,) = records(f"{folder}/{data}-{name}")
        row = record[part] if part else record
        cells = [
            f"{row[key]:.{digits}f} ± {row[f'{key}_se']:.{digits}f}" for key, (_, digits) in COLUMNS.items()
        ]
        cost = "" if part else f"{record['cost']['simulation'] / record['segments']:.2f}"
        grid.append([label, *cells, cost])
    return grid


CROWD = ("2", "8", "16", "32", "all")
"""How many agents are driven."""
AGENTS = {
    "agent_collision_rate": ("collide %", 1),
    "agent_collision_into_leader": ("into a leader", 1),
    "agent_collision_rear_ended": ("rear-ended", 1),
    "agent_collision_sideswipe": ("sideswipe", 1),
    "agent_collision_crossing": ("crossing", 1),
    "agent_collision_with_playback": ("with playback", 1),
    "agent_offroad_time": ("off-road %", 2),
    "agent_progress": ("way of the log %", 0),
    "agent_standing": ("standing %", 0),
    "agent_speed_distance": ("speeds off by m/s", 2),
}
"""Figures of single agents: their headings, and the digits after their points."""


def crowd(data: str) -> Grid:
    """What becomes of single agents, the more of the traffic is theirs."""
    grid = [["driven", "search", *(heading for heading, _ in AGENTS.values()), "CPU s"]]
    for number in CROWD:
        for search, word in (("none", "no"), ("tree", "yes")):
            (record,) = records(f"crowd/{data}-{number}-{search}")
            cells = [f"{record[key]:.{digits}f}" for key, (_, digits) in AGENTS.items()]
            cells[0] += f" ± {record['agent_collision_rate_se']:.1f}"
            grid.append([number, word, *cells, f"{record['cost']['simulation'] / record['segments']:.2f}"])
    return grid


def mixed() -> Grid:
    """What learning from searches with more agents changes, in open traffic."""
    shown = ("agent_collision_rate", "agent_offroad_time", "agent_progress", "agent_speed_distance")
    grid = [["driven", "learned with", *(AGENTS[key][0] for key in shown)]]
    for way in ("16-none", "16-tree", "all-none", "all-tree"):
        for label, name in (("2", "two"), ("2 to 16", "mixed")):
            (record,) = records(f"mixed/{name}-{way}")
            cells = [f"{record[key]:.{AGENTS[key][1]}f}" for key in shown]
            cells[0] += f" ± {record['agent_collision_rate_se']:.1f}"
            grid.append([way.removesuffix("-none").replace("-tree", ", searched"), label, *cells])
    return grid


def personas() -> Grid:
    """Whether agents drive in the style that they are told."""
    (record,) = records("personas/town")
    digits = {"headway": 2, "free_speed": 3, "speed": 2, "collision": 1, "offroad": 2}
    named = [(case["asked"].replace(",", ", ") or "drawn", case) for case in record["cases"]]
    named += [(f"{name}, .8 less .2", found) for name, found in record["differences"].items()]
    return [["asked", "time headway, s", "free speed / limit", "speed, m/s", "collide %", "off-road %"]] + [
        [label, *(f"{case[key]:.{n}f} ± {case[f'{key}_se']:.{n}f}" for key, n in digits.items())]
        for label, case in named
    ]


def included() -> Grid:
    """The agent that comes with the package beside baselines, on simulated towns and on real roads."""
    columns = ("collision_rate", "ade", "min_sade")
    grid = [["", *(f"{where}: {COLUMNS[key][0]}" for where in DRIVEN.values() for key in columns)]]
    for label, name, part in INCLUDED:
        line = [label]
        for data in DRIVEN:
            (record,) = records(f"driving/{data}-{name}")
            row = record[part] if part else record
            line += [
                f"{row[key]:.{COLUMNS[key][1]}f} ± {row[f'{key}_se']:.{COLUMNS[key][1]}f}" for key in columns
            ]
        grid.append(line)
    return grid


def road_rows(count: int) -> list[tuple[str, str, Record]]:
    """What was learned from, agent and record on the NGSIM test part, as far as there are records, for a number of
    interactive agents.
    """
    names = [("", label, name) for label, name in ROAD_BASELINES]
    for data, source in LEARNED_FROM.items():
        names += [(source, label, f"{data}-{method}") for method, label in ROAD_AGENTS.items()]
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
            groups = np.unique([row["group"] for row in rows], return_inverse=True)[1]
            for key, digits in (("collision_rate", 1), ("ade", 2)):
                values = np.array([row[key] for row in rows], np.float64)
                mean, error = clustered_mean(values, groups)
                ghosts = np.mean([row["collision_with_playback"] for row in rows])
                aside = f" ({ghosts:.1f})" if key == "collision_rate" else ""
                line.append(f"{mean:.{digits}f} ± {error:.{digits}f}{aside}")
        grid.append(line)
    return grid


def by_kind(count: int) -> Grid:
    """The NGSIM test part as a whole: collisions by kind."""
    columns = KINDS | OTHERWISE
    grid = [["", "learned from", *(heading for heading, _ in columns.values())]]
    return grid + [[label, source, *figures(record, columns)] for source, label, record in road_rows(count)]


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


def figures(row: Record, columns: dict[str, tuple[str, int]]) -> list[str]:
    """Figures of a row, some with their errors."""
    return [
        f"{row[key]:.{digits}f}" + (f" ± {row[f'{key}_se']:.{digits}f}" if key in WITH_ERROR else "")
        for key, (_, digits) in columns.items()
    ]


def wosac(data: str) -> Grid:
    """The WOSAC score of agents, beside the baselines."""
    files = [(label, RECORDS / "wosac" / f"{data}-{name}.json") for label, name in WOSAC]
    found = [(label, read_wosac(file)) for label, file in files if file.is_file()]
    return wosac_grid([record for _, record in found], [label for label, _ in found])


def wosac_log() -> Grid:
    """What the log itself scores in every component."""
    columns = [records(f"wosac/{data}-bc")[0]["agents"][name] for data, name in WOSAC_LOGS]
    names = [name for name in columns[0] if name.endswith("_likelihood")]
    grid = [["", "town-small, 5 Hz", "NGSIM, 10 Hz, 5 s", "NGSIM, at 5 Hz and back, 5 s"]]
    for name in ("metametric", *names):
        label = name.removesuffix("_likelihood").replace("_", " ")
        grid.append([label, *(f"{numbers[name]:.4f}" for numbers in columns)])
    return grid


def wosac_parity() -> Grid:
    """Differences from the official scores, the largest of all sets of rollouts and of each."""
    grid = [
        ["rollouts", "metametric 2024, 2025", "its difference", "of a component", "of a feature, m", "flags"]
    ]
    for name, case in records("wosac/parity")[0].items():
        years = [case[year] for year in ("2024", "2025")]
        apart = [max(year[f"{key}_difference"] for year in years) for key in ("metametric", "component")]
        numbers = [value for key, value in case["features"].items() if not key.endswith("_per_step")]
        flags = sum(value for key, value in case["features"].items() if key.endswith("_per_step"))
        grid.append([
            name.partition("_")[2].replace("_", " "),
            ", ".join(f"{year['metametric']:.6f}" for year in years),
            *(f"{value:.0e}" for value in (*apart, max(numbers))),
            f"{flags:.0f}",
        ])  # fmt: skip
    return grid


def wosac_speed() -> Grid:
    """Time and memory of one scenario beside those of the official code."""
    record = records("wosac/speed")[0]
    heads = (f"s (load {record['load']:.0f})", "CPU s", "peak GB", "times less s", "times less CPU s")
    grid = [["", *heads]]
    grid.append(["official code", *(f"{value:g}" for value in OFFICIAL), "", ""])
    for name, found in record["measured"].items():
        wall, cpu = zip(*found["times"][1:], strict=True)
        cells = [f"{min(values):.2f} (median {np.median(values):.2f})" for values in (wall, cpu)]
        ratios = [f"{other / min(own):.0f}" for other, own in zip(OFFICIAL[:2], (wall, cpu), strict=True)]
        grid.append([name, *cells, f"{found['peak'] / 1e9:.2f}", *ratios])
    return grid


def flattered() -> Grid:
    """What searches do for egos: collisions that begin per 100 steps, in all branches and in the leaves; collisions
    of runs and the score without a search and with it, its difference paired over segments.
    """
    found = records("planners/*")
    before, after = ("in all branches", "in the leaves"), ("collisions %, no search", "search")
    grid = [["crowd", "planner", *before, *after, "score, search less none"]]
    for record in found:
        search = record["search"]
        if search is None:
            continue
        (other,) = (
            one
            for one in found
            if (one["crowd"], one["planner"]) == (record["crowd"], record["planner"])
            and one["search"] is None
        )
        apart, error = paired_difference(record, other)
        cells = [f"{search[name]:.2f}" for name in ("simulated", "kept")]
        cells += [f"{one['collision_rate']:.1f}" for one in (other, record)]
        grid.append([crowd_name(record), planner_title(record), *cells, f"{apart:+.1f} ± {error:.1f}"])
    return grid


PLACES = {"Lanker": "Lankershim", "US101": "US-101"}
THREE = ("collision_rate", "ade", "min_sade")
TABLES: dict[str, Callable[[], Grid]] = {
    "methods": lambda: means((*BC, *MGAIL)),
    "relations": held,
    "features": lambda: means(FEATURES),
    "ngsim": lambda: beside(NGSIM, PLACES, THREE),
    "halving": lambda: means(HALVING),
    "ways": lambda: means(WAYS),
    "long": lambda: setting("long"),
    "many": lambda: setting("many"),
    "paper": against_paper,
    "sweep": sweep,
    "search-town": lambda: searched("search", "town"),
    "search-ngsim": lambda: searched("search", "ngsim"),
    "driving-town": lambda: searched("driving", "town"),
    "driving-ngsim": lambda: searched("driving", "ngsim"),
    "driving-places": lambda: by_place(2),
    "roads-places-many": lambda: by_place(8),
    "roads": lambda: by_kind(2),
    "roads-many": lambda: by_kind(8),
    "roads-unseen": unseen,
    "included": included,
    "labels": lambda: means(LABELS),
    "seeds": lambda: beside(SEEDS, DRIVEN, ("collision_rate", "offroad_time", "ade", "min_sade")),
    "wosac-log": wosac_log,
    "wosac-parity": wosac_parity,
    "wosac-speed": wosac_speed,
    "wosac-sumo": lambda: wosac("sumo"),
    "wosac-ngsim": lambda: wosac("ngsim"),
    "planners": lambda: planner_grid(records("planners/*")),
    "planners-search": flattered,
    "crowd-town": lambda: crowd("town"),
    "crowd-ngsim": lambda: crowd("ngsim"),
    "mixed": mixed,
    "personas": personas,
}


def markdown(grid: Grid) -> str:
    """A table, its first line the heading."""
    lines = [f"| {' | '.join(line)} |" for line in grid]
    return "\n".join([lines[0], "| --- " * len(grid[0]) + "|", *lines[1:]]) + "\n"


def rewritten(text: str) -> str:
    """A page with every table made anew.

    Raises:
        KeyError: if a block names no table.
    """
    return BLOCK.sub(lambda found: found[1] + markdown(TABLES[found[2]]()) + found[4], text)


def main(args: list[str] | None = None) -> int:
    """Rewrite the pages, or compare them with the records."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args(args).check
    differing = []
    for name in PAGES:
        page = ROOT / name
        before = page.read_text(encoding="utf-8")
        after = rewritten(before)
        if after != before:
            differing.append(name)
            if not check:
                page.write_text(after, encoding="utf-8")
    for name in differing:
        verb = "differs from the records: run scripts/results_page.py" if check else "rewritten"
        print(f"{name}: {verb}", file=sys.stderr)
    return 1 if check and differing else 0


if __name__ == "__main__":
    raise SystemExit(main())
