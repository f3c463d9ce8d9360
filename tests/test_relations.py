"""The paper's relations and paired differences from kept evaluations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_table import METHODS, make_entry, make_record, make_run
from symphony.errors import ConfigError, DataError
from symphony.evaluation.table import Entry, paper_figures
from symphony.metrics.intervals import clustered_mean
from test_pretrained import load_script

SCRIPT = load_script("relations")
relations, paired_lines = SCRIPT.relations, SCRIPT.paired_lines
MEANS = dict.fromkeys(("collision_rate", "offroad_time", "ade", "min_sade"), 1.0)
SEGMENTS = 12


def filled(record: dict[str, Any], parts: float = 0.0, **means: float) -> dict[str, Any]:
    """A record whose segments scatter around the given means; noise is that of the segment, not of the method."""
    noise, means = np.random.default_rng(0).uniform(0.5, 1.5, SEGMENTS), MEANS | means
    means["collision_rate_at_states"] = means["collision_rate"]
    rows = [
        {"segment": f"s{k}", "group": f"g{k // 2}"} | {key: mean * n for key, mean in means.items()}
        for k, n in enumerate(noise / noise.mean())
    ]
    record |= means | {"per_segment": rows, "segments": len(rows)}
    record["curvature"] |= {"parts": {f"g{k}": parts + 0.001 * k for k in range(SEGMENTS // 2)}}
    return record


def entry(method: str, seed: int = 0, parts: float = 0.0, **means: float) -> Entry:
    found = make_entry(method, seed)
    filled(found.record, parts, **means)  # type: ignore[arg-type]
    return found


def of(found: list[Any], metric: str, before: str, after: str) -> Any:
    (one,) = (r for r in found if (r["metric"], r["before"], r["after"]) == (metric, before, after))
    return one


@settings(max_examples=15)
@given(st.floats(0.1, 90), st.floats(0.01, 90), st.floats(0.01, 90))
def test_factors_are_held_from_their_bound_on(before: float, after: float, other: float) -> None:
    entries = [entry("bc", collision_rate=before)]
    entries += [entry("bc_ts_h", seed, collision_rate=rate) for seed, rate in enumerate((after, other))]
    found = of(relations(entries), "collision_rate", "bc", "bc_ts_h")
    assert found["value"] == pytest.approx(before / np.mean([after, other]))
    assert found["held"] == (found["value"] >= 9.3)
    # What is hard is as much harder in one as in the other: paired, the factor has no error.
    assert found["se"] == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=15)
@given(st.floats(1, 9), st.floats(1, 9))
def test_differences_are_held_by_their_sign(before: float, after: float) -> None:
    found = relations([entry("bc_h", min_sade=before), entry("bc_ts_h", min_sade=after)])
    one = of(found, "min_sade", "bc_h", "bc_ts_h")
    assert one["value"] == pytest.approx(after - before)
    assert one["held"] == (after <= before)
    assert one["clear"] == (abs(one["value"]) > 2 * one["se"])


@pytest.mark.parametrize(("shift", "held"), [(0.01, True), (0.0001, False), (-0.01, False)])
def test_divergences_must_differ_by_more_than_sampling(shift: float, held: bool) -> None:
    rng, entries = np.random.default_rng(0), [entry("bc"), entry("bc_ts")]
    for one, mean in zip(entries, (0.0, shift), strict=True):
        noise = rng.normal(0, 0.001, 40)
        one.record["curvature"]["parts"] = {
            f"g{k}": part for k, part in enumerate(mean + noise - noise.mean())
        }
    found = of(relations(entries), "curvature_jsd", "bc", "bc_ts")
    assert (found["held"], found["value"]) == (held, pytest.approx(shift))
    assert found["se"] == pytest.approx(0.001 * np.sqrt(2 / 40), rel=0.4)
    # Without the single recording that makes it there is no turn left: no number, and the same one for all others.
    for one, value in zip(entries, (0.01, 0.02), strict=True):
        one.record["curvature"]["parts"] = {"a": None, "b": value, "c": value}
    assert of(relations(entries), "curvature_jsd", "bc", "bc_ts")["held"] is None


def test_what_cannot_be_said_is_not_said() -> None:
    level = relations([entry(method, collision_rate=3.0) for method in ("bc", "bc_ts", "mgail")])
    for method in ("bc_ts", "mgail"):  # what stays the same does not fall
        assert of(level, "collision_rate", "bc", method)["held"] is False
    entries = [entry("bc", 0), entry("bc_ts", 0, collision_rate=0.0)]
    found = relations(entries)
    infinite, missing = (of(found, "collision_rate", "bc", method) for method in ("bc_ts", "mgail"))
    assert (infinite["held"], infinite["value"], missing["held"]) == (True, np.inf, None)
    for one in entries:
        one.record["per_segment"] = []  # type: ignore[index]
    with pytest.raises(ConfigError, match="share no run segment"):
        relations(entries)
    del entries[0].record["per_segment"]  # type: ignore[attr-defined]
    with pytest.raises(DataError, match="per_segment"):
        relations(entries)


def test_paired_differences_are_over_what_both_have_and_over_recordings() -> None:
    def shifted(method: str, seed: int, shift: float) -> Entry:
        found = entry(method, seed)
        for row in found.record["per_segment"]:
            row |= {key: value + shift for key, value in row.items() if key in MEANS or "states" in key}
        return found

    (line,) = paired_lines([shifted("bc", 0, 0.0), shifted("bc", 1, 1.0), shifted("bc_h", 0, 2.5)], "bc")
    # Seeds are averaged first, and a shift that is the same everywhere has no error.
    numbers = "collision +2.00 ± 0.00 %, off-road +2.00 ± 0.00 %, ADE +2.00 ± 0.00 m, minSADE +2.00 ± 0.00 m"
    assert line == f"BC+H less BC: {numbers} (12 segments of 6 groups)"
    fewer = shifted("bc_h", 0, 2.5)
    fewer.record["per_segment"].pop()
    assert "11 segments" in paired_lines([shifted("bc", 0, 0.0), fewer], "bc")[0]
    fewer.record["per_segment"][3]["ade"] = "far"
    with pytest.raises(DataError, match="ade"):
        paired_lines([shifted("bc", 0, 0.0), fewer], "bc")
    with pytest.raises(ConfigError, match="not among the methods"):
        paired_lines([shifted("bc", 0, 0.0)], "mgail")


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=30))
def test_errors_over_groups_of_one_are_the_usual_ones(values: list[float]) -> None:
    numbers = np.array(values)
    mean, error = clustered_mean(numbers, np.arange(len(numbers)))
    assert mean == pytest.approx(numbers.mean())
    assert error == pytest.approx(numbers.std(ddof=1) / np.sqrt(len(numbers)), abs=1e-12)
    # Copies within a group tell nothing new.
    twice = clustered_mean(np.repeat(numbers, 2), np.repeat(np.arange(len(numbers)), 2))
    assert twice == pytest.approx((mean, error), abs=1e-9)


def test_the_paper_s_own_figures_have_the_paper_s_relations() -> None:
    """Up to rounding: the paper's factors themselves are given to one digit."""
    figures, entries = paper_figures("main", "proprietary"), []
    for method in METHODS:
        means = {key: mean for key, (mean, _) in figures[method].items()}
        entries.append(entry(method, parts=means.pop("curvature_jsd"), **means))
    for one in relations(entries):
        assert one["held"] or one["value"] > one["does"] - 0.06, one
        assert one["paper"]["proprietary"] == pytest.approx(one["value"])


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "bc", "bc", 0, filled(make_record()))
    SCRIPT.main([str(run), "--json", str(tmp_path / "relations.json")])
    assert len(json.loads((tmp_path / "relations.json").read_text())) == len(SCRIPT.STATEMENTS)
    shown = capsys.readouterr().out
    assert "not known" in shown
    assert all(one["text"] in shown for one in relations([entry("bc")]))
    make_run(tmp_path / "mgail", "mgail", 0, filled(make_record(), ade=3.0))
    SCRIPT.main([str(tmp_path), "--paired", "bc"])
    assert "MGAIL less BC" in capsys.readouterr().out
    make_run(tmp_path / "two", "bc", 1, filled(make_record(search="tree", trees=1, branches=16, rule="best")))
    with pytest.raises(ConfigError, match="BC was simulated in several ways"):
        SCRIPT.main([str(tmp_path)])
