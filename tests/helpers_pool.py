"""Tasks of a pool of processes, in a module that imports little: a lost worker of Ray is started again."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

from symphony.errors import DataError


def slow_square(number: int) -> int:
    time.sleep(0.05 if number % 3 == 0 else 0.0)
    return number * number


def environment(name: str) -> str:
    return os.environ.get(name, "")


def fail_at_three(number: int) -> int:
    if number == 3:
        raise DataError("three", file="log", segment="s", field="agents")
    return number


def die_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


class Counted:
    """An iterator that knows how much of it was taken."""

    def __init__(self, total: int) -> None:
        self.taken, self.total = 0, total

    def __iter__(self) -> Iterator[int]:
        for k in range(self.total):
            self.taken += 1
            yield k
