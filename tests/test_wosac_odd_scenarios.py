"""Scenarios with everything odd that records may hold, scored and compared with a plain computation."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from helpers_wosac_oracle import BINS, FLAGS, oracle_features, oracle_scores
from symphony.data.sources import womd_pb2 as pb
from symphony.wosac.records import logged_scenario, parse_scenario
from symphony.wosac.scorer import (
    CHALLENGES,
    SimulatedRollouts,
    compute_features,
    object_scores,
    score_features,
)

ROLLOUTS = 2
ODD = (
    "plain",
    "closed edges",
    "turned headings",
    "no lights",
    "late and lost",
    "one step only",
    "lights that come and go",
    "steep roads",
    "doubled points",
    "others than vehicles",
    "closed edges, turned headings, no lights, late and lost",
)


def add_line(target: Any, points: NDArray[np.floating[Any]]) -> None:
    for x, y, z in points.tolist():
        target.add(x=x, y=y, z=z)


def ring(centre: NDArray[Any], radius: float, count: int, turn: int = 1) -> NDArray[np.floating[Any]]:
    """A closed line whose last point is the first one again, but for 0.2 m."""
    angle = np.linspace(0, turn * 2 * np.pi, count)
    points = np.stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle), 0 * angle], -1)
    points[-1, 0] += 0.2
    return points


def odd_record(kind: str, seed: int = 0) -> pb.Scenario:
    """Six objects near a crossing in the middle of a map with edges, lanes, signs, crosswalks and lights."""
    rng = np.random.default_rng(seed)
    record = pb.Scenario(scenario_id=f"odd{seed}", current_time_index=10, sdc_track_index=2)
    record.timestamps_seconds.extend(0.1 * k for k in range(91))
    middle = rng.uniform(-40, 40, 2)
    add_tracks(record, kind, middle, rng)
    for row in (0, 1, 3) if kind != "others than vehicles" else (0, 1, 2, 3):
        record.tracks_to_predict.add(track_index=row)
    for k, line in enumerate(odd_edges(kind, middle, rng)):
        add_line(record.map_features.add(id=k).road_edge.polyline, line)
    add_lanes(record, middle, rng)
    if "no lights" not in kind:
        add_lights(record, kind, middle, rng)
    return record


def add_tracks(record: pb.Scenario, kind: str, middle: NDArray[Any], rng: np.random.Generator) -> None:
    time = 0.1 * np.arange(91)
    for k in range(6):
        heading = rng.uniform(-3, 3) + rng.uniform(-0.2, 0.2) * time
        speed = np.clip(rng.uniform(2, 9) + rng.uniform(-1, 1) * time, 0, None)
        path = np.cumsum(0.1 * speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1), 0)
        # All come near the middle of the map in the middle of the log.
        path += middle + rng.normal(0, 12, 2) - path[45]
        z = rng.uniform(-0.2, 0.2) + 0.05 * time
        if "turned headings" in kind:
            heading = heading + 2 * np.pi * rng.integers(-2, 3) + 2 * np.pi * (time > 4) * rng.integers(0, 2)
        valid = odd_validity(kind, k, rng)
        types = (1, 2, 1, 3, 4, 1) if kind == "others than vehicles" else (1, 1, 1, 1, 2, 1)
        track = record.tracks.add(id=int((70, 9, 33, 12, 8, 51)[k]), object_type=types[k])
        shape = sorted(rng.uniform(0.8, 5, 2))
        for step in range(91):
            state = track.states.add(valid=bool(valid[step]), center_z=z[step] - 0.03)
            # Some of what is not valid has values all the same.
            if valid[step] or ("late and lost" in kind and step % 3 == 0):
                state.center_x, state.center_y = path[step]
                state.heading, state.height = heading[step], 1.5
                state.width, state.length = shape


def odd_validity(kind: str, k: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """[91] of object k; the recording vehicle, 2, is always there."""
    valid = np.ones(91, bool)
    if "late and lost" in kind and k != 2:
        valid[: rng.integers(0, 11)] = False
        valid[rng.integers(12, 91) :] = False
        valid[rng.integers(11, 91, 5)] = False
        valid[10] = k != 5
    if kind == "one step only" and k != 2:
        valid[:] = np.arange(91) == 10
    return valid


def odd_edges(kind: str, middle: NDArray[Any], rng: np.random.Generator) -> list[NDArray[Any]]:
    edges = [
        np.stack([middle[0] + np.linspace(-60, 60, 9), middle[1] - 8 + rng.normal(0, 2, 9), np.zeros(9)], -1),
        np.stack([middle[0] + np.linspace(60, -60, 7), middle[1] + 9 + rng.normal(0, 2, 7), np.zeros(7)], -1),
    ]
    if "closed edges" in kind:
        # Only rings with the most points go on from their end to their start.
        edges += [ring(middle, 6, 14, -1), ring(middle + 20, 5, 11), ring(middle - 15, 4, 14)]
    if kind == "steep roads":
        edges += [edges[0] + [0, 3, 4], edges[1] + [0, -2, -5]]
    if kind == "doubled points":
        edges = [
            np.repeat(edges[0], 2, 0),
            np.concatenate([edges[1], edges[1][-1:]]),
            middle[None, [0, 1, 0]],
        ]
    return edges


def add_lanes(record: pb.Scenario, middle: NDArray[Any], rng: np.random.Generator) -> None:
    """Four lanes, the last a freeway's, one without points, and everything else a map may hold."""
    for k in range(4):
        feature = record.map_features.add(id=100 + k)
        feature.lane.type = 2 if k < 3 else 1
        angle = k * 1.5 + rng.uniform(-0.3, 0.3)
        along = np.linspace(-50, 50, 6 + 3 * (k == 1))
        line = np.stack([middle[0] + along * np.cos(angle), middle[1] + along * np.sin(angle), 0 * along], -1)
        add_line(feature.lane.polyline, line)
    record.map_features.add(id=110).lane.type = 2
    sign = record.map_features.add(id=200).stop_sign
    sign.lane.append(100)
    sign.position.x = middle[0]
    corners = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0]]) + np.append(middle, 0)
    for k, polygon in enumerate(("crosswalk", "driveway", "speed_bump")):
        add_line(getattr(record.map_features.add(id=201 + k), polygon).polygon, corners)


def add_lights(record: pb.Scenario, kind: str, middle: NDArray[Any], rng: np.random.Generator) -> None:
    for _ in range(91):
        now = record.dynamic_map_states.add()
        for lane in (100, 101, 103, 999):
            if kind == "lights that come and go" and rng.random() < 0.3:
                continue
            light = now.lane_states.add(lane=lane, state=int(rng.choice([4, 4, 1, 6, 7, 0])))
            light.stop_point.x, light.stop_point.y = middle + rng.normal(0, 3, 2) * (lane == 101)


def odd_rollouts(record: pb.Scenario, seed: int = 0) -> SimulatedRollouts:
    """The log, bent and sped up, of all who are valid at step 10, the last one first."""
    rng = np.random.default_rng(seed + 1)
    tracks = [track for track in record.tracks if track.states[10].valid][::-1]
    made = []
    for track in tracks:
        now, before = track.states[10], track.states[9]
        speed = (
            10 * math.hypot(now.center_x - before.center_x, now.center_y - before.center_y)
            if before.valid
            else 4
        )
        time = 0.1 * np.arange(1, 81)
        heading = now.heading + rng.normal(0, 0.1, (ROLLOUTS, 1)) * time + rng.normal(0, 0.01, (ROLLOUTS, 80))
        pace = np.clip(min(speed, 12) + rng.normal(0, 0.5, (ROLLOUTS, 1)) * time, 0, None)
        x = now.center_x + np.cumsum(0.1 * pace * np.cos(heading), -1)
        y = now.center_y + np.cumsum(0.1 * pace * np.sin(heading), -1)
        made.append((x, y, now.center_z + 0.05 * time + 0 * x, heading))
    x, y, z, heading = (np.stack(part, 1).astype(np.float32) for part in zip(*made, strict=True))
    return SimulatedRollouts(np.array([track.id for track in tracks]), x, y, z, heading)


@cache
def plain(
    kind: str,
) -> tuple[pb.Scenario, SimulatedRollouts, dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Record, rollouts, and features of the log and of the rollouts by the plain computation."""
    seed = ODD.index(kind)
    record = odd_record(kind, seed)
    rollouts = odd_rollouts(record, seed)
    log = oracle_features(record, None)
    each = [oracle_features(record, rollouts, k) for k in range(ROLLOUTS)]
    return record, rollouts, log, {name: np.stack([one[name] for one in each]) for name in log}


@pytest.mark.parametrize("kind", ODD)
def test_features_and_scores_are_those_of_a_plain_computation(kind: str) -> None:
    record, rollouts, log, simulated = plain(kind)
    scenario = logged_scenario(parse_scenario(record.SerializeToString(), Path("made"), 0))
    found = compute_features(scenario, rollouts)
    own: list[dict[str, NDArray[Any]]] = []
    for got, expected in ((found.log, log), (found.simulated, simulated)):
        arrays = {name: got[name].numpy() for name in (*BINS, *FLAGS.values())}
        arrays["ade"] = got["average_displacement_error"].numpy()
        own.append(arrays)
        for name, values in expected.items():
            # float32 against float64: of speeds from positions some tens of metres out, a few thousandths.
            close = np.isclose(arrays[name], values, rtol=2e-3, atol=2e-2, equal_nan=True)
            # Whatever is decided by a sign or a limit may go the other way within rounding.
            assert close.mean() > 0.995, (name, arrays[name][~close], values[~close])
    for year in CHALLENGES:
        scores = score_features(found, CHALLENGES[year])
        for name, value in oracle_scores(record, *own, year).items():
            assert scores[name] == pytest.approx(value, abs=1e-5), name
        for name, value in oracle_scores(record, log, simulated, year).items():
            assert scores[name] == pytest.approx(value, abs=0.02), name
    for row in object_scores(found):
        for name, value in row.items():
            assert math.isnan(value) or 0 <= value < math.inf, name


def test_what_is_compared_occurs() -> None:
    seen = {kind: plain(kind)[2:] for kind in ODD}
    for flag in FLAGS.values():
        assert any(part[flag].any() for parts in seen.values() for part in parts), flag
    assert any((part["time_to_collision"] < 5).any() for parts in seen.values() for part in parts)
    assert not seen["no lights"][1]["traffic_light_violation_per_step"].any()
    assert (seen["one step only"][0]["distance_to_road_edge"] < -1e9).any()
