"""A step, goals and flags on a device that isn't the CPU: no mixed devices, and nothing waits for it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorDeviceMismatchError

from helpers_device import NAME, on, pretend
from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.envs import Bicycle, Displacement, DrivingEnv, ObservationConfig, collate, scene
from symphony.envs.edge import map_edge
from symphony.envs.flags import collision_flags, offroad_flags
from symphony.envs.objects import everyone_at
from symphony.envs.observation import observe
from symphony.roadgraph import LaneGraph

EVERYTHING = ObservationConfig(
    num_objects=3,
    num_points=60,
    num_lights=2,
    route=True,
    along=True,
    gaps=True,
    clearance=True,
    foresight=(0.5, 1.0),
)
MANY, NOTHING = ObservationConfig(16, 4000), ObservationConfig.nothing()


SCENES = collate([scene(s, [0, 1], LaneGraph(s.road)) for s in (straight_road(), crossing(6))])


@pytest.mark.parametrize(
    ("config", "dynamics", "gradient"),
    [
        *((config, Bicycle(), False) for config in (EVERYTHING, MANY, NOTHING)),
        *((config, Displacement(), True) for config in (EVERYTHING, MANY, NOTHING)),
    ],
)
def test_steps_goals_and_observations_stay_on_the_device(
    config: ObservationConfig, dynamics: Any, gradient: bool
) -> None:
    env = DrivingEnv(SCENES, dynamics, config)
    with pretend() as device, torch.set_grad_enabled(gradient):
        on(device, env)
        number = torch.arange(2, device=device.device)[:, None].expand(2, 3)
        start = env.start(number, number)
        if config.route:
            start = env.with_goals(env.choices(start))
        out = env.step(act(env, start, gradient))["next"]
        out = env.at(out)
        assert {v.device.type for v in out.values(True, True)} == {NAME}
        assert out[keys.COLLISION].shape == (2, 3, 2, 1)
        if gradient and not dynamics.discrete and config.num_points:
            out[keys.POINTS].sum().backward()
        assert device.waits == []
        assert device.constants < 7  # each is made once


def test_steps_of_open_traffic_stay_on_the_device() -> None:
    graphs = [(s, LaneGraph(s.road)) for s in (straight_road(), crossing(6))]
    edges = [scene(s, [0, 1], graph, edge=map_edge(graph)) for s, graph in graphs]
    env = DrivingEnv(collate(edges), observation=ObservationConfig.nothing())
    assert env.open_traffic
    with pretend() as device:
        on(device, env)
        number = torch.arange(2, device=device.device)
        start = env.start(number, number)
        out = env.step(act(env, start, gradient=False))["next"]
        assert {v.device.type for v in out.values(True, True)} == {NAME}
        assert device.waits == []


def act(env: DrivingEnv, state: Any, gradient: bool) -> Any:
    shape = (*state.shape, env.num_agents)
    if env.dynamics.discrete:
        action = torch.zeros(shape, dtype=torch.int64, device=state.device)
    else:
        action = torch.zeros(*shape, 2, device=state.device, requires_grad=gradient)
    return state.copy().set(keys.ACTION, action)


def test_observing_without_an_environment_stays_on_the_device() -> None:
    with pretend() as device:
        given = on(device, SCENES)
        row = torch.zeros(5, dtype=torch.int64, device=device.device)
        agent = row[:, None].expand(5, 2)
        objects = everyone_at(given, row, row, torch.zeros(5, 2, 4, device=row.device), agent > 0)
        seen = observe(given, row, row, objects, agent, EVERYTHING)
        flags = collision_flags(objects, agent), offroad_flags(given, row, objects.state[:, :2, :2])
        assert {value.device.type for value in (*seen.values(), *flags)} == {NAME}


def test_the_pretended_device_notices() -> None:
    with pretend() as device:
        there = torch.zeros(3, device=device.device)
        with pytest.raises(FakeTensorDeviceMismatchError):
            there + torch.ones(3)
        with pytest.raises(DataDependentOutputException):
            bool(there.any())
        assert device.waits == []
        there.cpu()
        torch.tensor([1.0, 2.0]).to(device.device)
        assert len(device.waits) == 2
