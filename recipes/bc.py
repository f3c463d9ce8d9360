"""Behavioural cloning: the row "BC" of the paper's tables.

python recipes/bc.py --data TRAIN --test TEST --out runs/bc
"""

from __future__ import annotations

from symphony.cli.recipe import judge, parse
from symphony.training import train


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    recipe = parse("bc", __doc__, args)
    judge(recipe, train(recipe.training))


if __name__ == "__main__":
    main()
