"""Measure two versions in turn on one machine, and print a table of ratios.

    python benchmarks/side_by_side.py --before 9eed275 [--rounds 5] [--only simulator ...]

Each figure is the median over rounds; a round is a process of its own, and versions alternate, so that whatever else
the machine does meets both. The version before is checked out beside this one by ``git worktree``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
YARDSTICKS = ("brute force", "matmul")


def run(root: Path, workload: str, *options: str) -> dict[str, float]:
    """One process of one version."""
    paths = os.pathsep.join([str(root / "src"), str(ROOT / "tests")])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    command = [sys.executable, str(ROOT / "benchmarks" / "workloads.py"), workload, *options]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True, cwd=root)  # noqa: S603
    return json.loads(done.stdout)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", required=True, help="a commit")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="+")
    arguments = parser.parse_args()
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from workloads import WORKLOADS  # noqa: PLC0415

    names = arguments.only or list(WORKLOADS)
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "before"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", str(old), arguments.before], check=True, capture_output=True)  # noqa: S603
        try:
            report(old, names, arguments.rounds)
        finally:
            subprocess.run([*git, "remove", "--force", str(old)], check=True, capture_output=True)  # noqa: S603


def report(old: Path, names: list[str], rounds: int) -> None:
    """Measure and print."""
    found: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for number in range(rounds):
        for name in names:
            found[name, "after"].append(run(ROOT, name))
            if name not in YARDSTICKS:
                found[name, "kept"].append(run(ROOT, name, "--keep-memory"))
                found[name, "before"].append(run(old, name))
        print(f"round {number + 1} of {rounds}", file=sys.stderr, flush=True)

    def middle(name: str, which: str, what: str) -> float:
        return statistics.median(one[what] for one in found[name, which])

    print(
        "| workload | agent-steps/s before | after | ratio | memory kept | ratio | page faults | peak MiB |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in names:
        steps = found[name, "after"][0]["steps"]
        after = steps / middle(name, "after", "seconds")
        if name in YARDSTICKS:
            print(f"| {name} | | {after:,.0f} | | | | {middle(name, 'after', 'faults'):,.0f} | |")
            continue
        before, kept = (steps / middle(name, which, "seconds") for which in ("before", "kept"))
        faults, peak = (
            " → ".join(f"{middle(name, which, what):,.0f}" for which in ("before", "after", "kept"))
            for what in ("faults", "mebibytes")
        )
        print(
            f"| {name} | {before:,.0f} | {after:,.0f} | {after / before:.2f} | {kept:,.0f} | {kept / before:.2f} "
            f"| {faults} | {peak} |"
        )


if __name__ == "__main__":
    main()
