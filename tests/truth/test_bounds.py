"""Rates of nothing, and numbers that are not defined: what tables say of them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from made import Case, segment_of
from scenes import car, ego

from helpers_saved import played
from helpers_store import fill
from symphony.cli import main
from symphony.cli.shared import number_cell
from symphony.config import EvaluateConfig
from symphony.evaluation import evaluate
from symphony.evaluation.planners import COLUMNS, planners_text, winners
from symphony.evaluation.report import Report, add_segment, total_numbers
from symphony.metrics.intervals import beta_quantile, t_quantile, zero_bound
from symphony.saved.folder import About, save_rollouts


def test_a_rate_of_a_thousandth_takes_three_thousand_runs() -> None:
    assert zero_bound(1) == pytest.approx(95)
    assert zero_bound(24) == pytest.approx(100 * (1 - 0.05 ** (1 / 24)))
    assert zero_bound(2994) > 0.1 > zero_bound(2995)
    # The most of Clopper and Pearson for no hit, with all of the doubt on one side.
    assert zero_bound(24) == pytest.approx(100 * scipy.special.betaincinv(1, 24, 0.95))


@given(st.floats(1e-4, 1 - 1e-4), st.integers(1, 2_000))
def test_quantiles_of_t_are_those_of_scipy(probability: float, freedom: int) -> None:
    assert t_quantile(probability, freedom) == pytest.approx(
        scipy.special.stdtrit(freedom, probability), rel=1e-7, abs=1e-9
    )


@given(st.floats(1e-6, 1 - 1e-6), st.floats(0.5, 300), st.floats(0.5, 300))
def test_quantiles_of_beta_are_those_of_scipy(probability: float, a: float, b: float) -> None:
    assert beta_quantile(probability, a, b) == pytest.approx(scipy.special.betaincinv(a, b, probability), rel=1e-7)


def report_of(*chosen: Case) -> Report:
    found = Report("made", "ego")
    for case in chosen:
        segment, state = segment_of(case, 0.2, 0.0)
        saved = played(segment)
        saved.state[0, :, 0] = state
        add_segment(found, saved)
    return found


FREE, UNBOUNDED = Case("free", "", ego()), Case("unbounded", "", ego(), boundary=False)
HIT = Case("hit", "", ego(), (car(60, speed=2.0),))


def test_totals_say_of_how_many_segments_they_are_and_what_a_zero_means() -> None:
    totals = total_numbers(report_of(FREE, UNBOUNDED, HIT).rows)
    assert (totals["offroad_time"], totals["offroad_time_segments"]) == (0.0, 2)
    assert totals["offroad_time_bound"] == pytest.approx(zero_bound(2))
    assert (totals["red_light_rate"], totals["red_light_rate_segments"]) == (None, 0)
    assert totals["red_light_rate_bound"] is totals["collision_rate_bound"] is None
    assert totals["collision_rate"] == pytest.approx(100 / 3)
    rows = report_of(FREE, UNBOUNDED).rows
    none = total_numbers(rows)
    for name in ("collision_rate_bound", "at_fault_collision_rate_bound"):
        assert none[name] == pytest.approx(zero_bound(2))
    # Runs of one recording are one sample.
    shared = total_numbers([row | {"group": "one"} for row in rows])
    assert shared["collision_rate_bound"] == pytest.approx(95)


def test_cells_show_bounds_of_zeros_and_dashes() -> None:
    assert number_cell(0.0, 0.0, 1, 4.94) == "0.0 (≤ 4.9)"
    assert number_cell(1.2, 0.31, 1, math.nan) == "1.2 ± 0.3"
    assert number_cell(None, None, 1, None) == number_cell(math.nan, math.nan, 1) == "–"


def test_the_report_prints_dashes_counts_and_bounds(tmp_path, capsys):
    saved = [played(segment_of(case, 0.2, 0.0)[0]) for case in (FREE, UNBOUNDED)]
    save_rollouts(tmp_path / "sim", About("made"), saved)
    assert main(["report", str(tmp_path / "sim"), "--no-view", "--evaluated", "ego"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "0.00 (≤ 77.64)" in lines["collision_rate"]
    wanted = (("offroad_time", "0.00 (≤ 95.00)", 1), ("red_light_rate", "–", 0))
    assert all(cell in lines[name] and f"{known} of 2 segments" in lines[name] for name, cell, known in wanted)
    assert all(text in (tmp_path / "sim" / "report.html").read_text() for text in ("≤ 78", "of 1 segments"))


def test_the_evaluator_knows_no_road_without_a_boundary(tmp_path: Path) -> None:
    segments = [segment_of(case, 0.2, 0.0)[0] for case in (FREE, UNBOUNDED)]
    one, two = tmp_path / "two", tmp_path / "one"
    fill(one, segments)
    fill(two, segments[1:])
    numbers = evaluate("constant_velocity", one, EvaluateConfig(rollouts=1, interactive=1)).numbers()
    assert (numbers["offroad_time"], numbers["offroad_segments"], numbers["segments"]) == (0.0, 1, 2)
    assert numbers["offroad_time_bound"] == pytest.approx(95)
    assert numbers["collision_rate_bound"] == pytest.approx(zero_bound(2))
    assert math.isnan(float(numbers["ade_se"])) is False
    found = evaluate("constant_velocity", two, EvaluateConfig(rollouts=1, interactive=1))
    for name in ("offroad_time", "agent_offroad_time", "offroad_time_bound"):
        assert math.isnan(float(found.numbers()[name])), name
    assert math.isnan(found.metrics.rows()[0]["offroad_time"])


def test_the_evaluator_counts_at_states_and_between(tmp_path: Path) -> None:
    """Two that pass through one another between two states."""
    other = car(99.2, speed=32.0, heading=math.pi)
    through = Case("through", "", ego(32.0, x=3.2, size=(2.0, 1.8)), (other,))
    fill(tmp_path / "store", [segment_of(through, 0.2, 0.0)[0]])
    numbers = evaluate("playback", tmp_path / "store", EvaluateConfig(rollouts=1, interactive=1)).numbers()
    assert (numbers["collision_rate"], numbers["collision_rate_at_states"]) == (100.0, 0.0)
    assert numbers["collision_oncoming"] == 100.0


def record(name: str, scores: list[float], **numbers: Any) -> dict[str, Any]:
    runs = [
        {"segment": f"s{k}", "rollout": 0, "group": f"s{k}", "failed": "", "collision": False}
        | {"at_fault_collision": False, "red_lights": None, "offroad_time": 0.0, "progress_ratio": score}
        for k, score in enumerate(scores)
    ]
    found: dict[str, Any] = dict.fromkeys(COLUMNS, 0.0) | {"score": 100 * float(np.mean(scores))}
    settings = {"interactive": 2}
    return {"planner": name, "crowd": "playback", "settings": settings, "per_run": runs, **found, **numbers}


@pytest.mark.parametrize(("last", "verb"), [(0.85, "is first, within the error"), (0.6, "wins")])
def test_who_wins_with_few_runs_is_decided_by_t(last: float, verb: str) -> None:
    """Three differences with two degrees of freedom: 4.3 standard errors are needed, not 2."""
    apart = np.array([0.5, 0.6, last]) - np.array([0.4, 0.4, 0.4])
    error = apart.std(ddof=1) / math.sqrt(3)
    assert apart.mean() > 2 * error
    assert (apart.mean() > scipy.special.stdtrit(2, 0.975) * error) == (verb == "wins")
    (line,) = winners([record("a", [0.5, 0.6, last]), record("b", [0.4, 0.4, 0.4])])
    assert line.startswith(f"log: a {verb},")


def test_the_table_of_planners_has_bounds_and_dashes() -> None:
    first = record("a", [1.0, 1.0], collision_rate_bound=77.64, red_light_rate=None)
    text = planners_text([first, record("b", [1.0, 0.0], collision_rate=50.0, collision_rate_se=50.0)])
    assert all(cell in text for cell in ("0.0 (≤ 77.6)", "50.0 ± 50.0", "–"))


def test_who_blocks_traffic_ranks_before_who_does_not() -> None:
    found = report_of(FREE, Case("blocks", "", ego(x=100, change=(1.0, 3.0, -5.0)), log=ego(x=100)))
    assert [row["segment"] for row in found.worst()] == ["blocks", "free"]
    (event,) = found.events["blocks"]
    # Below 0.5 m/s from second 2.9 on.
    assert (event.kind, event.text, event.step) == ("blocking", "blocks traffic", 15)
