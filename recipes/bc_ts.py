"""Behavioural cloning with tree search: the row "BC+TS" of the paper's tables.

python recipes/bc_ts.py --data TRAIN --test TEST --out runs/bc_ts
"""

from __future__ import annotations

from symphony.cli.recipe import run


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    run("bc_ts", __doc__, args)


if __name__ == "__main__":
    main()
