"""The WOSAC score against recorded results of the official scorer, where they are present."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from symphony.wosac.files import read_rollouts
from symphony.wosac.records import logged_scenario, parse_scenario, read_scenarios
from symphony.wosac.scorer import (
    CHALLENGES,
    Component,
    WosacConfig,
    WosacFeatures,
    WosacScenario,
    compute_features,
    score_features,
)
from symphony.wosac.scorer.boxes import Boxes, corners, distance_to_nearest, rectangle_gap, time_to_collision
from symphony.wosac.scorer.features import angular, central_difference, speed, wrap
from symphony.wosac.scorer.lights import Lanes, Signals, red_light_violations
from symphony.wosac.scorer.road import Edges, distance_to_road_edge, signed_distance_to_edges
from symphony.wosac.scorer.scoring import (
    bin_edges,
    flag_log_likelihood,
    histogram_log_likelihood,
    log_likelihoods,
    speed_mask,
)

pytestmark = pytest.mark.samples

CASES = (
    "a_official_submission",
    "b2_log_playback_hold",
    "b_log_playback_raw",
    "c_constant_velocity",
    "d_log_noise_xy",
    "e_random_arcs",
    "f_log_timewarp",
    "g_redlight_lane_follow",
)
NAME = "637f20cafde22ff8"
CONFIGS = {"2024": "challenge_2024", "2025": "challenge_2025_sim_agents"}

Arrays = dict[str, NDArray[Any]]


@pytest.fixture(scope="module")
def folder(samples: Path) -> Path:
    found = samples.parent / "wosac"
    if not (found / "manifest.json").is_file():
        pytest.skip(f"no results of the official scorer at {found}")
    return found


@pytest.fixture(scope="module")
def manifest(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text())


@pytest.fixture(scope="module")
def scenario(samples: Path) -> WosacScenario:
    file = samples / "womd" / "motion_data_one_scenario.tfrecord"
    ((_, record, payload),) = read_scenarios(file)
    return logged_scenario(parse_scenario(payload, file, record))


@pytest.fixture(scope="module", params=CASES)
def case(
    request: pytest.FixtureRequest, folder: Path, scenario: WosacScenario
) -> tuple[str, Arrays, WosacFeatures]:
    file = folder / f"case_{NAME}_{request.param}.npz"
    return f"{NAME}_{request.param}", unit(file), compute_features(scenario, read_rollouts(file))


def close(found: torch.Tensor, expected: NDArray[Any], **tolerance: Any) -> None:
    np.testing.assert_allclose(found.numpy(), expected, **{"rtol": 1e-6, **tolerance})


def equal(found: torch.Tensor, expected: NDArray[Any]) -> None:
    np.testing.assert_array_equal(found.numpy(), expected)


def unit(file: Path) -> Arrays:
    with np.load(file, allow_pickle=False) as archive:
        return dict(archive)


def config(entry: dict[str, Any]) -> WosacConfig:
    """Components of a configuration of the official scorer, which all have our pseudocounts."""
    bins = {
        name: tuple(part["histogram"][key] for key in ("min_val", "max_val", "num_bins"))
        for name, part in entry.items()
        if part["estimator"] == "histogram"
    }
    return {name: Component(part["metametric_weight"], bins.get(name)) for name, part in entry.items()}


def test_features(case: tuple[str, Arrays, WosacFeatures]) -> None:
    _, expected, features = case
    assert features.object_id.tolist() == expected["eval_object_id"].tolist()
    assert features.object_type.tolist() == expected["eval_object_type"].tolist()
    equal(features.log_valid, expected["log_valid"])
    for prefix, source in (("log", features.log), ("sim", features.simulated)):
        for name, found in source.items():
            close(found, expected[f"{prefix}_{name}"], rtol=1e-3, atol=1e-3, err_msg=f"{prefix}_{name}")


@pytest.mark.parametrize("year", CONFIGS)
def test_log_likelihoods(case: tuple[str, Arrays, WosacFeatures], year: str) -> None:
    _, expected, features = case
    for name, found in log_likelihoods(features, CHALLENGES[year]).items():
        close(found, expected[f"{CONFIGS[year]}/ll_{name}"], atol=1e-3, err_msg=name)


# The weights and bins of the test configuration differ from the challenges', so that more is seen.
@pytest.mark.parametrize("name", [*CONFIGS.values(), "test_config"])
def test_scores(case: tuple[str, Arrays, WosacFeatures], manifest: dict[str, Any], name: str) -> None:
    key, _, features = case
    expected = manifest["cases"][key]["expected_scores"][name]
    found = score_features(features, config(manifest["configs"][name]))
    limit = 1e-3 if name == "test_config" else 1e-6
    assert found["metametric"] == pytest.approx(expected["metametric"], abs=limit)
    assert found["min_ade"] == pytest.approx(expected["min_average_displacement_error"], rel=1e-5, abs=1e-5)
    names = set(expected) - {"metametric", "min_average_displacement_error", "buckets"}
    assert len(names) == 14
    for each in names:
        assert found[each] == pytest.approx(expected[each], abs=1e-4, rel=1e-5), each
    for bucket in ("kinematic_metrics", "interactive_metrics", "map_based_metrics"):
        assert found[bucket] == pytest.approx(expected["buckets"][bucket], abs=1e-3), bucket


def test_configurations_and_their_bins(manifest: dict[str, Any]) -> None:
    for year, name in CONFIGS.items():
        expected = config(manifest["configs"][name])
        for part, mine in CHALLENGES[year].items():
            assert mine.weight == pytest.approx(expected[part].weight, rel=1e-6)
            assert (mine.bins or ()) == pytest.approx(expected[part].bins or (), rel=1e-6)
    parts = [part for entry in manifest["configs"].values() for part in entry.values()]
    histograms = [part["histogram"] for part in parts if part.get("histogram")]
    assert len(histograms) == 35
    for h in histograms:
        edges = bin_edges((h["min_val"], h["max_val"], h["num_bins"]))
        equal(edges, np.array(h["edges_float32"], np.float32))


def test_kinematics(folder: Path) -> None:
    expected = unit(folder / "unit_kinematics.npz")
    given = {name: torch.from_numpy(array) for name, array in expected.items()}
    linear, (turning, turning_change) = speed(given["x"], given["y"], given["z"]), angular(given["heading"])
    found = {
        "linear_speed": linear,
        "linear_acceleration": central_difference(linear) / 0.1,
        "angular_speed": turning,
        "angular_acceleration": turning_change,
        "wrap_out": wrap(given["wrap_in"]),
        "speed_valid": speed_mask(given["valid"]),
        "accel_valid": speed_mask(speed_mask(given["valid"])),
    }
    for name, values in found.items():
        close(values, expected[name], rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(("boxes", "rounding", "expected"), [
    ("boxes", 0.0, "dist_rf00"), ("boxes", 0.7, "dist_rf07"), ("boxes_offset", 0.7, "dist_offset_rf07"),
])  # fmt: skip
def test_box_pairs(folder: Path, boxes: str, rounding: float, expected: str) -> None:
    arrays = unit(folder / "unit_box_pair_distance.npz")
    a, b = torch.from_numpy(arrays[boxes])
    radius = [rounding * box[:, 3:5].amin(-1) / 2 for box in (a, b)]
    cores = [
        corners(box[:, :2], box[:, 6], box[:, 3:5] - 2 * r[:, None])
        for box, r in zip((a, b), radius, strict=True)
    ]
    found = rectangle_gap(*cores) - radius[0] - radius[1]
    close(found, arrays[expected], atol=2e-5, rtol=0)


def scored_first(arrays: Arrays, names: tuple[str, ...]) -> tuple[dict[str, torch.Tensor], int]:
    """Arrays [1, n, ...] with the scored objects first, and how many they are."""
    mask = arrays["evaluated_mask"]
    order = np.argsort(~mask, kind="stable")
    return {name: torch.from_numpy(arrays[name][order][None]) for name in names}, int(mask.sum())


def test_boxes_of_a_scene(folder: Path) -> None:
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


def test_road_edges(folder: Path, scenario: WosacScenario) -> None:
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


def number(lanes: Lanes, segment: torch.Tensor) -> torch.Tensor:
    """The number of segments in their lanes."""
    first = torch.tensor([int((lanes.lane == lane).nonzero()[0]) for lane in lanes.lane[segment]])
    return segment - first


def test_nearest_lane_of_a_real_map(folder: Path, scenario: WosacScenario) -> None:
    arrays = unit(folder / f"unit_nearest_lane_real_{NAME}.npz")
    street = np.flatnonzero(scenario.lane_type == 2)
    lanes = Lanes.of([scenario.lanes[k] for k in street], scenario.lane_id[street])
    found = lanes.nearest(torch.from_numpy(arrays["query_xy"]))
    equal(lanes.lane[found], arrays["lane_id"])
    equal(number(lanes, found), arrays["segment_index"])


def test_red_lights(folder: Path) -> None:
    arrays = unit(folder / "unit_red_light.npz")
    lines = np.split(arrays["lane_points"], np.cumsum(arrays["lane_n"])[:-1])
    lanes = Lanes.of(lines, arrays["lane_id"])
    position = torch.from_numpy(np.stack((arrays["x"], arrays["y"]), -1))
    nearest = lanes.nearest(position.reshape(-1, 2))
    equal(lanes.lane[nearest].view(40, 91), arrays["nearest_lane_id"])
    equal(number(lanes, nearest).view(40, 91), arrays["nearest_segment"])
    seen = [arrays[f"tl_{name}"] for name in ("step", "lane", "state", "stop_xy")]
    mask = arrays["evaluated_mask"]
    signals = Signals.of(*seen, steps=91)
    found = red_light_violations(position[mask], torch.from_numpy(arrays["valid"])[mask], lanes, signals)
    assert arrays["violation"].any()
    equal(found, arrays["violation"])


def test_estimators(folder: Path) -> None:
    arrays = unit(folder / "unit_estimators.npz")
    assert np.isnan(arrays["sim_values"]).any()
    for name, scale, component in (
        ("ll_ind", 1, "linear_acceleration"),
        ("ll_angspeed", arrays["scale_for_angspeed"], "angular_speed"),
    ):
        log, simulated = (torch.from_numpy(arrays[n] * scale) for n in ("log_values", "sim_values"))
        bins = CHALLENGES["2025"][component].bins
        assert bins is not None
        close(histogram_log_likelihood(log, simulated, bins), arrays[name], atol=1e-5)
    log, simulated = torch.from_numpy(arrays["log_bool"]), torch.from_numpy(arrays["sim_bool"])
    close(flag_log_likelihood(log, simulated), arrays["ll_bernoulli_default"], atol=1e-5)
