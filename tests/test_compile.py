"""The environment's step compiles as one graph, with and without an observation, and gives the same numbers."""

from __future__ import annotations

import pickle
from typing import Any

import pytest
import torch
from tensordict import assert_close

from helpers_segments import crossing, straight_road
from helpers_steps import assert_same_step
from symphony import keys
from symphony.envs import Bicycle, Displacement, DrivingEnv, ObservationConfig, collate, scene
from symphony.envs.edge import map_edge
from symphony.roadgraph import LaneGraph

SEES = ObservationConfig(num_objects=3, num_points=60, clearance=True, foresight=(0.5,))


@pytest.mark.parametrize(
    ("dynamics", "config", "edge"),
    [
        (Bicycle(), SEES, False),
        (Bicycle(), ObservationConfig.nothing(), True),
    ],
)
@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
@torch.no_grad()
def test_a_compiled_step_is_the_step(dynamics: Any, config: ObservationConfig, edge: bool) -> None:
    torch.compiler.reset()
    segments = [straight_road(), crossing(6)]
    edges = [map_edge(LaneGraph(s.road)) if edge else None for s in segments]
    scenes = [scene(s, [0, 1], edge=end) for s, end in zip(segments, edges, strict=True)]
    env = DrivingEnv(collate(scenes), dynamics, config)
    assert env.open_traffic == edge
    start = env.start(torch.tensor([0, 1]))
    action = torch.tensor([[80, 60], [75, 70]])
    if not dynamics.discrete:
        action = torch.tensor([[[1.0, 0.1], [2.0, 0.0]], [[0.5, 0.0], [1.0, -0.2]]])
    start.set(keys.ACTION, action)
    plain = env._step(start)
    env.compile(backend="eager", fullgraph=True)
    compiled = env._step(start)
    assert_same_step(compiled, plain, atol=1e-4)


@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
@torch.no_grad()
def test_an_environment_is_compiled_where_it_is_and_its_copies_are_not() -> None:
    torch.compiler.reset()
    env = DrivingEnv(
        collate([scene(straight_road(), [0, 1])]), Displacement(), ObservationConfig.nothing(), seed=0
    )
    plain = env.rollout(4)
    calls = []

    def backend(graph: torch.fx.GraphModule, _: object) -> Any:
        calls.append(graph)
        return graph.forward

    env.compile(backend=backend, fullgraph=True)
    # Again is not twice; and a batch without dimensions, as rollouts have it, compiles, too.
    env.compile(backend=backend, fullgraph=True)
    env.set_seed(0)
    torch.manual_seed(0)
    compiled = env.rollout(4)
    assert len(calls) == 1
    assert plain.shape == compiled.shape
    copy = pickle.loads(pickle.dumps(env))  # noqa: S301 - just pickled
    for tried in (env, copy):
        torch.manual_seed(0)
        tried.set_seed(0)
        assert_close(tried.rollout(4), compiled, rtol=0, atol=1e-5)
    assert len(calls) == 1
    assert copy._step.__func__ is DrivingEnv._step


@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
@torch.no_grad()
def test_a_compiled_environment_takes_other_scenes_and_their_time_step() -> None:
    torch.compiler.reset()
    given = [collate([scene(straight_road().replace(dt=dt), [0, 1])]) for dt in (0.2, 0.1, 0.2)]
    plain, compiled = (DrivingEnv(given[0], observation=ObservationConfig.nothing()) for _ in range(2))
    compiled.compile(backend="eager", fullgraph=True)
    for env_scenes in given:
        found = []
        for env in (plain, compiled):
            env.scenes = env_scenes
            start = env.start(torch.tensor([0])).set(keys.ACTION, torch.tensor([[80, 60]]))
            found.append(env.step(start)["next"])
        assert_close(found[1], found[0], rtol=0, atol=1e-5)
