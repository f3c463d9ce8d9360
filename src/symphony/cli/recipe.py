"""What the recipes share: train one method, judge it beside log playback, keep the numbers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from symphony.cli.evaluate import judge as judge_agent
from symphony.cli.profiles import WORDS, Profile, expanded
from symphony.cli.tables import print_metrics
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
    profile: Annotated[Profile, tyro.conf.arg(help=WORDS)] = "default"


def parse(method: Method, description: str | None, args: Sequence[str] | None = None) -> Recipe:
    """The recipe of one method from command-line arguments (those of the process by default)."""
    given = list(sys.argv[1:] if args is None else args)
    return tyro.cli(Recipe, description=description, args=expanded([method, *given]))


def judge(recipe: Recipe, run: Path) -> None:
    """Evaluate a trained run, print its row and keep it where `symphony table` looks for it."""
    config = EvaluateConfig(
        rollouts=recipe.rollouts, seed=recipe.training.seed, device=recipe.training.device
    )
    found = judge_agent(str(run), recipe.test, config)
    print_metrics(found.rows, title=str(recipe.test))
    found.keep()
