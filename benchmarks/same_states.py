"""Check that two versions simulate the same: searches on built-in segments, compared bit by bit.

    python benchmarks/same_states.py --before 9eed275

States, actions and flags must be equal; scores may differ by rounding.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))

from side_by_side import ROOT, checked_out, run
from workloads import search


def save(path: Path) -> None:
    """Simulate with the installed version, and save the result."""
    torch.set_num_threads(1)
    found = {}
    for points, features in ((128, "foresight"), (200, "clearance"), (1000, "paper")):
        with torch.no_grad():
            once, _ = search(points, features, branches=8, noise=True)
            result = once()
        for key, value in result.trajectories.items(True, True):
            found[f"{points} points, {features}: {key}"] = value
        found[f"{points} points, {features}: slots"] = result.slots
        found[f"{points} points, {features}: scores"] = result.scores
    torch.save(found, path)


def main() -> None:
    """Compare; the exit status is 1 where anything but a score differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", help="a commit")
    parser.add_argument("--save", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.save is not None:
        save(arguments.save)
        return
    if arguments.before is None:
        parser.error("the following arguments are required: --before")
    with tempfile.TemporaryDirectory() as folder, checked_out(arguments.before) as old:
        parts = []
        for name, root in (("before", old), ("after", ROOT)):
            path = Path(folder) / f"{name}.pt"
            run(root, "same_states.py", "--save", str(path))
            parts.append(torch.load(path))
    before, after = parts
    assert before.keys() == after.keys()
    differ = 0
    for name, value in before.items():
        same = torch.equal(value, after[name])
        differ += not same and not name.endswith("scores")
        away = (value.double() - after[name].double()).abs().max().item()
        print(f"{name}: {'the same bits' if same else f'differ by up to {away:.1e}'}")
    sys.exit(differ > 0)


if __name__ == "__main__":
    main()
