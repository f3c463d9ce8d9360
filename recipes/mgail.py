"""Adversarial imitation through the model: the row "MGAIL" of the paper's tables.

python recipes/mgail.py --data TRAIN --test TEST --out runs/mgail
"""

from __future__ import annotations

from symphony.cli.recipe import judge, parse
from symphony.training import train


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    recipe = parse("mgail", __doc__, args)
    judge(recipe, train(recipe.training))


if __name__ == "__main__":
    main()
