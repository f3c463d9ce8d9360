"""What an accelerator or a compiler makes of a state is what the CPU, which looks only where it must, makes of it."""

from __future__ import annotations

import pickle
import sys
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import assert_close
from torch import Tensor

from helpers_losses import CASES, batch_for, losses, searched, world
from helpers_segments import crossing, ring, straight_road
from symphony import keys
from symphony.collectors import Systematic
from symphony.envs import Displacement, DrivingEnv, ObservationConfig, collate, scene
from symphony.roadgraph import LaneGraph
from test_cells import overpass

EVERYTHING = {"route": True, "along": True, "gaps": True, "clearance": True, "foresight": (0.5, 1.0)}
GROUPS = {"points": (), "lights": (), "objects": ("gap", "gap_ahead", "along")}


def as_on_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, module in list(sys.modules.items()):
        if name.startswith("symphony.") and "on_host" in vars(module):
            monkeypatch.setattr(module, "on_host", lambda _: False)


def states(env: DrivingEnv, seed: int) -> Any:
    """Return states of agents near where they began, every other time both at one place: some beside the road."""
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
    """[..., K, F] of one kind, in an order that does not depend on theirs."""
    parts = [seen[group], seen[f"{group}_mask"][..., None]]
    parts += [seen[name].reshape(*seen[group].shape[:-1], -1) for name in GROUPS[group]]
    joined = torch.cat([part.double() for part in parts], -1)
    weight = torch.from_numpy(np.random.default_rng(0).normal(size=joined.shape[-1]))
    order = (joined @ weight).argsort(-1)
    return joined.gather(-2, order[..., None].expand(joined.shape))


@pytest.mark.parametrize(("counts", "seed"), [((3, 60, 2), 0), ((3, 60, 2), 1), ((16, 4000, 30), 0)])
@torch.no_grad()
def test_a_device_sees_and_flags_the_same(counts, seed, monkeypatch):
    segments = [crossing(6, seed=seed), straight_road(5, seed=seed), ring(), overpass()]
    scenes = collate([scene(s, [0, 1], LaneGraph(s.road)) for s in segments])
    env = DrivingEnv(scenes, observation=ObservationConfig(*counts, **EVERYTHING))
    given = states(env, seed)
    found = env.at(given)
    as_on_a_device(monkeypatch)
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


@pytest.mark.parametrize(("name", "space"), CASES)
def test_a_device_learns_the_same(name, space, monkeypatch):
    agent, env = world(space)
    loss, given = losses(agent, env)[name], batch_for(name, env)
    given[keys.GOAL_SET] = given[keys.ROUTES_MASK] & (torch.arange(given[keys.ROUTES_MASK].shape[-1]) == 0)
    found = differentiated(loss, given)
    as_on_a_device(monkeypatch)
    largest = max(float(gradient.abs().max()) for gradient in found[1:])
    assert largest > 1e-6
    for there, here in zip(differentiated(loss, given), found, strict=True):
        torch.testing.assert_close(there, here, atol=0.05 * largest, rtol=1e-4)


def differentiated(loss: Any, given: Any) -> list[Tensor]:
    loss.zero_grad()
    torch.manual_seed(0)
    out = loss(given.copy())
    total = sum(value for key, value in out.items() if key.startswith("loss"))
    total.backward()
    gradients = [value.grad.clone() for value in loss.parameters() if value.grad is not None]
    return [total.detach(), *gradients]


@torch.no_grad()
def test_a_device_finds_the_same(monkeypatch):
    agent, env = world("bicycle")
    found = searched(agent, env, Systematic(0.6))
    as_on_a_device(monkeypatch)
    there = searched(agent, env, Systematic(0.6))
    for key in (keys.STATE, keys.ACTION, keys.VALID):
        assert torch.equal(there.trajectories[key], found.trajectories[key])
    torch.testing.assert_close(there.totals, found.totals, atol=1e-4, rtol=0)


@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
def test_an_environment_is_compiled_where_it_is_and_its_copies_are_not():
    """Nor is the gradient another, where what is driven depends on the start."""
    torch.compiler.reset()
    scenes = collate([scene(straight_road(), [0, 1])])
    env = DrivingEnv(scenes, Displacement(), ObservationConfig.nothing())
    calls = []
    kept = {"backend": lambda graph, _: calls.append(graph) or graph.forward, "fullgraph": True}

    def driven(env: DrivingEnv) -> Any:
        torch.manual_seed(0)
        env.set_seed(0)
        start = (begin := env.reset()).set(keys.STATE, begin[keys.STATE].requires_grad_())
        found = env.rollout(4, auto_reset=False, tensordict=start)
        (slope,) = torch.autograd.grad(found["next", *keys.STATE].sum(), start[keys.STATE])
        return found.set("slope", slope.expand(4, 2, 4)).detach()

    plain = driven(env)
    env.compile(**kept)
    # Again is not twice; and a batch without dimensions, as rollouts have it, compiles, too.
    env.compile(**kept)
    copy = pickle.loads(pickle.dumps(env))  # noqa: S301 - just pickled
    for tried in (env, env, copy):
        assert_close(driven(tried), plain, rtol=0, atol=1e-5)
        assert len(calls) == 1
    assert copy._step.__func__ is DrivingEnv._step
