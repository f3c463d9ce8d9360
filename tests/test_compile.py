"""The environment's step compiles as one graph, with and without an observation, and gives the same numbers."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.envs import Bicycle, Displacement, DrivingEnv, ObservationConfig, collate, scene

SEES = ObservationConfig(num_objects=3, num_points=60, clearance=True, foresight=(0.5,))


@pytest.mark.parametrize(
    ("dynamics", "config"), [(Bicycle(), SEES), (Displacement(), ObservationConfig.nothing())]
)
@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
@torch.no_grad()
def test_a_compiled_step_is_the_step(dynamics: Any, config: ObservationConfig) -> None:
    torch.compiler.reset()
    env = DrivingEnv(collate([scene(s, [0, 1]) for s in (straight_road(), crossing(6))]), dynamics, config)
    start = env.start(torch.tensor([0, 1]))
    action = torch.tensor([[80, 60], [75, 70]])
    if not dynamics.discrete:
        action = torch.tensor([[[1.0, 0.1], [2.0, 0.0]], [[0.5, 0.0], [1.0, -0.2]]])
    start.set(keys.ACTION, action)
    plain = env._step(start)
    compiled = torch.compile(env._step, backend="eager", fullgraph=True)(start)
    assert set(compiled.keys(True, True)) == set(plain.keys(True, True))
    for key in plain.keys(True, True):
        found, expected = compiled[key], plain[key]
        # Elements that are seen are in the scene's order here and in any order there.
        if key[-1] in ("objects", "objects_mask", "points", "points_mask", "gap", "gap_ahead"):
            found, expected = found.double().sum(2), expected.double().sum(2)
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)
