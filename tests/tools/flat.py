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
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.append(str(Path(__file__).resolve().parents[1]))

from helpers_runs import build, tiny
from helpers_segments import straight_road
from symphony.config import METHODS, EvaluateConfig
from symphony.data.store_writer import StoreWriter
from symphony.evaluation import evaluate

MIB = 1 << 20
ROWS = 8


def main(args: list[str] | None = None) -> int:
    """Measure and report; status 1 if memory grew by a tenth, or files by one, in the second half."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--updates", type=int, default=2000)
    parser.add_argument("--segments", type=int, default=2000, help="to evaluate")
    parser.add_argument("--method", choices=METHODS, default="bc")
    parser.add_argument("--out", type=Path, default=Path("out/flat.json"), help="where the numbers are kept")
    given = parser.parse_args(args)
    with tempfile.TemporaryDirectory(prefix="symphony-flat-") as place:
        os.fsync = lambda descriptor: None  # nothing here is to last
        store = Path(place) / "store"
        with StoreWriter(store) as writer:
            for k in range(given.segments):
                writer.append(straight_road(2, seed=k, steps=6))
        every = max(given.updates // 8, 1)
        config = tiny(
            given.method,
            store,
            Path(place) / "run",
            steps=given.updates,
            checkpoint_every=every,
            log_every=20,
        )
        trainer = build(config)
        update = trainer._update
        updates, at_update = samples(given.updates)

        def counted(step: int) -> object:
            at_update(step + 1)
            return update(step)

        trainer._update = counted  # type: ignore[assignment,method-assign]
        trainer.run()
        segments, at_segment = samples(given.segments)
        how = EvaluateConfig(rollouts=2, search="none")
        evaluate(trainer.agent, store, how, lambda done, total: at_segment(done))
    given.out.parent.mkdir(parents=True, exist_ok=True)
    record = {"method": given.method, "updates": updates, "segments": segments}
    given.out.write_text(json.dumps(record) + "\n", encoding="utf-8")
    good = [report("updates", updates), report("segments", segments)]
    return 0 if all(good) else 1


def samples(total: int) -> tuple[list[tuple[int, int, int]], Callable[[int], None]]:
    """Rows (done, bytes, open files), about eight, and the function that adds them."""
    rows: list[tuple[int, int, int]] = []

    def take(done: int) -> None:
        if done * ROWS >= total * (len(rows) + 1):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            rows.append((done, pages * resource.getpagesize(), len(os.listdir("/proc/self/fd"))))

    return rows, take


def report(what: str, rows: list[tuple[int, int, int]]) -> bool:
    """Print the rows; whether the second half is flat."""
    print(f"{what:>10}{'MiB':>8}{'files':>7}")
    for done, used, files in rows:
        print(f"{done:10}{used / MIB:8.0f}{files:7}")
    middle, last = rows[len(rows) // 2], rows[-1]
    return last[1] < 1.1 * middle[1] and last[2] <= middle[2]


if __name__ == "__main__":
    raise SystemExit(main())
