"""Evaluations, runs and tables of made-up numbers."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from symphony.config import METHODS, EvaluateConfig
from symphony.evaluation.records import evaluation_name, keep_evaluation
from symphony.evaluation.table import METRICS, Entry

CONFIG = asdict(EvaluateConfig())
CONFIG |= {"search": "none", "score": "discriminator", "goals": "tree", "trees": 0, "rule": ""}
CONFIG |= {"interactive": 2, "metric": []}


def make_record(values: dict[str, float] | None = None, **changes: Any) -> dict[str, Any]:
    numbers = dict.fromkeys(METRICS, 1.0) | {"curvature_jsd_floor": 0.5} | (values or {})
    counts = [0] * 100 + [3] + [0] * 100
    playback = {"collision_rate_at_states": 0.5, "collision_rate": 0.5, "offroad_time": 0.25, "ade": 0.0}
    return numbers | {
        "format": 2, "collision_rate_at_states": numbers["collision_rate"], "segments": 4,
        "run": {"updates": 0, "named": False, "checkpoint": 0}, "config": CONFIG | changes,
        "data": {"name": "test", "checksum": "ab" * 32}, "playback": playback, "cost": {"simulation": 6.0},
        "constant_velocity": dict.fromkeys([*METRICS, "collision_rate_at_states"], 2.0),
        "curvature": {"policy": counts, "log": counts},
    }  # fmt: skip


def make_entry(method: str, seed: int = 0, **values: float) -> Entry:
    record = make_record(values, seed=seed)
    return Entry(Path(f"{method}-{seed}"), {"method": method, "seed": seed}, evaluation_name(record), record)


def make_run(folder: Path, method: str, seed: int = 0, *records: dict[str, Any], **config: Any) -> Path:
    folder.mkdir(parents=True)
    settings = {"format": 2, "method": method, "seed": seed, "agent": {"interactive": 2}} | config
    (folder / "config.json").write_text(json.dumps(settings))
    for record in records:
        keep_evaluation(str(folder), record)
    return folder


def full_table(seeds: int = 3, methods: Any = METHODS) -> list[Entry]:
    rng, top = np.random.default_rng(0), [30, 5, 20, 10, 0.01]
    return [
        make_entry(method, seed, **dict(zip(METRICS, rng.uniform(0, top).tolist(), strict=True)))
        for method in methods
        for seed in range(seeds)
    ]


def row_of(table: dict[str, Any], method: str) -> Any:
    (row,) = (row for row in table["rows"] if row["method"] == method)
    return row
