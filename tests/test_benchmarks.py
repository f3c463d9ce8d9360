"""The programs of benchmarks/ fit the package, and their tables say what was measured. Nothing is timed here."""

from __future__ import annotations

import importlib
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers_segments import LANE_WIDTH, crossing, make_segment, straight_road
from helpers_store import brief, fill
from symphony import DrivingEnv, ObservationConfig, keys
from symphony.agents import load_agent
from symphony.agents.checkpoint import save_checkpoint
from symphony.agents.choice import FOLDER as PRETRAINED
from symphony.envs import Bicycle, ConstantVelocity, scene
from symphony.learning import SearchReplay
from symphony.modules import mlp, pool_elements

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(name="program")
def _program(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module


def test_parts_are_functions_that_exist(program: Any) -> None:
    measure = program("measure")
    paths = {path for row in measure.rows().values() for path in row.parts}
    assert len(paths) > 10
    for path in paths:
        owner, name = measure.located(path)
        assert callable(getattr(owner, name)), path


def test_all_agents_of_a_ring_step_and_segments_are_prepared(program: Any) -> None:
    work, steps = program("workloads").rings(2, 4, count=2, agents=3)
    prepare, segments = program("workloads").preparation(1)
    assert (steps, segments, prepare()) == (2 * 3, 1, None)
    after = work()["next", "agents"]
    assert after["valid"].all()
    assert after["state"].isfinite().all()


def test_dense_counts_the_operations_of_every_element(program: Any) -> None:
    measure, encoder = program("measure"), mlp((3, 4, 5))
    sets, mask, found = torch.rand(2, 100, 3), torch.ones(2, 100).bool(), {}
    for how, pool in {"auto": pool_elements, "dense": partial(measure.densely, pool_elements)}.items():
        with measure.Calls() as calls:
            pooled = pool(encoder, sets, mask, mode="auto")
        with measure.Calls() as back:
            gradients = torch.autograd.grad(pooled.sum(), encoder.parameters())
        found[how] = calls.flops, back.flops, gradients
    forward = 2 * 200 * (3 * 4 + 4 * 5)
    # Backwards once more for the weights, and once for what the second layer is given.
    assert found["dense"][:2] == (forward, forward + 2 * 200 * 4 * 5)
    assert found["auto"][1] < found["dense"][1] / 10
    torch.testing.assert_close(found["auto"][2], found["dense"][2])


def test_a_step_and_an_update_start_no_more_operators(program: Any, tmp_path: Path, monkeypatch: Any) -> None:
    """Each is a launch on a device. Whoever needs more raises the bound, and says why."""
    launches, store = program("launches"), brief(tmp_path / "store", range(2), 16, "train")
    monkeypatch.setattr(launches, "builtin_store", lambda split: store)
    step = launches.of_a_search_step()
    assert step["environment"] <= 832
    assert step.total() - step["environment"] <= 200
    assert launches.of_an_update("bc").total() <= 700
    monkeypatch.setattr(torch, "compile", lambda step, **_: step)  # one program, whatever is in it
    assert launches.of_a_search_step(compile_step=True).total() <= 40


def test_reinforcement_learning_is_recorded(program: Any, tmp_path: Path, monkeypatch: Any) -> None:
    learning = program("reinforcement")
    store = fill(tmp_path / "store", [straight_road(4, steps=14), crossing(4, steps=14)]).path
    monkeypatch.setattr(learning, "builtin_store", lambda split: store)
    for name, value in (("SHOWN", (0,)), ("STEPS", 4)):
        monkeypatch.setattr(learning, name, value)
    runs = {method: [learning.run(method, seed, batches=1) for seed in (0, 1)] for method in learning.METHODS}
    for one, other in runs.values():
        driven, crashes = zip(*one["batches"], one["unseen"], strict=True)
        assert 0 < min(driven) <= max(driven) < 2560 * 8
        assert 0 <= min(crashes) <= max(crashes) <= 256
        assert one != other
    longer = {m: [one | {"batches": one["batches"] * 10} for one in runs[m]] for m in runs}
    learning.curves(longer, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5000
    record = learning.record(runs)
    assert [len(row) for row in record["rows"]] == [len(record["columns"])] * 4


def test_being_hit_from_behind_costs_nothing(program: Any, monkeypatch: Any) -> None:
    """By a car of the log; what a car runs into does, and so does whom two meet in the last step."""
    x, speed, lane = np.array([[60, 40, 40, 60, 0, 42], [0, 10, 10, 0, 10, -10], [0, 0, 2, 2, 1, 1]])[..., None]
    place = np.stack([x + speed * np.arange(12) * 0.2, np.repeat(LANE_WIDTH * lane, 12, 1)], -1)
    heading = np.pi * (speed < 0) + np.zeros((6, 12))
    scenes = scene(make_segment(straight_road().road, place, heading, np.gradient(place, 0.2, axis=1)), [0, 2, 4, 5])
    scenes.last_step[:] = 10
    env = DrivingEnv(scenes, Bicycle(), ObservationConfig.nothing())
    start, ahead = env.start(torch.tensor([0])), ConstantVelocity(Bicycle())
    driven = env.rollout(10, ahead, auto_reset=False, tensordict=start)
    after = driven["next"].select(keys.STEP, keys.VALID, keys.STATE)[:, -1:]
    replay = SearchReplay.__new__(SearchReplay)  # searches go on beyond the end, which counts for nothing
    replay.env, replay._leaves = env, torch.cat([driven, driven[:, -1:].clone().update(after)], 1)[:, None]
    monkeypatch.setattr(SearchReplay, "blamed", lambda self, *_: self.leaves)
    judged = program("fine_tuning").at_fault(replay, 1, torch.Generator(), env.observation)
    hit, before = (each["next", keys.COLLISION][0, 0, ..., 0] for each in (judged, replay.leaves))
    assert before.int().argmax(0).tolist() == [7, 7, 9, 9]
    assert torch.equal(hit, before & torch.tensor([False, True, True, True]))
    gone = (torch.arange(11) > 7)[:, None] & torch.tensor([True, False, False, False])
    assert torch.equal(~judged[keys.VALID][0, 0], gone)


def test_planners_are_recorded(program: Any, tmp_path: Path, monkeypatch: Any) -> None:
    planners, small = program("planners"), {"ROWS": 2, "SEEDS": 2, "HORIZON": 8, "ROUNDS": 2, "CANDIDATES": 16}
    small |= {"STEPS": dict.fromkeys(planners.MAKERS, 3)}
    for name, value in (small | {"RECORD": tmp_path / "a.json"}).items():
        monkeypatch.setattr(planners, name, value)
    with pytest.raises(SystemExit):
        planners.main(["--help"])  # measures nothing
    planners.main([])
    record = json.loads((tmp_path / "a.json").read_bytes())
    assert [len(row) for row in record["rows"]] == [len(record["columns"])] * 5
    pole = [row[-1][0] for row in record["rows"]]
    assert max(pole) <= 3
    assert pole[0] < min(pole[1:])


def test_goals_are_chosen_by_all_stores_also_where_they_are_called_alike(program, tmp_path, monkeypatch, capsys):
    stores = [brief(tmp_path / name / "validation", [0], 16) for name in "ab"]
    words = f"goals.py pretrained:bc_ts_h {tmp_path}/out --passes 1 --data {stores[0]} --validation"
    monkeypatch.setattr("sys.argv", [*words.split(), *map(str, stores)])
    program("goals").main()
    assert capsys.readouterr().out.count('"draws"') == 2


def test_an_average_is_the_mean_of_the_checkpoints(program: Any, tmp_path: Path) -> None:
    run, agent = tmp_path / "run", load_agent("pretrained:bc_ts_h")
    shutil.copytree(PRETRAINED / "bc_ts_h", run, ignore=shutil.ignore_patterns("checkpoints"))
    before = {name: weights.clone() for name, weights in agent.policy.named_parameters()}
    folders = []
    for step in (1, 2):
        for weights in agent.policy.parameters():
            weights.data += step
        folders.append(save_checkpoint(run / "checkpoints", step=step, modules=agent.modules))
    program("average").average(run, tmp_path / "mean", folders)
    for name, weights in load_agent(str(tmp_path / "mean")).policy.named_parameters():
        torch.testing.assert_close(weights.data, before[name] + 2)
