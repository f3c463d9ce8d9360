"""Backtracking in the driving environment, and what a search looks for."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from helpers_segments import crossing, straight_road
from symphony import keys, load_agent
from symphony.collectors import Backtrack
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs import DrivingEnv, ObservationConfig, scene
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.evaluation.records import evaluation_record, simulation_way
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import Simulation, filled_lines, simulation
from symphony.rollouts.search import rule_score
from symphony.rollouts.unroll import Rollouts
from test_search import SEGMENTS, blocked, make_agent

LINES = EvaluateConfig(search="backtrack", score="rule", rollouts=4)
NONE = replace(LINES, search="none")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SegmentStore:
    path = tmp_path_factory.mktemp("data") / "store"
    with StoreWriter(path) as writer:
        for segment in [*SEGMENTS, blocked()]:
            writer.append(segment)
    return SegmentStore(path)


def driven(
    store: SegmentStore, items: list[int], config: EvaluateConfig = LINES, **changes: Any
) -> Simulation:
    agent = make_agent(**changes)
    return simulation(agent, crowd_dataset(store, agent, config).scenes(items), config)


def collided(rollouts: Rollouts) -> Tensor:
    """[B, K] whether anybody collides."""
    return (rollouts.collision & rollouts.counted).any(-1).any(-1)


@pytest.mark.parametrize("crowd", [{}, {"interactive": "all"}, {"interactive": 3, "others": "idm"}], ids=str)
def test_what_is_never_bad_is_simulated_without_search(store: SegmentStore, crowd: dict[str, Any]) -> None:
    none = driven(store, [0, 1, 4], replace(NONE, **crowd))
    lines = driven(store, [0, 1, 4], replace(LINES, threshold=math.inf, **crowd))
    assert all(torch.equal(a, b) for a, b in zip(none.rollouts, lines.rollouts, strict=True))
    assert torch.equal(none.goal, lines.goal)
    assert none.steps == lines.steps == 3 * 4 * (none.rollouts.state.shape[2] - 1)
    assert lines.search is None


@pytest.mark.parametrize("crowd", [{}, {"interactive": "all"}], ids=str)
def test_the_batch_changes_nothing(
    store: SegmentStore, crowd: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(LINES, **crowd)
    whole = driven(store, [0, 1, 2, 3, 4], config)
    assert whole.steps > 1.1 * 5 * 4 * (whole.rollouts.state.shape[2] - 1)
    few = driven(store, [0, 1, 2, 3, 4], replace(config, rollouts=3))
    monkeypatch.setattr(sys.modules["symphony.rollouts.search"], "FEW", 3)
    waiting = driven(store, [0, 1, 2, 3, 4], config)
    part = driven(store, [4, 1], config)
    agents, steps = part.rollouts.state.shape[3], part.rollouts.counted.shape[2]
    for name in Rollouts._fields:
        value = getattr(whole.rollouts, name)
        assert torch.equal(value, getattr(waiting.rollouts, name))
        assert torch.equal(value[:, :3], getattr(few.rollouts, name))
        cut = steps + (name == "state")
        assert torch.equal(value[[4, 1], :, :cut, :agents], getattr(part.rollouts, name))
    assert torch.equal(whole.goal[[4, 1], :, :agents], part.goal)


def test_lines_avoid_what_they_are_judged_by(store: SegmentStore) -> None:
    rates = {}
    for name, config in (
        ("none", NONE),
        ("flags", replace(LINES, score="flags")),
        ("rule", LINES),
    ):
        found = driven(store, [4], replace(config, rollouts=32), goals=False)
        rates[name] = collided(found.rollouts).float().mean().item()
    assert rates["none"] > 0.3
    assert rates["flags"] < 0.6 * rates["none"]
    assert rates["rule"] < 0.6 * rates["none"]


def test_who_begins_again_draws_goals_anew(store: SegmentStore, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules["symphony.rollouts.search"]
    monkeypatch.setattr(module, "Backtrack", lambda *given, **named: Backtrack(*given, **named, back=(1, 0)))
    config = replace(LINES, score="flags", threshold=-1.0, rollouts=16)  # bad whatever happens
    none, lines, logged = (
        driven(store, [0, 1, 2], how)
        for how in (replace(config, search="none"), config, replace(config, logged_goals=True))
    )
    counts = (none.goal[:, :, None] != none.goal[:, None]).any(-1).any(-1)
    assert counts.any(), "all follow the same routes"
    assert not torch.equal(none.goal, lines.goal)
    agent = make_agent()
    routes = crowd_dataset(store, agent, config).scenes([0, 1, 2])
    assert routes.route_count.gather(-1, lines.goal.transpose(1, 2).clamp_min(0)).all()
    assert torch.equal(logged.goal, routes.route_logged[:, None].expand_as(logged.goal))


@pytest.mark.parametrize("seed", range(2))
def test_the_rule_is_that_of_the_gaps_agents_may_observe(seed: int) -> None:
    scenes = scene(
        crossing(6, seed=seed, steps=12) if seed % 2 else straight_road(6, seed=seed, steps=12), [0, 1, 2]
    )
    seeing = ObservationConfig(num_objects=5, num_points=0, clearance=True, foresight=(0.5,))
    env, blind = (
        DrivingEnv(scenes, observation=seeing),
        DrivingEnv(scenes, observation=ObservationConfig.nothing()),
    )
    state = env.start(torch.zeros(200, dtype=torch.int64))
    generator = torch.Generator().manual_seed(seed)
    moved = state.get(keys.STATE) + torch.randn(200, 3, 4, generator=generator) * torch.tensor([6.0, 3, 1, 4])
    state = env.at(state.set(keys.STATE, moved))
    gap = torch.cat([state.get(keys.GAP)[..., None], state.get(keys.GAP_AHEAD)], -1)
    close = ((gap < 0).any(-1) & state.get(keys.OBJECTS_MASK)).any(-1)
    expected = close | (state.get(keys.ROAD)[..., 0] > 0)
    assert 0.1 < expected.float().mean() < 0.9
    assert torch.equal(rule_score(env, state), expected.float())
    assert torch.equal(rule_score(blind, blind.at(state)), expected.float())
    alone = state.clone().set(keys.VALID, torch.tensor([True, False, False]).expand(200, 3))
    assert (rule_score(env, env.at(alone))[:, 1:] == 0).all()


def test_what_is_searched_for_is_on_record(store: SegmentStore) -> None:
    agent, how = make_agent(), EvaluateConfig(rollouts=4)
    names = set()
    for changes in (
        {},
        {"search": "backtrack"},
        {"score": "flags"},
        {"search": "backtrack", "score": "rule"},
    ):
        found = evaluate(agent, store, replace(how, **changes))
        record = evaluation_record(agent, found, store)
        names.add(simulation_way(record["config"]))
        assert record["cost"]["steps"] == found.steps >= 4 * len(store)
    assert names == {
        "tree-1x4-systematic-every2-at0.6",
        "tree-1x4-systematic-every2-at0.6-score=flags",
        "backtrack-every2-threshold=1.0",
        "backtrack-every2-score=rule-threshold=0.0",
    }


def test_agents_without_a_discriminator_are_searched_by_what_they_do(store: SegmentStore) -> None:
    blind = replace(make_agent(), discriminator=None)
    assert blind.plan(EvaluateConfig()).kind == "none"
    assert blind.plan(EvaluateConfig(rollouts=1, score="rule")).kind == "tree"
    assert evaluate(blind, store, replace(LINES, rollouts=2)).search == "backtrack"
    assert evaluate("constant_velocity", store, replace(LINES, rollouts=1)).search == "backtrack"
    with pytest.raises(ConfigError, match="another score: --score flags or rule"):
        blind.plan(EvaluateConfig(search="backtrack"))


@given(st.integers(1, 6), st.integers(1, 9), st.integers(0, 1000))
def test_bad_lines_are_filled_from_good_ones_in_turn(scenes: int, lines: int, seed: int) -> None:
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


def test_included_agents_go_back_by_the_rule_and_others_search_as_they_learned() -> None:
    for name in ("bc_ts_h", "mgail_ts_h"):
        agent = load_agent(f"pretrained:{name}")
        assert agent.plan(EvaluateConfig()).kind == "backtrack"
        assert agent.plan(EvaluateConfig()).search.score == "rule"
        assert EvaluateConfig().pruning(agent.search).threshold == 0
        assert agent.plan(EvaluateConfig(search="tree")).kind == "tree"
        assert agent.plan(EvaluateConfig(score="discriminator")).search.score == "discriminator"
    plan = make_agent().plan(EvaluateConfig(rollouts=4))
    assert (plan.kind, plan.trees, plan.taken, plan.search.score) == ("tree", 1, 4, "discriminator")
