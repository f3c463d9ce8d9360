"""The one trainer: runs what a recipe has built."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import random
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tensordict import TensorDictBase
from torch import Tensor, nn

from symphony import allocator
from symphony.agents.agent import FILE, Agent
from symphony.agents.checkpoint import MANIFEST, CheckpointError, load_checkpoint, prune, save_checkpoint
from symphony.agents.choice import Best
from symphony.config import RunConfig, to_json
from symphony.errors import ConfigError, DataError
from symphony.files import Lock, write_file
from symphony.training.alarms import ALARMS, NORM, Alarms, Skips, loss_of
from symphony.training.logging import Tracker
from symphony.training.phases import Phase
from symphony.training.processes import Processes
from symphony.training.resume import checkpoint_to_resume, warm_start

if TYPE_CHECKING:
    from symphony.learning import SceneDataset, SearchReplay
    from symphony.training.previews import Previewer
    from symphony.training.validation import Validator

KEEP = 3
"""Checkpoints kept in a run's folder, the last ones; the best beside them."""
CLIP = 1.0
"""Largest norm of a network's gradient."""
LOCK = "run.lock"
"""Held by the process that trains."""
_SEED_STRIDE = 1_000_003


class Trainer:
    """Runs the updates of a recipe: records, validation, previews and checkpoints, in that order.

    All that is random in an update derives from the seed and the number of the update, and checkpoints hold weights
    and optimizers, so a run that was stopped and resumed ends with the same weights as one that was not. With a store
    to validate on, the checkpoint that does best there is the run's agent.

    Args:
        config: of the run; the folder gets it whole.
        agent: what learns, on its device.
        data: what it learns from.
        phases: stretches of updates, in their order.
        optimizers: by name; each is stepped on the losses that come under its name.
        rng: the generator that the updates draw from; seeded anew before each.
        processes: those that train together.
        replay: what is drawn from searches, where there are any.

    Raises:
        ConfigError: if the folder holds another run, or settings can't be used.
        DataError: if a store can't be read or holds nothing to learn from.
    """

    def __init__(
        self,
        config: RunConfig,
        agent: Agent,
        data: SceneDataset,
        phases: Sequence[Phase],
        optimizers: Mapping[str, torch.optim.Optimizer],
        rng: torch.Generator,
        processes: Processes,
        replay: SearchReplay | None = None,
    ) -> None:
        if replay is not None and config.checkpoint_every % replay.every:
            raise ConfigError(
                f"checkpoint-every ({config.checkpoint_every}) must be a multiple of search.updates "
                f"({replay.every}), so that a resumed run repeats no search"
            )
        self.config, self.agent, self.data, self.phases = config, agent, data, phases
        self.optimizers, self.rng, self.world = dict(optimizers), rng, processes
        self.seed = processes.seed(config.seed)
        self.skips, self.told = Skips(), set[str]()
        self.best: Best | None = None
        self.validated: str | None = None
        self.progress = _progress(shown=processes.leads)
        self.tracker: Tracker | None = None
        self.checksum = data.checksum()
        self.done = checkpoint_to_resume(config)
        if config.warm_start is not None and self.done is None:
            warm_start(agent, config.warm_start)
        if agent.personas is not None and self.done is None:
            agent.personas.copy_(data.personas.table())
        self.validator: Validator | None = None
        self.previewer: Previewer | None = None
        # Only a run that simulates its agent loads what simulates, judges and draws.
        if self.world.leads and config.validation.data is not None:
            from symphony.training.validation import Validator  # noqa: PLC0415

            self.validator = Validator(config.validation, agent, processes.device)
        if self.world.leads and 0 < config.preview.every <= config.steps:
            from symphony.training.previews import Previewer  # noqa: PLC0415

            shown = data if self.validator is None else self.validator.dataset
            self.previewer = Previewer(config, agent, shown, processes.device, replay)

    def run(self) -> Path:
        """Train to the end.

        Returns:
            The run's folder: ``config.json``, ``agent.json``, ``metrics.jsonl``, ``checkpoints/`` and ``media/``.

        Raises:
            ConfigError: if another process has begun or gone on with the run since this trainer was made.
            DataError: if another process is at it, or the disk refuses.
            TrainingError: if gradients stay infinite or undefined.
        """
        with contextlib.ExitStack() as held:
            # No process writes before all have looked at what there is.
            self.world.wait()
            if self.world.leads:
                self.config.out.mkdir(parents=True, exist_ok=True)
                self._lock = held.enter_context(Lock(self.config.out / LOCK))
                if checkpoint_to_resume(self.config) != self.done:
                    raise ConfigError(
                        f"{self.config.out}: another process went on with this run in the meantime"
                    )
            return self._run()

    def _run(self) -> Path:
        config, step = self.config, 0
        # Kept with checkpoints like torch's, which the recipe has seeded: those of equal runs are equal files.
        random.seed(config.seed)
        np.random.seed(config.seed % 2**32)  # noqa: NPY002
        if self.world.leads:
            write_file(config.out / "config.json", to_json(config))
            write_file(config.out / FILE, to_json(self.agent.spec))
        if self.done is not None:
            loaded = load_checkpoint(self.done, modules=self.agent.modules, optimizers=self.optimizers)
            step = loaded.step
            try:
                self._restore(loaded.extra)
            except CheckpointError as error:
                raise error.at(file=self.done / MANIFEST) from error
        self.alarms = Alarms()
        for before, phase in pairwise(self.phases):
            if before.until >= config.steps:
                name = getattr(phase.update, "__name__", "the next phase")
                self._warn(name, f"the run ends at update {config.steps}, before the first of {name}")
        others = [] if self.validator is None else [self.validator.dataset]
        for store in (dataset.store for dataset in (self.data, *others)):
            if store.unfinished is not None:
                self._warn(str(store.path), f"{store.path} {store.unfinished}")
        if self.world.leads:
            # The process before may have died between a checkpoint and the removal of old ones.
            self._prune()
            settings = json.loads(to_json(config))
            self.tracker = Tracker(
                config.out,
                settings,
                config.wandb,
                after=step,
            )
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
        self.world.wait()
        return config.out

    def _update_from(self, step: int) -> None:
        config, first, began = self.config, step, time.perf_counter()
        while step < config.steps:
            values = self._update(step)
            step += 1
            last = step == config.steps
            for network in self.skips.count(values):
                self._warn(f"{NORM}{network}", f"a gradient of the {network} network is not finite; skipped")
            numbers: dict[str, float | str] = {}
            if last or step % config.log_every == 0:
                numbers = {name: value.item() for name, value in self.world.mean(values).items()}
                numbers["updates_per_second"] = (step - first) / (time.perf_counter() - began)
                numbers |= self._describe(numbers)
                allocator.release()
            self.progress.update(self.task, completed=step)
            if self.tracker is None:
                continue
            paused = time.perf_counter()
            if self.validator is not None and (last or step % config.checkpoint_every == 0):
                numbers |= self._validate(self.validator, step)
            if self.previewer is not None and (last or step % config.preview.every == 0):
                numbers |= self._preview(self.previewer, self.tracker, step)
            began += time.perf_counter() - paused
            if numbers:
                self.tracker.log(step, numbers)
            if last or step % config.checkpoint_every == 0:
                self.tracker.sync()
                self._save(step)

    def _update(self, step: int) -> dict[str, Tensor]:
        """One update of every network; what is worth a record, as tensors without gradient."""
        self.rng.manual_seed(self.seed * _SEED_STRIDE + step)
        self.world.reseed(self.config.seed, step)
        phase = next(phase for phase in self.phases if step < phase.until)
        for name, rate in phase.rates(step).items():
            for group in self.optimizers[name].param_groups:
                group["lr"] = rate
        record: dict[str, Tensor] = {}
        for name, losses in phase.update(step):
            found = self._descend(name, losses)
            norm = f"{NORM}{name}"
            if norm in record:  # stepped more than once: the largest counts, and NaN, so that no skip is lost
                found[norm] = torch.maximum(record[norm], found[norm])
            record |= found
        return record

    def _descend(self, name: str, losses: TensorDictBase) -> dict[str, Tensor]:
        """Step the optimizer of a name; its statistics, with the name before those that are no losses."""
        named = {
            key if key.startswith(("loss", name)) else f"{name}_{key}": value.detach()
            for key, value in losses.items()
        }
        if name not in self.optimizers:
            return named
        parts = {key: value for key, value in losses.items() if key.startswith("loss")}
        total = torch.stack(list(parts.values())).sum()
        if len(parts) == 1:  # recorded as the network's loss
            named.pop(next(iter(parts)))
        optimizer = self.optimizers[name]
        weights = [weight for group in optimizer.param_groups for weight in group["params"]]
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        norm = nn.utils.clip_grad_norm_(weights, CLIP)
        if bool(norm.isfinite()):  # else the update is skipped; the loop counts them
            optimizer.step()
        return {**named, f"loss_{name}": total.detach(), f"{NORM}{name}": norm}

    def _describe(self, numbers: Mapping[str, Any]) -> dict[str, float | str]:
        """What the loop adds to a record, and shows."""
        added: dict[str, float | str] = {}
        if "policy" in self.optimizers:
            added["learning_rate"] = self.optimizers["policy"].param_groups[0]["lr"]
        added["skipped_updates"] = self.skips.total
        loss = loss_of("policy")
        if loss in numbers:
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
        self.best, self.validated = validator.best, validator.what
        self.progress.update(self.task, description="training")
        return numbers

    def _preview(self, previewer: Previewer, tracker: Tracker, step: int) -> dict[str, float]:
        self.progress.update(self.task, description="previewing")
        preview = previewer(step)
        tracker.preview(step, preview.samples, preview.video)
        self.progress.update(self.task, description="training")
        return preview.numbers()

    def _save(self, step: int) -> None:
        """Write a checkpoint; by now all records up to it are on the disk."""
        self._lock.check()
        extra = {
            "best": None if self.best is None else dataclasses.asdict(self.best),
            "validated": self.validated,
            "skips": dataclasses.asdict(self.skips),
            "processes": self.world.count,
            "data": self.checksum,
        }
        save_checkpoint(
            self.config.out / "checkpoints",
            step=step,
            modules=self.agent.modules,
            optimizers=self.optimizers,
            extra=extra,
        )
        self._prune()

    def _prune(self) -> None:
        protect = () if self.best is None else (self.best.step,)
        prune(self.config.out / "checkpoints", KEEP, protect=protect)

    def _restore(self, extra: Mapping[str, Any]) -> None:
        before = extra.get("processes", 1)
        if type(before) is not int or before < 1:
            raise CheckpointError("no number of processes", field="extra.processes")
        if before != self.world.count:
            raise ConfigError(
                f"{self.config.out}: trained by {before} processes so far, can't be resumed by {self.world.count}"
            )
        if extra.get("data", self.checksum) != self.checksum:
            raise DataError(
                f"not the run segments, or the record of hard ones, that {self.config.out} learned from so far: "
                f"checksum {self.checksum[:12]}, then {str(extra['data'])[:12]}",
                file=self.data.store.path,
            )
        self.best, self.validated = Best.of(extra), extra.get("validated")
        self.skips = Skips.of(extra)
        if self.validator is not None:
            if self.best is not None and self.validated not in (None, self.validator.what):
                raise ConfigError(
                    f"{self.config.out}: its best checkpoint was chosen by {self.validated}; can't be compared with "
                    f"{self.validator.what}"
                )
            self.validator.best = self.best


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
