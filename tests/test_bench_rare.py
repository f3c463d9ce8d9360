"""Rare failures: their estimated rate has no bias, on a chain whose rate is known and on the road."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from helpers_saved import played
from helpers_segments import straight_road
from helpers_store import brief
from symphony import keys
from symphony.bench.rare import Rate, _kept, _rate, leaf_weights, remarks, resampling
from symphony.cli import main
from symphony.collectors import Systematic, beam_search, branch
from symphony.data.builtin import builtin_store
from symphony.envs.driving import DrivingEnv
from symphony.envs.scene import scene
from symphony.evaluation.report import report
from symphony.planners.nearness import Nearness
from symphony.roadgraph import LaneGraph
from symphony.saved.folder import load_rollouts

EXAMPLES = Path(__file__).parents[1] / "examples"
UP, TOP, STEPS = 0.25, 8, 12


class Chain(EnvBase):
    """One up or down by the action, never below 0; it ends at the top."""

    batch_locked = False

    def __init__(self) -> None:
        super().__init__(batch_size=[])
        self.observation_spec = Composite(x=Unbounded((1,)))
        self.state_spec, self.action_spec = self.observation_spec.clone(), Unbounded((1,))

    def _set_seed(self, seed: int | None) -> None: ...

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        raise NotImplementedError

    def _step(self, td: TensorDictBase) -> TensorDictBase:
        x = torch.where(td["x"] >= TOP, td["x"], (td["x"] + td["action"]).clamp_min(0.0))
        zero = torch.zeros_like(x)
        return TensorDict({"x": x, "reward": zero, "done": zero.bool()}, td.shape)


def known_rate() -> float:
    """The probability that the chain has come to its top, by the law of total probability."""
    share = np.eye(1, TOP + 1)[0]
    for _ in range(STEPS):
        after = np.append(np.zeros(TOP), share[TOP])
        after[1:] += UP * share[:-1]
        after[:-2] += (1 - UP) * share[1:-1]
        after[0] += (1 - UP) * share[0]
        share = after
    return float(share[TOP])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brief(tmp_path_factory.mktemp("data") / "store", (0, 19, 3), steps=21)


@pytest.mark.parametrize("rule", [resampling(), Systematic()], ids=["seldom", "always"])
def test_the_rate_of_a_chain_is_found_without_bias_by_few_branches(rule: Systematic) -> None:
    """To the exact rate, with an error far below that of as many free rollouts."""
    torch.manual_seed(0)
    rows, branches = 200, 64
    found = beam_search(
        Chain(), lambda td: td.set("action", 1.0 - 2.0 * (torch.rand(*td.shape, 1) >= UP)),
        lambda td: torch.zeros_like(td["x"]),
        branch(TensorDict({"x": torch.zeros(rows, 1)}, [rows]), branches), steps=STEPS, prune_every=2,
        rule=rule, noise=torch.rand(rows, STEPS // 2), value=lambda td: -0.8 * td["x"].squeeze(-1),
        prune_last=False, keep=[("next", "x")],
    )  # fmt: skip
    top = found.trajectories["next", "x"][..., -1, 0] >= TOP
    estimates, rate = (leaf_weights(found) * top).mean(-1), known_rate()
    error = float(estimates.std()) / math.sqrt(rows)
    assert rate < 1e-3
    assert abs(float(estimates.mean()) - rate) < 4 * error
    # A tenth of the steps of free rollouts with that error.
    assert 10 * error**2 < rate / (rows * branches)


def test_near_is_whoever_is_ahead_and_a_hit_is_remembered() -> None:
    segment = straight_road(3, steps=3)
    scenes = scene(segment, [0, 1, 2], LaneGraph(segment.road))
    env = DrivingEnv(scenes)

    def near(gap: float, speed: float, behind: float = 6.0, hit: float = 0.0, aside: float = 0.0) -> float:
        start = env.start(torch.zeros(1, dtype=torch.int64))
        x = torch.tensor([0.0, float(scenes.box_size[0, :2, 0].mean()) + gap, -behind])
        y, zero = torch.tensor([0.0, 0.0, aside]), torch.zeros(3)
        state = torch.stack([x, y, zero, torch.tensor([speed, 0.0, 0.0])], -1)
        lure = Nearness(env, start)
        start.set(keys.STATE, state[None])
        start.set("hit", torch.full((1, 1), hit))
        return float(lure.near(start))

    assert near(1.0, 20.0) > near(4.0, 20.0) > near(15.0, 20.0) > near(4.0, 0.0) > 0
    assert near(300.0, 0.0) == 0
    assert near(300.0, 0.0, behind=0.5) == 0
    # Who merges from beside counts, with its centre behind the ego's or not.
    assert near(300.0, 0.0, behind=2.0, aside=2.5) > near(300.0, 0.0, behind=2.0, aside=4.0) > 0
    assert near(300.0, 0.0, behind=9.0, aside=2.5) == 0
    assert near(-1.0, 5.0) == 1
    assert near(300.0, 0.0, hit=1.0) == 1
    at, height = env.objects, torch.tensor([[[0.0, 1], [6, 2], [0, 1]]])  # one is on a bridge
    env.objects = lambda *state: at(*state)._replace(height=height)  # type: ignore[method-assign]
    assert near(-1.0, 5.0) == 0 < near(-1.0, 5.0, behind=2.0, aside=2.5)


def test_the_command_finds_the_rate_of_free_rollouts_and_keeps_what_shows_it(tmp_path, capsys):
    coast, agent, out = EXAMPLES / "coast.py", "random --interactive 4", tmp_path / "out"
    words = f"{agent} --planner {coast}:plan --data {brief(tmp_path / 'store', (2,), steps=51)}".split()
    kept = f"--metric collision_rate --trees 4 --branches 8 --out {out} --json -".split()
    assert main(["hunt", *words, *kept]) == 0
    segment, mean = json.loads(capsys.readouterr().out)
    assert (segment["rate"], segment["error"], mean["segment"]) == (mean["rate"], mean["error"], None)
    assert main(["simulate", *words, "--rollouts", "16", "--out", str(tmp_path / "free")]) == 0
    rate = report(load_rollouts(tmp_path / "free"), "ego").totals()["collision_rate"] / 100
    assert 0 < rate < 1
    assert abs(mean["rate"] - rate) < 3 * math.hypot(mean["error"], math.sqrt(rate * (1 - rate) / 16))
    capsys.readouterr()
    (saved,) = load_rollouts(out)
    assert saved.rollouts == segment["kept"] > 0
    assert saved.collision[:, :, 0].any(1).all()
    assert main(["hunt", *words, *kept, "--metric", "offroad_rate"]) == 1
    assert "another simulation, which differs in settings.hunt" in capsys.readouterr().err
    # What was picked is no sample of anything.
    for command in (["report", str(out)], ["planners", str(tmp_path / "free"), str(out)]):
        assert main(command) == 1
        assert "give no rates" in capsys.readouterr().err
    assert main(["view", str(out)]) == 0


@pytest.mark.parametrize("words", ["idm", "constant_velocity", "pretrained:bc_ts_h --interactive 1"])
def test_where_nothing_is_random_there_is_nothing_to_hunt(words, tmp_path, capsys):
    command = f"hunt {words} --planner log --data {builtin_store('test')} --segments 0 --out {tmp_path}"
    assert main(command.split()) == 1
    assert "one run of each segment is enough" in capsys.readouterr().err


def test_what_a_rate_is_worth_is_said():
    def said(rate, trees):
        return " ".join(remarks([Rate("a", rate, 0.1, trees, 1), Rate(None, rate, 0.1, trees, 1)]))

    assert said(0.1, 4) == ""
    assert "rough" in said(0.1, 3)
    assert "take more branches" in said(1.1, 8)
    assert "bounds no rate" in said(0.0, 0)
    assert said(math.nan, 0) == ""
    saved = played(straight_road(2, steps=4), rollouts=6)
    saved.state[:, 0, 0, 0] = np.arange(6)
    kept = _kept(saved, np.array([[False, False, True], [False, True, True]]))  # the first of each tree
    found = _rate(kept, np.array([0.0, 0.3, 0.6]), "")
    assert (kept.state[:, 0, 0, 0].tolist(), found.kept, found.trees) == ([2, 4], 2, 2)
    assert (found.rate, found.error) == (pytest.approx(0.3), pytest.approx(0.3 / math.sqrt(3)))


def test_a_hunt_says_no_zero_for_what_it_does_not_know(store, tmp_path, capsys):
    plan = "def plan(s):\n    if '001000-f0-w09' in s.segment_id: raise ValueError('flat tyre')\n    return 0, 0\n"
    (tmp_path / "fails.py").write_text(plan)
    words = f"hunt pretrained:bc_ts_h --data {store} --trees 4 --branches 2 --duration 2 --out x".split()

    def told(planner, segment, out, *more):
        words[-1] = str(tmp_path / out)
        code = main([*words, "--planner", planner, "--segments", *segment.split(), *more])
        return code, *capsys.readouterr()

    fails = f"{tmp_path / 'fails.py'}:plan"
    code, _, error = told(fails, "0", "all")
    assert code == 3
    assert re.search(r"failed in 8 of 8 runs, the first: .*flat tyre.*metric failed_rate", error)
    found = json.loads(told(fails, "0 1", "failed", "--metric", "failed_rate", "--json", "-")[1])
    assert [one["rate"] for one in found] == [pytest.approx(1.0, abs=0.5), 0.0, found[0]["rate"] / 2]
    # Where it fails in one segment, the others have their rates; the same hunt finds the same once more.
    for _ in range(2):
        code, text, error = told(fails, "0 1", "one", "--metric", "collision_rate", "--json", "-")
        lost, other, mean = json.loads(text)
        assert (code, lost["rate"], mean["rate"]) == (0, None, other["rate"])
        assert lost["failed"] in error
        folder = load_rollouts(tmp_path / "one")
        assert [entry.failed for entry in folder.failures] == [lost["failed"]]
        assert [saved.rollouts for saved in folder] == [other["kept"]] * bool(other["kept"])
    # Nobody is hit: the rate is 0 as far as was seen, and has no error; no light is there to be run.
    zero = json.loads(told("log", "0", "zero", "--json", "-")[1])[-1]
    assert (zero["rate"], zero["error"]) == (0.0, None)
    assert re.search(r"mean of 0 +– +– +0 of 0 +0\n", told("log", "2", "dark", "--metric", "red_light_rate")[1])
