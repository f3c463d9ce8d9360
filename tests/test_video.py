"""Animated rollouts."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence

from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.cli import main
from symphony.data.segment import RunSegment
from symphony.errors import ConfigError
from symphony.render import Clip, animate_rollouts

SIZE = 2.0
"""Inches, small to be quick."""
MOST = 12
"""Frames, few for the same reason."""


def clip(segment: RunSegment, agents: list[int], count: int = 1, start: int = 1, **changes: Any) -> Clip:
    """The log itself, shifted sideways by 2 m per rollout."""
    rows = np.maximum(agents, 0)
    position = np.repeat(segment.position[None, rows, start:, :2], count, 0).astype(float)
    position[..., 1] += 2 * np.arange(count)[:, None, None]
    heading = np.repeat(segment.heading[None, rows, start:], count, 0)
    return Clip(segment, position, heading, agents, start, **changes)


def frames(clips: list[Clip], path: Path, **options: Any) -> np.ndarray:
    """[F, H, W, 3]."""
    animate_rollouts(clips, path, size=SIZE, **options)
    with Image.open(path) as image:
        return np.stack([np.asarray(page.convert("RGB")) for page in ImageSequence.Iterator(image)])


def durations(path: Path) -> list[float]:
    """Seconds of each frame."""
    with Image.open(path) as image:
        return [page.info["duration"] / 1000 for page in ImageSequence.Iterator(image)]


def standing(segment: RunSegment, agents: list[int]) -> RunSegment:
    """All but some agents stay where they are at first."""
    position = np.repeat(segment.position[:, :1], segment.num_steps, 1)
    position[agents] = segment.position[agents]
    return segment.replace(position=position)


@pytest.mark.parametrize(("steps", "start"), [(2, 0), (6, 1), (MOST, 0), (MOST + 1, 0), (2 * MOST + 1, 0)])
def test_frames_are_the_steps_or_evenly_fewer_in_real_time(
    steps: int, start: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("symphony.render.video.FRAMES", MOST)
    segment, file = crossing(3, steps=steps), tmp_path / "a.gif"
    drawn = frames([clip(segment, [0], start=start)], file)
    shown = steps - start
    every = -(-shown // MOST)
    assert len(drawn) == -(-shown // every) <= MOST
    assert durations(file) == pytest.approx([every * segment.dt] * len(drawn))
    assert file.stat().st_size < 1_000_000
    frames([clip(segment.replace(dt=1 / 30), [0], start=start)], file)  # no whole hundredths
    assert sum(durations(file)) == pytest.approx(len(drawn) * every / 30, abs=0.006)


def test_nothing_changes_but_where_something_moves(tmp_path: Path) -> None:
    """One agent of a straight road drives: above and below it all stays as it is, but for the clock."""
    segment = standing(straight_road(3, steps=8), [0])
    drawn = frames([clip(segment, [0], view=(-10.0, 90.0, -40.0, 40.0))], tmp_path / "a.gif")
    rows = np.flatnonzero((drawn != drawn[0]).any((0, 2, 3)))
    height = drawn.shape[1]
    clock, road = rows[rows < 0.2 * height], rows[rows >= 0.2 * height]
    assert np.ptp(clock) < 0.06 * height
    assert np.ptp(road) < 0.15 * height
    # The clock is at the right.
    columns = np.flatnonzero((drawn[:, clock] != drawn[:1, clock]).any((0, 1, 3)))
    assert columns.min() > 0.7 * drawn.shape[2]


@pytest.mark.parametrize("padded", [[0, -1, 2], [-1, 0, 2, -1]])
def test_padding_changes_nothing(padded: list[int], tmp_path: Path) -> None:
    segment = crossing(4, steps=4)
    both = [frames([clip(segment, agents, 2)], tmp_path / "a.gif") for agents in ([0, 2], padded)]
    np.testing.assert_array_equal(*both)


def test_collisions_are_marked_from_where_they_begin(tmp_path: Path) -> None:
    segment = straight_road(2, steps=9)
    hit = np.zeros((1, 2, 8), bool)
    hit[0, 1, 4:6] = True
    plain = frames([clip(segment, [0, 1], collision=np.zeros_like(hit))], tmp_path / "a.gif")
    marked = frames([clip(segment, [0, 1], collision=hit)], tmp_path / "b.gif")
    # Around the cars, where no legend is.
    middle = np.s_[:, int(0.45 * plain.shape[1]) : int(0.8 * plain.shape[1])]
    changed = (abs(plain[middle].astype(int) - marked[middle]) > 60).any((1, 2, 3))
    assert changed.tolist() == [False] * 4 + [True] * 4


def test_invalid_steps_are_not_drawn(tmp_path: Path) -> None:
    segment = standing(straight_road(2, steps=9), [0])
    valid = np.ones((1, 1, 8), bool)
    valid[0, 0, 3:] = False
    # The log would go on, and so is not there either.
    seen = segment.valid.copy()
    seen[0, 4:] = False
    drawn = frames([clip(segment.replace(valid=seen), [0], valid=valid)], tmp_path / "a.gif")
    road = drawn[:, int(0.3 * drawn.shape[1]) :]
    assert (road[4:] == road[4]).all()
    assert (road[2] != road[3]).any()


def test_shorter_segments_wait_for_longer_ones(tmp_path: Path) -> None:
    clips = [clip(crossing(3, steps=4), [0]), clip(crossing(3, seed=1, steps=9), [0])]
    drawn = frames(clips, tmp_path / "a.gif")
    assert len(drawn) == 8
    half = drawn.shape[2] // 2
    left, right = drawn[:, :, :half], drawn[:, :, half:]
    assert (left[2:] == left[2]).all()
    assert all((a != b).any() for a, b in pairwise(right))


def test_equal_animations_are_equal_files(tmp_path: Path) -> None:
    for name in ("a", "b"):
        animate_rollouts([clip(crossing(3, steps=4), [0])], tmp_path / f"{name}.gif", size=SIZE)
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_the_kind_of_file_is_checked(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.gif"):
        animate_rollouts([clip(crossing(3, steps=4), [0])], tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


# The command line


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, [straight_road(4, steps=5), crossing(4, seed=1, steps=7)])
    return path


def test_an_evaluation_can_be_animated(store: Path, tmp_path: Path) -> None:
    file = tmp_path / "rollouts.gif"
    options = ["--data", str(store), "--figure", str(file), "--rollouts", "2"]
    assert main(["evaluate", "constant_velocity", *options]) == 0
    assert len(durations(file)) == 6
