"""Feed changed files to everything that reads files, and count what comes of it.

Each input gets 10 s and 1 GiB in a process that other inputs share; the same seed gives the same inputs. What was
done is kept, so that the same command goes on until there are as many as are asked for. Linux only.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import gc
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

# Pools that reserve address space for later would be taken for use of memory.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.append(str(Path(__file__).resolve().parents[1]))

from fuzz_base import FOREIGN, Files, Target, every
from fuzz_targets import TARGETS
from kills import spent_alone as spent

SECONDS, MEMORY = 10, 1 << 30
"""What one input may take; CPU time, as the machine may be busy."""
WAIT = 20
"""So many times longer may an input take that does nothing, or is not let."""
BATCH = 500
"""Inputs per process."""
PLACE = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # noqa: S108 - memory, as millions of files come and go
OUTCOMES = ("accepted", "refused", "foreign", "hang", "memory", "crash", "absurd")
BAD = OUTCOMES[2:]
KEPT = 20
"""Findings of one kind that are described."""


@dataclass
class Counts:
    """What came of the inputs of a target so far.

    Attributes:
        inputs: how many; those up to this number.
        outcomes: how often each of :data:`OUTCOMES` was seen.
        found: number of the input and what was wrong, for some of the bad ones.
    """

    inputs: int = 0
    outcomes: dict[str, int] = field(default_factory=lambda: dict.fromkeys(OUTCOMES, 0))
    found: list[tuple[int, str, str]] = field(default_factory=list)

    def add(self, number: int, outcome: str, detail: str) -> None:
        """Count one."""
        self.inputs += 1
        self.outcomes[outcome] += 1
        if outcome in BAD and sum(kind == outcome for _, kind, _ in self.found) < KEPT:
            self.found.append((number, outcome, detail))

    @property
    def bad(self) -> int:
        """Inputs that were not read as they should be."""
        return sum(self.outcomes[name] for name in BAD)


def inputs(name: str, seed: int, number: int) -> Files:
    """The files of one input; the same ones whenever it is asked for."""
    target = TARGETS[name]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return target.mutate(rng, dict(target.good()))


def attempt(target: Target, files: Files, folder: Path) -> tuple[str, str]:
    """What a target makes of files, in this process."""
    for file, data in files.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            outcome, detail = target.run(folder, next(iter(files)))
    except MemoryError:
        return "memory", "MemoryError"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        outcome, detail = (
            FOREIGN,
            f"{type(error).__name__}: {str(error)[:150]} ({Path(where.filename).name}:{where.lineno})",
        )
    if "MemoryError" in detail or "alloc" in detail.lower():
        return "memory", detail
    return outcome, detail


def run(
    name: str,
    counts: Counts,
    total: int,
    *,
    seed: int = 0,
    until: float = np.inf,
    tell: Callable[[], None] | None = None,
) -> None:
    """Go on with a target until so many inputs are counted, or a moment of :func:`time.monotonic` has come."""
    with tempfile.TemporaryDirectory(dir=PLACE) as folder:  # here, lest each process import everything anew
        token = every.set(True)
        attempt(TARGETS[name], dict(TARGETS[name].good()), Path(folder))
        every.reset(token)
    gc.freeze()  # lest each process go through, and so copy, all that was there before it
    while counts.inputs < total and time.monotonic() < until:
        _batch(name, counts, min(total, counts.inputs + BATCH), seed, until)
        if tell is not None:
            tell()


def _batch(name: str, counts: Counts, stop: int, seed: int, until: float) -> None:
    """Inputs in one process; ends early after one that it did not survive."""
    folder = Path(tempfile.mkdtemp(prefix="symphony-fuzz-", dir=PLACE))
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        _work(name, range(counts.inputs, stop), seed, write, folder)
    os.close(write)
    try:
        with os.fdopen(read, "rb", buffering=0) as pipe:
            data, began, told = b"", time.monotonic(), spent(child)
            while counts.inputs < stop:
                ready, _, _ = select.select([pipe], [], [], SECONDS / 2)
                late = time.monotonic() - began > WAIT * SECONDS
                if not ready and not late and spent(child) - told < SECONDS:
                    continue
                chunk = pipe.read(1 << 16) if ready else b""
                if not chunk:
                    lost = ("crash", "the process ended") if ready else ("hang", f"more than {SECONDS} s")
                    counts.add(counts.inputs, *lost)
                    return
                *lines, data = (data + chunk).split(b"\n")
                began = time.monotonic()
                for line in lines:
                    outcome, detail, told = json.loads(line)
                    counts.add(counts.inputs, outcome, detail)
                if time.monotonic() > until:
                    return
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        shutil.rmtree(folder, ignore_errors=True)


def _work(name: str, numbers: range, seed: int, pipe: int, folder: Path) -> None:
    """In the process of its own: never returns."""
    try:
        faulthandler.disable()
        os.fsync = lambda _: None  # nothing here is to last
        tempfile.tempdir = str(folder)
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in numbers:
            place = folder / str(number)
            place.mkdir()
            result = attempt(TARGETS[name], inputs(name, seed, number), place)
            shutil.rmtree(place, ignore_errors=True)
            os.write(pipe, json.dumps((*result, time.process_time())).encode() + b"\n")
    finally:
        os._exit(0)


def to_json(counts: dict[str, Counts]) -> str:
    """Counts as text, to go on with later."""
    return json.dumps({name: asdict(each) for name, each in counts.items()}, indent=1) + "\n"


def from_json(text: str) -> dict[str, Counts]:
    """The reverse of :func:`to_json`."""
    return {name: Counts(**each) for name, each in json.loads(text).items()}


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
    counts = from_json(given.state.read_text()) if given.state.is_file() else {}
    given.state.parent.mkdir(parents=True, exist_ok=True)

    def keep() -> None:
        draft = given.state.with_suffix(".new")
        draft.write_text(to_json(counts), encoding="utf-8")
        draft.replace(given.state)

    until = time.monotonic() + given.seconds
    while time.monotonic() < until:
        behind = [name for name in given.targets if counts.get(name, Counts()).inputs < given.inputs]
        if not behind:
            break
        # In turns, so that a run that is stopped has looked at all of them.
        for name in behind:
            mine = counts.setdefault(name, Counts())
            goal = min(given.inputs, mine.inputs + 5 * BATCH)
            run(name, mine, goal, seed=given.seed, until=until, tell=keep)
    _report({name: counts[name] for name in given.targets if name in counts})
    return 1 if any(each.bad for each in counts.values()) else 0


def _save(which: str, seed: int) -> int:
    name, _, number = which.partition(":")
    folder = Path("out/fuzz") / f"{name}-{number}"
    for file, data in inputs(name, seed, int(number)).items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    print(folder)
    return 0


def _report(counts: dict[str, Counts]) -> None:
    print(f"{'target':14}{'inputs':>9}" + "".join(f"{name:>10}" for name in OUTCOMES))
    for name, each in counts.items():
        print(f"{name:14}{each.inputs:9}" + "".join(f"{each.outcomes[key]:10}" for key in OUTCOMES))
    for name, each in counts.items():
        for number, outcome, detail in each.found:
            print(f"{outcome}: {name}:{number}: {detail}")


if __name__ == "__main__":
    raise SystemExit(main())
