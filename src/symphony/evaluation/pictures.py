"""Pictures of the very rollouts that were evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.evaluation.evaluator import EvaluatedBatch
from symphony.render.plots import Clip
from symphony.render.style import ANIMATIONS, FORMATS, picture_path
from symphony.rollouts.unroll import Rollouts
from symphony.saved.folder import RolloutWriter
from symphony.saved.rollouts import saved_rollouts

PANELS = 6
"""Run segments in one picture."""
SHOWN = 8
"""Rollouts drawn per run segment."""


class RolloutKeeper:
    """Saves rollouts while they are evaluated; see the evaluator's ``observe``.

    Args:
        writer: of the folder.
        driver: name of the agent.
        others: what drives background agents.
    """

    def __init__(self, writer: RolloutWriter, driver: str, others: str = "log") -> None:
        self.writer, self.driver, self.others = writer, driver, others

    def __call__(self, batch: EvaluatedBatch) -> None:
        """Save a batch, but for segments that are there already."""
        for row, segment in enumerate(batch.segments):
            if not self.writer.has(segment.segment_id):
                self.writer.add(
                    saved_rollouts(
                        segment,
                        batch.scenes,
                        batch.rollouts,
                        row,
                        goal=batch.goal,
                        driver=self.driver,
                        others=self.others,
                    )
                )


class ClipKeeper:
    """Keeps rollouts of some run segments while they are evaluated; see the evaluator's ``observe``.

    Args:
        items: numbers of the segments in their dataset.
        rollouts: of each, at most.
        title: before the name of the segment.

    Attributes:
        clips: what was kept so far.
    """

    def __init__(self, items: Sequence[int], rollouts: int = SHOWN, title: str = "") -> None:
        self.items, self.rollouts, self.title = set(items), rollouts, title
        self.clips: list[Clip] = []

    def __call__(self, batch: EvaluatedBatch) -> None:
        """Keep what is wanted of a batch."""
        for row, (item, segment) in enumerate(zip(batch.items, batch.segments, strict=True)):
            if item in self.items:
                title = f"{self.title}{segment.segment_id}"
                clip = clip_of(segment, batch.scenes, batch.rollouts, row, self.rollouts, title)
                self.clips.append(clip)


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


def check_picture(path: Path) -> None:
    """Raise ConfigError if a file is no picture or animation by its name."""
    picture_path(path, (*FORMATS, *ANIMATIONS))
