"""Oriented boxes against shapely and against their own symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from symphony.geometry import box_corners, box_gap, boxes_overlap, rotate

coordinate = st.floats(-6, 6)
angle = st.floats(-7, 7)
side = st.floats(0.1, 6)
box = st.tuples(coordinate, coordinate, angle, side, side)


def tensors(*boxes):
    out = []
    for x, y, heading, length, width in boxes:
        out += [torch.tensor(v, dtype=torch.float64) for v in ([x, y], heading, [length, width])]
    return out


def random_pairs(count, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)

    def one():
        center = torch.rand(count, 2, generator=generator, dtype=torch.float64) * 8
        heading = torch.rand(count, generator=generator, dtype=torch.float64) * 14 - 7
        size = torch.rand(count, 2, generator=generator, dtype=torch.float64) * 5 + 0.1
        return [v.to(dtype) for v in (center, heading, size)]

    return [*one(), *one()]


def polygons(center, heading, size):
    return shapely.polygons(box_corners(center.double(), heading.double(), size.double()).numpy())


def minkowski_depth(a, b):
    """Distance from the origin to the edge of a - b: by how much overlapping convex shapes interpenetrate."""
    pa, pb = (shapely.get_coordinates(x)[:4] for x in (a, b))
    hull = shapely.convex_hull(shapely.multipoints((pa[:, None] - pb[None]).reshape(-1, 2)))
    return shapely.distance(shapely.Point(0, 0), hull.exterior)


def test_corner_order():
    corners = box_corners(torch.tensor([10.0, 20.0]), torch.tensor(math.pi / 2), torch.tensor([4.0, 2.0]))
    # Facing +y: front left is at smaller x and larger y.
    expected = torch.tensor([[9.0, 22.0], [9.0, 18.0], [11.0, 18.0], [11.0, 22.0]])
    torch.testing.assert_close(corners, expected)
    assert shapely.LinearRing(corners.numpy()).is_ccw


@settings(max_examples=200, deadline=None)
@given(box, box)
@example((0.0, 0.0, 0.0, 4.0, 2.0), (4.0, 1.0, math.pi / 2, 2.0, 4.0))  # they touch
@example(
    (0.0, 2.00001, 0.7061143561163341, 1.25, 1.25),
    (0.0, 2.00001, 0.7061143561163341, 5.193947124195385, 1.25),
)
def test_agrees_with_shapely(first, second):
    """Not with its areas of intersections: in the second example that is 0 or 1.56, by which box comes first."""
    args = tensors(first, second)
    a, b = polygons(*args[:3]), polygons(*args[3:])
    distance, depth = shapely.distance(a, b), minkowski_depth(a, b)
    gap = float(box_gap(*args))
    if distance > 1e-9:
        assert not boxes_overlap(*args)
        assert gap == pytest.approx(distance, abs=1e-9)
    else:
        assert gap == pytest.approx(-depth, abs=1e-8)
        assert boxes_overlap(*args) or depth < 1e-8


def test_agrees_with_shapely_on_many_float32_pairs():
    args = random_pairs(3000, dtype=torch.float32)
    a, b = polygons(*args[:3]), polygons(*args[3:])
    distance = shapely.distance(a, b)
    gap = box_gap(*args).numpy()
    assert 500 < (distance > 0).sum() < 2500
    np.testing.assert_allclose(np.maximum(gap, 0), distance, atol=2e-6)
    np.testing.assert_array_equal(boxes_overlap(*args).numpy(), gap < 0)
    clear = np.abs(gap) > 1e-5
    np.testing.assert_array_equal((gap < 0)[clear], (distance == 0)[clear])


def test_far_from_the_origin_float32_stays_precise():
    args = random_pairs(500, seed=3)
    shift = torch.tensor([12_000.0, -9_000.0])
    # Quantise first, so that both places hold exactly the same boxes.
    far = [(v.float() + shift) if i in (0, 3) else v.float() for i, v in enumerate(args)]
    near = [(v - shift) if i in (0, 3) else v for i, v in enumerate(far)]
    assert torch.equal(box_gap(*far), box_gap(*near))


@settings(max_examples=60, deadline=None)
@given(box, box, angle, coordinate, coordinate)
def test_invariant_under_rigid_motion_and_swap(first, second, turn, dx, dy):
    args = tensors(first, second)
    turn, shift = torch.tensor(turn, dtype=torch.float64), torch.tensor([dx, dy], dtype=torch.float64)
    moved = [rotate(v, turn) + shift if i in (0, 3) else v for i, v in enumerate(args)]
    moved[1], moved[4] = moved[1] + turn, moved[4] + turn
    gap = box_gap(*args)
    torch.testing.assert_close(box_gap(*moved), gap, atol=1e-9, rtol=0)
    torch.testing.assert_close(box_gap(*args[3:], *args[:3]), gap, atol=1e-9, rtol=0)
    assert boxes_overlap(*args) == boxes_overlap(*args[3:], *args[:3])


@settings(max_examples=60, deadline=None)
@given(box, box, angle, st.floats(0, 3))
def test_gap_changes_no_faster_than_the_box_moves(first, second, direction, step):
    args = tensors(first, second)
    gap = box_gap(*args)
    args[0] = args[0] + step * torch.tensor([math.cos(direction), math.sin(direction)], dtype=torch.float64)
    assert abs(box_gap(*args) - gap) <= step + 1e-9


def test_touching_boxes_do_not_overlap():
    zero, size = torch.tensor(0.0), torch.tensor([4.0, 2.0])
    here = torch.tensor([0.0, 0.0])
    for there in ([4.0, 0.0], [0.0, 2.0], [-4.0, 2.0]):
        pair = (here, zero, size, torch.tensor(there), zero, size)
        assert not boxes_overlap(*pair)
        assert box_gap(*pair) == 0
    assert boxes_overlap(here, zero, size, torch.tensor([3.99, 0.0]), zero, size)


def test_boxes_that_touch_but_for_rounding_are_as_near_in_single_precision_as_in_double():
    # Rounding may put a corner inside by one test and outside by another.
    generator = torch.Generator().manual_seed(0)
    center, size, other = (torch.rand(20_000, 2, generator=generator) * scale for scale in (100, 4, 4))
    heading, turn = torch.rand(2, 20_000, generator=generator)
    size, other = size + 0.5, other + 0.5
    reach = size[:, 0] + other[:, 0] * turn.cos() + other[:, 1] * turn.sin()
    way = torch.stack((heading.cos(), heading.sin()), -1) * (reach / 2)[:, None]
    boxes = (center, heading, size, center + way, heading + turn, other)
    exact = box_gap(*(value.double() for value in boxes))
    torch.testing.assert_close(box_gap(*boxes).double(), exact, atol=1e-5, rtol=0)


def test_boxes_without_area():
    zero, size, point = torch.tensor(0.0), torch.tensor([4.0, 2.0]), torch.zeros(2)
    assert boxes_overlap(torch.zeros(2), zero, size, torch.tensor([1.0, 0.5]), zero, point)
    assert not boxes_overlap(torch.zeros(2), zero, size, torch.tensor([2.0, 0.5]), zero, point)
    assert not boxes_overlap(torch.zeros(2), zero, point, torch.zeros(2), zero, point)


def test_broadcasts_like_the_loop():
    args = random_pairs(6, seed=1)
    table = box_gap(*(v[:, None] for v in args[:3]), *(v[None] for v in args[3:]))
    assert table.shape == (6, 6)
    for i in range(6):
        for j in range(6):
            assert table[i, j] == box_gap(*(v[i] for v in args[:3]), *(v[j] for v in args[3:]))


def test_gradients():
    args = [v[:20].clone().requires_grad_() for v in random_pairs(40, seed=5)]
    assert torch.autograd.gradcheck(box_gap, tuple(args))


def test_gradients_are_finite_at_degenerate_places():
    center = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 0.0]], requires_grad=True)
    heading = torch.zeros(4, requires_grad=True)
    size = torch.tensor([[4.0, 2.0], [4.0, 2.0], [4.0, 2.0], [0.0, 0.0]], requires_grad=True)
    other = torch.zeros(4, 2), torch.zeros(4), torch.tensor([[4.0, 2.0]] * 3 + [[0.0, 0.0]])
    box_gap(center, heading, size, *other).sum().backward()
    for value in (center, heading, size):
        assert torch.isfinite(value.grad).all()
