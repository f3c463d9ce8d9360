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

from helpers_agents import make_agent
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony import keys, load_agent
from symphony.collectors import Backtrack
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, ObservationConfig, scene
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.evaluation.records import evaluation_record, simulation_way
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import Simulation, filled_lines, simulation
from symphony.rollouts.search import rule_score
from symphony.rollouts.unroll import Rollouts
from test_search import SEARCH, SEGMENTS, blocked

LINES = EvaluateConfig(search="backtrack", score="rule", rollouts=4)
NONE = replace(LINES, search="none")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SegmentStore:
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, [*SEGMENTS, blocked()])
    return SegmentStore(path)


def driven(
    store: SegmentStore, items: list[int], config: EvaluateConfig = LINES, **changes: Any
) -> Simulation:
    agent = make_agent(search=SEARCH, **changes)
    return simulation(agent, crowd_dataset(store, agent, config).scenes(items), config)


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
    config = replace(LINES, rollouts=3, **crowd)
    whole = driven(store, [1, 2, 3], config)
    assert whole.steps > 1.1 * 3 * 3 * (whole.rollouts.state.shape[2] - 1)
    monkeypatch.setattr(sys.modules["symphony.rollouts.search"], "FEW", 3)
    part = driven(store, [3, 1], config)  # and fewer at a time than there are
    agents, steps = part.rollouts.state.shape[3], part.rollouts.counted.shape[2]
    for name in Rollouts._fields:
        cut = steps + (name == "state")
        value = getattr(whole.rollouts, name)[[2, 0], :, :cut, :agents]
        assert torch.equal(value, getattr(part.rollouts, name))
    assert torch.equal(whole.goal[[2, 0], :, :agents], part.goal)


def test_lines_avoid_what_they_are_judged_by(store: SegmentStore) -> None:
    def rate(config: EvaluateConfig) -> float:
        found = driven(store, [4], replace(config, rollouts=24), goals=False).rollouts
        return float((found.collision & found.counted).any(-1).any(-1).float().mean())

    none = rate(NONE)
    assert none > 0.3
    assert max(rate(replace(LINES, score="flags")), rate(LINES)) < 0.6 * none


def test_who_begins_again_draws_goals_anew(store: SegmentStore, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules["symphony.rollouts.search"]
    monkeypatch.setattr(module, "Backtrack", lambda *given, **named: Backtrack(*given, **named, back=(1, 0)))
    config = replace(LINES, score="flags", threshold=-1.0, rollouts=8)  # bad whatever happens
    none, lines, logged = (
        driven(store, [0, 2], how)
        for how in (replace(config, search="none"), config, replace(config, logged_goals=True))
    )
    assert (none.goal[:, :, None] != none.goal[:, None]).any(), "all follow the same routes"
    assert not torch.equal(none.goal, lines.goal)
    routes = crowd_dataset(store, make_agent(search=SEARCH), config).scenes([0, 2])
    assert routes.route_count.gather(-1, lines.goal.transpose(1, 2).clamp_min(0)).all()
    assert torch.equal(logged.goal, routes.route_logged[:, None].expand_as(logged.goal))


@pytest.mark.parametrize("segment", [crossing(6, seed=1, steps=12), straight_road(6, seed=0, steps=12)])
def test_the_rule_is_that_of_the_gaps_agents_may_observe(segment: Any) -> None:
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


def test_what_is_searched_for_is_on_record(store: SegmentStore) -> None:
    agent = make_agent(search=SEARCH)
    for changes, way in (
        ({"score": "flags"}, "tree-1x4-systematic-every2-at0.6-score=flags"),
        ({"search": "backtrack"}, "backtrack-every2-threshold=1.0"),
    ):
        found = evaluate(agent, store, replace(EvaluateConfig(rollouts=2), **changes), items=[0, 1])
        record = evaluation_record(agent, found, store)
        assert simulation_way(record["config"]) == way
        assert record["cost"]["steps"] == found.steps >= 4 * 2


def test_agents_are_searched_as_they_are_meant_to_be(store: SegmentStore) -> None:
    """Without a discriminator by what they do; the included ones go back by the rule."""
    blind = replace(make_agent(search=SEARCH), discriminator=None)
    assert blind.plan(EvaluateConfig()).kind == "none"
    assert blind.plan(EvaluateConfig(rollouts=1, score="rule")).kind == "tree"
    quiet = replace(LINES, rollouts=1)
    assert evaluate("constant_velocity", store, quiet, items=[0]).search == "backtrack"
    with pytest.raises(ConfigError, match="another score: --score flags or rule"):
        blind.plan(EvaluateConfig(search="backtrack"))
    for name in ("bc_ts_h", "mgail_ts_h"):
        agent = load_agent(f"pretrained:{name}")
        plan = agent.plan(EvaluateConfig())
        assert (plan.kind, plan.search.score, plan.search.threshold) == ("backtrack", "rule", 0)
        assert agent.plan(EvaluateConfig(search="tree")).kind == "tree"
    plan = make_agent(search=SEARCH).plan(EvaluateConfig(rollouts=4))
    assert (plan.kind, plan.trees, plan.taken, plan.search.score) == ("tree", 1, 4, "discriminator")


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
