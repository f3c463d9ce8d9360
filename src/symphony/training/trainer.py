"""The training loop."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from symphony.agents.agent import read_config
from symphony.agents.checkpoint import latest, load_checkpoint, parts_of, prune, save_checkpoint
from symphony.agents.choice import Best, choose, split_name
from symphony.agents.networks import Networks, build_networks, dynamics_of
from symphony.config import TrainConfig, to_json
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.files import write_file
from symphony.simulation.demonstrations import SceneDataset
from symphony.training.alarms import ALARMS, NORM, Alarms, Skips, loss_of
from symphony.training.learner import Learner
from symphony.training.logging import Tracker
from symphony.training.previews import Show
from symphony.training.processes import Processes, processes
from symphony.training.validation import Validator

KEEP = 3
"""Checkpoints kept in a run's folder, the last ones; the best beside them."""
FREE = ("out", "data", "steps", "resume", "device", "wandb", "show", "checkpoint_every", "log_every")
"""Settings that may be others when a run goes on."""


def train(config: TrainConfig, dataset: SceneDataset | None = None) -> Path:
    """Train an agent as configured.

    The data of every update is drawn from (seed, update) alone, and checkpoints hold weights and optimiser, so a
    run that was stopped and resumed ends with the same weights as one that was not. With a store to validate on, the
    checkpoint that does best there is the run's agent.

    Args:
        config: what to train.
        dataset: the prepared data, if several runs are to share it; by default made from ``config.data``.

    Returns:
        The run's folder: ``config.json``, ``metrics.jsonl``, ``checkpoints/`` and ``media/``.

    Raises:
        ConfigError: if the folder holds another run, or settings can't be used.
        DataError: if a store can't be read or holds nothing to learn from, or the disk refuses.
        TrainingError: if gradients stay infinite or undefined.
    """
    with processes(_device(config.device)) as world:
        folder = _train(config, dataset, world)
        world.wait()
    return folder


def _train(config: TrainConfig, dataset: SceneDataset | None, world: Processes) -> Path:
    if dataset is None:
        store = SegmentStore(config.data)
        dataset = SceneDataset(
            store,
            config.agent.interactive,
            dynamics_of(config),
            routes=config.hierarchical,
            duration=config.duration,
        )
    if len(dataset) == 0:
        raise DataError("the store holds no run segments", file=config.data)
    if config.hierarchical and not dataset.routes:
        raise ConfigError(f"method {config.method} needs a dataset with routes")
    done = _find(config)
    torch.manual_seed(config.seed)
    networks = build_networks(config)
    if config.warm_start is not None and done is None:
        _warm_start(networks, config.warm_start)
    for module in networks.present().values():
        module.to(world.device)
    drawing = dataclasses.replace(config, seed=world.seed(config.seed))
    learner = Learner(drawing, networks, dataset, world.device)
    validator = None
    if world.leads and config.validation.data is not None:
        validator = Validator(config, networks, world.device)
    show = None
    if world.leads and 0 < config.show.every <= config.steps:
        show = Show(config, learner, dataset if validator is None else validator.dataset)
    # No process writes before all have looked at what there is.
    world.wait()
    if world.leads:
        config.out.mkdir(parents=True, exist_ok=True)
        write_file(config.out / "config.json", to_json(config))
    return _Loop(config, learner, validator, show, world).run(done)


class _Loop:
    """One run: updates, records, judgements and checkpoints, in that order."""

    def __init__(
        self,
        config: TrainConfig,
        learner: Learner,
        validator: Validator | None,
        show: Show | None,
        world: Processes,
    ) -> None:
        self.config, self.learner, self.world = config, learner, world
        self.validator, self.show = validator, show
        self.modules = learner.networks.present()
        self.skips, self.told = Skips(), set[str]()
        self.best: Best | None = None
        self.progress = _progress(shown=world.leads)
        self.tracker: Tracker | None = None

    def run(self, done: Path | None) -> Path:
        """Train from a checkpoint, or from the start, to the end."""
        config, step = self.config, 0
        if done is not None:
            loaded = load_checkpoint(done, modules=self.modules, optimizers=self.learner.optimizers)
            step = loaded.step
            self._restore(loaded.extra)
        self.world.share(self.learner)
        self.alarms = Alarms()
        if self.world.leads:
            # The process before may have died between a checkpoint and the removal of old ones.
            self._prune()
            self.tracker = Tracker(config.out, json.loads(to_json(config)), config.wandb, after=step)
            self.alarms = Alarms(self.tracker.kept)
        try:
            with self.progress:
                self.task = self.progress.add_task(
                    "training", total=config.steps, completed=step, loss="-", speed="-"
                )
                self._update_from(step)
        finally:
            if self.tracker is not None:
                self.tracker.close()
        return config.out

    def _update_from(self, step: int) -> None:
        config, first, began = self.config, step, time.perf_counter()
        while step < config.steps:
            self.world.reseed(config.seed, step)
            values = self.learner.update(step)
            step += 1
            last = step == config.steps
            for network in self.skips.count(values):
                self._warn(f"{NORM}{network}", f"a gradient of the {network} network is not finite; skipped")
            numbers: dict[str, float | str] = {}
            if last or step % config.log_every == 0:
                numbers = {name: value.item() for name, value in self.world.mean(values).items()}
                numbers["updates_per_second"] = (step - first) / (time.perf_counter() - began)
                numbers |= self._describe(numbers)
            self.progress.update(self.task, completed=step)
            if self.tracker is None:
                continue
            paused = time.perf_counter()
            if self.validator is not None and (last or step % _validate_every(config) == 0):
                numbers |= self._validate(self.validator, step)
            if self.show is not None and (last or step % config.show.every == 0):
                numbers |= self._show(self.show, self.tracker, step)
            began += time.perf_counter() - paused
            if numbers:
                self.tracker.log(step, numbers)
            if last or step % config.checkpoint_every == 0:
                self.tracker.sync()
                self._save(step)

    def _describe(self, numbers: Mapping[str, Any]) -> dict[str, float | str]:
        """What the loop adds to a record, and shows."""
        rate = self.learner.optimizers["policy"].param_groups[0]["lr"]
        added: dict[str, float | str] = {"learning_rate": rate, "skipped_updates": self.skips.total}
        loss = loss_of("policy", numbers)
        if loss is not None:
            self.progress.update(self.task, loss=f"{numbers[loss]:.3f}")
        self.progress.update(self.task, speed=f"{numbers['updates_per_second']:.3g}")
        alarm = self.alarms.check(numbers)
        if alarm is not None:
            added["alarm"] = alarm
            self._warn(alarm, ALARMS[alarm])
        return added

    def _warn(self, condition: str, message: str) -> None:
        """Tell the user, once."""
        if condition not in self.told and self.world.leads:
            self.told.add(condition)
            self.progress.console.print(f"warning: {message}", style="yellow", soft_wrap=True)

    def _validate(self, validator: Validator, step: int) -> dict[str, float]:
        def show(done: int, total: int) -> None:
            self.progress.update(self.task, description=f"validating {done}/{total}")

        numbers = validator(step, show)
        self.best = validator.best
        self.progress.update(self.task, description="training")
        return numbers

    def _show(self, show: Show, tracker: Tracker, step: int) -> dict[str, float]:
        self.progress.update(self.task, description="showing")
        shown = show(step)
        tracker.show(step, shown.samples, shown.video)
        self.progress.update(self.task, description="training")
        return shown.numbers()

    def _save(self, step: int) -> None:
        """Write a checkpoint; by now all records up to it are on the disk."""
        folder = self.config.out / "checkpoints"
        extra = {
            "best": None if self.best is None else self.best.plain(),
            "skips": dataclasses.asdict(self.skips),
            "processes": self.world.count,
        }
        save_checkpoint(
            folder, step=step, modules=self.modules, optimizers=self.learner.optimizers, extra=extra
        )
        self._prune()

    def _prune(self) -> None:
        protect = () if self.best is None else (self.best.step,)
        prune(self.config.out / "checkpoints", KEEP, protect=protect)

    def _restore(self, extra: Mapping[str, Any]) -> None:
        before = extra.get("processes", 1)
        if before != self.world.count:
            raise ConfigError(
                f"{self.config.out}: trained by {before} processes so far, can't be resumed by {self.world.count}"
            )
        self.best = Best.of(extra)
        self.skips = Skips(**extra.get("skips", {}))
        if self.validator is not None:
            self.validator.best = self.best


def _validate_every(config: TrainConfig) -> int:
    return config.validation.every or config.checkpoint_every


def _warm_start(networks: Networks, name: Path) -> None:
    """Take over the networks that another run has too."""
    source = choose(*split_name(str(name)))
    there = parts_of(source)
    shared = {name: module for name, module in networks.present().items() if name in there}
    load_checkpoint(source, modules=shared, partial=True, restore_rng=False)


def _find(config: TrainConfig) -> Path | None:
    """Find the checkpoint to go on from, if this is a run to go on with."""
    done = latest(config.out / "checkpoints")
    if (config.out / "config.json").exists():
        if not config.resume:
            raise ConfigError(f"{config.out} holds a run already; choose another folder or --resume")
        # More updates, another machine or fewer records do not make it another run.
        free = {name: getattr(config, name) for name in FREE}
        before = read_config(config.out)
        judged = before.validation
        # Judgements of other segments could not be compared with those so far.
        free["validation"] = config.validation
        if judged.data is not None:
            free["validation"] = dataclasses.replace(
                judged, data=config.validation.data, every=config.validation.every
            )
        before = dataclasses.replace(before, **free)
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


def _progress(*, shown: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]}, {task.fields[speed]} updates/s, left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not shown,
    )
