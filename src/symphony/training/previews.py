"""Looking at a run while it trains: what its agent does, in an animation and as distributions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from symphony.agents.agent import assemble
from symphony.config import EvaluateConfig, TrainConfig
from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.evaluation.evaluator import simulated
from symphony.files import naming
from symphony.geometry.frames import wrap
from symphony.render import Clip, animate_rollouts
from symphony.simulation.demonstrations import SceneDataset, logged, spread
from symphony.simulation.rollouts import Rollouts
from symphony.training.learner import Learner
from symphony.training.validation import undisturbed

PANELS = 2
"""Run segments in the animation, at most."""
ROLLOUTS = 2
"""Of each segment, at most; the animation has the first."""
QUANTILES = (10, 50, 90)
"""Percent."""

Samples = dict[str, NDArray[np.float64]]
"""Values [K] by what they are of; K may be 0."""


@dataclass(frozen=True)
class Shown:
    """What there is to see after an update.

    Attributes:
        video: the animation.
        samples: ``speed`` (m/s), ``acceleration`` (m/s^2) and ``turn`` (rad/s) of the interactive agents at every
            step, simulated and, in ``speed_log`` etc., logged; ``ade`` (m) of every segment; where there is a
            discriminator, its logits ``score_simulated`` and ``score_data`` of states it learns from.
    """

    video: Path
    samples: Samples

    def numbers(self) -> dict[str, float]:
        """Quantiles for the record, all beginning with ``show_``; those of nothing are NaN."""
        found: dict[str, float] = {}
        for name, values in self.samples.items():
            levels = np.percentile(values, QUANTILES) if len(values) else [np.nan] * len(QUANTILES)
            found |= {f"show_{name}_p{q}": float(x) for q, x in zip(QUANTILES, levels, strict=True)}
        return found


class Show:
    """Simulates the agent that a learner's networks make, as it is meant to be simulated.

    Args:
        config: of the run.
        learner: shown as it is at each call.
        dataset: segments to choose from, evenly spaced: the same at each call.
    """

    def __init__(self, config: TrainConfig, learner: Learner, dataset: SceneDataset) -> None:
        self.items = spread(len(dataset), config.show.segments)
        self.learner, self.dataset = learner, dataset
        # Before the first update, so that one that can't be used is found then.
        dataset.scenes(self.items)
        self.folder = config.out / "media"
        self.agent = assemble(str(config.out), config, learner.networks)
        rollouts = min(ROLLOUTS, config.search.test_branches) if config.searches else ROLLOUTS
        self.how = EvaluateConfig(rollouts=rollouts, device=str(learner.device))

    def __call__(self, step: int) -> Shown:
        """Show the agent as it is after an update; the course of the training does not depend on it.

        Args:
            step: updates made so far.

        Raises:
            DataError: if the disk refuses.
        """
        device = self.learner.device
        segments, scenes = [self.dataset.segment(i) for i in self.items], self.dataset.scenes(self.items)
        with undisturbed(self.learner.networks, device):
            rollouts = simulated(self.agent, scenes.to(device), self.how).cpu()
            scores = self.learner.scores(step)
        samples = samples_of(scenes, rollouts, [segment.dt for segment in segments])
        samples |= {f"score_{name}": _finite(values.cpu()) for name, values in scores.items()}
        video = self.folder / f"rollout-{step:06d}.gif"
        clips = [clip_of(segments[b], scenes, rollouts, b, 1) for b in range(min(PANELS, len(segments)))]
        with naming(video):
            animate_rollouts(clips, video)
        return Shown(video, samples)


def clip_of(
    segment: RunSegment,
    scenes: SceneBatch,
    rollouts: Rollouts,
    row: int = 0,
    count: int | None = None,
    title: str | None = None,
) -> Clip:
    """Rollouts of one run segment, to be drawn or animated.

    Args:
        segment: in row ``row`` of the scenes.
        scenes: that were simulated, on the CPU.
        rollouts: [B, K, ...] of them, on the CPU.
        row: of the batch.
        count: how many of the K; all by default.
        title: of the picture; by default the segment's id.
    """
    # Past the segment's end there is only the padding of its batch.
    steps = segment.num_steps - 1
    state = rollouts.state[row, :count, 1 : steps + 1].transpose(1, 2).numpy()
    counted, collision, offroad = (
        part[row, :count, :steps].transpose(1, 2).numpy()
        for part in (rollouts.counted, rollouts.collision, rollouts.offroad)
    )
    agents = torch.where(scenes.interactive_valid[row], scenes.interactive[row], -1).numpy()
    return Clip(segment, state[..., :2], state[..., 2], agents, 1, counted, collision, offroad, title=title)


def samples_of(scenes: SceneBatch, rollouts: Rollouts, dt: Sequence[float]) -> Samples:
    """What interactive agents do in rollouts and in the log, and how far apart these are: see :class:`Shown`.

    Args:
        scenes: B scenes.
        rollouts: [B, K, ...] of them.
        dt: [B] seconds per step.
    """
    log, seen = logged(scenes)
    log, seen = log[:, None], seen[:, None]
    step = log.new_tensor(dt)[:, None, None, None]
    samples = _motion(rollouts.state, rollouts.counted, step)
    between = seen[:, :, 1:] & seen[:, :, :-1]
    samples |= {f"{name}_log": values for name, values in _motion(log, between, step).items()}
    away = (rollouts.state[:, :, 1:, :, :2] - log[:, :, 1:, :, :2]).norm(dim=-1)
    both = rollouts.counted & seen[:, :, 1:]
    return samples | {"ade": _finite((away * both).sum((1, 2, 3)) / both.sum((1, 2, 3)))}


def _motion(state: Tensor, valid: Tensor, dt: Tensor) -> Samples:
    """Of the valid [B, K, T, N] steps to the later of states [B, K, T + 1, N, 4]."""
    change = state[:, :, 1:] - state[:, :, :-1]
    found = {
        "speed": state[:, :, 1:, :, 3],
        "acceleration": change[..., 3] / dt,
        "turn": wrap(change[..., 2]) / dt,
    }
    return {name: _finite(values[valid]) for name, values in found.items()}


def _finite(values: Tensor) -> NDArray[np.float64]:
    return values[values.isfinite()].double().numpy()
