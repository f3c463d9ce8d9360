"""Demonstrations: fitted together as one by one, close to the log, kept, and displaced with the way back."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from helpers_runs import tiny
from helpers_segments import crossing, hide, straight_road
from helpers_store import fill
from symphony.cli import main
from symphony.config import AgentConfig, PerturbConfig
from symphony.data.builtin import builtin_store
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, Displacement, ObservationConfig
from symphony.envs.dynamics import bicycle_step
from symphony.envs.routes import FollowedRoutes
from symphony.errors import DataError
from symphony.geometry import with_speed
from symphony.geometry.frames import rotate, wrap
from symphony.learning import SceneDataset, perturbation
from symphony.learning import experts as module
from symphony.learning.demonstrations import ItemCache
from symphony.learning.experts import FOLLOWS, VERSION, Experts, fit_experts
from symphony.learning.perturbation import displaced, perturbed, way_back
from symphony.recipes import train

DYNAMICS = pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])


def segments() -> list[RunSegment]:
    """Make segments of several lengths and time steps, with gaps, with made and recorded traffic."""
    store = SegmentStore(builtin_store("train"))
    short = straight_road(3, steps=11).replace(dt=0.1)
    hidden = hide(crossing(5), 2, slice(10, 20)), hide(straight_road(5), 1, slice(0, 7))
    return [straight_road(4, steps=31), hidden[0], store[3], short, hidden[1], store[40]]


@DYNAMICS
@pytest.mark.parametrize("together", [12, 10_000])
def test_fitting_together_is_the_fit_of_the_dynamics(dynamics, together, monkeypatch):
    monkeypatch.setattr(module, "TOGETHER", together)
    for segment, found in zip(segments(), fit_experts(segments(), dynamics), strict=True):
        rows = found.agent.numpy()
        parts = segment.position[rows, :, :2], segment.heading[rows, :, None], segment.velocity[rows]
        valid, size = torch.from_numpy(segment.valid[rows]), torch.from_numpy(segment.size[rows, :2])
        log = with_speed(torch.from_numpy(np.concatenate(parts, -1)))
        actions, states = dynamics.fit(log, valid, size, segment.dt)
        assert len(rows) > 1
        torch.testing.assert_close(found.actions.to(actions.dtype), actions, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.states, states, atol=1e-6, rtol=0)
        near = valid & ((states - log)[..., :2].norm(dim=-1) <= FOLLOWS)
        assert torch.equal(found.valid, near[:, 1:] & near[:, :-1])
        assert found.states.untyped_storage().nbytes() == states.nbytes


def test_experts_drive_or_wait_in_a_lane_and_are_not_parked() -> None:
    segment = straight_road(4)
    position, velocity = segment.position.copy(), segment.velocity.copy()
    position[1:3] = position[1:3, :1]
    velocity[1:3] = 0
    position[2, :, 1] += 1.5  # beside its lane
    (found,) = fit_experts([segment.replace(position=position, velocity=velocity)], Bicycle())
    assert found.agent.tolist() == [0, 1, 3]
    assert (found.states[..., :2] - torch.from_numpy(position[[0, 1, 3], :, :2])).norm(dim=-1).max() < 0.15
    assert (found.actions[1] == 73).all()  # who waits neither steers nor brakes
    # The ego always, whoever else has no two steps in a row never.
    once = hide(segment.replace(position=position, velocity=velocity, ego=2), 3, slice(1, None))
    assert fit_experts([once], Bicycle())[0].agent.tolist() == [0, 1, 2]


@settings(max_examples=25)
@given(
    st.lists(st.lists(st.integers(0, 9), min_size=1, max_size=4), max_size=20),
    st.integers(1, 60),
    st.none() | st.integers(1, 5),
)
def test_the_cache_gives_what_was_asked_for_and_holds_no_more_than_it_may(calls, limit, keep):
    asked: list[list[int]] = []

    def make(items: Any) -> list[bytes]:
        asked.append(list(items))
        return [bytes(3 * item) for item in items]

    cache = ItemCache(make, len, keep=keep, limit=limit, name="bytes")
    crowded = False
    for items in calls:
        held = set(cache.kept)
        asked.clear()
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert [len(value) for value in cache.many(items)] == [3 * item for item in items]
        # What is missing is made together; the oldest go, but one is held however large it is.
        missing = [item for item in dict.fromkeys(items) if item not in held]
        assert asked == ([missing] if missing else [])
        assert sum(3 * item for item in cache.kept) <= limit or len(cache.kept) == 1
        assert len(cache.kept) <= (keep or 99)
        assert items[-1] in cache.kept
        # It is said once, when the first has to go.
        assert len(told) <= (not crowded)
        crowded = crowded or bool(told)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A copy of the built-in store."""
    return Path(shutil.copytree(builtin_store("train"), tmp_path / "s"))


def files(store: Path) -> list[Path]:
    return sorted((store / "experts").glob("*.npz"))


def data(store: Path, dynamics: Any = None, **how: Any) -> SceneDataset:
    return SceneDataset(SegmentStore(store), 2, dynamics or Bicycle(), **how)


def same(a: Experts, b: Experts) -> None:
    for name in ("agent", "states", "actions", "valid", "progress"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0, msg=name)
    for one, other in zip(a.routes, b.routes, strict=True):
        for name in ("points", "count", "right", "change", "logged"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
        np.testing.assert_equal(one.carried, other.carried)


@DYNAMICS
@pytest.mark.parametrize("routes", [True, False])
def test_what_was_kept_is_what_was_fitted(store, dynamics, routes, monkeypatch):
    first = data(store, dynamics, routes=routes).experts.many([0, 1, 2])
    assert len(files(store)) == 3
    monkeypatch.setattr("symphony.learning.demonstrations.fit_experts", None)  # nothing is fitted again
    again = data(store, dynamics, routes=routes).experts.many([2, 0, 1])
    for a, b in zip(first, [again[1], again[2], again[0]], strict=True):
        same(a, b)


@pytest.mark.parametrize("method", ["bc_h", "mgail"])
def test_training_finds_all_that_was_prepared_by_whatever_workers(method, tmp_path, monkeypatch):
    made, store = [], tmp_path / "store"
    fill(store, [straight_road(4, steps=9), crossing(4, steps=8), straight_road(3, seed=1, steps=9)])
    command = f"data prepare {store} --method {method} --workers"
    for workers in (1, 2):
        assert main([*command.split(), str(workers)]) == 0
        made.append([file.read_bytes() for file in files(store)])
        for file in files(store)[workers - 1 :]:  # in the end all but one
            file.unlink()
    assert made[0] == made[1]
    assert (len(made[0]), len(files(store))) == (3, 1)
    assert main([*command.split(), "1"]) == 0
    monkeypatch.setattr("symphony.learning.demonstrations.fit_experts", None)  # nothing is fitted again
    train(tiny(method, store, tmp_path / "run"))


@pytest.mark.parametrize(("method", "cars"), [("bc", 1), ("bc_ts", 3)])
def test_logs_that_show_nobody_drive_on_are_named(method, cars, tmp_path):
    """Neither the ego, which alone is driven, nor, of one car, anybody to imitate."""
    fill(tmp_path / "store", [hide(straight_road(cars), 0, slice(1, None))])
    with pytest.raises(DataError, match=r"segment straight-0, field valid: .*none of which shows how a"):
        train(tiny(method, tmp_path / "store", tmp_path / "run", agent=AgentConfig(interactive=1)))


def test_another_action_space_or_duration_is_kept_apart(store: Path) -> None:
    for how in ({}, {"dynamics": Bicycle(num_acceleration=21)}, {"duration": 5}, {"routes": True}):
        data(store, **how).experts(0)
    assert len(files(store)) == 4


def test_damaged_files_are_made_anew(store: Path) -> None:
    right = data(store, routes=True).experts(0)
    (file,) = files(store)
    content = file.read_bytes()
    damaged = [content[: len(content) // 2], b"x" * 500]
    directory = content.rindex(b"PK\x01\x02")  # at the end: version, flags, compression, sizes
    for at in (directory + 8, directory + 20):
        damaged += [content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :] for bit in range(8)]
    for other in (*damaged, b""):
        file.write_bytes(other)
        same(data(store, routes=True).experts(0), right)
    assert file.read_bytes() == content


def test_where_there_is_no_place_nothing_is_kept(store: Path, monkeypatch) -> None:
    data(builtin_store("test")).experts(0)
    assert not (builtin_store("test") / "experts").exists()
    monkeypatch.setattr(np, "save", lambda *_: Path("/").write_text("as bad as a full disk"))
    assert len(data(store).experts(0).agent)
    monkeypatch.undo()
    (store / "experts").rmdir()
    (store / "experts").write_text("not a folder")
    assert len(data(store).experts(0).agent)


def test_the_version_is_raised_when_the_fit_or_the_routes_change(store: Path) -> None:
    """If this fails, raise VERSION and renew the digest: what stores kept is not what would be fitted now."""
    # Whole numbers only, as the last bits of others depend on the processor.
    facts = [
        [
            len(expert.agent),
            [[t.logged, t.count.tolist(), t.right.tolist(), np.isinf(t.change).tolist()] for t in expert.routes],
        ]
        for expert in data(store, routes=True).experts.many(range(6))
    ]
    digest = hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]
    assert (VERSION, digest) == (8, "b944984c526954e0")


DT, LENGTH = 0.2, torch.tensor([4.5], dtype=torch.float64)


def drive(speed: float, acceleration: float, steering: float, steps: int) -> Tensor:
    """A smooth log [T, 4] of one vehicle."""
    state = torch.tensor([[3.0, -2.0, 0.4, speed]], dtype=torch.float64)
    states = [state]
    for _ in range(steps):
        control = (torch.full((1,), value, dtype=torch.float64) for value in (acceleration, steering))
        state = bicycle_step(state, *control, LENGTH, DT)
        states.append(state)
    return torch.cat(states)


@given(speed=st.floats(0, 35), acceleration=st.floats(-2, 2), steering=st.floats(-0.03, 0.03))
def test_on_the_log_the_way_back_is_the_log(speed: float, acceleration: float, steering: float) -> None:
    log = drive(speed, acceleration, steering, 1)
    found = way_back(log[:1], log[:1], log[1:], LENGTH, DT)
    # Below 0.5 m/s its curvature can't be told, and such a vehicle hardly moves.
    close = 1e-6 if speed > 2 else 0.02
    torch.testing.assert_close(found[..., [0, 1, 3]], log[1:][..., [0, 1, 3]], atol=close, rtol=0)
    assert wrap(found[..., 2] - log[1:, 2]).abs() < (1e-6 if speed > 2 else 0.05)
    # Who is ahead in a bend, as far on its way as the log is a step later, keeps to it.
    log = drive(8.0, 0.0, 5 * steering, 2)
    ahead = way_back(log[1:2], log[:1], log[1:2], LENGTH, DT)
    assert wrap(ahead[0, 2] - log[1, 2] - (8.0 + ahead[0, 3]) / 16.0 * wrap(log[2, 2] - log[1, 2])).abs() < 0.006


@given(st.floats(4, 30), st.tuples(*(st.floats(-most, most) for most in (2, 0.8, 0.1, 2))))
def test_it_leads_back(speed: float, by: tuple[float, ...]) -> None:
    """From errors along, across, in heading and in speed."""
    log, error = drive(speed, 0.0, 0.005, 50), torch.tensor(by, dtype=torch.float64)
    state = log[:1] + torch.cat([rotate(error[:2], log[0, 2]), error[2:]])
    for t in range(50):
        state = way_back(state, log[t : t + 1], log[t + 1 : t + 2], LENGTH, DT)
    assert (state[0, :2] - log[-1, :2]).norm() < 0.2
    assert abs(float(state[0, 3] - log[-1, 3])) < 0.1
    # From afar neither harder nor in a tighter bend than a vehicle can.
    log = drive(5.0, 0.0, 0.0, 1)
    state = log[:1] + torch.tensor([-20.0, 0.0, 1.0, 0.0])
    most = (torch.tensor([value]) for value in (perturbation.BRAKING, -perturbation.STEERING))
    far = way_back(state, log[:1], log[1:], LENGTH, DT)
    torch.testing.assert_close(far, bicycle_step(state, *most, LENGTH, DT))


@given(
    speed=st.floats(0, 30), acceleration=st.floats(-4, 4), lateral=st.floats(-6, 6),
    dynamics=st.sampled_from([Displacement(), Bicycle(num_acceleration=401, num_steering=201)]),
)  # fmt: skip
def test_a_label_brakes_and_turns_as_the_way_back_does(speed, acceleration, lateral, dynamics):
    """In either action space: a displacement to the same place would change the speed half as much."""
    # A turn with at most so many m/s^2 to the side, and the wheel not beyond 0.4 radians.
    steering = max(-0.4, min(0.4, lateral * 2.7 / max(speed, 1.0) ** 2))
    log = drive(speed, acceleration, steering, 1)
    size = torch.cat([LENGTH, LENGTH / 2])[None]
    found = dynamics.step(log[:1], dynamics.towards(log[:1], log[1:], size, DT), size, DT)
    torch.testing.assert_close(found[:, 3], log[1:, 3], atol=0.03, rtol=0)
    steep = torch.tensor([0.0, 0.0, 1.2, 0.0]).to(log)
    # A step too short for its turn: one that comes to rest while the wheel is held over.
    if log[1, 3] > 2.0:
        assert wrap(found[:, 2] - log[1:, 2]).abs() < 0.01
        # Too sharp a turn is the steepest step to its side.
        across = [Displacement().towards(log[:1], log[1:] + turn * steep, size, DT)[0] for turn in (-1, 1)]
        assert [(y / x.hypot(y)).item() for x, y in across] == pytest.approx([-0.3, 0.3], abs=0.02)


def test_displacements_are_as_large_as_is_said_and_none_goes_backwards() -> None:
    """A slow vehicle is not put sideways nor sped up, a fast one hardly turned; times numbers uniform in 0 to 1."""
    for speed, across, turned in ((0.0, 0.0, 0.0), (2.0, 0.5, 0.5), (8.0, 1.0, 1.0), (32.0, 1.0, 0.25)):
        found = displaced(torch.tensor([0.0, 0.0, 0.0, speed]).expand(20_000, 4), torch.Generator().manual_seed(0))
        each = (perturbation.AHEAD, 1.0), (perturbation.ASIDE, across), (perturbation.TURNED, turned)
        most = torch.tensor([most * share for most, share in (*each, (perturbation.FASTER, across))])
        torch.testing.assert_close(found.std(0), most / 3**0.5, atol=0, rtol=0.03)
        assert (found[:, 3] >= 0).all()


def test_a_share_is_displaced_and_the_rest_left_as_it_was() -> None:
    for dynamics in (Bicycle(), Displacement()):
        log = drive(8.0, 0.3, 0.0, 1).float()
        state = log[:1].expand(4000, 4) + 0.01
        action = torch.zeros(4000, dtype=torch.int64) if dynamics.discrete else torch.zeros(4000, 2)
        more = torch.linspace(1, 2, 4000)[:, None]  # no two are alike
        given_ = (log[:1] * more, log[1:] * more, torch.tensor([4.5, 2.0]) * more)
        start, label = perturbed(state, action, *given_, dynamics, DT, 0.25, torch.Generator().manual_seed(1))
        same = (start == state).all(-1)
        assert 0.7 < same.float().mean() < 0.8
        assert (label[same] == action[same]).all()
        before, after, size = (each[~same] for each in given_)
        back = dynamics.towards(start[~same], way_back(start[~same], before, after, size[:, 0], DT), size, DT)
        torch.testing.assert_close(label[~same], back.to(action.dtype))


def test_training_batches_are_the_log_unless_displaced(monkeypatch: pytest.MonkeyPatch) -> None:
    store = SegmentStore(builtin_store("train"))
    data = SceneDataset(store, 2, Bicycle(num_acceleration=21), routes=True)
    sees, window, come = ObservationConfig(num_points=16, route=True), FollowedRoutes.window, []
    seen = lambda routes, far: (come.append((routes.lines(), far[:, 0])), window(routes, far))[1]  # noqa: E731
    monkeypatch.setattr(FollowedRoutes, "window", seen)

    def batch(perturb: PerturbConfig | None) -> tuple[Tensor, Tensor]:
        rng = torch.Generator().manual_seed(3)
        drawn = data.sample_states([0, 1, 2, 3], 400, sees, rng, "cpu", perturb)
        return drawn["agents", "state"], drawn["agents", "action"]

    plain, action = batch(None)
    with monkeypatch.context() as nowhere:
        for name in ("AHEAD", "ASIDE", "TURNED", "FASTER"):
            nowhere.setattr(perturbation, name, 0.0)
        still, label = batch(PerturbConfig(share=1.0))
    # Not displaced, an expert is where the log is, not where the fit is: centimetres apart.
    assert (plain[..., :2] - still[..., :2]).norm(dim=-1).median() < 0.1
    levels, _ = Bicycle(num_acceleration=21).grid(torch.zeros(1))
    assert (levels[action] - levels[label]).abs().median() < 0.3
    monkeypatch.setattr(perturbation, "AHEAD", 6.0)
    away, _ = batch(PerturbConfig(share=1.0))
    assert (plain[..., :2] - away[..., :2]).norm(dim=-1).median() > 0.2
    # As far along its route as where it is, some metres from where it was.
    ((lines, count), far), (_, before) = come[-1], come[0]
    for at, line, number, now, then in zip(away[:, 0, :2], lines[:, 0], count[:, 0], far, before, strict=True):
        expected = shapely.LineString(line[:number]).project(shapely.Point(at)) if number > 1 else 0.0
        assert abs(expected - then) > 6 or now == pytest.approx(expected, abs=0.5)


def test_goals_are_learned_as_often_as_there_are_experts(tmp_path: Path) -> None:
    """Ten times 26 of them, 128 at a time; people on foot choose no routes."""
    road = straight_road(26)
    walkers = road.replace(segment_id="on foot", agent_type=np.where(np.arange(26) < 13, road.agent_type, 2))
    data = SceneDataset(fill(tmp_path / "store", [walkers, walkers.replace(segment_id="again")]), 2, Bicycle())
    assert [data.goal_updates(most, processes) for most, processes in ((9, 1), (2, 1), (9, 3))] == [3, 2, 1]
