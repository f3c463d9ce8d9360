"""Two processes that train together and write what they find, started from one that has no threads."""

from __future__ import annotations

import json
import os
import shutil
import socket
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from helpers_processes import fork
from helpers_runs import pieces, tiny
from symphony import keys
from symphony.agents.choice import choose
from symphony.config import MGAILConfig, TrainConfig, ValidationConfig
from symphony.errors import ConfigError
from symphony.learning import SceneDataset
from symphony.recipes import recipe_of, train
from symphony.training import Processes, Trainer
from symphony.training.processes import processes

WORLD = 2
LOSSES = {"bc": "policy_loss", "distillation": "policy_loss", "goals": "goal_loss", "realism": "realism_loss"}
TRAINED = ("bc", "bc_ts_h", "mgail_ts")
CPU = torch.device("cpu")


def config(method: Any, store: Path, out: Path) -> TrainConfig:
    """Return the configuration of a run with all that is random, and as much of MGAIL as there is."""
    validation = ValidationConfig(data=store, segments=1, rollouts=1)
    mgail = MGAILConfig(regression=2, head_start=1, rollouts=2, expert_weight=0.5)
    return tiny(method, store, out, validation=validation, mgail=mgail)


def fresh(method: str, store: Path, world: Processes) -> Trainer:
    """Networks and losses that are the same at every call."""
    return recipe_of(method)(tiny(method, store, store.parent / "nowhere"), world)


def batch_for(kind: str, trainer: Trainer) -> TensorDictBase:
    """A batch that is the same at every call, whose first half has far fewer entries that count."""
    rng, data, sees = torch.Generator().manual_seed(1), trainer.data, trainer.agent.observation
    if kind == "goals":
        batch = data.sample_goals([0, 1], 32, sees, rng)
    elif kind == "realism":
        replay = pieces(trainer)["replay"]
        trainer.rng.manual_seed(1)
        replay.refresh(0)
        batch = replay.both_kinds(rng)
        # Simulated states come before logged ones.
        batch = batch[torch.arange(len(batch)).reshape(2, 2, -1).transpose(0, 1).flatten()]
    else:
        batch = data.sample_states([0, 1], 32, sees, rng)
        if kind == "distillation":
            batch.set(keys.ROLLOUT, torch.rand(32, 1, generator=rng) < 0.5)
    valid = batch.get(keys.VALID)
    chance = torch.where(torch.arange(len(valid)) < len(valid) // 2, 0.3, 0.9)[:, None]
    return batch.set(keys.VALID, valid & (torch.rand(valid.shape, generator=rng) < chance))


def descended(trainer: Trainer, kind: str, batch: TensorDictBase) -> tuple[dict[str, Tensor], Tensor]:
    """Return what a loss reports, and its gradient."""
    loss = pieces(trainer)[LOSSES[kind]]
    values = loss(batch)
    next(values[key] for key in loss.out_keys if key.startswith("loss_")).backward()
    parameters = [p for module in trainer.agent.modules.values() for p in module.parameters()]
    grads = [p.grad.flatten() for p in parameters if p.grad is not None]
    return {name: value.detach() for name, value in values.items()}, torch.cat(grads)


def compare(kind: str, store: Path, world: Processes) -> dict[str, Any]:
    """The loss of one half of a batch in each process beside that of all of it in one."""
    method = {"bc": "bc", "distillation": "bc_ts", "goals": "bc_h", "realism": "bc_ts"}[kind]
    alone, together = fresh(method, store, Processes(CPU)), fresh(method, store, world)
    batch = batch_for(kind, alone)
    half = len(batch) // WORLD
    own = batch[world.rank * half : (world.rank + 1) * half]
    values, gradient = descended(alone, kind, batch)
    _, lone_gradient = descended(alone, kind, own)
    part, shared_gradient = descended(together, kind, own)
    shared = world.mean(part)
    return {
        "counts": int(own.get(keys.VALID).sum()), "values": {name: value.item() for name, value in values.items()},
        "shared": {name: value.item() for name, value in shared.items()}, "gradient": gradient.norm().item(),
        "gradient_off": (shared_gradient - gradient).abs().max().item(),
        "gradient_off_alone": (lone_gradient - 2 * gradient).abs().max().item(),
    }  # fmt: skip


def of_run(method: str, store: Path, out: Path, rank: int) -> dict[str, Any]:
    """Train, and take the last updates up again; with what this process drew, and where its weights got to."""
    drawn, at_end, begun = [], [], []
    draw, descend, update = SceneDataset.draw, Trainer._descend, Trainer._update

    def spy(self: SceneDataset, count: int, rng: torch.Generator) -> list[int]:
        if begun:  # what is drawn to build a run is not learned from
            drawn.append(rng.initial_seed())
        return draw(self, count, rng)

    def watch(self: Trainer, *args: Any) -> dict[str, Tensor]:
        record = descend(self, *args)
        at_end[:] = [float(p.detach().double().sum()) for p in self.agent.modules["policy"].parameters()]
        return record

    def begin(self: Trainer, step: int) -> dict[str, Tensor]:
        begun.append(step)
        return update(self, step)

    SceneDataset.draw, Trainer._descend, Trainer._update = spy, watch, begin  # type: ignore[method-assign]
    settings = config(method, store, out / method)
    train(settings)
    found = {"drawn": list(drawn), "weights": list(at_end)}
    if rank == 0:
        shutil.copytree(settings.out, out / f"{method}-part")
        shutil.rmtree(choose(out / f"{method}-part", "4"))
    resumed = replace(settings, out=out / f"{method}-part", resume=True)
    with processes(CPU) as world:
        world.wait()
    train(resumed)
    SceneDataset.draw, Trainer._descend, Trainer._update = draw, descend, update  # type: ignore[method-assign]
    return {**found, "resumed": list(at_end)}


def main(rank: int, store: Path, out: Path) -> None:
    """Run one process."""
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
    found: dict[str, Any] = {}
    with processes(CPU) as world:
        found["world"] = [world.rank, world.count, world.is_main]
        nan, inf = float("nan"), float("inf")
        own = {"both": float(rank), "none": nan}
        own |= {"one": 3.0, "infinite": inf} if rank else {"one": nan, "infinite": 1.0}
        mean = world.mean({name: torch.tensor(value) for name, value in own.items()})
        found["mean"] = {name: value.item() for name, value in mean.items()}
        found["losses"] = {kind: compare(kind, store, world) for kind in LOSSES}
        found["runs"] = {method: of_run(method, store, out, rank) for method in TRAINED}
    (out / f"rank{rank}.json").write_text(json.dumps(found))


def alone(store: Path, out: Path) -> None:
    """Take up what two processes began."""
    try:
        train(replace(config("bc", store, out / "bc"), resume=True, steps=6))
    except ConfigError as error:
        (out / "alone.txt").write_text(str(error))


def both(store: Path, out: Path) -> int:
    """Run two processes, and then one alone; return whether one of them failed."""
    warnings.simplefilter("error")
    if Path("/sys/class/net/lo").exists():
        # Else gloo asks for the address of the machine's name, which may have none.
        os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    codes = as_torchrun(main, store, out)
    del os.environ["TORCHELASTIC_RUN_ID"]
    codes.append(os.waitstatus_to_exitcode(os.waitpid(fork(alone, store, out), 0)[1]))
    return int(any(codes))


def as_torchrun(action: Callable[..., None], *args: Any) -> list[int]:
    """Have processes that know of each other do something, their ranks first; how they ended."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(WORLD)}
    os.environ["TORCHELASTIC_RUN_ID"] = "test"
    children = [fork(action, rank, *args) for rank in range(WORLD)]
    return [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
