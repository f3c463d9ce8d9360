"""Pictures of rollouts: who was hit and where, how many rollouts differ, panels of one size."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_segments import straight_road
from symphony.data.segment import RunSegment
from symphony.render import Clip, plot_grid, plot_rollout, viewer
from symphony.render.plots import colors_of
from symphony.render.style import AGENT_COLORS, new_figure, with_aspect
from symphony.render.video import frames_of

STEPS = 12


def segment(seed: int = 0) -> RunSegment:
    return straight_road(4, seed=seed, steps=STEPS)


def rollouts(found: RunSegment, count: int = 1) -> dict[str, Any]:
    """The ego as logged, in so many rollouts, from the first step on."""
    ego = found.ego
    return {
        "position": np.repeat(found.position[None, [ego], :, :2], count, 0),
        "heading": np.repeat(found.heading[None, [ego]], count, 0),
        "agents": [ego],
    }


def patches(axes: Any, gid: str) -> list[np.ndarray[Any, Any]]:
    return [path.vertices for part in axes.collections if part.get_gid() == gid for path in part.get_paths()]


def test_playback_vehicles_are_drawn_where_they_were_hit() -> None:
    found, at = segment(), 4
    other = next(agent for agent in range(found.num_agents) if agent != found.ego)
    given = rollouts(found)
    given["position"] = given["position"].copy()
    given["position"][0, 0, at:] = found.position[other, at, :2]
    collision = np.zeros((1, 1, STEPS), bool)
    collision[0, 0, at:] = True
    axes = new_figure().add_subplot()
    plot_rollout(Clip(found, **given, collision=collision), axes)
    boxes = patches(axes, "hit")
    middles = [box[:4].mean(0) for box in boxes]
    assert any(np.allclose(middle, found.position[other, at, :2], atol=1e-3) for middle in middles)
    assert "playback, when it was hit" in [text.get_text() for text in axes.get_legend().get_texts()]
    calm = new_figure().add_subplot()
    plot_rollout(Clip(found, **given), calm)
    assert patches(calm, "hit") == []


@pytest.mark.parametrize(
    ("kinds", "words"),
    [([0], "1 rollout"), ([0, 1], "2 rollouts"), ([0, 1, 0, 1, 1], "5 rollouts, 2 distinct")],
)
def test_rollouts_that_are_the_same_are_counted_once(kinds: list[int], words: str) -> None:
    found = segment()
    given = rollouts(found, len(kinds))
    given["position"] = given["position"] + np.array(kinds)[:, None, None, None]
    # What is not valid makes no difference.
    valid = np.ones((len(kinds), 1, STEPS), bool)
    valid[..., -1] = False
    given["position"][..., -1, :] += np.arange(len(kinds))[:, None, None]
    axes = new_figure().add_subplot()
    plot_rollout(Clip(found, **given, valid=valid), axes)
    assert any(f"{words} of " in text.get_text() for text in axes.texts)


def test_eight_agents_have_eight_colours() -> None:
    found = straight_road(8, steps=STEPS)
    assert len(set(colors_of(found, range(8)))) == 8
    script = (Path(viewer.__file__).parent / "scene.js").read_text()
    palette = re.search(r"const PALETTE = (\[.*?\]);", script)
    assert palette is not None
    assert json.loads(palette[1]) == [color.lower() for color in AGENT_COLORS]


def test_panels_are_of_one_size(tmp_path: Path) -> None:
    """However far each rollout goes."""
    given = [(segment(), 1.0), (segment(1), 4.0), (segment(2), 9.0)]
    clips = []
    for found, scale in given:
        drawn = rollouts(found)
        first = drawn["position"][:, :, :1]
        clips.append(Clip(found, first + scale * (drawn["position"] - first), *list(drawn.values())[1:]))
    figure = plot_grid(
        [partial(plot_rollout, clip) for clip in clips],
        tmp_path / "a.png",
    )
    sizes = [axes.get_window_extent().size for axes in figure.axes]
    np.testing.assert_allclose(sizes, [sizes[0]] * len(sizes), atol=0.5)
    frames, _ = frames_of(clips[:2])
    assert len({frame.shape for frame in frames}) == 1


@pytest.mark.parametrize("aspect", [0.3, 1.0, 2.5])
def test_views_grow_about_their_middle(aspect: float) -> None:
    view = (-3.0, 7.0, 10.0, 16.0)
    left, right, low, high = with_aspect(view, aspect)
    assert (high - low) / (right - left) == pytest.approx(aspect)
    assert (left + right, low + high) == pytest.approx((4.0, 26.0))
    assert left <= -3
    assert right >= 7
    assert low <= 10
    assert high >= 16
