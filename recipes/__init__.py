"""One recipe for each row of the paper's tables: networks, environment, collector, losses, the order of updates.

A recipe is a function from a configuration to a trainer, meant to be read from top to bottom. Recipes repeat one
another on purpose; no other package knows the methods. In a checkout each file of ``recipes`` is also a script.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

from symphony.agents.agent import usable_device
from symphony.config.training import Method, TrainConfig
from symphony.training import Processes, Trainer
from symphony.training.processes import processes

__all__ = ["Recipe", "recipe_of", "train", "trainer_of"]

Recipe = Callable[[TrainConfig, Processes], Trainer]
"""A function that builds the trainer of a run."""


def recipe_of(method: Method) -> Recipe:
    """Return the recipe of a method: the function of its name, in the file of its name."""
    return getattr(importlib.import_module(f"symphony.recipes.{method}"), method)


def train(config: TrainConfig, recipe: Recipe | None = None) -> Path:
    """Train an agent; with ``torchrun`` by all its processes.

    Args:
        config: of the run.
        recipe: of the run; by default that of the configured method.

    Returns:
        The run's folder (see :meth:`symphony.training.Trainer.run`).

    Raises:
        ConfigError: if the folder holds another run, or settings can't be used.
        DataError: if a store can't be read or has nothing to learn from; TrainingError: if gradients stay not finite.
    """
    with processes(usable_device(config.device)) as world:
        return trainer_of(config, world, recipe).run()


def trainer_of(config: TrainConfig, world: Processes, recipe: Recipe | None = None) -> Trainer:
    """Return the trainer that a recipe builds, with the hooks that its configuration asks for."""
    trainer = (recipe or recipe_of(config.method))(config, world)
    if world.is_main and (config.validation.data is not None or 0 < config.preview.every <= config.steps):
        from symphony.training.hooks import add_hooks  # noqa: PLC0415 - loads what simulates, judges and draws

        add_hooks(trainer)
    return trainer
