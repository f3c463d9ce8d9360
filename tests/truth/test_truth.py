"""The report of scenes whose right values are known, whatever the phase of the time step and its length."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from bridges import bridges
from made import Case, segment_of
from scenes import cases

from helpers_saved import played
from helpers_segments import hide, make_road, make_segment, turned
from symphony.data.segment import AgentType
from symphony.envs.flags import offroad_flags
from symphony.envs.objects import rollout_heights
from symphony.envs.scene import collate, scene
from symphony.evaluation.contacts import contacts
from symphony.evaluation.report import KIND_NAMES, Report, add_segment
from symphony.metrics import CollisionKind, collision_kinds
from symphony.rollouts.unroll import between_states
from symphony.saved.rollouts import SavedRollouts, world_of

KINDS = {name: kind for kind, name in KIND_NAMES.items()}
BY_TYPE = {int(AgentType.PEDESTRIAN): CollisionKind.PEDESTRIAN, int(AgentType.CYCLIST): CollisionKind.CYCLIST}
"""What the evaluator calls a collision with them, whichever way they went."""
PHASES = {0.2: (0.0, 0.25, 0.625), 0.1: (0.375, 0.875)}
"""For each length of a step in seconds where in it a scene begins: other seconds for each."""
ALL = [*cases(), *bridges()]


def rollouts(case: Case, dt: float, phases: tuple[float, ...]) -> list[SavedRollouts]:
    """One of the case for each phase, with the flags that the simulation would have set."""
    made = [segment_of(case, dt, phase) for phase in phases]
    found = [played(segment) for segment, _ in made]
    scenes = collate([scene(segment, [0]) for segment, _ in made])
    state = torch.from_numpy(np.stack([state for _, state in made]).astype(np.float32))[:, None, :, None]
    there = torch.from_numpy(np.stack([saved.there for saved in found]))
    height = rollout_heights(scenes, state[:, :, 1:])
    row = torch.arange(len(found)).repeat_interleave(state.shape[2] - 1)
    position = state[:, 0, 1:, :, :2].flatten(0, 1)
    off = offroad_flags(scenes, row, position, height=None if height is None else height.flatten(0, 2))
    hit = between_states(scenes, state, there)
    for k, saved in enumerate(found):
        saved.state[:] = state[k].numpy()
        saved.offroad[0], saved.collision[0] = off.view(len(found), -1, 1)[k].numpy(), hit[k, 0].numpy()
    return found


def kind_of(saved: SavedRollouts) -> int:
    """Return the kind of the first collision, as the evaluator finds it."""
    segment, steps = saved.segment, saved.steps + 1
    pose = np.concatenate([segment.position[..., :2], segment.heading[..., None], segment.velocity], -1)
    found = collision_kinds(
        torch.from_numpy(saved.collision[0].T), torch.from_numpy(saved.state[0].swapaxes(0, 1)),
        torch.from_numpy(saved.there[0].T), torch.tensor([0]), torch.from_numpy(pose[:, :steps]),
        torch.from_numpy(segment.valid[:, :steps]), torch.from_numpy(segment.size[:, :2]),
        torch.from_numpy(segment.agent_type.astype(np.int64)),
    )  # fmt: skip
    return int(found.kind[0])


def check(case: Case, row: dict[str, Any], events: list[Any], saved: SavedRollouts, start: float) -> None:
    """Compare every number that the case names, and those that follow from it."""
    right, dt = case.right, saved.segment.dt
    hits = [event for event in events if event.kind == "collision"]
    assert row["collision"] == ("kind" in right), "collision"
    assert row["collision"] == saved.collision.any() == bool(hits), "the evaluator's reading"
    assert row["collisions"] == right.get("collisions", len(hits[:1]))
    if hits:
        assert {event.text for event in hits} == {right["kind"]}
        assert row["at_fault_collision"] == right["fault"], "at fault"
        if start == 0:
            first = int(saved.segment.agent_type[hits[0].other])
            assert kind_of(saved) == BY_TYPE.get(first, int(KINDS[right["kind"]])), "the evaluator's kind"
        if right["at"] is not None:
            (found,) = contacts([world_of(saved, 0)], np.array([0]))
            times = start + (found.step - 1 + found.share) * dt
            assert times[0] == pytest.approx(right["at"], abs=2e-3), "time of contact"
    assert row["red_lights"] == (right.get("red", 0) if case.light else None)
    for name, number in (("wrong", "wrong_way_time"), ("blocking", "blocking_time")):
        if name in right:
            expected = right[name]
            assert (row[number] is None) == (expected is None), name
            assert expected is None or (row[number] > 0) == expected, name
        elif name == "wrong" and case.lanes:
            assert row[number] == 0, name
    step = 150 * dt / 8
    for name, number, tolerance in (
        ("ratio", "progress_ratio", 0.03), ("progress", "progress", 1e-3), ("ttc", "min_ttc", dt),
        ("distance", "log_distance", 1.5), ("braking", "max_braking", 1e-3), ("jerk", "max_jerk", 1e-2),
        ("acceleration", "max_acceleration", 1e-3), ("lateral", "max_lateral_acceleration", 1e-3),
        ("offroad", "offroad_time", step),
    ):  # fmt: skip
        if name in right:
            expected = right[name]
            assert row[number] == (None if expected is None else pytest.approx(expected, abs=tolerance)), name
    if "low_ttc" in right:
        assert (row["low_ttc_time"] > 0) == right["low_ttc"]


@pytest.mark.parametrize("dt", PHASES)
@pytest.mark.parametrize("case", ALL, ids=[case.name for case in ALL])
def test_a_report_says_what_is_right(case: Case, dt: float) -> None:
    phases = PHASES[dt]
    for phase, saved in zip(phases, rollouts(case, dt, phases), strict=True):
        found = Report("made", "ego")
        add_segment(found, saved)
        check(case, found.rows[0], found.events[case.name], saved, phase * dt)


@pytest.mark.parametrize(("angle", "cut"), [*product([0.1, 0.2, 0.4, 0.7], [False, True])])
def test_where_two_lanes_merge_the_one_that_bends_cuts_in(angle: float, cut: bool) -> None:
    slope, time = np.array([np.cos(angle), np.sin(angle)]), np.arange(41) * 0.2 - 4
    main, ramp = np.arange(-200.0, 401, 2)[:, None] * [1, 0], np.arange(-120.0, 1, 2)[:, None] * slope
    lanes = make_road([main[:101], main[100:], ramp], [(0, 1), (2, 1)])
    past = np.stack([7.5 + 9 * time, 0.3 + 16 * time][:: -1 if cut else 1])  # metres past the merge
    way = np.where((past < 0)[..., None] & [[[False]], [[True]]], slope, [1, 0])
    heading, speed = np.arctan2(way[..., 1], way[..., 0]), np.diff(past, axis=1)[:, :1, None] / 0.2
    for ego, fault in ((0, False), (1, True)):
        segment = make_segment(lanes, past[..., None] * way, heading, speed * way, 0.2).replace(ego=ego)
        add_segment(found := Report("made", "ego"), played(segment, [ego]))
        assert (found.rows[0]["collision"], found.rows[0]["at_fault_collision"]) == (True, fault)


@pytest.mark.parametrize("hidden", [slice(1, 7), slice(2, 7), slice(1, 4)])
def test_who_cuts_in_unseen_is_judged_where_it_is_seen_again(hidden: slice) -> None:
    case = next(each for each in cases() if each.name == "another cuts in closely and brakes")
    segment = hide(segment_of(case, 0.2, 0.0)[0], 1, hidden)
    for shift in (0.0, -100.0, 500.0):
        add_segment(found := Report("made", "ego"), played(turned(segment, 0.0, np.array([shift, 0.0]))))
        assert found.rows[0]["at_fault_collision"] is False
