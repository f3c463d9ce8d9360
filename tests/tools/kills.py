"""Kill generate, convert, train, evaluate and simulate at random moments, go on, and compare with undisturbed work.

What is left must be the same to the last bit, but for what is a matter of the clock. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a child does not survive the fork of a process with more
sys.path.append(str(Path(__file__).resolve().parents[1]))

from helpers_processes import fork

TICKS = os.sysconf("SC_CLK_TCK")
PATIENCE = 600
"""Seconds without progress after which a life is given up."""


class Target(NamedTuple):
    """Something that is killed: ``work`` begins, or goes on, in a folder, of which ``left`` gives files by name."""

    work: Callable[[Path], None]
    left: Callable[[Path], dict[str, bytes]]


@dataclass
class Counts:
    """How often work was killed, how often it came to its end, how it failed, and its CPU time undisturbed."""

    kills: int = 0
    finished: int = 0
    failed: list[str] = field(default_factory=list)
    seconds: float = 0.0


def torment(target: Target, folder: Path, kills: int, seed: int) -> Counts:
    """Kill work several times, each at a random moment of what it takes undisturbed, and compare what is left."""
    rng, counts = np.random.default_rng(seed), Counts()
    status, counts.seconds = live(target, folder / "whole")
    if status:
        counts.failed.append(f"undisturbed: status {status}")
        return counts
    whole, place = target.left(folder / "whole"), folder / "killed"
    while counts.kills < kills or place.exists():
        limit = float(rng.uniform(0, counts.seconds)) if counts.kills < kills else np.inf
        status, _ = live(target, place, limit)
        if status == -signal.SIGKILL:
            counts.kills += 1
            continue
        if status:
            counts.failed.append(f"after {counts.kills} kills: status {status}")
        else:
            counts.finished += 1
            other = target.left(place)
            names = sorted(whole.keys() | other.keys())
            counts.failed += [f"{name} differs" for name in names if whole.get(name) != other.get(name)]
        shutil.rmtree(place)
    return counts


def live(target: Target, place: Path, limit: float = np.inf) -> tuple[int, float]:
    """Work in a process until it ends or has taken so much CPU time; how it ended and the seconds it had."""

    def life() -> None:
        os.setpgid(0, 0)
        os.fsync = lambda descriptor: None  # the kernel outlives us
        target.work(place)

    child = fork(life)
    used, until = 0.0, time.monotonic() + PATIENCE
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        used = max(used, spent(child))
        if used >= limit or time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            break
        time.sleep(0.01)  # as often as the clock of processes moves on
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what it has started
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), used


def spent(group: int) -> float:
    """CPU seconds of the processes of a group, those that have ended included."""
    total = 0
    for place in Path("/proc").glob("[0-9]*"):
        try:
            fields = (place / "stat").read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields[2]) == group:
            total += sum(map(int, fields[11:15]))
    return total / TICKS


def main(args: list[str] | None = None) -> int:
    """Run and report; status 1 if anything was lost, came twice, or differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=30, help="of each target")
    parser.add_argument("--targets", nargs="+", metavar="NAME", help="beginnings of names; all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/kills.json"), help="where the counts are kept")
    given = parser.parse_args(args)
    import kills_targets

    found = {}
    given.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="symphony-kills-") as place:
        for name, target in kills_targets.targets(Path(place)).items():
            if given.targets and not name.startswith(tuple(given.targets)):
                continue
            found[name] = asdict(torment(target, Path(place) / name, given.kills, given.seed))
            print(name, found[name])
            given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 1 if any(each["failed"] for each in found.values()) else 0


if __name__ == "__main__":
    raise SystemExit(main())
