"""Tables of the methods: those of the paper, ways to search, the included agent."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

import numpy as np

from results_base import COLUMNS, PLAYBACK, RECORDS, Grid, Record, mean_of, paired, records
from results_users import NAMES
from symphony.evaluation.entries import Entry
from symphony.evaluation.paper import paper_figures
from symphony.evaluation.relations import grid, relations

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
FOREST = {
    "bc_ts": "BC+TS",
    "bc_ts_h": "BC+TS+H",
    "mgail_ts": "MGAIL+TS",
    "mgail_ts_h": "MGAIL+TS+H",
    "included": "included BC+TS+H",
}
"""Agents on 100 of the 500 test segments of towns: those of BC of 10 000 towns, those of MGAIL of seed 70."""
AGAIN = (
    ("16 branches", "16", ""),
    ("32 branches", "32", ""),
    ("64 branches", "64", ""),
    ("16, totals above 1 once again", "retry-1", ""),
    ("16, totals above 0 once again", "retry-0", ""),
    ("16, totals above 0 twice again", "retries-0", ""),
)
"""The included agent on validation segments: label and end of the record's name."""
DRIVEN = {"town": "towns", "ngsim": "real roads"}
INCLUDED = (
    ("log playback", "driving/{}-none", "playback"),
    ("constant velocity", "driving/{}-none", "constant_velocity"),
    ("BC", "driving/{}-bc", ""),
    ("BC that observes as much", "eight/{}-bc-40", ""),
    ("BC+TS+H without its search", "driving/{}-none", ""),
    ("BC+TS+H", "driving/{}-replace-branch", ""),
)
LABELS = (
    ("BC+H, one route taught (seed 0)", "bc/bc_h-0-none"),
    ("BC+H, the set of open routes", "labels/bc_h-0-none"),
    ("BC+TS+H, one route taught (seed 0)", "bc/bc_ts_h-0-often"),
    ("BC+TS+H, the set of open routes", "labels/bc_ts_h-0-systematic"),
)
EIGHT = {
    "bc": "BC",
    "bc_h": "BC+H",
    "bc_ts": "BC+TS",
    "bc_ts_h": "BC+TS+H",
    "mgail": "MGAIL",
    "mgail_h": "MGAIL+H",
    "mgail_ts": "MGAIL+TS",
    "mgail_ts_h": "MGAIL+TS+H",
}
"""The methods, trained anew alike: records `eight/PLACE-METHOD-SEED`."""
SEEDS = (("BC+TS+H without its search", "driving/{}-none*"), ("BC+TS+H", "driving/{}-replace-branch*"))
"""The included agent (seed 0) and those trained likewise of two more seeds."""
NGSIM = (
    (PLAYBACK, "ngsim/{}/playback"),
    ("constant velocity", "ngsim/{}/constant_velocity"),
    ("BC", "ngsim/{}/bc-0-none"),
    ("BC+H", "ngsim/{}/bc_h-0-none"),
    ("BC+TS", "ngsim/{}/bc_ts-0-often"),
    ("BC+TS+H", "ngsim/{}/bc_ts_h-0-often"),
    ("BC+TS+H, freeways among the simulated data", "ngsim-mixed/{}/bc_ts_h-0-often"),
)


def cells(found: Sequence[Record], columns: Iterable[str], part: str = "") -> list[str]:
    """Figures ± standard errors over recordings (of several records, the mean of either); `part` names a baseline's
    row in them.
    """
    rows = [record[part] if part else record for record in found]
    line = []
    for key in columns:
        mean, error = (np.mean([row[name] for row in rows]) for name in (key, f"{key}_se"))
        line.append(f"{mean:.{COLUMNS[key][1]}f} ± {error:.{COLUMNS[key][1]}f}")
    return line


def eight(place: str) -> Grid:
    """The methods on one test part, as far as there are records: means over seeds, ± standard error over recordings
    (of one seed, the mean of these); for collisions also that over seeds.
    """
    last = ("offroad_time", "ade", "min_sade")
    head = ["collisions %", "± over seeds", "with playback %", *(COLUMNS[name][0] for name in last)]
    grid = [["", *head, COLUMNS["curvature_jsd"][0], "CPU s", "seeds"]]
    baselines = records(f"eight/{place}-bc-[0-9]*")[0]
    rows = [(PLAYBACK, [baselines], "playback"), ("constant velocity", [baselines], "constant_velocity")]
    for method, label in EIGHT.items():
        if any(RECORDS.glob(f"eight/{place}-{method}-[0-9]*.json")):
            rows.append((label, records(f"eight/{place}-{method}-[0-9]*"), ""))
    for label, found, part in rows:
        rates = [record["collision_rate"] for record in found]
        playback, jsd = (
            np.mean([(record[part] if part else record)[key] for record in found])
            for key in ("collision_with_playback", "curvature_jsd")
        )
        line = [label, *cells(found, ["collision_rate"], part)]
        line += [f"{np.std(rates, ddof=1) / len(rates) ** 0.5:.1f}" if len(rates) > 1 else ""]
        line += [f"{playback:.1f}", *cells(found, last, part), f"{jsd:.3f}"]
        cost = "" if part else f"{np.mean([r['cost']['simulation'] / r['segments'] for r in found]):.2f}"
        grid.append([*line, cost, "" if part else str(len(found))])
    return grid


RATES = tuple((rate, f"rates/{{}}-{rate}") for rate in ("0.001", "0.003", "0.006", "0.01", "0.02"))
"""Learning rates of BC, and their records on the validation parts."""
PARTS = (
    ("BC with the paper's inputs", "driving/{}-bc"),
    ("the same, half of the states displaced", "parts/{}-bcp"),
    ("BC", "eight/{}-bc-40"),
    ("BC, 500 updates more", "parts/{}-bc500"),
    ("BC+TS without its search", "parts/{}-bc_ts_none"),
    ("BC+TS, the paper's discriminator, halved every 2 s", "parts/{}-paperd"),
    ("BC+TS", "eight/{}-bc_ts-40"),
    ("BC+TS+H without its search", "parts/{}-bc_ts_h_none"),
    ("BC+TS+H", "eight/{}-bc_ts_h-40"),
    ("BC+TS+H, 2 000 instead of 500 updates", "parts/{}-tsh2000"),
)
"""What inputs, further updates, distillation and search each do, of one seed."""
TOWNS = (
    ("BC, 3 290 towns, three seeds", "eight/{}-bc-*"),
    ("BC, 10 000 towns, three seeds", "towns/{}-bc-[0-9]*"),
    ("BC+TS, 3 290 towns, three seeds", "eight/{}-bc_ts-*"),
    ("BC+TS, 10 000 towns, 500 updates, one seed", "towns/{}-bc_ts"),
    ("BC+TS, 10 000 towns, 2 000 updates, three seeds", "towns/{}-bc_ts-2000-*"),
    ("BC+H, 3 290 towns, three seeds", "eight/{}-bc_h-*"),
    ("BC+H, 10 000 towns, goals of today, three seeds", "turns/{}-bc_h-*"),
    ("BC+TS+H, 3 290 towns, three seeds", "eight/{}-bc_ts_h-*"),
    ("BC+TS+H, 10 000 towns, 500 updates, one seed", "towns/{}-bc_ts_h"),
    ("BC+TS+H, 10 000 towns, 2 000 updates, goals of today, three seeds", "turns/{}-bc_ts_h-*"),
)
"""What three times as many simulated towns do in as many updates."""
TURNS = (
    ("BC", "towns/{}-bc-[45]0"),
    ("BC+H", "towns/{}-bc_h-[45]0"),
    ("BC+H, goals that see lane changes", "turns/{}-bc_h-[45]0"),
    ("BC+TS", "towns/{}-bc_ts-2000-[45]0"),
    ("BC+TS+H", "towns/{}-bc_ts_h-2000-[45]0"),
    ("BC+TS+H, goals that see lane changes", "turns/{}-bc_ts_h-[45]0"),
)
"""Agents of 10 000 towns with another goal policy, nothing else changed."""
OFTEN = (
    ("run segments drawn evenly", "hard/{}-even"),
    ("half of them hard ones", "hard/{}-hard"),
    ("evenly, states of standing vehicles a quarter as often", "hard/{}-standing"),
)
"""1 000 further updates of BC, on the validation parts."""
EVEN = (
    ("BC+H, one in twenty of NGSIM", "turns/{}-bc_h-60"),
    ("BC+H, one in six", "even/{}-bc_h"),
    ("BC+TS+H, one in twenty", "turns/{}-bc_ts_h-60"),
    ("BC+TS+H, one in six", "even/{}-bc_ts_h"),
)
"""Of 10 000 towns, freeways and NGSIM, with sources drawn as they are or more evenly; third seed."""
LARGE = ("towns/town-bc-[0-9]*", "turns/town-bc_h-*", "towns/town-bc_ts-2000-*", "turns/town-bc_ts_h-*")
"""The four of 10 000 towns, with the goal policy of today."""
INPUTS = (
    ("the paper's inputs", "inputs/{}-paper"),
    ("+ gaps to others", "inputs/{}-gaps"),
    ("+ displaced states", "inputs/{}-perturb"),
    ("+ lights of their own", "inputs/{}-lights"),
    ("+ 21 levels of acceleration", "inputs/{}-levels"),
    ("+ gaps, displaced states, lights", "inputs/{}-seven"),
    ("all four", "rates/{}-0.01"),
    ("all four, interactive agents' states four times as often", "inputs/{}-interactive"),
)
"""What changes of the paper's inputs do alone, and their records on the validation parts."""
POINTS = tuple(
    (f"{method}, {count} points", f"points/{{}}-{kind}-{count}-*")
    for method, kind in (("BC", "bc"), ("BC+TS", "ts"))
    for count in (128, 200, 512, 1000)
)
"""How many points policy and discriminator observe, on the validation parts."""
ATTENTION = (
    ("the paper's encoder, 3 000 updates", "attention/{}-pooled"),
    ("attention to others and lights, points pooled, 2 560 updates", "attention/{}-others"),
    ("attention to everything, 1 040 updates", "attention/{}-everything"),
)
"""BC with other encoders after as much CPU time, on the validation parts."""
ADVERSARIAL = (
    ("2 000 updates of regression at 0.01", "adversarial/{}-short"),
    ("6 000 at 0.01", "adversarial/{}-faster"),
    ("6 000 at 0.003", "adversarial/{}-regression"),
    ("and 300 adversarial updates", "adversarial/{}-detached"),
    ("and 300 at a rate five times as high", "adversarial/{}-fast"),
    ("and 300 with the gradient through reactions, too", "adversarial/{}-react"),
)
"""MGAIL before and after adversarial updates, and their records on the validation parts."""
LONGER = (
    ("6 000 updates of regression at 0.003", "adversarial/{}-longer-start"),
    ("and 150 adversarial ones", "adversarial/{}-longer-150"),
    ("and 600", "adversarial/{}-longer-600"),
)
"""MGAIL of another seed that goes on for longer, on more validation segments."""
MENDED = (
    ("one Gaussian, 6 000 updates, half of the way back", "adversarial/{}-longer-start"),
    ("one Gaussian, 6 000 updates, all of it", "mended/{}-gaussian"),
    ("histogram, 3 000 updates, half of the way back", "mended/{}-histogram-half"),
    ("histogram, 3 000 updates, all of it", "mended/{}-histogram"),
)
"""Regression by labels that lead half of the way back to the log and all of it, on the validation parts."""
HALF = tuple(
    (f"{EIGHT[method]}, three seeds", f"half/{{}}-{method}-[0-9]*") for method in EIGHT if "mgail" in method
)
"""The methods' rows of MGAIL as they were by labels that lead half of the way back, without a histogram or a cut."""
SETTINGS = {"many": "8 agents", "long": "20 s"}


def driven(
    rows: Sequence[tuple[str, str] | tuple[str, str, str]],
    places: dict[str, str] = DRIVEN,
    columns: Sequence[str] = ("collision_rate", "offroad_time", "ade", "min_sade"),
) -> Grid:
    """Records per row and place (its name stands for ``{}``); a third entry names a baseline's row in them."""
    grid = [["", *(f"{title}: {COLUMNS[key][0]}" for title in places.values() for key in columns)]]
    for label, pattern, *part in rows:
        found = [records(pattern.format(place)) for place in places]
        grid.append([label, *(cell for one in found for cell in cells(one, columns, *part))])
    return grid


ROADSIDE = (
    ("included, no search", "roadside/included-none", "driving/{}-none"),
    ("learned on with a roadside, no search", "roadside/roadside-none", "roadside/roadside-{}-none"),
    ("included", "roadside/included-replace-branch", "driving/{}-replace-branch"),
    ("two other seeds of it, mean", "roadside/seed-*", "driving/{}-replace-branch-[12]0"),
    (
        "learned on with a roadside",
        "roadside/roadside-replace-branch",
        "roadside/roadside-{}-replace-branch",
    ),
)
"""Labels, and records among parked cars and on the two test parts."""


def points() -> Grid:
    """More or fewer map points, and what they cost."""
    grid = driven(POINTS)
    grid[0].append("CPU s")
    for line, (_, pattern) in zip(grid[1:], POINTS, strict=True):
        found = records(pattern.format("town"))
        line.append(f"{np.mean([record['cost']['simulation'] / record['segments'] for record in found]):.2f}")
    return grid


def settings() -> Grid:
    """The methods in the paper's other settings: what they learned with two agents in 10 s, tried in these."""
    baselines = [(PLAYBACK, "playback"), ("constant velocity", "constant_velocity")]
    rows = [(label, "settings/{}-bc-40", part) for label, part in baselines]
    rows += [
        (label, f"settings/{{}}-{method}-[0-9]*", "")
        for method, label in EIGHT.items()
        if any(RECORDS.glob(f"settings/*-{method}-[0-9]*.json"))
    ]
    grid = driven(rows, SETTINGS)
    grid[0].append("seeds")
    for line, (_, pattern, part) in zip(grid[1:], rows, strict=True):
        line.append("" if part else str(len(records(pattern.format("many")))))
    return grid


def roadside() -> Grid:
    """The included agent, and the same after it learned from parked cars and people beside the road."""
    columns = ("collision_rate", "min_sade")
    places = {"": "beside parked cars", **DRIVEN}
    grid = [["", *(f"{title}: {COLUMNS[key][0]}" for title in places.values() for key in columns)]]
    for label, parked, plain in ROADSIDE:
        found = [records(plain.format(place) if place else parked) for place in places]
        grid.append([label, *(cell for one in found for cell in cells(one, columns))])
    return grid


def held(patterns: Sequence[str]) -> Grid:
    """The paper's relations as `symphony table --relations` has them, those that the records can tell."""
    entries = []
    for pattern in patterns:
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
    """Collisions, time off the road and ADE in towns beside the paper's on WOMD."""
    columns = ("collision_rate", "offroad_time", "ade")
    figures = paper_figures("main", "womd") or {}
    grid = [["", *(head for name in columns for head in (COLUMNS[name][0], "paper"))]]
    for method, label in EIGHT.items():
        line = [label]
        found = records(f"eight/town-{method}-[0-9]*")
        for name in columns:
            mean, error = figures[method][name]
            line += [mean_of([row[name] for row in found], COLUMNS[name][1]), f"{mean:.2f} ± {error:.2f}"]
        grid.append(line)
    return grid


def sweep() -> Grid:
    """What every change of the adversarial settings did, paired over segments with the base."""
    grid = [["", "change", *(heading for heading, _ in COLUMNS.values()), "collisions against base", "AUC"]]
    for method, title in NAMES.items():
        rows = {row["name"]: row for row in records(f"sweep/{method}-*")}
        for name in sorted(rows, key=lambda name: (name != "start", name != "base", name)):
            row = rows[name]
            cells = [mean_of([row[key]], digits) for key, (_, digits) in COLUMNS.items()]
            apart = "–" if name == "base" else paired([rows["base"]], [row], "collision_rate", 1)
            what = "the regression alone" if name == "start" else name
            grid.append([title, what, *cells, apart, f"{row['auc']:.2f}" if "auc" in row else "–"])
    return grid


def searched(folder: str, data: str, rows: Sequence[tuple[str, str, str]] = SEARCH) -> Grid:
    """One agent simulated in several ways: errors over recordings, and CPU seconds per segment."""
    grid = [["", *(heading for heading, _ in COLUMNS.values()), "CPU s"]]
    for label, name, part in rows:
        (record,) = records(f"{folder}/{data}-{name}")
        cost = "" if part else f"{record['cost']['simulation'] / record['segments']:.2f}"
        grid.append([label, *cells([record], COLUMNS, part), cost])
    return grid


def forests() -> Grid:
    """Independent trees of which each gives a leaf, beside one tree and beside no search."""
    ways = {
        "none": "no search",
        "one": "the leaves of one tree of 16",
        "forest": "a leaf each of 16 trees of 16",
        "branch": "the same, goals of each branch",
    }
    rows = [
        (f"{name}: {words}" if way == "none" else words, f"{agent}-{way}", "")
        for agent, name in FOREST.items()
        for way, words in ways.items()
        if way != "branch" or agent == "mgail_ts_h"
    ]
    return searched("forest", "town", rows)


def included() -> Grid:
    """The agent that comes with the package beside baselines, on simulated towns and on real roads."""
    return driven(INCLUDED, columns=("collision_rate", "ade", "min_sade"))
