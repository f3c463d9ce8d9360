"""Wall time, CPU time and peak memory of the WOSAC score of one scenario.

    python benchmarks/wosac_score.py --scenario FILE.tfrecord --rollouts FILE.npz [--threads 1 2] [--repeat 5]

A new process for every number of threads scores the scenario again and again: from the two files to all numbers. The
first time, which fills caches, is given apart. A last row is the command `symphony wosac score` from its start to its
end, Python's and PyTorch's imports included. Minimum and median; CPU seconds are what a busy machine changes least.
The scorer itself uses one thread, whatever is allowed.
"""

from __future__ import annotations

import argparse
import json
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

from symphony.cli.wosac_files import score_files


def measured(threads: int, repeat: int, scenario: Path, rollouts: Path, config: str) -> dict[str, Any]:
    """In a process of its own: seconds and CPU seconds of every time, peak memory after imports and at last."""
    torch.set_num_threads(threads)
    imported = peak()
    times = []
    score = 0.0
    for _ in range(repeat + 1):
        wall, cpu = time.perf_counter(), time.process_time()
        (found,) = score_files(scenario, rollouts, config)
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
        score = found.scores.metametric
    return {"times": times, "imported": imported, "peak": peak(), "metametric": score}


def commanded(repeat: int, scenario: Path, rollouts: Path, config: str) -> dict[str, Any]:
    """The same of the whole command."""
    files = ["--scenario", str(scenario), "--rollouts", str(rollouts), "--config", config]
    command = [sys.executable, "-m", "symphony", "wosac", "score", *files]
    times = []
    for _ in range(repeat + 1):
        began = [resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = used.ru_utime + used.ru_stime - began[0].ru_utime - began[0].ru_stime
        times.append((time.perf_counter() - began[1], cpu))
    return {"times": times}


def peak() -> int:
    """Peak memory of this process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def alone(function: Callable[..., dict[str, Any]], *args: Any) -> dict[str, Any]:
    """Call it in a new process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, args)


def line(name: str, found: dict[str, Any]) -> str:
    """One row of the table."""
    (first, _), *rest = found["times"]
    wall, cpu = zip(*rest, strict=True)
    cells = [f"{min(values):.2f} / {statistics.median(values):.2f}" for values in (wall, cpu)]
    memory = f"{found['peak'] / 1e9:.2f} ({found['imported'] / 1e9:.2f})" if "peak" in found else ""
    return f"| {' | '.join([name, f'{first:.2f}', *cells, memory])} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
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
    print("| | first s | s, min / median | CPU s, min / median | peak GB (after imports) |")
    print("| --- | --- | --- | --- | --- |")
    for name, part in found.items():
        print(line(name, part))
    if given.json is not None:
        given.json.write_text(json.dumps({"load": load, **found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
