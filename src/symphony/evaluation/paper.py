"""The figures of the paper's tables (Igl et al., ICRA 2022, tables I and II)."""

from __future__ import annotations

import math

from symphony.config import PaperData, Setting

Figure = tuple[float, float]
"""Mean and standard error over five seeds; NaN where there is none."""

METRICS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")

# Per metric: mean, standard error. Percent, percent, metres, metres, thousandths of a nat.
_TABLES: dict[tuple[Setting, PaperData], str] = {
    ("main", "proprietary"): """
        playback    0.99 -      0.40 -     -     -     -     -     -    -
        bc          16.65 0.41  2.16 0.08  5.80 0.07  2.16 0.04  2.82 0.26
        bc_h        17.25 1.07  1.69 0.12  5.18 0.09  2.01 0.03  1.38 0.11
        bc_ts       1.84 0.13   0.35 0.03  4.83 0.09  2.07 0.04  5.28 1.14
        bc_ts_h     1.80 0.07   0.34 0.01  4.30 0.05  1.96 0.04  1.24 0.14
        mgail       5.34 0.32   0.83 0.08  7.32 0.52  3.95 0.42  1.88 0.18
        mgail_h     4.16 0.18   0.76 0.03  4.52 0.17  2.48 0.09  1.55 0.17
        mgail_ts    2.97 0.16   0.72 0.20  6.83 0.48  3.80 0.39  4.14 1.08
        mgail_ts_h  2.40 0.19   0.70 0.06  4.69 0.15  2.73 0.12  2.35 0.53
    """,
    ("main", "womd"): """
        playback    3.04 -      0.96 -     -     -     -     -     -    -
        bc          24.65 0.32  2.75 0.12  4.81 0.10  1.76 0.04  1.32 0.28
        bc_h        23.27 0.38  2.40 0.05  4.38 0.04  1.67 0.03  3.50 1.25
        bc_ts       4.94 0.65   1.23 0.04  4.20 0.15  1.82 0.07  5.84 1.02
        bc_ts_h     4.86 0.24   1.30 0.06  3.70 0.09  1.66 0.04  2.82 1.13
        mgail       9.48 0.91   1.62 0.15  5.70 0.44  3.13 0.26  4.14 1.36
        mgail_h     7.39 0.37   1.65 0.12  3.82 0.12  2.15 0.08  3.88 0.80
        mgail_ts    4.36 0.21   1.22 0.02  4.26 0.19  2.51 0.11  5.42 1.26
        mgail_ts_h  4.89 0.38   1.65 0.25  3.86 0.17  2.22 0.13  2.80 0.60
    """,
    ("long", "proprietary"): """
        playback    2.38 -      0.47 -     -     -     -     -     -    -
        bc          25.56 0.69  2.99 0.09  11.60 0.21  4.08 0.05   2.61 0.20
        bc_h        30.33 0.56  3.14 0.22  9.83 0.18   3.83 0.05   4.17 0.37
        bc_ts       6.05 0.31   0.72 0.10  8.92 0.30   3.97 0.11   4.90 0.59
        bc_ts_h     7.76 0.12   0.66 0.02  7.74 0.15   3.72 0.09   2.69 0.22
        mgail       14.15 0.83  1.03 0.19  14.18 0.97  9.34 0.45   6.79 1.70
        mgail_h     14.73 1.93  1.72 0.24  10.52 1.17  6.58 0.60   3.09 0.62
        mgail_ts    10.52 0.94  0.99 0.03  15.76 1.17  11.80 1.22  5.93 0.71
        mgail_ts_h  7.81 0.78   0.88 0.03  9.11 0.73   6.39 0.64   2.66 0.59
    """,
    ("many", "proprietary"): """
        playback    2.37 -      0.22 -     -     -     -     -     -    -
        bc          17.46 0.79  1.06 0.15  6.40 0.51   1.86 0.14  1.49 0.25
        bc_h        18.60 0.81  0.95 0.06  5.85 0.08   1.83 0.08  1.73 0.36
        bc_ts       4.17 0.23   0.38 0.02  6.22 0.38   2.10 0.20  2.76 0.50
        bc_ts_h     5.18 0.24   0.36 0.03  5.68 0.16   2.03 0.05  0.96 0.12
        mgail       11.08 1.29  0.47 0.02  12.30 0.62  6.55 0.65  4.14 1.06
        mgail_h     6.79 0.11   0.37 0.03  5.74 0.34   2.80 0.26  1.61 0.40
        mgail_ts    9.50 0.93   0.51 0.06  7.46 0.79   3.66 0.53  2.65 0.41
        mgail_ts_h  5.80 0.47   0.36 0.02  5.47 0.07   2.69 0.04  1.24 0.15
    """,
}


def paper_figures(setting: Setting, dataset: PaperData) -> dict[str, dict[str, Figure]]:
    """The paper's figures by method and metric, in our units (the divergence in nats); empty if it has none."""
    found = {}
    for method, *words in (line.split() for line in _TABLES.get((setting, dataset), "").strip().splitlines()):
        values = [math.nan if word == "-" else float(word) for word in words]
        figures = dict(zip(METRICS, zip(values[::2], values[1::2], strict=True), strict=True))
        mean, error = figures["curvature_jsd"]
        found[method] = {**figures, "curvature_jsd": (mean / 1000, error / 1000)}
    return found
