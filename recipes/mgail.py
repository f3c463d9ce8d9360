"""Adversarial imitation through the model: the row "MGAIL" of the paper's tables.

python recipes/mgail.py --data TRAIN --test TEST --out runs/mgail
"""

from __future__ import annotations

from symphony.cli.recipe import run


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    run("mgail", __doc__, args)


if __name__ == "__main__":
    main()
