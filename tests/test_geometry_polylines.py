"""Signed distance to oriented polylines against shapely."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from symphony.geometry import NO_BOUNDARY, rotate, segments_of, signed_distance
from symphony.geometry import polylines as module


def segments(lines, dtype=torch.float64):
    """start, end, valid, previous, following of one scene [1, E]."""
    points = np.concatenate([np.asarray(line, float) for line in lines])
    offsets = np.cumsum([0, *(len(line) for line in lines)])
    start, end, previous, following = segments_of(points, offsets)
    valid = torch.ones(1, len(start), dtype=torch.bool)
    start, end = (torch.tensor(x, dtype=dtype)[None] for x in (start, end))
    return start, end, valid, torch.tensor(previous)[None], torch.tensor(following)[None]


def star(rng, corners, center, low, high):
    """A simple polygon with acute corners."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
    angles += np.linspace(0, 0.1, corners)
    radius = rng.uniform(low, high, corners)
    return center + radius[:, None] * np.stack((np.cos(angles), np.sin(angles)), -1)


def closed(ring):
    return np.concatenate([ring, ring[:1]])


def rings(polygon):
    polygon = shapely.orient_polygons(polygon)
    return [np.asarray(ring.coords) for ring in (polygon.exterior, *polygon.interiors)]


def oracle(polygon, points):
    points = shapely.points(points)
    distance = shapely.distance(polygon.boundary, points)
    return np.where(shapely.contains(polygon, points), -distance, distance)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 30), st.integers(0, 4))
def test_polygons_with_holes_agree_with_shapely(seed, corners, holes):
    rng = np.random.default_rng(seed)
    polygon = shapely.Polygon(star(rng, corners, np.zeros(2), 4, 50)).buffer(0)
    for _ in range(holes):
        polygon = polygon - shapely.Polygon(star(rng, 5, rng.uniform(-20, 20, 2), 1, 9)).buffer(0)
    polygon = max(shapely.get_parts(polygon), key=shapely.area, default=shapely.Polygon())
    if polygon.area < 1e-3:
        return
    points = np.concatenate([rng.uniform(-60, 60, (60, 2)), shapely.get_coordinates(polygon)[:20]])
    points[60:] += rng.normal(0, 0.5, points[60:].shape)
    scene = segments(rings(polygon))
    ours = signed_distance(torch.tensor(points)[None], *scene)[0].numpy()
    expected = oracle(polygon, points)
    np.testing.assert_allclose(np.abs(ours), np.abs(expected), atol=1e-9)
    # shapely may leave slivers thinner than rounding between touching rings.
    clear = np.abs(expected) > 1e-6
    np.testing.assert_array_equal(ours[clear] > 0, expected[clear] > 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("coordinate", [0, 1])
def test_a_point_that_is_not_finite_has_no_finite_distance_and_changes_no_other(bad, coordinate):
    square = segments([closed(np.array([[0.0, 0], [40, 0], [40, 30], [0, 30]]))])
    points = torch.tensor([[[20.0, 3], [50, 20], [0, 0], [39, 31]]], dtype=torch.float64)
    alone = signed_distance(points, *square)
    broken = torch.cat([points[:, :2], points[:, :1], points[:, 2:]], 1)
    broken[0, 2, coordinate] = bad
    found = signed_distance(broken, *square)
    assert not found[0, 2].isfinite()
    torch.testing.assert_close(found[:, [0, 1, 3, 4]], alone, atol=1e-12, rtol=0)
    assert not signed_distance(broken[:, 2:3], *square).isfinite().any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_open_lines_have_euclidean_distance(seed):
    rng = np.random.default_rng(seed)
    lines = [rng.uniform(-20, 20, (rng.integers(2, 8), 2)) for _ in range(4)]
    points = rng.uniform(-30, 30, (50, 2))
    ours = signed_distance(torch.tensor(points)[None], *segments(lines))[0].abs().numpy()
    np.testing.assert_allclose(
        ours, shapely.distance(shapely.MultiLineString(lines), shapely.points(points)), atol=1e-9
    )


def test_left_is_inside_on_an_open_line():
    scene = segments([[[0, 0], [10, 0], [20, 0]]])
    points = torch.tensor([[[5.0, 2.0], [5.0, -3.0], [-3.0, 4.0], [23.0, -4.0]]], dtype=torch.float64)
    expected = torch.tensor([[-2.0, 3.0, -5.0, 5.0]], dtype=torch.float64)
    torch.testing.assert_close(signed_distance(points, *scene), expected)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("angle", [5.0, 40.0, 120.0])
def test_acute_corner_needs_its_neighbor(angle, reverse):
    """Beyond the tip of a wedge both sides are told apart only by looking at both segments."""
    half = math.radians(angle / 2)
    arm = np.array([math.cos(half), math.sin(half)]) * 30
    wedge = np.array([arm * [-1, 1], [0.0, 0.0], arm * [-1, -1]])
    line = wedge[::-1] if reverse else wedge
    theta = np.linspace(-(math.pi / 2 - half) + 0.01, (math.pi / 2 - half) - 0.01, 41)
    points = torch.tensor(np.stack((np.cos(theta), np.sin(theta)), -1) * 3)[None]
    start, end, valid, previous, following = segments([line])
    sign = -1.0 if not reverse else 1.0
    # Travelling down and back along the wedge's rim turns right at the tip: the outside is on the left.
    ours = signed_distance(points, start, end, valid, previous, following)
    torch.testing.assert_close(ours, torch.full_like(ours, 3.0 * sign))
    if angle < 90:
        alone = signed_distance(points, start, end, valid)
        assert (alone.sign() != sign).any()


def test_no_segments():
    points = torch.zeros(2, 3, 2, requires_grad=True)
    none = torch.zeros(2, 0, 2)
    assert (signed_distance(points, none, none, torch.zeros(2, 0, dtype=torch.bool)) == NO_BOUNDARY).all()
    padded = torch.zeros(2, 4, 2)
    result = signed_distance(points, padded, padded, torch.zeros(2, 4, dtype=torch.bool))
    assert (result == NO_BOUNDARY).all()
    result.sum().backward()
    assert torch.equal(points.grad, torch.zeros(2, 3, 2))
    assert signed_distance(
        torch.zeros(2, 0, 2), padded, padded, torch.zeros(2, 4, dtype=torch.bool)
    ).shape == (2, 0)


def test_padding_and_batch_change_nothing():
    rng = np.random.default_rng(1)
    scenes = [segments([closed(star(rng, n, np.zeros(2), 5, 30))], torch.float32) for n in (5, 9, 17)]
    points = torch.tensor(rng.uniform(-30, 30, (3, 11, 2)), dtype=torch.float32)
    width = 25

    def pad(index, fill):
        rows = []
        for scene in scenes:
            value = scene[index][0]
            rows.append(torch.cat([value, value.new_full((width - len(value), *value.shape[1:]), fill)]))
        return torch.stack(rows)

    batch = pad(0, float("nan")), pad(1, float("nan")), pad(2, False), pad(3, 24), pad(4, -1)
    together = signed_distance(points, *batch)
    for b, scene in enumerate(scenes):
        assert torch.equal(together[b], signed_distance(points[b : b + 1], *scene)[0])


def test_blocks_change_nothing(monkeypatch):
    rng = np.random.default_rng(2)
    start = torch.tensor(rng.uniform(-50, 50, (5, 300, 2)), dtype=torch.float32)
    end = start + torch.tensor(rng.normal(0, 2, (5, 300, 2)), dtype=torch.float32)
    points = torch.tensor(rng.uniform(-50, 50, (5, 13, 2)), dtype=torch.float32)
    valid = torch.tensor(rng.random((5, 300)) < 0.8)
    whole = signed_distance(points, start, end, valid)
    for block in (1, 100, 5000, 10_000):
        monkeypatch.setattr(module, "_BLOCK", block)
        torch.testing.assert_close(signed_distance(points, start, end, valid), whole, atol=1e-4, rtol=0)


def test_rotation_and_translation():
    rng = np.random.default_rng(4)
    start, end, *rest = segments([closed(star(rng, 12, np.zeros(2), 5, 30))])
    points = torch.tensor(rng.uniform(-30, 30, (1, 40, 2)))
    turn, shift = torch.tensor(1.234, dtype=torch.float64), torch.tensor([400.0, -300.0], dtype=torch.float64)
    moved = [rotate(x, turn) + shift for x in (points, start, end)]
    torch.testing.assert_close(signed_distance(*moved, *rest), signed_distance(points, start, end, *rest))


def test_float32_far_out_is_within_a_millimetre():
    rng = np.random.default_rng(5)
    # Numbers that float32 holds exactly, and so many that some lie between two edges.
    ring, points = (
        np.round(8 * value) / 8 + np.array([3000.0, -2000.0])
        for value in (closed(star(rng, 80, np.zeros(2), 20, 90)), rng.uniform(-90, 90, (3000, 2)))
    )
    exact = signed_distance(torch.tensor(points)[None], *segments([ring]))
    single = signed_distance(
        torch.tensor(points, dtype=torch.float32)[None], *segments([ring], torch.float32)
    )
    torch.testing.assert_close(single.double(), exact, atol=1e-3, rtol=0)


def test_gradient():
    rng = np.random.default_rng(6)
    scene = segments([closed(star(rng, 9, np.zeros(2), 5, 30))])
    points = torch.tensor(rng.uniform(-30, 30, (1, 25, 2)), requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: signed_distance(p, *scene), (points,))
    (gradient,) = torch.autograd.grad(signed_distance(points, *scene).sum(), points)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(1, 25, dtype=torch.float64))


def test_gradient_on_the_line_and_at_a_corner():
    scene = segments([[[0, 0], [10, 0], [10, 10]]])
    points = torch.tensor([[[5.0, 0.0], [10.0, 0.0], [0.0, 0.0]]], dtype=torch.float64, requires_grad=True)
    distance = signed_distance(points, *scene)
    distance.sum().backward()
    torch.testing.assert_close(distance.detach(), torch.zeros(1, 3, dtype=torch.float64))
    assert torch.isfinite(points.grad).all()
    torch.testing.assert_close(points.grad[0, 0], torch.tensor([0.0, -1.0], dtype=torch.float64))


def test_segments_of_links_rings_and_continuing_lines():
    lines = [
        [[0, 0], [1, 0], [1, 0], [1, 1], [0, 0.0005]],  # a ring with a repeated point
        [[5, 5], [6, 5], [7, 5]],
        [[7, 5], [8, 5]],  # continues the line before
        [[9, 9], [8, 8]],
    ]
    points = np.concatenate([np.array(line, float) for line in lines])
    start, end, previous, following = segments_of(points, np.array([0, 5, 8, 10, 12]))
    assert len(start) == 7
    assert following.tolist() == [1, 2, 0, 4, 5, -1, -1]
    assert previous.tolist() == [2, 0, 1, -1, 3, 4, -1]
    np.testing.assert_array_equal(start[1:3], end[0:2])


def test_segments_of_does_not_guess_where_three_lines_meet():
    points = np.array([[0, 0], [1, 0], [1, 0], [2, 1], [1, 0], [2, -1]], float)
    _, _, previous, following = segments_of(points, np.array([0, 2, 4, 6]))
    assert (previous == -1).all()
    assert (following == -1).all()


def test_segments_of_nothing():
    start, end, previous, following = segments_of(np.zeros((0, 3)), np.zeros(1, np.int64))
    assert start.shape == end.shape == (0, 2)
    assert len(previous) == len(following) == 0
