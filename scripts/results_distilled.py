"""Tables of what distillation does to a policy and to its search."""

from __future__ import annotations

from results_base import COLUMNS, Grid, mean_of, over, records
from results_methods import DRIVEN, cells

NEW = {"lined": "beside parked cars", "elsewhere": "other real roads"}
ROWS = (
    ("BC", "towns/{}-bc-[0-9]*", "distilled/{}-bc-none-[0-9]*"),
    ("distilled", "distilled/{}-bc_ts-none-[0-9]*", "distilled/{}-bc_ts-none-[0-9]*"),
    ("BC, with the search", "distilled/{}-bc-tree-[0-9]*", "distilled/{}-bc-tree-[0-9]*"),
    ("distilled, with the search", "towns/{}-bc_ts-2000-*", "distilled/{}-bc_ts-tree-[0-9]*"),
)
"""Three seeds of 10 000 towns, freeways and NGSIM: records on the test parts, and where they learned nothing from."""
ALONE = (
    ("BC", "bc-none"),
    ("distilled", "bc_ts-none"),
    ("BC, with the search", "bc-tree"),
    ("distilled, with the search", "bc_ts-tree"),
)
"""One agent of 10 000 towns alone."""
ROADS = {
    "towns": ("town", lambda recording: True),
    "real streets": ("ngsim", lambda recording: "US101" not in recording),
    "a real freeway": ("ngsim", lambda recording: "US101" in recording),
}
"""Store, and which of its recordings."""


def distilled() -> Grid:
    """Policies before and after distillation, each with no search and with that of the distilled one."""
    columns = ("collision_rate", "min_sade")
    places = DRIVEN | NEW
    grid = [["", *(f"{title}: {COLUMNS[key][0]}" for title in places.values() for key in columns)]]
    for label, known, new in ROWS:
        found = [records((known if place in DRIVEN else new).format(place)) for place in places]
        grid.append([label, *(cell for one in found for cell in cells(one, columns))])
    return grid


def spread() -> Grid:
    """How varied proposals are without a search: mean over seeds, ± standard error over seeds."""
    places = DRIVEN | {"elsewhere": NEW["elsewhere"]}
    heads = ("entropy", "apart after 2 s, m", "after 8 s, m")
    grid = [["", *(f"{title}: {head}" for title in places.values() for head in heads)]]
    for label, method in (("BC", "bc"), ("distilled", "bc_ts")):
        line = [label]
        for place in places:
            found = records(f"trials/spread-{place}-{method}-[0-9]*")
            line += [mean_of([one["entropy"] for one in found], 2)]
            line += [mean_of([one["spread"][seconds] for one in found], 2) for seconds in ("2.0", "8.0")]
        grid.append(line)
    return grid


def alone() -> Grid:
    """An agent that has seen no freeway and no real road, ± standard error over recordings."""
    columns = ("collision_rate", "offroad_time", "min_sade")
    grid = [["", *(f"{title}: {COLUMNS[key][0]}" for title in ROADS for key in columns)]]
    for label, name in ALONE:
        line = [label]
        for store, among in ROADS.values():
            (record,) = records(f"distilled/{store}-alone-{name}")
            rows = [row for row in record["per_segment"] if among(row["group"])]
            line += [over(rows, key, COLUMNS[key][1]) for key in columns]
        grid.append(line)
    return grid
