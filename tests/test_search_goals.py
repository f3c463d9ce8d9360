"""A search that keeps diversity: goals of branches, and rules that replace only the bad."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

import pytest
import torch

from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.agents import Agent, build_agent
from symphony.collectors import ReplaceBad
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig, EvaluateConfig, SearchConfig
from symphony.envs import DrivingEnv, collate, scene
from symphony.envs.scene import SceneBatch
from symphony.roadgraph import LaneGraph
from symphony.rollouts.driving import Simulation, simulation
from symphony.rollouts.unroll import start_states

BRANCHES = 8


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    logs = [crossing(4, seed=1, steps=9), crossing(4, seed=2, steps=9), straight_road(4, steps=9)]
    return collate([scene(log, [0, 1], LaneGraph(log.road)) for log in logs])


@pytest.fixture(scope="module")
def agent() -> Agent:
    torch.manual_seed(0)
    spec = AgentSpec(
        action_space="bicycle",
        dt=0.2,
        goals=True,
        agent=AgentConfig(num_points=12, hidden=8),
        discriminator=DiscriminatorConfig(hidden=8),
        searches=True,
        search=SearchConfig(test_branches=BRANCHES, prune_every=2),
    )
    return build_agent("tiny", spec)


def run(agent: Agent, scenes: SceneBatch, **changes: Any) -> Simulation:
    config = EvaluateConfig(rollouts=BRANCHES, goals="branch", seed=3)
    return simulation(agent, scenes, replace(config, **changes))


def test_branches_draw_the_goals_that_trees_of_one_would(agent: Agent, scenes: SceneBatch) -> None:
    env = DrivingEnv(scenes, agent.dynamics, agent.observation)
    settings: dict[str, Any] = {"seed": 3, "goals_per": "branch"}
    mine = start_states(env, agent.goals, trees=2, branches=4, **settings)
    alone = start_states(env, agent.goals, trees=8, branches=1, seed=3)
    assert torch.equal(mine.get(keys.GOAL).flatten(1, 2), alone.get(keys.GOAL)[:, :, 0])
    assert torch.equal(mine.get(keys.STREAM).flatten(1, 2), alone.get(keys.STREAM)[:, :, 0])
    # At a crossing they are not all the same.
    goal = mine.get(keys.GOAL)[0].flatten(0, 1)
    assert (goal != goal[0]).any()
    shared = start_states(env, agent.goals, trees=2, branches=4, seed=3).get(keys.GOAL)
    assert (shared == shared[:, :, :1]).all()


def test_with_nothing_to_replace_a_search_is_independent_rollouts(agent: Agent, scenes: SceneBatch) -> None:
    free = run(agent, scenes, search="none", goals="tree")
    searched = run(agent, scenes, rule="replace", threshold=1e9)
    # The best leaves come first; which they are is the same.
    for mine, theirs in zip(searched.rollouts.state, free.rollouts.state, strict=True):
        assert {path.numpy().tobytes() for path in mine} == {path.numpy().tobytes() for path in theirs}
    for goal, drawn in zip(searched.goal, free.goal, strict=True):
        assert sorted(goal.tolist()) == sorted(drawn.tolist())


@pytest.mark.parametrize("rule", ["best", "systematic", "replace"])
def test_a_leaf_follows_a_goal_that_was_drawn(agent: Agent, scenes: SceneBatch, rule: str) -> None:
    drawn = run(agent, scenes, search="none", goals="tree").goal
    left = run(agent, scenes, rule=rule, threshold=0.0).goal
    # [B, K, K, N]: every leaf beside every draw of its scene.
    same = (left[:, :, None] == drawn[:, None]).all(-1)
    assert same.any(-1).all()


class Middle:
    """Rule `replace` with a threshold in the middle of each tree's scores; keeps what it was asked."""

    takes_groups = True
    asked: ClassVar[list[tuple[torch.Tensor, torch.Tensor]]] = []

    def __call__(
        self, totals: torch.Tensor, noise: torch.Tensor, groups: torch.Tensor | None = None
    ) -> torch.Tensor:
        assert groups is not None
        above = totals - totals.median(-1, keepdim=True).values
        self.asked.append((above > 0, groups))
        return ReplaceBad(0.0)(above, noise, groups)


def test_copies_prefer_a_parent_of_the_same_goals(agent: Agent, scenes: SceneBatch) -> None:
    """A slot keeps its goals as long as any branch of the same goals is good."""
    Middle.asked.clear()
    run(agent, scenes, rule="test_search_goals:Middle")
    replaced = 0
    for (bad, groups), (_, later) in pairwise(Middle.asked):
        same = groups[..., :, None] == groups[..., None, :]
        kept = (same & ~bad[..., None, :]).any(-1)
        assert (later == groups)[kept].all()
        replaced += int((kept & bad).sum())
    assert replaced > 0


def test_without_goals_all_branches_are_of_one_group(scenes: SceneBatch, agent: Agent) -> None:
    assert agent.spec is not None
    torch.manual_seed(0)
    plain = build_agent("plain", replace(agent.spec, goals=False))
    found = run(plain, scenes, rule="replace", threshold=0.0)
    assert (found.goal == -1).all()
