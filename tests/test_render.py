"""Pictures of run segments and rollouts, films, and the curves of training."""

from __future__ import annotations

import itertools
import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from PIL import Image, ImageSequence

from helpers_saved import played
from helpers_segments import crossing, hide, straight_road
from helpers_store import fill
from helpers_table import make_record, make_run
from symphony.cli import main
from symphony.data.segment import MarkType, Polylines, RunSegment, SignalState
from symphony.errors import ConfigError
from symphony.render import Clip, animate_rollouts, plot_curves, plot_rollout, plot_segment, viewer
from symphony.render.curves import read_curves, smoothed
from symphony.render.plots import colors_of, saved_clip
from symphony.render.roads import CORNERS, NOSE, SIGNALS, lane_arrows, pieces, place, road_ribbon
from symphony.render.style import AGENT_COLORS, INK, PLAYBACK, ROAD, new_figure, view_around
from symphony.render.video import _Panel


def blank() -> Axes:
    return new_figure().add_subplot()


def by_gid(axes: Axes, gid: str) -> Any:
    (found,) = (artist for artist in axes.get_children() if artist.get_gid() == gid)
    return found


def gids(axes: Axes) -> set[str]:
    return {artist.get_gid() for artist in axes.get_children() if artist.get_gid()}


def labels(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def corners(collection: Any) -> np.ndarray:
    """[A, 4, 2] boxes of a collection, without the closing vertex."""
    return np.stack([path.vertices[:4] for path in collection.get_paths()])


numbers = st.floats(-50, 50, width=32)


@given(arrays(np.float64, 2, elements=numbers), st.floats(-7, 7), st.floats(0.5, 12), st.floats(0.3, 3))
def test_box_agrees_with_shapely_and_its_nose_is_ahead(position, heading, length, width):
    at = position[None], np.array([heading]), np.array([[length, width]])
    box, nose = shapely.Polygon(place(CORNERS, *at)[0]), place(NOSE, *at)[0]
    plain = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    turned = shapely.affinity.rotate(plain, heading, (0, 0), use_radians=True)
    expected = shapely.affinity.translate(turned, *position)
    assert box.symmetric_difference(expected).area < 1e-6 * expected.area + 1e-9
    assert box.buffer(1e-6).contains(shapely.Polygon(nose))
    assert (nose.mean(0) - position) @ [math.cos(heading), math.sin(heading)] > 0.2 * length


@given(arrays(np.bool_, st.integers(2, 12)))
def test_pieces_join_valid_steps_only(valid: np.ndarray) -> None:
    path = np.stack([np.arange(len(valid)), -np.arange(len(valid))], -1).astype(float)
    found, begin = pieces(path, valid)
    expected = np.flatnonzero(valid[1:] & valid[:-1]).tolist()
    assert begin.tolist() == found[:, 0, 0].tolist() == expected
    assert (found[:, 1] - found[:, 0] == [1, -1]).all()
    assert pieces(np.where(valid[:, None], path, np.nan))[1].tolist() == expected


@settings(deadline=None)
@given(st.integers(2, 9), st.floats(0.3, 40), st.integers(0, 1000))
@example(7, 35.99999999999999, 0)
def test_arrows_lie_on_the_lane_and_point_along_it(count: int, length: float, seed: int) -> None:
    turns = np.random.default_rng(seed).uniform(-0.4, 0.4, count)
    steps = np.stack([np.cos(turns), np.sin(turns)], -1) * length
    line = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
    found = lane_arrows(line)
    # A length on the edge of one more arrow may fall to either side by rounding, and only then.
    about = [count * length * (1 + sign * 1e-9) for sign in (-1, 1)]
    assert len(found) in {0 if total < 7 else max(1, int(total / 14)) for total in about}
    for arrow in found:
        tip, back = arrow[1], (arrow[0] + arrow[2]) / 2
        assert shapely.LineString(line).distance(shapely.Point(tip)) < 1e-6
        direction = (tip - back) / 0.7
        # At a bend, either of the two pieces that meet there.
        near = [shapely.LineString(line[k : k + 2]).distance(shapely.Point(tip)) < 1e-6 for k in range(count)]
        assert np.abs(direction - steps[near] / length).max(-1).min() < 1e-6


@given(arrays(np.float64, st.tuples(st.integers(1, 9), st.just(2)), elements=st.floats(-500, 500)))
def test_view_holds_the_points_with_their_margin(points: np.ndarray) -> None:
    x0, x1, y0, y1 = view_around(points, margin=20, least=70)
    assert (points.min(0) - [x0, y0] >= 15 - 1e-6).all()
    assert ([x1, y1] - points.max(0) >= 15 - 1e-6).all()
    short, long = sorted([x1 - x0, y1 - y0])
    assert long >= 70 - 1e-9
    assert short >= 0.6 * long - 1e-6


def test_colors_can_be_told_apart_by_all_eyes() -> None:
    # Severe deuteranopia and protanopia (Machado et al. 2009), on linear RGB.
    deutan = [0.367322, 0.860646, -0.227968, 0.280085, 0.672501, 0.047413, -0.01182, 0.04294, 0.968881]
    protan = [0.152286, 1.052583, -0.204868, 0.114503, 0.786281, 0.099216, -0.003882, -0.048116, 1.051998]
    linear = np.array([to_rgb(color) for color in (*AGENT_COLORS, PLAYBACK, ROAD)]) ** 2.2
    for eye in (np.eye(3), np.reshape(deutan, (3, 3)), np.reshape(protan, (3, 3))):
        seen = np.clip(linear @ eye.T, 0, 1) ** (1 / 2.2)
        for a, b in itertools.combinations(seen, 2):
            assert np.linalg.norm(a - b) > 0.25


@pytest.mark.parametrize(("suffix", "head"), [("png", b"\x89PNG\r\n"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_segment_is_written_as_a_picture(suffix: str, head: bytes, tmp_path: Path) -> None:
    path = tmp_path / "made" / f"crossing.{suffix}"
    plot_segment(crossing(), path)
    content = path.read_bytes()
    assert content.startswith(head)
    if suffix != "svg":  # whose names are drawn
        plot_segment(crossing(), again := path.with_name(f"again.{suffix}"))
        assert again.read_bytes() == content
    if suffix == "png":
        colors = {to_hex(color) for color in matplotlib.image.imread(path).reshape(-1, 4)[::7]}
        assert {AGENT_COLORS[0].lower(), PLAYBACK.lower(), "#ffffff"} <= colors


@pytest.mark.parametrize("step", [0, 50])
def test_boxes_stand_where_the_log_has_them(step: int) -> None:
    segment = crossing()
    axes = plot_segment(segment, blank(), step=step, interactive=[2])
    for agent, color in ((segment.ego, AGENT_COLORS[0]), (2, AGENT_COLORS[1])):
        box, one = by_gid(axes, f"box-{agent}"), [agent]
        at = segment.position[one, step, :2], segment.heading[one, step], segment.size[one]
        np.testing.assert_allclose(corners(box), place(CORNERS, *at), atol=1e-4)
        assert to_hex(box.get_facecolor()[0]) == color.lower()
    assert len(corners(by_gid(axes, "playback"))) == segment.num_agents - 2


def test_agents_that_are_not_seen_are_not_drawn() -> None:
    segment = hide(hide(crossing(), 1, slice(20, 30)), 2, slice(20, 30))
    axes = plot_segment(segment, blank(), step=25, interactive=[1])
    assert "box-1" not in gids(axes)
    assert len(corners(by_gid(axes, "playback"))) == segment.num_agents - 3
    trail = by_gid(axes, "trail-1").get_segments()
    assert len(trail) == segment.num_steps - 1 - 11
    np.testing.assert_allclose(trail[0], segment.position[1, :2, :2])


def test_map_is_drawn_where_it_lies_and_in_view() -> None:
    segment = straight_road(3)
    axes = plot_segment(segment, blank(), view=(0.0, 60.0, -20.0, 20.0))
    for k, lane in enumerate(by_gid(axes, "lanes").get_segments()):
        np.testing.assert_allclose(lane, segment.road.lanes[k][:, :2])
    assert len(by_gid(axes, "boundary").get_segments()) == len(segment.road.boundary)
    surface = shapely.Polygon(by_gid(axes, "surface").get_path().vertices)
    assert [surface.contains(shapely.Point(30, y)) for y in (3.5, 13)] == [True, False]
    assert (*axes.get_xlim(), *axes.get_ylim()) == (0, 60, -20, 20)
    for bottom, lanes in ((2.0, 2), (200.0, 0)):
        axes = plot_segment(straight_road(3), blank(), view=(0.0, 60.0, bottom, bottom + 40))
        assert (len(by_gid(axes, "lanes").get_segments()), "surface" in gids(axes)) == (lanes, bool(lanes))


def test_lanes_without_width_have_a_surface_and_those_of_one_point_none() -> None:
    road = straight_road(3).road
    for width, expected in ((road.lane_width, 3.5), (np.full_like(road.lane_width, np.nan), 3.6)):
        ribbon = road_ribbon(replace(road, lane_width=width), 0)
        assert ribbon.bounds[3] - ribbon.bounds[1] == pytest.approx(expected + 0.3, abs=1e-4)
    stub = Polylines.of([road.lanes[0][:1], *(road.lanes[k] for k in range(1, len(road.lanes)))])
    assert road_ribbon(replace(road, lanes=stub), 0).is_empty


def test_lights_stand_at_their_stop_points_in_their_state() -> None:
    segment, shown = crossing(), set()
    for step in (0, segment.num_steps - 1):
        axes = plot_segment(segment, blank(), step=step, view=(-200.0, 200.0, -200.0, 200.0))
        for name, (_, _, states) in SIGNALS.items():
            there = np.isin(segment.signal_state[:, step], [int(state) for state in states])
            assert (f"signals-{name}" in gids(axes)) == (f"light: {name}" in labels(axes)) == there.any()
            if there.any():
                drawn = by_gid(axes, f"signals-{name}").get_offsets()
                np.testing.assert_allclose(drawn, segment.signal_point[there, :2], atol=1e-4)
                shown.add(name)
    assert {"stop", "go"} <= shown


def test_marks_of_every_kind_are_drawn() -> None:
    segment, square = straight_road(3), np.array([(20, -1), (24, -1), (24, 8), (20, 8)], float)
    lines = [square + np.array([6, 0]) * k for k in range(4)] + [np.array([[50.0, 9.0]])]
    kinds = ("ROAD_LINE", "CROSSWALK", "SPEED_BUMP", "DRIVEWAY", "STOP_SIGN")
    codes = np.array([MarkType[kind] for kind in kinds], np.uint8)
    road = replace(segment.road, marks=Polylines.of(lines), mark_type=codes)
    axes = plot_segment(segment.replace(road=road), blank())
    np.testing.assert_allclose(by_gid(axes, "marks").get_segments()[0], square)
    for name, line in zip(("crosswalk", "speed_bump", "driveway"), lines[1:], strict=False):
        np.testing.assert_allclose(by_gid(axes, f"mark-{name}").get_path().vertices[:4], line)
    np.testing.assert_allclose(by_gid(axes, "stop-signs").get_offsets(), [(50, 9)])
    assert "stop sign" in labels(axes)


def test_unknown_kinds_of_pictures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.png"):
        plot_segment(crossing(), tmp_path / "a.docx")
    with pytest.raises(ConfigError, match=r"\.gif"):
        animate_rollouts([rollouts(crossing(3, steps=4), [0])], tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def rollouts(segment: RunSegment, agents: list[int], count: int = 3, start: int = 0, **flags: Any) -> Clip:
    """The log shifted sideways by 2 m per rollout."""
    position = np.repeat(segment.position[None, agents, start:, :2].astype(float), count, 0)
    position[..., 1] += 2 * np.arange(count)[:, None, None]
    heading = np.repeat(segment.heading[None, agents, start:], count, 0)
    known = {"valid": np.ones(heading.shape, bool)} | dict.fromkeys(("collision", "offroad"), heading < -np.inf)
    return Clip(segment, position, heading, np.array(agents), start, **(known | flags))


def test_rollouts_are_drawn_over_the_log() -> None:
    segment = straight_road(4)
    given = rollouts(segment, [0, 2], start=10)
    axes = plot_rollout(given, blank())
    for n, agent in enumerate([0, 2]):
        lines = np.stack(by_gid(axes, f"rollouts-{agent}").get_segments()).reshape(3, -1, 2, 2)
        np.testing.assert_allclose(lines[:, :, 0], given.position[:, n, :-1], atol=1e-4)
        ends = corners(by_gid(axes, f"ends-{agent}")).mean(1)
        np.testing.assert_allclose(ends, given.position[:, n, -1], atol=1e-4)
        log = np.stack(by_gid(axes, f"log-{agent}").get_data(), -1)
        np.testing.assert_allclose(log, segment.position[agent, 10:, :2])
    playback = corners(by_gid(axes, "playback")).mean(1)
    np.testing.assert_allclose(playback, segment.position[[1, 3], -1, :2], atol=1e-3)


def test_rollouts_end_at_their_last_valid_step_and_gaps_of_logs_stay() -> None:
    valid = np.ones((3, 1, 51), bool)
    valid[1, 0, 20:] = False
    given = rollouts(hide(straight_road(3), 1, slice(10, 20)), [1], valid=valid)
    axes = plot_rollout(given, blank())
    ends = corners(by_gid(axes, "ends-1")).mean(1)
    np.testing.assert_allclose(ends, given.position[[0, 1, 2], 0, [50, 19, 50]], atol=1e-4)
    assert len(by_gid(axes, "rollouts-1").get_segments()) == 50 + 19 + 50
    assert np.flatnonzero(np.isnan(by_gid(axes, "log-1").get_xdata())).tolist() == list(range(10, 20))


def test_events_are_marked_where_they_begin() -> None:
    collision = np.zeros((3, 2, 51), bool)
    collision[0, 1, 5:9] = collision[0, 1, 30:] = collision[2, 0, 0] = True
    given = rollouts(straight_road(3), [0, 1], collision=collision, offroad=np.zeros_like(collision))
    axes = plot_rollout(given, blank())
    expected = [given.position[where] for where in ((0, 1, 5), (0, 1, 30), (2, 0, 0))]
    drawn = by_gid(axes, "collision").get_offsets()
    np.testing.assert_allclose(*(sorted(map(tuple, points)) for points in (drawn, expected)), atol=1e-3)
    assert "collision" in labels(axes)
    assert not {"offroad", "off road"} & {*gids(axes), *labels(axes)}


def test_a_clip_begins_with_the_first_state_and_marks_who_is_evaluated() -> None:
    saved = played(straight_road(3, steps=21), [0, 1], 2, drivers=("me", "background:idm"))
    saved.collision[0, 5:, 1] = saved.offroad[1, 3:, 1] = True
    clip = saved_clip(saved)
    np.testing.assert_allclose(clip.position[:, :, 0], np.stack([saved.segment.position[:2, 0, :2]] * 2), atol=1e-6)
    assert not (clip.collision | clip.offroad).any()
    saved.collision[0, 5:, 0] = True
    assert np.argwhere(saved_clip(saved).collision).tolist() == [[0, 0, step] for step in range(6, 21)]


def test_a_light_keeps_its_colour_in_a_film_and_its_entry_in_the_legend(tmp_path: Path) -> None:
    segment = crossing(2, steps=9)
    state = np.full_like(segment.signal_state, SignalState.GO)
    state[:, 3] = SignalState.CAUTION
    clip = saved_clip(played(segment.replace(signal_state=state)))
    animate_rollouts([clip], tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as image:
        shown = {
            color for frame in ImageSequence.Iterator(image) for _, color in frame.convert("RGB").getcolors(1 << 20)
        }
    assert tuple(round(255 * part) for part in to_rgb(SIGNALS["caution"][1])) in shown
    panel = _Panel(clip)
    panel.settle(axes := blank())
    assert {"light: go", "light: caution"} <= set(labels(axes))


def test_playback_vehicles_are_drawn_where_they_were_hit() -> None:
    segment, at = straight_road(4, steps=12), 4
    clip = rollouts(segment, [0], 1, collision=np.arange(12)[None, None] >= at)
    clip.position[0, 0, at:] = segment.position[1, at, :2]
    clip.position[0, 0, at + 3 :] = segment.position[2, at + 3, :2]  # in one run of flagged steps
    axes = plot_rollout(clip, blank())
    middles = corners(by_gid(axes, "hit")).mean(1)
    assert np.isclose(middles, segment.position[[1, 2], [at, at + 3], None, :2], atol=1e-3).all(-1).any(1).all()
    assert len(middles) == 2  # one outline each, however long the contact
    assert "playback, when it was hit" in labels(axes)
    assert "hit" not in gids(plot_rollout(rollouts(segment, [0], 1), blank()))


def test_agents_have_their_colours_in_pictures_and_pages() -> None:
    """Eight have eight, and the ego has its own among thirty; the legend of a crowd is short."""
    script = (Path(viewer.__file__).parent / "scene.js").read_text()
    (palette,) = re.findall(r"const PALETTE = (\[.*?\]);", script)
    assert json.loads(palette) == [color.lower() for color in AGENT_COLORS]
    assert len(set(colors_of(straight_road(8), range(8)))) == 8
    segment = straight_road(30)
    axes = plot_segment(segment, blank(), interactive=list(range(1, 30)))
    for name, color in (("facecolor", AGENT_COLORS[0]), ("edgecolor", INK)):
        shown = [tuple(getattr(by_gid(axes, f"box-{k}"), f"get_{name}")()[0][:3]) for k in range(30)]
        assert [k for k in range(30) if shown[k] == to_rgb(color)] == [segment.ego]
    assert len([label for label in labels(axes) if label.startswith(("ego", "vehicle"))]) == 8
    assert "and 22 more in colour" in labels(axes)


def test_pictures_need_no_window_and_no_torch() -> None:
    code = "import sys, symphony.render.video; assert not {'matplotlib.pyplot', 'torch'} & {*sys.modules}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_routes_of_agents_are_drawn(tmp_path: Path) -> None:
    fill(tmp_path / "store", [straight_road(4, steps=8)])
    picture = tmp_path / "routes.png"
    assert main(["plot", "routes", "--data", str(tmp_path / "store"), "--out", str(picture)]) == 0
    assert picture.stat().st_size > 20_000


def frames(clips: list[Clip], path: Path) -> np.ndarray:
    """[F, H, W, 3], two inches wide to be quick."""
    animate_rollouts(clips, path, size=2.0)
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


@pytest.mark.parametrize(("steps", "start", "hertz"), [(2, 0, 30), (6, 1, 5), (12, 0, 30), (13, 0, 30), (25, 0, 5)])
def test_frames_are_the_steps_or_evenly_fewer_in_real_time(steps, start, hertz, tmp_path, monkeypatch):
    """Also of no whole hundredths of a second."""
    monkeypatch.setattr("symphony.render.video.FRAMES", 12)
    segment, file, shown = crossing(3, steps=steps).replace(dt=1 / hertz), tmp_path / "a.gif", steps - start
    drawn, every = frames([rollouts(segment, [0], 1, start)], file), -(-shown // 12)
    assert len(drawn) == -(-shown // every) <= 12
    assert durations(file) == pytest.approx([every / hertz] * len(drawn), abs=0.01 if hertz == 30 else 1e-9)
    assert sum(durations(file)) == pytest.approx(len(drawn) * every / hertz, abs=0.006)


def test_nothing_changes_but_where_something_moves(tmp_path: Path) -> None:
    """One agent of a straight road drives: above and below it all stays as it is, but for the clock."""
    segment = standing(straight_road(3, steps=8), [0])
    drawn = frames([rollouts(segment, [0], 1, view=(-10.0, 90.0, -40.0, 40.0))], tmp_path / "a.gif")
    rows, (height, width) = np.flatnonzero((drawn != drawn[0]).any((0, 2, 3))), drawn.shape[1:3]
    clock, road = rows[rows < 0.2 * height], rows[rows >= 0.2 * height]
    assert np.ptp(clock) < 0.06 * height
    assert np.ptp(road) < 0.15 * height
    # The clock is at the right.
    assert np.flatnonzero((drawn[:, clock] != drawn[:1, clock]).any((0, 1, 3))).min() > 0.7 * width


def test_films_of_the_same_are_equal_files(tmp_path: Path) -> None:
    written, segment = set(), crossing(4, steps=4)
    for _ in range(2):
        animate_rollouts([rollouts(segment, [0, 2], 2)], tmp_path / "a.gif", size=2.0)
        written.add((tmp_path / "a.gif").read_bytes())
    assert len(written) == 1


def test_collisions_are_marked_from_where_they_begin(tmp_path: Path) -> None:
    segment, hit = straight_road(2, steps=8), np.zeros((1, 2, 8), bool)
    hit[0, 1, 4:6] = True
    clips = (rollouts(segment, [0, 1], 1, collision=flags) for flags in (hit & False, hit))
    plain, marked = (frames([clip], tmp_path / "a.gif") for clip in clips)
    # Around the cars, where no legend is.
    middle = np.s_[:, int(0.45 * plain.shape[1]) : int(0.8 * plain.shape[1])]
    changed = (abs(plain[middle].astype(int) - marked[middle]) > 60).any((1, 2, 3))
    assert changed.tolist() == [False] * 4 + [True] * 4


def test_invalid_steps_are_not_drawn(tmp_path: Path) -> None:
    """Nor is the log, where it ends as well."""
    segment, valid = standing(straight_road(2, steps=8), [0]), np.arange(8)[None, None] < 3
    drawn = frames([rollouts(hide(segment, 0, slice(3, 8)), [0], 1, valid=valid)], tmp_path / "a.gif")
    road = drawn[:, int(0.3 * drawn.shape[1]) :]
    assert (road[4:] == road[4]).all()
    assert (road[2] != road[3]).any()


def test_shorter_segments_wait_for_longer_ones(tmp_path: Path) -> None:
    clips = [rollouts(crossing(3, seed=seed, steps=steps), [0], 1) for seed, steps in enumerate((3, 8))]
    drawn = frames(clips, tmp_path / "a.gif")
    assert len(drawn) == 8
    left, right = np.split(drawn[:, :, : drawn.shape[2] // 2 * 2], 2, 2)
    assert (left[2:] == left[2]).all()
    assert all((a != b).any() for a, b in itertools.pairwise(right))


def records(count: int = 30, **metrics: float) -> list[dict[str, float]]:
    return [{"step": 20 * (k + 1)} | {name: x * k for name, x in metrics.items()} for k in range(count)]


def test_every_metric_has_a_panel_and_every_run_two_lines(tmp_path: Path) -> None:
    runs = {
        "one": records(discriminator_auc=0.1, policy_accuracy=1.0, mine=3.0),
        r"$\two$": records(5, discriminator_auc=0.2, search_collision_all=1.0, search_collision_kept=0.5),
    }
    figure = plot_curves(runs, tmp_path / "curves.png")
    drawn = {axes.get_title(loc="left"): axes.lines for axes in figure.axes}
    assert list(drawn) == ["discriminator auc", "policy accuracy", "mine", "search: share in collision"]
    twice = [f"{raw}discriminator_auc-{run}" for run in runs for raw in ("raw-", "")]
    assert [line.get_gid() for line in drawn["discriminator auc"]] == twice
    assert len(drawn["search: share in collision"]) == 4
    raw, strong = drawn["policy accuracy"]
    assert [raw.get_gid(), strong.get_gid()] == ["raw-policy_accuracy-one", "policy_accuracy-one"]
    np.testing.assert_array_equal(raw.get_xydata(), [(20 * (k + 1), k) for k in range(30)])
    assert raw.get_alpha() < 0.5
    assert raw.get_linewidth() < strong.get_linewidth()
    assert raw.get_color() == strong.get_color() == AGENT_COLORS[0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", r"\$\two\$"]
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def test_missing_and_odd_values_are_tolerated(tmp_path: Path) -> None:
    odd: list[dict[str, Any]] = [{"step": 1, "auc": (nan := math.nan), "note": "text"}]
    odd += [{"step": 2, "auc": None, "flag": True}, {"step": 3, "auc": 0.5, "late": nan}]
    curves = read_curves(odd)
    assert list(curves) == ["auc", "late"]
    np.testing.assert_array_equal(curves["auc"], [[1, 2, 3], [nan, nan, 0.5]])
    assert plot_curves({"odd": odd}, tmp_path / "odd.svg").axes[0].lines[1].get_marker() == "o"
    plot_curves({"odd": odd}, tmp_path / "again.svg")
    assert (tmp_path / "odd.svg").read_bytes() == (tmp_path / "again.svg").read_bytes()
    many = {"many": records(ttc_p5=1.0, ttc_p25=2.0, ttc_p50=3.0, ttc_p75=4.0)}
    (axes, *_) = plot_curves(many, tmp_path / "many.svg").axes
    assert (len(axes.lines), len(axes.get_legend().get_texts())) == (8, 4)


@settings(deadline=None, max_examples=25)
@given(arrays(float, st.integers(1, 40), elements=st.floats(-1e3, 1e3) | st.just(math.nan)), st.floats(0, 1))
def test_smoothing_stays_within_the_values_around(values: np.ndarray, window: float) -> None:
    found, reach = smoothed(values, window), round(window * len(values) / 2)
    for k, average in enumerate(found):
        near = [x for x in values[max(0, k - reach) : k + reach + 1] if np.isfinite(x)]
        expected = np.mean(near) if near else math.nan
        assert average == pytest.approx(expected, abs=1e-6, nan_ok=True)


def test_the_command_draws_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "curves.png")
    for name, metrics in (("one", {"auc": 0.1}), ("two", {"auc": 0.2, "accuracy": 1.0}), ("fresh", {})):
        lines = [json.dumps(line) + "\n" for line in records(3 if metrics else 0, **metrics)]
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_text("".join(lines))
    one, two, fresh = (str(tmp_path / name) for name in ("one", "two", "fresh"))
    assert main(["plot", "curves", one, two, "--out", out, "--metrics", "auc", "accuracy"]) == 0
    assert Path(out).stat().st_size > 5_000
    for words, expected in (
        ([one, fresh], f"{fresh}: is not a run"), ([str(tmp_path)], f"{tmp_path}: is not a run"),
        ([one, "--metrics", "auk"], "no run has auk"), ([one, "--out", "a.txt"], ".png"),
    ):  # fmt: skip
        assert main(["plot", "curves", "--out", out, *words]) == 1
        assert expected in capsys.readouterr().err
    for command in ("curves", "curvature"):
        assert main(["plot", command, one, two, f"{one}/", "--out", out]) == 2
        assert f"RUN ...: {one} is given twice" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [
    {"policy": None}, {"log": [1, 2]}, {"log": [1.5, 2.0, 3.0]}, {"policy": [-1, 2, 3]}, {"policy": [1 << 70, 2, 3]},
])  # fmt: skip
def test_a_damaged_evaluation_is_named(tmp_path: Path, damage: Any, capsys: Any) -> None:
    counts = {"policy": [1, 2, 3], "log": [3, 2, 1]}
    for name, status, held in (("whole", 0, counts), ("run", 1, {**counts, **damage})):
        folder = make_run(tmp_path / name, "bc", 0, make_record() | {"curvature": held})
        command = ["plot", "curvature", str(folder), "--out", str(tmp_path / "a.png")]
        assert main(command) == status, capsys.readouterr().err
    assert f"file {folder}, field curvature: an evaluation holds no counts" in capsys.readouterr().err
