"""Two processes that train together do what one would do with a batch of twice the size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import helpers_distributed
from helpers_distributed import LOSSES, TRAINED
from helpers_processes import output_of
from helpers_runs import same_weights, weights
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.agents.checkpoint import checkpoints, latest, load_checkpoint
from symphony.training.logging import read_metrics
from symphony.training.processes import Processes, processes

Found = tuple[Path, list[dict[str, Any]]]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """The folder of what the two have written, and what each reports."""
    base = tmp_path_factory.mktemp("distributed")
    made = [(straight_road(4, seed=seed, steps=9), crossing(4, seed=seed, steps=8)) for seed in range(2)]
    fill(base / "store", [segment for both in made for segment in both])
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
    assert last is not None
    assert load_checkpoint(last, partial=True, restore_rng=False).extra["processes"] == 2


def test_one_process_alone_needs_no_group() -> None:
    cpu = torch.device("cpu")
    with processes(cpu) as world:
        assert world == Processes(cpu)
        assert world.is_main
        state = torch.get_rng_state()
        world.reseed(3, 4)
        world.wait()
        assert torch.equal(state, torch.get_rng_state())
        value = {"loss": torch.tensor(2.0)}
        assert world.mean(value) == value
        assert world.seed(7) == 7
