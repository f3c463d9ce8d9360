"""The PDM score against values worked out by hand, and which segments are critical."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_saved import played
from helpers_segments import crossing, hide, make_road, make_segment, straight_road
from helpers_store import fill
from symphony.bench.criticality import GENTLE, HARD, LONGEST, criticality, hardest
from symphony.bench.published import PDM, comfortable, derivative, pdm
from symphony.cli import main
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.evaluation.report import Report, add_segment
from symphony.files import finite
from symphony.saved.folder import About, save_rollouts


@given(st.sampled_from([0.1, 0.2]), st.integers(4, 60), st.sampled_from([1, 2]))
def test_derivatives_of_polynomials_are_exact(dt: float, count: int, order: int) -> None:
    time = np.arange(count) * dt
    values = 3 - 2 * time + 0.5 * time**2
    right = -2 + time if order == 1 else np.ones(count)
    assert derivative(values, dt, order) == pytest.approx(right, abs=1e-6)


@pytest.mark.parametrize("dt", [0.1, 0.2])
@pytest.mark.parametrize(("speed", "kind", "kept", "broken"), [
    (20, "along", lambda t: 2.35 * t, lambda t: 2.45 * t), (20, "along", lambda t: -4.0 * t, lambda t: -4.1 * t),
    (10, "turn", lambda t: 0.485 * t, lambda t: 0.495 * t),  # 4.85 and 4.95 m/s² across
    (2, "turn", lambda t: 0.94 * t, lambda t: 0.96 * t),
    # Sines, of which the rate is below its limit.
    (0, "turn", lambda t: 0.3 * np.sin(2 * t), lambda t: 0.3 * np.sin(3 * t)),
    (20, "along", lambda t: 1.1 * np.sin(1.5 * t), lambda t: 0.9 * np.sin(2.6 * t)),
], ids=["speeds up", "brakes", "sideways", "turns", "turn changes", "jerk"])  # fmt: skip
def test_comfort_has_the_published_limits(dt: float, speed: float, kind: str, kept: Any, broken: Any) -> None:
    """Every limit by itself, kept and broken."""
    time = np.arange(0, 4 + dt / 2, dt)
    for changes, comfort in ((kept(time), True), (broken(time), False)):
        heading, gain = (changes, 0 * time) if kind == "turn" else (0 * time, changes)
        assert comfortable(heading, speed + gain, dt) == comfort


def test_the_score_weighs_its_terms_as_published() -> None:
    scores = {(0, 1, 1, 1, 1): 0, (1, 0, 1, 1, 1): 0, (0.5, 1, 1, 1, 1): 6}
    scores |= {(1, 1, 0, 1, 1): 7, (1, 1, 1, 0, 1): 10, (1, 1, 1, 1, 0.5): 9.5}
    for terms, score in scores.items():
        assert PDM(*terms).score == pytest.approx(100 * score / 12)


def test_where_the_log_hardly_moves_there_is_no_progress_to_make() -> None:
    ego = lambda t: (10 * t, 0.0, 0.0, 10.0)  # noqa: E731
    saved, found = played(two(ego, lambda t: (0.0, 500.0, 0.0, 0.0))), Report("made", "ego")
    add_segment(found, saved)
    for ratio in (-0.1, 0.0, 0.003, 0.4):
        for metres, progress in ((3.2, 1.0), (30.0, max(ratio, 0.0))):
            terms = pdm(found.rows[0] | {"progress_ratio": ratio, "log_progress": metres}, saved, [])
            assert terms is not None
            assert terms.progress == progress


def two(ego: Any, other: Any, *, dt: float = 0.2, steps: int = 21) -> RunSegment:
    """Two cars of 4.5 by 2 m: functions of time to x, y, heading, speed."""
    time = np.arange(steps) * dt
    parts = [np.stack(np.broadcast_arrays(time, *one(time))[1:], -1) for one in (ego, other)]
    state = np.stack(parts)
    heading, speed = state[..., 2], state[..., 3]
    road = straight_road(2, steps=2).road
    velocity = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    size = np.array([[4.5, 2.0, 1.5]] * 2, np.float32)
    # Away from the road's edge, so that it plays no part.
    return make_segment(road, state[..., :2] + [0.0, 1000.0], heading, velocity, dt, size=size)


@pytest.mark.parametrize("dt", [0.1, 0.5])
def test_another_that_crosses_behind_the_ego_comes_close_in_time(dt: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ego leaves the crossing at 4.5 / 2 + 1 m past it, the other comes there 2.25 m before it: 1 s later."""
    ego = lambda t: (-10 + 10 * t, 0.0, 0.0, 10.0)  # noqa: E731
    clears = (10 + 1 + 2.25) / 10
    other = lambda t: (0.0, -(clears + 1) * 10 - 1 - 2.25 + 10 * t, np.pi / 2, 10.0)  # noqa: E731
    meets = two(ego, other, dt=dt, steps=round(4 / dt) + 1)
    found = criticality(meets)
    assert found.encroachment == pytest.approx(1.0, abs=1e-6)
    assert 1 - 1.0 / LONGEST - 1e-6 <= found.score <= 4
    # At one time boxes overlap by mistake; on a bridge they do not meet.
    assert criticality(two(ego, lambda t: (*ego(t)[1::-1], np.pi / 2, 10.0), dt=dt)).encroachment == pytest.approx(dt)
    heights = np.tile(np.float32([[0, 1], [6, 2]]), (meets.num_steps, 1, 1))
    monkeypatch.setattr("symphony.bench.criticality.agent_heights", lambda segment: heights)
    assert criticality(meets).encroachment == math.inf


@pytest.mark.parametrize(("height", "margin"), [(0.0, 0.0), (8.0, 3.0)])
def test_the_edges_of_a_bridge_are_no_edges_below_it(height: float, margin: float) -> None:
    """The ego drives down the middle of a road of 8 m, below another one."""
    along = np.arange(-80, 81, 2.0)

    def lines(*aside: float, z: float = 0.0) -> list[Any]:
        return [np.column_stack([along, np.full_like(along, y), np.full_like(along, z)]) for y in aside]

    above = [line[:, [1, 0, 2]] for line in lines(0, -4, 4, z=height)]
    road = make_road([*lines(0), above[0]], boundary=[*lines(-4, 4), *above[1:]])
    position = np.zeros((1, 41, 3)) + np.array([0, 0, 0.75])
    position[0, :, 0] += 2 * np.arange(41) - 40
    moves = np.zeros((1, 41)), np.tile([10.0, 0.0], (1, 41, 1))
    ego = make_segment(road, position, *moves, 0.2, size=np.array([[4.5, 2.0, 1.5]], np.float32))
    assert criticality(ego).margin == pytest.approx(margin, abs=1e-6)


def test_who_follows_in_a_lane_does_not_cross() -> None:
    found = criticality(two(lambda t: (10 * t, 0.0, 0.0, 10.0), lambda t: (-12 + 10 * t, 0.0, 0.0, 10.0)))
    assert found.encroachment == found.time_to_collision == math.inf


def test_time_to_collision_is_that_of_the_gap() -> None:
    """15 m between bumpers at first, closing at 5 m/s: after 2 s 5 m are left, 1 s."""
    other = lambda t: (19.5 + 5 * t, 0.0, 0.0, 5.0)  # noqa: E731
    found = criticality(two(lambda t: (10 * t, 0.0, 0.0, 10.0), other, steps=11))
    assert found.time_to_collision == pytest.approx(1.0, abs=0.01)


@given(st.floats(0.0, 8.0))
def test_braking_counts_from_gentle_to_hard(braking: float) -> None:
    ego = lambda t: (20 * t - braking * t * t / 2, 0.0, 0.0, 20 - braking * t)  # noqa: E731
    found = criticality(hide(two(ego, lambda t: (0.0, 500.0, 0.0, 0.0), steps=6), 0, 3))
    assert found.braking == pytest.approx(braking, abs=0.01)
    assert found.score == pytest.approx(min(1, max(0, (braking - GENTLE) / (HARD - GENTLE))), abs=0.01)


def test_the_hardest_come_first_and_are_listed(tmp_path: Path, capsys: Any) -> None:
    roads = [straight_road(3, steps=8, seed=seed) for seed in (0, 2)]
    fill(tmp_path / "store", [roads[0], crossing(4, steps=30), roads[1]])
    store = SegmentStore(tmp_path / "store")
    found = hardest(store, 2)
    assert len(found) == 2
    assert found[0][1].score >= found[1][1].score
    assert main(["data", "hardest", str(tmp_path / "store"), "--count", "2", "--ids"]) == 0
    assert capsys.readouterr().out.split() == [one.segment for _, one in found]
    assert main(["data", "hardest", str(tmp_path / "store"), "--json", "-"]) == 0
    assert "time_to_collision" in capsys.readouterr().out
    assert main(["data", "hardest", str(tmp_path / "store"), "--ids", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)


def test_of_rollouts_the_hardest_are_named_by_segment_and_number(tmp_path: Path, capsys: Any) -> None:
    """The log played back is as critical as the log, one in which the ego brakes or collides is more so."""
    segment = crossing(4, steps=30)
    one = played(segment, rollouts=3)
    one.state[1, 20:, 0, 3] -= 2.0  # within 0.2 s
    one.collision[2, 9, 0] = one.collision[0, -1, 0] = True
    one.counted[0, -1, 0] = False  # so it did not happen
    save_rollouts(tmp_path / "sim", About("made"), [one, played(straight_road(3, steps=8))])
    assert main(["data", "hardest", str(tmp_path / "sim"), "--count", "3", "--json", "-"]) == 0
    brakes, hits, log = sorted(json.loads(capsys.readouterr().out), key=lambda one: (one["rollout"] - 1) % 3)
    assert {one["segment"] for one in (brakes, hits, log)} == {segment.segment_id}
    for name, value in asdict(criticality(segment)).items():
        assert name in ("segment", "rollout") or log[name] == pytest.approx(finite(value), abs=1e-3), name
    assert brakes["braking"] == pytest.approx(10.0, abs=0.5)
    assert (hits["time_to_collision"], hits["score"] > log["score"]) == (0.0, True)
    assert main(["data", "hardest", str(tmp_path / "sim"), "--ids"]) == 0
    assert capsys.readouterr().out.split() == [segment.segment_id, "straight-0"]
