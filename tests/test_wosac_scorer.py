"""The WOSAC score: laws, and numbers by hand; what the official scorer finds is in ``test_wosac_parity.py``."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_wosac import ROAD, made_rollouts, made_scenario
from symphony.errors import DataError
from symphony.wosac import CHALLENGES, SimulatedRollouts
from symphony.wosac.scorer import compute_features, object_scores, road, score, score_features
from symphony.wosac.scorer.boxes import Boxes, time_to_collision
from symphony.wosac.scorer.config import BUCKETS
from symphony.wosac.scorer.lights import Lanes, Signals, red_light_violations
from symphony.wosac.scorer.road import Edges, signed_distance_to_edges
from symphony.wosac.scorer.scenario import STATES
from symphony.wosac.scorer.scoring import bin_of, flag_log_likelihood, histogram_log_likelihood


def every(features):
    """All features by name."""
    sources = {"log": features.log, "sim": features.simulated}
    return {f"{side}_{name}": v.numpy() for side, source in sources.items() for name, v in source.items()}


def taken(rollouts, agents=slice(None), which=slice(None)):
    parts = {name: getattr(rollouts, name)[which][:, agents] for name in STATES}
    return SimulatedRollouts(rollouts.object_id[agents], **parts)


@pytest.mark.parametrize(("x", "y", "heading", "speed", "found"), [
    (20, 0, 0, 6, 4),
    (20, 0, 0, 9, 5),  # In 16 s, beyond the limit.
    (20, 0, 0, 12, 5),  # It drives away.
    (-20, 0, 0, 6, 5),  # Behind.
    (20, 0, 0, math.nan, 5),
    (20, 2.5, 0, 6, 5),  # In the next lane.
    (20, 1.8, 0, 6, 4),  # 0.2 m of overlap, same direction: followed.
    (20, 2.5, math.radians(20), 6, 5),  # 0.26 m of overlap only, across: not followed.
    (20, 0, math.radians(80), 6, 5),  # Crossing.
    (20, 0, 2 * math.pi, 6, 5),  # Same direction, but a turn apart, as it is stored.
])  # fmt: skip
def test_time_to_collision_by_hand(x, y, heading, speed, found):
    # Itself at 10 m/s; both 4 m long: 20 m ahead, centre to centre, is a gap of 16 m.
    given = ([[0.0, 0.0], [x, y]], [0.0, heading], [[4.0, 2.0]] * 2, [False, True], [10.0, speed])
    position, angle, size, valid, speeds = (torch.tensor(value)[None, :, None] for value in given)
    boxes = Boxes(position, angle, size, valid, speeds)
    assert time_to_collision(boxes, 1).item() == pytest.approx(found)
    assert time_to_collision(boxes._replace(valid=~boxes.valid), 1).item() == 5


@pytest.mark.parametrize("far", [0.0, 80_000.0])
def test_how_points_share_cells_changes_nothing(far, monkeypatch):
    rng, move = np.random.default_rng(5), np.array([far, -far, 0])
    walks = np.cumsum(rng.normal(0, [3, 3, 0.5], (9, 40, 3)), 1)
    lines = walks + rng.uniform(-90, 90, (9, 1, 3)) * [1, 1, 0] + move
    near = lines.reshape(-1, 3)[rng.integers(360, size=500)] + rng.normal(0, [6, 6, 1], (500, 3))
    near[:3] *= 1e4
    edges, points, found = Edges.of(list(lines)), torch.from_numpy(near.astype(np.float32)), []
    # In one cell for all every segment is measured.
    for cell, together in ((1e8, 600), (road._CELL, 100), (30.0, 600)):
        monkeypatch.setattr(road, "_CELL", cell)
        monkeypatch.setattr(road, "_TOGETHER", together)
        found.append(signed_distance_to_edges(points, edges))
    assert all(torch.equal(distance, found[0]) for distance in found[1:])


def test_road_edges_by_hand():
    edges = Edges.of([ROAD, np.array([(5.0, 5.0, 0.0)])])
    points = torch.tensor([[0.0, 0, 0], [10, -11, 0], [0, -8, 0], [203, -12, 0]])
    torch.testing.assert_close(signed_distance_to_edges(points, edges), torch.tensor([-8.0, 3, 0, 5]))
    # An edge on another level is not taken.
    edges = Edges.of([ROAD, np.add(ROAD, [0, -10, 6])])
    points = torch.tensor([[0.0, -14, 0], [0, -14, 6], [0, -16, 3]])
    torch.testing.assert_close(signed_distance_to_edges(points[:2], edges), torch.tensor([6.0, -4]))
    # Without heights counting threefold, the lower point is nearer to the bridge's edge.
    assert signed_distance_to_edges(points[2:], edges, 0.0).item() == pytest.approx(-2)


@pytest.mark.parametrize(("runs", "change"), [
    (True, {}), *((state in (1, 4), {"state": state}) for state in range(9)), (False, {"lane": 8}),
    (False, {"lane": 9}),  # A lane that is not there.
    (False, {"aside": 40.0}),  # The car is on the other lane.
    (False, {"seen": 2}),  # Not observed before, its stop point was at the origin then, which the car had passed.
    (False, {"seen": 4}),
])  # fmt: skip
def test_red_lights_by_hand(runs, change):
    """A car that passes x = 30 between two steps, and a light there."""
    how = {"state": 4, "lane": 7, "aside": 0.0, "seen": 0} | change
    lanes = Lanes.of([[(k, y, 0.0) for k in range(0, 60, 2)] for y in (0.0, 40.0)], [7, 8])
    position = torch.tensor([[(x, how["aside"]) for x in (28.0, 29.5, 30.5, 32.0)]])
    steps = np.arange(how["seen"], 4)
    light = (np.full(len(steps), how[name]) for name in ("lane", "state"))
    signals = Signals.of(steps, *light, np.tile([30.0, 0.5], (len(steps), 1)), 4)
    found = red_light_violations(position, torch.ones(1, 4, dtype=torch.bool), lanes, signals)
    assert found[0].tolist() == [False, False, runs, False]


def test_playback_has_the_features_of_the_log_runs_the_light_and_scores_best():
    scenario = made_scenario()
    features = compute_features(scenario, made_rollouts(scenario, 2, noise=0.0))
    for name, values in features.log.items():
        np.testing.assert_array_equal(features.simulated[name], torch.stack([values] * 2), err_msg=name)
    assert features.simulated["traffic_light_violation_per_step"].any(-1).tolist() == [[True, False]] * 2
    scores = [score(scenario, made_rollouts(scenario, 4, noise))["metametric"] for noise in (0.0, 0.5, 3.0)]
    assert scores[0] > scores[1] > scores[2]


def test_order_and_who_is_not_there_change_nothing():
    scenario, more = made_scenario(5), made_scenario(7)
    rollouts, there = made_rollouts(scenario, 3), (np.arange(7) < 5)[:, None]
    plain = every(compute_features(scenario, rollouts))
    mixed = every(compute_features(scenario, taken(rollouts, [3, 0, 4, 1, 2], [2, 1, 0])))
    position = np.concatenate([scenario.position, more.position[5:]])
    grown = replace(more, position=position, valid=more.valid & there)
    for name, values in plain.items():
        np.testing.assert_array_equal(mixed[name], values[::-1] if name.startswith("sim_") else values)
        np.testing.assert_array_equal(every(compute_features(grown, rollouts))[name], values, err_msg=name)


def test_turning_and_moving_the_world_changes_little():
    """But for headings, which are compared as they are, and for the origin, which lights know."""
    scenario, angle = made_scenario(4, signal_lane=np.full(91, 99)), 0.7
    rollouts, (cos, sin) = made_rollouts(scenario, 2), (math.cos(angle), math.sin(angle))

    def turned(*points):
        turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        return [np.asarray(each) @ turn + [300.0, -200.0, 0.0] for each in points]

    edges, lanes = turned(*scenario.road_edges), turned(*scenario.lanes)
    (position,), heading = turned(scenario.position), scenario.heading + angle
    elsewhere = replace(scenario, position=position, heading=heading, road_edges=edges, lanes=lanes)
    x, y, _ = np.moveaxis(turned(np.stack([rollouts.x, rollouts.y, rollouts.z], -1))[0], -1, 0)
    there = replace(rollouts, x=x, y=y, heading=rollouts.heading + angle)
    plain, found = every(compute_features(scenario, rollouts)), every(compute_features(elsewhere, there))
    tolerance = {"linear_acceleration": 0.02, "angular_acceleration": 0.01, "time_to_collision": 0.01}
    for name, values in plain.items():
        limit = tolerance.get(name[4:], 1e-3)
        np.testing.assert_allclose(found[name].astype(float), values.astype(float), atol=limit, err_msg=name)


@pytest.mark.parametrize(("changes", "field", "text"), [
    ({"road_edges": [ROAD[:1]]}, "road_edge", "no road edge of two or more points"),
    ({"road_edges": [np.array([(0.0, 0.0, 0.0), (math.nan, 1.0, 0.0)])]}, "road_edge", "not finite"),
    ({"object_id": np.array([10, 11, 11, 12])}, "object_id", "agent 11 more than once"),
    ({"evaluated": np.array([10, 77])}, "tracks_to_predict", "agent 77 to be scored"),
    ({"evaluated": np.zeros(0, int)}, "evaluated", "no object to score"),
    ({"size": np.zeros((4, 3), np.float32)}, "size", "without length or width"),
    ({"heading": np.full((4, 91), np.inf, np.float32)}, "heading", "agents 10, 11, 12, 13 not finite"),
])  # fmt: skip
def test_scenarios_that_cannot_be_scored(changes, field, text):
    with pytest.raises(DataError, match=text) as caught:
        made_scenario(**changes)
    assert (caught.value.segment, caught.value.field) == ("made", field)


@pytest.mark.parametrize(("change", "field", "text"), [
    (lambda r: taken(r, [0, 1, 2]), "object_id", "agent 13 missing"),
    (lambda r: replace(r, object_id=np.array([10, 11, 12, 12])), "object_id", "agent 12 more than once"),
    (lambda r: replace(r, object_id=r.object_id[None]), "object_id", "has shape"),
    (lambda r: replace(r, y=r.y[..., :79]), "y", "has shape"),
    (lambda r: replace(r, x=r.x[0, 0, 0]), "x", "no rollouts"), (lambda r: replace(r, x=r.x[:0]), "x", "no rollouts"),
    (lambda r: replace(r, x=np.where(np.arange(80) == 5, np.nan, r.x)), "x", "agent 10, rollout 0, step 16: not fin"),
    (lambda r: replace(r, heading=r.heading.astype(float) + 1e39), "heading", "agent 10, .*: not finite"),
])  # fmt: skip
def test_rollouts_that_cannot_be_scored(change, field, text):
    scenario = made_scenario()
    with pytest.raises(DataError, match=text) as caught:
        compute_features(scenario, change(made_rollouts(scenario)))
    assert (caught.value.segment, caught.value.field) == ("made", field)
    gone = replace(scenario, valid=scenario.valid & (np.arange(4) < 3)[:, None])
    with pytest.raises(DataError, match="agent 13 in the rollouts, but not valid at step 10"):
        compute_features(gone, made_rollouts(scenario))


def made_features(**changes):
    scenario = made_scenario(**changes)
    return compute_features(scenario, made_rollouts(scenario, 4))


def test_estimators_by_hand():
    values = torch.tensor([-1.0, 0, 1.999, 2, 9.99, 10, 50, math.nan, math.inf, -math.inf])
    assert bin_of(values, (0.0, 10.0, 5)).tolist() == [0, 0, 0, 1, 4, 4, 4, 4, 4, 0]
    # Two rollouts of two steps: three of the four values lie in the first bin, one that is no number in the last.
    simulated = torch.tensor([[[0.5, 0.1]], [[math.nan, 0.9]]])
    found = histogram_log_likelihood(torch.tensor([[0.2, 1.5]]), simulated, (0.0, 4.0, 4))
    torch.testing.assert_close(found, torch.tensor([[3.1 / 4.4, 0.1 / 4.4]]).log())
    flags = torch.tensor([[True, False], [True, False], [False, False]])
    found = flag_log_likelihood(torch.tensor([True, True]), flags).exp()
    torch.testing.assert_close(found, torch.tensor([2.001 / 3.002, 0.001 / 3.002]))


@given(st.integers(0, 2**32 - 1))
def test_likelihoods_of_all_bins_sum_to_one(seed):
    simulated = 3 * torch.randn(5, 2, 4, generator=torch.Generator().manual_seed(seed))
    centers = torch.tensor([-1.5, -0.5, 0.5, 1.5])
    each = [histogram_log_likelihood(c.expand(2, 4), simulated, (-2.0, 2.0, 4)).exp() for c in centers]
    torch.testing.assert_close(sum(each), torch.ones(2, 4))


@pytest.mark.parametrize("year", CHALLENGES)
def test_the_metametric_is_the_weighted_sum(year):
    config = CHALLENGES[year]
    scores = score_features(made_features(), config)
    weights = {name: part.weight for name, part in config.items()}
    assert sum(weights.values()) == pytest.approx(1)
    likelihoods = {name: scores[f"{name}_likelihood"] for name in config}
    assert all(0 < value <= 1 for value in likelihoods.values())
    assert scores["metametric"] == pytest.approx(sum(weights[n] * v for n, v in likelihoods.items()))
    shares = {bucket: sum(weights[name] for name in names) for bucket, names in BUCKETS.items()}
    assert scores["metametric"] == pytest.approx(sum(shares[b] * scores[f"{b}_metrics"] for b in shares))


def test_steps_at_which_the_log_is_not_valid_do_not_count():
    features, gone = made_features(), torch.arange(80) // 20 == 2
    masked = replace(features, log_valid=features.log_valid & ~gone)
    log, simulated = dict(features.log), dict(features.simulated)
    log["distance_to_road_edge"] = log["distance_to_road_edge"].masked_fill(gone, 1e9)
    simulated["offroad_per_step"] = simulated["offroad_per_step"] | gone
    changed = replace(masked, log=log, simulated=simulated)
    assert score_features(changed) == score_features(masked) != score_features(features)
    assert score_features(replace(changed, log_valid=features.log_valid))["simulated_offroad_rate"] == 1


def test_only_vehicles_have_a_time_to_collision_and_run_red_lights():
    walking = replace(made_features(), object_type=torch.tensor([2, 1]))
    scores = score_features(walking)
    # The first object runs the light in log and rollouts; as a pedestrian it is taken not to, and the rate stays.
    assert scores["simulated_traffic_light_violation_rate"] == 0.5
    assert scores["traffic_light_violation_likelihood"] == pytest.approx(4.001 / 4.002, abs=1e-6)
    assert math.isnan(object_scores(walking)[0]["time_to_collision_likelihood"])
    with pytest.raises(DataError, match="no step"):
        score_features(replace(walking, object_type=torch.tensor([2, 3])))


def test_what_each_object_adds():
    """Displacements, which count the history too."""
    scenario = made_scenario()
    log = made_rollouts(scenario, 2, noise=0.0)
    y = log.y + np.array([[[1.0], [1.0], [0.0], [0.0]], [[4.0], [0.0], [0.0], [0.0]]], np.float32)
    features = compute_features(scenario, replace(log, y=y))
    parts = object_scores(features)
    assert [part["object_id"] for part in parts] == [10, 11]
    for name, values in (("average_displacement_error", (2.5, 0.5)), ("min_ade", (1.0, 0.0))):
        expected = [value * 80 / 91 for value in values]
        assert [part[name] for part in parts] == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert score_features(features)["min_ade"] == pytest.approx(80 / 91, rel=1e-5)
