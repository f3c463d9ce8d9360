"""Judging the weights of a run while it trains, to choose among its checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from symphony.agents.agent import assemble
from symphony.agents.choice import Best
from symphony.agents.networks import Networks, dynamics_of
from symphony.config import EvaluateConfig, TrainConfig
from symphony.data.store import SegmentStore
from symphony.errors import DataError
from symphony.evaluation.evaluator import judge
from symphony.simulation.demonstrations import SceneDataset, spread

METRICS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")


class Validator:
    """Judges networks as the agent they make is judged by the evaluator, search included.

    Args:
        config: of the run, with a store to validate on.
        networks: judged as they are at each call.
        device: theirs.

    Attributes:
        best: the best judgement so far; to be set for a run that goes on.

    Raises:
        DataError: if the store can't be read, is empty, or a segment has too few agents.
    """

    def __init__(self, config: TrainConfig, networks: Networks, device: torch.device) -> None:
        settings = config.validation
        if settings.data is None:
            raise ValueError("no store to validate on")
        store = SegmentStore(settings.data)
        if len(store) == 0:
            raise DataError("the store holds no run segments", file=store.path)
        chosen = spread(len(store), settings.segments)
        self.dataset = SceneDataset(
            store,
            config.agent.interactive,
            dynamics_of(config),
            chosen,
            routes=config.hierarchical,
            duration=config.duration,
            keep=len(chosen),
        )
        # All scenes are prepared before the first update, so that one that can't be used is found then.
        for i in range(len(chosen)):
            self.dataset.scene(i)
        self.agent = assemble(str(config.out), config, networks)
        self.networks, self.device = networks, device
        self.how = EvaluateConfig(rollouts=settings.rollouts, device=str(device))
        self.best: Best | None = None

    def __call__(self, step: int, progress: Callable[[int, int], None] | None = None) -> dict[str, float]:
        """Judge the networks as they are after an update, and remember whether they are the best so far.

        They are the best if collision rate plus off-road time is lower than at any time before (paper, section V-B).
        The course of the training does not depend on whether it is validated.

        Args:
            step: updates made so far.
            progress: called with the segments done and their total.

        Returns:
            The numbers for the record, all beginning with ``validation_``.
        """
        with undisturbed(self.networks, self.device):
            found = judge(self.agent, self.dataset, self.how, progress).metrics.compute()
        infractions = found["collision_rate"] + found["offroad_time"]
        # Not a number, and so never the best, if nobody was simulated for a single step.
        if math.isfinite(infractions) and (self.best is None or infractions < self.best.infractions):
            self.best = Best(step, infractions)
        numbers = {f"validation_{name}": found[name] for name in METRICS}
        return {**numbers, "validation_infractions": infractions}


@contextmanager
def undisturbed(networks: Networks, device: torch.device) -> Iterator[None]:
    """Use networks on a device as they will be used after training, which goes on as if they had not been used."""
    modules = networks.present().values()
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
