"""Saved rollouts in the formats of other tools: what is read back is what was simulated."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from helpers_saved import played, searched
from helpers_segments import crossing, hide, straight_road
from symphony.cli import main
from symphony.data.segment import AgentType, Polylines, RunSegment, SignalState
from symphony.data.sources.commonroad import CommonRoadReader
from symphony.saved.export import commonroad, to_dict
from symphony.saved.folder import About, save_rollouts
from symphony.saved.rollouts import SavedRollouts, world_of


def read_back(saved: SavedRollouts, rollout: int, path: Path) -> RunSegment:
    file = path / "scenario.xml"
    file.write_text(commonroad(saved, rollout), encoding="utf-8")
    (item,) = CommonRoadReader().read(file)
    assert isinstance(item, RunSegment), item
    return item


def test_a_rollout_comes_back_from_commonroad(tmp_path: Path) -> None:
    """Every agent is where it was in the rollout, at every step, within a millimetre."""
    for saved in searched()[1]:
        for rollout in (0, saved.rollouts - 1):
            found, world = read_back(saved, rollout, tmp_path), world_of(saved, rollout)
            assert (found.dt, found.num_steps) == (saved.segment.dt, saved.steps + 1)
            for row in np.flatnonzero(world.valid.any(1)):
                (k,) = np.flatnonzero(found.agent_id == saved.segment.agent_id[row])
                seen, shift = found.valid[k], found.origin[:2] - saved.segment.origin[:2]
                np.testing.assert_array_equal(seen, world.valid[row])
                for mine, other in (
                    (found.position[k, seen, :2] + shift, world.position[row, seen]),
                    (found.heading[k, seen], world.heading[row, seen]),
                    (np.linalg.norm(found.velocity[k, seen], axis=-1), np.abs(world.speed[row, seen])),
                    (found.size[k, :2], world.size[row]),
                ):
                    np.testing.assert_allclose(mine, other, atol=1e-3)


def test_the_map_and_its_lights_come_back(tmp_path: Path) -> None:
    segment = crossing(4, steps=31).replace(origin=np.array([512_000.0, 5_400_000.0, 0.0]))
    again = read_back(played(segment, [0, 1]), 0, tmp_path)
    road, other, shift = segment.road, again.road, again.origin[:2] - segment.origin[:2]
    assert len(other.lanes) == len(road.lanes)
    for k in range(len(road.lanes)):
        np.testing.assert_allclose(other.lanes[k][:, :2] + shift, road.lanes[k][:, :2], atol=0.01)
    for name in ("lane_width", "speed_limit", "lane_type"):
        np.testing.assert_allclose(getattr(other, name), getattr(road, name), atol=0.01)
    assert set(map(tuple, other.successors)) == set(map(tuple, road.successors))
    order = np.argsort(again.signal_lane)
    np.testing.assert_array_equal(again.signal_lane[order], segment.signal_lane)
    np.testing.assert_array_equal(again.signal_state[order], segment.signal_state)
    np.testing.assert_allclose(again.signal_point[order, :2] + shift, segment.signal_point[:, :2], atol=0.01)


def test_neighbours_come_back_and_unknown_widths_are_nominal(tmp_path: Path) -> None:
    segment = straight_road(3)
    lost = np.full_like(segment.road.lane_width, np.nan)
    segment = segment.replace(road=dataclasses.replace(segment.road, lane_width=lost, speed_limit=lost))
    again = read_back(played(segment), 0, tmp_path)
    for name in ("left_neighbors", "right_neighbors"):
        assert set(map(tuple, getattr(again.road, name))) == set(map(tuple, getattr(segment.road, name)))
    np.testing.assert_allclose(again.road.lane_width, 3.6, atol=1e-3)
    assert np.isnan(again.road.speed_limit).all()


def test_agents_that_are_lost_and_odd_ids_stay_apart(tmp_path: Path) -> None:
    """An agent seen twice is two obstacles; ids that are not positive are shifted."""
    segment = hide(straight_road(4, steps=21), 2, slice(5, 9))
    segment = segment.replace(
        agent_id=np.array([-3, 0, 4, 9]),
        agent_type=np.array([1, 2, 3, 4], np.uint8),
        size=np.array([[9, 2, 0], [0.5, 0.5, 0], [1.8, 0.6, 0], [2, 2, 0]], np.float32),
    )
    text = commonroad(played(segment), 0)
    for kind in ("truck", "pedestrian", "bicycle", "unknown"):
        assert f"<type>{kind}</type>" in text
    again = read_back(played(segment), 0, tmp_path)
    assert again.agent_id[:2].tolist() == [1, 4]
    first, second = (again.valid[again.agent_id == number][0] for number in (8, 14))
    np.testing.assert_array_equal(first ^ second, segment.valid[2])
    assert AgentType.CYCLIST in again.agent_type


def test_json_says_who_is_the_ego_and_where_it_was_to_go() -> None:
    segment = crossing(4, steps=11).replace(ego=2, origin=np.array([300.0, -20.0, 5.0]))
    route = np.array([(0, 0, 0), (10, 5, 0)], np.float32)
    routes = Polylines.of([route + 7, route])
    saved = played(segment, [1, 2], goal=np.array([[-1, 1]]), routes=routes)
    found = [{agent["id"]: agent for agent in to_dict(saved, 0)["agents"]}[int(n)] for n in segment.agent_id]
    assert [agent["ego"] for agent in found] == [False, False, True, False]
    assert found[1]["route"] is None
    assert found[2]["route"] == [[300.0, -20.0], [310.0, -15.0]]
    assert "route" not in found[0]


def test_a_run_that_failed_at_once_is_a_scenario_without_anybody() -> None:
    saved = played(straight_road(1), failed={0: "why"})
    saved.counted[:] = False
    assert "dynamicObstacle" not in commonroad(saved, 0)
    assert to_dict(saved, 0)["agents"] == []


def test_the_command_writes_a_file_for_each_rollout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = played(crossing(4, steps=11), [0, 1], 3)
    saved.collision[1, 4, 1] = True
    save_rollouts(tmp_path / "sim", About("made"), [saved, played(straight_road())])
    sim, out = str(tmp_path / "sim"), tmp_path / "json"
    assert main(["export", sim]) == 0
    names = [path.name for path in sorted((tmp_path / "sim" / "export").iterdir())]
    assert names == [*(f"crossing-0-{k}.xml" for k in range(3)), "straight-0-0.xml"]
    arguments = ["--format", "json", "--out", str(out), "--segments", "crossing-0", "--rollouts", "1"]
    assert main(["export", sim, *arguments]) == 0
    (file,) = out.iterdir()
    found = json.loads(file.read_text())
    states, world = np.array(found["agents"][1]["states"]), world_of(saved, 1)
    np.testing.assert_array_equal(states[:, 0], np.arange(11))
    np.testing.assert_allclose(states[:, 1:3], world.position[1], atol=1e-6)
    np.testing.assert_allclose(states[:, 4], world.speed[1], atol=1e-6)
    assert found["agents"][1]["collision"] == [5]
    assert [agent["driver"] for agent in found["agents"]] == ["made", "made", "playback", "playback"]
    assert found["lights"][0]["states"][0] == SignalState(saved.segment.signal_state[0, 0]).name.lower()
    assert main(["export", sim, "--rollouts", "1"]) == 1
    assert "straight-0 has rollouts 0 to 0, not 1" in capsys.readouterr().err


def test_a_lane_that_is_not_written_has_no_sign() -> None:
    segment = crossing()
    road = segment.road
    values = {"lane_id": 999, "lane_type": road.lane_type[0], "speed_limit": 7.77, "lane_width": 3.5}
    more = {
        name: np.append(getattr(road, name), getattr(road, name).dtype.type(x)) for name, x in values.items()
    }
    lines = [road.lanes[k] for k in range(len(road.lanes))] + [road.lanes[0][:1]]
    longer = dataclasses.replace(road, lanes=Polylines.of(lines), **more)
    assert "7.77" not in commonroad(played(segment.replace(road=longer)), 0)
