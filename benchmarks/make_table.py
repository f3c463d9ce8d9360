"""The whole way to a table of the paper, in small: ``python benchmarks/make_table.py --out out/table``.

Runs the eight recipes on the run segments that come with the package and prints the table of their scores, in some
minutes. It shows that everything works; agents as small as these have hardly learned to drive. Every further argument
goes to every recipe, such as ``--steps 1000 --rollouts 16``.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from symphony.cli import main as symphony
from symphony.cli.recipe import main as recipe
from symphony.config import METHODS
from symphony.data.builtin import builtin_store
from symphony.recipes import recipe_of


def main(args: Sequence[str] | None = None) -> int:
    """Train and evaluate every method, then print the table; returns the exit status of ``symphony table``."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--out", type=Path, default=Path("out/table"), help="folder of the runs and the table")
    arguments, further = parser.parse_known_args(args)
    out: Path = arguments.out
    for method in METHODS:
        run = out / method
        if (run / "config.json").is_file():
            shutil.rmtree(run)
        given = {word.partition("=")[0] for word in further}
        places = {"--data": builtin_store("train"), "--test": builtin_store("test"), "--out": run}
        flags = {**places, "--profile": "tiny", "--rollouts": "4"}
        kept = [str(word) for flag, value in flags.items() if flag not in given for word in (flag, value)]
        recipe(recipe_of(method), None, [*kept, *further])
    table = ["table", "--setting", "main", "--runs", str(out)]
    return symphony([*table, "--out", str(out / "table.md")]) or symphony(table)


if __name__ == "__main__":
    raise SystemExit(main())
