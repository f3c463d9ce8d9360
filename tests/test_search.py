"""The search through the driving environment, the evaluator's kinds of it, and the goals that branches follow."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from helpers_agents import make_agent
from helpers_segments import crossing, make_road, make_segment, straight_road
from helpers_store import stored
from symphony import SegmentStore, builtin_store, keys, load_agent
from symphony.collectors import Backtrack, KeepBest, with_rows
from symphony.config import EvaluateConfig, SearchConfig
from symphony.envs import Bicycle, DrivingEnv, ObservationConfig, scene
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.evaluation.records import evaluation_record, simulation_way
from symphony.learning.demonstrations import SceneDataset
from symphony.modules import SeededNoise
from symphony.roadgraph import LaneGraph
from symphony.rollouts import RouteGoals, simulate
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import filled_lines, simulation
from symphony.rollouts.search import rule_score, search
from symphony.rollouts.unroll import Rollouts, draw_goals, rollouts_of

SEARCH = {"branches": 4, "test_branches": 4, "prune_every": 2}
KINDS = ("none", "tree", "backtrack")
SEGMENTS = [crossing(3, seed=1, steps=5), straight_road(4, seed=0, steps=8)]
SEGMENTS += [crossing(4, seed=2, steps=6), straight_road(3, seed=3, steps=5)]
DECISIONS = 7


store = stored(lambda: [*SEGMENTS, blocked()], opened=True)


@pytest.fixture(scope="module")
def dataset(store):
    return SceneDataset(store, 2, Bicycle(), routes=True)


@pytest.fixture(scope="module")
def scenes(dataset):
    return dataset.scenes(range(4))


@pytest.fixture(scope="module")
def agent():
    return make_agent(search=SEARCH)


@pytest.fixture(scope="module")
def env(scenes, agent):
    return DrivingEnv(scenes, agent.dynamics, agent.observation)


def start_of(env, branches):
    rows = torch.arange(len(env.scenes))[:, None].expand(-1, branches)
    return env.with_goals(env.start(rows, torch.arange(branches).expand(rows.shape)))


def look(env, agent, start, **changes):
    settings = {"seed": 5, "rule": KeepBest(0.5), "prune_every": 2, **changes}
    with torch.no_grad():
        return search(env, agent.policy, agent.discriminator, start, **settings)


def plain(env, agent, start):
    return simulate(env, TensorDictSequential(SeededNoise(5), agent.policy), start)


def driven(agent, scenes, kind="tree", **changes):
    return simulation(agent, scenes, EvaluateConfig(**{"search": kind, "rollouts": 4, **changes}))


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def scored(env, agent, start, states):
    """Scores [B, S, T, N] of states [B, S, T + 1, N, 4], the first left out."""
    whole = [*start.shape, states.shape[2] - 1]
    state = start.select(keys.SCENE, keys.STREAM, keys.VALID, keys.GOAL).unsqueeze(-1).expand(*whole).clone()
    before, come = env._read(start), []
    for now in states.unbind(2)[1:]:
        come.append(env._progress(before, now))
        before = before._replace(state=now, progress=come[-1])
    state.set(keys.PROGRESS, torch.stack(come, 2)).set(keys.STATE, states[:, :, 1:])
    state.set(keys.STEP, torch.arange(1, whole[-1] + 1)[:, None].expand(*whole, 1))
    with torch.no_grad():
        return agent.discriminator(env.at(state)).get(keys.SCORE)


def test_leaves_follow_their_actions_and_goals_and_are_scored_as_they_are(env, agent):
    seen, start = [], start_of(env, 4)
    spy = TensorDictModule(lambda goal: seen.append(goal.clone()), [keys.GOAL], [])
    policy = TensorDictSequential(spy, agent.policy)
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
    tree = torch.cat([start[keys.STATE][:, :, None], result.tree[("next", *keys.STATE)]], 2)
    counted = found.counted.any(-1)
    for states, scores in ((found.state, result.scores), (tree, result.simulated_scores)):
        expected = scored(env, agent, start, states)
        torch.testing.assert_close(scores[counted], expected[counted], atol=1e-6, rtol=1e-5)
        assert (scores[~counted] == 0).all()
    assert not counted.all()


@pytest.mark.parametrize(("kind", "how", "goals"), [
    ("tree", {}, False), *((kind, {}, True) for kind in KINDS),
    ("tree", {"rule": "replace", "threshold": 0.1, "goals": "branch"}, True), ("tree", {"rule": "best"}, True),
])  # fmt: skip
def test_no_rollout_depends_on_batch_or_order(dataset, kind, how, goals):
    agent, order, how = make_agent(search=SEARCH, goals=goals), [2, 0, 3, 1], {"trees": 2, "seed": 3, **how}
    scenes = dataset.scenes(range(4))
    whole, mixed = driven(agent, scenes, kind, **how), driven(agent, dataset.scenes(order), kind, **how)
    again = driven(agent, scenes, kind, **how | {"seed": 4})
    assert not torch.equal(again.rollouts.state, whole.rollouts.state)
    alone = driven(agent, dataset.scenes([3]), kind, **how)
    steps = alone.rollouts.counted.shape[2]
    for name in Rollouts._fields:
        value, cut = getattr(whole.rollouts, name), steps + (name == "state")
        assert torch.equal(value[3][:, :cut], getattr(alone.rollouts, name)[0])
        assert torch.equal(value[order], getattr(mixed.rollouts, name))
    assert torch.equal(whole.goal[3], alone.goal[0])
    if alone.search is not None:
        scores = whole.search.scores[3][:, :, :steps]
        torch.testing.assert_close(scores, alone.search.scores[0], rtol=1e-5, atol=1e-5)
    found = whole.rollouts
    assert found.state.shape == (4, 4, DECISIONS + 1, 2, 4)
    first = scenes.log_state[:, 0].gather(1, scenes.interactive[..., None].expand(4, 2, 5))
    assert torch.equal(found.state[:, :, 0, :, :3], first[:, None, :, :3].expand(-1, 4, -1, -1))
    step = (found.state[:, :, 1:, :, :2] - found.state[:, :, :-1, :, :2]).norm(dim=-1)
    assert step.max() < 6  # 30 m/s; elsewhere in another segment it would be tens of metres
    ends = torch.tensor([segment.num_steps - 1 for segment in SEGMENTS])
    assert torch.equal(found.counted.sum(2), ends[:, None, None].expand(4, 4, 2))


def test_trees_of_one_branch_are_independent_rollouts_and_more_keep_the_first_ones(scenes, agent):
    none = driven(agent, scenes, "none", rollouts=3).rollouts
    assert same(none, driven(agent, scenes, rollouts=3, trees=3, branches=1).rollouts)
    for score in ("discriminator", "rule"):
        few = driven(agent, scenes, score=score, trees=2).rollouts
        many = driven(agent, scenes, score=score, rollouts=6, trees=3).rollouts
        assert same(few, Rollouts(*(value[:, :4] for value in many)))


def test_neither_discriminator_nor_search_touches_the_goals(scenes, agent, monkeypatch):
    drawn, how = [], {"rollouts": 5, "branches": 3, "rule": "best"}
    noted = lambda *args: drawn.append(draw_goals(*args)) or drawn[-1]  # noqa: E731
    monkeypatch.setattr(sys.modules["symphony.rollouts.unroll"], "draw_goals", noted)
    other = replace(agent, discriminator=make_agent(seed=1, search=SEARCH).discriminator)
    states = [driven(agent, scenes, "none", rollouts=5).rollouts.state]
    assert len(drawn[0][1, :, 0].unique()) > 1  # else there is nothing to bias
    for scorer, score in ((agent, "discriminator"), (other, "discriminator"), (agent, "flags")):
        states.append(driven(scorer, scenes, score=score, trees=5, **how).rollouts.state)
    assert all(torch.equal(goals, drawn[0]) for goals in drawn)
    # Each of them does change what survives.
    assert all(not torch.equal(a, b) for a, b in pairwise(states))


def test_a_temperature_makes_the_draws_of_goals_even(env, agent):
    number = torch.arange(2000).expand(len(env.scenes), -1)
    start = env.start(torch.arange(len(env.scenes))[:, None].expand(number.shape), number)
    plain, warm, hot = (
        draw_goals(env, agent.goals, start, 0, number, heat)
        for heat in (None, torch.ones(number.shape), torch.full(number.shape, 1e6))
    )
    assert torch.equal(plain, warm)
    count = env.choices(start)[keys.ROUTES_MASK].sum(-1)[:, 0]
    for b, n in count.nonzero().tolist():
        share = hot[b, :, n].bincount(minlength=int(count[b, n])) / 2000
        assert share.sum() == share[: count[b, n]].sum()
        assert (share - 1 / count[b, n]).abs().max() < 0.05


def test_lines_that_fail_again_from_their_first_state_draw_less_likely_routes(scenes, agent, monkeypatch):
    heats = []
    noted = lambda *args: heats.append(args[5]) or draw_goals(*args)  # noqa: E731
    monkeypatch.setattr(sys.modules["symphony.rollouts.driving"], "draw_goals", noted)
    driven(agent, scenes, "backtrack", score="rule", threshold=-1.0)
    assert torch.cat(heats).unique().tolist()[:4] == [1, 2, 3, 4]


@pytest.mark.parametrize("drawn", [True, False])
def test_route_goals_are_given_at_each_reset_and_kept_after(scenes, agent, drawn):
    base = DrivingEnv(scenes, agent.dynamics, agent.observation, seed=1)
    env = with_rows(TransformedEnv(base, RouteGoals(agent.goals if drawn else None, seed=7)), [12])
    found = env.reset()
    row, number = (found[key].squeeze(-1) for key in (keys.SCENE, keys.STREAM))
    plain = found.clone().set(keys.GOAL, torch.full_like(found[keys.GOAL], -1))
    goal = draw_goals(base, agent.goals, plain, 7, number) if drawn else scenes.route_logged[row]
    assert (goal >= 0).any()
    assert (found == base.with_goals(plain, goal)).all()
    later = step_mdp(env.rand_step(env.rand_step(found)["next"]))
    again = env.reset(later.set("_reset", torch.arange(12)[:, None] < 4), set_state=False)
    assert (again[4:] == later[4:].select(*again.keys(True, True))).all()
    assert again[keys.STEP].flatten().tolist() == [0] * 4 + [2] * 8
    assert (again[keys.GOAL][:4] >= 0).any()
    held = base.with_goals(base.start(row), torch.zeros_like(goal))
    assert torch.equal(env.reset(held, set_state=True)[keys.GOAL], held[keys.GOAL])
    assert TransformedEnv(base, RouteGoals(agent.goals)).rollout(2).shape == (2,)


def test_an_included_agent_drives_where_doubles_are_the_default():
    torch.set_default_dtype(torch.float64)
    try:
        agent = load_agent("pretrained:bc_ts_h")
        data = SceneDataset(SegmentStore(builtin_store("train")), 1, agent.dynamics, [0, 1], routes=True)
        driving = TransformedEnv(DrivingEnv(data, agent.dynamics, agent.observation), RouteGoals(agent.goals))
        check_env_specs(with_rows(driving, [2]))
        assert with_rows(driving, [2]).rollout(2, agent.policy)[keys.STATE].dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("what", ["route", "along"])
def test_agents_that_need_routes_and_have_none_say_so(dataset, scenes, what):
    bare = SceneDataset(dataset.store, 2, Bicycle())
    sees, blind = ObservationConfig(num_objects=2, num_points=0, **{what: True}), ObservationConfig.nothing()
    with pytest.raises(ConfigError, match=r"routes=True"):
        DrivingEnv(bare, Bicycle(), sees)
    for source in (bare, bare.scenes(range(2))):
        with pytest.raises(ConfigError, match=r"routes=True"):
            TransformedEnv(DrivingEnv(source, Bicycle(), blind), RouteGoals()).reset()
    for source in (dataset, scenes):
        with pytest.raises(ConfigError, match="RouteGoals"):
            DrivingEnv(source, Bicycle(), sees).rollout(2)


def test_goals_depend_on_seed_scene_and_tree_alone(env, agent):
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


def test_agents_without_any_route_are_no_error(agent):
    segment = straight_road(3, steps=9)
    far = segment.replace(position=segment.position + np.array([0, 200, 0], np.float32))
    assert (driven(make_agent(search=SEARCH, goals=False), scene(far, [0, 1], None)).goal == -1).all()
    nowhere = scene(far, [0, 1], LaneGraph(segment.road))
    assert driven(agent, nowhere, rollouts=2).rollouts.state.isfinite().all()


def test_with_nothing_to_replace_a_search_is_independent_rollouts(agent, scenes):
    how = {"rollouts": 8, "branches": 8, "goals": "branch", "seed": 3}  # each branch draws its own goals
    free = driven(agent, scenes, "none", **how | {"goals": "tree"})
    assert (free.goal != free.goal[:, :1]).any()  # at a crossing
    shared = driven(agent, scenes, **how | {"goals": "tree"}).goal
    assert (shared == shared[:, :1]).all()
    searched = driven(agent, scenes, rule="replace", threshold=1e9, **how)
    # The best leaves come first; which they are is the same.
    for mine, theirs in zip(searched.rollouts.state, free.rollouts.state, strict=True):
        assert {path.numpy().tobytes() for path in mine} == {path.numpy().tobytes() for path in theirs}
    for rule in ("best", "systematic", "replace"):
        left = driven(agent, scenes, rule=rule, threshold=0.0, **how).goal
        # [B, K, K, N]: every leaf beside every draw of its scene.
        assert (left[:, :, None] == free.goal[:, None]).all(-1).any(-1).all()


def blocked():
    """On a wide road the ego follows two cars that brake to a stand; the first of them is interactive too."""
    steps, dt = 21, 0.2
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
def test_an_oracle_replaces_what_is_flagged_whatever_the_agent_was_trained_with(trained):
    """Flags are 1, as is a usual threshold of a discriminator's scores; one agent that is bad makes a branch bad."""
    settings = SearchConfig(rule="replace", threshold=trained)
    for score in ("flags", "rule"):
        assert EvaluateConfig(score=score).pruning(settings).threshold == 0.0
        assert EvaluateConfig(score=score, threshold=2.0).pruning(settings).threshold == 2.0
    assert EvaluateConfig(search="tree").pruning(settings).threshold == trained


def collisions(found):
    return float((found.rollouts.collision & found.rollouts.counted).any(-1).any(-1).float().mean())


def test_an_oracle_avoids_what_it_knows():
    agent, data = make_agent(search=SEARCH, goals=False), scene(blocked(), [0, 1])
    how = {"score": "flags", "rule": "replace", "rollouts": 16, "trees": 2, "branches": 8}
    none, tree = (collisions(driven(agent, data, kind, **how)) for kind in ("none", "tree"))
    assert none > 0.3
    assert tree < 0.5 * none


def test_kinds_and_sizes_that_do_not_fit_are_refused(store, agent):
    for kind in ("tree", "backtrack"):
        with pytest.raises(ConfigError, match="needs an agent with a discriminator"):
            evaluate(replace(agent, discriminator=None), store, EvaluateConfig(search=kind))
    with pytest.raises(ConfigError, match="less than 16 rollouts"):
        evaluate(agent, store, EvaluateConfig(search="tree", branches=3, trees=2))
    for wrong in ({"rollouts": 16, "trees": 3}, {"trees": 0}, {"branches": -1}, {"search": "orcale"}):
        with pytest.raises(ConfigError):
            EvaluateConfig(**wrong)


LINES = EvaluateConfig(search="backtrack", score="rule", rollouts=4)
NONE = replace(LINES, search="none")


def crowds(store, items, config, **changes):
    agent = make_agent(search=SEARCH, **changes)
    return simulation(agent, crowd_dataset(store, agent, config).scenes(items), config)


@pytest.mark.parametrize("crowd", [{"interactive": "all"}, {"interactive": 3, "others": "idm"}], ids=str)
def test_what_is_never_bad_is_simulated_without_search(store, crowd):
    none = crowds(store, [0, 1, 4], replace(NONE, **crowd))
    lines = crowds(store, [0, 1, 4], replace(LINES, threshold=math.inf, **crowd))
    assert all(torch.equal(a, b) for a, b in zip(none.rollouts, lines.rollouts, strict=True))
    assert torch.equal(none.goal, lines.goal)
    assert none.steps == lines.steps == 3 * 4 * (none.rollouts.state.shape[2] - 1)
    assert lines.search is None


@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
@pytest.mark.parametrize(("kind", "crowd"), [("none", "all"), ("backtrack", 2)])
def test_compiled_runs_are_the_runs_by_one_program_for_batches_of_few_shapes(store, kind, crowd, monkeypatch):
    torch.compiler.reset()
    programs: set[object] = set()

    def backend(graph, _):
        programs.add(graph)
        return graph.forward

    def depends(state):
        return tuple((name, value.shape, value.stride()) for name, value in state.flatten_keys().items())

    def noted(step, **_):
        return lambda *given: programs.add(depends(given[-1])) or step(*given)

    monkeypatch.setitem(sys.modules["symphony.rollouts.search"].COMPILER, "backend", backend)
    if kind == "none":  # to compile takes seconds: what a program depends on tells as much
        monkeypatch.setattr(torch, "compile", noted)
    agent, how = make_agent(search=SEARCH), EvaluateConfig(search=kind, rollouts=2, score="rule")
    how = replace(how, interactive=crowd, batch=4 if crowd == "all" else 2)  # whose sizes differ too much
    parts = {"items": [0, 1, 2, 3]}
    plain, compiled = (evaluate(agent, store, replace(how, compile=on), **parts) for on in ("no", "yes"))
    assert len(programs) == 1
    theirs, ours = compiled.metrics.compute(), plain.metrics.compute()
    assert ours["collision_rate"] == theirs["collision_rate"]
    assert {name: theirs[name] for name in ours} == pytest.approx(ours, rel=1e-4, abs=1e-5, nan_ok=True)


@pytest.mark.parametrize("threshold", [LINES.threshold, -1.0])  # at the latter all go back as often as they may
def test_the_batch_changes_nothing_in_lines(store, threshold, monkeypatch):
    module = sys.modules["symphony.rollouts.search"]
    monkeypatch.setattr(module, "Backtrack", partial(Backtrack, cap=1.0))
    config = replace(LINES, rollouts=3, interactive="all", threshold=threshold)
    whole = crowds(store, [1, 2, 3], config)
    assert whole.steps > 1.1 * 3 * 3 * (whole.rollouts.state.shape[2] - 1)
    monkeypatch.setattr(module, "FEW", 3)
    part = crowds(store, [3, 2], config)  # shorter ones, and fewer at a time than there are
    agents, steps = part.rollouts.state.shape[3], part.rollouts.counted.shape[2]
    for name in Rollouts._fields:
        value = getattr(whole.rollouts, name)[[2, 1], :, : steps + (name == "state"), :agents]
        assert torch.equal(value, getattr(part.rollouts, name))
    assert torch.equal(whole.goal[[2, 1], :, :agents], part.goal)


def test_lines_avoid_what_they_are_judged_by(store, monkeypatch):
    monkeypatch.setattr(sys.modules["symphony.rollouts.search"], "Backtrack", partial(Backtrack, cap=2.0))
    ways = (replace(how, rollouts=12) for how in (NONE, replace(LINES, score="flags"), LINES))
    none, *lines = (collisions(crowds(store, [4], how, goals=False)) for how in ways)
    assert none > 0.3
    assert max(lines) < 0.6 * none


def test_who_begins_again_draws_goals_anew(store, monkeypatch):
    module = sys.modules["symphony.rollouts.search"]
    monkeypatch.setattr(module, "Backtrack", lambda *given, **named: Backtrack(*given, **named, back=(1, 0), cap=1.0))
    config = replace(LINES, score="flags", threshold=-1.0, rollouts=8)  # bad whatever happens
    none, lines, logged = (
        crowds(store, [0, 2], how)
        for how in (replace(config, search="none"), config, replace(config, logged_goals=True))
    )
    assert (none.goal[:, :, None] != none.goal[:, None]).any(), "all follow the same routes"
    assert not torch.equal(none.goal, lines.goal)
    routes = crowd_dataset(store, make_agent(search=SEARCH), config).scenes([0, 2])
    assert routes.route_count.gather(-1, lines.goal.transpose(1, 2).clamp_min(0)).all()
    assert torch.equal(logged.goal, routes.route_logged[:, None].expand_as(logged.goal))


@pytest.mark.parametrize("segment", [crossing(6, seed=1, steps=12), straight_road(6, seed=0, steps=12)])
def test_the_rule_is_that_of_the_gaps_agents_may_observe(segment):
    scenes = scene(segment, [0, 1, 2])
    seeing = ObservationConfig(num_objects=5, num_points=0, clearance=True, foresight=(0.5,))
    env, blind = (DrivingEnv(scenes, observation=one) for one in (seeing, ObservationConfig.nothing()))
    state = env.start(torch.zeros(200, dtype=torch.int64))
    noise = torch.randn(200, 3, 4, generator=torch.Generator().manual_seed(0))
    state = env.at(state.set(keys.STATE, state.get(keys.STATE) + noise * torch.tensor([6.0, 3, 1, 4])))
    gap = torch.cat([state.get(keys.GAP)[..., None], state.get(keys.GAP_AHEAD)], -1)
    close = ((gap < 0).any(-1) & state.get(keys.OBJECTS_MASK)).any(-1)
    expected = close | (state.get(keys.ROAD)[..., 0] > 0)
    assert 0.1 < expected.float().mean() < 0.9
    assert torch.equal(rule_score(env, state), expected.float())
    assert torch.equal(rule_score(blind, blind.at(state)), expected.float())
    alone = state.clone().set(keys.VALID, torch.tensor([True, False, False]).expand(200, 3))
    assert (rule_score(env, env.at(alone))[:, 1:] == 0).all()


def test_what_is_searched_for_is_on_record(store):
    agent = make_agent(search=SEARCH)
    for kind, score, way in (
        ("agent", "flags", "tree-1x4-systematic-every2-at0.6-score=flags"),
        ("backtrack", "agent", "backtrack-every2-threshold=1.0"),
    ):
        config = EvaluateConfig(rollouts=2, search=kind, score=score)
        record = evaluation_record(agent, evaluate(agent, store, config, items=[0, 1]), store)
        assert simulation_way(record["config"]) == way
        assert record["cost"]["steps"] >= 4 * 2


def test_agents_are_searched_as_they_are_meant_to_be(store):
    """Without a discriminator by what they do; the included ones go back by the rule."""
    blind = replace(make_agent(search=SEARCH), discriminator=None)
    assert blind.plan(EvaluateConfig()).kind == "none"
    assert blind.plan(EvaluateConfig(rollouts=1, score="rule")).kind == "tree"
    assert evaluate("constant_velocity", store, replace(LINES, rollouts=1), items=[0]).search == "backtrack"
    with pytest.raises(ConfigError, match="another score: --score rule"):
        blind.plan(EvaluateConfig(search="backtrack"))
    for name in ("bc_rl", "bc_ts_h"):
        plan = load_agent(f"pretrained:{name}").plan(EvaluateConfig())
        assert (plan.kind, plan.search.score, plan.search.threshold) == ("backtrack", "rule", 0)
    plan = make_agent(search=SEARCH).plan(EvaluateConfig(rollouts=4))
    assert (plan.kind, plan.trees, plan.taken, plan.search.score) == ("tree", 1, 4, "discriminator")


@given(st.integers(1, 6), st.integers(1, 9), st.integers(0, 1000))
def test_bad_lines_are_filled_from_good_ones_in_turn(scenes, lines, seed):
    totals = torch.rand(scenes, lines, 3, generator=torch.Generator().manual_seed(seed))
    found = filled_lines(totals, 0.8)
    good = (totals <= 0.8).all(-1)
    for row, is_good in zip(found, good, strict=True):
        if not is_good.any():
            assert row.tolist() == list(range(lines))
            continue
        assert bool(is_good[row].all())
        assert row[is_good].tolist() == is_good.nonzero().flatten().tolist()
        copies = torch.bincount(row, minlength=lines)[is_good]
        assert copies.max() - copies.min() <= 1
