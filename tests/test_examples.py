"""Every example, the notebook, the demo and the table of all methods run, tiny."""

from __future__ import annotations

import importlib
import json
import math
import os
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers_pool import Counted, die_at_three, environment, fail_at_three, slow_square
from helpers_processes import forget, output_of
from helpers_runs import tiny
from helpers_segments import crossing, straight_road
from helpers_store import brief, fill
from symphony import keys
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import METHODS, EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.errors import DataError, DataWarning, SymphonyError
from symphony.learning.demonstrations import SceneDataset
from symphony.parallel import ordered_map
from symphony.recipes import train
from symphony.saved.saving import save_simulation

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(name="example")
def _example(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


def test_examples_fit_on_a_page_and_all_are_tested() -> None:
    here, names = Path(__file__).read_text(), sorted(path.stem for path in EXAMPLES.glob("*.py"))
    assert len(names) >= 4
    for name in names:
        assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 100, name
        assert f'("{name}")' in here, name


def without_cars() -> None:
    """Run the examples of what has nothing to do with them, and tell which modules of the package they load."""

    def tell(*found: object) -> None:
        sys.stdout.write(" ".join(map(str, found)) + "\n")

    forget("symphony", *(path.stem for path in EXAMPLES.glob("*.py")))
    sys.path.insert(0, str(EXAMPLES))
    importlib.import_module("beam_search_torchrl").main(4, 10, (2, 4))
    tell("search:", *(name for name in sys.modules if name.startswith("symphony")))
    costs = importlib.import_module("gail_pendulum").main(iterations=2, rows=2, branches=4, updates=2)
    tell("costs:", *costs)
    tell("gail:", *(name for name in sys.modules if name.startswith("symphony")))


def test_what_has_nothing_to_do_with_cars_loads_nothing_of_them(tmp_path: Path) -> None:
    """Neither collectors nor losses nor the examples of them do."""
    lines = output_of(without_cars, said=tmp_path / "said").splitlines()
    told = {line.split()[0]: line.split()[1:] for line in lines if line.strip()}
    assert "independent" in told
    alone = {"symphony", "symphony.errors", "symphony.imports", "symphony.programs"}
    searched = {*told["search:"]}
    assert alone < searched == {m for m in searched if m in alone or m.startswith("symphony.collectors")}
    both = {m for m in told["gail:"] if m.startswith(("symphony.collectors", "symphony.objectives"))}
    assert {"symphony.collectors", "symphony.objectives"} <= both
    assert {*told["gail:"]} == both | alone
    costs = [float(cost) for cost in told["costs:"]]
    assert len(costs) == 4
    assert all(0 < cost < math.pi**2 + 7 for cost in costs)


def test_planner(example: Any, tmp_path: Path) -> None:
    totals = example("planner").main(segments=2, rollouts=2, out=str(tmp_path / "sim"))
    assert totals["runs"] == 4
    assert totals["failed_runs"] == 0
    assert totals["progress"] > 5


def test_coast_neither_speeds_nor_turns(example: Any, tmp_path: Path) -> None:
    plan = example("coast").plan
    agent, store = load_agent("playback"), SegmentStore(builtin_store("test"))
    dataset = SceneDataset(store, 1, agent.dynamics, [0], routes=True, duration=2)
    (saved,) = save_simulation(tmp_path / "sim", agent, dataset, EvaluateConfig(rollouts=1), planner=plan)
    assert not saved.failed
    heading, speed = saved.state[0, :, 0, 2], saved.state[0, :, 0, 3]
    assert abs(heading - heading[0]).max() < 1e-4
    assert abs(speed - speed[0]).max() < 1e-4


@pytest.mark.slow
@pytest.mark.usefixtures("_started_quickly")
def test_several_processes(example: Any) -> None:
    costs = example("several_processes").main(iterations=1, branches=2, workers=2, updates=1)
    assert len(costs) == 2
    assert all(0 < cost < math.pi**2 + 7 for cost in costs)


@pytest.mark.slow
def test_ray(example: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two workers of one cluster are as those of one machine, and collect; they get the folders where modules are."""
    ray = pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_worker_niceness", "0")  # 15 by default: on a busy machine they would hardly run
    machines = example("many_machines")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    ray.init(num_cpus=2, include_dashboard=False)
    try:
        tasks = Counted(20)
        results = ordered_map(slow_square, tasks, workers=2, engine="ray")
        assert next(results) == 0
        assert tasks.taken == 4
        assert list(results) == [k * k for k in range(1, 20)]
        assert list(ordered_map(environment, ["OMP_NUM_THREADS"], engine="ray")) == ["1"]
        with pytest.raises(DataError, match="file log, segment s, field agents: three"):
            list(ordered_map(fail_at_three, range(10), workers=2, engine="ray"))
        with pytest.raises(SymphonyError, match="a Ray worker failed"):
            list(ordered_map(die_at_three, range(10), workers=2, engine="ray"))
        first, second = machines.collected(2, batches=2, rows=3, branches=2, steps=4)
    finally:
        ray.shutdown()
    for batch in (first, second):
        assert batch.numel() == 2 * 3 * 4
        starts = batch[keys.STATE].reshape(6, 4, -1)[:, 0]
        assert len(starts.unique(dim=0)) == 6  # each worker has segments of its own
        assert starts.isfinite().all()
    assert set(first.keys(True, True)) >= {keys.ACTION, ("collector", "beam_score")}


@pytest.mark.parametrize("name", ["Everything", "Others"])
def test_attention_looks_at_nothing_that_is_not_there(name: str, example: Any) -> None:
    """Nor does it matter how many are not there, nor in which order they are."""
    torch.manual_seed(0)
    encoder = getattr(example("attention"), name)(3, [4, 2], hidden=8)
    own, valid = torch.randn(2, 3, 3), torch.tensor([[True, True, False]] * 2)
    few, many = torch.randn(2, 3, 5, 4), torch.randn(2, 3, 60, 2)
    there, near = torch.rand(2, 3, 5) < 0.6, torch.rand(2, 3, 60) < 0.6
    there[0, 0] = False
    found = encoder(own, valid, few, there, many, near)
    assert found.shape == (2, 3, encoder.width)
    hidden = [torch.where(mask[..., None], x, 9.0) for x, mask in ((few, there), (many, near))]
    more, padded = torch.cat([few, few[:, :, :2]], 2), torch.nn.functional.pad(there, (0, 2))
    flipped = [x.flip(2) for x in (few, there, many, near)]
    for same in ((hidden[0], there, hidden[1], near), (more, padded, many, near), flipped):
        torch.testing.assert_close(encoder(own, valid, *same), found)
    few[1, 0, there[1, 0].nonzero()[0]] += 1.0
    changed = (encoder(own, valid, few, there, many, near) != found).any(-1)
    assert changed.tolist() == [[False] * 3, [True, False, False]]
    found.square().sum().backward()
    assert all(weight.grad.isfinite().all() for weight in encoder.parameters() if weight.grad is not None)


def test_a_recipe_learns_with_attention(example: Any, tmp_path: Path) -> None:
    assert example("attention").Others
    config = tiny("bc", builtin_store("train"), tmp_path / "run", steps=2, checkpoint_every=2)
    config = replace(config, agent=replace(config.agent, encoder="attention:Others", hidden=8))
    with pytest.warns(DataWarning, match="agent.encoder runs code, 'attention:Others'"):
        agent = load_agent(str(train(config)), trust_code=True)
    assert "keys" in str(agent.policy)


def test_every_cell_of_the_notebook_runs_and_is_kept_without_output(tmp_path, monkeypatch, capsys):
    """Small: the sizes that the first cell sets are others here."""
    found = json.loads((EXAMPLES.parent / "docs" / "tutorial.ipynb").read_text(encoding="utf-8"))["cells"]
    cells = [cell for cell in found if cell["cell_type"] == "code"]
    assert all((cell["outputs"], cell["execution_count"]) == ([], None) for cell in cells)
    store = brief(tmp_path / "brief", [0])
    monkeypatch.setattr("symphony.data.builtin.builtin_store", lambda split: store)
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {"__name__": "tutorial"}
    for number, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"cell {number}", "exec"), space)  # noqa: S102
        if number == 0:
            assert {"segments", "rollouts"} <= space.keys()
            space |= {"segments": 1, "rollouts": 2}
    assert (tmp_path / "out/tutorial/rollouts.png").stat().st_size > 10_000
    shown = " ".join(capsys.readouterr().out.split())
    assert "runs 2.00" in shown
    assert "failed_runs 0.00" in shown


def test_demo(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    """With fewer updates, rollouts and segments than a newcomer gets, over what an earlier demo has left."""
    for split in ("train", "test"):
        brief(tmp_path / split, (3, 9), 16, split)
    folders = {split: tmp_path / split for split in ("train", "test")}
    monkeypatch.setattr("symphony.data.builtin.builtin_store", folders.__getitem__)
    earlier = tmp_path / "demo" / "bc_h"
    earlier.mkdir(parents=True)
    (earlier / "config.json").write_text("{}")
    (earlier / "left").touch()
    assert main(["demo", "--out", str(tmp_path / "demo"), "--steps", "2", "--rollouts", "1"]) == 0
    assert not (earlier / "left").exists()
    rows = json.loads((tmp_path / "demo" / "metrics.json").read_text())["rows"]
    names = ["log playback", "constant velocity", "included BC+TS+H", "your BC+H"]
    assert [(row["agent"], row["segments"]) for row in rows] == [(name, 2) for name in names]
    assert rows[0]["ade"] == rows[0]["collision_rate"] == 0
    assert rows[1]["ade"] > 1
    # Whatever two updates make of BC+H, an agent that has learned to drive stays on the road.
    assert rows[2]["search"] == "backtrack"
    assert rows[2]["offroad_time"] < rows[1]["offroad_time"]
    sizes = [(tmp_path / "demo" / name).stat().st_size for name in ("included.png", "rollouts.png")]
    assert 50_000 < sizes[0] < sizes[1]
    told = capsys.readouterr().out
    assert f"{rows[1]['ade']:.2f}" in told
    first, _, second = told.partition("Now one of your own")
    assert [names[2] in first, names[3] in first, names[3] in second] == [True, False, True]
    assert len(told.splitlines()) <= 30  # a screen


def test_the_table_of_all_methods(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    for split, seed in (("train", 0), ("test", 1)):
        fill(tmp_path / split, [straight_road(4, seed=seed, steps=4), crossing(4, seed=seed, steps=4)])
    script, methods = runpy.run_path(str(EXAMPLES.parent / "benchmarks" / "make_table.py")), METHODS[1::3]
    assert script["METHODS"] == METHODS
    monkeypatch.setitem(script["main"].__globals__, "METHODS", methods)  # as all would take long
    monkeypatch.setitem(script["main"].__globals__, "builtin_store", lambda split: tmp_path / split)
    sizes = "--steps 2 --states 8 --agent.hidden 8 --agent.num-points 8 --search.updates 2 "
    sizes += "--checkpoint-every 2 --batch 1 --search.branches=2 --rollouts 2"
    out = tmp_path / "out"
    status = script["main"](["--out", str(out), *sizes.split()])
    shown = capsys.readouterr()
    assert status == 0, shown.err
    lines = (out / "table.md").read_text().splitlines()
    for method in methods:
        name = method.upper().replace("_", "+")
        assert sum(line.strip("| *").startswith(f"{name} ") for line in lines) == 1, name
        config = json.loads((out / method / "config.json").read_text())
        assert (config["method"], config["steps"], config["search"]["branches"]) == (method, 2, 2)
