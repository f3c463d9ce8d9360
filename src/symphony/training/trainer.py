"""The one trainer: runs what a recipe has built, from its last checkpoint, another run's networks, or scratch."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import random
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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
from symphony.agents.agent import FILE, Agent, read_spec
from symphony.agents.checkpoint import (
    MANIFEST,
    CheckpointError,
    latest,
    load_checkpoint,
    parts_of,
    prune,
    save_checkpoint,
)
from symphony.agents.choice import Best, choose, split_name
from symphony.config import RunConfig, read_json, to_json
from symphony.errors import ConfigError, DataError, SymphonyError
from symphony.files import Lock, write_file
from symphony.training.logging import RECORDS, Tracker
from symphony.training.processes import Processes

if TYPE_CHECKING:
    from symphony.learning import SceneDataset, SearchReplay
    from symphony.training.hooks import Previewer, Validator

KEEP = 3  # checkpoints in a run's folder, the last ones; the best beside them
CLIP = 1.0  # largest norm of a network's gradient
LOCK = "run.lock"  # held by the process that trains
NORM = "gradient_norm_"
PATIENCE = 20  # updates in a row that may be skipped
WINDOW = 10  # records that an alarm looks back on
ALARMS = {
    "discriminator_too_strong": "the discriminator tells simulated from logged states almost without fail (AUC above "
    "0.98 in the last 10 records): its scores rank little; consider a lower rate or a gradient penalty for it",
    "discriminator_blind": "the discriminator can't tell simulated from logged states (AUC below 0.52 in the last 10 "
    "records): its scores are chance; consider a higher rate, or more features or states for it",
}
"""Values that `alarm` in the metrics may have, and what they mean."""
FREE = ("out", "data", "steps", "resume", "device", "wandb", "preview", "checkpoint_every", "log_every", "compile")
"""Settings that may change when a run goes on: more updates or another machine do not make another run."""
_SEED_STRIDE = 1_000_003

Updates = Iterator[tuple[str, TensorDictBase]]
"""Losses one by one, each with the name of the optimizer that descends it before the next is computed. Losses without
an optimizer of their name are only recorded."""
Rates = Callable[[int], Mapping[str, float]]
"""Learning rates by optimizer at an update."""


@dataclass(frozen=True)
class Phase:
    """A stretch of updates of one kind, up to the update `until`, counted from the start of the run."""

    until: int
    update: Callable[[int], Updates]
    rates: Rates


def cosine(rates: Mapping[str, float], end: int, begin: int = 0, **ends: int) -> Rates:
    """Return rates that fall to a tenth along a cosine, from update ``begin`` to ``end``, and are 0 after it.
    Networks named in ``ends`` learn from update 0 to an end of their own. A KeyError names one without a rate.
    """
    spans = dict.fromkeys(rates, (begin, end)) | {name: (0, last) for name, last in ends.items()}

    def at(step: int) -> Mapping[str, float]:
        done = {name: (step - first) / (last - first) for name, (first, last) in spans.items()}
        falls = {name: 0.55 + 0.45 * math.cos(math.pi * share) if share < 1 else 0.0 for name, share in done.items()}
        return {name: rates[name] * fall for name, fall in falls.items()}

    return at


class TrainingError(SymphonyError):
    """Training that can't go on."""


@dataclass
class Skips:
    """The number of optimizer steps of each network in a row that were left out for a gradient that is not finite."""

    total: int = 0
    in_row: dict[str, int] = field(default_factory=dict)

    def count(self, values: Mapping[str, Tensor]) -> list[str]:
        """Count the skips of one update, from its gradient norms; return the networks concerned, and raise
        TrainingError if one had to skip too many in a row.
        """
        norms = {name.removeprefix(NORM): value for name, value in values.items() if name.startswith(NORM)}
        if not norms:
            return []
        # One transfer from the device for all.
        finite = torch.stack([norm.detach() for norm in norms.values()]).isfinite().tolist()
        bad = [name for name, good in zip(norms, finite, strict=True) if not good]
        self.total += len(bad)
        for name in norms:
            self.in_row[name] = self.in_row.get(name, 0) + 1 if name in bad else 0
            if self.in_row[name] >= PATIENCE:
                raise TrainingError(
                    f"the gradient of the {name} network (loss_{name} is {values[f'loss_{name}'].item():g}) was not "
                    f"finite in {PATIENCE} updates in a row: train anew in another folder with a lower learning "
                    "rate, or check the data"
                )
        return bad


class Alarms:
    """Watches the records of a run, earlier ones included, for a discriminator that has won or learns nothing."""

    def __init__(self, records: Iterable[Mapping[str, Any]] = ()) -> None:
        self._recent: deque[float] = deque(maxlen=WINDOW)
        for record in records:
            self.check(record)

    def check(self, record: Mapping[str, Any]) -> str | None:
        """Return the alarm (see :data:`ALARMS`) that is on after this record, if any."""
        value = record.get("discriminator_auc")
        if value is None or math.isnan(value):
            return None
        self._recent.append(value)
        if len(self._recent) < WINDOW:
            return None
        if min(self._recent) > 0.98:
            return "discriminator_too_strong"
        return "discriminator_blind" if max(self._recent) < 0.52 else None


class Trainer:
    """Runs the updates of a recipe: records, validation, previews and checkpoints, in that order.

    All randomness in an update derives from the seed and the number of the update, and checkpoints hold weights and
    optimizers, so a resumed run ends with the same weights as one that was never stopped.

    Args:
        config: the run's configuration; written whole to its folder.
        agent: the agent to train, on its device.
        data: the scenes to learn from.
        phases: the stretches of updates, in their order.
        optimizers: the optimizers by name; each is stepped on the losses that come under its name.
        rng: the generator of all draws of updates; seeded again before each.
        processes: the processes that train together.
        replay: the draws from searches, where there are any.

    Attributes:
        validator: a hook called at every checkpoint, of which the best then is the run's agent.
        previewer: a hook called every ``preview.every`` updates; see :func:`symphony.training.hooks.add_hooks`.
    """

    validator: Validator | None = None
    previewer: Previewer | None = None

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
        if replay is not None and config.checkpoint_every % replay.period:
            many = "" if replay.period == replay.every else f" x {replay.period // replay.every} searches as one"
            raise ConfigError(
                f"checkpoint-every ({config.checkpoint_every}) must be a multiple of search.updates "
                f"({replay.every}){many}, so that a resumed run repeats no search"
            )
        self.config, self.agent, self.data, self.phases = config, agent, data, phases
        self.optimizers, self.rng, self.world, self.replay = dict(optimizers), rng, processes, replay
        self.seed = processes.seed(config.seed)
        self.skips, self.told = Skips(), set[str]()
        self.best: Best | None = None
        self.validated: str | None = None
        speed = TextColumn("loss {task.fields[loss]}, {task.fields[speed]} updates/s, left")
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), speed, TimeRemainingColumn())
        self.progress = Progress(*columns, console=Console(stderr=True), disable=not processes.is_main)
        self.tracker: Tracker | None = None
        self.checksum = data.checksum()
        self.done = checkpoint_to_resume(config)
        if config.warm_start is not None and self.done is None:
            warm_start(agent, config.warm_start)

    def run(self) -> Path:
        """Train to the end.

        Returns:
            The run's folder: ``config.json``, ``agent.json``, ``metrics.jsonl``, ``checkpoints/`` and ``media/``.

        Raises:
            ConfigError: if another process has begun or gone on with the run since this trainer was made.
            DataError: if another process trains it, or the disk refuses.
            TrainingError: if gradients stay infinite or undefined.
        """
        with contextlib.ExitStack() as held:
            self.world.wait()  # no process writes before all have read what exists
            if self.world.is_main:
                self._lock = held.enter_context(Lock(self.config.out / LOCK))
                if checkpoint_to_resume(self.config) != self.done:
                    raise ConfigError(f"{self.config.out}: another process has continued this run meanwhile")
            return self._run()

    def _run(self) -> Path:
        config, step = self.config, 0
        # Kept with checkpoints like torch's, which the recipe has seeded: those of equal runs are equal files.
        random.seed(config.seed)
        np.random.seed(config.seed % 2**32)  # noqa: NPY002
        if self.done is not None:
            loaded = load_checkpoint(self.done, modules=self.agent.modules, optimizers=self.optimizers)
            step = loaded.step
            try:
                self._restore(loaded.extra)
            except CheckpointError as error:
                raise error.at(file=self.done / MANIFEST) from error
        if self.world.is_main:
            write_file(config.out / "config.json", to_json(config))
            write_file(config.out / FILE, to_json(self.agent.spec))
        self.alarms = Alarms()
        for before, phase in pairwise(self.phases):
            if before.until >= config.steps:
                name = getattr(phase.update, "__name__", "the next phase")
                self._warn(name, f"the run ends at update {config.steps}, before the first of {name}")
        others = [] if self.validator is None else [self.validator.dataset]
        for store in (dataset.store for dataset in (self.data, *others)):
            if store.unfinished is not None:
                self._warn(str(store.path), f"{store.path} {store.unfinished}")
        if self.world.is_main:
            # The process before may have died between a checkpoint and the removal of old ones.
            self._prune()
            self.tracker = Tracker(config.out, json.loads(to_json(config)), config.wandb, after=step)
            self.alarms = Alarms(self.tracker.kept)
        try:
            with self.progress:
                shown: Any = {"total": config.steps, "completed": step, "loss": "-", "speed": "-"}
                self.task = self.progress.add_task("training", **shown)
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
                numbers |= self.validator(step, lambda n, total: self._show(f"validating {n}/{total}"))
                self.best, self.validated = self.validator.best, self.validator.what
            if self.previewer is not None and (last or step % config.preview.every == 0):
                self._show("previewing")
                self.previewer(step, self.tracker)
            self._show("training")
            began += time.perf_counter() - paused
            if numbers:
                self.tracker.log(step, numbers)
            if last or step % config.checkpoint_every == 0:
                self.tracker.sync()
                self._save(step)

    def _update(self, step: int) -> dict[str, Tensor]:
        """Update every network once; return what is worth a record, as tensors without gradient."""
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
        """Step the optimizer of a name; return its statistics, those that are not losses prefixed with the name."""
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
        """Show the numbers of a record; return what the loop adds to it."""
        added: dict[str, float | str] = {}
        if "policy" in self.optimizers:
            added["learning_rate"] = self.optimizers["policy"].param_groups[0]["lr"]
        added["skipped_updates"] = self.skips.total
        if "loss_policy" in numbers:
            self.progress.update(self.task, loss=f"{numbers['loss_policy']:.3f}")
        self.progress.update(self.task, speed=f"{numbers['updates_per_second']:.3g}")
        alarm = self.alarms.check(numbers)
        if alarm is not None:
            added["alarm"] = alarm
            self._warn(alarm, ALARMS[alarm])
        return added

    def _warn(self, condition: str, message: str) -> None:
        """Tell the user, once."""
        if condition not in self.told and self.world.is_main:
            self.told.add(condition)
            self.progress.console.print(f"warning: {message}", style="yellow", soft_wrap=True)

    def _show(self, what: str) -> None:
        self.progress.update(self.task, description=what)

    def _save(self, step: int) -> None:
        """Write a checkpoint; all records up to it are on disk by now."""
        self._lock.check()
        extra = {
            "best": None if self.best is None else dataclasses.asdict(self.best),
            "validated": self.validated,
            "skips": dataclasses.asdict(self.skips),
            "processes": self.world.count,
            "data": self.checksum,
            "period": 0 if self.replay is None else self.replay.period,
        }
        what: Any = {"modules": self.agent.modules, "optimizers": self.optimizers, "extra": extra}
        save_checkpoint(self.config.out / "checkpoints", step=step, **what)
        self._prune()

    def _prune(self) -> None:
        protect = () if self.best is None else (self.best.step,)
        prune(self.config.out / "checkpoints", KEEP, protect=protect)

    def _restore(self, extra: Mapping[str, Any]) -> None:
        before = extra.get("processes", 1)
        out, count = self.config.out, self.world.count
        if before != count:
            raise ConfigError(f"{out}: trained by {before} processes so far, can't be resumed by {count}")
        period = 0 if self.replay is None else self.replay.period
        if (searched := extra.get("period", period)) != period:
            what = f"{out}: searched for {searched} updates at a time so far, now it would for {period}"
            raise ConfigError(f"{what}: device and checkpoint-every decide that")
        then = str(extra.get("data", self.checksum))
        if then != self.checksum:
            why = f"not the run segments that {out} learned from so far"
            numbers = f"checksum {self.checksum[:12]}, then {then[:12]}"
            raise DataError(f"{why}: {numbers}", file=self.data.store.path)
        self.best, self.validated = Best.of(extra), extra.get("validated")
        self.skips = Skips(**extra.get("skips") or {})
        if self.validator is not None:
            if self.best is not None and self.validated not in (None, self.validator.what):
                chosen = f"its best checkpoint was chosen by {self.validated}"
                raise ConfigError(f"{out}: {chosen}; can't be compared with {self.validator.what}")
            self.validator.best = self.best


def checkpoint_to_resume(config: RunConfig) -> Path | None:
    """Return the checkpoint to go on from; None for a new run. ConfigError if the folder holds another run."""
    path, records = config.out / "config.json", config.out / RECORDS
    found = latest(config.out / "checkpoints")
    if path.exists():
        # One that failed at its first update, say for a wrong setting, has nothing to lose.
        if not config.resume and found is None and not (records.exists() and records.stat().st_size):
            return None
        if not config.resume:
            raise ConfigError(f"{config.out} holds a run already; choose another folder or --resume")
        before = read_json(type(config), path)
        free = {name: getattr(config, name) for name in (*FREE, "validation")}
        # Scores on other segments could not be compared with those so far.
        if before.validation.data is not None:
            free["validation"] = dataclasses.replace(before.validation, data=config.validation.data)
        changed = _changed(dataclasses.replace(before, **free), config)
        if changed:
            raise ConfigError(f"{config.out}: can't resume with another {', '.join(changed)}")
    elif found is not None:
        raise ConfigError(f"{config.out} holds checkpoints without their config.json; choose another folder")
    if found is not None and (done := int(found.name[-12:])) > config.steps:
        raise ConfigError(f"{config.out}: {done} updates are done, more than steps ({config.steps})")
    return found


def _changed(before: Any, after: Any, where: str = "") -> list[str]:
    """Return the settings that differ, nested ones by their full names, with their old values."""
    found = []
    for name in (item.name for item in dataclasses.fields(after)):
        one, other = getattr(before, name), getattr(after, name)
        if dataclasses.is_dataclass(one) and type(one) is type(other):
            found += _changed(one, other, f"{where}{name}.")
        elif one != other:
            found.append(f"{where}{name} (was {one})")
    return found


def warm_start(agent: Agent, run: Path) -> None:
    """Take over the networks that another run has too.

    Raises ConfigError if there is no such run, it learned another time step or action space, and CheckpointError if
    its networks have other shapes, with the settings of the agent that differ.
    """
    folder, which = split_name(str(run))
    source = choose(folder, which)
    there = parts_of(source)
    shared = {name: module for name, module in agent.modules.items() if name in there}
    before = read_spec(folder)
    if agent.spec is not None:
        dataclasses.replace(agent, name=str(run), spec=before).check_step(agent.spec.dt)
        if "policy" in shared and before.action_space != (wanted := agent.spec.action_space):
            raise ConfigError(f"{run}: its agent has another action_space: {before.action_space}, not {wanted}")
    try:
        load_checkpoint(source, modules=shared, partial=True, restore_rng=False)
    except CheckpointError as error:
        changed = [] if agent.spec is None else _changed(before, agent.spec)
        if changed := [one for one in changed if one.startswith(("action", "goals", "agent", "discriminator"))]:
            error.message += f"; its agent has another {', '.join(changed)}"
        raise
