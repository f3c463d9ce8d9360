"""Kill generate, convert, train, evaluate and simulate at random moments, go on, and compare with undisturbed work.

What is left must be the same to the last bit, but for what is a matter of the clock. Linux only.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a child does not survive the fork of a process with more
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import kills_run
import kills_targets


def main(args: list[str] | None = None) -> int:
    """Run and report; status 1 if anything was lost, came twice, or differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=30, help="of each target")
    parser.add_argument("--targets", nargs="+", metavar="NAME", help="beginnings of names; all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/kills.json"), help="where the counts are kept")
    given = parser.parse_args(args)
    found = {}
    with tempfile.TemporaryDirectory(prefix="symphony-kills-") as place:
        for name, target in kills_targets.targets(Path(place)).items():
            if given.targets and not name.startswith(tuple(given.targets)):
                continue
            counts = kills_run.torment(target, Path(place) / name, given.kills, given.seed)
            found[name] = dataclasses.asdict(counts)
            print(
                f"{name:16}{counts.kills:4} kills{counts.finished:4} finished, {counts.seconds:.2f} s undisturbed"
            )
            for text in counts.failed:
                print(f"    {text}")
            given.out.parent.mkdir(parents=True, exist_ok=True)
            given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 1 if any(each["failed"] for each in found.values()) else 0


if __name__ == "__main__":
    raise SystemExit(main())
