"""The training loop."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from pathlib import Path

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from symphony.config import BCConfig, to_json
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle
from symphony.errors import ConfigError, DataError
from symphony.objectives import BCLoss
from symphony.trainers.agents import build_policy, observation_config, read_config
from symphony.trainers.checkpoint import latest, load_checkpoint, prune, save_checkpoint
from symphony.trainers.dataset import SceneDataset
from symphony.trainers.tracking import Tracker

_SEED_STRIDE = 1_000_003
KEEP = 3
"""Checkpoints kept in a run's folder."""


def train(config: BCConfig) -> Path:
    """Train an agent as configured.

    The data of every update is drawn from (seed, update) alone, and checkpoints hold weights and optimiser, so a
    run that was stopped and resumed ends with the same weights as one that was not.

    Returns:
        The run's folder: ``config.json``, ``metrics.jsonl`` and ``checkpoints/``.

    Raises:
        ConfigError: if the folder holds another run, or settings can't be used.
        DataError: if the store can't be read or holds nothing to learn from.
    """
    device = _device(config.device)
    store = SegmentStore(config.data)
    if len(store) == 0:
        raise DataError("the store holds no run segments", file=config.data)
    done = _prepare(config)
    dynamics = Bicycle()
    dataset = SceneDataset(store, config.agent.interactive, dynamics)
    torch.manual_seed(config.seed)
    policy = build_policy(config.agent, dynamics).to(device)
    loss_module = BCLoss(policy)
    optimizer = torch.optim.Adam(policy.parameters(), lr=config.learning_rate)
    if done is not None:
        step = load_checkpoint(done, modules={"policy": policy}, optimizers={"adam": optimizer}).step
    else:
        step = 0
    tracker = Tracker(config.out, json.loads(to_json(config)), config.wandb, after=step)
    seen, rng = observation_config(config.agent), torch.Generator()
    try:
        with _progress() as progress:
            task = progress.add_task("training", total=config.steps, completed=step, loss=math.nan)
            began, first = time.perf_counter(), step
            while step < config.steps:
                rng.manual_seed(config.seed * _SEED_STRIDE + step)
                batch = dataset.sample_states(config.segments, config.states, seen, rng, device)
                for group in optimizer.param_groups:
                    group["lr"] = _learning_rate(config, step)
                losses = loss_module(batch)
                optimizer.zero_grad(set_to_none=True)
                losses["loss_bc"].backward()
                norm = torch.nn.utils.clip_grad_norm_(policy.parameters(), config.clip)
                optimizer.step()
                step += 1
                if step % config.log_every == 0 or step == config.steps:
                    values = {name: losses[name].item() for name in ("loss_bc", "accuracy", "entropy")}
                    speed = (step - first) / (time.perf_counter() - began)
                    values |= {"gradient_norm": norm.item(), "updates_per_second": speed}
                    tracker.log(step, values | {"learning_rate": optimizer.param_groups[0]["lr"]})
                    progress.update(task, loss=values["loss_bc"])
                progress.update(task, completed=step)
                if step % config.checkpoint_every == 0 or step == config.steps:
                    folder = config.out / "checkpoints"
                    save_checkpoint(
                        folder, step=step, modules={"policy": policy}, optimizers={"adam": optimizer}
                    )
                    prune(folder, KEEP)
    finally:
        tracker.close()
    return config.out


def _prepare(config: BCConfig) -> Path | None:
    """Write the configuration, or find the checkpoint to go on from."""
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
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / "config.json").write_text(to_json(config), encoding="utf-8")
    return done


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"unknown device '{name}'") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device '{name}': this PyTorch sees no CUDA device")
    return device


def _learning_rate(config: BCConfig, step: int) -> float:
    """Cosine from the configured rate to a tenth of it."""
    share = 0.5 * (1 + math.cos(math.pi * step / config.steps))
    return config.learning_rate * (0.1 + 0.9 * share)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:.3f}"),
        TimeRemainingColumn(),
    )
