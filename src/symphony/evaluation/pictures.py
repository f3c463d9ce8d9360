"""Pictures of the very rollouts that were evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.render.plots import Clip, saved_clip
from symphony.render.style import ANIMATIONS, FORMATS, picture_path
from symphony.rollouts.unroll import Rollouts
from symphony.saved.folder import RolloutWriter
from symphony.saved.rollouts import SavedRollouts, saved_rollouts

PANELS = 6
"""Run segments in one picture."""
SHOWN = 8
"""Rollouts drawn per run segment."""


class RolloutKeeper:
    """Saves rollouts while they are evaluated (see the evaluator's ``observe``), but for segments that are there."""

    def __init__(self, writer: RolloutWriter) -> None:
        self.writer = writer

    def __call__(self, item: int, saved: SavedRollouts) -> None:
        """Save the rollouts of a run segment."""
        if not self.writer.has(saved.segment.segment_id):
            self.writer.add(saved)


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

    def __call__(self, item: int, saved: SavedRollouts) -> None:
        """Keep the rollouts of a run segment if they are wanted."""
        if item in self.items:
            title = f"{self.title}{saved.segment.segment_id}"
            self.clips.append(saved_clip(saved, self.rollouts, title))


def clip_of(
    segment: RunSegment,
    scenes: SceneBatch,
    rollouts: Rollouts,
    row: int = 0,
    count: int | None = None,
    title: str | None = None,
) -> Clip:
    """Rollouts [B, K, ...] of the run segment in row ``row`` of the scenes, to be drawn or animated."""
    return saved_clip(saved_rollouts(segment, scenes, rollouts, row), count, title)


def check_picture(path: Path) -> None:
    """Raise ConfigError if a file is no picture or animation by its name."""
    picture_path(path, (*FORMATS, *ANIMATIONS))
