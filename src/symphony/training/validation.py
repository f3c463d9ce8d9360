"""Evaluating the weights of a run while it trains, to choose among its checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from symphony.agents.agent import Agent
from symphony.agents.choice import Best
from symphony.config import EvaluateConfig, ValidationConfig
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation.evaluator import evaluate_dataset
from symphony.learning.demonstrations import SceneDataset, evenly_spaced

METRICS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")


class Validator:
    """Evaluates an agent as it will be used, search included.

    Args:
        config: with a store to validate on.
        agent: evaluated as it is at each call.
        device: its networks'.

    Attributes:
        best: the best so far; to be set for a run that goes on.
        what: which segments of what data are simulated how often: scores of something else can't be compared.

    Raises:
        ConfigError: if more rollouts are asked for than a tree has branches.
        DataError: if the store can't be read, is empty, or a segment has too few agents.
    """

    def __init__(self, config: ValidationConfig, agent: Agent, device: torch.device) -> None:
        if config.data is None:
            raise ValueError("no store to validate on")
        if agent.searches and config.rollouts > agent.search.test_branches:
            raise ConfigError(
                f"validation.rollouts ({config.rollouts}) must not exceed search.test-branches "
                f"({agent.search.test_branches}), the branches of one tree"
            )
        store = SegmentStore(config.data)
        if len(store) == 0:
            raise DataError("the store holds no run segments", file=store.path)
        chosen = evenly_spaced(len(store), config.segments)
        self.dataset = SceneDataset(
            store,
            agent.interactive,
            agent.dynamics,
            chosen,
            routes=agent.goals is not None,
            duration=agent.duration,
            keep=len(chosen),
        )
        # All scenes are prepared before the first update, so that one that can't be used is found then.
        for i in range(len(chosen)):
            self.dataset.scene(i)
        agent.check_step(self.dataset.dt)
        self.agent, self.device = agent, device
        self.how = EvaluateConfig(rollouts=config.rollouts, device=str(device))
        self.best: Best | None = None
        self.what = f"{len(chosen)} segments of {store.checksum()}, {config.rollouts} rollouts"

    def __call__(self, step: int, progress: Callable[[int, int], None] | None = None) -> dict[str, float]:
        """Evaluate the agent as it is after an update, and remember whether it is the best so far.

        It is the best if collision rate plus off-road time is lower than at any time before (paper, section V-B).
        The course of the training does not depend on whether it is validated.

        Args:
            step: updates made so far.
            progress: called with the segments done and their total.

        Returns:
            The numbers for the record, all beginning with ``validation_``.
        """
        with undisturbed(self.agent, self.device):
            found = evaluate_dataset(self.agent, self.dataset, self.how, progress).metrics.compute()
        # Where no map has a boundary nobody can be off the road.
        off = found["offroad_time"] if found["offroad_segments"] else 0.0
        infractions = found["collision_rate"] + off
        # Not a number, and so never the best, if nobody was simulated for a single step.
        if math.isfinite(infractions) and (self.best is None or infractions < self.best.infractions):
            self.best = Best(step, infractions)
        numbers = {f"validation_{name}": found[name] for name in METRICS}
        return {**numbers, "validation_infractions": infractions}


@contextmanager
def undisturbed(agent: Agent, device: torch.device) -> Iterator[None]:
    """Use networks on a device as they will be used after training, which goes on as if they had not been used."""
    modules = agent.modules.values()
    modes = [module.training for module in modules]
    devices = [torch.cuda.current_device()] if device.type == "cuda" else []
    try:
        with torch.random.fork_rng(devices):
            for module in modules:
                module.eval()
            yield
    finally:
        for module, mode in zip(modules, modes, strict=True):
            module.train(mode)
