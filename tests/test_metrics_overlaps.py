"""Collisions against shapely and by hand."""

from __future__ import annotations

import math

import numpy as np
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from symphony.geometry import box_corners
from symphony.metrics import collisions


def scene(seed, lead=(2,), agents=7, steps=5, spread=14.0):
    rng = np.random.default_rng(seed)
    position = torch.tensor(rng.uniform(0, spread, (*lead, agents, steps, 2)))
    heading = torch.tensor(rng.uniform(-7, 7, (*lead, agents, steps)))
    size = torch.tensor(rng.uniform(0.4, 5, (*lead, agents, 2)))
    valid = torch.tensor(rng.random((*lead, agents, steps)) < 0.7)
    subject = torch.tensor(np.stack([rng.permutation(agents)[:3] for _ in range(math.prod(lead))]))
    return position, heading, size, valid, subject.reshape(*lead, 3)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_collisions_agree_with_shapely(seed):
    position, heading, size, valid, subject = scene(seed)
    boxes = shapely.polygons(box_corners(position, heading, size[..., None, :]).numpy())
    found = collisions(position, heading, size, valid, subject, at_states=True)
    assert found.shape == (2, 3, 5)
    for b, n, t in np.ndindex(2, 3, 5):
        me = int(subject[b, n])
        others = [k for k in range(7) if k != me and valid[b, k, t]]
        area = [shapely.area(shapely.intersection(boxes[b, me, t], boxes[b, k, t])) for k in others]
        expected = bool(valid[b, me, t]) and max(area, default=0) > 0
        if not 0 < max(area, default=0) < 1e-9:
            assert found[b, n, t] == expected


def test_collisions_by_hand():
    """Three cars in a row: the first two overlap by 12.5 cm at step 1, the last one only touches."""
    position = torch.zeros(3, 2, 2)
    position[1, :, 0] = torch.tensor([6.0, 4.375])
    position[2, :, 0] = torch.tensor([10.5, 8.875])
    heading, size = torch.zeros(3, 2), torch.tensor([[4.5, 2.0]]).expand(3, 2)
    valid, subject = torch.ones(3, 2, dtype=torch.bool), torch.tensor([0, 1, 2])
    found = collisions(position, heading, size, valid, subject, at_states=True)
    assert found.tolist() == [[False, True], [False, True], [False, False]]
    assert collisions(position, heading, size, valid, subject).tolist() == [[True], [True], [False]]
    valid[1, 1] = False
    assert not collisions(position, heading, size, valid, subject).any()


def test_on_another_level_is_so_both_before_and_after_a_step():
    position, heading = torch.zeros(2, 2, 2), torch.zeros(2, 2)
    size, valid, subject = torch.tensor([[4.5, 2.0]]).expand(2, 2), torch.ones(2, 2).bool(), torch.tensor([0])
    level = torch.tensor([[[0.0, 1], [0, 1]], [[6, 2], [6, 2]]])
    for before, after, z in ((2, 2, 6.0), (1, 2, 6.0), (2, 1, 6.0), (0, 0, 6.0), (2, 2, 2.4)):
        level[1] = torch.tensor([[z, before], [z, after]])
        met = (before, after, z) != (2, 2, 6.0)
        assert collisions(position, heading, size, valid, subject, level).tolist() == [[met]]
        at_states = collisions(position, heading, size, valid, subject, level, at_states=True)
        assert at_states.tolist() == [[z < 6 or number < 2 for number in (before, after)]]
    # Who was not there before is where it is now.
    valid[1, 0] = False
    level[1] = torch.tensor([[0.0, 0], [6, 2]])
    assert not collisions(position, heading, size, valid, subject, level).any()


def test_padding_and_order_of_agents_change_nothing():
    position, heading, size, valid, subject = scene(3)
    found = collisions(position, heading, size, valid, subject)
    assert found.any()
    order = torch.tensor([4, 2, 6, 0, 1, 5, 3])
    place = torch.argsort(order)
    pad = [torch.cat([x[:, order], x[:, :2]], 1) for x in (position, heading, size, valid)]
    pad[3][:, -2:] = False
    pad[0][:, -2:] = torch.nan
    shuffled = torch.cat([place[subject], torch.full((2, 1), -1)], 1)
    again = collisions(pad[0], pad[1], pad[2], pad[3], shuffled)
    assert torch.equal(again[:, :3], found)
    assert not again[:, 3].any()


def test_leading_dimensions_broadcast():
    position, heading, size, valid, subject = scene(4, lead=(2, 3))
    whole = collisions(position, heading, size[:, :1], valid, subject[:, :1])
    assert whole.shape == (2, 3, 3, 4)
    for b, k in np.ndindex(2, 3):
        one = collisions(position[b, k], heading[b, k], size[b, 0], valid[b, k], subject[b, 0])
        assert torch.equal(whole[b, k], one)
