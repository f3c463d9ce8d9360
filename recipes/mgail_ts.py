"""Adversarial imitation through the model with tree search: the row "MGAIL+TS" of the paper's tables.

python recipes/mgail_ts.py --data TRAIN --test TEST --out runs/mgail_ts
"""

from __future__ import annotations

from symphony.cli.recipe import run


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    run("mgail_ts", __doc__, args)


if __name__ == "__main__":
    main()
