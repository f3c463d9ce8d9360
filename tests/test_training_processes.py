"""Training that dies at any moment and is taken up again, and training by two processes."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

import helpers_distributed
import helpers_killed
from helpers_distributed import LOSSES, TRAINED
from helpers_processes import output_of
from helpers_runs import build, pieces, run_of, same_weights, tiny, weights
from helpers_segments import crossing, straight_road
from helpers_store import fill, stored
from symphony import keys
from symphony.agents.checkpoint import CheckpointError, checkpoints, latest, load_checkpoint
from symphony.agents.choice import choose
from symphony.errors import ConfigError, DataError, SymphonyError
from symphony.recipes import train
from symphony.training import trainer as training
from symphony.training.logging import Tracker, read_metrics
from symphony.training.processes import Processes, processes

store = stored(lambda: [straight_road(4, steps=10), crossing(4, steps=9)])
run = run_of(partial(tiny, "bc"))


def learned(run: Path) -> dict[str, bytes]:
    """Files of weights and optimizers of all checkpoints."""
    files = sorted((run / "checkpoints").glob("step-*/[mo]*.safetensors"))
    return {str(file.relative_to(run)): file.read_bytes() for file in files}


def records(run: Path) -> list[dict[str, Any]]:
    """All but the one number that is a matter of the clock."""
    return [{k: v for k, v in r.items() if k != "updates_per_second"} for r in read_metrics(run)]


@pytest.fixture
def part(run: Path, tmp_path: Path) -> Path:
    """A copy of the run."""
    return Path(shutil.copytree(run, tmp_path / "part"))


def test_a_run_that_was_killed_at_many_a_moment_ends_like_one_that_was_not(store, tmp_path):
    words = output_of(helpers_killed.main, store, tmp_path, "bc_ts", said=tmp_path / "said.txt").split()
    assert words == [name for name, _, _ in helpers_killed.DEATHS]
    part, whole = tmp_path / "killed", tmp_path / "whole"
    assert len(checkpoints(whole / "checkpoints")) >= 2
    assert learned(part) == learned(whole)
    assert records(part) == records(whole)
    assert [r["step"] for r in records(whole)] == list(range(1, helpers_killed.STEPS + 1))
    assert choose(part, "best").name == choose(whole, "best").name
    assert not list(part.rglob(".*"))


def test_searches_made_as_one_are_learned_from_in_turn(store, tmp_path):
    """Two, each for two updates; with only one at a time all is as without."""
    config = tiny("bc_ts", store, tmp_path / "run", segments=1, together=2)
    trainer = build(replace(config, checkpoint_every=4))
    replay, rng, seen = pieces(trainer)["replay"], torch.Generator().manual_seed(0), []
    for step in range(8):
        replay.refresh(step)
        scenes = replay.env.scenes
        drawn = [replay.both_kinds(rng), replay.survivors(30, rng, replay.env.observation)]
        seen.append((id(scenes), {int(row) for batch in drawn for row in batch[keys.SCENE].flatten()}))
        assert len(scenes) == 2
    assert [rows for _, rows in seen] == [{0}, {0}, {1}, {1}] * 2
    assert [len({one for one, _ in seen[k : k + 4]}) for k in (0, 4)] == [1, 1]
    assert seen[0][0] != seen[4][0]
    with pytest.raises(ConfigError, match=r"must be a multiple of search.updates \(2\) x 2 searches as one"):
        build(config)


def test_a_full_disk_stops_training_and_leaves_the_last_checkpoint(run, store, part):
    """Whatever file it is that finds no room."""
    shutil.rmtree(choose(part, "4"))
    before, settings = learned(part), tiny("bc", store, part, resume=True)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    cases = (5000, CheckpointError, "can't write the checkpoint"), (900, DataError, "json")
    for size, error, what in cases:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            with pytest.raises(error, match=what):
                train(settings)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert learned(part) == before
    train(settings)
    assert learned(part) == learned(run)
    assert records(part) == records(run)


@pytest.mark.parametrize("file", ["config.json", "checkpoints/step-000000000004/checkpoint.json"])
def test_files_of_another_version_are_refused_and_left_alone(run, store, part, file):
    changed = {**json.loads((part / file).read_text()), "format": 99}
    (part / file).write_text(json.dumps(changed))
    before = learned(part)
    with pytest.raises(SymphonyError, match=r"expected format \d|format.*(expected|reads) \d"):
        train(tiny("bc", store, part, resume=True, steps=6))
    assert learned(part) == before
    assert json.loads((part / file).read_text()) == changed
    assert records(part) == records(run)


def test_a_damaged_last_checkpoint_is_named_and_the_one_before_it_can_be_used(run, store, part):
    last = latest(part / "checkpoints")
    file = last / "module.policy.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    settings = tiny("bc", store, part, resume=True)
    with pytest.raises(CheckpointError, match=r"step-0+4/module\.policy\.safetensors.*checksum"):
        train(settings)
    shutil.rmtree(last)
    assert same_weights(weights(train(settings)), weights(run))


def test_a_run_that_was_killed_before_its_first_checkpoint_starts_over(run, store, part):
    shutil.rmtree(part / "checkpoints")
    with pytest.raises(ConfigError, match="holds a run already"):
        train(tiny("bc", store, part))
    train(tiny("bc", store, part, resume=True))
    assert learned(part) == learned(run)
    assert records(part) == records(run)


def test_checkpoints_without_the_configuration_they_go_with_are_refused(run, store, part):
    (part / "config.json").unlink()
    for resume in (False, True):
        with pytest.raises(ConfigError, match=r"part holds checkpoints without their config\.json"):
            train(tiny("bc", store, part, seed=99, steps=6, resume=resume))
    assert learned(part) == learned(run)


LOCKED = """
import sys, time
from pathlib import Path
from symphony.files import Lock
held = Lock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(600)
"""


def test_two_processes_on_one_run_are_refused_and_the_lock_dies_with_its_process(run, store, part):
    shutil.rmtree(choose(part, "4"))
    before, settings = learned(part), tiny("bc", store, part, resume=True)
    command = [sys.executable, "-c", LOCKED, str(part / training.LOCK)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        who = rf"part: is being written by another process: {other.pid} on .*: -c "
        with pytest.raises(DataError, match=who):
            train(settings)
        assert (learned(part), records(part)) == (before, records(run))
        other.kill()
    train(settings)
    assert learned(part) == learned(run)


@pytest.mark.parametrize("resume", [False, True])
def test_who_comes_second_does_not_go_on_from_what_it_saw_at_first(run, store, tmp_path, resume):
    """Two processes that look at the folder before either of them writes there."""
    part = tmp_path / "part"
    if resume:
        shutil.rmtree(choose(shutil.copytree(run, part), "4"))
    first, second = (build(tiny("bc", store, part, resume=resume)) for _ in range(2))
    first.run()
    done = learned(part)
    with pytest.raises(ConfigError, match=r"part.*(holds a run already|another process has continued)"):
        second.run()
    assert learned(part) == done == learned(run)


BAD = [b"", b"5", b"[1]", b'{"loss": 1}', b'{"step": "x"}', b"\xff\x00", b"{" * 9000]


@pytest.mark.parametrize("bad", BAD)
def test_records_are_kept_up_to_the_checkpoint_and_a_damaged_one_costs_no_others(bad, tmp_path):
    first = Tracker(tmp_path, {}, "disabled")
    for step in range(1, 6):
        first.log(step, {"loss": float(step), "ratio": float("nan"), "norm": float("inf"), "word": "x"})
    first.close()
    text = first.path.read_bytes()
    assert b'"ratio": null, "norm": null' in text
    lines = text.splitlines()
    first.path.write_bytes(b"\n".join([lines[0], bad, *lines[2:], b""])[:-30])
    again = Tracker(tmp_path, {}, "disabled", after=3)
    assert again.path.read_bytes() == b"\n".join([lines[0], lines[2], b""])
    assert again.kept == read_metrics(tmp_path)
    again.log(4, {"loss": 0.0})
    again.sync()
    again.close()
    assert [r["step"] for r in read_metrics(tmp_path)] == [1, 3, 4]
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.jsonl"]


Found = tuple[Path, list[dict[str, Any]]]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """The folder of what the two have written, and what each reports."""
    base = tmp_path_factory.mktemp("distributed")
    kinds = (straight_road, 9), (crossing, 8)
    fill(base / "store", [make(4, seed=seed, steps=steps) for seed in range(2) for make, steps in kinds])
    output_of(helpers_distributed.both, base / "store", base, said=base / "said.txt", limit=500)
    return base, [json.loads((base / f"rank{rank}.json").read_text()) for rank in range(2)]


def test_each_knows_its_place_and_numbers_are_means_of_those_that_are_known(found: Found) -> None:
    assert [report["world"] for report in found[1]] == [[0, 2, True], [1, 2, False]]
    for report in found[1]:
        mean = report["mean"]
        assert (mean["both"], mean["one"], mean["infinite"]) == (0.5, 3.0, float("inf"))
        assert mean["none"] != mean["none"]


@pytest.mark.parametrize("kind", LOSSES)
def test_losses_gradients_and_metrics_are_those_of_the_joint_batch(found: Found, kind: str) -> None:
    both = [report["losses"][kind] for report in found[1]]
    few, many = sorted(result["counts"] for result in both)
    assert 0 < 1.5 * few < many  # else means of means would do as well
    for result in both:
        assert result["gradient"] > 1e-3
        assert result["gradient_off"] < 1e-6 < result["gradient_off_alone"]
        assert result["values"].keys() == result["shared"].keys()
        for name, value in result["values"].items():
            if name != "auc":
                assert result["shared"][name] == pytest.approx(value, abs=1e-5), name
    assert both[0]["shared"] == both[1]["shared"]


@pytest.mark.parametrize("method", TRAINED)
def test_processes_draw_apart_and_stay_together(found: Found, method: str) -> None:
    one, two = (report["runs"][method] for report in found[1])
    assert len(one["drawn"]) == len(two["drawn"]) >= 4
    assert not set(one["drawn"]) & set(two["drawn"])
    assert one["weights"] == two["weights"]
    assert one["resumed"] == two["resumed"] == one["weights"]


@pytest.mark.parametrize("method", TRAINED)
def test_one_process_writes_and_a_run_resumes_to_the_last_bit(found: Found, method: str) -> None:
    whole, part = found[0] / method, found[0] / f"{method}-part"
    assert [r["step"] for r in read_metrics(whole)] == [1, 2, 3, 4]
    assert [int(path.name[-12:]) for path in checkpoints(whole / "checkpoints")] == [2, 4]
    assert [r["step"] for r in read_metrics(whole) if "validation_ade" in r] == [2, 4]
    assert same_weights(weights(f"{whole}@last"), weights(f"{part}@last"))
    without = [[{**r, "updates_per_second": 0} for r in read_metrics(run)] for run in (whole, part)]
    assert without[0] == without[1]


def test_a_run_of_two_is_not_taken_up_by_one(found: Found) -> None:
    told = (found[0] / "alone.txt").read_text()
    assert "trained by 2 processes so far, can't be resumed by 1" in told
    last = latest(found[0] / "bc" / "checkpoints")
    assert load_checkpoint(last, partial=True, restore_rng=False).extra["processes"] == 2


def test_one_process_alone_needs_no_group() -> None:
    cpu = torch.device("cpu")
    with processes(cpu) as world:
        assert world == Processes(cpu)
        state = torch.get_rng_state()
        world.reseed(3, 4)
        world.wait()
        assert torch.equal(state, torch.get_rng_state())
        value = {"loss": torch.tensor(2.0)}
        assert world.mean(value) == value
        assert world.seed(7) == 7
