"""Training in one go, ``OUT/whole``, and by processes that kill themselves and say at what, ``OUT/killed``."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path
from typing import Any

import helpers_runs
from helpers_processes import fork
from symphony.config import TrainConfig, ValidationConfig
from symphony.recipes import train
from symphony.training import Trainer, hooks
from symphony.training import trainer as training
from symphony.training.logging import Tracker

STEPS = 8
OWNERS = {"_update": Trainer, "log": Tracker, "evaluate": hooks, "fsync": os, "rmtree": shutil}
OWNERS |= dict.fromkeys(("rename", "replace", "unlink"), Path)
DEATHS = (
    ("_update", 1, ""),
    ("fsync", 5, ""),  # in the first checkpoint, when some of its files are written
    ("rename", 0, ""),  # when all of them are
    ("log", 2, ""),  # after it, half a record being written
    ("evaluate", 0, ""),
    ("replace", 0, "metrics.jsonl"),  # while it is taken up again, its records being written anew
    ("replace", 0, "agent.json"),  # and before that
    ("rmtree", 0, ""),  # between the next checkpoint and the removal of old ones
    ("unlink", 0, "checkpoint.json"),  # in the removal of an old one
)
"""Operations, how often each goes well before, and the end of the names of the files that count."""


def config(method: Any, store: Path, out: Path) -> TrainConfig:
    """Return the configuration of a run with more checkpoints than are kept."""
    evaluated = ValidationConfig(data=store, segments=1, rollouts=1)
    return helpers_runs.tiny(method, store, out, steps=STEPS, validation=evaluated, resume=True)


def die_at(name: str, count: int, file: str, report: int) -> None:
    """Have this process killed at an operation after it went well the given number of times."""
    action: Any = getattr(OWNERS[name], name)
    left = iter(range(count))

    def deadly(*args: Any, **options: Any) -> Any:
        if not str(args[-1] if args else "").endswith(file) or next(left, None) is not None:
            return action(*args, **options)
        if name == "log":
            args[0]._file.write('{"step": 3, "los')
            args[0]._file.flush()
        os.write(report, f"{name}\n".encode())
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError

    setattr(OWNERS[name], name, deadly)


def live(settings: TrainConfig, death: tuple[str, int, str] | None = None) -> int:
    """Train in a process of its own; returns how it ended."""

    def life() -> None:
        if death is not None:
            die_at(*death, os.dup(1))
        train(settings)

    return os.waitstatus_to_exitcode(os.waitpid(fork(life), 0)[1])


def main(store: Path, out: Path, method: str) -> int:
    """Train in one go and in many."""
    os.fsync = lambda descriptor: None  # the kernel outlives us
    training.KEEP = 2
    part, whole = (config(method, store, out / name) for name in ("killed", "whole"))
    ends = [live(part, death) for death in DEATHS]
    return int(ends != [-signal.SIGKILL] * len(DEATHS) or live(part) != 0 or live(whole) != 0)
