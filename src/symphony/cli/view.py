"""Look at saved rollouts."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.cli.shared import Names, ResultFile, at_least, say, short_name
from symphony.errors import ConfigError

if TYPE_CHECKING:
    from symphony.saved.folder import RolloutFolder

PANELS = 6
"""Run segments in a picture or an animation, where none are named."""


@dataclass(frozen=True)
class View:
    """Make a page that plays saved rollouts: it opens from disk in any browser, without a network.

    Play, scrub, zoom, follow, click an agent; collisions are marked and listed; where a search was kept, its branches
    with their scores and why they were pruned. With --out a picture or a film instead.
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SIM")]
    """Folder of saved rollouts."""
    out: ResultFile = None
    """File to write: a page (.html), a picture (.png, .pdf or .svg), an animation (.gif) or a film (.mp4, which needs
    `pip install 'symphony-traffic[video]'`). By default view.html in the folder."""
    segments: Names = ()
    """Ids of the run segments to show; by default all, in a picture the first few."""
    rollouts: int = 0
    """Rollouts of each run segment in a picture or film, at most; 0: all in a picture, the first one in a film."""

    def __post_init__(self) -> None:
        at_least(0, rollouts=self.rollouts)

    def run(self) -> None:
        """Write the page, the picture or the film."""
        from symphony.files import lock_file
        from symphony.saved.folder import load_rollouts

        folder = load_rollouts(self.folder)
        out = self.folder / "view.html" if self.out is None else self.out
        with lock_file(out) if self.out is None else nullcontext():
            if out.suffix.lower() == ".html":
                write_view(folder, out, self.segments)
            else:
                self._draw(folder, out)
        say(f"written: {out}")

    def _draw(self, folder: RolloutFolder, out: Path) -> None:
        from symphony.render.plots import saved_clip
        from symphony.render.style import ANIMATIONS, FILMS, FORMATS, picture_path
        from symphony.render.video import draw_clips

        kind = picture_path(out, (*FORMATS, *ANIMATIONS, *FILMS)).suffix[1:].lower()
        names = self.segments or tuple(folder.ids[:PANELS])
        if not names:
            raise ConfigError(f"{self.folder} holds no rollouts to draw")
        count = self.rollouts or (None if kind in FORMATS else 1)
        agent = " among ".join(short_name(part) for part in folder.about.agent.split(" among "))
        draw_clips([saved_clip(folder.of(name), count, f"{agent}: {name}") for name in names], out)


def write_view(folder: RolloutFolder, out: Path, segments: tuple[str, ...] = ()) -> None:
    """Write the page with what the report found marked in it."""
    from symphony.evaluation.report import Report, add_segment
    from symphony.files import write_file
    from symphony.render.viewer import view_page

    found = Report(folder.about.agent, "interactive")
    replays = []
    for name in segments or folder.ids:
        saved = folder.of(name)
        add_segment(found, saved)
        replays.append((saved, found.events[name]))
    write_file(out, view_page(folder.about.agent, replays, folder.about.settings))
