"""Behavioural cloning: the row "BC" of the paper's tables.

python recipes/bc.py --data TRAIN --test TEST --out runs/bc
"""

from __future__ import annotations

from symphony.cli.recipe import run


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    run("bc", __doc__, args)


if __name__ == "__main__":
    main()
