"""Boxes, contacts, frames and oriented lines against shapely and against their own symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from symphony import geometry
from symphony.geometry.frames import forward_speed, with_speed

coordinate, angle, side = (st.floats(*ends) for ends in ((-6, 6), (-7, 7), (0.1, 6)))
box = st.tuples(coordinate, coordinate, angle, side, side)


def tensors(*boxes):
    out = []
    for x, y, heading, length, width in boxes:
        out += [torch.tensor(v, dtype=torch.float64) for v in ([x, y], heading, [length, width])]
    return out


def polygons(center, heading, size):
    return shapely.polygons(geometry.box_corners(center.double(), heading.double(), size.double()).numpy())


def minkowski_depth(a, b):
    """Distance from the origin to the edge of a - b: by how much overlapping convex shapes interpenetrate."""
    pa, pb = (shapely.get_coordinates(x)[:4] for x in (a, b))
    hull = shapely.convex_hull(shapely.multipoints((pa[:, None] - pb[None]).reshape(-1, 2)))
    return shapely.distance(shapely.Point(0, 0), hull.exterior)


def test_corner_order():
    corners = geometry.box_corners(*tensors((10.0, 20.0, math.pi / 2, 4.0, 2.0)))
    # Facing +y: front left is at smaller x and larger y.
    np.testing.assert_allclose(corners, [[9.0, 22.0], [9.0, 18.0], [11.0, 18.0], [11.0, 22.0]])
    assert shapely.LinearRing(corners.numpy()).is_ccw


WITHIN = (0.0, 2.00001, 0.7061143561163341)


@settings(max_examples=50, deadline=None)
@given(box, box)
@example((0.0, 0.0, 0.0, 4.0, 2.0), (4.0, 1.0, math.pi / 2, 2.0, 4.0))  # they touch
@example((*WITHIN, 1.25, 1.25), (*WITHIN, 5.193947124195385, 1.25))
def test_agrees_with_shapely(first, second):
    """Not with its areas of intersections: in the second example that is 0 or 1.56, by which box comes first."""
    args = tensors(first, second)
    a, b = polygons(*args[:3]), polygons(*args[3:])
    distance, depth = shapely.distance(a, b), minkowski_depth(a, b)
    gap = float(geometry.box_gap(*args))
    if distance > 1e-9:
        assert not geometry.boxes_overlap(*args)
        assert gap == pytest.approx(distance, abs=1e-9)
    else:
        assert gap == pytest.approx(-depth, abs=1e-8)
        assert geometry.boxes_overlap(*args) or depth < 1e-8


@settings(max_examples=30, deadline=None)
@given(box, box, angle, coordinate, coordinate)
def test_invariant_under_rigid_motion_and_swap(first, second, turn, dx, dy):
    args = tensors(first, second)
    turn, shift = torch.tensor(turn, dtype=torch.float64), torch.tensor([dx, dy], dtype=torch.float64)
    moved = [geometry.rotate(v, turn) + shift if i in (0, 3) else v for i, v in enumerate(args)]
    moved[1], moved[4] = moved[1] + turn, moved[4] + turn
    gap = geometry.box_gap(*args)
    torch.testing.assert_close(geometry.box_gap(*moved), gap, atol=1e-9, rtol=0)
    torch.testing.assert_close(geometry.box_gap(*args[3:], *args[:3]), gap, atol=1e-9, rtol=0)
    assert geometry.boxes_overlap(*args) == geometry.boxes_overlap(*args[3:], *args[:3])


def test_boxes_that_touch_but_for_rounding_are_as_near_in_single_precision_as_in_double():
    # Rounding may put a corner inside by one test and outside by another.
    generator = torch.Generator().manual_seed(0)
    center, size, other = (torch.rand(20_000, 2, generator=generator) * scale for scale in (100, 4, 4))
    heading, turn = torch.rand(2, 20_000, generator=generator)
    size, other = size + 0.5, other + 0.5
    reach = size[:, 0] + other[:, 0] * turn.cos() + other[:, 1] * turn.sin()
    way = torch.stack((heading.cos(), heading.sin()), -1) * (reach / 2)[:, None]
    boxes = (center, heading, size, center + way, heading + turn, other)
    exact = geometry.box_gap(*(value.double() for value in boxes))
    torch.testing.assert_close(geometry.box_gap(*boxes).double(), exact, atol=1e-5, rtol=0)


def test_boxes_without_area():
    zero, size, point = torch.tensor(0.0), torch.tensor([4.0, 2.0]), torch.zeros(2)
    assert geometry.boxes_overlap(torch.zeros(2), zero, size, torch.tensor([1.0, 0.5]), zero, point)
    assert not geometry.boxes_overlap(torch.zeros(2), zero, size, torch.tensor([2.0, 0.5]), zero, point)
    assert not geometry.boxes_overlap(torch.zeros(2), zero, point, torch.zeros(2), zero, point)


def test_gradients():
    rng = np.random.default_rng(5)
    kinds = 2 * [(0, 8, (20, 2)), (-7, 7, 20), (0.1, 5.1, (20, 2))]
    args = [torch.tensor(rng.uniform(*kind), requires_grad=True) for kind in kinds]
    assert torch.autograd.gradcheck(geometry.box_gap, tuple(args))


def test_gradients_are_finite_at_degenerate_places():
    center = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 0.0]], requires_grad=True)
    heading = torch.zeros(4, requires_grad=True)
    size = torch.tensor([[4.0, 2.0], [4.0, 2.0], [4.0, 2.0], [0.0, 0.0]], requires_grad=True)
    other = torch.zeros(4, 2), torch.zeros(4), torch.tensor([[4.0, 2.0]] * 3 + [[0.0, 0.0]])
    geometry.box_gap(center, heading, size, *other).sum().backward()
    for value in (center, heading, size):
        assert torch.isfinite(value.grad).all()


FINE = 1000
poses = st.tuples(coordinate, coordinate, st.floats(-4, 4))
sizes = st.tuples(st.floats(0.4, 6), st.floats(0.4, 3))


@settings(max_examples=30)
@given(poses, poses, poses, poses, st.tuples(sizes, sizes), st.floats(0, 0.4))
def test_a_contact_is_where_many_small_steps_find_one(a, b, c, d, size, turn):
    ways = torch.tensor([[a, (*b[:2], a[2] + turn)], [c, (*d[:2], c[2] - turn)]], dtype=torch.float64)
    size = torch.tensor(size, dtype=torch.float64)
    boxes = [part for k in (0, 1) for part in (ways[k, :, :2], ways[k, :, 2], size[k])]
    found = float(geometry.contact_share(*boxes))
    many = ways[:, None].expand(2, FINE + 1, 2, 3)
    times = torch.linspace(0, 1, FINE + 1, dtype=torch.float64).expand(2, -1)
    extents = size[:, None].expand(2, FINE + 1, 2)
    shapes = polygons(*geometry.pose_at(many[..., :2], many[..., 2], times), extents)
    # Without a grid shapely finds no area shared by boxes of which one covers the other to the last bit.
    shared = shapely.area(shapely.intersection(*shapes, grid_size=1e-9))
    apart, deep = shapely.distance(*shapes), shared > 1e-9
    if deep[0]:
        # In contact from the beginning, or parting.
        assert found == (0 if deep[-1] else math.inf)
        return
    # Turning boxes are found within a centimetre, which a step here may be, too.
    speed = sum(float((way[1, :2] - way[0, :2]).norm()) + 4 * turn for way in ways)
    slack = 0.01 + speed / FINE
    if found < math.inf:
        k = max(int(found * FINE) - 1, 0)
        assert apart[k : k + 4].min() <= slack
        assert apart[:k].min(initial=math.inf) > 0 or shared[:k].max() < 6 * slack
    else:
        # What is missed is a graze.
        assert not deep.any() or shared.max() < 6 * slack


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrap_range_and_congruence(dtype):
    """Also where rounding leaves the quotient on the wrong side of a whole number, next to the ends of many turns."""
    ends = torch.cat([torch.arange(-9, 10), torch.arange(-20_001, 20_001, 2)]).double() * math.pi
    base = torch.cat([ends, torch.tensor([0.0, -1e-12, 1e-12, -1e-30]), torch.linspace(-50, 50, 997)])
    far = torch.full_like(base := base.to(dtype), torch.inf)
    angle = torch.cat([base, base.nextafter(far), base.nextafter(-far)])
    wrapped = geometry.wrap(angle)
    assert (wrapped >= -math.pi - 1e-6).all()
    assert (wrapped <= math.pi).all()
    turns = (angle - wrapped).double() / (2 * math.pi)
    assert ((turns - turns.round()).abs() <= 1e-5 + angle.abs() * torch.finfo(dtype).eps).all()
    near = angle.abs() < 60
    assert ((wrapped >= -math.pi) & (wrapped < math.pi))[near].all()
    inside = (angle >= -math.pi) & (angle < math.pi)
    assert torch.equal(wrapped[inside], angle[inside])


def test_rotation_keeps_distances_and_its_inverse_turns_back():
    quarter = geometry.rotate(torch.tensor([2.0, 1.0]), torch.tensor(math.pi / 2))
    torch.testing.assert_close(quarter, torch.tensor([-1.0, 2.0]))
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(3, 5, 7, 2, generator=generator, dtype=torch.float64) * 100
    angle = torch.randn(3, 5, 1, generator=generator, dtype=torch.float64) * 9
    turned = geometry.rotate(points, angle)
    torch.testing.assert_close(geometry.rotate(turned, -angle), points)
    torch.testing.assert_close(turned.norm(dim=-1), points.norm(dim=-1))
    one = points[0, 0].requires_grad_(), angle[0, 0].requires_grad_()
    assert torch.autograd.gradcheck(geometry.rotate, one)


def test_speed_is_what_of_a_velocity_points_ahead():
    generator = torch.Generator().manual_seed(0)
    moving = torch.randn(7, 5, generator=generator, dtype=torch.float64)
    heading, velocity = moving[:, 2], moving[:, 3:]
    speed = forward_speed(velocity, heading)
    torch.testing.assert_close(speed, geometry.rotate(velocity, -heading)[:, 0])
    torch.testing.assert_close(with_speed(moving), torch.cat([moving[:, :3], speed[:, None]], 1))


def segments(lines, dtype=torch.float64):
    """start, end, valid, previous, following of one scene [1, E]."""
    points = np.concatenate([np.asarray(line, float) for line in lines])
    offsets = np.cumsum([0, *(len(line) for line in lines)])
    start, end, previous, following = geometry.segments_of(points, offsets)
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


@settings(max_examples=30, deadline=None)
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
    polygon = shapely.orient_polygons(polygon)
    scene = segments([np.asarray(ring.coords) for ring in (polygon.exterior, *polygon.interiors)])
    ours = geometry.signed_distance(torch.tensor(points)[None], *scene)[0].numpy()
    expected = shapely.distance(polygon.boundary, shapely.points(points))
    expected[shapely.contains(polygon, shapely.points(points))] *= -1
    np.testing.assert_allclose(np.abs(ours), np.abs(expected), atol=1e-9)
    # shapely may leave slivers thinner than rounding between touching rings.
    clear = np.abs(expected) > 1e-6
    np.testing.assert_array_equal(ours[clear] > 0, expected[clear] > 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("coordinate", [0, 1])
def test_a_point_that_is_not_finite_has_no_finite_distance_and_changes_no_other(bad, coordinate):
    square = segments([closed(np.array([[0.0, 0], [40, 0], [40, 30], [0, 30]]))])
    points = torch.tensor([[[20.0, 3], [50, 20], [0, 0], [39, 31]]], dtype=torch.float64)
    alone = geometry.signed_distance(points, *square)
    broken = torch.cat([points[:, :2], points[:, :1], points[:, 2:]], 1)
    broken[0, 2, coordinate] = bad
    found = geometry.signed_distance(broken, *square)
    assert not found[0, 2].isfinite()
    torch.testing.assert_close(found[:, [0, 1, 3, 4]], alone, atol=1e-12, rtol=0)
    assert not geometry.signed_distance(broken[:, 2:3], *square).isfinite().any()


def test_no_segments():
    points = torch.zeros(2, 3, 2, requires_grad=True)
    for count in (0, 4):
        nothing, valid = torch.zeros(2, count, 2), torch.zeros(2, count, dtype=torch.bool)
        distance = geometry.signed_distance(points, nothing, nothing, valid)
        assert (distance == geometry.NO_BOUNDARY).all()
        assert geometry.signed_distance(points[:, :0], nothing, nothing, valid).shape == (2, 0)
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    assert not gradient.any()


def test_float32_far_out_is_within_a_millimetre():
    rng = np.random.default_rng(5)
    # Numbers that float32 holds exactly, and so many that some lie between two edges.
    ring, points = (
        np.round(8 * value) / 8 + np.array([3000.0, -2000.0])
        for value in (closed(star(rng, 80, np.zeros(2), 20, 90)), rng.uniform(-90, 90, (3000, 2)))
    )
    exact, single = (
        geometry.signed_distance(torch.tensor(points, dtype=kind)[None], *segments([ring], kind)).double()
        for kind in (torch.float64, torch.float32)
    )
    torch.testing.assert_close(single, exact, atol=1e-3, rtol=0)


def test_gradient():
    rng = np.random.default_rng(6)
    scene = segments([closed(star(rng, 9, np.zeros(2), 5, 30))])
    points = torch.tensor(rng.uniform(-30, 30, (1, 25, 2)), requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: geometry.signed_distance(p, *scene), (points,))
    (gradient,) = torch.autograd.grad(geometry.signed_distance(points, *scene).sum(), points)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(1, 25, dtype=torch.float64))


def test_gradient_on_the_line_and_at_a_corner():
    scene = segments([[[0, 0], [10, 0], [10, 10]]])
    points = torch.tensor([[[5.0, 0.0], [10.0, 0.0], [0.0, 0.0]]], dtype=torch.float64, requires_grad=True)
    distance = geometry.signed_distance(points, *scene)
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
    start, end, previous, following = geometry.segments_of(points, np.array([0, 5, 8, 10, 12]))
    assert len(start) == 7
    assert following.tolist() == [1, 2, 0, 4, 5, -1, -1]
    assert previous.tolist() == [2, 0, 1, -1, 3, 4, -1]
    np.testing.assert_array_equal(start[1:3], end[0:2])


def test_segments_of_does_not_guess_where_three_lines_meet():
    points = np.array([[0, 0], [1, 0], [1, 0], [2, 1], [1, 0], [2, -1]], float)
    _, _, previous, following = geometry.segments_of(points, np.array([0, 2, 4, 6]))
    assert (previous == -1).all()
    assert (following == -1).all()
