"""Which run segments are hard, and for whom."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from results_base import Grid, records
from results_methods import EIGHT

SHARE = 7
"""The hardest segments are one in so many."""


def _rates(method: str) -> NDArray[Any]:
    """Collision rates [seeds, segments] on the test part of towns, segments by name."""
    found = [
        sorted(r["per_segment"], key=lambda row: row["segment"])
        for r in records(f"eight/town-{method}-[0-9]*")
    ]
    if len({tuple(row["segment"] for row in rows) for rows in found}) > 1:
        raise ValueError(f"records of {method} are of different run segments")
    return np.array([[row["collision_rate"] for row in rows] for rows in found])


def hard() -> Grid:
    """The methods where the first seed of BC collides most, and elsewhere (of BC, the other seeds)."""
    base = _rates("bc")
    hardest = np.zeros(base.shape[1], bool)
    hardest[np.argsort(-base[0], kind="stable")[: base.shape[1] // SHARE]] = True
    head = ["", "half of its collisions in", "correlation between seeds", "with BC's other seeds"]
    grid = [[*head, f"BC's hardest {hardest.sum()}: collisions %", "elsewhere: collisions %"]]
    for method, label in EIGHT.items():
        rates = _rates(method)
        ordered = np.sort(rates, 1)[:, ::-1].cumsum(1)
        half = (ordered < ordered[:, -1:] / 2).sum(1) + 1
        between = [np.corrcoef(a, b)[0, 1] for a, b in combinations(rates, 2)]
        others = base[1:] if method == "bc" else rates
        with_base = "" if method == "bc" else f"{np.corrcoef(rates.mean(0), base[1:].mean(0))[0, 1]:.2f}"
        grid.append(
            [
                label,
                f"{half.mean():.0f} of {rates.shape[1]}",
                f"{np.mean(between):.2f}",
                with_base,
                f"{others[:, hardest].mean():.1f}",
                f"{others[:, ~hardest].mean():.1f}",
            ]
        )
    return grid
