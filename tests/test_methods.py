"""The rows of the paper's tables: what training each of them means, and what their data is."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from helpers_runs import Trained, build, pieces, same_weights, stopped, tiny, trained_as, weights
from helpers_segments import crossing, hide, straight_road
from helpers_store import stored
from symphony import keys
from symphony.agents.checkpoint import CheckpointError
from symphony.collectors import BeamSearchCollector
from symphony.config import AgentSpec, SearchConfig, read_json, to_json
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, Displacement, DrivingEnv, ObservationConfig
from symphony.errors import ConfigError
from symphony.learning import SearchReplay, transitions
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.experts import logged
from symphony.learning.replay import COLLIDED, MEMORY, OFF_ROAD, PRICE, advantages
from symphony.recipes import train
from symphony.training import Trainer
from symphony.training.logging import read_metrics

NETWORKS = {"bc": {"policy"}, "bc_h": {"policy", "goals"}, "bc_ts": {"policy", "discriminator"}}
NETWORKS |= {"bc_rl": {"policy"}, "bc_rl_h": NETWORKS["bc_h"], "bc_ts_h": {"policy", "goals", "discriminator"}}
METHODS: tuple[Any, ...] = tuple(NETWORKS)
ROUTED = ObservationConfig(num_objects=4, num_points=12, route=True)


LATE = hide(crossing(5, seed=1, steps=6), 3, slice(0, 4))  # one vehicle comes into sight after the start
GAP = hide(straight_road(4, steps=5), [1, 2, 3], 2)  # all but the ego are out of sight once
store = stored(lambda: [GAP, crossing(4, steps=7), LATE])
trained = trained_as(tiny)


def of(network: str, found: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value for name, value in found.items() if name.startswith(f"{network}.")}


@pytest.mark.parametrize("method", METHODS)
def test_each_method_trains_its_networks_and_tells_of_them(trained, store, tmp_path, method):
    run = trained(method)
    trainer, after = build(tiny(method, store, tmp_path)), weights(run)
    fresh, rates = trainer.agent.modules, trainer.phases[0].rates
    assert all((rates(step).get("goals", 0) > 0) == (step < 2 and "goals" in fresh) for step in range(4))
    assert set(fresh) == {name.split(".")[0] for name in after} == NETWORKS[method]
    for name, module in fresh.items():
        before = {f"{name}.{key}": value for key, value in module.state_dict().items()}
        assert of(name, after).keys() == before.keys()
        assert all(torch.isfinite(value).all() for value in of(name, after).values())
        assert sum(not torch.equal(before[key], after[key]) for key in before) >= 0.8 * len(before), name
    records = read_metrics(run)
    assert [r["step"] for r in records] == [1, 2, 3, 4]
    assert not {"NaN", "Infinity"} & set(re.findall(r"\w+", (run / "metrics.jsonl").read_text()))
    for name, statistic in {"policy": "accuracy", "goals": "accuracy_top3", "discriminator": "auc"}.items():
        told = {f"{name}_{statistic}", f"loss_{name}", f"gradient_norm_{name}"}
        assert told & records[0].keys() == (told if name in NETWORKS[method] else set())
        for r in records if name in NETWORKS[method] else ():
            assert math.isfinite(r[f"loss_{name}"])
            assert r[f"gradient_norm_{name}"] > 0
    # Who simulates learns from that, too.
    both = [name in records[0] for name in ("policy_nll_rollout", "search_offroad_kept")]
    assert both == [method not in {"bc", "bc_h"}] * 2


def test_the_seed_decides_the_weights(trained: Trained, store: Path, tmp_path: Path) -> None:
    """Whether the same seed gives the same weights is tested with checkpoints."""
    first = weights(trained("bc_ts_h"))
    other = weights(train(tiny("bc_ts_h", store, tmp_path / "other", seed=1)))
    assert not any(same_weights(of(n, other), of(n, first)) for n in ("policy", "goals", "discriminator"))


@pytest.mark.parametrize("method", METHODS)
def test_a_resumed_run_ends_like_an_uninterrupted_one(trained, store, tmp_path, method):
    stopped(trained(method), tmp_path / "part", 2)
    train(tiny(method, store, tmp_path / "part", resume=True))
    assert same_weights(weights(tmp_path / "part"), weights(trained(method)))
    assert [r["step"] for r in read_metrics(tmp_path / "part")] == [1, 2, 3, 4]


def test_a_warm_start_takes_over_what_both_runs_have(trained, store, tmp_path, monkeypatch):
    # Rates so small that no weight moves.
    monkeypatch.setattr("symphony.config.training.DISCRIMINATOR_RATE", 1e-30)
    changes: dict[str, Any] = {"learning_rate": 1e-30, "steps": 2, "seed": 9}

    def warm(method: str, source: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        run = train(tiny(method, store, tmp_path / method, warm_start=trained(source), **changes))
        return weights(run), weights(trained(source))

    after, before = warm("bc_ts_h", "bc_h")
    fresh = build(tiny("bc_ts_h", store, tmp_path / "fresh", **changes)).agent.modules["discriminator"]
    before |= {f"discriminator.{k}": v for k, v in fresh.state_dict().items()}
    assert same_weights(after, before)
    # And from one with more networks than are asked for.
    after, before = warm("bc_h", "bc_ts_h")
    assert same_weights(after, {k: v for k, v in before.items() if "discriminator" not in k})


def test_a_resumed_run_does_not_start_warm_again(trained: Trained, store: Path, tmp_path: Path) -> None:
    whole = tiny("bc_ts", store, tmp_path / "whole", warm_start=trained("bc"))
    train(whole)
    assert not same_weights(of("policy", weights(whole.out)), of("policy", weights(trained("bc_ts"))))
    stopped(whole.out, tmp_path / "part", 2)
    train(replace(whole, out=tmp_path / "part", resume=True))
    assert same_weights(weights(tmp_path / "part"), weights(whole.out))


def test_a_warm_start_that_does_not_fit_leaves_no_run_behind(trained, store, tmp_path):
    for source, why in ((tmp_path / "nowhere", "no such folder"), (trained("bc_h"), r"another goals \(was True\)")):
        with pytest.raises((ConfigError, CheckpointError), match=why):
            train(tiny("bc", store, tmp_path / "run", warm_start=source))
        # Else the corrected command would be refused: the folder holds a run already.
        assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.parametrize(("part", "change", "expected"), [
    ("agent", {"hidden": None}, "agent.hidden must be int"),
    ("agent", {"hidden": 10**30}, "agent.hidden must be at most"),
    ("agent", {"interactive": 10**30}, "agent.interactive must be at most"),
    ("", {"dt": 10**400}, "dt must be float"),
    ("search", {"threshold": float("nan")}, "search.threshold must be a number, is nan"),
])  # fmt: skip
def test_a_damaged_agent_is_named(store, tmp_path, part, change, expected):
    saved = json.loads(to_json(build(tiny("bc_ts", store, tmp_path / "run")).agent.spec))
    (saved[part] if part else saved).update(change)
    file = tmp_path / "agent.json"
    file.write_text(json.dumps(saved))
    with pytest.raises(ConfigError, match=rf"agent\.json: {expected}"):
        read_json(AgentSpec, file)


def test_checkpoints_must_fall_on_searches(store: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="multiple of search"):
        build(tiny("bc_ts_h", store, tmp_path / "run", checkpoint_every=3))
    assert not (tmp_path / "run").exists()
    build(tiny("bc_h", store, tmp_path / "run", checkpoint_every=3))
    for bad in ({"temperature": 0}, {"branches": 0}, {"updates": 0}):
        with pytest.raises(ConfigError):
            SearchConfig(**bad)


def searched(store: Path, out: Path, **changes: Any) -> tuple[dict[str, Tensor], SearchReplay]:
    """Return what the first update of a run with search and goals records, and what it learned from."""
    trainer = build(tiny("bc_ts_h", store, out, segments=3, **changes))
    record = trainer._update(0)
    return record, pieces(trainer)["replay"]


def led_to(steps: TensorDictBase) -> TensorDictBase:
    """The states after steps."""
    after = steps.select(keys.SCENE, keys.STREAM, keys.VALID, keys.GOAL)
    for key in (keys.STATE, keys.PROGRESS):
        after.set(key, steps[("next", *key)])
    return after.set(keys.STEP, steps[keys.STEP] + 1)


def test_searches_are_scored_up_to_the_end_of_each_scene(store: Path, tmp_path: Path) -> None:
    wide = SearchConfig(branches=4, prune_every=4, updates=2, states=8)
    record, replay = searched(store, tmp_path, search=wide)
    env, found = replay.env, replay.leaves
    for steps, kind in ((found["tree"], "all"), (found, "kept")):
        seen = env.at(led_to(steps))
        going = (seen[keys.STEP] <= env.scenes.last_step[seen[keys.SCENE]]) & seen[keys.VALID]
        assert not going.all()
        for name, key in (("collision", keys.COLLISION), ("offroad", keys.OFFROAD)):
            share = seen[key].squeeze(-1)[going].float().mean()
            torch.testing.assert_close(record[f"search_{name}_{kind}"], share)
        assert record[f"search_offroad_{kind}"] > 0


def test_what_is_searched_is_what_is_imitated(store: Path, tmp_path: Path) -> None:
    """Actions of survivors lead from each of their states to the next."""
    _, replay = searched(store, tmp_path)
    env, lived = replay.env, replay.leaves.exclude("tree", "collector")
    before, after = lived[..., :-1], lived[..., 1:]
    stepped = env.step(env.at(before).set(keys.ACTION, before[keys.ACTION]))["next"]
    assert torch.equal(stepped[keys.STATE], after[keys.STATE])
    assert torch.equal(stepped[keys.GOAL], after[keys.GOAL])


def test_the_discriminator_is_shown_what_was_simulated_and_what_was_logged(store: Path, tmp_path: Path) -> None:
    """After the first state, which is the same in both, up to the end of each scene."""
    _, replay = searched(store, tmp_path, search=SearchConfig(branches=4, prune_every=4, updates=2, states=200))
    env, tree, both = replay.env, replay.leaves["tree"], replay.both_kinds(torch.Generator().manual_seed(0))
    assert torch.equal(both[keys.SIMULATED], (torch.arange(400) < 200)[:, None].expand(-1, 2))
    after = led_to(tree)[(tree[keys.STEP] < env.scenes.last_step[tree[keys.SCENE]]).squeeze(-1)]
    names = (keys.SCENE, keys.STEP, keys.STREAM, keys.VALID, keys.STATE, keys.GOAL, keys.PROGRESS)
    same = [(both[name][:200, None] == after[name]).flatten(2).all(-1) for name in names]
    assert torch.stack(same).all(0).any(1).all()
    real, fit = both[200:], replay.data.fitted(env.scenes.segment.tolist(), env.scenes)
    at = real[keys.SCENE].squeeze(-1), real[keys.STEP].squeeze(-1)
    for name, expected in ((keys.STATE, fit.state), (keys.VALID, fit.valid), (keys.PROGRESS, fit.progress)):
        assert torch.equal(real[name], expected[at])
    assert torch.equal(real[keys.GOAL], env.scenes.route_logged[at[0]])
    seen = torch.zeros_like(fit.valid[..., 0]).index_put(at, torch.tensor(True))
    assert torch.equal(seen[:, 1:], fit.valid[:, 1:].any(-1))
    fit.state[0, 4:, 0, 0] += 2.1  # where a fit leaves the log it is not shown
    replay._fitted = fit
    real = replay.both_kinds(torch.Generator().manual_seed(0))[200:]
    far = (torch.arange(len(fit.valid[0])) > 3) & fit.valid[0, :, 0]
    left = (fit.valid[0].any(-1) & ~far).nonzero().flatten().tolist()
    assert {0, *real[keys.STEP][real[keys.SCENE] == 0].tolist()} == {0, *left}


@pytest.mark.parametrize("method", ["bc_rl", "bc_rl_h"])
def test_blame_is_what_came_of_an_action_beyond_the_mean_of_the_other_branches(method, store, tmp_path):
    search = SearchConfig(branches=4, prune_every=4, updates=2, states=8, rule="replace", goals="branch")
    with pytest.raises(ConfigError, match=r"search\.branches must be at least 2"):
        build(tiny(method, store, tmp_path, search=replace(search, branches=1)))._update(0)
    trainer = build(tiny(method, store, tmp_path, segments=3, search=search))
    trainer._update(0)
    replay = pieces(trainer)["replay"]
    env, leaves = replay.env, replay.leaves.clone()
    env.scenes.last_step[leaves[0, 0, 0][keys.SCENE]] //= 2  # a shorter one
    rng = torch.Generator().manual_seed(0)
    for key in (keys.COLLISION, keys.OFFROAD):  # of one sort or another, not what happens to be
        leaves["next", key] = torch.rand(leaves["next", key].shape, generator=rng) < 0.2
    found, fade = advantages(env, leaves), math.exp(-env.dt / MEMORY)
    going = leaves[keys.STEP] < env.scenes.last_step[leaves[keys.SCENE]]
    there = leaves[keys.VALID] & going
    hit, off = (leaves["next", key].squeeze(-1) & there for key in (keys.COLLISION, keys.OFFROAD))
    cost, to_go = COLLIDED * hit + OFF_ROAD * env.dt * off, [torch.zeros(hit[:, :, 0].shape)]
    for t in reversed(range(hit.shape[2])):
        to_go.insert(0, fade * to_go[0] * ~hit[:, :, t] - cost[:, :, t])
    to_go, counts = torch.stack(to_go[:-1], 2).numpy(), (there & (hit.cumsum(2) - hit.long() == 0)).numpy()
    for b, s, t, n in np.ndindex(found.shape):
        others = [k for k in range(4) if k != s and counts[b, k, t, n]]
        mean = np.mean(to_go[b, others, t, n]) if others else to_go[b, s, t, n]
        expected = (to_go[b, s, t, n] - mean) * counts[b, s, t, n]
        assert found[b, s, t, n].item() == pytest.approx(expected, abs=1e-5)
    # Drawn with weights, their mean is that over all.
    replay._leaves = leaves
    many = replay.blamed(20_000, torch.Generator().manual_seed(0), ObservationConfig.nothing())
    blame = found.abs()[going[..., 0]]
    assert many[keys.WEIGHT].abs().mean().item() == pytest.approx(PRICE * blame.mean().item(), rel=0.05)
    worst = blame.amax(-1)
    assert (many[keys.WEIGHT].abs().amax(-1) <= PRICE * worst.mean() * 1.001).all()


@pytest.mark.parametrize(("method", "per"), [("bc_ts_h", "tree"), ("bc_ts_h", "branch"), ("mgail_h", "tree")])
def test_searches_follow_routes_that_the_goal_policy_draws(store, tmp_path, method, per):
    """As in evaluation: new ones at every search, feasible, those of a tree together unless branches draw alone."""
    wide = SearchConfig(branches=8, prune_every=99, updates=2, states=8, goals=per)
    replay, drawn = pieces(build(tiny(method, store, tmp_path, segments=3, search=wide)))["replay"], []
    for _ in range(6):
        start, env = replay.collector.rollout()["tree"][..., 0], replay.env
        goal, valid = start[keys.GOAL], start[keys.VALID]
        assert (goal[valid] < env.choices(start)[keys.ROUTES_MASK].sum(-1)[valid]).all()
        assert (goal == goal[:, :1]).all() == (per == "tree")
        logged = env.scenes.route_logged[start[keys.SCENE].squeeze(-1)]
        drawn.append((goal == logged).float().mean().item())
        assert ((goal >= 0) == (logged >= 0)).all()
    assert min(drawn) < 1
    assert len(set(drawn)) > 1


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_expert_batches_show_what_the_environment_shows_with_logged_goals(store: Path, dynamics: Any) -> None:
    dataset = SceneDataset(SegmentStore(store), 2, dynamics, routes=True)
    for item in range(3):
        env = DrivingEnv(dataset.scenes([item]), dynamics, ROUTED)
        start = env.with_goals(env.start(torch.tensor([0])))
        batch = dataset.sample_states([0, item], 1500, ROUTED, torch.Generator().manual_seed(0))
        assert batch[keys.VALID].all()
        # Points are fixed in the world, so that few other states look alike.
        sums, at_start = (b[keys.POINTS].double().sum((-1, -2)) for b in (batch, start))
        for agent in range(2):
            near = (sums[:, 0] - at_start[0, agent]).abs() < 1e-4
            assert near.any()
            for key in (keys.OWN, keys.ROUTE, keys.POINTS, keys.OBJECTS, keys.OBJECTS_MASK):
                expected = start[key][0, agent].expand_as(batch[key][near, 0])
                torch.testing.assert_close(batch[key][near, 0], expected, atol=1e-4, rtol=0)


def test_goal_batches_are_the_choices_of_the_environment(store: Path) -> None:
    dataset = SceneDataset(SegmentStore(store), 2, Bicycle(), routes=True)
    for item in range(3):
        env, experts = DrivingEnv(dataset.scenes([item]), Bicycle(), ROUTED), dataset.experts(item)
        seen = env.choices(env.start(torch.tensor([0])))
        one = {"points": np.float32([[0, 0]]), "count": [1], "right": [True], "change": np.float32([np.inf])}
        more = [{name: np.append(getattr(each, name), one[name], 0) for name in one} for each in experts.routes]
        tables = tuple(replace(each, **found) for each, found in zip(experts.routes, more, strict=True))
        dataset.experts.kept[item] = replace(experts, routes=tables), 0
        batch = dataset.sample_goals([item], 60, ROUTED, torch.Generator().manual_seed(0))
        routes, mask, label = (batch[key][:, 0] for key in (keys.ROUTES, keys.ROUTES_MASK, keys.GOAL))
        assert batch[keys.VALID].all()
        assert mask.gather(-1, label[:, None]).all()
        for agent in range(2):
            own = seen[keys.ROUTES][0, agent, seen[keys.ROUTES_MASK][0, agent]]
            same = (mask.sum(-1) == len(own)) & mask[:, : len(own)].all(-1)
            same &= (routes[:, : len(own)] - own).abs().amax((-1, -2)) < 1e-4
            assert same.any()
            assert (label[same] == env.scenes.route_logged[0, agent]).all()
            table = tables[experts.agent.tolist().index(int(env.scenes.interactive[0, agent]))]
            right = torch.tensor([*table.right[:-1], False])  # one point more is no choice
            assert (batch[keys.GOAL_SET][same, 0, : len(right)] == right).all()


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_fitted_states_are_the_experts_and_transitions_lead_through_them(store, dynamics, monkeypatch):
    data, items = SceneDataset(SegmentStore(store), 2, dynamics, routes=True), [2, 0, 1]
    sees = ObservationConfig(num_objects=3, num_points=4, route=True)
    env, fit = DrivingEnv(data.scenes(items), dynamics, sees), data.fitted(items, data.scenes(items))
    found = transitions(data, items, sees, reward=lambda before, after: after[keys.STATE][..., 3])
    log, log_valid = logged(env.scenes)
    assert torch.equal(fit.valid, log_valid)
    assert (fit.state - log)[..., :2].norm(dim=-1)[log_valid].max() < 0.5
    assert found["next", "truncated"].sum() == len(items)
    assert DrivingEnv(data, dynamics, sees).action_spec == env.action_spec
    for b, item in enumerate(items):
        experts = data.experts(item)
        steps, rows = experts.states.shape[1], experts.agent.tolist()
        for n, agent in enumerate(env.scenes.interactive[b].tolist()):
            assert torch.equal(fit.state[b, :steps, n], experts.states[rows.index(agent)])
            assert torch.equal(fit.progress[b, :steps, n], experts.progress[rows.index(agent)])
        now = env.with_goals(env.start(torch.tensor([b])))
        for step in found[found["scene"].squeeze(-1) == b]:
            known, after = step[keys.VALID], step["next"]
            now = env.step(now.set(keys.ACTION, step[keys.ACTION][None]))["next"]
            assert {*now.keys(True, True)} == {*after.keys(True, True)}
            torch.testing.assert_close(now[keys.STATE][0][known], after[keys.STATE][known])
            fitted = fit.state[b, int(after[keys.STEP])]
            torch.testing.assert_close(after[keys.STATE][known], fitted[known], atol=1e-3, rtol=0)
            torch.testing.assert_close(after[keys.REWARD][known][:, 0], after[keys.STATE][known][:, 3])
    (off := env.scenes.clone()).route_logged.fill_(-1)  # on no lane, which is not forgotten
    monkeypatch.setattr(data, "scenes", lambda items: off)
    assert len(transitions(data, items, sees)) == len(found)
    with pytest.raises(ConfigError, match="routes=True"):
        transitions(SceneDataset(SegmentStore(store), 2, dynamics), items, sees)


def test_one_search_serves_as_many_updates_as_configured(store, tmp_path, monkeypatch):
    done: list[Any] = []
    for owner, name in ((Trainer, "_update"), (BeamSearchCollector, "rollout")):
        original = getattr(owner, name)
        noted = lambda self, *given, original=original: (done.append(given), original(self, *given))[1]  # noqa: E731
        monkeypatch.setattr(owner, name, noted)
    settings = tiny("bc_ts", store, tmp_path / "run", steps=6, checkpoint_every=6)
    train(replace(settings, search=replace(settings.search, updates=3)))
    assert done == [(0,), (), (1,), (2,), (3,), (), (4,), (5,)]
