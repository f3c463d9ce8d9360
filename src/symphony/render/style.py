"""Colours and the frame of a picture: figure, view, scale bar, saving."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray

from symphony.errors import ConfigError
from symphony.files import replacing

# From Okabe and Ito's and Tol's palettes: apart from each other, from playback and from the road for the
# common kinds of colour blindness too.
AGENT_COLORS = ("#0072B2", "#D55E00", "#009E73", "#882255", "#332288", "#D9C400", "#FF80FF", "#9ADE6B")
"""The ego's, which is its alone, then the interactive agents', which repeat after the last."""
PLAYBACK, INK, LAND, ROAD = "#A9AEB5", "#2B2F36", "#F3F1EC", "#FFFFFF"
BOUNDARY, LANE, MARK = "#6F6A62", "#C9CDD3", "#DAD6CE"
STOP, CAUTION, GO = "#B3122B", "#E69F00", "#009E73"

FORMATS, ANIMATIONS, FILMS = ("png", "pdf", "svg"), ("gif",), ("mp4",)

Corner = Literal["upper right", "upper left", "lower right"]
Target = str | Path | Axes
View = tuple[float, float, float, float]  # x from, x to, y from, y to, in metres


def agent_color(rank: int) -> str:
    """Return the colour of the agent of that rank among the highlighted ones (0: ego)."""
    return AGENT_COLORS[0 if rank == 0 else 1 + (rank - 1) % (len(AGENT_COLORS) - 1)]


def new_figure(width: float = 8.0, height: float = 8.0) -> Figure:
    """Return an empty figure (inches) that belongs to no window and no global state."""
    figure = Figure(figsize=(width, height), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_panels(count: int, columns: int, width: float, height: float, head: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels, each of the given width and height in inches, with room above them."""
    rows = -(-count // columns)
    figure = new_figure(width * columns, height * rows + head)
    grid = figure.add_gridspec(rows, columns)
    return figure, [figure.add_subplot(grid[k // columns, k % columns]) for k in range(count)]


def open_target(target: Target, view: View) -> tuple[Axes, Path | None]:
    """Return axes to draw on, and where to save them afterwards (None for axes given by the caller)."""
    if isinstance(target, Axes):
        return target, None
    path = picture_path(target)
    width, height = view[1] - view[0], view[3] - view[2]
    inches = 8.0 / max(width, height)
    # Room for the title above.
    return new_figure(width * inches, height * inches + 0.5).add_subplot(), path


def picture_path(path: str | Path, formats: Sequence[str] = FORMATS) -> Path:
    """Return the path if its suffix is that of a picture that can be written; raise a ConfigError otherwise."""
    path = Path(path)
    if path.suffix[1:].lower() not in formats:
        raise ConfigError(f"{path}: a picture's name must end in one of .{', .'.join(formats)}")
    return path


def save(figure: Any, path: Path) -> None:
    """Write a figure, creating the folder it goes into."""
    # Without the date, equal pictures are equal files.
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    with replacing(path) as draft, mpl.rc_context({"svg.hashsalt": "symphony"}):
        figure.savefig(draft, metadata=undated.get(path.suffix[1:].lower()))


def view_around(points: NDArray[Any], margin: float = 20.0, least: float = 70.0) -> View:
    """Return a rectangle around points [P, 2] with a margin, ``least`` metres long or more, 0.6 of that wide."""
    points = points[np.isfinite(points).all(-1)]
    if len(points) == 0:
        points = np.zeros((1, 2))
    low, high = points.min(0), points.max(0)
    x, y = (low + high).tolist()
    sides = high - low + 2 * margin
    longer = max(float(sides.max()), least)
    width, height = np.maximum(sides, 0.6 * longer).tolist() if longer > least else (least, least)
    return (x - width) / 2, (x + width) / 2, (y - height) / 2, (y + height) / 2


def with_aspect(view: View, aspect: float = 1.0) -> View:
    """Return the view, grown about its middle until its height is ``aspect`` times its width."""
    width, height = view[1] - view[0], view[3] - view[2]
    x, y = (view[0] + view[1]) / 2, (view[2] + view[3]) / 2
    width, height = max(width, height / aspect), max(height, width * aspect)
    return x - width / 2, x + width / 2, y - height / 2, y + height / 2


def frame(axes: Axes, view: View, title: str, subtitle: str) -> None:
    """Set equal aspect, limits, no ticks, title and scale bar."""
    axes.set_facecolor(LAND)
    axes.set_xlim(view[0], view[1])
    axes.set_ylim(view[2], view[3])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#C8C4BC")
    title_style: dict[str, Any] = {"fontweight": "bold", "color": INK, "parse_math": False}
    axes.set_title(title, loc="left", fontsize=font(axes, 11, title), pad=20, **title_style)
    add_caption(axes, subtitle)
    add_scale_bar(axes, view)


def add_caption(axes: Axes, text: str, *, right: bool = False) -> None:
    """Add a text between the picture and its title, at the left or the right end of the line."""
    place: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "parse_math": False}
    side = "right" if right else "left"
    caption = axes.annotate(
        text, (float(right), 1), (0, 6), ha=side, fontsize=font(axes, 8.5, text), color="#5B616B", **place
    )
    # The title's padding has made its room; its width must not squeeze the picture.
    caption.set_in_layout(False)


def _width(axes: Axes) -> float:
    """Return the width in inches of the axes' slot in the figure, before layout."""
    figure = axes.get_figure(root=True)
    return axes.get_position(original=True).width * figure.get_figwidth() if figure else 8.0


def font(axes: Axes, size: float, text: str = "") -> float:
    """Return a font size in points for these axes, smaller on narrow ones and such that the text fits."""
    room = 72 * _width(axes) / max(0.62 * len(text), 1)
    return max(3.0, min(size * float(np.clip(_width(axes) / 5, 0.6, 1)), room))


def add_scale_bar(axes: Axes, view: View) -> None:
    """Add a bar of a round length (1, 2 or 5 times a power of ten metres) in the lower left corner."""
    span = max(view[1] - view[0], view[3] - view[2])
    power = 10.0 ** math.floor(math.log10(span / 5))
    length = max(step * power for step in (1, 2, 5) if step * power <= span / 5)
    style: dict[str, Any] = {"pad": 0.4, "borderpad": 0.6, "sep": 4, "frameon": True, "color": INK}
    style |= {"size_vertical": span / 250, "fontproperties": FontProperties(size=font(axes, 8.5))}
    bar = AnchoredSizeBar(axes.transData, length, f"{length:g} m", "lower left", **style)
    bar.patch.set(alpha=0.85, edgecolor="none")
    bar.set_zorder(20)
    axes.add_artist(bar)


def add_legend(axes: Axes, handles: Sequence[Line2D | Any], points: NDArray[Any]) -> None:
    """Add a legend above everything drawn, in the corner that hides the fewest of the points [P, 2]."""
    place = free_corner(points, (*axes.get_xlim(), *axes.get_ylim()))
    style: dict[str, Any] = {"framealpha": 0.9, "edgecolor": "#C8C4BC", "handlelength": 1.8, "borderpad": 0.6}
    legend = axes.legend(handles=list(handles), loc=place, fontsize=font(axes, 8.5), **style)
    legend.set_zorder(20)


def free_corner(points: NDArray[Any], view: View) -> Corner:
    """Return the corner with the fewest points [P, 2], but for the one of the scale bar."""
    x = (points[:, 0] - view[0]) / (view[1] - view[0])
    y = (points[:, 1] - view[2]) / (view[3] - view[2])
    inside = (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1)
    right, upper = x > 0.6, y > 0.65
    corners: dict[Corner, NDArray[np.bool_]] = {
        "upper right": right & upper,
        "upper left": (x < 0.4) & upper,
        "lower right": right & (y < 0.35),
    }
    return min(corners, key=lambda name: int((corners[name] & inside).sum()))
