"""Hooks of a run that do not change its course: validation, which chooses among checkpoints, and previews."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from symphony.agents.agent import Agent
from symphony.agents.choice import Best
from symphony.config import EvaluateConfig, RunConfig
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError
from symphony.evaluation.evaluator import evaluate
from symphony.files import naming
from symphony.learning.demonstrations import SceneDataset, evenly_spaced
from symphony.render import animate_rollouts
from symphony.render.plots import saved_clip
from symphony.rollouts.driving import simulate_batch
from symphony.rollouts.workers import segments_together, settled
from symphony.saved.rollouts import saved_rollouts
from symphony.training.logging import Tracker
from symphony.training.trainer import Trainer

METRICS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")
"""Metrics of a validation that are recorded."""
PANELS = 2  # run segments in the animation of a preview, evenly spaced, with a rollout each


def add_hooks(trainer: Trainer) -> None:
    """Give a trainer the hooks that its configuration asks for. Raises ConfigError for more rollouts than a tree has
    branches, DataError if the store to validate on can't be read, is empty, or has too few agents.
    """
    config, agent, device = trainer.config, trainer.agent, trainer.world.device
    shown = trainer.data
    if config.validation.data is not None:
        trainer.validator = validator = Validator(config, agent, device)
        shown = validator.dataset
    if 0 < config.preview.every <= config.steps:
        trainer.previewer = Previewer(config, agent, shown, device)


class Validator:
    """Evaluates an agent, whose networks are on a device, as it is at each call and as it will be used, with search.

    Attributes:
        best: the best so far; to be set for a run that goes on.
        what: the segments and the number of their rollouts, in words.
        dataset: these segments.
    """

    def __init__(self, run: RunConfig, agent: Agent, device: torch.device) -> None:
        config, branches = run.validation, agent.search.test_branches
        if agent.searches and config.rollouts > branches:
            most = f"search.test-branches ({branches}), the branches of one tree"
            raise ConfigError(f"validation.rollouts ({config.rollouts}) must not exceed {most}")
        store = SegmentStore(config.data or Path()).filled()
        chosen = evenly_spaced(len(store), config.segments)
        how: Any = {"routes": agent.goals is not None, "duration": agent.duration, "keep": len(chosen)}
        self.dataset = SceneDataset(store, agent.interactive, agent.dynamics, chosen, **how)
        # All scenes are prepared before the first update, so that one that can't be used is found then.
        for i in range(len(chosen)):
            self.dataset.scene(i)
        agent.check_step(self.dataset.dt)
        self.agent, self.device = agent, device
        on = EvaluateConfig(rollouts=config.rollouts, device=str(device), compile=run.compile)
        batches = -(-len(chosen) // segments_together(agent, on, agent.interactive))
        self.how = settled(on, self.dataset, batches * -(-run.steps // run.checkpoint_every))  # over all validations
        self.best: Best | None = None
        self.what = f"{len(chosen)} segments of {store.checksum()}, {config.rollouts} rollouts"

    def __call__(self, step: int, progress: Callable[[int, int], None] = lambda *_: None) -> dict[str, float]:
        """Return the numbers for the record after an update, all beginning with ``validation_``. The best agent is
        the one whose collision rate plus off-road time is lowest (paper, section V-C).
        """
        with undisturbed(self.agent, self.device):
            found = evaluate(self.agent, self.dataset, self.how, progress).metrics.compute()
        # Where no map has a boundary no agent can be off the road.
        off = found["offroad_time"] if found["offroad_segments"] else 0.0
        infractions = found["collision_rate"] + off
        # Not a number, and so never the best, if no agent was simulated for a single step.
        if math.isfinite(infractions) and (self.best is None or infractions < self.best.infractions):
            self.best = Best(step, infractions)
        numbers = {f"validation_{name}": found[name] for name in METRICS}
        return {**numbers, "validation_infractions": infractions}


@contextmanager
def undisturbed(agent: Agent, device: torch.device) -> Iterator[None]:
    """Use networks on a device as after training, which then continues as if they had not been used."""
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


class Previewer:
    """Simulates an agent as it will be used, on the same run segments each time, and shows it in folder ``media``."""

    def __init__(self, config: RunConfig, agent: Agent, dataset: SceneDataset, device: torch.device) -> None:
        self.items = evenly_spaced(len(dataset), PANELS)
        self.agent, self.dataset, self.device = agent, dataset, device
        # Before the first update, so that one that can't be used is found then.
        dataset.scenes(self.items)
        self.folder = config.out / "media"
        self.how = EvaluateConfig(rollouts=1, device=str(device))

    def __call__(self, step: int, tracker: Tracker | None = None) -> None:
        """Show the agent in folder and tracker. Raises DataError if the disk refuses."""
        segments, scenes = [self.dataset.segment(i) for i in self.items], self.dataset.scenes(self.items)
        with undisturbed(self.agent, self.device):
            rollouts = simulate_batch(self.agent, scenes.to(self.device), self.how).rollouts.cpu()
        video = self.folder / f"rollout-{step:06d}.gif"
        clips = [saved_clip(saved_rollouts(one, scenes, rollouts, b), 1) for b, one in enumerate(segments)]
        with naming(video):
            animate_rollouts(clips, video)
        if tracker is not None:
            tracker.preview(step, video)
