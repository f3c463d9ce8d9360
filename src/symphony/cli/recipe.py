"""Recipes as scripts: train, evaluate beside the baselines, keep the numbers."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

import symphony
from symphony.cli import guarded, settle
from symphony.cli.agents import Evaluate, Train
from symphony.config.profiles import expanded


class Arguments(Train):
    """Train on one store, evaluate on another beside log playback and constant velocity."""

    test: Path  # Store of run segments to evaluate the agent on.
    rollouts: int = 16  # Rollouts per run segment in the evaluation.


def main(recipe: Any, description: str | None, args: Sequence[str] | None = None) -> None:
    """Run a recipe with command-line arguments; by default with those of the process, which it ends."""
    if args is None:
        settle()
        sys.exit(guarded(lambda: main(recipe, description, sys.argv[1:])))
    from symphony.recipes import train

    settings = tyro.cli(Arguments, description=description, args=expanded([recipe.__name__, *args]))
    symphony.SegmentStore(settings.test)  # fails now, not after the training
    training = settings.config
    how: Any = {"seed": training.seed, "device": training.device, "compile": training.compile}
    config = symphony.EvaluateConfig(rollouts=settings.rollouts, **how)
    folder = train(training, recipe)
    if os.environ.get("RANK", "0") == "0":  # of the processes that torchrun starts, one evaluates
        # Its folder names what the user typed a moment ago.
        Evaluate(agent=str(folder), data=settings.test, trust_code=True, config=config)()
