"""Measure wall time, CPU time and peak memory of the WOSAC score of one scenario.

    python benchmarks/wosac_score.py --scenario FILE.tfrecord --rollouts FILE.npz [--threads 1 2] [--repeat 5]

A new process for every number of threads scores the scenario again and again: from the two files to all numbers. The
first time, which fills caches, is listed separately. A last row is the command `symphony wosac score` from its start
to its end, Python's and PyTorch's imports included. Minimum and median; CPU seconds are what a busy machine changes
least. The scorer itself uses one thread, whatever is allowed.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from symphony.files import write_json
from symphony.wosac.files import score_files

UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes that the system counts peak memory in."""


def measured(threads: int, repeat: int, scenario: Path, rollouts: Path, config: str) -> dict[str, Any]:
    """Measure in this process: seconds and CPU seconds of every time, and peak memory in bytes."""
    torch.set_num_threads(threads)
    times = []
    for _ in range(repeat + 1):
        wall, cpu = time.perf_counter(), time.process_time()
        score_files(scenario, rollouts, config)
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    return {"times": times, "peak": peak()}


def commanded(repeat: int, scenario: Path, rollouts: Path, config: str) -> dict[str, Any]:
    """Measure the whole command in the same way."""
    files = ["--scenario", str(scenario), "--rollouts", str(rollouts), "--config", config]
    command = [sys.executable, "-m", "symphony", "wosac", "score", *files]
    times, most = [], 0
    for _ in range(repeat + 1):
        wall = time.perf_counter()
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603
        _, status, used = os.wait4(child.pid, 0)
        if status:
            raise SystemExit(f"the command ended with status {status}")
        times.append((time.perf_counter() - wall, used.ru_utime + used.ru_stime))
        most = max(most, used.ru_maxrss * UNIT)
    return {"times": times, "peak": most}


def peak() -> int:
    """Return the peak memory of this process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * UNIT


def alone(function: Callable[..., dict[str, Any]], *args: Any) -> dict[str, Any]:
    """Call a function in a new process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, args)


def line(name: str, found: dict[str, Any]) -> str:
    """Return one row of the table."""
    (first, _), *rest = found["times"]
    wall, cpu = zip(*rest, strict=True)
    cells = [f"{min(values):.2f} / {statistics.median(values):.2f}" for values in (wall, cpu)]
    memory = f"{found['peak'] / 1e9:.2f}"
    return f"| {' | '.join([name, f'{first:.2f}', *cells, memory])} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--rollouts", type=Path, required=True)
    parser.add_argument("--config", default="2025")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    what = given.repeat, given.scenario, given.rollouts, given.config
    found = {f"{n} thread{'s' * (n > 1)}": alone(measured, n, *what) for n in given.threads}
    found["whole command"] = commanded(*what)
    load = os.getloadavg()[0]
    print(f"{given.repeat} times; {os.cpu_count()} cores, load {load:.1f}\n")
    print("| | first s | s, min / median | CPU s, min / median | peak GB |")
    print("| --- | --- | --- | --- | --- |")
    for name, part in found.items():
        print(line(name, part))
    if given.json is not None:
        write_json(given.json, {"cores": os.cpu_count(), "load": load, "measured": found})


if __name__ == "__main__":
    main()
