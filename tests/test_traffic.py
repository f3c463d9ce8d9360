"""Open traffic: who may enter, and who has left."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers_segments import crossing
from symphony import keys
from symphony.envs import DrivingEnv, ObservationConfig, collate, scene
from symphony.envs.edge import leaving
from symphony.envs.objects import Objects, entering
from symphony.roadgraph import LaneGraph
from symphony.rollouts.background import CarFollower


@pytest.mark.parametrize(
    ("ahead", "aside", "speed", "its_speed", "enters"),
    [
        (5.6, 0.0, 0.0, 0.0, True),
        (5.4, 0.0, 0.0, 0.0, False),  # 0.9 m between them
        (9.0, 0.0, 10.0, 0.0, False),  # it would be there in half a second
        (9.0, 0.0, 10.0, 10.0, True),
        (-9.0, 0.0, 0.0, 9.0, False),  # who comes from behind
        (-9.0, 4.0, 0.0, 9.0, True),
        (13.0, 0.0, 9.0, 0.0, False),  # in a second
        (15.0, 0.0, 9.0, 0.0, True),
    ],
)
@pytest.mark.parametrize("angle", [0.0, 2.0])
def test_who_enters_would_meet_nobody_within_a_second(
    ahead: float, aside: float, speed: float, its_speed: float, enters: bool, angle: float
) -> None:
    forward, left = (
        torch.tensor([np.cos(angle), np.sin(angle)]),
        torch.tensor([-np.sin(angle), np.cos(angle)]),
    )
    rows = [
        torch.cat([place, torch.tensor([angle]), v * forward])
        for place, v in ((0 * forward, speed), (ahead * forward + aside * left, its_speed))
    ]
    objects = Objects(
        torch.stack(rows)[None].float(),
        torch.ones(1, 2, dtype=torch.bool),
        torch.tensor([[[4.5, 2.0], [4.5, 2.0]]]),
    )
    for index, slot in (([[0]], 0), ([[1, 0]], 1)):
        ready = torch.zeros(1, len(index[0]), dtype=torch.bool)
        ready[0, slot] = True
        assert entering(objects, torch.tensor(index), ready)[0, slot].item() == enters


@pytest.mark.parametrize("seed", range(8))
def test_on_a_device_the_same_enter(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """There all are compared with all, as to look for those that are ready would wait for it."""
    rng = torch.Generator().manual_seed(seed)
    rows, agents, driven = 6, 9, 5
    state = torch.rand(rows, agents, 5, generator=rng) * torch.tensor([40.0, 12, 6, 12, 4])
    size = torch.tensor([4.5, 2.0]).expand(rows, agents, 2)
    valid = torch.rand(rows, agents, generator=rng) < 0.9
    objects = Objects(state, valid, size)
    index = torch.rand(rows, agents, generator=rng).argsort(-1)[:, :driven]
    ready = (torch.rand(rows, driven, generator=rng) < 0.6) & valid.gather(1, index)
    found = entering(objects, index, ready)
    assert 0 < found.sum() < ready.sum()
    monkeypatch.setattr("symphony.geometry.nearest.on_host", lambda _: False)
    assert torch.equal(entering(objects, index, ready), found)
    assert not entering(objects, index, torch.zeros_like(ready)).any()


def test_on_a_device_the_same_are_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """There the rule moves everybody, and those it doesn't drive are put back."""
    segments = [(s, LaneGraph(s.road)) for s in (crossing(6, seed=1), crossing(5, seed=5))]
    ruled = np.arange(4) % 2 > 0
    scenes = collate([scene(s, range(4), graph, background=ruled) for s, graph in segments])
    env = DrivingEnv(scenes, observation=ObservationConfig.nothing())
    start = env.start(torch.tensor([[0, 1], [1, 0], [0, 0]]))
    follow = CarFollower(env)
    found = follow(start.clone())[keys.BACKGROUND]
    monkeypatch.setattr("symphony.rollouts.background.on_host", lambda _: False)
    there = follow(start.clone())[keys.BACKGROUND]
    torch.testing.assert_close(there, found, rtol=0, atol=1e-5)
    still = (there == start[keys.STATE]).all(-1)
    assert still[..., ~ruled].all()
    assert not still[..., ruled].any()


def test_who_is_beyond_any_side_of_the_map_has_left() -> None:
    hull = torch.tensor([[[1.0, 0, 10], [-1, 0, 10], [0, 1, 10], [0, -1, 10], [0, 0, 0]]])
    after = torch.tensor([[[9.0, -9], [11, 0], [-11, 9], [0, 10.5], [3, -12]]])
    none = torch.zeros(1, 2, 4)
    assert leaving(torch.zeros_like(after), after, none, hull).tolist() == [[False, True, True, True, True]]
