"""Look at saved rollouts."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from symphony.cli.tables import short_name
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
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write: a page (.html), a picture (.png, .pdf or .svg), an animation (.gif) or a film (.mp4, which needs
    `pip install 'symphony-traffic[video]'`). By default view.html in the folder."""
    segments: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...")] = ()
    """Only these run segments, by their ids; of a picture by default the first few."""
    rollouts: int = 0
    """Of each segment in a picture or film, at most; 0: all in a picture, the first one in a film."""

    def __post_init__(self) -> None:
        if self.rollouts < 0:
            raise ConfigError(f"--rollouts must not be negative, is {self.rollouts}")

    def run(self) -> None:
        """Write the page, the picture or the film."""
        from rich.console import Console

        from symphony.files import lock_file
        from symphony.saved.folder import load_rollouts

        folder = load_rollouts(self.folder)
        out = self.folder / "view.html" if self.out is None else self.out
        with lock_file(out) if self.out is None else nullcontext():
            if out.suffix.lower() == ".html":
                write_view(folder, out, self.segments)
            else:
                self._draw(folder, out)
        Console().print(f"written: {out}", soft_wrap=True, markup=False)

    def _draw(self, folder: RolloutFolder, out: Path) -> None:
        from symphony.evaluation.pictures import saved_clip
        from symphony.render import animate_rollouts, plot_grid, plot_rollout
        from symphony.render.film import FILMS, write_film
        from symphony.render.style import ANIMATIONS, FORMATS, picture_path

        kind = picture_path(out, (*FORMATS, *ANIMATIONS, *FILMS)).suffix[1:].lower()
        moving = kind in (*ANIMATIONS, *FILMS)
        names = self.segments or tuple(folder.ids[:PANELS])
        if not names:
            raise ConfigError(f"{self.folder} holds no rollouts to draw")
        count, agent = self.rollouts or (1 if moving else None), title_of(folder.about.agent)
        clips = [saved_clip(folder.of(name), count, f"{agent}: {name}") for name in names]
        if kind in FILMS:
            write_film(clips, out)
        elif moving:
            animate_rollouts(clips, out)
        else:
            panels = [lambda axes, clip=clip: plot_rollout(target=axes, **vars(clip)) for clip in clips]
            plot_grid(panels, out)


def write_view(folder: RolloutFolder, out: Path, segments: tuple[str, ...] = ()) -> dict[str, Any]:
    """Write the page with what the report found marked in it; returns the report."""
    from symphony.evaluation.report import Report, add_segment
    from symphony.files import naming, write_file
    from symphony.render.viewer import view_page

    found = Report(folder.about.agent, "interactive")
    replays = []
    for name in segments or folder.ids:
        saved = folder.of(name)
        add_segment(found, saved)
        replays.append((saved, found.events[name]))
    page = view_page(folder.about.agent, replays, folder.about.settings)
    with naming(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    write_file(out, page)
    return found.totals()


def title_of(agent: str) -> str:
    """Who drove, without folders, to be put before the name of a segment."""
    return " among ".join(short_name(part) for part in agent.split(" among "))
