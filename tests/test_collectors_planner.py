"""The beam search as a planner."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import CatFrames, StepCounter, TransformedEnv
from torchrl.modules import MPCPlannerBase

from helpers_collectors import Mass
from symphony.collectors import BeamSearchPlanner, KeepAll, KeepBest, with_rows

ROWS, HORIZON, BRANCHES = 3, 6, 8


def hashed(td: TensorDictBase) -> TensorDictBase:
    """Actions of each branch, a function of its slot alone."""
    slots = torch.arange(td.shape[-1]).float()[:, None]
    return td.set("action", (slots * 12.9898 + td["place"].sum(-1, keepdim=True) * 0).sin())


def returns(env: Mass, start: TensorDictBase, value: Any = None) -> tuple[Tensor, Tensor]:
    """Of each slot the return of its constant action, and that action."""
    now, total, over = start.unsqueeze(-1).expand(*start.shape, BRANCHES).clone(), 0.0, None
    action = hashed(now)["action"].clone()
    for _ in range(HORIZON):
        after = env.step(now.clone().set("action", action))["next"]
        over = torch.zeros_like(after["done"]) if over is None else over
        total = total + torch.where(over, 0.0, after["reward"])
        over = over | after["done"]
        now = after.exclude("reward")
    ahead = 0.0 if value is None else torch.where(over, 0.0, value(now["place"]))
    return (total + ahead).squeeze(-1), action


@pytest.mark.parametrize("valued", [False, True])
def test_without_pruning_it_is_the_best_of_all_branches(valued: bool) -> None:
    env = Mass()
    start = with_rows(env, [ROWS]).reset()

    def worth(place: Tensor) -> Tensor:
        return 3.0 * place[..., :1]

    network = TensorDictModule(worth, ["place"], ["state_value"]) if valued else None
    how = {
        "policy": hashed,
        "value_network": network,
        "rule": KeepAll(),
        "prune_every": 2,
        "temperature": 0.5,
    }
    planner = BeamSearchPlanner(env, HORIZON, BRANCHES, **how)
    planned = planner(start.clone())
    expected, actions = returns(env, start, worth if valued else None)
    best = expected.argmax(-1)
    torch.testing.assert_close(planned["action"], actions[torch.arange(ROWS), best])
    torch.testing.assert_close(planned["planner", "weight"], torch.softmax(expected / 0.5, -1))
    torch.testing.assert_close(planned["planner", "value"].squeeze(-1), expected.amax(-1))
    torch.testing.assert_close(planned["planner", "action"], actions)


@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs:UserWarning")
@pytest.mark.parametrize("outer", [None, StepCounter, "frames"])
def test_it_is_a_policy_of_torchrl(outer: Any) -> None:
    """In rollouts and collectors, through transforms; it keeps a point within its bounds."""

    def make() -> Any:
        env = with_rows(Mass(limit=1.0), [ROWS])
        if outer is None:
            return env
        frames = CatFrames(2, -1, in_keys=["observation"])
        return TransformedEnv(env, frames if outer == "frames" else outer())

    planner = BeamSearchPlanner(make(), HORIZON, 32, rule=KeepBest(0.5), prune_every=3)
    assert isinstance(planner, MPCPlannerBase)
    torch.manual_seed(0)
    planned, drawn = (make().rollout(20, policy, break_when_any_done=False) for policy in (planner, None))
    assert planned["next", "reward"].mean() > drawn["next", "reward"].mean() + 0.2
    torch.testing.assert_close(planned["planner", "weight"].sum(-1), torch.ones(ROWS, 20))
    how = {"frames_per_batch": ROWS * 4, "total_frames": ROWS * 4, "auto_register_policy_transforms": False}
    collector = Collector(make(), planner, **how)
    assert next(iter(collector))["planner", "action"].shape == (ROWS, 4, 32, 1)
