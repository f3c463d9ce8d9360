"""The messages of a training that goes wrong, and when it gives up."""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from helpers_runs import build, tiny
from helpers_segments import crossing, straight_road
from helpers_store import stored
from symphony.agents.choice import choose
from symphony.cli import main
from symphony.objectives import BCLoss
from symphony.recipes import train
from symphony.training import Trainer
from symphony.training.logging import read_metrics
from symphony.training.trainer import ALARMS, PATIENCE, WINDOW, Alarms, Skips, TrainingError, Updates

NAN, INF = math.nan, math.inf


def norms(**values: float) -> dict[str, Tensor]:
    kinds = ("gradient_norm_", "loss_")
    return {kind + name: torch.tensor(value) for kind in kinds for name, value in values.items()}


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(1, PATIENCE)), max_size=20))
def test_skips_are_counted_until_a_network_has_too_many_in_a_row(runs: list[tuple[bool, bool, int]]) -> None:
    skips, total = Skips(), 0
    row = {"policy": 0, "goals": 0}
    for *bad, _ in (one for one in runs for _ in range(one[-1])):
        names = [name for name, is_bad in zip(row, bad, strict=True) if is_bad]
        row = {name: row[name] + 1 if name in names else 0 for name in row}
        total += len(names)
        found = norms(**{name: NAN if name in names else 1.0 for name in row})
        if max(row.values()) == PATIENCE:
            with pytest.raises(TrainingError):
                skips.count(found)
            return
        assert skips.count(found) == names
        assert (skips.total, skips.in_row) == (total, row)


def test_an_update_without_a_network_neither_counts_nor_forgives() -> None:
    """As the first updates of MGAIL, which are the discriminator's alone."""
    skips = Skips()
    for _ in range(PATIENCE - 1):
        for found in (norms(policy=INF, discriminator=1.0), norms(discriminator=1.0), {}):
            skips.count(found)
    with pytest.raises(TrainingError, match=r"the policy network .* was not finite in 20 updates in a row"):
        skips.count(norms(policy=INF))


def alarms(*values: float | None) -> list[str | None]:
    watch = Alarms()
    return [watch.check({"discriminator_auc": value}) for value in values]


def test_alarms_need_the_whole_window() -> None:
    strong, blind = "discriminator_too_strong", "discriminator_blind"
    assert set(ALARMS) == {strong, blind}
    before = [None] * (WINDOW - 1)
    assert alarms(*[0.99] * WINDOW, 0.97, 0.99) == [*before, strong, None, None]
    assert alarms(*[0.51] * WINDOW, 0.53, 0.51) == [*before, blind, None, None]
    assert alarms(0.6, *[0.2] * WINDOW) == [None, *before, blind]
    assert alarms(*[0.98] * 12) == alarms(*[0.52] * 12) == [None] * 12
    # Records without a value don't count.
    assert alarms(*[0.99] * 9, None, NAN, 0.99) == [None] * 11 + [strong]
    assert Alarms().check({"loss_policy": 1.0}) is None


@given(st.lists(st.sampled_from([0.3, 0.51, 0.7, 0.99, None]), max_size=40), st.integers(0, 40))
def test_a_run_that_goes_on_rings_as_if_it_had_not_stopped(values: list[float | None], stop: int) -> None:
    later = Alarms({"discriminator_auc": value} for value in values[:stop])
    assert [later.check({"discriminator_auc": value}) for value in values[stop:]] == alarms(*values)[stop:]


store = stored(lambda: [straight_road(4, seed=0, steps=5), crossing(4, seed=0, steps=5)])
Altered = Callable[[Callable[[int], dict[str, float]]], None]


@pytest.fixture
def altered(monkeypatch: pytest.MonkeyPatch) -> Altered:
    """Let updates report other numbers than they found."""
    update = Trainer._update

    def alter(numbers: Callable[[int], dict[str, float]]) -> None:
        def altered_update(self: Trainer, step: int) -> dict[str, Any]:
            found = {name: torch.tensor(value) for name, value in numbers(step).items()}
            return {**update(self, step), **found}

        monkeypatch.setattr(Trainer, "_update", altered_update)

    return alter


def test_skipped_updates_are_recorded_and_told_once(store, tmp_path, altered, capsys):
    altered(lambda step: {"gradient_norm_policy": NAN} if step in (1, 2, 4) else {})
    out, sparse = tmp_path / "run", tmp_path / "sparse"
    train(tiny("bc", store, out, steps=6))
    assert read_metrics(out)[1]["gradient_norm_policy"] is None
    assert capsys.readouterr().err.count("warning: a gradient of the policy network is not finite; skipped") == 1
    # A run that goes on counts on.
    for last in ("6", "4"):
        shutil.rmtree(choose(out, last))
    train(tiny("bc", store, out, steps=6, resume=True))
    assert [r["skipped_updates"] for r in read_metrics(out)] == [0, 1, 2, 2, 3, 3]
    # Those between two records count too.
    train(tiny("bc", store, sparse, steps=6, log_every=3))
    assert [r["skipped_updates"] for r in read_metrics(sparse)] == [2, 3]


@pytest.mark.parametrize("spoiled", [0, 1])
def test_a_network_that_is_stepped_twice_loses_no_skip(spoiled: int, store: Path, tmp_path: Path) -> None:
    trainer = build(tiny("bc", store, tmp_path / "run"))
    (phase,) = trainer.phases

    def twice(step: int) -> Updates:
        for k in range(2):
            for name, losses in phase.update(step):
                yield name, losses.apply(lambda loss, k=k: loss * NAN if k == spoiled else loss)

    trainer.phases = [dataclasses.replace(phase, update=twice)]
    assert Skips().count(trainer._update(0)) == ["policy"]


def test_a_skipped_update_leaves_weights_and_optimizer_as_they_were(store, tmp_path, monkeypatch):
    trainer = build(tiny("bc", store, tmp_path / "run"))
    trainer._update(0)

    def state() -> list[Tensor]:
        adam = trainer.optimizers["policy"].state_dict()["state"]
        moments = [value.clone() for entry in adam.values() for value in entry.values()]
        return [*(p.detach().clone() for p in trainer.agent.modules["policy"].parameters()), *moments]

    before, forward = state(), BCLoss.forward
    for poison in (NAN, INF):
        with monkeypatch.context() as patch:
            patch.setattr(BCLoss, "forward", lambda *a, p=poison: forward(*a).apply(lambda value: value * p))
            assert Skips().count(trainer._update(1)) == ["policy"]
        assert all(torch.equal(a, b) for a, b in zip(before, state(), strict=True))
    assert Skips().count(trainer._update(1)) == []
    assert not torch.equal(before[0], state()[0])


def test_training_gives_up_with_one_line(store, tmp_path, altered, capsys):
    altered(lambda step: {"gradient_norm_policy": NAN, "loss_policy": INF} if step >= 4 else {})
    small = "--agent.hidden 8 --agent.num-points 12 --states 8 --checkpoint-every 2"
    command = f"train bc --data {store} --out {tmp_path}/run --wandb disabled {small}"
    assert main(command.split()) == 1
    *_, last = capsys.readouterr().err.strip().splitlines()
    assert last.startswith("symphony: error: the gradient of the policy network (loss_policy is inf) was not finite")
    assert choose(tmp_path / "run").name.endswith(str(4 + PATIENCE - 2))


def test_a_discriminator_that_has_won_raises_an_alarm(store, tmp_path, altered, capsys):
    altered(lambda step: {"discriminator_auc": 0.999 if step < WINDOW + 2 else 0.9})
    out, how = tmp_path / "run", {"steps": WINDOW + 4, "checkpoint_every": WINDOW + 2}
    train(tiny("bc", store, out, **how))
    assert capsys.readouterr().err.count(f"warning: {ALARMS['discriminator_too_strong']}") == 1
    before = read_metrics(out)
    assert [r["step"] for r in before if "alarm" in r] == [WINDOW, WINDOW + 1, WINDOW + 2]
    shutil.rmtree(choose(out, str(WINDOW + 4)))
    train(tiny("bc", store, out, **how, resume=True))
    assert [r.get("alarm") for r in read_metrics(out)] == [r.get("alarm") for r in before]
