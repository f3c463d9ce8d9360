"""One recipe for each row of the paper's tables: networks, environment, collector, losses, the order of updates.

A recipe is a function from a configuration to a trainer that is ready to run, meant to be read from top to bottom.
They repeat one another on purpose; nothing below this package knows which methods there are.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from symphony.agents.agent import usable_device
from symphony.config import TrainConfig
from symphony.recipes.bc import bc
from symphony.recipes.bc_h import bc_h
from symphony.recipes.bc_ts import bc_ts
from symphony.recipes.bc_ts_h import bc_ts_h
from symphony.recipes.mgail import mgail
from symphony.recipes.mgail_h import mgail_h
from symphony.recipes.mgail_ts import mgail_ts
from symphony.recipes.mgail_ts_h import mgail_ts_h
from symphony.training import Processes, Trainer, processes

RECIPES: dict[str, Callable[[TrainConfig, Processes], Trainer]] = {
    "bc": bc,
    "bc_h": bc_h,
    "bc_ts": bc_ts,
    "bc_ts_h": bc_ts_h,
    "mgail": mgail,
    "mgail_h": mgail_h,
    "mgail_ts": mgail_ts,
    "mgail_ts_h": mgail_ts_h,
}
"""By the name of the method."""

__all__ = [
    "RECIPES",
    "bc",
    "bc_h",
    "bc_ts",
    "bc_ts_h",
    "mgail",
    "mgail_h",
    "mgail_ts",
    "mgail_ts_h",
    "train",
]


def train(config: TrainConfig) -> Path:
    """Train an agent by the recipe of its method; with ``torchrun`` by all its processes.

    Returns:
        The run's folder (see :meth:`symphony.training.Trainer.run`).

    Raises:
        ConfigError: if the folder holds another run, or settings can't be used.
        DataError: if a store can't be read or holds nothing to learn from, or the disk refuses.
        TrainingError: if gradients stay infinite or undefined.
    """
    with processes(usable_device(config.device)) as world:
        return RECIPES[config.method](config, world).run()
