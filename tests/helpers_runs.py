"""Training runs that take a second."""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from symphony.agents import load_agent
from symphony.agents.checkpoint import checkpoints
from symphony.config import AgentConfig, DiscriminatorConfig, SearchConfig, TrainConfig
from symphony.recipes import train, trainer_of
from symphony.training import Processes, Trainer

Trained = Callable[[str], Path]


def tiny(method: Any, store: Path, out: Path, **changes: Any) -> TrainConfig:
    """A configuration of the smallest networks and batches."""
    rule: Any = "systematic" if "ts" in str(method) else "replace"
    base = TrainConfig(
        method=method, data=store, out=out, steps=4, agent=AgentConfig(num_points=12, hidden=8), segments=2,
        states=16, search=SearchConfig(branches=2, prune_every=2, updates=2, states=8, test_branches=2, rule=rule),
        discriminator=DiscriminatorConfig(hidden=8), checkpoint_every=2, log_every=1, wandb="disabled",
    )  # fmt: skip
    return replace(base, **changes)


def build(config: TrainConfig) -> Trainer:
    """Return what the recipe of a configuration builds, with its hooks, before any training."""
    return trainer_of(config, Processes(torch.device("cpu")))


def run_of(config: Callable[[Path, Path], TrainConfig]) -> Any:
    """A fixture: a run on a module's store, made once; never written to."""

    @pytest.fixture(scope="module")
    def run(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return train(config(store, tmp_path_factory.mktemp("runs") / "run"))

    return run


def trained_as(config: Callable[[str, Path, Path], TrainConfig]) -> Any:
    """A fixture: gives the runs of methods on a module's store, made once each; never written to again."""

    @pytest.fixture(scope="module")
    def trained(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Trained:
        return cache(lambda method: train(config(method, store, tmp_path_factory.mktemp("runs") / method)))

    return trained


def pieces(trainer: Trainer) -> dict[str, Any]:
    """Return what the updates of a recipe use, by the names it gives them."""
    found: dict[str, Any] = {}
    todo: list[Any] = [phase.update for phase in trainer.phases]
    while todo:
        used = inspect.getclosurevars(todo.pop()).nonlocals
        todo.extend(value for name, value in used.items() if name not in found and inspect.isfunction(value))
        found |= used
    return found


def weights(run: Path | str) -> dict[str, Tensor]:
    """Copies of all weights of a run's agent."""
    return {
        f"{name}.{key}": value.clone()
        for name, module in load_agent(str(run)).modules.items()
        for key, value in module.state_dict().items()
    }


def same_weights(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    """Whether they are the same to the last bit."""
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def stopped(run: Path, out: Path, step: int) -> None:
    """Copy a run as it was after some updates."""
    shutil.copytree(run, out)
    for done in checkpoints(out / "checkpoints"):
        if int(done.name[-12:]) > step:
            shutil.rmtree(done)
    lines = (out / "metrics.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    (out / "metrics.jsonl").write_text("".join(lines[: step + 1]), encoding="utf-8")
