"""Search, simulation and every loss on a device that isn't the CPU: nothing mixes devices or waits for it, and all
tensors are what signatures say."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from jaxtyping import Bool, Float, Int, jaxtyped
from tensordict.nn import TensorDictSequential
from torch import Tensor

from helpers_device import NAME, PretendDevice, on, pretend
from helpers_losses import CASES, LOGGED, ROWS, SCENES, batch_of, losses, searched, spec
from helpers_processes import forget, output_of
from helpers_shapes import tensors_only
from symphony import keys, objectives
from symphony.agents import build_agent
from symphony.collectors import KeepAll, KeepBest, PruningRule, ReplaceBad, Systematic
from symphony.collectors.rules import checked
from symphony.envs import DrivingEnv, ObservationConfig
from symphony.modules import SeededNoise
from symphony.rollouts.background import CarFollower
from symphony.rollouts.unroll import simulate, start_states

FEW = 7  # constants that are made once, in however many steps


@contextmanager
def world(space: Any = "bicycle") -> Iterator[tuple[PretendDevice, Any, DrivingEnv]]:
    """A device, and an agent and an environment on it."""
    agent = build_agent("agent", spec(space))
    env = DrivingEnv(SCENES, agent.dynamics, agent.observation)
    with pretend() as device:
        for module in agent.modules.values():
            on(device, module)
        yield device, agent, on(device, env)


@pytest.mark.parametrize("space", ["bicycle", "displacement"])
def test_simulations_stay_on_the_device(space: Any) -> None:
    with world(space) as (device, agent, env):
        policy = TensorDictSequential(SeededNoise(0, agent.dynamics.numbers), agent.policy)
        found = simulate(env, policy, start_states(env, agent.goals, trees=2, branches=1, seed=0))
        assert found.state.shape == (2, 2, 1, LOGGED, 2, 4)
        assert {part.device.type for part in found} == {NAME}
        assert device.waits == []
        assert device.constants < FEW


def test_others_that_a_rule_drives_stay_on_the_device() -> None:
    scenes = SCENES.clone()
    scenes.background = scenes.interactive_valid.clone()
    env = DrivingEnv(scenes, observation=ObservationConfig.nothing())
    follow = CarFollower(env)  # looks at the maps once
    with pretend() as device:
        on(device, env)
        follow.routes = type(follow.routes)(*(on(device, part) for part in follow.routes))
        number = torch.arange(2, device=device.device)
        state = env.start(number, number)
        assert follow(state)[keys.BACKGROUND].device.type == NAME
        assert device.waits == []
        assert device.constants < FEW


def test_searches_stay_on_the_device() -> None:
    with world() as (device, agent, env):
        start = start_states(env, agent.goals, trees=1, branches=4, seed=0)
        found = searched(agent, env, Systematic(0.6), start)
        assert found.trajectories.shape == (2, 1, 3, LOGGED - 1)
        assert found.totals.device.type == NAME
        assert device.waits == []
        assert device.constants < FEW


@pytest.mark.parametrize("rule", [KeepBest(0.5), Systematic(0.6), KeepAll(), ReplaceBad(0.0)], ids=repr)
def test_rules_stay_on_the_device(rule: PruningRule) -> None:
    groups = torch.arange(8).expand(2, 3, 8) % 2
    with pretend() as device:
        totals, noise = torch.zeros(2, 3, 8, device=device.device), torch.zeros(2, 3, device=device.device)
        parents = checked(rule, totals, noise, on(device, groups))
        assert parents.device.type == NAME
        assert device.waits == []


@pytest.mark.parametrize("space", sorted({space for _, space in CASES}))
def test_losses_and_their_gradients_stay_on_the_device(space: str) -> None:
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
        assert device.constants < FEW


def test_every_loss_is_among_them() -> None:

    with world() as (_, agent, env):
        known = {type(loss) for loss in losses(agent, env).values()}
    there = [getattr(objectives, name) for name in objectives.__all__ if name.endswith("Loss")]
    assert known == set(there)


def instrumented() -> None:
    """Take every loss once, as :mod:`helpers_losses` does as a program."""
    forget("symphony", *(path.stem for path in Path(__file__).parent.glob("helpers_*.py")))
    runpy.run_module("helpers_losses", run_name="__main__")


def test_what_is_taken_and_returned_is_what_signatures_say(tmp_path: Path) -> None:
    """All that runs for a step and a loss, with shapes and kinds of numbers checked."""
    # In a process of its own, as the package must be instrumented when it is imported.
    lines = output_of(instrumented, said=tmp_path / "said").splitlines()
    assert [tuple(line.split()) for line in lines] == CASES


@jaxtyped(typechecker=tensors_only)
def counted(
    scores: Float[Tensor, "*b N"], valid: Bool[Tensor, "*b N"] | None, *more: Float[Tensor, "*b"]
) -> tuple[Int[Tensor, "*b"], dict[str, Float[Tensor, "*b"]]]:
    """Whatever the last argument is, comes back."""
    number = torch.zeros(scores.shape[:-1], dtype=torch.int64)
    return number, {"more": more[-1] if more else scores.mean(-1)}


def test_the_check_finds_what_is_wrong() -> None:
    scores, flags = torch.zeros(2, 3), torch.ones(2, 3, dtype=torch.bool)
    counted(scores, flags, scores[:, 0])
    counted(scores, None)
    for arguments in (
        [scores.long(), None],
        [scores, flags[:, :2]],
        [scores, flags.float()],
        [scores, None, scores],
    ):
        with pytest.raises(TypeError):
            counted(*arguments)
