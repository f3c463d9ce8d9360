"""Displaced expert states and the way back."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from symphony.config import PerturbConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, Displacement
from symphony.envs.dynamics import bicycle_step
from symphony.envs.observation import ObservationConfig
from symphony.geometry.frames import rotate, wrap
from symphony.learning import SceneDataset, perturbation
from symphony.learning.perturbation import displaced, perturbed, way_back

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


@given(st.floats(4, 30), st.tuples(*(st.floats(-most, most) for most in (2, 0.8, 0.1, 2))))
def test_it_leads_back(speed: float, by: tuple[float, ...]) -> None:
    """From errors along, across, in heading and in speed."""
    log, error = drive(speed, 0.0, 0.005, 50), torch.tensor(by, dtype=torch.float64)
    state = log[:1] + torch.cat([rotate(error[:2], log[0, 2]), error[2:]])
    for t in range(50):
        state = way_back(state, log[t : t + 1], log[t + 1 : t + 2], LENGTH, DT)
    assert (state[0, :2] - log[-1, :2]).norm() < 0.2
    assert abs(float(state[0, 3] - log[-1, 3])) < 0.1


@given(
    speed=st.floats(0, 30),
    acceleration=st.floats(-4, 4),
    lateral=st.floats(-6, 6),
    dynamics=st.sampled_from([Displacement(), Bicycle(num_acceleration=401, num_steering=201)]),
)
def test_a_label_brakes_and_turns_as_the_way_back_does(speed, acceleration, lateral, dynamics):
    """In either action space: a displacement to the same place would change the speed half as much."""
    # A turn with at most so many m/s^2 to the side, and the wheel not beyond 0.4 radians.
    steering = max(-0.4, min(0.4, lateral * 2.7 / max(speed, 1.0) ** 2))
    log = drive(speed, acceleration, steering, 1)
    size = torch.cat([LENGTH, LENGTH / 2])[None]
    found = dynamics.step(log[:1], dynamics.towards(log[:1], log[1:], size, DT), size, DT)
    torch.testing.assert_close(found[:, 3], log[1:, 3], atol=0.03, rtol=0)
    # A step too short for its turn: one that comes to rest while the wheel is held over.
    if log[1, 3] > 2.0:
        assert wrap(found[:, 2] - log[1:, 2]).abs() < 0.01


def test_slow_vehicles_are_not_put_sideways_and_none_goes_backwards() -> None:
    rng = torch.Generator().manual_seed(0)
    standing = torch.zeros(500, 4)
    found = displaced(standing, rng)
    assert (found[:, 1:3] == 0).all()
    assert (found[:, 3] >= 0).all()
    assert (found[:, 3] > 0).any()


def test_a_share_is_displaced_and_the_rest_left_as_it_was() -> None:
    for dynamics in (Bicycle(), Displacement()):
        log = drive(8.0, 0.3, 0.0, 1).float()
        state = log[:1].expand(4000, 4) + 0.01
        action = torch.zeros(4000, dtype=torch.int64) if dynamics.discrete else torch.zeros(4000, 2)
        given_ = (log[:1].expand(4000, 4), log[1:].expand(4000, 4), torch.tensor([4.5, 2.0]).expand(4000, 2))
        rng = torch.Generator().manual_seed(1)
        start, label = perturbed(state, action, *given_, dynamics, DT, 0.25, rng)
        same = (start == state).all(-1)
        assert 0.7 < same.float().mean() < 0.8
        assert (label[same] == action[same]).all()
        assert label.dtype == action.dtype


def test_training_batches_are_the_log_unless_displaced(monkeypatch: pytest.MonkeyPatch) -> None:
    store = SegmentStore(builtin_store("train"))
    data = SceneDataset(store, 2, Bicycle(num_acceleration=21), routes=True)
    sees = ObservationConfig(num_points=16)

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
    away, _ = batch(PerturbConfig(share=1.0))
    assert (plain[..., :2] - away[..., :2]).norm(dim=-1).median() > 0.2
