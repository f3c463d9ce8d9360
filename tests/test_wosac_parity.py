"""The WOSAC score against recorded results of the official scorer, where they are present."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from symphony.wosac.records import parse_scenario, read_scenario_payloads, scenario_arrays
from symphony.wosac.rollouts import read_rollouts
from symphony.wosac.scorer import (
    CHALLENGES,
    Lines,
    SimulatedRollouts,
    WosacConfig,
    WosacFeatures,
    WosacScenario,
    compute_features,
    kinematics,
    score_features,
)
from symphony.wosac.scorer.boxes import corners, rectangle_gap
from symphony.wosac.scorer.config import Bernoulli, FlagComponent, Histogram, NumberComponent
from symphony.wosac.scorer.estimators import (
    bernoulli_log_likelihood,
    bin_edges,
    histogram_log_likelihood,
    kernel_log_likelihood,
)
from symphony.wosac.scorer.interaction import distance_to_nearest, time_to_collision
from symphony.wosac.scorer.lights import Lanes, Signals, red_light_violations
from symphony.wosac.scorer.road import Edges, distance_to_road_edge, signed_distance_to_edges
from symphony.wosac.scorer.scoring import log_likelihoods

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
    ((_, record, payload),) = read_scenario_payloads([file])
    return WosacScenario.of(**scenario_arrays(parse_scenario(payload, file, record)))


@pytest.fixture(scope="module", params=CASES)
def case(
    request: pytest.FixtureRequest, folder: Path, scenario: WosacScenario
) -> tuple[str, Arrays, WosacFeatures]:
    file = folder / f"case_{NAME}_{request.param}.npz"
    rollouts = SimulatedRollouts.of(**vars(read_rollouts(file)))
    return f"{NAME}_{request.param}", unit(file), compute_features(scenario, rollouts)


def close(found: torch.Tensor, expected: NDArray[Any], **tolerance: Any) -> None:
    np.testing.assert_allclose(found.numpy(), expected, **{"rtol": 1e-6, **tolerance})


def equal(found: torch.Tensor, expected: NDArray[Any]) -> None:
    np.testing.assert_array_equal(found.numpy(), expected)


def unit(file: Path) -> Arrays:
    with np.load(file, allow_pickle=False) as archive:
        return dict(archive)


def tensors(arrays: Arrays) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def lines(points: NDArray[Any], counts: NDArray[Any]) -> Lines:
    return Lines(torch.from_numpy(points), torch.from_numpy(counts).long())


def config(entry: dict[str, Any]) -> WosacConfig:
    parts: dict[str, Any] = {}
    for name, part in entry.items():
        if part["estimator"] == "histogram":
            h = part["histogram"]
            shape = (h["min_val"], h["max_val"], h["num_bins"], h["additive_smoothing_pseudocount"])
            estimator = Histogram(*shape, part["independent_timesteps"], part["aggregate_objects"])
            parts[name] = NumberComponent(part["metametric_weight"], estimator)
        else:
            pseudocount = part["bernoulli"]["additive_smoothing_pseudocount"]
            parts[name] = FlagComponent(part["metametric_weight"], Bernoulli(pseudocount))
    return WosacConfig(name="made", **parts)


def test_features(case: tuple[str, Arrays, WosacFeatures]) -> None:
    _, expected, features = case
    assert features.object_id.tolist() == expected["eval_object_id"].tolist()
    assert features.object_type.tolist() == expected["eval_object_type"].tolist()
    equal(features.log_valid, expected["log_valid"])
    for prefix, source in (("log", features.log), ("sim", features.simulated)):
        for name in source.__dataclass_fields__:
            found, wanted = getattr(source, name), expected[f"{prefix}_{name}"]
            close(found, wanted, rtol=1e-3, atol=1e-3, err_msg=f"{prefix}_{name}")


@pytest.mark.parametrize("year", CONFIGS)
def test_log_likelihoods(case: tuple[str, Arrays, WosacFeatures], year: str) -> None:
    _, expected, features = case
    for name, found in log_likelihoods(features, CHALLENGES[year]).items():
        close(found, expected[f"{CONFIGS[year]}/ll_{name}"], atol=1e-3, err_msg=name)


@pytest.mark.parametrize("year", CONFIGS)
def test_scores(case: tuple[str, Arrays, WosacFeatures], manifest: dict[str, Any], year: str) -> None:
    key, _, features = case
    check_scores(features, CHALLENGES[year], manifest["cases"][key]["expected_scores"][CONFIGS[year]])


# The test configurations' sums and bins differ from the challenges', so that more of the estimators is seen.
@pytest.mark.parametrize("name", ["test_config", "test_config_dependent_timesteps"])
def test_scores_of_other_configurations(
    case: tuple[str, Arrays, WosacFeatures], manifest: dict[str, Any], name: str
) -> None:
    key, _, features = case
    check_scores(
        features, config(manifest["configs"][name]), manifest["cases"][key]["expected_scores"][name], 1e-3
    )


def check_scores(
    features: WosacFeatures, chosen: WosacConfig, expected: dict[str, Any], meta: float = 1e-5
) -> None:
    found = score_features(features, chosen).to_dict()
    assert found["metametric"] == pytest.approx(expected["metametric"], abs=meta)
    assert found["min_ade"] == pytest.approx(expected["min_average_displacement_error"], rel=1e-5, abs=1e-5)
    names = set(expected) - {"metametric", "min_average_displacement_error", "buckets"}
    assert len(names) == 14
    for name in names:
        assert found[name] == pytest.approx(expected[name], abs=1e-4, rel=1e-5), name
    for bucket in ("kinematic_metrics", "interactive_metrics", "map_based_metrics"):
        assert found[bucket] == pytest.approx(expected["buckets"][bucket], abs=1e-3), bucket


@pytest.mark.parametrize("year", CONFIGS)
def test_configuration(manifest: dict[str, Any], year: str) -> None:
    expected = config(manifest["configs"][CONFIGS[year]])
    for name, part in CHALLENGES[year].components.items():
        assert part.weight == pytest.approx(expected.components[name].weight, rel=1e-6)
        assert vars(part.estimator) == pytest.approx(vars(expected.components[name].estimator), rel=1e-6)


def test_bin_edges(manifest: dict[str, Any]) -> None:
    checked = 0
    for entry in manifest["configs"].values():
        for part in entry.values():
            if h := part.get("histogram"):
                edges = bin_edges(Histogram(h["min_val"], h["max_val"], h["num_bins"]))
                equal(edges, np.array(h["edges_float32"], np.float32))
                checked += 1
    assert checked == 35


def test_kinematics(folder: Path) -> None:
    expected = unit(folder / "unit_kinematics.npz")
    given = tensors(expected)
    speed = kinematics.speed(given["x"], given["y"], given["z"])
    turning, turning_change = kinematics.angular(given["heading"])
    found = {
        "linear_speed": speed,
        "linear_acceleration": kinematics.acceleration(speed),
        "angular_speed": turning,
        "angular_acceleration": turning_change,
        "wrap_out": kinematics.wrap(given["wrap_in"]),
        "speed_valid": kinematics.speed_mask(given["valid"]),
        "accel_valid": kinematics.speed_mask(kinematics.speed_mask(given["valid"])),
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


def test_box_scene(folder: Path) -> None:
    arrays = unit(folder / "unit_box_scene_distance.npz")
    given, count = scored_first(arrays, ("boxes", "valid"))
    boxes = given["boxes"]
    found = distance_to_nearest(boxes[..., :2], boxes[..., 6], boxes[..., 3:5], given["valid"], count)[0]
    close(found, arrays["dist"], atol=1e-5, rtol=1e-6)


def test_time_to_collision(folder: Path) -> None:
    arrays = unit(folder / "unit_time_to_collision.npz")
    given, count = scored_first(arrays, ("x", "y", "length", "width", "heading", "valid"))
    position = torch.stack((given["x"], given["y"]), -1)
    size = torch.stack((given["length"], given["width"]), -1)
    speed = kinematics.speed(given["x"], given["y"])
    found = time_to_collision(position, given["heading"], size, given["valid"], speed, count)[0]
    close(found, arrays["ttc"], atol=1e-5)


@pytest.mark.parametrize("stretch", [1, 3])
def test_road_edges(folder: Path, stretch: int) -> None:
    arrays = unit(folder / "unit_road_edge.npz")
    edges = Edges.of(lines(arrays["poly_points"], arrays["poly_n"]))
    found = signed_distance_to_edges(torch.from_numpy(arrays["query_xyz"]), edges, stretch)
    close(found, arrays[f"signed_distance_zstretch{stretch}"], atol=1e-5)


def test_road_edge_of_boxes(folder: Path) -> None:
    arrays = unit(folder / "unit_road_edge.npz")
    edges = Edges.of(lines(arrays["poly_points"], arrays["poly_n"]))
    boxes, valid = (torch.from_numpy(arrays[name][arrays["evaluated_mask"]]) for name in ("boxes", "valid"))
    found = distance_to_road_edge(boxes[..., :3], boxes[..., 6], boxes[..., 3:6], valid, edges)
    close(found, arrays["box_distance"], atol=1e-5)


def test_road_edges_of_a_real_map(folder: Path, scenario: WosacScenario) -> None:
    arrays = unit(folder / f"unit_road_edge_real_{NAME}.npz")
    found = signed_distance_to_edges(torch.from_numpy(arrays["query_xyz"]), Edges.of(scenario.road_edges))
    close(found, arrays["signed_distance"], atol=1e-5)


def test_nearest_lane_of_a_real_map(folder: Path, scenario: WosacScenario) -> None:
    arrays = unit(folder / f"unit_nearest_lane_real_{NAME}.npz")
    street = scenario.lane_type == 2
    lanes = Lanes.of(scenario.lanes.keep(street), scenario.lane_id[street])
    found = lanes.nearest(torch.from_numpy(arrays["query_xy"]))
    equal(lanes.lane[found], arrays["lane_id"])
    equal(lanes.number[found], arrays["segment_index"])


def test_red_lights(folder: Path) -> None:
    arrays = unit(folder / "unit_red_light.npz")
    lanes = Lanes.of(lines(arrays["lane_points"], arrays["lane_n"]), torch.from_numpy(arrays["lane_id"]))
    position = torch.from_numpy(np.stack((arrays["x"], arrays["y"]), -1))
    nearest = lanes.nearest(position.reshape(-1, 2))
    equal(lanes.lane[nearest].view(40, 91), arrays["nearest_lane_id"])
    equal(lanes.number[nearest].view(40, 91), arrays["nearest_segment"])
    seen = [torch.from_numpy(arrays[f"tl_{name}"]) for name in ("step", "lane", "state", "stop_xy")]
    mask = arrays["evaluated_mask"]
    signals = Signals.of(*seen, steps=91)
    found = red_light_violations(position[mask], torch.from_numpy(arrays["valid"])[mask], lanes, signals)
    assert arrays["violation"].any()
    equal(found, arrays["violation"])


@pytest.mark.parametrize(("name", "independent", "aggregate"), [
    ("ll_ind", True, False), ("ll_dep", False, False), ("ll_ind_agg", True, True), ("ll_dep_agg", False, True),
])  # fmt: skip
def test_histograms(folder: Path, name: str, independent: bool, aggregate: bool) -> None:
    arrays = unit(folder / "unit_estimators.npz")
    assert np.isnan(arrays["sim_values"]).any()
    log, simulated = torch.from_numpy(arrays["log_values"]), torch.from_numpy(arrays["sim_values"])
    estimator = Histogram(-12.0, 12.0, 11, 0.1, independent, aggregate)
    close(histogram_log_likelihood(log, simulated, estimator), arrays[name], atol=1e-5)


def test_histogram_of_angular_speeds(folder: Path) -> None:
    arrays = unit(folder / "unit_estimators.npz")
    log, simulated = (
        torch.from_numpy(arrays[n] * arrays["scale_for_angspeed"]) for n in ("log_values", "sim_values")
    )
    estimator = CHALLENGES["2025"].angular_speed.estimator
    close(histogram_log_likelihood(log, simulated, estimator), arrays["ll_angspeed"], atol=1e-5)


@pytest.mark.parametrize(("name", "aggregate"), [("ll_bernoulli_default", False), ("ll_bernoulli_agg", True)])
def test_bernoulli(folder: Path, name: str, aggregate: bool) -> None:
    given = tensors(unit(folder / "unit_estimators.npz"))
    found = bernoulli_log_likelihood(
        given["log_bool"], given["sim_bool"], Bernoulli(aggregate_objects=aggregate)
    )
    close(found, given[name].numpy(), atol=1e-5)


@pytest.mark.parametrize(("name", "independent"), [("ll_kde_bw02", True), ("ll_kde_bw02_dep", False)])
def test_kernel_density(folder: Path, name: str, independent: bool) -> None:
    given = tensors(unit(folder / "unit_estimators.npz"))
    log, simulated = given["kde_log"].double(), given["kde_sim"].double()
    found = kernel_log_likelihood(log, simulated, 0.2, independent_timesteps=independent)
    close(found, given[name].numpy(), atol=1e-5)
