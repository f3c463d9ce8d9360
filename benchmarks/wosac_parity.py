"""Measure how far the WOSAC score is from the official one, over rollouts whose official results are known.

    python benchmarks/wosac_parity.py --scenario FILE.tfrecord --official DIR --json results/wosac/parity.json

DIR holds `manifest.json` (the official scores of every case) and `case_SCENARIO_CASE.npz` (rollouts, and the official
features `log_NAME`, `sim_NAME` of every object and step). Only differences and our own scores are written.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from symphony.files import write_json
from symphony.wosac.files import read_rollouts
from symphony.wosac.records import logged_scenario, parse_scenario, read_scenarios
from symphony.wosac.scorer import (
    CHALLENGES,
    WosacFeatures,
    WosacScenario,
    compute_features,
    score_features,
)

EXPECTED = {"2024": "challenge_2024", "2025": "challenge_2025_sim_agents"}
NAMES = {"min_ade": "min_average_displacement_error"}


def feature_differences(found: WosacFeatures, file: Path) -> dict[str, float]:
    """Return the largest difference of every feature; of flags, how many differ. NaN agrees with NaN."""
    largest = {}
    with np.load(file, allow_pickle=False) as official:
        for prefix, part in (("log", found.log), ("sim", found.simulated)):
            for name, values in part.items():
                ours, theirs = values.numpy(), official[f"{prefix}_{name}"]
                if ours.dtype == bool:
                    apart = float((ours != theirs).sum())
                else:
                    same = np.isnan(ours) & np.isnan(theirs)
                    apart = float(np.where(same, 0, np.abs(ours - theirs)).max())
                # Not `max`, which would drop NaN: a number where the other has none is a difference.
                largest[name] = float(np.maximum(largest.get(name, 0.0), apart))
    return largest


def compared(scenario: WosacScenario, file: Path, expected: dict[str, Any]) -> dict[str, Any]:
    """Return our scores of one case, and the largest differences."""
    found = compute_features(scenario, read_rollouts(file))
    result: dict[str, Any] = {"features": feature_differences(found, file)}
    for year, config in CHALLENGES.items():
        ours, theirs = score_features(found, config), expected[EXPECTED[year]]
        apart = {name: abs(value - theirs.get(NAMES.get(name, name), value)) for name, value in ours.items()}
        result[year] = {
            "metametric": ours["metametric"],
            "metametric_difference": apart["metametric"],
            "component_difference": max(v for name, v in apart.items() if name.endswith("_likelihood")),
            "min_ade_difference": apart["min_ade"],
        }
    return result


def main() -> None:
    """Compare all cases and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--official", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args()
    ((_, record, payload),) = read_scenarios(given.scenario)
    scenario = logged_scenario(parse_scenario(payload, given.scenario, record))
    cases = json.loads((given.official / "manifest.json").read_text())["cases"]
    found = {
        name.removeprefix(f"{scenario.scenario_id}_"): compared(
            scenario, given.official / f"case_{name}.npz", case["expected_scores"]
        )
        for name, case in cases.items()
        if name.startswith(scenario.scenario_id)
    }
    write_json(given.json, found)
    for name, case in found.items():
        print(name, {year: f"{case[year]['metametric_difference']:.1e}" for year in CHALLENGES})


if __name__ == "__main__":
    main()
