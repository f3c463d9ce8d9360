"""The WOSAC score against recorded results of the official scorer, where they are present."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from symphony.wosac.files import read_rollouts
from symphony.wosac.records import logged_scenario, parse_scenario, read_scenarios
from symphony.wosac.scorer import CHALLENGES, Component, compute_features, score_features, scoring
from symphony.wosac.scorer.boxes import Boxes, distance_to_nearest, time_to_collision
from symphony.wosac.scorer.features import speed
from symphony.wosac.scorer.lights import Lanes, Signals, red_light_violations
from symphony.wosac.scorer.road import Edges, distance_to_road_edge, signed_distance_to_edges
from symphony.wosac.scorer.scoring import flag_log_likelihood, histogram_log_likelihood, log_likelihoods

pytestmark = pytest.mark.samples

CASES = (
    "a_official_submission", "b2_log_playback_hold", "b_log_playback_raw", "c_constant_velocity", "d_log_noise_xy",
    "e_random_arcs", "f_log_timewarp", "g_redlight_lane_follow",
)  # fmt: skip
NAME = "637f20cafde22ff8"
CONFIGS = {"2024": "challenge_2024", "2025": "challenge_2025_sim_agents"}


@pytest.fixture(scope="module")
def folder(samples):
    found = samples.parent / "wosac"
    if not (found / "manifest.json").is_file():
        pytest.skip(f"no results of the official scorer at {found}")
    return found


@pytest.fixture(scope="module")
def manifest(folder):
    return json.loads((folder / "manifest.json").read_text())


@pytest.fixture(scope="module")
def scenario(samples):
    file = samples / "womd" / "motion_data_one_scenario.tfrecord"
    ((_, record, payload),) = read_scenarios(file)
    return logged_scenario(parse_scenario(payload, file, record))


@pytest.fixture(scope="module", params=CASES)
def case(request, folder, scenario):
    file = folder / f"case_{NAME}_{request.param}.npz"
    return f"{NAME}_{request.param}", unit(file), compute_features(scenario, read_rollouts(file))


def close(found, expected, **tolerance):
    np.testing.assert_allclose(found.numpy(), expected, **{"rtol": 1e-6, **tolerance})


def equal(found, expected):
    np.testing.assert_array_equal(found.numpy(), expected)


def unit(file):
    with np.load(file, allow_pickle=False) as archive:
        return dict(archive)


def config(entry):
    """Components of a configuration of the official scorer, which all have our pseudocounts."""
    return {name: Component(part["metametric_weight"], bins_of(part)) for name, part in entry.items()}


def bins_of(part):
    given = part.get("histogram") if part["estimator"] == "histogram" else None
    return given and (given["min_val"], given["max_val"], given["num_bins"])


def test_features_and_log_likelihoods(case):
    _, expected, features = case
    assert features.object_id.tolist() == expected["eval_object_id"].tolist()
    assert features.object_type.tolist() == expected["eval_object_type"].tolist()
    equal(features.log_valid, expected["log_valid"])
    found = {f"log_{name}": values for name, values in features.log.items()}
    found |= {f"sim_{name}": values for name, values in features.simulated.items()}
    for year, name in CONFIGS.items():
        parts = log_likelihoods(features, CHALLENGES[year])
        found |= {f"{name}/ll_{part}": values for part, values in parts.items()}
    for name, values in found.items():
        close(values, expected[name], rtol=1e-6 if "/ll_" in name else 1e-3, atol=1e-3, err_msg=name)


# The weights and bins of the test configuration differ from the challenges', so that more is seen.
@pytest.mark.parametrize("name", [*CONFIGS.values(), "test_config"])
def test_scores(case, manifest, name):
    key, _, features = case
    expected = manifest["cases"][key]["expected_scores"][name]
    found = score_features(features, config(manifest["configs"][name]))
    limit = 1e-3 if name == "test_config" else 1e-6
    assert found["metametric"] == pytest.approx(expected["metametric"], abs=limit)
    assert found["min_ade"] == pytest.approx(expected["min_average_displacement_error"], rel=1e-5, abs=1e-5)
    names = set(expected) - {"metametric", "min_average_displacement_error", "buckets"}
    assert len(names) == 14
    assert {n: found[n] for n in names} == pytest.approx({n: expected[n] for n in names}, abs=1e-4, rel=1e-5)
    for bucket in ("kinematic_metrics", "interactive_metrics", "map_based_metrics"):
        assert found[bucket] == pytest.approx(expected["buckets"][bucket], abs=1e-3), bucket


def test_configurations_and_their_bins(manifest):
    for year, name in CONFIGS.items():
        expected = config(manifest["configs"][name])
        for part, mine in CHALLENGES[year].items():
            assert mine.weight == pytest.approx(expected[part].weight, rel=1e-6)
            assert (mine.bins or ()) == pytest.approx(expected[part].bins or (), rel=1e-6)
    parts = [part for entry in manifest["configs"].values() for part in entry.values() if bins_of(part)]
    for part in parts:
        equal(scoring.bin_edges(bins_of(part)), np.array(part["histogram"]["edges_float32"], np.float32))


def scored_first(arrays, names):
    """Arrays [1, n, ...] with the scored objects first, and how many they are."""
    mask = arrays["evaluated_mask"]
    order = np.argsort(~mask, kind="stable")
    return {name: torch.from_numpy(arrays[name][order][None]) for name in names}, int(mask.sum())


def test_boxes_of_a_scene(folder):
    arrays = unit(folder / "unit_box_scene_distance.npz")
    given, count = scored_first(arrays, ("boxes", "valid"))
    each = given["boxes"]
    boxes = Boxes(each[..., :2], each[..., 6], each[..., 3:5], given["valid"], each[..., 0])
    close(distance_to_nearest(boxes, count)[0], arrays["dist"], atol=1e-5, rtol=1e-6)
    arrays = unit(folder / "unit_time_to_collision.npz")
    given, count = scored_first(arrays, ("x", "y", "length", "width", "heading", "valid"))
    place, size = (torch.stack([given[a], given[b]], -1) for a, b in (("x", "y"), ("length", "width")))
    boxes = Boxes(place, given["heading"], size, given["valid"], speed(given["x"], given["y"]))
    close(time_to_collision(boxes, count)[0], arrays["ttc"], atol=1e-5)


def test_road_edges(folder, scenario):
    arrays = unit(folder / "unit_road_edge.npz")
    edges = Edges.of(np.split(arrays["poly_points"], np.cumsum(arrays["poly_n"])[:-1]))
    for stretch in (1, 3):
        found = signed_distance_to_edges(torch.from_numpy(arrays["query_xyz"]), edges, stretch)
        close(found, arrays[f"signed_distance_zstretch{stretch}"], atol=1e-5)
    boxes, valid = (torch.from_numpy(arrays[name][arrays["evaluated_mask"]]) for name in ("boxes", "valid"))
    found = distance_to_road_edge(boxes[..., :3], boxes[..., 6], boxes[..., 3:6], valid, edges)
    close(found, arrays["box_distance"], atol=1e-5)
    arrays = unit(folder / f"unit_road_edge_real_{NAME}.npz")
    found = signed_distance_to_edges(torch.from_numpy(arrays["query_xyz"]), Edges.of(scenario.road_edges))
    close(found, arrays["signed_distance"], atol=1e-5)


def test_nearest_lanes_and_red_lights(folder, scenario):
    arrays = unit(folder / f"unit_nearest_lane_real_{NAME}.npz")
    street = np.flatnonzero(scenario.lane_type == 2)
    lanes = Lanes.of([scenario.lanes[k] for k in street], scenario.lane_id[street])
    equal(lanes.lane[lanes.nearest(torch.from_numpy(arrays["query_xy"]))], arrays["lane_id"])
    arrays = unit(folder / "unit_red_light.npz")
    lanes = Lanes.of(np.split(arrays["lane_points"], np.cumsum(arrays["lane_n"])[:-1]), arrays["lane_id"])
    position = torch.from_numpy(np.stack((arrays["x"], arrays["y"]), -1))
    equal(lanes.lane[lanes.nearest(position.reshape(-1, 2))].view(40, 91), arrays["nearest_lane_id"])
    signals = Signals.of(*(arrays[f"tl_{name}"] for name in ("step", "lane", "state", "stop_xy")), steps=91)
    mask, valid = arrays["evaluated_mask"], torch.from_numpy(arrays["valid"])
    assert arrays["violation"].any()
    equal(red_light_violations(position[mask], valid[mask], lanes, signals), arrays["violation"])


def test_estimators(folder):
    arrays = unit(folder / "unit_estimators.npz")
    assert np.isnan(arrays["sim_values"]).any()
    scale = arrays["scale_for_angspeed"]
    for name, by, part in (("ll_ind", 1, "linear_acceleration"), ("ll_angspeed", scale, "angular_speed")):
        log, simulated = (torch.from_numpy(arrays[n] * by) for n in ("log_values", "sim_values"))
        found = histogram_log_likelihood(log, simulated, CHALLENGES["2025"][part].bins)
        close(found, arrays[name], atol=1e-5)
    log, simulated = torch.from_numpy(arrays["log_bool"]), torch.from_numpy(arrays["sim_bool"])
    close(flag_log_likelihood(log, simulated), arrays["ll_bernoulli_default"], atol=1e-5)
