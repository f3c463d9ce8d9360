"""The training loop."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from pathlib import Path

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from symphony.config import TrainConfig, to_json
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle
from symphony.errors import ConfigError, DataError
from symphony.trainers.agents import read_config
from symphony.trainers.checkpoint import latest, load_checkpoint, parts_of, prune, save_checkpoint
from symphony.trainers.dataset import SceneDataset
from symphony.trainers.learner import Learner
from symphony.trainers.networks import Networks, build_networks
from symphony.trainers.tracking import Tracker

KEEP = 3
"""Checkpoints kept in a run's folder."""


def train(config: TrainConfig, dataset: SceneDataset | None = None) -> Path:
    """Train an agent as configured.

    The data of every update is drawn from (seed, update) alone, and checkpoints hold weights and optimiser, so a
    run that was stopped and resumed ends with the same weights as one that was not.

    Args:
        config: what to train.
        dataset: the prepared data, if several runs are to share it; by default made from ``config.data``.

    Returns:
        The run's folder: ``config.json``, ``metrics.jsonl`` and ``checkpoints/``.

    Raises:
        ConfigError: if the folder holds another run, or settings can't be used.
        DataError: if the store can't be read or holds nothing to learn from.
    """
    device = _device(config.device)
    dynamics = Bicycle()
    if dataset is None:
        store = SegmentStore(config.data)
        dataset = SceneDataset(store, config.agent.interactive, dynamics, routes=config.hierarchical)
    if len(dataset) == 0:
        raise DataError("the store holds no run segments", file=config.data)
    if config.hierarchical and not dataset.routes:
        raise ConfigError(f"method {config.method} needs a dataset with routes")
    done = _find(config)
    torch.manual_seed(config.seed)
    networks = build_networks(config, dynamics)
    if config.warm_start is not None and done is None:
        _warm_start(networks, config.warm_start)
    for module in networks.present().values():
        module.to(device)
    learner = Learner(config, networks, dataset, device)
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / "config.json").write_text(to_json(config), encoding="utf-8")
    step = 0
    if done is not None:
        step = load_checkpoint(done, modules=networks.present(), optimizers=learner.optimizers).step
    tracker = Tracker(config.out, json.loads(to_json(config)), config.wandb, after=step)
    try:
        with _progress() as progress:
            task = progress.add_task("training", total=config.steps, completed=step, loss=math.nan)
            began, first = time.perf_counter(), step
            while step < config.steps:
                values = learner.update(step)
                step += 1
                if step % config.log_every == 0 or step == config.steps:
                    numbers = {name: value.item() for name, value in values.items()}
                    numbers["updates_per_second"] = (step - first) / (time.perf_counter() - began)
                    numbers["learning_rate"] = learner.optimizers["policy"].param_groups[0]["lr"]
                    tracker.log(step, numbers)
                    progress.update(task, loss=numbers[learner.policy_loss.out_keys[0]])
                progress.update(task, completed=step)
                if step % config.checkpoint_every == 0 or step == config.steps:
                    folder = config.out / "checkpoints"
                    save_checkpoint(
                        folder, step=step, modules=networks.present(), optimizers=learner.optimizers
                    )
                    prune(folder, KEEP)
    finally:
        tracker.close()
    return config.out


def _warm_start(networks: Networks, folder: Path) -> None:
    """Take over the networks that another run has too."""
    newest = latest(folder / "checkpoints")
    if newest is None:
        raise ConfigError(f"{folder}: no run with a checkpoint to start from")
    there = parts_of(newest)
    shared = {name: module for name, module in networks.present().items() if name in there}
    load_checkpoint(newest, modules=shared, partial=True, restore_rng=False)


def _find(config: TrainConfig) -> Path | None:
    """Find the checkpoint to go on from, if this is a run to go on with."""
    done = latest(config.out / "checkpoints")
    if (config.out / "config.json").exists():
        if not config.resume:
            raise ConfigError(f"{config.out} holds a run already; choose another folder or --resume")
        # More updates, another machine or fewer records do not make it another run.
        free = {
            name: getattr(config, name)
            for name in ("out", "data", "steps", "resume", "device", "wandb", "checkpoint_every", "log_every")
        }
        before = dataclasses.replace(read_config(config.out), **free)
        changed = [
            f.name for f in dataclasses.fields(config) if getattr(before, f.name) != getattr(config, f.name)
        ]
        if changed:
            raise ConfigError(f"{config.out}: can't resume with another {', '.join(changed)}")
    return done


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"unknown device '{name}'") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device '{name}': this PyTorch sees no CUDA device")
    return device


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:.3f}"),
        TimeRemainingColumn(),
    )
