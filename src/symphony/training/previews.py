"""Previews of a run while it trains: what its agent does, in an animation and as distributions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony import keys
from symphony.agents.agent import Agent
from symphony.config import EvaluateConfig, RunConfig
from symphony.envs.scene import SceneBatch
from symphony.evaluation.pictures import clip_of
from symphony.files import naming
from symphony.geometry.frames import wrap
from symphony.learning import SearchReplay
from symphony.learning.demonstrations import SceneDataset, evenly_spaced
from symphony.learning.logged import logged
from symphony.render import animate_rollouts
from symphony.rollouts.driving import simulated
from symphony.rollouts.unroll import Rollouts
from symphony.training.validation import undisturbed

PANELS = 2
"""Run segments in the animation, at most."""
SEGMENTS = 8
"""Run segments simulated for a preview, evenly spaced; the animation has the first two."""
ROLLOUTS = 2
"""Of each segment, at most; the animation has the first."""
QUANTILES = (10, 50, 90)
"""Percent."""

Samples = dict[str, NDArray[np.float64]]
"""Values [K] by what they are of; K may be 0."""


@dataclass(frozen=True)
class Preview:
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
        """Quantiles for the record, all beginning with ``preview_``; those of nothing are NaN."""
        found: dict[str, float] = {}
        for name, values in self.samples.items():
            levels = np.percentile(values, QUANTILES) if len(values) else [np.nan] * len(QUANTILES)
            found |= {f"preview_{name}_p{q}": float(x) for q, x in zip(QUANTILES, levels, strict=True)}
        return found


class Previewer:
    """Simulates an agent as it is meant to be simulated.

    Args:
        config: of the run.
        agent: shown as it is at each call.
        dataset: segments to choose from, evenly spaced: the same at each call.
        device: the networks'.
        replay: gives the states that the discriminator learns from.
    """

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

    def __call__(self, step: int) -> Preview:
        """Preview the agent as it is after an update; the course of the training does not depend on it.

        Args:
            step: updates made so far.

        Raises:
            DataError: if the disk refuses.
        """
        segments, scenes = [self.dataset.segment(i) for i in self.items], self.dataset.scenes(self.items)
        with undisturbed(self.agent, self.device):
            rollouts = simulated(self.agent, scenes.to(self.device), self.how).cpu()
            scores = self._scores(step)
        samples = samples_of(scenes, rollouts, [segment.dt for segment in segments])
        samples |= {f"score_{name}": _finite(values.cpu()) for name, values in scores.items()}
        video = self.folder / f"rollout-{step:06d}.gif"
        clips = [clip_of(segments[b], scenes, rollouts, b, 1) for b in range(min(PANELS, len(segments)))]
        with naming(video):
            animate_rollouts(clips, video)
        return Preview(video, samples)

    @torch.no_grad()
    def _scores(self, step: int) -> dict[str, Float[Tensor, " K"]]:
        """The discriminator's logits [K] of simulated and logged states; which, the number of the update says."""
        if self.agent.discriminator is None:
            return {}
        if self.replay is None or not self.replay.searched:
            return dict.fromkeys(("simulated", "data"), torch.zeros(0))
        batch = self.agent.discriminator(self.replay.both_kinds(torch.Generator().manual_seed(step)))
        score, valid, fake = (batch.get(key) for key in (keys.SCORE, keys.VALID, keys.SIMULATED))
        return {"simulated": score[valid & fake], "data": score[valid & ~fake]}


def samples_of(scenes: SceneBatch, rollouts: Rollouts, dt: Sequence[float]) -> Samples:
    """What interactive agents do in rollouts and in the log, and how far apart these are: see :class:`Preview`.

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


def _motion(
    state: Float[Tensor, "B K U N 4"], valid: Bool[Tensor, "B K T N"], dt: Float[Tensor, "B 1 1 1"]
) -> Samples:
    """Of the valid [B, K, T, N] steps to the later of states [B, K, T + 1, N, 4]."""
    change = state[:, :, 1:] - state[:, :, :-1]
    found = {
        "speed": state[:, :, 1:, :, 3],
        "acceleration": change[..., 3] / dt,
        "turn": wrap(change[..., 2]) / dt,
    }
    return {name: _finite(values[valid]) for name, values in found.items()}


def _finite(values: Float[Tensor, "*_"]) -> NDArray[np.float64]:
    return values[values.isfinite()].double().numpy()
