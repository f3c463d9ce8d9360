"""Adversarial imitation through the model with goals: the row "MGAIL+H" of the paper's tables.

python recipes/mgail_h.py --data TRAIN --test TEST --out runs/mgail_h
"""

from __future__ import annotations

from symphony.cli.recipe import run


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    run("mgail_h", __doc__, args)


if __name__ == "__main__":
    main()
