"""Hooks of a run that do not change its course: validation, which chooses among checkpoints, and previews."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony import keys
from symphony.agents.agent import Agent
from symphony.agents.choice import Best
from symphony.config import EvaluateConfig, RunConfig
from symphony.data.store import SegmentStore
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.evaluation.evaluator import evaluate
from symphony.files import naming
from symphony.geometry.frames import wrap
from symphony.learning import SearchReplay
from symphony.learning.demonstrations import SceneDataset, evenly_spaced
from symphony.learning.experts import logged
from symphony.render import animate_rollouts
from symphony.render.plots import saved_clip
from symphony.rollouts.driving import simulate_batch
from symphony.rollouts.unroll import Rollouts
from symphony.rollouts.workers import segments_together, settled
from symphony.saved.rollouts import saved_rollouts
from symphony.training.logging import Tracker
from symphony.training.trainer import Trainer

METRICS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")
"""Metrics of a validation that are recorded."""
SEGMENTS, ROLLOUTS = 8, 2
"""Run segments simulated for a preview, evenly spaced, and rollouts of each, at most."""
PANELS = 2  # segments in its animation, the first ones, with their first rollouts
QUANTILES = (10, 50, 90)  # percent

Samples = dict[str, NDArray[np.float64]]
"""Values [K] by what they are of; K may be 0."""


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
        trainer.previewer = Previewer(config, agent, shown, device, trainer.replay)


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

    def __init__(
        self,
        config: RunConfig,
        agent: Agent,
        dataset: SceneDataset,
        device: torch.device,
        replay: SearchReplay | None = None,
    ) -> None:
        self.items = evenly_spaced(len(dataset), SEGMENTS)
        self.agent, self.dataset, self.device, self.replay = agent, dataset, device, replay
        # Before the first update, so that one that can't be used is found then.
        dataset.scenes(self.items)
        self.folder = config.out / "media"
        rollouts = min(ROLLOUTS, agent.search.test_branches) if agent.searches else ROLLOUTS
        self.how = EvaluateConfig(rollouts=rollouts, device=str(device))

    def __call__(self, step: int, tracker: Tracker | None = None) -> dict[str, float]:
        """Show the agent in folder and tracker; return :func:`quantiles`. Raises DataError if the disk refuses."""
        segments, scenes = [self.dataset.segment(i) for i in self.items], self.dataset.scenes(self.items)
        with undisturbed(self.agent, self.device):
            rollouts = simulate_batch(self.agent, scenes.to(self.device), self.how).rollouts.cpu()
            scores = self._scores(step)
        samples = samples_of(scenes, rollouts, [segment.dt for segment in segments])
        samples |= {f"score_{name}": _finite(values.cpu()) for name, values in scores.items()}
        video = self.folder / f"rollout-{step:06d}.gif"
        clips = [
            saved_clip(saved_rollouts(segments[b], scenes, rollouts, b), 1) for b in range(min(PANELS, len(segments)))
        ]
        with naming(video):
            animate_rollouts(clips, video)
        if tracker is not None:
            tracker.preview(step, samples, video)
        return quantiles(samples)

    @torch.no_grad()
    def _scores(self, step: int) -> dict[str, Float[Tensor, " K"]]:
        """Return the discriminator's logits [K] of simulated and logged states, drawn by the number of the update."""
        if self.agent.discriminator is None:
            return {}
        if self.replay is None or not self.replay.searched:
            return dict.fromkeys(("simulated", "data"), torch.zeros(0))
        batch = self.agent.discriminator(self.replay.both_kinds(torch.Generator().manual_seed(step)))
        score, valid, fake = (batch.get(key) for key in (keys.SCORE, keys.VALID, keys.SIMULATED))
        return {"simulated": score[valid & fake], "data": score[valid & ~fake]}


def quantiles(samples: Samples) -> dict[str, float]:
    """Return quantiles of samples for the record, all beginning with ``preview_``; NaN without samples."""
    found: dict[str, float] = {}
    for name, values in samples.items():
        levels = np.percentile(values, QUANTILES) if len(values) else [np.nan] * len(QUANTILES)
        found |= {f"preview_{name}_p{q}": float(x) for q, x in zip(QUANTILES, levels, strict=True)}
    return found


def samples_of(scenes: SceneBatch, rollouts: Rollouts, dt: Sequence[float]) -> Samples:
    """Return the motion of interactive agents in rollouts [B, K] of scenes with steps of dt seconds: ``speed`` (m/s),
    ``acceleration`` (m/s^2) and ``turn`` (rad/s) by step, and as logged (``speed_log`` etc.); ``ade`` (m) by segment.
    """
    log, seen = (part[:, None] for part in logged(scenes))
    step = log.new_tensor(dt)[:, None, None, None]
    samples = _motion(rollouts.state, rollouts.counted, step)
    between = seen[:, :, 1:] & seen[:, :, :-1]
    samples |= {f"{name}_log": values for name, values in _motion(log, between, step).items()}
    away = (rollouts.state[:, :, 1:, :, :2] - log[:, :, 1:, :, :2]).norm(dim=-1)
    both = rollouts.counted & seen[:, :, 1:]
    return samples | {"ade": _finite((away * both).sum((1, 2, 3)) / both.sum((1, 2, 3)))}


def _motion(
    state: Float[Tensor, "B K U N 4"], valid: Bool[Tensor, "B K T N"], dt: Float[Tensor, "B 1 1 1"]
) -> Samples:
    """Return the motion of the valid [B, K, T, N] steps to the later of states [B, K, T + 1, N, 4]."""
    change, speed = state[:, :, 1:] - state[:, :, :-1], state[:, :, 1:, :, 3]
    found = {"speed": speed, "acceleration": change[..., 3] / dt, "turn": wrap(change[..., 2]) / dt}
    return {name: _finite(values[valid]) for name, values in found.items()}


def _finite(values: Float[Tensor, "*_"]) -> NDArray[np.float64]:
    return values[values.isfinite()].double().numpy()
