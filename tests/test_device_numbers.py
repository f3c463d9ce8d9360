"""What an accelerator would compute of a state is what the CPU, which looks only where it must, makes of it."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers_segments import crossing, ring, straight_road
from symphony import keys
from symphony.envs import DrivingEnv, ObservationConfig, collate, scene
from symphony.roadgraph import LaneGraph

EVERYTHING: dict[str, Any] = {
    "route": True,
    "along": True,
    "gaps": True,
    "road": True,
    "clearance": True,
    "foresight": (0.5, 1.0),
}
GROUPS = {"points": (), "lights": (), "objects": ("gap", "gap_ahead", "along")}


def states(env: DrivingEnv, seed: int) -> Any:
    """Of agents near where they began, every other time both at one place: some beside the road, some far."""
    rng = torch.Generator().manual_seed(seed)
    start = env.with_goals(env.start(torch.arange(len(env.scenes)).repeat_interleave(12)))
    state = start.get(keys.STATE)
    noise = torch.randn(state.shape, generator=rng) * torch.tensor([3.0, 3.0, 1.0, 2.0])
    far = torch.rand(state.shape[:-1], generator=rng) < 0.05
    noise[..., :2] *= torch.where(far, 50.0, 1.0)[..., None]
    state[::2, 1] = state[::2, 0]
    start.set(keys.STATE, torch.cat([(state + noise)[..., :3], (state + noise)[..., 3:].abs()], -1))
    return start.set(keys.STEP, torch.randint(5, start.get(keys.STEP).shape, generator=rng))


def elements(seen: Any, group: str) -> Tensor:
    """[..., K, F] of one kind, in an order that does not depend on theirs; of several at the distance from which on
    they are left out, a device may see others."""
    away = seen[group][..., :2].norm(dim=-1)
    within = away < away.masked_fill(~seen[f"{group}_mask"], 0.0).amax(-1, keepdim=True) - 1e-4
    within |= ~seen[f"{group}_mask"].all(-1, keepdim=True)
    parts = [seen[group], seen[f"{group}_mask"][..., None]]
    parts += [seen[name].reshape(*seen[group].shape[:-1], -1) for name in GROUPS[group]]
    joined = torch.cat([part.double() for part in parts], -1) * within[..., None]
    weight = torch.from_numpy(np.random.default_rng(0).normal(size=joined.shape[-1]))
    order = (joined @ weight).argsort(-1)
    return joined.gather(-2, order[..., None].expand(joined.shape))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("counts", [(3, 60, 2), (16, 4000, 30)])
@torch.no_grad()
def test_a_device_sees_and_flags_the_same(
    counts: tuple[int, int, int], seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    segments = [crossing(6, seed=seed), straight_road(5, seed=seed), ring()]
    scenes = collate([scene(s, [0, 1], LaneGraph(s.road)) for s in segments])
    env = DrivingEnv(scenes, observation=ObservationConfig(*counts, **EVERYTHING))
    given = states(env, seed)
    found = env.at(given)
    for name, module in list(sys.modules.items()):
        if name.startswith("symphony.") and "on_host" in vars(module):
            monkeypatch.setattr(module, "on_host", lambda _: False)
    there = env.at(given)
    for flag in (keys.COLLISION, keys.OFFROAD):
        assert torch.equal(there[flag], found[flag])
        assert 0.02 < found[flag].float().mean() < 0.98
    seen, expected = there["agents", "observation"], found["agents", "observation"]
    assert set(seen.keys()) == set(expected.keys())
    for group in GROUPS:
        torch.testing.assert_close(elements(seen, group), elements(expected, group), atol=1e-4, rtol=0)
    grouped = {name for group, more in GROUPS.items() for name in (group, f"{group}_mask", *more)}
    for name in set(seen.keys()) - grouped:
        torch.testing.assert_close(seen[name], expected[name], atol=1e-4, rtol=0, msg=name)
