"""The search through the driving environment, the evaluator's kinds of it, and the goals that branches follow."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import step_mdp

from helpers_agents import make_agent
from helpers_segments import crossing, make_road, make_segment, straight_road
from helpers_store import fill
from symphony import keys
from symphony.agents import Agent
from symphony.collectors import BeamSearchResult, KeepBest, ReplaceBad
from symphony.config import EvaluateConfig, SearchConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv, scene
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.learning.demonstrations import SceneDataset
from symphony.modules import SeededNoise
from symphony.rollouts import simulate
from symphony.rollouts.driving import Simulation, simulation
from symphony.rollouts.search import search
from symphony.rollouts.unroll import Rollouts, draw_goals, rollouts_of, start_states

SEARCH = {"branches": 4, "test_branches": 4, "prune_every": 2}
KINDS = ("none", "tree", "backtrack", "best")
SEGMENTS = [
    crossing(3, seed=1, steps=5),
    straight_road(4, seed=0, steps=8),
    crossing(4, seed=2, steps=6),
    straight_road(3, seed=3, steps=5),
]
DECISIONS = 7


def searching(agent: Agent, **changes: Any) -> Agent:
    """The same agent, trained with another search."""
    assert agent.spec is not None
    return replace(agent, spec=replace(agent.spec, search=replace(agent.search, **changes)))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SegmentStore:
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, SEGMENTS)
    return SegmentStore(path)


@pytest.fixture(scope="module")
def dataset(store: SegmentStore) -> SceneDataset:
    return SceneDataset(store, 2, Bicycle(), routes=True)


@pytest.fixture(scope="module")
def scenes(dataset: SceneDataset) -> SceneBatch:
    return dataset.scenes(range(4))


@pytest.fixture(scope="module")
def agent() -> Agent:
    return make_agent(search=SEARCH)


@pytest.fixture(scope="module")
def env(scenes: SceneBatch, agent: Agent) -> DrivingEnv:
    return DrivingEnv(scenes, agent.dynamics, agent.observation)


def start_of(env: DrivingEnv, branches: int) -> TensorDict:
    rows = torch.arange(len(env.scenes))[:, None].expand(-1, branches)
    return env.with_goals(env.start(rows, torch.arange(branches).expand(rows.shape)))


def look(env: DrivingEnv, agent: Agent, start: TensorDict, **changes: Any) -> BeamSearchResult:
    settings: dict[str, Any] = {"seed": 5, "rule": KeepBest(0.5), "prune_every": 2, **changes}
    with torch.no_grad():
        return search(env, agent.policy, agent.discriminator, start, **settings)


def plain(env: DrivingEnv, agent: Agent, start: TensorDict) -> Rollouts:
    return simulate(env, TensorDictSequential(SeededNoise(5), agent.policy), start)


def driven(agent: Agent, scenes: SceneBatch, kind: Any = "tree", **changes: Any) -> Simulation:
    return simulation(agent, scenes, EvaluateConfig(**{"search": kind, "rollouts": 4, **changes}))


def same(a: Rollouts, b: Rollouts) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def scored(env: DrivingEnv, agent: Agent, start: TensorDict, states: Tensor) -> Tensor:
    """Scores [B, S, T, N] of states [B, S, T + 1, N, 4], the first left out."""
    steps = states.shape[2] - 1
    whole = [*start.shape, steps]
    state = start.select(keys.SCENE, keys.STREAM, keys.VALID, keys.GOAL).unsqueeze(-1).expand(*whole).clone()
    before, come = env._read(start), []
    for t in range(steps):
        come.append(env._progress(before, states[:, :, t + 1]))
        before = before._replace(state=states[:, :, t + 1], progress=come[-1])
    state.set(keys.PROGRESS, torch.stack(come, 2)).set(keys.STATE, states[:, :, 1:])
    state.set(keys.STEP, torch.arange(1, steps + 1)[:, None].expand(*whole, 1))
    with torch.no_grad():
        assert agent.discriminator is not None
        return agent.discriminator(env.at(state)).get(keys.SCORE)


def test_one_branch_is_a_plain_rollout(env: DrivingEnv, agent: Agent) -> None:
    start = start_of(env, 1)
    assert same(rollouts_of(env, start, look(env, agent, start).trajectories), plain(env, agent, start))


def test_leaves_follow_their_actions_and_goals_and_are_scored_as_they_are(
    env: DrivingEnv, agent: Agent
) -> None:
    seen: list[Tensor] = []

    def spy(goal: Tensor) -> None:
        seen.append(goal.clone())

    start = start_of(env, 4)
    policy = TensorDictSequential(TensorDictModule(spy, [keys.GOAL], []), agent.policy)
    result = look(env, replace(agent, policy=policy), start, keep_tree=True)
    # What the policy is shown after forks is still the route of the start.
    assert len(seen) == DECISIONS
    assert all(torch.equal(goal, start[keys.GOAL]) for goal in seen)
    # Some leaf must have been simulated in more than one slot, else nothing was forked.
    assert (result.slots != result.slots[:, :1]).any()
    found, now = rollouts_of(env, start, result.trajectories), start
    for t, action in enumerate(result.trajectories[keys.ACTION].unbind(2)):
        now = step_mdp(env.step(now.clone(False).set(keys.ACTION, action)))
        assert torch.equal(now[keys.STATE], found.state[:, :, t + 1])
        for key, flags in ((keys.COLLISION, found.collision), (keys.OFFROAD, found.offroad)):
            assert torch.equal(now[key].squeeze(-1), flags[:, :, t])
    assert result.tree is not None
    tree = torch.cat([start[keys.STATE][:, :, None], result.tree[("next", *keys.STATE)]], 2)
    counted = found.counted.any(-1)
    for states, scores in ((found.state, result.scores), (tree, result.simulated_scores)):
        expected = scored(env, agent, start, states)
        torch.testing.assert_close(scores[counted], expected[counted], atol=1e-6, rtol=1e-5)
        assert (scores[~counted] == 0).all()
    assert not counted.all()


# Of a seed, whatever lies beside it


@pytest.mark.parametrize(("goals", "kind"), [(False, "tree"), *((True, kind) for kind in KINDS)])
def test_no_rollout_depends_on_batch_or_order(dataset: SceneDataset, kind: Any, goals: bool) -> None:
    agent, order = make_agent(search=SEARCH, goals=goals), [2, 0, 3, 1]
    scenes = dataset.scenes(range(4))
    whole = driven(agent, scenes, kind, trees=2, seed=3)
    mixed = driven(agent, dataset.scenes(order), kind, trees=2, seed=3)
    again = driven(agent, scenes, kind, trees=2, seed=4)
    assert not torch.equal(again.rollouts.state, whole.rollouts.state)
    for item in range(4):
        alone = driven(agent, dataset.scenes([item]), kind, trees=2, seed=3)
        steps = alone.rollouts.counted.shape[2]
        for name in Rollouts._fields:
            value, place = getattr(whole.rollouts, name)[item], order.index(item)
            cut = steps + (name == "state")
            assert torch.equal(value[:, :cut], getattr(alone.rollouts, name)[0])
            assert torch.equal(value[:, :cut], getattr(mixed.rollouts, name)[place][:, :cut])
        assert torch.equal(whole.goal[item], alone.goal[0])
    found = whole.rollouts
    assert found.state.shape == (4, 4, DECISIONS + 1, 2, 4)
    first = scenes.log_state[:, 0].gather(1, scenes.interactive[..., None].expand(4, 2, 5))
    assert torch.equal(found.state[:, :, 0, :, :3], first[:, None, :, :3].expand(-1, 4, -1, -1))
    step = (found.state[:, :, 1:, :, :2] - found.state[:, :, :-1, :, :2]).norm(dim=-1)
    assert step.max() < 6  # 30 m/s; elsewhere in another segment it would be tens of metres
    ends = torch.tensor([segment.num_steps - 1 for segment in SEGMENTS])
    assert torch.equal(found.counted.sum(2), ends[:, None, None].expand(4, 4, 2))


@pytest.mark.parametrize(("rule", "trees"), [("replace", 1), ("replace", 2), ("best", 2)])
def test_longer_segments_beside_it_choose_no_leaves(
    dataset: SceneDataset, agent: Agent, rule: Any, trees: int
) -> None:
    agent = searching(agent, rule=rule, threshold=0.1)
    together = driven(agent, dataset.scenes(range(4)), "agent", trees=trees)
    assert together.search is not None
    for item in range(4):
        alone = driven(agent, dataset.scenes([item]), "agent", trees=trees)
        steps = alone.rollouts.state.shape[2]
        assert torch.equal(together.rollouts.state[item][:, :steps], alone.rollouts.state[0])
        assert alone.search is not None
        periods = alone.search.slots.shape[-2]
        assert torch.equal(together.search.slots[item][:, :periods], alone.search.slots[0])
        scores = together.search.scores[item][:, :, : steps - 1]
        torch.testing.assert_close(scores, alone.search.scores[0], rtol=1e-5, atol=1e-5)


def test_trees_of_one_branch_are_independent_rollouts(scenes: SceneBatch, agent: Agent) -> None:
    none = driven(agent, scenes, "none", rollouts=3).rollouts
    assert same(none, driven(agent, scenes, rollouts=3, trees=3, branches=1).rollouts)


@pytest.mark.parametrize("score", ["discriminator", "rule"])
def test_more_trees_keep_the_first_ones(scenes: SceneBatch, agent: Agent, score: Any) -> None:
    few = driven(agent, scenes, score=score, trees=2).rollouts
    many = driven(agent, scenes, score=score, rollouts=6, trees=3).rollouts
    assert same(few, Rollouts(*(value[:, :4] for value in many)))


@pytest.mark.parametrize("changes", [{"rule": "systematic"}, {"prune_every": 3}, {"temperature": 0.01}])
def test_the_evaluation_decides_the_pruning(
    scenes: SceneBatch, agent: Agent, changes: dict[str, Any]
) -> None:
    agent = searching(agent, rule="systematic" if "temperature" in changes else "best")
    found = driven(agent, scenes, **changes).rollouts
    assert same(found, driven(searching(agent, **changes), scenes).rollouts)
    assert not same(found, driven(agent, scenes).rollouts)


# Goals


def test_neither_discriminator_nor_search_touches_the_goals(
    scenes: SceneBatch, agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Tensor] = []

    def noted(*args: Any) -> Tensor:
        drawn.append(draw_goals(*args))
        return drawn[-1]

    monkeypatch.setattr(sys.modules["symphony.rollouts.unroll"], "draw_goals", noted)
    other = replace(agent, discriminator=make_agent(seed=1, search=SEARCH).discriminator)
    states = [driven(agent, scenes, "none", rollouts=5).rollouts.state]
    assert len(drawn[0][1, :, 0].unique()) > 1  # else there is nothing to bias
    for kind, score, scorer in (
        ("tree", "discriminator", agent),
        ("tree", "discriminator", other),
        ("tree", "flags", agent),
        ("best", "discriminator", other),
    ):
        how: dict[str, Any] = {"score": score, "rollouts": 5, "branches": 3, "rule": "best"}
        how["trees"] = 1 if kind == "best" else 5
        states.append(driven(scorer, scenes, kind, **how).rollouts.state)
    assert all(torch.equal(goals, drawn[0]) for goals in drawn)
    # Each of them does change what survives.
    assert all(not torch.equal(a, b) for a, b in pairwise(states))


def test_goals_depend_on_seed_scene_and_tree_alone(env: DrivingEnv, agent: Agent) -> None:
    tree = torch.arange(40).expand(4, 40)
    start = env.start(torch.arange(4)[:, None].expand(4, 40), 1000 + tree)
    whole = draw_goals(env, agent.goals, start, 7, tree)
    # Another stream (branch), another batch, another order: the same goals.
    rows = torch.randperm(160, generator=torch.Generator().manual_seed(0))[:50]
    other = env.start(rows // 40, 3)
    assert torch.equal(draw_goals(env, agent.goals, other, 7, rows % 40), whole.flatten(0, 1)[rows])
    assert not torch.equal(draw_goals(env, agent.goals, start, 8, tree), whole)
    counts = env.scenes.route_count > 0
    assert (whole[..., None] == torch.arange(counts.shape[-1])).any(1)[counts].float().mean() > 0.9
    assert counts.gather(-1, whole.transpose(1, 2)).all()


def test_logged_goals_are_the_logged_routes(scenes: SceneBatch, agent: Agent) -> None:
    goals = driven(agent, scenes, "none", logged_goals=True).goal
    assert torch.equal(goals, scenes.route_logged[:, None].expand_as(goals))


def test_agents_without_any_route_are_no_error(agent: Agent) -> None:
    segment = straight_road(3, steps=9)
    position = segment.position + np.array([0, 200, 0], np.float32)
    data = scene(segment.replace(position=position), [0, 1], None)
    assert (driven(make_agent(search=SEARCH, goals=False), data).goal == -1).all()
    from symphony.roadgraph import LaneGraph

    nowhere = scene(segment.replace(position=position), [0, 1], LaneGraph(segment.road))
    assert driven(agent, nowhere, rollouts=2).rollouts.state.isfinite().all()


def branching(agent: Agent, scenes: SceneBatch, **changes: Any) -> Simulation:
    """Eight branches, each of which draws its own goals."""
    how = {"search": "tree", "rollouts": 8, "branches": 8, "goals": "branch", "seed": 3, **changes}
    return simulation(agent, scenes, EvaluateConfig(**how))


def test_branches_draw_the_goals_that_trees_of_one_would(env: DrivingEnv, agent: Agent) -> None:
    settings: dict[str, Any] = {"seed": 3, "goals_per": "branch"}
    mine = start_states(env, agent.goals, trees=2, branches=4, **settings)
    alone = start_states(env, agent.goals, trees=8, branches=1, seed=3)
    for key in (keys.GOAL, keys.STREAM):
        assert torch.equal(mine.get(key).flatten(1, 2), alone.get(key)[:, :, 0])
    goal = mine.get(keys.GOAL)[0].flatten(0, 1)
    assert (goal != goal[0]).any()  # at a crossing
    shared = start_states(env, agent.goals, trees=2, branches=4, seed=3).get(keys.GOAL)
    assert (shared == shared[:, :, :1]).all()


def test_with_nothing_to_replace_a_search_is_independent_rollouts(agent: Agent, scenes: SceneBatch) -> None:
    free = branching(agent, scenes, search="none", goals="tree")
    searched = branching(agent, scenes, rule="replace", threshold=1e9)
    # The best leaves come first; which they are is the same.
    for mine, theirs in zip(searched.rollouts.state, free.rollouts.state, strict=True):
        assert {path.numpy().tobytes() for path in mine} == {path.numpy().tobytes() for path in theirs}
    for rule in ("best", "systematic", "replace"):
        left = branching(agent, scenes, rule=rule, threshold=0.0).goal
        # [B, K, K, N]: every leaf beside every draw of its scene.
        assert (left[:, :, None] == free.goal[:, None]).all(-1).any(-1).all()


class Middle:
    """Rule `replace` with a threshold in the middle of each tree's scores; keeps what it was asked."""

    takes_groups = True
    asked: ClassVar[list[tuple[Tensor, Tensor]]] = []

    def __call__(self, totals: Tensor, noise: Tensor, groups: Tensor | None = None) -> Tensor:
        assert groups is not None
        above = totals - totals.median(-1, keepdim=True).values
        self.asked.append((above > 0, groups))
        return ReplaceBad(0.0)(above, noise, groups)


def test_copies_prefer_a_parent_of_the_same_goals(agent: Agent, scenes: SceneBatch) -> None:
    """A slot keeps its goals as long as any branch of the same goals is good."""
    Middle.asked.clear()
    branching(agent, scenes, rule="test_search:Middle")
    replaced = 0
    asked = sys.modules["test_search"].Middle.asked
    for (bad, groups), (_, later) in pairwise(asked):
        same_goals = groups[..., :, None] == groups[..., None, :]
        kept = (same_goals & ~bad[..., None, :]).any(-1)
        assert (later == groups)[kept].all()
        replaced += int((kept & bad).sum())
    assert replaced > 0


# What is looked for


def test_best_is_the_best_of_independent_rollouts(scenes: SceneBatch, env: DrivingEnv, agent: Agent) -> None:
    found = driven(agent, scenes, "best", rollouts=2, branches=3, logged_goals=True, seed=5).rollouts
    start = start_of(env, 6)
    every = plain(env, agent, start)
    scores = scored(env, agent, start, every.state).masked_fill(~every.counted, -torch.inf)
    best = scores.amax(2).sum(-1).unflatten(1, (2, 3)).argmin(-1) + 3 * torch.arange(2)
    for b in range(4):
        assert same(Rollouts(*(part[b] for part in found)), Rollouts(*(part[b, best[b]] for part in every)))
    assert best.unique().numel() > 2


def blocked() -> RunSegment:
    """On a wide road the ego follows two cars that brake to a stand; the first of them is interactive too."""
    steps, dt = 26, 0.2
    time = np.arange(steps) * dt
    x = np.arange(-60, 200, 2.0)
    line, side = np.stack([x, 0 * x], -1), np.array([0, 9.0])
    road = make_road([line], boundary=[line - side, (line + side)[::-1]])
    speed = np.stack([np.full(steps, 7.0), np.maximum(0, 7 - 2 * time), np.maximum(0, 6 - 3 * time)])
    place = np.array([[0.0], [18.0], [32.0]]) + np.cumsum(speed * dt, 1) - speed * dt
    flat = np.zeros_like(place)
    velocity = np.stack([speed, flat], -1)
    return make_segment(road, np.stack([place, flat], -1), flat, velocity, dt, "blocked")


@pytest.mark.parametrize("trained", [1.0, -3.0])
def test_an_oracle_replaces_what_is_flagged_whatever_the_agent_was_trained_with(trained: float) -> None:
    """Flags are 1, as is a usual threshold of a discriminator's scores; one agent that is bad makes a branch bad."""
    settings = SearchConfig(rule="replace", threshold=trained)
    for score in ("flags", "rule"):
        assert EvaluateConfig(score=score).pruning(settings).threshold == 0.0
        assert EvaluateConfig(score=score, threshold=2.0).pruning(settings).threshold == 2.0
    assert EvaluateConfig(search="tree").pruning(settings).threshold == trained
    agent, data = make_agent(search=SEARCH, goals=False), scene(blocked(), [0, 1])
    how: dict[str, Any] = {"score": "flags", "rule": "replace", "rollouts": 16, "trees": 2, "branches": 8}
    rates = []
    for kind in ("none", "tree"):
        found = driven(agent, data, kind, **how).rollouts
        rates.append(float((found.collision & found.counted).any(-1).any(-1).float().mean()))
    assert rates[0] > 0.3
    assert rates[1] < 0.5 * rates[0]


def test_kinds_and_sizes_that_do_not_fit_are_refused(store: SegmentStore, agent: Agent) -> None:
    without = replace(agent, discriminator=None)
    for kind in ("tree", "best", "backtrack"):
        with pytest.raises(ConfigError, match="needs an agent with a discriminator"):
            evaluate(without, store, EvaluateConfig(search=kind))
    with pytest.raises(ConfigError, match="less than 16 rollouts"):
        evaluate(agent, store, EvaluateConfig(search="tree", branches=3, trees=2))
    wrong: list[Callable[[], EvaluateConfig]] = [
        lambda: EvaluateConfig(rollouts=16, trees=3),
        lambda: EvaluateConfig(trees=0),
        lambda: EvaluateConfig(branches=-1),
        lambda: EvaluateConfig(search="orcale"),  # type: ignore[arg-type]
    ]
    for make in wrong:
        with pytest.raises(ConfigError):
            make()
