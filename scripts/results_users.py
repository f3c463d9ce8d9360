"""Tables of crowds, planners, driving styles and the WOSAC score."""

from __future__ import annotations

import numpy as np

from results_base import RECORDS, Grid, records
from symphony.evaluation.planners import crowd_name, paired_difference, planner_title
from symphony.evaluation.wosac_table import read_wosac, wosac_grid

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


LEARNED_WITH = {
    "two": "2",
    "many16": "2 to 16",
    "split16": "2 to 16, map and neighbours apart",
}
"""What searches in training drove, and how the discriminator judged: names of records and labels."""


def mixed() -> Grid:
    """What learning from searches with more agents changes, and a discriminator that separates, in open traffic."""
    shown = ("agent_collision_rate", "agent_offroad_time", "agent_progress", "agent_speed_distance")
    grid = [["", "searched", "learned with", *(AGENTS[key][0] for key in shown)]]
    for data, place in (("town", "towns"), ("ngsim", "NGSIM")):
        for search, word in (("none", "no"), ("tree", "yes")):
            for name, label in LEARNED_WITH.items():
                (record,) = records(f"mixed/{name}-{data}-16-{search}")
                cells = [f"{record[key]:.{AGENTS[key][1]}f}" for key in shown]
                cells[0] += f" ± {record['agent_collision_rate_se']:.1f}"
                grid.append([place, word, label, *cells])
    return grid


def trained_with() -> Grid:
    """Agents that learned with two or with eight agents in their searches, in open traffic with more."""
    counts, arms = ("16", "32", "all"), {"two": "2", "n8": "8"}
    shown = {key: AGENTS[key] for key in ("agent_collision_rate", "agent_offroad_time", "agent_progress")}
    head = [f"{heading}, {count} driven" for heading, _ in shown.values() for count in counts]
    grid = [["", "searched", "learned with", *head]]
    for data, place in (("town", "towns"), ("ngsim", "NGSIM")):
        for search, word in (("none", "no"), ("tree", "yes")):
            for name, label in arms.items():
                found = [records(f"mixed/{name}-{data}-{count}-{search}")[0] for count in counts]
                cells = [
                    f"{record[key]:.{digits}f}"
                    + (f" ± {record[f'{key}_se']:.1f}" if "collision" in key else "")
                    for key, (_, digits) in shown.items()
                    for record in found
                ]
                grid.append([place, word, label, *cells])
    return grid


def personas(place: str) -> Grid:
    """Whether agents drive in the style that they are told."""
    (record,) = records(f"personas/{place}")
    digits = {"headway": 2, "free_speed": 3, "speed": 2, "collision": 1, "offroad": 2}
    named = [(case["asked"].replace(",", ", ") or "drawn", case) for case in record["cases"]]
    named += [(f"{name}, .8 less .2", found) for name, found in record["differences"].items()]
    return [["asked", "headway, s", "free speed / limit", "speed, m/s", "collide %", "off-road %"]] + [
        [label, *(f"{case[key]:.{n}f} ± {case[f'{key}_se']:.{n}f}" for key, n in digits.items())]
        for label, case in named
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
        apart, error, _ = paired_difference(record, other)
        cells = [f"{search[name]:.2f}" for name in ("simulated", "kept")]
        cells += [f"{one['collision_rate']:.1f}" for one in (other, record)]
        grid.append([crowd_name(record), planner_title(record), *cells, f"{apart:+.1f} ± {error:.1f}"])
    return grid


PLACES = {"Lanker": "Lankershim", "US101": "US-101"}
THREE = ("collision_rate", "ade", "min_sade")
