"""Rollouts as a film, where the encoder is installed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from symphony.errors import ConfigError
from symphony.files import replacing
from symphony.render.video import Clip, frames_of

FILMS = ("mp4",)
SMOOTH = 25
"""Frames a second that a player is sure to keep up with; slower clips repeat frames."""


def write_film(clips: Sequence[Clip], path: Path, *, columns: int = 3, size: float = 5.0) -> None:
    """What :func:`symphony.render.animate_rollouts` draws, as a film (H.264).

    Args:
        clips: rollouts of each segment.
        path: file to write (mp4).
        columns: panels per row, at most.
        size: inches a panel is wide, and high at most.

    Raises:
        ConfigError: the encoder is not installed.
        ValueError: as animate_rollouts.
    """
    try:
        import imageio_ffmpeg  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError("a film needs an encoder: pip install 'symphony-traffic[video]'") from error
    frames, interval = frames_of(clips, columns=columns, size=size)
    # The format wants even sides.
    height, width = (side - side % 2 for side in frames[0].shape[:2])
    repeat = max(1, round(SMOOTH * interval))
    with replacing(path) as draft:
        writer = imageio_ffmpeg.write_frames(
            str(draft), (width, height), fps=repeat / interval, macro_block_size=2
        )
        writer.send(None)
        for frame in frames:
            for _ in range(repeat):
                writer.send(np.ascontiguousarray(frame[:height, :width]))
        writer.close()
