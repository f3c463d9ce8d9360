"""Feed changed files to everything that reads files, and count what comes of it.

Each input gets 10 s and 1 GiB in a process that other inputs share; the same seed gives the same inputs. What was
done is kept, so that the same command goes on until there are as many as are asked for. Linux only.
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
import zlib
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

# Pools that reserve address space for later would be taken for use of memory.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.append(str(Path(__file__).resolve().parents[1]))

from fuzz_mutations import FOREIGN, Files, Target
from fuzz_targets import TARGETS

SECONDS, WAIT, MEMORY = 10.0, 200.0, 1 << 30
"""What one input may take: of CPU time, as the machine may be busy; of the clock; bytes."""
BATCH = 500  # inputs per process
PLACE = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # noqa: S108 - memory, as millions of files come and go
BAD = ("foreign", "hang", "memory", "crash", "absurd")
KEPT = 20  # findings of one kind that are described


@dataclass
class Counts:
    """The outcomes of a target's inputs so far: how many, how often each outcome, and some of the bad ones."""

    inputs: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    found: list[list[str]] = field(default_factory=list)

    def add(self, outcome: str, detail: str) -> None:
        """Count one."""
        self.outcomes[outcome] += 1
        if outcome in BAD and self.outcomes[outcome] <= KEPT:
            self.found.append([outcome, str(self.inputs), detail])
        self.inputs += 1


def inputs(name: str, seed: int, number: int) -> Files:
    """The files of one input; the same ones whenever it is asked for."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return TARGETS[name].mutate(rng, dict(TARGETS[name].good()))


def write(files: Files, folder: Path) -> None:
    for file, data in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(data)


def attempt(target: Target, files: Files, folder: Path) -> tuple[str, str]:
    """Run a target on files, in this process."""
    write(files, folder)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            outcome, detail = target.run(folder, next(iter(files)))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        outcome, detail = FOREIGN, f"{type(error).__name__}: {str(error)[:150]} ({place})"
    return ("memory" if "MemoryError" in detail or "alloc" in detail.lower() else outcome), detail


def run(name: str, counts: Counts, total: int, seed: int = 0) -> None:
    """Go on with a target until the given number of inputs are counted."""
    with tempfile.TemporaryDirectory(dir=PLACE) as folder:  # here, lest each process import everything anew
        attempt(TARGETS[name], dict(TARGETS[name].good()), Path(folder))
    gc.freeze()  # lest each process go through, and so copy, all that was there before it
    while counts.inputs < total:
        stop = min(total, counts.inputs + BATCH)
        folder = tempfile.mkdtemp(prefix="symphony-fuzz-", dir=PLACE)
        read, pipe = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(read)
            _work(name, range(counts.inputs, stop), seed, pipe, Path(folder))
        os.close(pipe)
        with os.fdopen(read) as told:
            for line in told:
                counts.add(*json.loads(line))
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        shutil.rmtree(folder, ignore_errors=True)
        if counts.inputs < stop:  # after an input that the process did not survive
            late = -status in (signal.SIGPROF, signal.SIGALRM)
            counts.add("hang" if late else "crash", f"the process ended with {status}")


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
            signal.setitimer(signal.ITIMER_PROF, SECONDS)  # signals that nobody handles end the process
            signal.setitimer(signal.ITIMER_REAL, WAIT)
            result = attempt(TARGETS[name], inputs(name, seed, number), place)
            shutil.rmtree(place, ignore_errors=True)
            os.write(pipe, json.dumps(result).encode() + b"\n")
    finally:
        os._exit(0)


def main(args: list[str] | None = None) -> int:
    """Run and report; status 1 if any input was not read as it should be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=1000, help="per target, those of earlier runs included")
    parser.add_argument("--targets", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--state", type=Path, default=Path("out/fuzz.json"), help="where the counts are kept")
    parser.add_argument("--save", metavar="TARGET:NUMBER", help="only write this input's files to out/fuzz/")
    given = parser.parse_args(args)
    if given.save:
        name, _, number = given.save.partition(":")
        write(inputs(name, given.seed, int(number)), Path("out/fuzz") / given.save.replace(":", "-"))
        return 0
    counts = {name: Counts() for name in TARGETS}
    if given.state.is_file():
        for name, each in json.loads(given.state.read_text()).items():
            counts[name] = Counts(each["inputs"], Counter(each["outcomes"]), each["found"])
    given.state.parent.mkdir(parents=True, exist_ok=True)
    # In turns, so that a run that is stopped has looked at all of them.
    for goal in [*range(BATCH, given.inputs, BATCH), given.inputs]:
        for name in given.targets:
            run(name, counts[name], goal, given.seed)
            given.state.write_text(json.dumps({key: asdict(each) for key, each in counts.items()}, indent=1))
    for name in given.targets:
        print(f"{name:14}{counts[name].inputs:9}", dict(counts[name].outcomes))
        for outcome, number, detail in counts[name].found:
            print(f"{outcome}: {name}:{number}: {detail}")
    return int(any(counts[name].found for name in given.targets))


if __name__ == "__main__":
    raise SystemExit(main())
