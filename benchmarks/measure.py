"""Measure every row of the report and keep the results as JSON: ``make bench``, or

    python benchmarks/measure.py --out out/bench.json [--only "search*" ...] [--rounds 15]

Each row is a process of its own, forked from this one, with one thread. Its rounds are given in CPU time, so that
other programs on the machine count less, and a matrix product is timed before and after them: shares of its speed,
and of that of the brute force, are what can be compared between machines. ``tables.py`` makes the report of the file.
"""

from __future__ import annotations

import argparse
import fnmatch
import importlib
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial, reduce, wraps
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from symphony import __version__, allocator
from symphony.files import write_json
from symphony.modules import pool_elements
from workloads import WORKLOADS, Work, matmul, rings, search

SIMULATOR = {
    "symphony.envs:Bicycle.step": "dynamics",
    "symphony.envs.driving:collision_flags": "collisions",
    "symphony.envs.driving:offroad_flags": "road edge",
    "symphony.envs.observation:observe": "observation",
}
SEARCH = {
    "symphony.envs:DrivingEnv._step": "environment",
    "tensordict.nn:ProbabilisticTensorDictSequential.forward": "policy",
    "symphony.collectors:KeyScore.__call__": "discriminator",
}
UPDATE = SEARCH | {
    "symphony.learning:SceneDataset.sample_states": "logged states",
    "symphony.learning:SceneDataset.sample_goals": "logged goals",
    "symphony.learning:SearchReplay.survivors": "searched states",
    "symphony.learning:SearchReplay.both_kinds": "discriminator's states",
    "symphony.training:Trainer._descend": "backward and optimizer",
}
PREPARATION = {
    "symphony.learning.demonstrations:fit_experts": "experts",
    "symphony.learning.demonstrations:scene": "scenes and routes",
    "symphony.learning.demonstrations:LaneGraph": "lane graphs",
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """A measurement: the work and how it is measured.

    Args:
        work: makes a round of it.
        warm: rounds before the first that counts.
        rounds: that count, if no fewer are asked for.
        parts: functions whose share of the time is told, by their import paths; the rest is "the rest".
        unit: of what a round does many of.
        tuned: with the allocator as it comes, and as the ``symphony`` command sets it; else only the latter.
        counted: whether its operators are; what is compiled has none where it is, and runs as it was where they are.
        pooled: whether the operations are told, too, that it would take to encode and differentiate every element of
            a set instead of those that win a max-pool, with the same gradients.
    """

    work: Callable[[], Work]
    warm: int = 25
    rounds: int = 50
    parts: Mapping[str, str] = field(default_factory=dict)
    unit: str = "agent-steps"
    tuned: tuple[bool, ...] = (True,)
    counted: bool = True
    pooled: bool = False


BOTH = (False, True)
LONG = {"warm": 1, "rounds": 3}
HOW: dict[str, dict[str, Any]] = {
    "simulator": {"parts": SIMULATOR, "tuned": BOTH},
    "16 objects": {"parts": SIMULATOR, "tuned": BOTH},
    "16 objects, 200 points": {"parts": SIMULATOR, "tuned": BOTH},
    "16 objects, 1000 points": {"parts": SIMULATOR, "tuned": BOTH},
    "smallest step": {"parts": SIMULATOR},
    "smallest step, compiled": {"counted": False},
    "actions of two": {},
    "search 16 x 16 x 50": {"parts": SEARCH, "tuned": BOTH, **LONG},
    "bc update": {"parts": UPDATE, "unit": "updates", "tuned": BOTH, "pooled": True},
    "bc update, paper size": {"parts": UPDATE, "unit": "updates", "tuned": BOTH, "pooled": True, **LONG},
    "bc_ts_h update": {"parts": UPDATE, "unit": "updates", **LONG},
    "segment prepared": {"parts": PREPARATION, "unit": "segments", **LONG},
    "segment evaluated": {"parts": SEARCH, "unit": "segments", **LONG},
    "brute force": {},
    "matmul": {"unit": "operations", "warm": 2},
}
"""How the workloads are measured."""
CURVES: dict[str, dict[int, Row]] = {
    "scenes B": {n: Row(work=partial(rings, 16, 200, count=n)) for n in (1, 4, 16, 64)},
    "agents A": {n: Row(work=partial(rings, 16, 200, count=16, agents=n)) for n in (2, 8, 32, 128)},
    "points P": {n: Row(work=partial(rings, 16, n, count=16)) for n in (16, 64, 256, 1000)},
    "branches S": {
        n: Row(work=partial(search, branches=n, segments=4, steps=10), warm=1, rounds=3) for n in (1, 4, 16, 64)
    },
    "steps T": {
        n: Row(work=partial(search, branches=4, segments=4, steps=n), warm=1, rounds=3) for n in (10, 20, 50, 100)
    },
}
"""Steps of ring roads with 32 agents in 16 scenes, 16 objects and 200 points, and searches on 4 segments with 4
branches and 10 steps: where one number grows, the others stay."""

FIRST_STEP = """
import os
from symphony.cli import main
from symphony.data.builtin import builtin_store
from symphony.envs import DrivingEnv
DrivingEnv._step = lambda *_: os._exit(0)
main(["evaluate", "pretrained:bc_ts_h", "--data", str(builtin_store("test"))])
raise SystemExit("no step was made")
"""
START = {
    "torchrl imported": "import os, torchrl.envs, torchrl.collectors; os._exit(0)",
    "symphony.envs imported": "import os, symphony.envs; os._exit(0)",
    "first step of symphony evaluate": FIRST_STEP,
}
"""Programs whose CPU time is that of a start; they end without tidying up."""


def rows() -> dict[str, Row]:
    """Return all rows by name; those of curves are called after what grows, as in ``scenes B = 16``."""
    found = {name: Row(work=work, **HOW[name]) for name, work in WORKLOADS.items()}
    return found | {f"{name} = {n}": row for name, curve in CURVES.items() for n, row in curve.items()}


def located(path: str) -> tuple[Any, str]:
    """Return the module or class that ``module:name`` or ``module:Class.name`` lies in, and its name there."""
    module, _, names = path.partition(":")
    *owners, name = names.split(".")
    return reduce(getattr, owners, importlib.import_module(module)), name


class Parts:
    """Process time spent in some functions, without that of others of them that they call."""

    def __init__(self, paths: Mapping[str, str]) -> None:
        self.seconds: Counter[str] = Counter()
        self._open: list[float] = []
        for path, part in paths.items():
            owner, name = located(path)
            setattr(owner, name, self._timed(getattr(owner, name), part))

    def _timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        @wraps(function, updated=())
        def call(*args: Any, **kwargs: Any) -> Any:
            self._open.append(0.0)
            began = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                spent, inside = time.process_time() - began, self._open.pop()
                self.seconds[part] += spent - inside
                if self._open:
                    self._open[-1] += spent

        return call


class Calls(TorchDispatchMode):
    """Counts operators, and the floating-point operations of products of matrices among them."""

    def __init__(self) -> None:
        super().__init__()
        self.count, self.flops = 0, 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        found = func(*args, **(kwargs or {}))
        if func._overloadpacket in flop_registry:
            self.flops += flop_registry[func._overloadpacket](*args, **(kwargs or {}), out_val=found)
        return found


def densely(pool: Callable[..., Any], *sets: Any, mode: str = "") -> Any:
    """Pool with all elements encoded and differentiated, whatever the mode is."""
    return pool(*sets, mode="dense")


def timed(work: Callable[[], Any]) -> dict[str, float]:
    """Return CPU seconds and page faults of a round."""
    faults, began = resource.getrusage(resource.RUSAGE_SELF).ru_minflt, time.process_time()
    work()
    seconds = time.process_time() - began
    return {"seconds": seconds, "faults": resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults}


def measured(row: Row, rounds: int, *, tuned: bool) -> dict[str, Any]:
    """Return all of a row; what counts operators and times parts comes last, as it costs time itself."""
    if tuned:
        allocator.tune()
    product, operations = matmul()
    peak = [timed(product)["seconds"] for _ in range(3)][1:]
    work, units = row.work()
    prepared = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(row.warm):
        work()
    found = [timed(work) for _ in range(min(row.rounds, rounds))]
    top = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak += [timed(product)["seconds"] for _ in range(2)]
    with Calls() as calls:
        if row.counted:
            work()
    dense = Calls()
    if row.pooled:
        with dense, mock.patch("symphony.modules.encoder.pool_elements", partial(densely, pool_elements)):
            work()
    shares: dict[str, float] = {}
    if row.parts:
        parts = Parts(row.parts)
        total = sum(timed(work)["seconds"] for _ in range(1 + len(found) // 4))
        shares = {part: seconds / total for part, seconds in parts.seconds.most_common()}
        shares["the rest"] = 1 - sum(shares.values())
    seconds = sorted(one["seconds"] for one in found)
    return {
        "tuned": tuned,
        "units": units,
        "unit": row.unit,
        "seconds": statistics.median(seconds),
        "quartiles": [seconds[len(seconds) // 4], seconds[-1 - len(seconds) // 4]],
        "faults": statistics.median(one["faults"] for one in found),
        "mebibytes": (top - prepared) / 1024,
        "operators": calls.count,
        "flops": calls.flops,
        "dense": dense.flops,
        "matmul": operations / statistics.median(peak),
        "parts": shares,
    }


def start(program: str) -> float:
    """Return CPU seconds of a program in its own process; the better of two, of which the first finds cold files."""
    found = []
    for _ in range(2):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)  # noqa: S603 - ours
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(found)


def forked(function: Callable[[], Any]) -> Any:
    """Return what a function returns in a process of its own, as JSON has it."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(reading)
            with os.fdopen(writing, "w") as pipe:
                json.dump(function(), pipe)
            status = 0
        except BaseException:  # whatever it is, it must not go on as a second parent
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
        raise RuntimeError("a row failed, see above")
    return json.loads(text)


def machine() -> dict[str, Any]:
    """Describe the machine and the versions of the measurement."""
    info = Path("/proc/cpuinfo")
    models = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
    versions = {"symphony": __version__, "torch": torch.__version__, "python": platform.python_version()}
    return {"processor": models[0] if models else platform.machine(), "cores": os.cpu_count(), **versions}


@torch.no_grad()
def main() -> None:
    """Measure, showing each row as it is done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=["*"], metavar="PATTERN", help="names of rows")
    parser.add_argument("--rounds", type=int, default=15, help="at most; long rows have fewer")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # before the first fork, which other threads would not survive
    found: dict[str, list[dict[str, Any]]] = {}
    began = time.time()
    for name, row in rows().items():
        if not any(fnmatch.fnmatchcase(name, pattern) for pattern in arguments.only):
            continue
        for tuned in row.tuned:
            result = forked(partial(measured, row, arguments.rounds, tuned=tuned))
            found.setdefault(name, []).append(result)
            speed = result["units"] / result["seconds"]
            print(f"{name}{' (tuned)' * tuned}: {speed:,.4g} {row.unit}/s", flush=True)
    date = time.strftime("%Y-%m-%d", time.gmtime(began))
    starts = {name: start(program) for name, program in START.items()} if arguments.only == ["*"] else {}
    report = {
        "date": date,
        "minutes": (time.time() - began) / 60,
        "machine": machine(),
        "rows": found,
        "start": starts,
    }
    write_json(arguments.out, report)


if __name__ == "__main__":
    main()
