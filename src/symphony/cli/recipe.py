"""What recipes do as scripts: train, evaluate beside the baselines, keep the numbers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.cli import guarded, settle
from symphony.cli.shared import PARAGRAPHS, print_evaluation, progress
from symphony.config import EvaluateConfig, Profile, TrainConfig
from symphony.config.profiles import WORDS, expanded

if TYPE_CHECKING:
    from symphony.recipes import Recipe


@dataclass(frozen=True)
class Arguments:
    """Train on one store, evaluate on another beside log playback and constant velocity."""

    training: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """The training run."""
    test: Path
    """Store of run segments to evaluate the agent on."""
    rollouts: int = 16
    """Rollouts per run segment in the evaluation."""
    profile: Annotated[Profile, tyro.conf.arg(help=WORDS)] = "default"


def main(recipe: Recipe, description: str | None, args: Sequence[str] | None = None) -> None:
    """Run a recipe with command-line arguments; by default with those of the process, which it ends."""
    if args is None:
        settle()
        sys.exit(guarded(lambda: main(recipe, description, sys.argv[1:])))
    from symphony.agents import load_agent
    from symphony.data.store import SegmentStore
    from symphony.evaluation import evaluate
    from symphony.evaluation.records import evaluation_record, keep_evaluation
    from symphony.recipes import train

    words = expanded([recipe.__name__, *args])
    settings = tyro.cli(Arguments, description=description, args=words, registry=PARAGRAPHS)
    store = SegmentStore(settings.test)  # or complain now, not after the training
    training = settings.training
    folder = train(training, recipe)
    config = EvaluateConfig(rollouts=settings.rollouts, seed=training.seed, device=training.device)
    agent = load_agent(str(folder), config.device, trust_code=True)  # the user's own words a moment ago
    with progress(f"evaluating {agent.name}") as advance:
        found = evaluate(agent, store, config, advance, baselines=True)
    print_evaluation(found, settings.test)
    keep_evaluation(agent.name, evaluation_record(agent, found, store))
