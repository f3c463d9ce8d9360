"""Feed changed files to everything that reads files, and count what comes of it.

Each input gets 10 s and 1 GiB in a process of its own kind; the same seed gives the same inputs. What was done is
kept, so that the same command goes on until there are as many as are asked for. Linux only.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

# Pools that reserve address space for later would be taken for use of memory.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import fuzz_run
from fuzz_targets import TARGETS


def main(args: list[str] | None = None) -> int:
    """Run and report; status 1 if any input was not read as it should be."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=1000, help="per target, those of earlier runs included")
    parser.add_argument("--targets", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="to stop after, whatever is done")
    parser.add_argument("--state", type=Path, default=Path("out/fuzz.json"), help="where the counts are kept")
    parser.add_argument("--save", metavar="TARGET:NUMBER", help="only write this input's files to out/fuzz/")
    given = parser.parse_args(args)
    if given.save:
        return _save(given.save, given.seed)
    counts = fuzz_run.from_json(given.state.read_text()) if given.state.is_file() else {}
    given.state.parent.mkdir(parents=True, exist_ok=True)

    def keep() -> None:
        draft = given.state.with_suffix(".new")
        draft.write_text(fuzz_run.to_json(counts), encoding="utf-8")
        draft.replace(given.state)

    until = time.monotonic() + given.seconds
    while time.monotonic() < until:
        behind = [name for name in given.targets if counts.get(name, fuzz_run.Counts()).inputs < given.inputs]
        if not behind:
            break
        # In turns, so that a run that is stopped has looked at all of them.
        for name in behind:
            mine = counts.setdefault(name, fuzz_run.Counts())
            goal = min(given.inputs, mine.inputs + 5 * fuzz_run.BATCH)
            fuzz_run.fuzz(name, mine, goal, seed=given.seed, until=until, tell=keep)
    _report({name: counts[name] for name in given.targets if name in counts})
    return 1 if any(each.bad for each in counts.values()) else 0


def _save(which: str, seed: int) -> int:
    name, _, number = which.partition(":")
    folder = Path("out/fuzz") / f"{name}-{number}"
    for file, data in fuzz_run.inputs(name, seed, int(number)).items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    print(folder)
    return 0


def _report(counts: dict[str, fuzz_run.Counts]) -> None:
    print(f"{'target':14}{'inputs':>9}" + "".join(f"{name:>10}" for name in fuzz_run.OUTCOMES))
    for name, each in counts.items():
        print(f"{name:14}{each.inputs:9}" + "".join(f"{each.outcomes[key]:10}" for key in fuzz_run.OUTCOMES))
    for name, each in counts.items():
        for number, outcome, detail in each.found:
            print(f"{outcome}: {name}:{number}: {detail}")


if __name__ == "__main__":
    raise SystemExit(main())
