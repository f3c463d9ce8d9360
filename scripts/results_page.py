"""Write the tables of the pages from the records in `results/`, between their markers.

    python scripts/results_page.py            # rewrites the pages
    python scripts/results_page.py --check    # says what differs, and fails if anything does

A block is `<!-- table NAME -->`, the table, `<!-- end table -->`. What a name stands for is in TABLES below.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

from symphony.evaluation.planners import planner_grid

sys.path.insert(0, str(Path(__file__).resolve().parent))

from results_base import ROOT, Grid, beside, means, records
from results_distilled import alone, distilled, spread
from results_hard import hard
from results_methods import (
    ADVERSARIAL,
    AGAIN,
    ATTENTION,
    DRIVEN,
    EVEN,
    FEATURES,
    HALF,
    HALVING,
    INPUTS,
    LABELS,
    LARGE,
    LONGER,
    MENDED,
    NGSIM,
    OFTEN,
    PARTS,
    RATES,
    SEEDS,
    TOWNS,
    TURNS,
    WAYS,
    against_paper,
    driven,
    eight,
    forests,
    held,
    included,
    points,
    roadside,
    searched,
    settings,
    sweep,
)
from results_roads import by_kind, by_place, elsewhere, roads, unseen
from results_users import (
    PLACES,
    THREE,
    crowd,
    flattered,
    mixed,
    personas,
    trained_with,
    wosac,
    wosac_log,
    wosac_parity,
    wosac_speed,
)

PAGES = (
    "README.md",
    *(
        f"docs/{name}.md"
        for name in (
            "results",
            "ablations",
            "ablations-search",
            "ablations-mgail",
            "roads",
            "roads-tables",
            "appendix",
            "wosac",
            "planners",
            "crowds",
        )
    ),
)
BLOCK = re.compile(r"(<!-- table ([a-z-]+) -->\n)(.*?)(<!-- end table -->)", re.DOTALL)
TABLES: dict[str, Callable[[], Grid]] = {
    "relations": lambda: held(["eight/town-*"]),
    "relations-towns": lambda: held(LARGE),
    "roadside": roadside,
    "parts": lambda: driven(PARTS),
    "towns": lambda: driven(TOWNS),
    "turns": lambda: driven(TURNS),
    "even": lambda: driven(EVEN),
    "rates": lambda: driven(RATES),
    "longer": lambda: driven(LONGER),
    "mended": lambda: driven(MENDED),
    "half": lambda: driven(HALF),
    "adversarial": lambda: driven(ADVERSARIAL),
    "inputs": lambda: driven(INPUTS),
    "points": points,
    "settings": settings,
    "eight-town": lambda: eight("town"),
    "eight-ngsim": lambda: eight("ngsim"),
    "features": lambda: means(FEATURES),
    "ngsim": lambda: beside(NGSIM, PLACES, THREE),
    "halving": lambda: means(HALVING),
    "ways": lambda: means(WAYS),
    "paper": against_paper,
    "sweep": sweep,
    "search-town": lambda: searched("search", "town"),
    "search-ngsim": lambda: searched("search", "ngsim"),
    "driving-town": lambda: searched("driving", "town"),
    "driving-ngsim": lambda: searched("driving", "ngsim"),
    "forest": forests,
    "hard": hard,
    "often": lambda: driven(OFTEN),
    "distilled": distilled,
    "spread": spread,
    "alone": alone,
    "attention": lambda: driven(ATTENTION),
    "again-town": lambda: searched("again", "town", AGAIN),
    "again-ngsim": lambda: searched("again", "ngsim", [row for row in AGAIN if "twice" not in row[0]]),
    "driving-places": lambda: by_place(2),
    "roads-places-many": lambda: by_place(8),
    "roads": roads,
    "elsewhere": elsewhere,
    "roads-kinds": lambda: by_kind(2),
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
    "trained-with": trained_with,
    "personas-town": lambda: personas("town"),
    "personas-ramp": lambda: personas("ramp"),
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
