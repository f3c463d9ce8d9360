"""Train and evaluate for long and tell whether memory and open files grow: a table of both on the way. Linux only.

The smallest networks and segments: what grows with the number of updates or segments grows here as well.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.append(str(Path(__file__).resolve().parents[1]))

from helpers_runs import build, tiny
from helpers_segments import straight_road
from helpers_store import fill
from symphony.config import METHODS, EvaluateConfig
from symphony.evaluation import evaluate

ROWS = 8


def main(args: list[str] | None = None) -> int:
    """Measure and report; status 1 if memory grew by a tenth, or files by one, in the second half."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--updates", type=int, default=2000)
    parser.add_argument("--segments", type=int, default=2000, help="to evaluate")
    parser.add_argument("--method", choices=METHODS, default="bc")
    parser.add_argument("--out", type=Path, default=Path("out/flat.json"), help="where the numbers are kept")
    given = parser.parse_args(args)
    rows: dict[str, list[tuple[int, int, int]]] = {"updates": [], "segments": []}

    def take(what: str, done: int, total: int) -> None:
        if done * ROWS >= total * (len(rows[what]) + 1):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            used = pages * resource.getpagesize() >> 20
            rows[what].append((done, used, len(os.listdir("/proc/self/fd"))))

    with tempfile.TemporaryDirectory(prefix="symphony-flat-") as place:
        os.fsync = lambda descriptor: None  # nothing here is to last
        store, run = Path(place) / "store", Path(place) / "run"
        found = fill(store, [straight_road(2, seed=k, steps=6) for k in range(given.segments)])
        every = max(given.updates // 8, 1)
        config = tiny(given.method, store, run, steps=given.updates, checkpoint_every=every, log_every=20)
        trainer = build(config)
        update = trainer._update

        def counted(step: int) -> Any:
            take("updates", step + 1, given.updates)
            return update(step)

        trainer._update = counted  # type: ignore[method-assign]
        trainer.run()
        how = EvaluateConfig(rollouts=2, search="none")
        evaluate(trainer.agent, found, how, lambda done, total: take("segments", done, total))
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps({"method": given.method, **rows}) + "\n", encoding="utf-8")
    grew = False
    for what, taken in rows.items():
        print(f"{what:>10}     MiB  files", *("{:10}{:8}{:7}".format(*row) for row in taken), sep="\n")
        (_, middle, files), (_, last, most) = taken[len(taken) // 2], taken[-1]
        grew |= last >= 1.1 * middle or most > files
    return int(grew)


if __name__ == "__main__":
    raise SystemExit(main())
