"""Behavioural cloning: the row "BC" of the paper's tables.

python recipes/bc.py --data TRAIN --test TEST --out runs/bc
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from symphony.cli.tables import print_metrics, write_json
from symphony.config import BCConfig, EvaluateConfig
from symphony.trainers import evaluate, train


@dataclass(frozen=True)
class Recipe:
    """Train on one store, judge on another beside log playback."""

    training: Annotated[BCConfig, tyro.conf.arg(name="")]
    """The training run."""
    test: Path
    """Store of run segments to judge it on."""
    rollouts: int = 16
    """Simulations per run segment."""


def main(args: list[str] | None = None) -> None:
    """Run the recipe."""
    recipe = tyro.cli(Recipe, description=__doc__, args=args)
    run = train(recipe.training)
    config = EvaluateConfig(
        rollouts=recipe.rollouts, seed=recipe.training.seed, device=recipe.training.device
    )
    judged = evaluate(str(run), recipe.test, config)
    log = evaluate("playback", recipe.test, replace(config, interactive=judged.interactive))
    rows = [log.numbers(), judged.numbers()]
    print_metrics(rows, title=str(recipe.test))
    write_json(run / "test.json", {"rows": rows, "per_segment": judged.metrics.rows()})


if __name__ == "__main__":
    main()
