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


@pytest.mark.parametrize(("config", "edge"), [(SEES, False), (ObservationConfig.nothing(), True)])
@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
@torch.no_grad()
def test_a_compiled_step_is_the_step(config: ObservationConfig, edge: bool) -> None:
    torch.compiler.reset()
    segments = [straight_road(), crossing(6)]
    edges = [map_edge(LaneGraph(s.road)) if edge else None for s in segments]
    scenes = [scene(s, [0, 1], edge=end) for s, end in zip(segments, edges, strict=True)]
    env = DrivingEnv(collate(scenes), Bicycle(), config)
    assert env.open_traffic == edge
    start = env.start(torch.tensor([0, 1])).set(keys.ACTION, torch.tensor([[80, 60], [75, 70]]))
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
    # Scenes of another time step are compiled once more, and those of before not again.
    for dt in (0.1, 0.2):
        found = []
        for tried in (env, copy):
            tried.scenes = collate([scene(straight_road().replace(dt=dt), [0, 1])])
            torch.manual_seed(0)
            tried.set_seed(0)
            found.append(tried.rollout(4))
        assert_close(found[0], found[1], rtol=0, atol=1e-5)
        assert len(calls) == 2
