"""Features of the WOSAC score: numbers worked out by hand, slow plain oracles, laws."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_wosac import ROAD, edge_distance, made_rollouts, made_scenario, rounded_gap
from symphony.errors import DataError
from symphony.wosac.scorer import (
    Lines,
    SimulatedRollouts,
    WosacFeatures,
    cells,
    compute_features,
    kinematics,
)
from symphony.wosac.scorer.interaction import distance_to_nearest, time_to_collision
from symphony.wosac.scorer.lights import Lanes, Signals, red_light_violations
from symphony.wosac.scorer.road import Edges, distance_to_road_edge, signed_distance_to_edges


def every(features: WosacFeatures) -> dict[str, NDArray[Any]]:
    """All features by name."""
    sources = {"log": features.log, "sim": features.simulated}
    return {
        f"{side}_{name}": getattr(source, name).numpy()
        for side, source in sources.items()
        for name in source.__dataclass_fields__
    }


def test_speeds_by_hand() -> None:
    # Every step 0.3 m along x and 0.4 m along y, then 0.4 m up as well: 5 m/s, later sqrt(41) m/s.
    step = torch.arange(6.0)
    up = torch.tensor([0, 0, 0, 0.4, 0.8, 1.2])
    speed = kinematics.speed(0.3 * step, 0.4 * step, up)
    assert speed[[0, -1]].isnan().all()
    half = math.hypot(3, 4, 2)
    expected = torch.tensor([5.0, half, math.sqrt(41), math.sqrt(41)])
    torch.testing.assert_close(speed[1:-1], expected)
    change = kinematics.acceleration(speed)
    assert change[[0, 1, -2, -1]].isnan().all()
    torch.testing.assert_close(change[2:4], (expected[2:] - expected[:2]) / 2 / 0.1)


def test_turning_takes_the_short_way_round() -> None:
    heading = torch.tensor([3.0, 3.1, 3.2, 3.3, 3.4]) + torch.tensor([0, 0, -2, 4, 0]) * math.pi
    turning, change = kinematics.angular(heading)
    torch.testing.assert_close(turning[1:-1], torch.ones(3), rtol=1e-4, atol=1e-4)
    assert change[2].abs() < 1e-3
    assert change[[0, 1, 3, 4]].isnan().all()


def test_mask_of_speeds_looks_at_both_neighbours_only() -> None:
    valid = torch.tensor([1, 1, 1, 0, 1, 1, 1, 1, 1], dtype=torch.bool)
    once = kinematics.speed_mask(valid)
    assert once.tolist() == [False, True, False, True, False, True, True, True, False]
    assert kinematics.speed_mask(once).nonzero()[:, 0].tolist() == [2, 4, 6]


def random_boxes(rng: np.random.Generator, count: int, spread: float = 6.0) -> tuple[Any, ...]:
    center = rng.uniform(-spread, spread, (count, 2))
    return center, rng.uniform(-7, 7, count), rng.uniform(0.5, 8, (count, 2))


@given(st.integers(0, 2**32 - 1), st.sampled_from([2.0, 6.0, 40.0]))
def test_nearest_object_agrees_with_shapely(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    center, heading, size = random_boxes(rng, 5, spread)
    valid = rng.random(5) < 0.8
    tensors = [torch.tensor(a, dtype=torch.float32)[None, :, None] for a in (center, heading, size)]
    found = distance_to_nearest(*tensors, torch.tensor(valid)[None, :, None], 2)[0, :, 0]
    shapes = [(c, h, *s) for c, h, s in zip(center, heading, size, strict=True)]
    for i in range(2):
        others = [rounded_gap(shapes[i], shapes[j]) for j in range(5) if j != i and valid[i] and valid[j]]
        assert found[i].item() == pytest.approx(min(others, default=1e10), abs=2e-4)


def test_time_to_collision_by_hand() -> None:
    # Itself at 10 m/s; 20 m ahead, centre to centre, one at 6 m/s; both 4 m long: a gap of 16 m closing at 4 m/s.
    def found(x: float, y: float, heading: float, speed: float, valid: bool = True) -> float:
        position = torch.tensor([[0.0, 0.0], [x, y]])[None, :, None]
        size = torch.tensor([[4.0, 2.0], [4.0, 2.0]])[None, :, None]
        headings = torch.tensor([0.0, heading])[None, :, None]
        there = torch.tensor([False, valid])[None, :, None]
        return time_to_collision(
            position, headings, size, there, torch.tensor([10.0, speed])[None, :, None], 1
        ).item()

    assert found(20, 0, 0, 6) == pytest.approx(4)
    assert found(20, 0, 0, 9) == 5  # In 16 s, beyond the limit.
    assert found(20, 0, 0, 12) == 5  # It drives away.
    assert found(-20, 0, 0, 6) == 5  # Behind.
    assert found(20, 0, 0, 6, valid=False) == 5
    assert found(20, 0, 0, math.nan) == 5
    assert found(20, 2.5, 0, 6) == 5  # In the next lane.
    assert found(20, 1.8, 0, 6) == pytest.approx(4)  # 0.2 m of overlap, same direction: followed.
    assert found(20, 2.5, math.radians(20), 6) == 5  # 0.26 m of overlap only, across: not followed.
    assert found(20, 0, math.radians(80), 6) == 5  # Crossing.
    assert found(20, 0, 2 * math.pi, 6) == 5  # Same direction, but a turn apart, as it is stored.


def points_near(rng: np.random.Generator, lines: list[NDArray[Any]], count: int) -> NDArray[Any]:
    points = np.concatenate(lines)
    near = points[rng.integers(len(points), size=count)] + rng.normal(0, [6, 6, 1], (count, 3))
    return np.concatenate([near, rng.uniform(-300, 300, (10, 3))]).astype(np.float32)


def not_tied(point: NDArray[Any], lines: list[NDArray[Any]]) -> bool:
    """Whether all segments that are nearest in float32, heights counted three times, are equally far from above."""
    start = np.concatenate([line[:-1] for line in lines])
    along = np.concatenate([np.diff(line, axis=0) for line in lines])
    away, squared = point - start, (along[:, :2] ** 2).sum(1)
    share = ((away * along)[:, :2].sum(1) / np.where(squared == 0, 1, squared)).clip(0, 1)
    offset = (away - share[:, None] * along) * [1, 1, 3]
    square = (offset**2).sum(1)
    return bool(np.ptp(np.hypot(*offset[square <= square.min() * (1 + 1e-6), :2].T)) < 1e-3)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_road_edges_agree_with_looking_at_every_segment(seed: int, closed: bool) -> None:
    rng = np.random.default_rng(seed)
    lines = [
        np.cumsum(rng.normal(0, [4, 4, 0.3], (rng.integers(2, 9), 3)), 0).astype(np.float32) for _ in range(4)
    ]
    if closed:
        lines[0] = np.concatenate([lines[0], rng.normal(0, 5, (2, 3)).astype(np.float32), lines[0][:1] + 0.2])
    points = points_near(rng, lines, 60)
    found = signed_distance_to_edges(torch.from_numpy(points), Edges.of(Lines.of(lines)))
    wide = [line.astype(np.float64) for line in lines]
    expected = np.array([edge_distance(point, wide) for point in points.astype(np.float64)])
    # Where two segments are equally near, rounding may choose either; their distances seen from above may differ.
    one = np.array([not_tied(point, wide) for point in points.astype(np.float64)])
    assert one.mean() > 0.9
    np.testing.assert_allclose(found.abs().numpy()[one], np.abs(expected)[one], atol=2e-3, rtol=1e-4)
    clear = np.abs(expected) > 1e-2
    # Their sides may differ likewise.
    agree = np.sign(found.numpy()[clear]) == np.sign(expected[clear])
    assert agree.mean() > 0.97


@pytest.mark.parametrize("far", [0.0, 80_000.0])
def test_cells_and_blocks_change_nothing(far: float, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    move = np.array([far, -far, 0])
    lines = [
        np.cumsum(rng.normal(0, [3, 3, 0.5], (40, 3)), 0) + rng.uniform(-90, 90, 3) * [1, 1, 0]
        for _ in range(9)
    ]
    points = points_near(rng, lines, 500)
    points[:3] *= 1e4
    edges, points = Edges.of(Lines.of([line + move for line in lines])), points + move.astype(np.float32)
    lanes = Lanes.of(Lines.of([line + move for line in lines]), torch.arange(9))
    given = torch.from_numpy(points)
    found = []
    for cell, pairs in ((1e12, 1 << 30), (cells.CELL, cells._PAIRS), (0.3, 100)):
        monkeypatch.setattr(cells, "CELL", cell)
        monkeypatch.setattr(cells, "_PAIRS", pairs)
        found.append((signed_distance_to_edges(given, edges), lanes.nearest(given[:, :2])))
    for distance, segment in found[1:]:
        torch.testing.assert_close(distance, found[0][0], rtol=0, atol=0)
        assert torch.equal(segment, found[0][1])


def test_edge_by_hand() -> None:
    edges = Edges.of(Lines.of([ROAD, [(5.0, 5.0, 0.0)]]))
    points = torch.tensor([[0.0, 0, 0], [10, -11, 0], [0, -8, 0], [203, -12, 0]])
    torch.testing.assert_close(signed_distance_to_edges(points, edges), torch.tensor([-8.0, 3, 0, 5]))


def test_an_edge_on_another_level_is_not_taken() -> None:
    bridge = [(x, y - 10.0, 6.0) for x, y, _ in ROAD]
    edges = Edges.of(Lines.of([ROAD, bridge]))
    points = torch.tensor([[0.0, -14, 0], [0, -14, 6]])
    torch.testing.assert_close(signed_distance_to_edges(points, edges), torch.tensor([6.0, -4]))
    # Without heights counting threefold, the lower point is nearer to the bridge's edge.
    near = torch.tensor([[0.0, -16, 3]])
    assert signed_distance_to_edges(near, edges, 0.0).item() == pytest.approx(-2)


def ring(count: int, radius: float) -> NDArray[Any]:
    angle = np.linspace(0, 2 * np.pi, count)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)), -1)


def test_closed_edges_continue_only_where_no_other_has_more_points() -> None:
    edges = Edges.of(Lines.of([ring(5, 10), ring(9, 30)]))
    assert edges.previous[[0, 4]].tolist() == [-1, 11]
    assert edges.following[[3, 11]].tolist() == [-1, 4]
    # Counter-clockwise: the inside is on the left, so on the road.
    points = torch.tensor([[5.0, 0, 0], [31.0, 0, 0], [29.0, 0, 0]])
    alone = Edges.of(Lines.of([ring(9, 30)]))
    torch.testing.assert_close(signed_distance_to_edges(points, alone)[1:].sign(), torch.tensor([1.0, -1]))


def test_a_box_is_as_far_off_as_its_worst_corner() -> None:
    edges = Edges.of(Lines.of([ROAD]))
    size = torch.tensor([[4.0, 2.0, 1.5]]).expand(3, 3)
    center = torch.tensor([[0.0, 0, 0], [0, -7, 0], [0, -7, 0]])
    heading = torch.tensor([0.0, 0, math.pi / 2])
    valid = torch.tensor([True, True, False])
    found = distance_to_road_edge(center, heading, size, valid, edges)
    torch.testing.assert_close(found, torch.tensor([-7.0, 0.0, -1e10]))
    turned = distance_to_road_edge(center, heading, size, torch.ones(3, dtype=torch.bool), edges)
    assert turned[2].item() == pytest.approx(1, abs=1e-5)


def crossing(state: int = 4, *, lane: int = 7, driven: float = 0.0, aside: float = 0.0) -> bool:
    """Whether a car that passes x = 30 between two steps runs a light there, at one step in four."""
    lanes = Lanes.of(
        Lines.of([[(k, 0.0, 0.0) for k in range(0, 60, 2)], [(k, 40.0, 0.0) for k in range(0, 60, 2)]]),
        torch.tensor([7, 8]),
    )
    x = torch.tensor([28.0, 29.5, 30.5, 32.0]) + driven
    position = torch.stack((x, torch.full_like(x, aside)), -1)[None]
    steps = torch.arange(4)
    signals = Signals.of(
        steps, torch.full((4,), lane), torch.full((4,), state), torch.tensor([[30.0, 0.5]]).expand(4, 2), 4
    )
    found = red_light_violations(position, torch.ones(1, 4, dtype=torch.bool), lanes, signals)
    assert not found[0, [0, 1, 3]].any()
    return bool(found[0, 2])


def test_red_lights_by_hand() -> None:
    assert crossing()
    assert crossing(state=1)
    assert not any(crossing(state=state) for state in (0, 2, 3, 5, 6, 7, 8))
    assert not crossing(lane=8)
    assert not crossing(lane=9)  # A lane that is not there.
    assert not crossing(aside=40.0)  # On the other lane.


def test_a_light_that_is_not_observed_has_its_stop_point_at_the_origin() -> None:
    # As the official scorer has it: at the step before, the car at x = 29.5 is beyond the origin.
    lanes = Lanes.of(Lines.of([[(k, 0.0, 0.0) for k in range(0, 60, 2)]]), torch.tensor([7]))
    position = torch.tensor([[[28.0, 0], [29.5, 0], [30.5, 0], [32.0, 0]]])
    seen = torch.tensor([2, 3])
    signals = Signals.of(
        seen, torch.tensor([7, 7]), torch.tensor([4, 4]), torch.tensor([[30.0, 0.0]] * 2), steps=4
    )
    assert not red_light_violations(position, torch.ones(1, 4, dtype=torch.bool), lanes, signals).any()


def test_nearest_lane_segment_agrees_with_looking_at_every_one() -> None:
    rng = np.random.default_rng(3)
    lines = [np.cumsum(rng.normal(0, 4, (count, 3)), 0) + 50 for count in (2, 6, 9, 1, 9)]
    lanes = Lanes.of(Lines.of(lines), torch.arange(5))
    points = torch.from_numpy((rng.uniform(-20, 120, (300, 2))).astype(np.float32))
    best = torch.full((300,), torch.inf)
    expected = torch.zeros(300, dtype=torch.long)
    # Lanes that are shorter than the longest one have one more segment, to the origin.
    segments = [
        (lane, k, line[k], line[k + 1] if k + 1 < len(line) else np.zeros(3))
        for lane, line in enumerate(lines)
        if len(line) > 1
        for k in range(len(line) - (len(line) == 9))
    ]
    for number, (_, _, start, end) in enumerate(segments):
        away, along = points - torch.tensor(start[:2]).float(), torch.tensor((end - start)[:2]).float()
        share = (away @ along / (along @ along)).clamp(0, 1)
        value = (away + share[:, None] * along).norm(dim=-1)
        expected = torch.where(value < best - 1e-4, number, expected)
        best = torch.minimum(best, value)
    found = lanes.nearest(points)
    assert [(a, b) for a, b, _, _ in segments] == list(
        zip(lanes.lane.tolist(), lanes.number.tolist(), strict=True)
    )
    assert (found == expected).float().mean() > 0.98


def test_displacement_counts_the_history_too() -> None:
    scenario = made_scenario()
    log = made_rollouts(scenario, 2, noise=0.0)
    off = replace(log, y=log.y + 3.0, z=log.z + 4.0)
    found = compute_features(scenario, off).simulated.average_displacement_error
    torch.testing.assert_close(found, torch.full((2, 2), 5 * 80 / 91))


def test_playback_has_the_features_of_the_log() -> None:
    scenario = made_scenario()
    found = every(compute_features(scenario, made_rollouts(scenario, 2, noise=0.0)))
    for name in (name for name in found if name.startswith("log_")):
        np.testing.assert_array_equal(np.stack([found[name]] * 2), found[name.replace("log_", "sim_")])


def shuffled(rollouts: SimulatedRollouts, order: list[int]) -> SimulatedRollouts:
    parts = {name: getattr(rollouts, name)[:, order] for name in ("x", "y", "z", "heading")}
    return SimulatedRollouts(rollouts.object_id[order], **parts)


def test_order_of_agents_and_rollouts_does_not_matter() -> None:
    scenario = made_scenario(5)
    rollouts = made_rollouts(scenario, 3)
    plain = every(compute_features(scenario, rollouts))
    mixed = every(compute_features(scenario, shuffled(rollouts, [3, 0, 4, 1, 2])))
    for name, values in plain.items():
        np.testing.assert_array_equal(mixed[name], values, err_msg=name)
    backwards = SimulatedRollouts(
        rollouts.object_id, *(getattr(rollouts, name).flip(0) for name in ("x", "y", "z", "heading"))
    )
    turned = every(compute_features(scenario, backwards))
    for name, values in plain.items():
        np.testing.assert_array_equal(turned[name], values[::-1] if name.startswith("sim_") else values)


def test_agents_that_are_not_there_change_nothing() -> None:
    scenario = made_scenario(4)
    more = made_scenario(6)
    grown = replace(
        more,
        position=torch.cat([scenario.position, more.position[4:]]),
        valid=more.valid & (torch.arange(6) < 4)[:, None],
    )
    rollouts = made_rollouts(scenario, 2)
    plain, found = (every(compute_features(each, rollouts)) for each in (scenario, grown))
    for name, values in plain.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_turning_and_moving_the_world_changes_little() -> None:
    """But for headings, which are compared as they are, and for the origin, which lights know."""
    scenario = made_scenario(4, signal_lane=np.full(91, 99))
    rollouts = made_rollouts(scenario, 2)
    angle, move = 0.7, torch.tensor([300.0, -200.0])
    cos, sin = math.cos(angle), math.sin(angle)

    def turned(x: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return cos * x - sin * y + move[0], sin * x + cos * y + move[1]

    def line(lines: Lines) -> Lines:
        x, y, z = lines.points.unbind(-1)
        return Lines(torch.stack((*turned(x, y), z), -1), lines.counts)

    x, y, z = scenario.position.unbind(-1)
    elsewhere = replace(
        scenario,
        position=torch.stack((*turned(x, y), z), -1),
        heading=scenario.heading + angle,
        road_edges=line(scenario.road_edges),
        lanes=line(scenario.lanes),
    )
    x, y = turned(rollouts.x, rollouts.y)
    there = replace(rollouts, x=x, y=y, heading=rollouts.heading + angle)
    plain, found = every(compute_features(scenario, rollouts)), every(compute_features(elsewhere, there))
    tolerance = {"linear_acceleration": 0.02, "angular_acceleration": 0.01, "time_to_collision": 0.01}
    for name, values in plain.items():
        limit = tolerance.get(name[4:], 1e-3)
        np.testing.assert_allclose(found[name].astype(float), values.astype(float), atol=limit, err_msg=name)


def test_a_scenario_without_lights_or_lanes_has_no_violations() -> None:
    none: list[int] = []
    empty = {"signal_step": none, "signal_lane": none, "signal_state": none}
    bare = made_scenario(**{k: np.array(v, int) for k, v in empty.items()}, signal_point=np.zeros((0, 2)))
    for scenario in (
        bare,
        made_scenario(lanes=[], lane_id=np.array(none, int), lane_type=np.array(none, int)),
    ):
        features = compute_features(scenario, made_rollouts(scenario))
        assert not features.simulated.traffic_light_violation_per_step.any()


def test_a_red_light_is_run_in_a_scenario() -> None:
    # The first agent drives along the lane and passes x = 30 after step 20.
    features = compute_features(made_scenario(), made_rollouts(made_scenario(), 2, noise=0.0))
    assert features.simulated.traffic_light_violation_per_step.any(-1).tolist() == [[True, False]] * 2


@pytest.mark.parametrize(("changes", "field", "text"), [
    ({"road_edges": []}, "road_edge", "no road edge"),
    ({"road_edges": [[(0.0, 0.0, 0.0)]]}, "road_edge", "two or more points"),
    ({"road_edges": [[(0.0, 0.0, 0.0), (math.nan, 1.0, 0.0)]]}, "road_edge", "not finite"),
    ({"object_id": [10, 11, 11, 12]}, "object_id", "agent 11 more than once"),
    ({"evaluated": [10, 77]}, "tracks_to_predict", "agent 77 to be scored"),
    ({"evaluated": []}, "evaluated", "no object to score"),
    ({"valid": np.ones((4, 90), bool)}, "valid", "has shape"),
    ({"size": np.zeros((4, 3), np.float32)}, "size", "without length or width"),
    ({"signal_step": np.arange(91) + 1}, "signal_step", "outside the 91 steps"),
    ({"heading": np.full((4, 91), np.inf, np.float32)}, "heading", "agents 10, 11, 12, 13 not finite"),
])  # fmt: skip
def test_scenarios_that_cannot_be_scored(changes: dict[str, Any], field: str, text: str) -> None:
    with pytest.raises(DataError, match=text) as caught:
        made_scenario(**changes)
    assert (caught.value.segment, caught.value.field) == ("made", field)


def nan_at(rollouts: SimulatedRollouts) -> SimulatedRollouts:
    x = rollouts.x.clone()
    x[1, 2, 5] = math.nan
    return replace(rollouts, x=x)


@pytest.mark.parametrize(("change", "field", "text"), [
    (lambda r: shuffled(r, [0, 1, 2]), "object_id", "agent 13 missing"),
    (lambda r: replace(r, object_id=torch.tensor([10, 11, 12, 99])), "object_id", "agent 13 missing"),
    (lambda r: replace(r, object_id=torch.tensor([10, 11, 12, 12])), "object_id", "agent 12 more than once"),
    (lambda r: replace(r, object_id=r.object_id.float()), "object_id", "whole numbers"),
    (lambda r: replace(r, y=r.y[..., :79]), "y", "has shape"),
    (lambda r: replace(r, heading=r.heading.long()), "heading", "floating-point"),
    (lambda r: replace(r, x=r.x[0, 0, 0]), "x", "no rollouts"),
    (lambda r: replace(r, x=r.x[:0]), "x", "no rollouts"),
    (nan_at, "x", "agent 12, rollout 1, step 16: not finite"),
])  # fmt: skip
def test_rollouts_that_cannot_be_scored(change: Any, field: str, text: str) -> None:
    scenario = made_scenario()
    with pytest.raises(DataError, match=text) as caught:
        compute_features(scenario, change(made_rollouts(scenario)))
    assert (caught.value.segment, caught.value.field) == ("made", field)


def test_extra_agents_are_refused() -> None:
    scenario = made_scenario()
    gone = replace(scenario, valid=scenario.valid & (torch.arange(4) < 3)[:, None])
    with pytest.raises(DataError, match="agent 13 in the rollouts, but not valid at step 10"):
        compute_features(gone, made_rollouts(scenario))
