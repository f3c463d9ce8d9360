"""The search through the driving environment, and the evaluator's kinds of it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import step_mdp

from helpers_segments import crossing, make_road, make_segment, straight_road
from symphony import keys
from symphony.agents import Agent, build_agent
from symphony.collectors import BeamSearchResult, KeepBest
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig, EvaluateConfig, SearchConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs import Bicycle, DrivingEnv, scene
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.learning.demonstrations import SceneDataset
from symphony.modules import SeededNoise
from symphony.rollouts import simulate
from symphony.rollouts.driving import simulate_batch, simulation
from symphony.rollouts.search import flag_score, search
from symphony.rollouts.unroll import Rollouts, draw_goals, rollouts_of

EVERY = 2
SEARCH = SearchConfig(branches=4, test_branches=4, prune_every=EVERY)
KINDS = ("none", "tree", "backtrack", "best")


def make_agent(seed: int = 0, discriminator: int = 0, **changes: Any) -> Agent:
    """A tiny untrained agent that follows routes; ``discriminator`` is the seed of that alone."""
    spec = AgentSpec(
        action_space="bicycle",
        dt=0.2,
        goals=True,
        agent=AgentConfig(num_points=12, hidden=8),
        discriminator=DiscriminatorConfig(hidden=8),
        searches=True,
        search=SEARCH,
    )
    spec = replace(spec, **changes)
    torch.manual_seed(seed)
    agent = build_agent("tiny", spec)
    torch.manual_seed(discriminator)
    return replace(agent, discriminator=build_agent("tiny", spec).discriminator)


def searching(agent: Agent, **changes: Any) -> Agent:
    """The same agent, trained with another search."""
    assert agent.spec is not None
    return replace(agent, spec=replace(agent.spec, search=replace(agent.search, **changes)))


SEGMENTS = [
    crossing(3, seed=1, steps=5),
    straight_road(4, seed=0, steps=8),
    crossing(4, seed=2, steps=6),
    straight_road(3, seed=3, steps=5),
]
DECISIONS = 7


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SegmentStore:
    path = tmp_path_factory.mktemp("data") / "store"
    with StoreWriter(path) as writer:
        for segment in SEGMENTS:
            writer.append(segment)
    return SegmentStore(path)


@pytest.fixture(scope="module")
def dataset(store: SegmentStore) -> SceneDataset:
    return SceneDataset(store, 2, Bicycle(), routes=True)


@pytest.fixture(scope="module")
def agent() -> Agent:
    return make_agent()


@pytest.fixture(scope="module")
def env(dataset: SceneDataset, agent: Agent) -> DrivingEnv:
    return DrivingEnv(dataset.scenes(range(4)), agent.dynamics, agent.observation)


def start_of(env: DrivingEnv, branches: int) -> TensorDict:
    rows = torch.arange(len(env.scenes))[:, None].expand(-1, branches)
    return env.with_goals(env.start(rows, torch.arange(branches).expand(rows.shape)))


def look(env: DrivingEnv, agent: Agent, start: TensorDict, **changes: Any) -> BeamSearchResult:
    settings: dict[str, Any] = {"seed": 5, "rule": KeepBest(0.5), "prune_every": EVERY}
    with torch.no_grad():
        return search(env, agent.policy, agent.discriminator, start, **{**settings, **changes})


def plain(env: DrivingEnv, agent: Agent, start: TensorDict, seed: int = 5) -> Rollouts:
    return simulate(env, TensorDictSequential(SeededNoise(seed), agent.policy), start)


def same(a: Rollouts, b: Rollouts) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def part(rollouts: Rollouts, *index: Any) -> Rollouts:
    return Rollouts(*(value[index] for value in rollouts))


def scored(env: DrivingEnv, agent: Agent, start: TensorDict, states: Tensor) -> Tensor:
    """Scores [B, S, T, N] of states [B, S, T + 1, N, 4], the first left out."""
    steps = states.shape[2] - 1
    whole = [*start.shape, steps]
    state = start.select(keys.SCENE, keys.STREAM, keys.VALID, keys.GOAL).unsqueeze(-1).expand(*whole).clone()
    before, come = env._read(start), []
    for t in range(steps):
        now = env._progress(before, states[:, :, t + 1])
        before = before._replace(state=states[:, :, t + 1], progress=now)
        come.append(now)
    state.set(keys.PROGRESS, torch.stack(come, 2))
    state.set(keys.STATE, states[:, :, 1:])
    state.set(keys.STEP, torch.arange(1, steps + 1)[:, None].expand(*whole, 1))
    with torch.no_grad():
        assert agent.discriminator is not None
        return agent.discriminator(env.at(state)).get(keys.SCORE)


def test_one_branch_is_a_plain_rollout(env: DrivingEnv, agent: Agent) -> None:
    start = start_of(env, 1)
    found = rollouts_of(env, start, look(env, agent, start).trajectories)
    assert same(found, plain(env, agent, start))


def test_the_actions_of_every_leaf_lead_where_it_went(env: DrivingEnv, agent: Agent) -> None:
    start = start_of(env, 4)
    result = look(env, agent, start)
    # Some leaf must have been simulated in more than one slot, else nothing was forked.
    assert (result.slots != result.slots[:, :1]).any()
    found, actions, now = (
        rollouts_of(env, start, result.trajectories),
        result.trajectories[keys.ACTION],
        start,
    )
    for t in range(actions.shape[2]):
        now = step_mdp(env.step(now.clone(False).set(keys.ACTION, actions[:, :, t])))
        assert torch.equal(now[keys.STATE], found.state[:, :, t + 1])
        assert torch.equal(now[keys.COLLISION].squeeze(-1), found.collision[:, :, t])
        assert torch.equal(now[keys.OFFROAD].squeeze(-1), found.offroad[:, :, t])


def test_what_the_search_scored_is_what_the_discriminator_says_of_the_leaves(
    env: DrivingEnv, agent: Agent
) -> None:
    start = start_of(env, 4)
    result = look(env, agent, start, keep_tree=True)
    found = rollouts_of(env, start, result.trajectories)
    assert result.tree is not None
    tree = torch.cat([start[keys.STATE][:, :, None], result.tree[("next", *keys.STATE)]], 2)
    counted = found.counted.any(-1)
    for states, scores in ((found.state, result.scores), (tree, result.simulated_scores)):
        expected = scored(env, agent, start, states)
        torch.testing.assert_close(scores[counted], expected[counted], atol=1e-6, rtol=1e-5)
        assert (scores[~counted] == 0).all()
    assert not counted.all()


def test_an_agents_goal_is_that_of_its_tree_in_every_branch(env: DrivingEnv, agent: Agent) -> None:
    """What the policy is shown after forks is still the route of the start."""
    seen = []

    class Spy(torch.nn.Module):
        def forward(self, td: TensorDictBase) -> TensorDictBase:
            seen.append(td.get(keys.GOAL).clone())
            return td

    start = start_of(env, 4)
    assert agent.policy is not None
    look(env, replace(agent, policy=TensorDictSequential(_module(Spy()), agent.policy)), start)
    assert len(seen) == DECISIONS
    assert all(torch.equal(goal, start[keys.GOAL]) for goal in seen)


def _module(inner: torch.nn.Module) -> Any:
    """An inner module that takes the whole TensorDict, where TensorDictSequential takes modules with keys."""
    inner.in_keys, inner.out_keys = [keys.GOAL], []
    return inner


@pytest.mark.parametrize(("goals", "kind"), [(False, "tree"), *((True, kind) for kind in KINDS[1:])])
def test_no_rollout_depends_on_the_batch(store: SegmentStore, kind: Any, goals: bool) -> None:
    agent = make_agent(goals=goals)
    one, three = (
        evaluate(agent, store, EvaluateConfig(search=kind, rollouts=4, trees=2, batch=b)).metrics.rows()
        for b in (1, 3)
    )
    assert one == three
    assert len({row["ade"] for row in one}) == 4


@pytest.mark.parametrize("kind", KINDS)
def test_no_rollout_depends_on_the_order_of_segments(dataset: SceneDataset, agent: Agent, kind: Any) -> None:
    config, order = EvaluateConfig(search=kind, rollouts=4, trees=2), [2, 0, 3, 1]
    sorted_ = simulate_batch(agent, dataset.scenes(range(4)), config).rollouts
    mixed = simulate_batch(agent, dataset.scenes(order), config).rollouts
    counted = sorted_.counted[order]
    assert torch.equal(mixed.counted, counted)
    real = counted.any(-1)
    for a, b in (
        (mixed.state[:, :, 1:], sorted_.state[order][:, :, 1:]),
        (mixed.collision, sorted_.collision[order]),
    ):
        assert torch.equal(a[real], b[real])


@pytest.mark.parametrize(("rule", "trees"), [("replace", 1), ("replace", 2), ("best", 2)])
def test_longer_segments_beside_it_choose_no_leaves(
    dataset: SceneDataset, agent: Agent, rule: Any, trees: int
) -> None:
    agent = searching(agent, rule=rule, threshold=0.1)
    config = EvaluateConfig(rollouts=4, trees=trees)
    scenes = dataset.scenes(range(4))
    together = simulation(agent, scenes, config)
    for item in range(4):
        alone = simulation(agent, dataset.scenes([item]), config)
        steps = alone.rollouts.state.shape[2]
        assert torch.equal(together.rollouts.state[item][:, :steps], alone.rollouts.state[0])
        assert torch.equal(together.goal[item], alone.goal[0])
        assert together.search is not None
        assert alone.search is not None
        periods = alone.search.slots.shape[-2]
        assert torch.equal(together.search.slots[item][:, :periods], alone.search.slots[0])
        scores = together.search.scores[item][:, :, : steps - 1]
        torch.testing.assert_close(scores, alone.search.scores[0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_rollouts_of_a_segment_stay_in_it(dataset: SceneDataset, agent: Agent, kind: Any) -> None:
    scenes = dataset.scenes(range(4))
    found = simulate_batch(agent, scenes, EvaluateConfig(search=kind, rollouts=4, trees=2)).rollouts
    assert found.state.shape == (4, 4, DECISIONS + 1, 2, 4)
    assert found.collision.shape == found.offroad.shape == found.counted.shape == (4, 4, DECISIONS, 2)
    first = scenes.log_state[:, 0].gather(1, scenes.interactive[..., None].expand(4, 2, 5))
    assert torch.equal(found.state[:, :, 0, :, :3], first[:, None, :, :3].expand(-1, 4, -1, -1))
    step = (found.state[:, :, 1:, :, :2] - found.state[:, :, :-1, :, :2]).norm(dim=-1)
    assert step.max() < 6  # 30 m/s; elsewhere in another segment it would be tens of metres
    ends = torch.tensor([s.num_steps - 1 for s in SEGMENTS])
    assert torch.equal(found.counted.sum(2), ends[:, None, None].expand(4, 4, 2))


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_decides_the_rollouts(dataset: SceneDataset, agent: Agent, kind: Any) -> None:
    scenes = dataset.scenes([0])
    a, b, c = (
        simulate_batch(agent, scenes, EvaluateConfig(search=kind, rollouts=2, seed=s)).rollouts
        for s in (3, 3, 4)
    )
    assert same(a, b)
    assert not torch.equal(a.state, c.state)


def test_trees_of_one_branch_are_independent_rollouts(dataset: SceneDataset, agent: Agent) -> None:
    scenes = dataset.scenes(range(4))
    none = simulate_batch(agent, scenes, EvaluateConfig(search="none", rollouts=3)).rollouts
    tree = simulate_batch(
        agent, scenes, EvaluateConfig(search="tree", rollouts=3, trees=3, branches=1)
    ).rollouts
    assert same(none, tree)


@pytest.mark.parametrize("score", ["discriminator", "rule"])
def test_more_trees_keep_the_first_ones(dataset: SceneDataset, agent: Agent, score: Any) -> None:
    scenes = dataset.scenes(range(4))
    few = simulate_batch(
        agent, scenes, EvaluateConfig(search="tree", score=score, rollouts=4, trees=2)
    ).rollouts
    many = simulate_batch(
        agent, scenes, EvaluateConfig(search="tree", score=score, rollouts=6, trees=3)
    ).rollouts
    assert same(few, part(many, slice(None), slice(0, 4)))


@pytest.mark.parametrize("changes", [{"rule": "systematic"}, {"prune_every": 3}, {"temperature": 0.01}])
def test_the_evaluation_decides_the_pruning(
    dataset: SceneDataset, agent: Agent, changes: dict[str, Any]
) -> None:
    scenes, config = dataset.scenes(range(4)), EvaluateConfig(search="tree", rollouts=4)
    agent = searching(agent, rule="systematic" if "temperature" in changes else "best")
    trained = searching(agent, **changes)
    found = simulate_batch(agent, scenes, replace(config, **changes)).rollouts
    assert same(found, simulate_batch(trained, scenes, config).rollouts)
    assert not same(found, simulate_batch(agent, scenes, config).rollouts)


def goals_of(
    monkeypatch: pytest.MonkeyPatch, agent: Agent, scenes: SceneBatch, config: EvaluateConfig
) -> tuple[Tensor, Tensor]:
    """Goals [B, trees, N] drawn on the way, and the states of the rollouts."""
    found = []

    def noted(*args: Any) -> Tensor:
        found.append(draw_goals(*args))
        return found[-1]

    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["symphony.rollouts.unroll"], "draw_goals", noted)
        state = simulate_batch(agent, scenes, config).rollouts.state
    assert len(found) == 1
    return found[0], state


def test_neither_discriminator_nor_search_touches_the_goals(
    dataset: SceneDataset, agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = dataset.scenes(range(4))
    reference, none = goals_of(monkeypatch, agent, scenes, EvaluateConfig(search="none", rollouts=5))
    assert len(reference[1, :, 0].unique()) > 1  # else there is nothing to bias
    strict = replace(agent, discriminator=make_agent(discriminator=1).discriminator)
    driven = []
    ways: list[tuple[Any, Any, Agent]] = [("tree", "discriminator", scorer) for scorer in (agent, strict)]
    for kind, score, scorer in (*ways, ("tree", "flags", agent), ("best", "discriminator", strict)):
        trees = 1 if kind == "best" else 5
        config = EvaluateConfig(search=kind, score=score, rollouts=5, trees=trees, branches=3, rule="best")
        goals, state = goals_of(monkeypatch, scorer, scenes, config)
        assert torch.equal(goals, reference)
        driven.append(state)
    # Each of them does change what survives.
    assert all(not torch.equal(a, b) for a, b in zip([none, *driven], [*driven, none], strict=True))


def test_goals_depend_on_seed_scene_and_tree_alone(env: DrivingEnv, agent: Agent) -> None:
    tree = torch.arange(40).expand(4, 40)
    start = env.start(torch.arange(4)[:, None].expand(4, 40), 1000 + tree)
    whole = draw_goals(env, agent.goals, start, 7, tree)
    # Another stream (branch), another batch, another order: the same goals.
    rows = torch.randperm(160, generator=torch.Generator().manual_seed(0))[:50]
    other = env.start(rows // 40, 3)
    assert torch.equal(draw_goals(env, agent.goals, other, 7, rows % 40), whole.flatten(0, 1)[rows])
    assert torch.equal(draw_goals(env, agent.goals, start[2, :3], 7, tree[2, :3]), whole[2, :3])
    assert not torch.equal(draw_goals(env, agent.goals, start, 8, tree), whole)
    counts = env.scenes.route_count > 0
    assert (whole[..., None] == torch.arange(counts.shape[-1])).any(1)[counts].float().mean() > 0.9
    assert counts.gather(-1, whole.transpose(1, 2)).all()


def test_logged_goals_are_the_logged_routes(dataset: SceneDataset, agent: Agent) -> None:
    scenes = dataset.scenes(range(4))
    config = EvaluateConfig(search="none", rollouts=3, logged_goals=True)
    goals = simulation(agent, scenes, config).goal
    assert torch.equal(goals, scenes.route_logged[:, None].expand(-1, 3, -1))


def test_agents_without_any_route_are_no_error(tmp_path: Path, agent: Agent) -> None:
    segment = straight_road(3, steps=9)
    position = segment.position.copy()
    position[..., 1] += 200
    with StoreWriter(tmp_path / "store") as writer:
        writer.append(segment.replace(position=position))
    result = evaluate(agent, tmp_path / "store", EvaluateConfig(search="tree", rollouts=2, trees=1))
    assert np.isfinite(result.numbers()["ade"])


def test_best_is_the_best_of_independent_rollouts(dataset: SceneDataset, agent: Agent) -> None:
    scenes, branches = dataset.scenes(range(4)), 3
    config = EvaluateConfig(search="best", rollouts=2, branches=branches, logged_goals=True, seed=5)
    found = simulate_batch(agent, scenes, config).rollouts
    env = DrivingEnv(scenes, agent.dynamics, agent.observation)
    start = start_of(env, 2 * branches)
    every = plain(env, agent, start)
    scores = scored(env, agent, start, every.state).masked_fill(~every.counted, -torch.inf)
    total = scores.amax(2).sum(-1).unflatten(1, (2, branches))
    best = total.argmin(-1) + branches * torch.arange(2)
    for b in range(4):
        one, other = part(found, b), part(every, b, best[b])
        # Flags are those between states there, and at states here.
        assert all(
            torch.equal(getattr(one, name), getattr(other, name)) for name in ("state", "offroad", "counted")
        )
    assert best.unique().numel() > 2


def blocked() -> RunSegment:
    """On a wide road the ego follows two cars that brake to a stand; the first of them is interactive too."""
    steps, dt = 26, 0.2
    time = np.arange(steps) * dt
    x = np.arange(-60, 200, 2.0)
    line, side = np.stack([x, 0 * x], -1), np.array([0, 9.0])
    road = make_road([line], boundary=[line - side, (line + side)[::-1]])
    speed = np.stack([np.full(steps, 7.0), np.maximum(0, 7 - 2 * time), np.maximum(0, 6 - 3 * time)])
    driven = np.cumsum(speed * dt, 1) - speed * dt
    place = np.array([[0.0], [18.0], [32.0]]) + driven
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
    agent, scenes = make_agent(goals=False), scene(blocked(), [0, 1])
    how: dict[str, Any] = {"score": "flags", "rule": "replace", "prune_every": 2}
    how |= {"rollouts": 16, "trees": 2, "branches": 8}
    rates = []
    kinds: tuple[Any, ...] = ("none", "tree")
    for kind in kinds:
        found = simulation(agent, scenes, EvaluateConfig(search=kind, **how)).rollouts
        rates.append(float((found.collision & found.counted).any(-1).any(-1).float().mean()))
    assert rates[0] > 0.3
    assert rates[1] < 0.5 * rates[0]


def test_the_oracle_scores_flags_of_real_agents_alone() -> None:
    shape = (3, 2)
    flags = TensorDict(
        {
            keys.COLLISION: torch.tensor([[1, 0], [0, 0], [1, 1]]).bool()[..., None],
            keys.OFFROAD: torch.tensor([[0, 0], [1, 0], [1, 1]]).bool()[..., None],
            keys.VALID: torch.tensor([[1, 1], [1, 1], [1, 0]]).bool(),
        },
        batch_size=shape[:1],
    )
    assert flag_score(flags).tolist() == [[1, 0], [1, 0], [1, 0]]


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
