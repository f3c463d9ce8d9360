"""The allocator is set where the process is ours, and only there."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from helpers_runs import tiny
from symphony import allocator, cli
from symphony.data.builtin import builtin_store
from symphony.recipes import train

GLIBC = platform.system() == "Linux" and platform.libc_ver()[0] == "glibc"

FAULTS = """
import resource, numpy as np
from symphony import allocator
set_ = allocator.tune()
def use():
    # Largest first: glibc itself learns from what is freed, but only up to 32 MiB.
    for _ in range(5):
        np.ones(1 << 26, np.uint8)
use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
use()
print(int(set_), resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def outcome(program: str, *words: str, **more: str) -> list[int]:
    """The numbers that a program prints."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "SYMPHONY_MALLOPT"))}
    command = [sys.executable, "-c", program, *words]
    return [int(n) for n in subprocess.check_output(command, env={**environment, **more}, text=True).split()]


@pytest.mark.skipif(not GLIBC, reason="not glibc")
def test_memory_is_kept_once_it_is_set() -> None:
    tuned, kept = outcome(FAULTS)
    untuned, returned = outcome(FAULTS, SYMPHONY_MALLOPT="0")
    assert (tuned, untuned) == (1, 0)
    # 5 x 64 MiB are 81 920 pages of 4 KiB; pages of the kernel's choice may be larger.
    assert kept < 100
    assert returned > 100


BESIDE = """
import re, sys, numpy as np
from symphony import allocator
allocator.tune()
# Something small stays after every large block, so that no end of the heap is free.
both = [(np.ones(1 << 24, np.uint8), np.ones(1 << 16, np.uint8)) for _ in range(16)]
stays = [small for _, small in both]
del both
if sys.argv[1] == "release":
    assert allocator.release()
print(*re.findall(r"VmRSS:\\s+(\\d+)", open("/proc/self/status").read()))
"""


@pytest.mark.skipif(not GLIBC, reason="not glibc")
def test_memory_that_is_free_between_what_stays_is_given_back() -> None:
    (kept,), (released,) = outcome(BESIDE, "keep"), outcome(BESIDE, "release")
    # 256 MiB were freed.
    assert released < kept - (200 << 10)


def test_training_gives_back_at_every_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr(allocator, "release", lambda: calls.append(1))
    train(tiny("bc", builtin_store("train"), tmp_path / "run", steps=5, checkpoint_every=5, log_every=2))
    assert len(calls) == 3  # after 2 and 4 updates, and at the end


def test_the_command_sets_it_for_a_process_of_its_own_only(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr(allocator, "tune", lambda: calls.append(1))
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert cli.main(["--version"]) == 0
    assert calls == []
    assert "OMP_WAIT_POLICY" not in os.environ
    monkeypatch.setattr(sys, "argv", ["symphony", "--version"])
    assert cli.main() == 0
    assert calls == [1]
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    assert cli.main() == 0
    assert os.environ["OMP_WAIT_POLICY"] == "active"
