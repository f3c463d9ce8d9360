"""What recipes do as scripts: train, evaluate beside the baselines, keep the numbers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.cli import guarded, settle
from symphony.cli.evaluate import evaluate_with_bar, print_evaluation
from symphony.cli.helps import PARAGRAPHS
from symphony.cli.profiles import WORDS, expanded
from symphony.config import EvaluateConfig, Profile, TrainConfig

if TYPE_CHECKING:
    from symphony.recipes import Recipe


@dataclass(frozen=True)
class Arguments:
    """Train on one store, evaluate on another beside log playback and constant velocity."""

    training: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """The training run."""
    test: Path
    """Store of run segments to evaluate it on."""
    rollouts: int = 16
    """Simulations per run segment."""
    profile: Annotated[Profile, tyro.conf.arg(help=WORDS)] = "default"


def main(recipe: Recipe, description: str | None, args: Sequence[str] | None = None) -> None:
    """Run a recipe with command-line arguments; by default with those of the process, which it ends."""
    if args is None:
        settle()
        sys.exit(guarded(lambda: main(recipe, description, sys.argv[1:])))
    from symphony.agents import load_agent
    from symphony.data.store import SegmentStore
    from symphony.evaluation.records import evaluation_record, keep_evaluation
    from symphony.recipes import train

    words = [recipe.__name__, *args]
    settings = tyro.cli(Arguments, description=description, args=expanded(words), registry=PARAGRAPHS)
    store = SegmentStore(settings.test)  # or complain now, not after the training
    folder = train(settings.training, recipe)
    config = EvaluateConfig(
        rollouts=settings.rollouts, seed=settings.training.seed, device=settings.training.device
    )
    agent = load_agent(str(folder), config.device, trust_code=True)  # the user's own words a moment ago
    found = evaluate_with_bar(agent, store, config, baselines=True)
    print_evaluation(found, settings.test)
    keep_evaluation(agent.name, evaluation_record(agent, found, store))
