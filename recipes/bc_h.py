"""Behavioural cloning with goals: the row "BC+H" of the paper's tables.

python recipes/bc_h.py --data TRAIN --test TEST --out runs/bc_h
"""

from __future__ import annotations

from symphony.cli.recipe import run


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    run("bc_h", __doc__, args)


if __name__ == "__main__":
    main()
