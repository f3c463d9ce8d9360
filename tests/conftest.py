"""Shared fixtures."""

from __future__ import annotations

import gc
import importlib.util
import multiprocessing
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from helpers_processes import serve_from_here
from helpers_skips import LIMITS, by_kind, grown
from symphony import allocator
from symphony import parallel as engine

MEMORY = "/dev/shm"  # noqa: S108 - pytest makes a folder of its own there

# There is next to no garbage while tests are imported; to look for it would be a fifth of that work. Nor is there
# much among so few new objects as Python looks at by default.
gc.disable()
gc.set_threshold(20_000, 10, 10)

# TensorDict looks for pandas after every network, which takes long where there is none.
find = importlib.util.find_spec
if find("pandas") is None:
    importlib.util.find_spec = lambda name, package=None: None if name == "pandas" else find(name, package)

# Thousands of small files are made and removed in memory, where there is room for them.
if os.path.isdir(MEMORY) and shutil.disk_usage(MEMORY).free > 8 << 30:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", MEMORY)

# A busy machine must not fail a test; other examples are tried each time.
settings.register_profile("symphony", deadline=None, max_examples=20)
settings.load_profile("symphony")

# Two torch threads on shared cores spin against each other otherwise; must precede the first torch import.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("WANDB_MODE", "disabled")

# Whether there is a card is asked without CUDA itself: processes forked after it has begun can't use it.
os.environ.setdefault("PYTORCH_NVML_BASED_CUDA_CHECK", "1")

# What a shell starts in the background ignores interrupts, and so would all that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Nothing that was imported or collected is garbage: it is not to be looked at again and again."""
    gc.freeze()
    gc.enable()
    allocator.tune()  # this process is ours
    if "tyro" in sys.modules:  # which would read the source of commands each time, asked for by the hundred
        source = sys.modules["tyro._docstrings"]._ClassTokenization
        source.make = cache(source.make)
    serve_from_here()


def _skipped(config: pytest.Config) -> Counter[str]:
    reporter: Any = config.pluginmanager.get_plugin("terminalreporter")
    reports = [] if reporter is None else reporter.stats.get("skipped", [])
    return by_kind([str(report.longrepr[2]) for report in reports])


def pytest_sessionfinish(session: pytest.Session) -> None:
    """With SYMPHONY_SKIPS in the environment (.ci/run) more skipped tests than are written down are a failure."""
    more = os.environ.get("SYMPHONY_SKIPS") and grown(_skipped(session.config), LIMITS.read_text())
    if more and not session.exitstatus:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Say what skipped tests lacked."""
    counts = _skipped(config)
    if counts:
        terminalreporter.section("skipped for want of")
        for kind, count in counts.most_common():
            terminalreporter.line(f"{count:4} {kind}")
    for line in grown(counts, LIMITS.read_text()) if os.environ.get("SYMPHONY_SKIPS") else ():
        terminalreporter.line(line, red=True)


@pytest.fixture(autouse=True)
def _path_as_it_was() -> Iterator[None]:
    """A user's file brings its folder with it; where hundreds stay, whatever is looked for and missing takes long."""
    before = list(sys.path)
    yield
    sys.path[:] = before


@pytest.fixture
def _started_quickly() -> Iterator[None]:
    """TorchRL starts processes as the global setting says, each with imports of its own if there is none."""
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method(engine._START, force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.fixture(scope="session")
def samples() -> Path:
    """Folder of the real samples; the test is skipped where it is absent."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SYMPHONY_SAMPLES", default))
    if not folder.is_dir():
        pytest.skip(f"real samples not found at {folder} (set SYMPHONY_SAMPLES)")
    return folder
