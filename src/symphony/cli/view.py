"""Look at saved rollouts."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from symphony.cli import shared
from symphony.config.checks import Natural
from symphony.errors import ConfigError
from symphony.files import lock_file, write_file

if TYPE_CHECKING:
    from symphony.evaluation.report import Report
    from symphony.saved.folder import RolloutFolder

PANELS = 6
"""Run segments in a picture or an animation, where none are named."""


class View(shared.Command):
    """Make a page that plays saved rollouts: it opens from disk in any browser, without a network.

    Play, scrub, zoom, follow, click an agent; collisions are marked and listed; where a search was kept, its branches
    with their scores and why they were pruned. With --out a picture or a film instead, by default of the first few
    run segments.
    """

    folder: shared.Saved
    #: File to write: a page (.html), a picture (.png, .pdf or .svg), an animation (.gif) or a film (.mp4, which
    #: needs `pip install 'symphony-traffic[video]'`). By default view.html in the folder.
    out: shared.ResultFile = None
    segments: shared.Segments = ()
    #: Rollouts of each run segment in a picture or film, at most; 0: all in a picture, the first one in a film.
    rollouts: Natural = 0

    def __call__(self) -> None:
        from symphony.evaluation.report import report
        from symphony.saved.folder import load_rollouts

        folder = load_rollouts(self.folder)
        if self.segments:
            folder = folder.only(folder.of(name).segment.segment_id for name in self.segments)
        out = self.folder / "view.html" if self.out is None else self.out
        with lock_file(out) if self.out is None else nullcontext():
            if out.suffix.lower() == ".html":
                write_view(folder, report(folder), out)
            else:
                self._draw(folder, out)
        shared.say(f"written: {out}")

    def _draw(self, folder: RolloutFolder, out: Path) -> None:
        from symphony.render import draw_clips, saved_clip
        from symphony.render.style import FORMATS

        names = self.segments or folder.ids[:PANELS]
        if not names:
            raise ConfigError(f"{self.folder} holds no rollouts to draw")
        count = self.rollouts or (None if out.suffix[1:].lower() in FORMATS else 1)
        agent = " among ".join(map(shared.short_name, folder.about.agent.split(" among ")))
        draw_clips([saved_clip(folder.of(name), count, f"{agent}: {name}") for name in names], out)


def write_view(folder: RolloutFolder, found: Report, out: Path) -> None:
    """Write the page that plays the rollouts of a folder, with what the report of them found marked in it."""
    from symphony.render.viewer import view_page

    replays = ((saved, found.events[saved.segment.segment_id]) for saved in folder)
    write_file(out, view_page(folder.about.agent, replays, folder.about.settings))
