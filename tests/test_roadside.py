"""Parked cars and pedestrians: where they stand, and whom they leave alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers_segments import crossing, straight_road
from symphony.cli import main
from symphony.data import generate as generation
from symphony.data import plans
from symphony.data.builtin import builtin_store
from symphony.data.generate import Harvest, generate
from symphony.data.overlaps import overlapping
from symphony.data.plans import Plan, Task
from symphony.data.roadside import CLEARANCE, MOST, REACH, Roadside, add_roadside
from symphony.data.segment import AgentType, RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError
from symphony.geometry import box_corners, box_gap, segments_of, signed_distance

FULL = Roadside(parked=1.0, pedestrians=40)


@pytest.fixture(scope="module")
def lined() -> list[tuple[RunSegment, RunSegment]]:
    """Simulated segments before and after."""
    store = SegmentStore(builtin_store("train"))
    return [(store[k], add_roadside(store[k], FULL, k)) for k in range(0, 24, 6)]


def outside(segment: RunSegment, points: np.ndarray) -> np.ndarray:
    """Metres [M] from the edge of the road, negative on it."""
    boundary = segment.road.boundary
    edges = [
        torch.from_numpy(np.asarray(array))[None] for array in segments_of(boundary.points, boundary.offsets)
    ]
    there = torch.ones(edges[0].shape[:2], dtype=torch.bool)
    where = torch.from_numpy(points.reshape(1, -1, 2))
    return signed_distance(where, edges[0].double(), edges[1].double(), there, *edges[2:])[0].numpy()


def test_whoever_was_there_before_stays_as_it_was(lined: list[tuple[RunSegment, RunSegment]]) -> None:
    for before, after in lined:
        count = before.num_agents
        assert after.num_agents > count
        names = ("agent_id", "agent_type", "size", "position", "heading", "velocity", "valid")
        mine = after.replace(**{name: getattr(after, name)[:count] for name in names})
        assert content_hash(mine) == content_hash(before)
        assert len(set(after.agent_id.tolist())) == after.num_agents


def test_cars_stand_at_the_kerb_and_in_nobodys_way(lined: list[tuple[RunSegment, RunSegment]]) -> None:
    standing = 0
    for before, after in lined:
        new = np.arange(before.num_agents, after.num_agents)
        cars = new[after.agent_type[new] == AgentType.VEHICLE]
        standing += len(cars)
        assert len(cars) <= MOST
        assert not after.velocity[cars].any()
        assert (np.ptp(after.position[cars], axis=1) == 0).all()
        assert after.valid[cars].all()
        pose, size = after.position[cars, 0].astype(np.float64), after.size[cars].astype(np.float64)
        heading = after.heading[cars, 0].astype(np.float64)
        box = [torch.from_numpy(value) for value in (pose[:, :2], heading, size[:, :2])]
        away = outside(after, box_corners(*box).numpy()).reshape(-1, 4)
        assert (away > -REACH - 0.1 - 1e-3).all()
        assert (away.max(1) > 1.0).all(), "most of a car is beside the road"
        assert (away.min(1) < 1.5).all(), "near the kerb"
        for step in range(after.num_steps):
            there = np.flatnonzero(before.valid[:, step])
            other = [
                torch.from_numpy(array[there].astype(np.float64))
                for array in (before.position[:, step, :2], before.heading[:, step], before.size[:, :2])
            ]
            gap = box_gap(*(value[:, None] for value in box), *(value[None] for value in other))
            assert float(gap.min()) > CLEARANCE - 1e-3
        apart = box_gap(*(value[:, None] for value in box), *(value[None] for value in box))
        assert float((apart + torch.eye(len(cars)) * 100).min()) > 0.2
        assert len(overlapping(after)) == len(overlapping(before))
    assert standing > 10 * len(lined)


def test_people_walk_beside_the_road(lined: list[tuple[RunSegment, RunSegment]]) -> None:
    seen = speeds = 0
    for _, after in lined:
        people = np.flatnonzero(after.agent_type == AgentType.PEDESTRIAN)
        seen += len(people)
        places = after.position[people, :, :2].astype(np.float64)
        assert (outside(after, places) > 0.3).all()
        speed = np.linalg.norm(after.velocity[people], axis=-1)
        assert speed.max(initial=0) < 4.0
        speeds += int((speed.mean(1) > 0.8).sum())
        way = (places[:, 2:] - places[:, :-2]) / (2 * after.dt)
        np.testing.assert_allclose(after.velocity[people, 1:-1], way, atol=1e-3)
        turn = np.cos(after.heading[people, 1:-1] - np.arctan2(way[..., 1], way[..., 0]))
        # But for a moment around the inside of a sharp corner.
        assert (turn[np.linalg.norm(way, axis=-1) > 0.5] > 0.7).mean() > 0.98, "they look where they go"
    assert seen > 3 * len(lined)
    assert 0.5 * seen < speeds < seen, "some stand"


def test_the_seed_decides_everything() -> None:
    segment = crossing(3)
    first = add_roadside(segment, FULL, 5)
    assert content_hash(first) == content_hash(add_roadside(segment, FULL, 5))
    assert content_hash(first) != content_hash(add_roadside(segment, FULL, 6))
    assert add_roadside(segment, Roadside(), 5) is segment


def test_turned_and_shifted_roads_have_the_same_cars() -> None:
    segment = straight_road(3, steps=8)
    found = add_roadside(segment, Roadside(0.6), 1)
    shift = np.array([300.0, -20.0], np.float32)
    road = segment.road
    lines = {
        name: type(lane)(lane.points + np.array([*shift, 0], np.float32), lane.offsets)
        for name, lane in (("lanes", road.lanes), ("boundary", road.boundary), ("marks", road.marks))
    }
    moved = segment.replace(
        position=np.where(segment.valid[..., None], segment.position + np.array([*shift, 0], np.float32), 0),
        signal_point=segment.signal_point + np.array([*shift, 0], np.float32),
        road=type(road)(**{**vars(road), **lines}),
    )
    again = add_roadside(moved, Roadside(0.6), 1)
    assert again.num_agents == found.num_agents > segment.num_agents
    new = slice(segment.num_agents, None)
    np.testing.assert_allclose(again.position[new, :, :2] - shift, found.position[new, :, :2], atol=1e-3)


def test_roads_without_an_edge_have_none() -> None:
    segment = straight_road(3, steps=8)
    boundary = segment.road.boundary
    bare = type(segment.road)(
        **{**vars(segment.road), "boundary": type(boundary)(boundary.points[:0], np.zeros(1, np.int64))}
    )
    assert add_roadside(segment.replace(road=bare), FULL, 0).num_agents == segment.num_agents


@pytest.mark.parametrize("bad", [{"parked": 2.0}, {"parked": float("nan")}, {"pedestrians": -1}])
def test_a_roadside_out_of_range_is_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(bad))):
        Roadside(**bad)


def _harvest(task: Task) -> Harvest:
    held = SegmentStore(builtin_store("train"))[:2]
    names = [f"{task.name}-{k}" for k in range(2)]
    return Harvest(
        task,
        [add_roadside(s.replace(segment_id=n), task.roadside, 1) for s, n in zip(held, names, strict=True)],
        2,
    )


def test_stores_without_are_those_of_before_and_others_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generation, "harvest", _harvest)
    monkeypatch.setattr(plans, "sumo_version", lambda: "0.0")
    generate(Plan(2), tmp_path / "plain")
    report = tmp_path / "plain" / "report.json"
    old = json.loads(report.read_text())
    for name in ("parked", "pedestrians"):
        del old["settings"][name]
    report.write_text(json.dumps(old))
    assert generate(Plan(2), tmp_path / "plain").complete
    generate(Plan(2, parked=0.5, pedestrians=3), tmp_path / "lined")
    settings = SegmentStore(tmp_path / "lined").report["settings"]
    assert (settings["parked"], settings["pedestrians"]) == (0.5, 3)
    assert SegmentStore(tmp_path / "lined")[0].num_agents > SegmentStore(tmp_path / "plain")[0].num_agents
    with pytest.raises(ConfigError, match="parked"):
        generate(Plan(2), tmp_path / "lined")


@pytest.mark.parametrize("given", [["--parked", "1.5"], ["--parked", "nan"], ["--pedestrians", "-1"]])
def test_shares_and_counts_out_of_range_are_refused(
    given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["data", "generate", "--count", "2", "--out", str(tmp_path / "no"), *given]) != 0
    assert given[0].removeprefix("--") in capsys.readouterr().err
