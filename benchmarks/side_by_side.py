"""Measure two versions in turn on one machine, and print a table of ratios.

    python benchmarks/side_by_side.py --before 9eed275 [--rounds 15] [--only simulator ...]

Each figure is the median over rounds in which the versions take turns, each in a process of its own, so that other
load on the machine affects all of them. The version before is checked out beside this one by ``git worktree``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
YARDSTICKS = ("brute force", "matmul")


def started(root: Path, program: str, *options: str) -> subprocess.Popen[str]:
    """Start a program of this folder with the package of one version."""
    paths = os.pathsep.join([str(root / "src"), str(ROOT / "tests")])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    command = [sys.executable, str(ROOT / "benchmarks" / program), *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, text=True, cwd=root)  # noqa: S603


def run(root: Path, program: str, *options: str) -> str:
    """Return what a program prints."""
    process = started(root, program, *options)
    printed, _ = process.communicate()
    if process.returncode:
        raise SystemExit(f"{program} failed with {root}")
    return printed


class Worker:
    """A workload in a process of its own."""

    def __init__(self, root: Path, *options: str) -> None:
        self.process = started(root, "workloads.py", *options)
        self._line()

    def _line(self) -> str:
        line = self.process.stdout.readline() if self.process.stdout else ""
        if not line:
            raise SystemExit(f"{' '.join(map(str, self.process.args))} failed")  # type: ignore[arg-type]
        return line

    def measure(self) -> dict[str, float]:
        """Measure one round."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return json.loads(self._line())

    def close(self) -> None:
        """End the process."""
        self.process.communicate()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", required=True, help="a commit")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--only", nargs="+")
    arguments = parser.parse_args()
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from workloads import WORKLOADS  # noqa: PLC0415

    names = arguments.only or list(WORKLOADS)
    with checked_out(arguments.before) as old:
        report(old, names, arguments.rounds)


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Check out the files of a commit into a folder of their own."""
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "before"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", str(old), commit], check=True, capture_output=True)  # noqa: S603
        try:
            yield old
        finally:
            subprocess.run([*git, "remove", "--force", str(old)], check=True, capture_output=True)  # noqa: S603


HEADER = """| a second of | before | after | ratio | memory kept: before | after | ratio | faults | peak MiB |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |"""
WAYS = {"before": (), "after": (), "before kept": ("--keep-memory",), "after kept": ("--keep-memory",)}


def report(old: Path, names: list[str], rounds: int) -> None:
    """Measure and print the table."""
    from measure import HOW, Row  # noqa: PLC0415

    print(HEADER, flush=True)
    for name in names:
        # The same for both: what is made once and kept, such as scenes, would else be paid by one of them.
        warm = str(HOW[name].get("warm", Row.warm))
        workers = {
            way: Worker(ROOT if way.startswith("after") else old, name, "--warm", warm, *options)
            for way, options in WAYS.items()
            if name not in YARDSTICKS or way == "after"
        }
        found = {way: [] for way in workers}
        for _ in range(rounds):
            for way, worker in workers.items():
                found[way].append(worker.measure())
        for worker in workers.values():
            worker.close()
        print(row(name, found), flush=True)


def row(name: str, found: dict[str, list[dict[str, float]]]) -> str:
    """Return a line of the table."""

    def middle(way: str, what: str) -> float:
        return statistics.median(one[what] for one in found[way])

    speed = {way: found[way][0]["steps"] / middle(way, "seconds") for way in found}
    faults, peak = (
        " → ".join(f"{middle(way, what):,.0f}" for way in WAYS if way in found) for what in ("faults", "mebibytes")
    )
    if name in YARDSTICKS:
        return f"| {name} | | {speed['after']:,.0f} | | | | | {faults} | {peak} |"
    pairs = [
        f"{speed[before]:,.4g} | {speed[after]:,.4g} | {speed[after] / speed[before]:.2f}"
        for before, after in (("before", "after"), ("before kept", "after kept"))
    ]
    return f"| {name} | {' | '.join(pairs)} | {faults} | {peak} |"


if __name__ == "__main__":
    main()
