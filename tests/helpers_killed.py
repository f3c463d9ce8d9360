"""Training that is killed again and again: run as a program, with STORE OUT METHOD...

For each method ``OUT/METHOD/whole`` is trained in one go, and ``OUT/METHOD/killed`` by processes that kill themselves
one after the other. Prints what they died at.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import helpers_runs
from symphony.config import TrainConfig, ValidationConfig
from symphony.data.store import SegmentStore
from symphony.simulation.demonstrations import SceneDataset
from symphony.training import train, validation
from symphony.training import trainer as training
from symphony.training.learner import Learner
from symphony.training.logging import Tracker

STEPS = 8
OWNERS = {
    "update": Learner,
    "log": Tracker,
    "judge": validation,
    "fsync": os,
    "rename": Path,
    "replace": Path,
    "rmtree": shutil,
    "unlink": Path,
}
DEATHS = (
    ("update", 1),
    ("fsync", 4),  # in the first checkpoint, when some of its files are written
    ("rename", 0),  # when all of them are
    ("log", 2),  # after it, half a record being written
    ("judge", 0),
    ("replace", 1),  # while it is taken up again, its records being written anew
    ("rmtree", 0),  # between the next checkpoint and the removal of old ones
    ("unlink", 0),  # in the removal of an old one
)
"""Operations and how often each goes well before."""


def config(method: Any, store: Path, out: Path) -> TrainConfig:
    """Of a run with more checkpoints than are kept."""
    judged = ValidationConfig(store, segments=1, rollouts=1)
    return helpers_runs.tiny(method, store, out, steps=STEPS, validation=judged, resume=True)


def die_at(name: str, count: int, report: int) -> None:
    """Have this process killed at an operation that went well so many times."""
    action: Callable[..., Any] = getattr(OWNERS[name], name)
    left = iter(range(count))

    def deadly(*args: Any, **options: Any) -> Any:
        if next(left, None) is not None:
            return action(*args, **options)
        if name == "log":
            args[0]._file.write('{"step": 3, "los')
            args[0]._file.flush()
        os.write(report, f"{name}\n".encode())
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError

    setattr(OWNERS[name], name, deadly)


def live(settings: TrainConfig, dataset: SceneDataset, death: tuple[str, int] | None = None) -> int:
    """Train in a process of its own; returns how it ended."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            if death is not None:
                die_at(*death, os.dup(1))
            train(settings, dataset)
            status = 0
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def main(store: Path, out: Path, methods: list[str]) -> int:
    """Train each method in one go and in many."""
    os.fsync = lambda descriptor: None  # the kernel outlives us
    training.KEEP = 2
    dataset = SceneDataset(SegmentStore(store))
    for item in range(len(dataset)):
        dataset.experts(item), dataset.scene(item)
    for method in methods:
        part, whole = (config(method, store, out / method / name) for name in ("killed", "whole"))
        ends = [live(part, dataset, death) for death in DEATHS]
        if ends != [-signal.SIGKILL] * len(DEATHS) or live(part, dataset) or live(whole, dataset):
            return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]))
