"""The driving environment: TorchRL's own checks and our contracts."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import BatchSizeTransform
from torchrl.envs.utils import RandomPolicy, check_env_specs

from helpers_segments import crossing, hide, straight_road
from symphony import keys
from symphony.data.segment import Polylines, RunSegment
from symphony.envs import (
    Bicycle,
    ConstantVelocity,
    Displacement,
    DrivingEnv,
    ObservationConfig,
    collate,
    scene,
)

FEW = ObservationConfig(num_objects=4, num_points=60)
ALL = ObservationConfig(num_objects=16, num_points=4000)


def make_env(
    *segments: RunSegment, dynamics: Any = None, config: ObservationConfig = FEW, n: int = 2
) -> DrivingEnv:
    chosen = segments or (straight_road(), crossing())
    return DrivingEnv(collate([scene(s, list(range(n))) for s in chosen]), dynamics, config)


def actions(env: DrivingEnv, shape: tuple[int, ...], seed: int = 0) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    if env.dynamics.discrete:
        return torch.randint(env.dynamics.num_actions, (*shape, env.num_agents), generator=rng)
    return torch.rand(*shape, env.num_agents, 2, generator=rng) * torch.tensor([2.0, 0.1])


def run(env: DrivingEnv, start: TensorDict, plan: torch.Tensor) -> TensorDict:
    """Apply actions [..., T, N(, 2)] and stack what follows along a last dimension T."""
    out, now = [], start
    time = start.ndim
    for action in plan.unbind(time):
        now = env.step(now.clone(False).set(keys.ACTION, action))["next"]
        out.append(now)
    return torch.stack(out, time)


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_torchrl_accepts_the_environment(dynamics: Any, shape: tuple[int, ...]) -> None:
    env = make_env(dynamics=dynamics)
    check_env_specs(env, tensordict=env.reset(TensorDict(batch_size=shape)), break_when_any_done="both")


def test_a_fixed_batch_runs_in_torchrls_collector() -> None:
    env = TransformedEnv(make_env(), BatchSizeTransform(batch_size=[3]))
    collector = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=3 * 60, total_frames=3 * 120)
    batches = list(collector)
    collector.shutdown()
    assert [b.shape for b in batches] == [(3, 60), (3, 60)]
    # Fifty decisions a segment: one reset falls into the first batch of each row.
    assert batches[0]["next", "done"].sum(1).flatten().tolist() == [1, 1, 1]


def test_step_does_not_touch_its_input() -> None:
    env = make_env()
    start = env.start(torch.tensor([0, 1]))
    start.set(keys.ACTION, actions(env, (2,)))
    before = start.clone()
    env.step(start)
    assert (start.exclude("next") == before).all()


def test_episodes_end_with_their_own_log() -> None:
    env = make_env(straight_road(steps=21), straight_road(steps=31, seed=1))
    out = run(env, env.start(torch.tensor([0, 1])), actions(env, (2, 30)))
    assert out["truncated"].squeeze(-1).int().argmax(1).tolist() == [19, 29]
    assert not out["terminated"].any()


def test_seed_decides_what_reset_draws() -> None:
    env = make_env()
    env.set_seed(3)
    first = env.reset(TensorDict(batch_size=[20]))
    env.set_seed(3)
    again, other = (env.reset(TensorDict(batch_size=[20])) for _ in range(2))
    assert (first == again).all()
    assert (first["stream"] != other["stream"]).all()


def test_partial_reset_keeps_the_rest() -> None:
    env = make_env()
    state = run(env, env.start(torch.tensor([0, 1, 0])), actions(env, (3, 5)))[:, -1]
    mask = torch.tensor([[True], [False], [False]])
    fresh = env.reset(state.clone().set("_reset", mask), set_state=False)
    assert fresh["step"].flatten().tolist() == [0, 5, 5]
    assert (fresh[1:] == state[1:].select(*fresh.keys(True, True))).all()


def test_a_state_can_be_started_from() -> None:
    env = make_env()
    plan = actions(env, (2, 10))
    whole = run(env, env.start(torch.tensor([0, 1])), plan)
    middle = env.reset(whole[:, 4].exclude(keys.REWARD), set_state=True)
    tail = run(env, middle, plan[:, 5:])
    assert (tail == whole[:, 5:]).all()


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_a_rollout_is_the_same_in_any_batch(dynamics: Any) -> None:
    alone = make_env(straight_road(), dynamics=dynamics)
    among = make_env(crossing(7), straight_road(), straight_road(8, steps=61, seed=5), dynamics=dynamics)
    plan = actions(alone, (1, 20))
    one = run(alone, alone.start(torch.tensor([0]), 6), plan)
    wide = run(
        among,
        among.start(torch.tensor([[2, 1], [0, 0]]), torch.tensor([[1, 6], [7, 8]])),
        plan.expand(2, 2, 20, *plan.shape[2:]),
    )[0, 1]
    for key in one.keys(True, True):
        if key != "scene":
            assert _same_elements(key, one[key][0], wide[key]), key


def _same_elements(key: Any, a: torch.Tensor, b: torch.Tensor) -> bool:
    """Equality bit by bit; the order of seen elements means nothing, so sets are compared by their sorted sums."""
    if isinstance(key, tuple) and key[-1] in {"points", "objects"}:
        return torch.equal(a.double().sum(-2), b.double().sum(-2)) or torch.allclose(
            a.double().sum(-2), b.double().sum(-2), atol=1e-9
        )
    if isinstance(key, tuple) and key[-1].endswith("_mask"):
        return torch.equal(a.sum(-1), b.sum(-1))
    return torch.equal(a, b)


def test_rollouts_of_a_scene_have_streams_of_their_own() -> None:
    env = make_env(straight_road(), straight_road(seed=1))
    streams = env.start(torch.arange(2).repeat_interleave(500), torch.arange(500).repeat(2))["stream"]
    assert streams.unique().numel() == 1000


def moved(segment: RunSegment, angle: float, x: float, y: float) -> RunSegment:
    """The whole world turned about the origin, then shifted."""
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64).numpy()
    shift = [x, y, 0.0]

    def lines(value: Polylines) -> Polylines:
        return Polylines((value.points @ turn + shift).astype("float32"), value.offsets)

    road = segment.road
    return segment.replace(
        position=(segment.position @ turn + shift).astype("float32"),
        heading=segment.heading + angle,
        velocity=(segment.velocity @ turn[:2, :2]).astype("float32"),
        signal_point=(segment.signal_point @ turn + shift).astype("float32"),
        road=type(road)(
            **{
                **vars(road),
                "lanes": lines(road.lanes),
                "boundary": lines(road.boundary),
                "marks": lines(road.marks),
            }
        ),
    )


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_moving_the_world_changes_nothing_an_agent_sees(dynamics: Any) -> None:
    segment = crossing(6)
    here = make_env(segment, dynamics=dynamics, config=ALL)
    there = make_env(moved(segment, 2.1, 310.0, -95.0), dynamics=dynamics, config=ALL)
    plan = actions(here, (1, 15))
    a, b = (run(e, e.start(torch.tensor([0])), plan) for e in (here, there))
    for key in (keys.OWN, keys.COLLISION, keys.OFFROAD, keys.REWARD):
        torch.testing.assert_close(a[key], b[key], atol=2e-4, rtol=0)
    for key in (keys.OBJECTS, keys.POINTS):
        # All elements fit, so pooling shows the same set whatever its order.
        torch.testing.assert_close(a[key].amax(-2), b[key].amax(-2), atol=2e-4, rtol=0)
        torch.testing.assert_close(a[key].mean(-2), b[key].mean(-2), atol=2e-4, rtol=0)


def test_padding_changes_nothing_an_agent_sees() -> None:
    small, large = straight_road(), crossing(9)
    lone, padded = make_env(small, config=ALL), make_env(small, large, config=ALL)
    a, b = lone.start(torch.tensor([0])), padded.start(torch.tensor([0]))
    for key in (keys.OWN, keys.OBJECTS, keys.POINTS):
        torch.testing.assert_close(a[key].double().sum(-2), b[key].double().sum(-2), atol=1e-6, rtol=0)
    assert torch.equal(a[keys.POINTS_MASK].sum(-1), b[keys.POINTS_MASK].sum(-1))


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_padded_interactive_agents_neither_act_nor_matter(dynamics: Any) -> None:
    two, three = scene(crossing(6), [0, 1]), scene(straight_road(4), [0, 1, 2])
    alone = DrivingEnv(collate([two]), dynamics, ALL)
    padded = DrivingEnv(collate([two, three]), dynamics, ALL)
    plan = actions(padded, (1, 20))
    a = run(alone, alone.start(torch.tensor([0])), plan[:, :, :2])
    start = padded.start(torch.tensor([0]))
    b = run(padded, start, plan)
    assert b[keys.VALID][0, 0].tolist() == [True, True, False]
    for key in (keys.STATE, keys.OWN, keys.COLLISION, keys.OFFROAD, keys.REWARD):
        assert torch.equal(a[key], b[key][:, :, :2])
    torch.testing.assert_close(a[keys.OBJECTS].sum(-2), b[keys.OBJECTS][:, :, :2].sum(-2))
    assert (b[keys.STATE][:, :, 2] == start[keys.STATE][:, None, 2]).all()
    assert not (b[keys.COLLISION] | b[keys.OFFROAD])[:, :, 2].any()


def test_nearest_elements_are_the_ones_seen() -> None:
    env = make_env(crossing(9), config=ObservationConfig(num_objects=3, num_points=40))
    td, scenes = env.start(torch.tensor([0])), env.scenes
    here = td[keys.STATE][0, 0, :2]
    for key, where, count, skip in (
        (keys.OBJECTS, scenes.log_state[0, 0, :, :2], 3, 1),
        (keys.POINTS, scenes.point[0], 40, 0),
    ):
        seen = td[key][0, 0, :, :2].norm(dim=-1).sort().values * 20
        true = (where - here).norm(dim=-1).sort().values[skip : skip + count]
        torch.testing.assert_close(seen, true, atol=1e-3, rtol=1e-4)


def test_padding_does_not_decide_between_equally_near_points() -> None:
    one, tied = scene(crossing(6), [0, 1]), 0
    distance = (one.point[0] - one.log_state[0, 0, 0, :2]).square().sum(-1)[one.point_valid[0]].sort().values
    for count in range(8, 200, 5):
        tied += bool(distance[count - 1] == distance[count])
        config = ObservationConfig(num_objects=3, num_points=count)
        seen = []
        for extra in (0, 57, 1300):
            wide = one.clone()
            for name in (
                "point",
                "point_direction",
                "point_speed",
                "point_type",
                "point_light",
                "point_valid",
            ):
                value = getattr(one, name)
                filler = value.new_zeros(1, extra, *value.shape[2:])
                setattr(wide, name, torch.cat([value, filler], 1))
            env = DrivingEnv(wide, Bicycle(), config)
            seen.append(env.start(torch.tensor([0]))[keys.POINTS][0, 0])
        for other in seen[1:]:
            assert sorted(other.tolist()) == sorted(seen[0].tolist())
    assert tied > 3


def test_what_is_not_valid_is_not_seen() -> None:
    segment = crossing(6)
    gone = hide(segment, 3, slice(0, 10))
    env, less = make_env(segment, config=ALL), make_env(gone, config=ALL)
    count = [e.start(torch.tensor([0]))[keys.OBJECTS_MASK][0, 0].sum().item() for e in (env, less)]
    assert count == [5, 4]


def test_lights_show_their_state_at_each_step() -> None:
    segment = crossing()
    env = make_env(segment, config=ALL)
    out = run(env, env.start(torch.tensor([0])), torch.full((1, 50, 2), 73))
    states = out[keys.POINTS][0, :, 0, :, -9:].sum(-2)
    for t in (0, 20, 24, 30, 49):
        expected = torch.bincount(
            torch.from_numpy(segment.signal_state[:, t + 1].astype("int64")), minlength=9
        )
        assert states[t].tolist() == expected.tolist()


def test_playback_follows_the_log_and_interactive_agents_do_not() -> None:
    segment = straight_road(4)
    env = make_env(segment, config=ALL)
    brake = torch.full((1, 50, 2), 10)
    out = run(env, env.start(torch.tensor([0])), brake)
    assert out[keys.STATE][0, -1, :, 3].max() == 0
    other = out[keys.OBJECTS][0, -1, 0]
    ego = out[keys.STATE][0, -1, 0]
    offset = torch.from_numpy(segment.position[2:, 50, :2]) - ego[:2]
    assert all((other[:, :2] * 20 - o).norm(dim=-1).min() < 1e-3 for o in offset)


def test_collision_and_offroad_flags() -> None:
    env = make_env(straight_road(3, num_lanes=1), n=3, dynamics=Displacement())
    gap = env.scenes.log_state[0, 0, 1, 0] - env.scenes.log_state[0, 0, 0, 0]
    stay = torch.zeros(1, 1, 3, 2)
    bump, leave = stay.clone(), stay.clone()
    bump[..., 0, 0] = gap - 4.0
    leave[..., 2, 1] = 2.0
    start = env.start(torch.tensor([0]))
    assert run(env, start, bump)[keys.COLLISION].flatten().tolist() == [True, True, False]
    assert run(env, start, leave)[keys.OFFROAD].flatten().tolist() == [False, False, True]
    assert run(env, start, stay)[keys.REWARD].flatten().tolist() == [0, 0, 0]
    assert run(env, start, leave)[keys.REWARD].flatten().tolist() == [0, 0, -1]


def test_gradient_flows_through_a_rollout_into_what_is_seen() -> None:
    env = make_env(dynamics=Displacement())
    plan = actions(env, (2, 8)).requires_grad_()
    out = run(env, env.start(torch.tensor([0, 1])), plan)
    (out[keys.OBJECTS].sum() + out[keys.POINTS].sum()).backward()
    assert torch.isfinite(plan.grad).all()
    assert (plan.grad[:, 0].abs() > 0).any()


def test_step_gradient_matches_finite_differences() -> None:
    scenes = collate([scene(straight_road(), [0, 1])])
    env = DrivingEnv(scenes, Displacement(), ALL)
    start = env.start(torch.tensor([0]))

    def seen(action: torch.Tensor) -> torch.Tensor:
        state = start[keys.STATE].double()
        after = env.dynamics.step(state, action, scenes.box_size[:, :2].double(), env.dt)
        double = scenes.apply(lambda x: x.double() if x.is_floating_point() else x)
        twin = DrivingEnv(double, Displacement(), ALL)
        out = twin._from_state(twin._read(start)._replace(step=start[keys.STEP][:, 0] + 1, state=after))
        # The farthest elements may swap at the cut; all of them are seen here, so pooling is smooth but at ties.
        return torch.cat([out[keys.OBJECTS].sum(-2), out[keys.POINTS].mean(-2)], -1)

    action = torch.tensor([[[1.5, 0.1], [2.0, -0.05]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(seen, (action,))


def test_constant_velocity_keeps_its_speed_and_course() -> None:
    for dynamics in (Bicycle(), Displacement()):
        env = make_env(straight_road(), dynamics=dynamics)
        policy, now = ConstantVelocity(dynamics, env.dt), env.start(torch.tensor([0]))
        for _ in range(50):
            now = env.step(policy(now))["next"]
        # On a straight road at constant speeds that is the log itself.
        truth = torch.from_numpy(straight_road().position[:2, 50, :2])
        torch.testing.assert_close(now[keys.STATE][0, :, :2], truth, atol=0.01, rtol=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_a_moved_environment_gives_the_same_numbers(dynamics: Any) -> None:
    here = make_env(dynamics=dynamics, config=ALL)
    there = make_env(dynamics=dynamics, config=ALL).to("cuda")
    plan = actions(here, (2, 20))
    a = run(here, here.start(torch.tensor([0, 1])), plan)
    b = run(there, there.start(torch.tensor([0, 1], device="cuda")), plan.cuda()).cpu()
    for key in (keys.STATE, keys.OWN, keys.COLLISION, keys.OFFROAD):
        torch.testing.assert_close(a[key], b[key], atol=1e-3, rtol=0)
    assert there.reset().device.type == "cuda"
