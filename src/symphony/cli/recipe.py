"""What the recipes share: train one method, judge it beside log playback, write the numbers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from symphony.cli.tables import print_metrics, write_json
from symphony.config import EvaluateConfig, Method, TrainConfig


@dataclass(frozen=True)
class Recipe:
    """Train on one store, judge on another beside log playback."""

    training: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """The training run."""
    test: Path
    """Store of run segments to judge it on."""
    rollouts: int = 16
    """Simulations per run segment."""


def parse(method: Method, description: str | None, args: Sequence[str] | None = None) -> Recipe:
    """The recipe of one method from command-line arguments (those of the process by default)."""
    given = list(sys.argv[1:] if args is None else args)
    return tyro.cli(Recipe, description=description, args=[method, *given])


def judge(recipe: Recipe, run: Path) -> None:
    """Evaluate a trained run, print the table and write ``test.json`` into its folder."""
    from symphony.trainers import evaluate

    config = EvaluateConfig(
        rollouts=recipe.rollouts, seed=recipe.training.seed, device=recipe.training.device
    )
    judged = evaluate(str(run), recipe.test, config)
    log = evaluate("playback", recipe.test, replace(config, interactive=judged.interactive))
    rows = [log.numbers(), judged.numbers()]
    print_metrics(rows, title=str(recipe.test))
    write_json(run / "test.json", {"rows": rows, "per_segment": judged.metrics.rows()})
