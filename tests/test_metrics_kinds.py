"""Collisions against shapely and by hand; their kinds: staged ones, and what must not change them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from symphony.geometry import box_corners
from symphony.metrics import CollisionKind, collision_kinds, collisions

KIND = CollisionKind
STEPS, DT = 10, 0.2


def stage(*agents, subjects=(0,), size=(4.5, 2.0)):
    """Agents (x, y, heading in degrees, speed) that drive straight on, as the arguments of `collision_kinds`."""
    start = torch.tensor(agents, dtype=torch.float64)
    heading = start[:, 2].deg2rad()
    velocity = start[:, 3, None] * torch.stack([heading.cos(), heading.sin()], -1)
    time = DT * torch.arange(STEPS + 1)
    position = start[:, None, :2] + time[:, None] * velocity[:, None]
    moving = torch.cat([heading[:, None], velocity], -1)[:, None].expand(-1, STEPS + 1, -1)
    log = torch.cat([position, moving], -1)
    sizes = torch.tensor(size, dtype=torch.float64).expand(len(agents), 2)
    return scene(log, start[:, 3, None].expand(-1, STEPS + 1), sizes, torch.tensor(subjects))


def scene(log, speed, size, subject):
    """With the flags that belong to it."""
    valid = torch.ones(log.shape[:-1], dtype=torch.bool)
    flags = collisions(log[..., :2], log[..., 2], size, valid, subject)
    state = torch.cat([log[..., :3], speed[..., None]], -1)
    rows = subject.clamp(min=0)[..., None]
    exists = (subject >= 0)[..., None].expand(*subject.shape, log.shape[-2])
    return {
        "collided": flags, "state": torch.take_along_dim(state, rows[..., None], -3), "exists": exists,
        "subject": subject, "log_state": log, "log_valid": valid, "size": size,
        "agent_type": torch.ones(size.shape[:-1], dtype=torch.int64),
    }  # fmt: skip


def kinds_of(*agents, **arguments):
    return collision_kinds(**stage(*agents, **arguments)).kind.tolist()


EGO = (0.0, 0.0, 0.0, 10.0)
CASES = {
    "into a slow leader": ([EGO, (12, 0, 0, 2)], KIND.INTO_LEADER, KIND.REAR_ENDED),
    "into a standing leader, half beside it": ([EGO, (12, 1.2, 0, 0)], KIND.INTO_LEADER, KIND.REAR_ENDED),
    "into one that turns off": ([EGO, (10, 1, 40, 3)], KIND.INTO_LEADER, KIND.REAR_ENDED),
    "at a speed of 5 m a step": ([(0, 0, 0, 25), (9, 0, 0, 0)], KIND.INTO_LEADER, KIND.REAR_ENDED),
    "head on": ([EGO, (20, 0.5, 180, 8)], KIND.ONCOMING, KIND.ONCOMING),
    "into the oncoming lane": ([(0, 0, 5, 10), (20, 2.6, 180, 8)], KIND.ONCOMING, KIND.ONCOMING),
    "crossing from the right": ([EGO, (10, -10, 90, 10)], KIND.CROSSING, KIND.CROSSING),
    "crossing, hit in the flank": ([(0, 0, 0, 5), (6, 10, -90, 10)], KIND.CROSSING, KIND.CROSSING),
    "into one that stands across": ([EGO, (12, 1, 100, 0)], KIND.CROSSING, KIND.CROSSING),
    "changing lane": ([(0, 0, 10, 10), (0.5, 3, 0, 10)], KIND.SIDESWIPE, KIND.SIDESWIPE),
    "changing lane into a tail": ([(0, 0, 8, 12), (9, 3.2, 0, 4)], KIND.INTO_LEADER, KIND.REAR_ENDED),
    "backing into one that stands": ([(0, 0, 0, -2), (-6, 0, 0, 0)], KIND.OTHER, KIND.OTHER),
    "into one that backs": ([EGO, (14, 0, 0, -2)], KIND.INTO_LEADER, KIND.REAR_ENDED),
}


@pytest.mark.parametrize(("agents", "kind", "other"), CASES.values(), ids=CASES)
def test_staged(agents, kind, other):
    """Also mirrored, and seen by the other."""
    assert (kinds_of(*agents), kinds_of(*agents, subjects=(1, 0))) == ([kind], [other, kind])
    assert kinds_of(*[(x, -y, -h, v) for x, y, h, v in agents], subjects=(1, 0)) == [other, kind]


def test_the_record_of_one_collision():
    # The leader's tail is 7.5 m ahead: closing at 8 m/s they meet within step 4 (from 0), the fifth.
    agents = (12, 0, 0, 2), (0, 50, 0, 0), EGO
    inputs = stage(*agents, subjects=(2, 1))
    assert inputs["collided"][0].int().argmax() == 4
    found = collision_kinds(**inputs)
    assert [value.tolist() for value in found] == [[KIND.INTO_LEADER, -1], [4, -1], [0, -1], [True, False]]
    found = collision_kinds(**stage(*agents, subjects=(2, 1, 0, -1)))
    assert (found.other.tolist(), found.playback.tolist()) == ([0, -1, 2, -1], [False] * 4)


def test_the_first_collision_counts_and_of_several_the_deepest():
    # Rear-ended at once, pushed nowhere, into the leader later.
    found = collision_kinds(**stage((0, 0, 0, 10), (-6, 0, 0, 24), (20, 0, 0, 0)))
    assert (found.kind.tolist(), found.other.tolist()) == ([KIND.REAR_ENDED], [1])
    # Of one step: a tail grazed by 0.1 m after 0.3 of it, one met squarely after 0.8, which is 1 m deep at its end.
    found = collision_kinds(**stage((0, 0, 0, 25), (6, 1.9, 0, 0), (8.5, -0.5, 0, 0)))
    assert (found.step.tolist(), found.other.tolist()) == ([0], [1])
    # At the same step: 0.1 m into the flank of one, half a metre into the tail of the other.
    found = collision_kinds(**stage((0, 0, 0, 5), (5, 0, 0, 0), (0, 3.9, -90, 5), size=(4.5, 2.0)))
    assert (found.kind.tolist(), found.other.tolist()) == ([KIND.INTO_LEADER], [1])


@pytest.mark.parametrize("appears", [True, False])
def test_without_a_state_before_contact_the_one_at_contact_decides(appears):
    """Where an agent appears at contact, or two overlap from the start."""
    inputs = stage((0, 0, 0, 0), (4.3, 0.2, 0, 0), subjects=(0, 1))
    if appears:
        inputs["exists"], inputs["collided"] = inputs["exists"].clone(), inputs["collided"].clone()
        inputs["exists"][1, :4] = False
        inputs["collided"][:, :3] = False
    assert collision_kinds(**inputs).kind.tolist() == [KIND.INTO_LEADER, KIND.REAR_ENDED]
    assert kinds_of((0, 0, 0, 0), (0.2, 1.9, 0, 0), subjects=(0, 1)) == [KIND.SIDESWIPE] * 2


def crowd(seed, lead=(3, 4), agents=6, subjects=3):
    """Agents that drive through each other at random."""
    rng = np.random.default_rng(seed)
    speed = torch.tensor(rng.uniform(-1, 12, (*lead, agents)))
    turn = torch.tensor(rng.uniform(-0.3, 0.3, (*lead, agents)))[..., None] * DT * torch.arange(STEPS + 1)
    heading = torch.tensor(rng.uniform(-4, 4, (*lead, agents)))[..., None] + turn
    velocity = speed[..., None, None] * torch.stack([heading.cos(), heading.sin()], -1)
    position = torch.tensor(rng.uniform(0, 32, (*lead, agents, 1, 2))) + DT * velocity.cumsum(-2)
    log = torch.cat([position, heading[..., None], velocity], -1)
    size = torch.tensor(rng.uniform((3.5, 1.6), (8, 2.4), (*lead, agents, 2)))
    subject = torch.tensor(np.stack([rng.permutation(agents)[:subjects] for _ in range(math.prod(lead))]))
    return scene(log, speed[..., None].expand(heading.shape), size, subject.reshape(*lead, subjects))


@given(st.integers(0, 2**32 - 1))
def test_every_first_collision_has_a_kind(seed):
    inputs = crowd(seed)
    found = collision_kinds(**inputs)
    hit = inputs["collided"].any(-1)
    assert torch.equal(found.kind >= 0, hit)
    assert torch.equal(found.step[hit], inputs["collided"].int().argmax(-1)[hit])
    assert (found.step[~hit] == -1).all()
    assert (found.other[hit] != inputs["subject"][hit]).all()
    listed = (found.other[..., None] == inputs["subject"][..., None, :]).any(-1)
    assert torch.equal(found.playback, hit & ~listed)


@given(st.integers(0, 2**32 - 1), st.floats(-3, 3), st.booleans())
def test_rotation_shift_and_mirror_change_nothing(seed, angle, mirror):
    inputs = crowd(seed)
    moved, sign = dict(inputs), -1.0 if mirror else 1.0
    c, s = math.cos(angle), math.sin(angle)
    # Headings turn by the angle after the mirror; speeds stay.
    matrix = torch.tensor([[c, -s], [s, c]], dtype=torch.float64) * torch.tensor([1.0, sign])
    shift = torch.tensor([70.0, -30.0], dtype=torch.float64)
    for name in ("state", "log_state"):
        old = inputs[name]
        parts = [old[..., :2] @ matrix.T + shift, sign * old[..., 2:3] + angle]
        parts.append(old[..., 3:] @ matrix.T if name == "log_state" else old[..., 3:])
        moved[name] = torch.cat(parts, -1)
    for a, b in zip(collision_kinds(**inputs), collision_kinds(**moved), strict=True):
        assert torch.equal(a, b)


@given(st.integers(0, 2**32 - 1))
def test_two_agents_agree_on_what_they_did(seed):
    found = collision_kinds(**crowd(seed, lead=(40,), agents=2, subjects=2))
    one, two = found.kind.unbind(-1)
    swapped = one.clone()
    swapped[one == KIND.INTO_LEADER], swapped[one == KIND.REAR_ENDED] = KIND.REAR_ENDED, KIND.INTO_LEADER
    assert torch.equal(two, swapped)
    kind, playback = found.first()
    assert not playback.any()
    assert torch.equal(kind, torch.where(kind == KIND.REAR_ENDED, -1, torch.minimum(one, two)))


def test_padding_order_and_batch_change_nothing():
    inputs = crowd(5)
    found = collision_kinds(**inputs)
    assert len(found.kind.unique()) > 3
    assert set(found.playback[found.kind >= 0].tolist()) == {True, False}
    for b, k in np.ndindex(3, 4):
        one = collision_kinds(**{name: value[b, k] for name, value in inputs.items()})
        assert all(torch.equal(a[b, k], x) for a, x in zip(found, one, strict=True))
    # Agents in another order with two more that are never valid, and subjects with two more that are none.
    order = torch.tensor([4, 2, 0, 1, 5, 3])
    place = torch.argsort(order)
    rows = {name: inputs[name] for name in ("log_state", "log_valid", "size", "agent_type")}
    changed = {name: torch.cat([value[:, :, order], value[:, :, :2]], 2) for name, value in rows.items()}
    changed["log_valid"][:, :, 6:] = False
    changed["log_state"][:, :, 6:] = torch.nan
    changed["subject"] = torch.cat([place[inputs["subject"]], torch.full((3, 4, 2), -1)], -1)
    for name in ("state", "exists", "collided"):
        changed[name] = torch.cat([inputs[name], inputs[name][:, :, :2]], 2)
    changed["collided"][:, :, 3:], changed["exists"][:, :, 3:] = False, False
    again = collision_kinds(**changed)
    for name, value in again._asdict().items():
        expected = getattr(found, name)
        if name == "other":
            expected = torch.where(expected < 0, -1, place[expected])
        assert torch.equal(value[..., :3], expected), name
        assert (value[..., 3:] <= 0).all()


def test_flags_that_are_not_those_of_the_states_are_refused():
    inputs = stage(EGO, (12, 30, 0, 2), subjects=(0, -1))
    flags = torch.zeros(2, STEPS, dtype=torch.bool)
    assert not inputs["collided"].any()
    flags[0, 3] = True
    with pytest.raises(ValueError, match=r"28\.\d+ m away from all others"):
        collision_kinds(**{**inputs, "collided": flags})


def test_nobody_meets_whom_is_on_another_level():
    """The ego meets a leader on its road while one on a bridge lies nearer and deeper in it."""
    inputs = stage((0, 0, 0, 10), (2, 1, -90, 0), (6, 0, 0, 0))
    level = torch.tensor([[0.0, 1], [6, 2], [0, 1]])[:, None].expand(3, STEPS + 1, 2)
    found = collision_kinds(**inputs, height=(level[:1], level))
    assert (found.other.tolist(), found.kind.tolist()) == ([2], [KIND.INTO_LEADER])
    low, first, second = level.clone(), level.clone(), level.clone()
    low[1, :, 0] = 2.4
    # Of a step, both ends must be on another level.
    first[1, 1:], second[1, :1], second[1, 2:] = level[0, 0], level[0, 0], level[0, 0]
    for height in (None, *((each[:1], each) for each in (low, first, second))):
        assert collision_kinds(**inputs, height=height).other.tolist() == [1]
    # Who was not there before is where it is now.
    inputs["log_valid"][1, 0], second[1, 1:] = False, level[1, 0]
    assert collision_kinds(**inputs, height=(second[:1], second)).other.tolist() == [2]


@pytest.mark.parametrize("name", list(CASES)[::4])
def test_the_others_type_names_the_kind(name):
    agents, kind, _ = CASES[name]
    for other, expected in enumerate((kind, kind, KIND.PEDESTRIAN, KIND.CYCLIST, kind)):
        types = torch.full((len(agents),), other)
        types[0] = 1
        found = collision_kinds(**stage(*agents) | {"agent_type": types})
        assert found.kind.tolist() == [int(expected)], other


def boxes(seed, lead=(2,), agents=7, steps=5, spread=14.0):
    """Position, heading, size and valid of boxes at random, and three of them in each scene."""
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
    position, heading, size, valid, subject = boxes(seed)
    shapes = shapely.polygons(box_corners(position, heading, size[..., None, :]).numpy())
    found = collisions(position, heading, size, valid, subject, at_states=True)
    assert found.shape == (2, 3, 5)
    for b, n, t in np.ndindex(2, 3, 5):
        me = int(subject[b, n])
        others = [k for k in range(7) if k != me and valid[b, k, t]]
        area = max(shapely.area(shapely.intersection(shapes[b, me, t], shapes[b, others, t])), default=0)
        if not 0 < area < 1e-9:
            assert found[b, n, t] == (bool(valid[b, me, t]) and area > 0)
    # Between states nothing is lost that states show.
    assert (collisions(position, heading, size, valid, subject) | ~found[..., 1:]).all()


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
    for there, end in ([True, False], 4.375), ([False, True], -4.7):  # gone, or not there yet on the other side
        valid[1], position[1, 1, 0] = torch.tensor(there), end
        assert not collisions(position, heading, size, valid, subject).any()


def test_on_another_level_is_so_both_before_and_after_a_step():
    position, heading = torch.zeros(2, 2, 2), torch.zeros(2, 2)
    size = torch.tensor([[4.5, 2.0]]).expand(2, 2)
    given = position, heading, size, torch.ones(2, 2).bool(), torch.tensor([0])
    level = torch.tensor([[[0.0, 1], [0, 1]], [[6, 2], [6, 2]]])
    for before, after, z in ((2, 2, 6.0), (1, 2, 6.0), (2, 1, 6.0), (0, 0, 6.0), (2, 2, 2.4)):
        level[1] = torch.tensor([[z, before], [z, after]])
        assert collisions(*given, level).tolist() == [[(before, after, z) != (2, 2, 6.0)]]
        at_states = collisions(*given, level, at_states=True)
        assert at_states.tolist() == [[z < 6 or number < 2 for number in (before, after)]]
    # Who was not there before is where it is now.
    given[3][1, 0] = False
    level[1] = torch.tensor([[0.0, 0], [6, 2]])
    assert not collisions(*given, level).any()


def test_padding_order_and_batch_change_no_collision():
    position, heading, size, valid, subject = boxes(3)
    found = collisions(position, heading, size, valid, subject)
    assert found.any()
    order = torch.tensor([4, 2, 6, 0, 1, 5, 3])
    pad = [torch.cat([x[:, order], x[:, :2]], 1) for x in (position, heading, size, valid)]
    pad[3][:, -2:] = False
    pad[0][:, -2:] = torch.nan
    shuffled = torch.cat([torch.argsort(order)[subject], torch.full((2, 1), -1)], 1)
    again = collisions(*pad, shuffled)
    assert torch.equal(again[:, :3], found)
    assert not again[:, 3].any()
    position, heading, size, valid, subject = boxes(4, lead=(2, 3))
    whole = collisions(position, heading, size[:, :1], valid, subject[:, :1])
    assert whole.shape == (2, 3, 3, 4)
    for b, k in np.ndindex(2, 3):
        one = collisions(position[b, k], heading[b, k], size[b, 0], valid[b, k], subject[b, 0])
        assert torch.equal(whole[b, k], one)
