"""Animated pictures and films of rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.offsetbox import AnchoredOffsetbox
from numpy.typing import NDArray
from PIL import Image

from symphony.errors import ConfigError
from symphony.files import replacing
from symphony.render import plots
from symphony.render.plots import Clip
from symphony.render.roads import CORNERS, draw_boxes, draw_roads, draw_signals, place
from symphony.render.style import (
    ANIMATIONS,
    FILMS,
    FORMATS,
    INK,
    add_caption,
    add_legend,
    frame,
    new_figure,
    picture_path,
    view_around,
    with_aspect,
)

SMOOTH = 25  # frames a second of a film that a player is sure to keep up with; slower clips repeat frames
FRAMES = 51  # frames of an animation, at most; steps are left out evenly where there are more
FILM = 5.0  # inches a panel of a film is wide
HEAD = 0.45  # inches for the title of a panel
COLORS = 255  # colours of an animation: one less than the format has, which then marks what stays as it was


def draw_clips(clips: Sequence[Clip], path: Path, columns: int = 3) -> None:
    """Draw, animate (to a .gif) or film (to a .mp4) rollouts beside the log, at most ``columns`` panels in a row.

    Raises a :class:`ConfigError` for a file of another kind, or where the encoder of films is not installed.
    """
    kind = picture_path(path, (*FORMATS, *ANIMATIONS, *FILMS)).suffix[1:].lower()
    if kind in FILMS:
        write_film(clips, path, columns)
    elif kind in ANIMATIONS:
        animate_rollouts(clips, path, columns=columns)
    else:
        plots.plot_grid([partial(plots.plot_rollout, clip) for clip in clips], path, columns=columns)


def write_film(clips: Sequence[Clip], path: Path, columns: int) -> None:
    """Write the animation of :func:`animate_rollouts` as a film (H.264)."""
    try:
        import imageio_ffmpeg  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError("a film needs an encoder: pip install 'symphony-traffic[video]'") from error
    frames, interval = frames_of(clips, columns=columns, size=FILM)
    # The format wants even sides.
    height, width = (side - side % 2 for side in frames[0].shape[:2])
    repeat = max(1, round(SMOOTH * interval))
    with replacing(path) as draft:
        writer = imageio_ffmpeg.write_frames(str(draft), (width, height), fps=repeat / interval, macro_block_size=2)
        writer.send(None)
        for frame in frames:
            for _ in range(repeat):
                writer.send(np.ascontiguousarray(frame[:height, :width]))
        writer.close()


def animate_rollouts(clips: Sequence[Clip], path: str | Path, *, columns: int = 3, size: float = 3.6) -> None:
    """Animate rollouts over the log, in real time: a panel for each run segment.

    Interactive agents are drawn where they are in every rollout, with the way they came; dashed is their way in the
    log, outlined where they were then. Playback agents and lights are shown as logged. The last frame is the last
    step; shorter segments end earlier and stay as they are. Where nothing moves all frames are the same. Panels are
    at most ``size`` inches wide and high, and ``columns`` in a row. A :class:`ConfigError` says if a file is no .gif.
    """
    file = picture_path(path, ANIMATIONS)
    frames, interval = frames_of(clips, columns=columns, size=size)
    _write(frames, file, interval)


def frames_of(clips: Sequence[Clip], *, columns: int = 3, size: float = 3.6) -> tuple[list[NDArray[np.uint8]], float]:
    """Return the frames [H, W, 3] of :func:`animate_rollouts`, and the seconds between two of them."""
    panels = [_Panel(clip) for clip in clips]
    figure = _lay_out(panels, min(columns, len(clips)), size)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # Lay out once: what moves must not move the rest.
    figure.set_layout_engine("none")
    still = canvas.copy_from_bbox(figure.bbox)
    hidden = [artist.get_window_extent().padded(1) for panel in panels for artist in panel.above()]
    above = [canvas.copy_from_bbox(box) for box in hidden]
    times, interval = _times(panels)
    frames = []
    for time in times:
        canvas.restore_region(still)
        for panel in panels:
            panel.draw(time)
        for part in above:
            canvas.restore_region(part)
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return frames, interval


class _Panel:
    """Rollouts of one segment on axes of their own, which hold only what never moves."""

    def __init__(self, clip: Clip) -> None:
        self.clip, self.segment, self.steps = clip, clip.segment, clip.heading.shape[2]
        self.view = clip.view or view_around(clip.points)

    @property
    def aspect(self) -> float:
        """The height of the view relative to its width."""
        return (self.view[3] - self.view[2]) / (self.view[1] - self.view[0])

    def settle(self, axes: Axes) -> None:
        """Draw what never moves."""
        self.axes, clip = axes, self.clip
        entries = draw_roads(axes, self.segment.road, self.view)
        line: dict[str, Any] = {"color": INK, "linestyle": plots.LOG_DASHES, "linewidth": 0.9}
        for agent, way in zip(clip.agents, clip.log, strict=True):
            axes.plot(*way.T, zorder=5, gid=f"log-{agent}", **line)
        # The blanks are room for the seconds.
        caption = f"{plots.describe(self.segment)}   ·   {clip.words()}"
        blanks = " " * (24 if self.segment.logged else 12)
        frame(axes, self.view, clip.title or self.segment.segment_id, caption + blanks)
        axes.set_anchor("N")
        self.still = set(axes.get_children())
        steps = range(clip.start, clip.start + self.steps)
        lit = {one.get_label(): one for step in steps for one in draw_signals(axes, self.segment, step, self.view)}
        marks = lit | {one.get_label(): one for one in self._draw_moving(self.steps - 1)}
        self._remove_moving()
        legend = [*plots.agent_entries(self.segment, clip.agents), Line2D([], [], label="log", **line)]
        add_legend(axes, [*legend, plots.playback_entry(), *marks.values(), *entries], clip.points)
        self.still = set(axes.get_children())

    def above(self) -> list[Artist]:
        """Return the artists that nothing that moves may hide."""
        return [artist for artist in self.still if isinstance(artist, Legend | AnchoredOffsetbox)]

    def draw(self, time: float) -> None:
        """Draw what moves as it is ``time`` seconds after the first step, and forget it."""
        self._draw_moving(min(round(time / self.segment.dt), self.steps - 1))
        for artist in sorted(self._moving(), key=Artist.get_zorder):
            self.axes.draw_artist(artist)
        self._remove_moving()

    def _draw_moving(self, at: int) -> list[Line2D]:
        """Add what moves, as it is at one of the steps; return legend entries for lights and events."""
        axes, segment, clip, step = self.axes, self.segment, self.clip, self.clip.start + at
        marks = draw_signals(axes, segment, step, self.view)
        plots.draw_playback(axes, segment, step, clip.others)
        for rank, (agent, color) in enumerate(zip(clip.agents, plots.colors_of(segment, clip.agents), strict=True)):
            plots.draw_ways(axes, clip, rank, color, width=1.4, until=at)
            here = clip.valid[:, rank, at]
            position, heading = clip.position[here, rank, at], clip.heading[here, rank, at]
            size = np.broadcast_to(segment.size[agent], (len(position), 3))
            draw_boxes(axes, position, heading, size, color, alpha=max(clip.alpha, 0.45), gid=f"box-{agent}")
        # The interactive agents are outlined where they were in the log.
        seen = clip.agents[segment.valid[clip.agents, step] & (step < segment.log_steps)]
        boxes = place(CORNERS, segment.position[seen, step], segment.heading[seen, step], segment.size[seen])
        style: dict[str, Any] = {"facecolors": "none", "edgecolors": INK, "linewidths": 0.7, "zorder": 11}
        axes.add_collection(PolyCollection(list(boxes), gid="log", **style), autolim=False)
        marks += filter(None, (plots.draw_events(axes, clip, *event, until=at) for event in plots.EVENTS))
        past = ", past the log" * (step >= segment.log_steps)
        add_caption(axes, f"{at * segment.dt:.1f} s{past}", right=True)
        return marks

    def _moving(self) -> list[Artist]:
        return [artist for artist in self.axes.get_children() if artist not in self.still]

    def _remove_moving(self) -> None:
        for artist in self._moving():
            artist.remove()


def _lay_out(panels: Sequence[_Panel], columns: int, size: float) -> Figure:
    """Return a figure with the panels laid out in it, all of one size unless someone chose their views."""
    aspect = min(1.0, max(panel.aspect for panel in panels))
    for panel in panels:
        if panel.clip.view is None:
            panel.view = with_aspect(panel.view, aspect)
    lines = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    heights = [size * min(1.0, max(panel.aspect for panel in line)) + HEAD for line in lines]
    figure = new_figure(size * columns, sum(heights))
    grid = figure.add_gridspec(len(lines), columns, height_ratios=heights)
    for row, line in enumerate(lines):
        for column, panel in enumerate(line):
            panel.settle(figure.add_subplot(grid[row, column]))
    return figure


def _times(panels: Sequence[_Panel]) -> tuple[NDArray[np.float64], float]:
    """Return seconds after the first step of each frame, the last step's among them, and between two frames."""
    dt = min(panel.segment.dt for panel in panels)
    count = 1 + round(max((panel.steps - 1) * panel.segment.dt for panel in panels) / dt)
    every = -(-count // FRAMES)
    return np.arange(count - 1, -1, -every)[::-1] * dt, every * dt


def _write(frames: Sequence[NDArray[np.uint8]], path: Path, interval: float) -> None:
    """Write frames [H, W, 3] that follow each other after ``interval`` seconds."""
    # One palette for all: with their own, frames would differ, and flicker, where nothing moves.
    palette = Image.fromarray(np.concatenate(frames)).quantize(COLORS, Image.Quantize.FASTOCTREE)
    images = [Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE) for pixels in frames]
    # The format counts in hundredths: rounded frame by frame, the error would grow.
    ends = np.rint(100 * interval * np.arange(len(images) + 1)).astype(int)
    more: dict[str, Any] = {"save_all": True, "append_images": images[1:], "loop": 0, "optimize": True}
    with replacing(path) as draft:
        images[0].save(draft, format="GIF", duration=(10 * np.diff(ends)).tolist(), **more)
