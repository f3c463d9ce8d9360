"""The test bench: suites are checked before they run, verdicts are those of the full sample, files can be read."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import betaincinv

from helpers_segments import straight_road
from helpers_store import brief, stored
from symphony.bench import run as bench
from symphony.bench.criticality import hardest
from symphony.bench.measures import estimate, needed_groups
from symphony.bench.pages import sentence
from symphony.bench.run import Verdict, run_suite
from symphony.bench.suite import Threshold, read_suite
from symphony.cli import main
from symphony.errors import ConfigError, DataError
from symphony.metrics.intervals import t_quantile

EXAMPLES = Path(__file__).parents[1] / "examples"
SUITE = """
[suite]
data = "store"
rollouts = 2
confidence = 0.9

[[planner]]
planner = "log"

[[planner]]
name = "fast"
planner = "planners.py:fast"

[[crowd]]
agent = "playback"

[[threshold]]
metric = "failed_rate"
at_most = 80

[[threshold]]
metric = "log_distance"
at_most = 0.5
confidence = false
planners = ["log"]
"""
PLANNERS = """
def fast(seen):
    return 4.0, 0.3

def broken(seen):
    raise RuntimeError("no idea")
"""
roads = stored(lambda: [straight_road(2, steps=8, seed=k, segment_id=f"road-{k}") for k in range(6)])


@pytest.fixture
def suite(roads: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A suite of six segments, each a group of its own, in two parts."""
    monkeypatch.setattr(bench, "ROUNDS", 2)
    (tmp_path / "store").symlink_to(roads)
    (tmp_path / "planners.py").write_text(PLANNERS)
    (tmp_path / "suite.toml").write_text(SUITE)
    return tmp_path / "suite.toml"


@given(st.lists(st.booleans(), min_size=3, max_size=40), st.sampled_from([0.8, 0.95]))
def test_rates_of_independent_runs_are_binomial(hits: list[bool], confidence: float) -> None:
    """One run a group: the bounds are Clopper's and Pearson's, or a little wider."""
    found = estimate([100.0 * hit for hit in hits], [str(k) for k in range(len(hits))], confidence, "rate")
    assert None not in (found.low, found.mean, found.high)
    assert found.low <= found.mean <= found.high
    n, k = len(hits), sum(hits)
    low = betaincinv(k, n - k + 1, 1 - confidence) if k else 0.0
    high = betaincinv(k + 1, n - k, confidence) if k < n else 1.0
    assert found.low <= 100 * low + 1e-9
    assert found.high >= 100 * high - 1e-9
    if k in (0, n):
        assert (found.low, found.high) == pytest.approx((100 * low, 100 * high))


@pytest.mark.parametrize("kind", ["rate", "share"])
@pytest.mark.parametrize(("rate", "alike", "sizes"), [
    (0.05, 0.6, [5] * 20), (0.2, 0.0, [5] * 20), (0.5, 0.9, [5] * 20), (0.3, 1.0, [40] * 5 + [1] * 25),
    (0.05, 0.0, [1] * 60), (0.01, 0.0, [1] * 200),
])  # fmt: skip
def test_bounds_of_rates_hold_as_often_as_they_say(rate: float, alike: float, sizes: list[int], kind: str) -> None:
    """Also where the runs of a group share their fate; as runs of their own they would not."""
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(len(sizes)), sizes)
    held = 0
    for _ in range(50):
        shared, own = rng.random(len(sizes))[groups] < rate, rng.random(len(groups)) < rate
        hit = np.where(rng.random(len(sizes))[groups] < alike, shared, own)
        held += estimate((100.0 * hit).tolist(), groups.astype(str).tolist(), 0.95, kind).high >= 100 * rate
    assert held / 50 >= 0.93


@given(st.integers(2, 30), st.sampled_from([0.9, 0.95]))
def test_means_have_students_bounds(count: int, confidence: float) -> None:
    values, more = (np.random.default_rng(count).normal(size=n) for n in (count, 21 * count))
    found = estimate(values.tolist(), [str(k) for k in range(count)], confidence)
    spread = t_quantile(confidence, count - 1) * values.std(ddof=1) / np.sqrt(count)
    assert (found.low, found.high) == pytest.approx((values.mean() - spread, values.mean() + spread))
    # One group that is nearly all of it is hardly more than one.
    names = ["a"] * (20 * count) + [str(k) for k in range(count)]
    even = [str(k % (count + 1)) for k in range(21 * count)]
    wide, few = (estimate(more.tolist(), each, confidence) for each in (names, even))
    assert wide.high - wide.mean > few.high - few.mean


@given(st.integers(2, 60), st.sampled_from([0.8, 0.95]))
def test_of_planners_that_did_nothing_wrong_no_difference_is_known_to_be_none(count: int, confidence: float) -> None:
    names = [str(k) for k in range(count)]
    rate = estimate([0.0] * count, names, confidence, "rate")
    found = estimate([0.0] * count, names, confidence, "difference")
    assert found.high == -found.low == pytest.approx(rate.high)
    assert estimate([0.1] * count, names, confidence).high is None


@given(st.lists(st.floats(0, 100), min_size=1, max_size=5), st.integers(2, 60), st.sampled_from([0.8, 0.95]))
def test_a_worse_run_shows_no_better_score(worse: list[float], count: int, confidence: float) -> None:
    """Also where it is the only one that differs: few runs may be far from all others."""
    names = [str(k) for k in range(count + len(worse))]
    found, best = (
        estimate([*some, *[100.0] * count], names, confidence, "share") for some in (worse, [100.0] * len(worse))
    )
    none = estimate([0.0] * len(names), names, confidence, "rate")
    assert found.low <= best.low + 1e-9
    assert (best.low, best.high) == (pytest.approx(100 - none.high), 100)


@given(st.floats(0.1, 60), st.sampled_from([0.8, 0.95, 0.99]))
def test_as_many_groups_as_needed_and_no_more(limit: float, confidence: float) -> None:
    needed = needed_groups(limit, confidence)
    high, less = (
        estimate([0.0] * n, [str(k) for k in range(n)], confidence, "rate").high if n else np.inf
        for n in (needed, needed - 1)
    )
    assert high <= limit * (1 + 1e-9)
    assert less > limit * (1 - 1e-9)


@pytest.mark.parametrize(("old", "new", "line", "field", "why"), [
    ('data = "store"', 'data = "nowhere"', 3, "data", "nowhere"),
    ('data = "store"', 'data = "builtin:all"', 3, "data", "builtin:train"),
    ("rollouts = 2", "rollouts = 0", 4, "rollouts", "at least 1"),
    ("rollouts = 2", "rollout = 2", 4, "rollout", "unknown"),
    ("confidence = 0.9", "confidence = 95", 5, "confidence", "95"),
    ("confidence = 0.9", "segments = 7", 5, "segments", "6 segments"),
    ("confidence = 0.9", 'segments = ["x"]', 5, "segments", "'x'"),
    ("confidence = 0.9", "hardest = 9", 5, "hardest", "6 segments"),
    ("confidence = 0.9", 'baseline = "other"', 5, "baseline", "neither a planner"),
    ('planner = "log"', 'planner = "logs"', 8, "planner", "logs"),
    ("planners.py:fast", "planners.py:slow", 12, "planner", "slow"),
    ('name = "fast"', 'name = "log"', 11, "name", "twice"),
    ('name = "fast"', 'name = "../fast"', 11, "name", "not a valid name"),
    ('planner = "planners.py:fast"', "", 10, "planner", "missing"),
    ('agent = "playback"', 'agent = "nobody"', 15, "agent", "nobody"),
    ('agent = "playback"', 'agent = "playback"\nsearch = "deep"', 16, "search", "deep"),
    ('agent = "playback"', 'agent = "playback"\nseeds = 3', 16, "seeds", "unknown"),
    ('metric = "failed_rate"', 'metric = "fails"', 18, "metric", "failed_rate"),
    ("at_most = 80", "at_most = 1", 19, "at_most", "at least 230 independent groups"),
    ("at_most = 80", "at_most = 0", 19, "at_most", "confidence = false"),
    ("at_most = 80", "at_most = 80\nat_least = 1", 18, "metric", "one of"),
    ("at_most = 80", "at_most = nan", 19, "at_most", "not nan"),
    ("at_most = 80", "at_most = true", 19, "at_most", "True"),
    ("at_most = 80", "at_most = 80\ncompared = true", 20, "compared", "no baseline"),
    ('planners = ["log"]', 'planners = ["logs"]', 25, "planners", "logs"),
    ('planners = ["log"]', "planners = []", 25, "planners", "names none"),
    ("[[crowd]]", "[[crowds]]", 14, "", "unknown table"),
])  # fmt: skip
def test_what_is_wrong_is_refused_before_anything_runs(suite, tmp_path, capsys, old, new, line, field, why):
    suite.write_text(SUITE.replace(old, new, 1))
    assert main(["test", str(suite), "--out", str(tmp_path / "out")]) == 2
    said = re.sub(r"\s+", " ", capsys.readouterr().err)
    assert f"suite.toml, line {line}" in said
    assert f", {field}:" in said or not field
    assert why in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["", "[suite]\n", "[[planner]]\n", "[suite\n", "suite = 3\n", "\0"])
def test_what_is_no_suite_is_refused(suite: Path, text: str) -> None:
    suite.write_text(text)
    with pytest.raises(ConfigError, match=r"suite\.toml"):
        read_suite(suite)


def test_log_playback_passes_and_a_wild_planner_is_judged(suite: Path, tmp_path: Path, capsys: Any) -> None:
    out, junit = tmp_path / "out", tmp_path / "found.xml"
    assert main(["test", str(suite), "--out", str(out), "--junit", str(junit)]) == 0
    found = json.loads((out / "result.json").read_text())
    assert found["passed"]
    log, fast = found["pairs"]
    assert log["numbers"]["log_distance"] == pytest.approx(0, abs=1e-3)
    assert fast["numbers"]["log_distance"] > 1
    assert log["numbers"]["pdm_score"] == 100
    assert fast["numbers"]["pdm_score"] == 0  # it leaves the road
    assert len(log["per_run"]) == log["planned"] == 12
    assert "passes" in capsys.readouterr().out
    tree = ET.fromstring(junit.read_text())  # noqa: S314 - ours
    assert [case.find("failure") for case in tree.iter("testcase")] == [None] * 3
    assert "http" not in (out / "index.html").read_text()
    # Once more: what was simulated is there, and nothing else is found.
    assert main(["test", str(suite), "--out", str(out)]) == 0
    assert json.loads((out / "result.json").read_text())["verdicts"] == found["verdicts"]


def test_thresholds_that_are_lost_fail(suite: Path, tmp_path: Path) -> None:
    suite.write_text(SUITE.replace('planners = ["log"]', "").replace("rollouts = 2", "hardest = 4"))
    chosen = read_suite(suite)
    assert list(chosen.items) == [row for row, _ in hardest(chosen.store, 4)]
    assert main(["test", str(suite), "--out", str(tmp_path / "out"), "--no-view"]) == 1
    tree = ET.parse(tmp_path / "out" / "junit.xml")  # noqa: S314 - ours
    failures = [case.get("classname") for case in tree.iter("testcase") if case.find("failure") is not None]
    assert failures == ["fast among playback"]
    assert not (tmp_path / "out" / "log" / "playback" / "view.html").exists()


def test_a_baseline_is_not_compared_with_itself(suite: Path) -> None:
    suite.write_text(SUITE.replace("[suite]", '[suite]\nbaseline = "log"') + "compared = true\n")
    with pytest.raises(ConfigError, match=r"line 27, .*not compared with itself"):
        read_suite(suite)


def test_a_number_beside_its_limit_is_told_apart_from_it() -> None:
    found = estimate([100.0, 0.0, 0.0], list("xyz"), 0.95, "rate")
    limit = Threshold("at_fault_collision_rate", 33.3, "at_most", None, ("a",), ("b",))
    told = sentence(Verdict(limit, "a", "b", "fails", found, found.mean))
    assert told.endswith(": 33.3333, from 3 runs of 3 groups")


def test_a_rate_compared_with_the_baselines_is_not_known_to_be_equal(suite: Path, tmp_path: Path) -> None:
    """Nothing happens to two that play back the log; that of 6 groups says little."""
    both = SUITE.partition("[[threshold]]")[0].replace("planners.py:fast", "log")
    wanted = '[[threshold]]\nmetric = "failed_rate"\nat_most = 1\ncompared = true\n'
    suite.write_text(both.replace("[suite]", '[suite]\nbaseline = "log"') + wanted)
    found = run_suite(read_suite(suite), tmp_path / "out")
    (one,) = (one for one in found.verdicts if one.threshold.compared)
    assert (one.found.mean, one.status) == (0.0, "fails")
    assert all(pair.report.collision_in.keys() == pair.report.events.keys() for pair in found.pairs)


def test_stopping_early_changes_no_verdict(suite, tmp_path, monkeypatch):
    text = SUITE.replace("planners.py:fast", "planners.py:broken").replace("80", "20\nconfidence = false")
    suite.write_text(text)
    stopped = run_suite(read_suite(suite), tmp_path / "stopped")
    monkeypatch.setattr(bench, "ROUNDS", 1)
    whole = run_suite(read_suite(suite), tmp_path / "whole")
    assert len(stopped.pairs[1].runs) < len(whole.pairs[1].runs) == whole.pairs[1].planned
    assert [one.status for one in stopped.verdicts] == [one.status for one in whole.verdicts]
    assert not stopped.passed
    # Where every run fails there is no result.
    suite.write_text(text.replace('planner = "log"', 'name = "log"\nplanner = "planners.py:broken"'))
    assert main(["test", str(suite), "--out", str(tmp_path / "out")]) == 2


def test_a_suite_that_was_interrupted_goes_on_and_regressions_are_named(suite: Path, tmp_path: Path) -> None:
    """Regressions against a planner, and against an earlier result."""

    def stop(name: str, done: int, total: int) -> None:
        if name.startswith("fast") and done >= 4:
            raise KeyboardInterrupt

    suite.write_text(SUITE.replace("rollouts = 2", 'rollouts = 2\nbaseline = "log"'))
    with pytest.raises(KeyboardInterrupt):
        run_suite(read_suite(suite), tmp_path / "out", stop)
    found = run_suite(read_suite(suite), tmp_path / "out")
    straight = run_suite(read_suite(suite), tmp_path / "other")
    assert [pair.runs for pair in found.pairs] == [pair.runs for pair in straight.pairs]
    assert {one["planner"] for one in found.regressions} == {"fast"}
    assert all(one["segment"] in found.suite.store.ids and one["what"] for one in found.regressions)
    suite.write_text(SUITE.replace("rollouts = 2", 'rollouts = 2\nbaseline = "out/result.json"'))
    assert run_suite(read_suite(suite), tmp_path / "out").regressions == []  # nothing changed
    earlier = tmp_path / "out" / "result.json"
    earlier.write_text(earlier.read_text().replace(found.suite.store.checksum(), "0" * 64))
    with pytest.raises(DataError, match="other run segments"):
        run_suite(read_suite(suite), tmp_path / "third")
    earlier.write_text(earlier.read_text().replace("0" * 64, found.suite.store.checksum()))
    suite.write_text(suite.read_text().replace("[[crowd]]", "[[crowd]]\nduration = 1", 1))
    with pytest.raises(DataError, match="met other traffic then: duration differ"):
        run_suite(read_suite(suite), tmp_path / "third")


@pytest.mark.parametrize(("name", "status"), [("suite.toml", 0), ("suite_fails.toml", 1)])
def test_examples_end_as_they_say(tmp_path: Path, name: str, status: int, monkeypatch: Any) -> None:
    monkeypatch.setattr(bench, "ROUNDS", 1)
    brief(tmp_path / "brief", range(5), 16)
    text = (EXAMPLES / name).read_text().replace("rollouts = 2", "rollouts = 1")
    text = text.replace('data = "builtin:test"', 'data = "brief"')
    text = text.replace("at_least = 50", "at_least = 50\nconfidence = false")  # so few runs tell little
    (tmp_path / name).write_text(re.sub(r"at_most = [1-9]\d", "at_most = 90", text))
    (tmp_path / "coast.py").write_bytes((EXAMPLES / "coast.py").read_bytes())
    assert main(["test", str(tmp_path / name), "--out", str(tmp_path / "out"), "--no-view"]) == status
