"""Lanes that meet on the ground without a link are joined in conversion; nothing else changes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_convert import FakeReader
from helpers_segments import make_road
from symphony.data.convert import convert, info, merge
from symphony.data.joins import REACH, SAME, TURN, joined
from symphony.data.report import Report
from symphony.data.segment import LaneType, RoadMap
from symphony.data.sources.base import Item
from symphony.data.store import SegmentStore


def line(*points: tuple[float, ...]) -> NDArray[Any]:
    return np.array(points, np.float32)


def links(road: RoadMap) -> set[tuple[int, int]]:
    return {(a, b) for a, b in road.successors.tolist()}


@given(st.lists(st.floats(0.05, 1.4), min_size=1, max_size=6), st.floats(-3, 3), st.integers(0, 2**16))
def test_a_road_cut_into_pieces_is_whole_again(gaps: list[float], angle: float, seed: int) -> None:
    """Gaps along a curve, the lanes in any order, the world turned in any way."""
    rng = np.random.default_rng(seed)
    pieces, at, heading = [], np.zeros(2), angle
    for gap in [*gaps, 0.0]:
        turn = rng.uniform(-0.2, 0.2)
        piece = [at]
        for _ in range(4):
            heading += turn / 4
            piece.append(piece[-1] + 5 * np.array([np.cos(heading), np.sin(heading)]))
        pieces.append(np.array(piece))
        at = piece[-1] + gap * np.array([np.cos(heading), np.sin(heading)])
    order = rng.permutation(len(pieces))
    road, count = joined(make_road([pieces[k] for k in order]))
    place = np.argsort(order).tolist()
    assert (links(road), count) == (set(pairwise(place)), len(pieces) - 1)
    again, none = joined(road)
    assert none == 0
    assert again is road


@pytest.mark.parametrize(("what", "start", "expected"), [
    ("at the end", ((20, 0), (40, 0)), True), ("just near enough", ((20 + REACH - 0.01, 0), (40, 0)), True),
    ("too far", ((20 + REACH + 0.01, 0), (40, 0)), False), ("beside it", ((20, -1.4), (40, -1.4)), True),
    ("in the next lane", ((20, -3.5), (40, -3.5)), False),
    ("bent a little", ((20, 0), (20 + 9 * np.cos(TURN - 0.01), 9 * np.sin(TURN - 0.01))), True),
    ("bent too far", ((20, 0), (20 + 9 * np.cos(TURN + 0.01), 9 * np.sin(TURN + 0.01))), False),
    ("against it", ((20, 0), (0, 0)), False), ("on a bridge", ((20, 0, 5), (40, 0, 5)), False),
    ("a point", ((20, 0),), False), ("begins a metre before the end", ((19, 0), (40, 0)), True),
])  # fmt: skip
def test_where_the_next_lane_must_begin(what: str, start: Any, expected: bool) -> None:
    road, count = joined(make_road([line((0, 0), (20, 0)), line(*start)]))
    assert (count, links(road)) == ((1, {(0, 1)}) if expected else (0, set())), what


def test_no_branch_is_invented_where_lanes_are_linked() -> None:
    here, on = line((0, 0), (20, 0)), line((20, 0), (40, 0))
    aside, same = line((20.5, 0.5), (40, 3)), line((20.05, 0), (40, 3))
    fed = make_road([here, on, aside], [(0, 1)])
    assert joined(fed)[1] == 0  # 0 leads somewhere, and 2 begins elsewhere
    road, count = joined(make_road([here, on, same], [(0, 1)]))
    assert (count, links(road)) == (1, {(0, 1), (0, 2)})  # 2 begins just there, and nothing leads to it
    ends = line((0, 1), (19.5, 0.2))
    road, count = joined(make_road([here, on, ends], [(0, 1)]))
    assert (count, links(road)) == (1, {(0, 1), (2, 1)})  # 2 would lead nowhere
    # Where two lanes begin at the same distance both are joined, and a farther one is not.
    road, count = joined(make_road([here, line((20, 0), (40, 4)), line((20, 0), (40, -4)), aside]))
    assert (count, links(road)) == (2, {(0, 1), (0, 2)})
    assert SAME < 0.5


def test_ends_that_only_look_like_it() -> None:
    # A stub that forks off where another lane begins: its end is near that beginning, but not before it.
    stub, on = line((0, 0), (1, 0.1)), line((0, 0), (30, 0))
    assert joined(make_road([stub, on]))[1] == 0
    # Two short lanes one after the other are no circle.
    assert joined(make_road([line((0, 0), (1, 0)), line((1, 0), (1.4, 0))], [(0, 1)]))[1] == 0
    track = make_road([line((0, 0), (20, 0)), line((20, 0), (40, 0))])
    kinds = track.lane_type.copy()
    kinds[1] = LaneType.BIKE_LANE
    assert joined(replace(track, lane_type=kinds))[1] == 0
    assert joined(make_road([line((0, 0)), line((0, 0), (0, 0))]))[1] == 0


class Cut(FakeReader):
    """Each lane is in two pieces."""

    def _read(self, path: Path) -> Iterator[Item]:
        for whole in super()._read(path):
            pieces = [piece for k in range(len(whole.road.lanes)) for piece in _halves(whole.road.lanes[k])]
            yield whole.replace(road=make_road(pieces))


def _halves(points: NDArray[Any]) -> list[NDArray[Any]]:
    middle = len(points) // 2
    return [points[: middle + 1], points[middle:]]


def test_conversion_joins_and_counts_them(tmp_path: Path) -> None:
    (tmp_path / "a.scene").write_text("straight 1\nstraight 2")
    (tmp_path / "b.scene").write_text("straight 3")
    report = convert(Cut(), [tmp_path], tmp_path / "out", workers=2)
    store = SegmentStore(tmp_path / "out")
    each = len(store[0].road.lanes) // 2
    assert [store.tags(k)["joined_gaps"] for k in range(3)] == [each] * 3
    assert [len(segment.road.successors) for segment in store] == [each] * 3
    assert report.joined_gaps == info(tmp_path / "out")["joined_gaps"] == 3 * each
    # Stores and reports from before there was this.
    old = json.loads((tmp_path / "out" / "report.json").read_text())
    del old["joined_gaps"]
    assert Report.from_json(old).joined_gaps == 0
    (tmp_path / "c.scene").write_text("straight 4")
    convert(Cut(), [tmp_path / "c.scene"], tmp_path / "more", workers=2)
    merge([tmp_path / "out", tmp_path / "more"], tmp_path / "both")
    assert info(tmp_path / "both")["joined_gaps"] == 4 * each
