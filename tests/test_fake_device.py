"""Steps, searches and losses on a device that isn't the CPU: nothing mixes devices or waits; what signatures say."""

from __future__ import annotations

import runpy
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorDeviceMismatchError

import helpers_losses
from helpers_device import NAME, on, pretend
from helpers_losses import CASES, LOGGED, ROWS, SCENES, batch_of, losses, searched
from helpers_processes import forget, output_of
from helpers_segments import crossing, straight_road
from symphony import keys, objectives
from symphony.agents import load_agent
from symphony.collectors import Systematic
from symphony.config import EvaluateConfig
from symphony.envs import Bicycle, DrivingEnv, ObservationConfig, collate, scene
from symphony.envs.scene import map_edge
from symphony.modules import SeededNoise
from symphony.roadgraph import LaneGraph
from symphony.rollouts.background import CarFollower
from symphony.rollouts.driving import simulation
from symphony.rollouts.unroll import simulate, start_states

MANY, NOTHING = ObservationConfig(16, 4000), ObservationConfig.nothing()
ROADS = collate([scene(s, [0, 1], LaneGraph(s.road)) for s in (straight_road(), crossing(6))])


@contextmanager
def placed(env, *parts):
    """A device on which an environment and networks are, and where nothing waits or makes many constants."""
    with pretend() as device:
        for part in (*parts, env):
            on(device, part)
        yield device
        assert device.waits == []
        assert device.constants < 7  # each is made once, in however many steps


@contextmanager
def world(space="bicycle"):
    agent, env = helpers_losses.world(space)
    with placed(env, *agent.modules.values()) as device:
        yield device, agent, env


def assert_there(td):
    assert {value.device.type for value in td.values(True, True)} == {NAME}


def act(env, state):
    shape = (*state.shape, env.num_agents)
    return state.copy().set(keys.ACTION, torch.zeros(shape, dtype=torch.int64, device=state.device))


@pytest.mark.parametrize("config", [MANY, NOTHING])
def test_steps_and_observations_stay_on_the_device(config):
    """Steps with many elements, or none; those of all kinds have gradients, and are seen by networks, below."""
    env = DrivingEnv(ROADS, Bicycle(), config)
    with placed(env) as device, torch.no_grad():
        number = torch.arange(2, device=device.device)[:, None].expand(2, 3)
        out = env.at(env.step(act(env, env.start(number, number)))["next"])
        assert_there(out)
        assert out[keys.COLLISION].shape == (2, 3, 2, 1)


def test_steps_of_open_traffic_stay_on_the_device():
    graphs = [(s, LaneGraph(s.road)) for s in (straight_road(), crossing(6))]
    edges = [scene(s, [0, 1], graph, edge=map_edge(graph)) for s, graph in graphs]
    env = DrivingEnv(collate(edges), observation=NOTHING)
    assert env.open_traffic
    with placed(env) as device:
        number = torch.arange(2, device=device.device)
        assert_there(env.step(act(env, env.start(number, number)))["next"])


def test_forgotten_goals_are_looked_for_once():
    env = DrivingEnv(ROADS, observation=ObservationConfig(1, 0, route=True))
    with pretend() as device:
        start = on(device, env).start(*[torch.arange(2, device=device.device)] * 2)
        with pytest.raises(DataDependentOutputException):
            env.step(act(env, start))


def test_the_pretended_device_notices():
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


def test_simulations_stay_on_the_device():
    with world("histogram") as (_, agent, env):  # a search simulates the other space
        policy = TensorDictSequential(SeededNoise(0, agent.dynamics.numbers), agent.policy)
        found = simulate(env, policy, start_states(env, agent.goals, trees=2, branches=1, seed=0))
        assert found.state.shape == (2, 2, 1, LOGGED, 2, 4)
        assert {part.device.type for part in found} == {NAME}


def test_others_that_a_rule_drives_stay_on_the_device():
    scenes = SCENES.clone()
    scenes.background = scenes.interactive_valid.clone()
    env = DrivingEnv(scenes, observation=NOTHING)
    follow = CarFollower(env)  # looks at the maps once
    with placed(env) as device:
        follow.routes = type(follow.routes)(*(on(device, part) for part in follow.routes))
        number = torch.arange(2, device=device.device)
        assert follow(env.start(number, number))[keys.BACKGROUND].device.type == NAME
        # Goals that are given come from the host; it ends where the time step is looked at.
        with pytest.raises(DataDependentOutputException):
            simulation(load_agent("idm"), env.scenes, EvaluateConfig(), given=torch.zeros(2, 2).long())
        device.waits.clear()


def test_searches_stay_on_the_device():
    with world() as (_, agent, env):
        start = start_states(env, agent.goals, trees=1, branches=4, seed=0)
        found = searched(agent, env, Systematic(0.6), start)
        assert found.trajectories.shape == (2, 1, 3, LOGGED - 1)
        assert found.totals.device.type == NAME


@pytest.mark.parametrize("space", sorted({space for _, space in CASES}))
def test_losses_and_their_gradients_stay_on_the_device(space):
    with world(space) as (device, agent, env):
        row = torch.arange(ROWS, device=device.device) % 2
        batch, known = batch_of(env, env.start(row, row)), losses(agent, env)
        for name in (name for name, used in CASES if used == space):
            device.waits.clear()
            out = known[name](batch.exclude(keys.ACTION) if name == "mgail" else batch.copy())
            total = sum(value for key, value in out.items() if key.startswith("loss"))
            assert isinstance(total, torch.Tensor), name
            assert total.device.type == NAME, name
            total.backward()
            assert device.waits == [], name


def test_every_loss_is_among_them():
    with world() as (_, agent, env):
        known = {type(loss) for loss in losses(agent, env).values()}
    there = [getattr(objectives, name) for name in objectives.__all__ if name.endswith("Loss")]
    assert known == set(there)


def instrumented() -> None:
    """Take every loss once, as :mod:`helpers_losses` does as a program."""
    forget("symphony", *(path.stem for path in Path(__file__).parent.glob("helpers_*.py")))
    runpy.run_module("helpers_losses", run_name="__main__")


def test_what_is_taken_and_returned_is_what_signatures_say(tmp_path):
    # In a process of its own, as the package must be instrumented when it is imported.
    lines = output_of(instrumented, said=tmp_path / "said").splitlines()
    assert [tuple(line.split()) for line in lines] == CASES
