"""The driving environment: TorchRL's own checks and our contracts; what is asked for is observed and nothing else."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import BatchSizeTransform
from torchrl.envs.utils import RandomPolicy, check_env_specs
from torchrl.modules import AdditiveGaussianModule

from helpers_segments import crossing, straight_road, turned
from symphony import DrivingEnv, ObservationConfig, SegmentStore, builtin_store, keys
from symphony.collectors import with_rows
from symphony.envs import Bicycle, ConstantVelocity, Displacement, collate, scene
from symphony.envs import flags as module
from symphony.envs.flags import collision_flags
from symphony.envs.objects import Objects
from symphony.envs.observation import observe_states
from symphony.errors import ConfigError
from symphony.learning import SceneDataset
from symphony.roadgraph import LaneGraph

FEW = ObservationConfig(num_objects=4, num_points=60)
ALL = ObservationConfig(num_objects=16, num_points=4000)


def make_env(*segments, dynamics=None, config=FEW, n=2):
    chosen = segments or (straight_road(), crossing())
    return DrivingEnv(collate([scene(s, list(range(n))) for s in chosen]), dynamics, config)


def actions(env: DrivingEnv, shape: tuple[int, ...], seed: int = 0) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    if env.dynamics.discrete:
        return torch.randint(env.dynamics.num_actions, (*shape, env.num_agents), generator=rng)
    return torch.rand(*shape, env.num_agents, 2, generator=rng) * torch.tensor([2.0, 0.1])


def run(env: DrivingEnv, start: TensorDict, plan: torch.Tensor) -> TensorDict:
    """Apply actions [..., T, N(, 2)] and stack what follows along a last dimension T."""
    out, now, time = [], start, start.ndim
    for action in plan.unbind(time):
        now = env.step(now.clone(False).set(keys.ACTION, action))["next"]
        out.append(now)
    return torch.stack(out, time)


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_torchrl_accepts_the_environment(dynamics, shape):
    env = make_env(dynamics=dynamics)
    check_env_specs(env, tensordict=env.reset(TensorDict(batch_size=shape)), break_when_any_done="both")


def test_displacements_are_bounded_at_any_time_step():
    env = make_env(dynamics=Displacement())
    scenes = env.scenes.clone()
    for _ in range(2):
        spec, one = env.full_action_spec[keys.ACTION], torch.ones(2, 1)
        torch.testing.assert_close(spec.low, env.dt * torch.tensor([-10.0, -15.0]) * one)
        torch.testing.assert_close(spec.high, env.dt * torch.tensor([50.0, 15.0]) * one)
        scenes.dt = scenes.dt / 2
        env.scenes = scenes
    noisy = AdditiveGaussianModule(spec=env.full_action_spec, action_key=keys.ACTION)
    assert env.full_action_spec.is_in(noisy(TensorDict({"agents": {"action": torch.full((2, 2), 99.0)}})))


def test_a_fixed_batch_runs_in_torchrls_collector():
    env = TransformedEnv(make_env(), BatchSizeTransform(batch_size=[3]))
    collector = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=3 * 60, total_frames=3 * 120)
    batches = list(collector)
    collector.shutdown()
    assert [b.shape for b in batches] == [(3, 60), (3, 60)]
    # Fifty decisions a segment: one reset falls into the first batch of each row.
    assert batches[0]["next", "done"].sum(1).flatten().tolist() == [1, 1, 1]


def test_a_source_gives_torchrls_collector_new_scenes_and_a_start_in_a_collision_is_no_end():
    data, seen = SceneDataset(SegmentStore(builtin_store("train"))), set()
    env = with_rows(DrivingEnv(data, observation=ObservationConfig.nothing(), ends_on=("collision",), seed=0), [1])
    for batch in Collector(env, RandomPolicy(env.action_spec), frames_per_batch=50, total_frames=300):
        seen |= set(batch["segment"].flatten().tolist())
    assert len(seen) > 4
    scenes = make_env(straight_road()).scenes
    scenes.log_state[:, 0, 1] = scenes.log_state[:, 0, 0]
    env = DrivingEnv(scenes, ends_on=("collision",))
    start = env.reset()
    assert start[keys.COLLISION].all()
    assert not start["done"].any()
    assert env.step(start.set(keys.ACTION, torch.full((2,), 73)))["next", "terminated"].all()


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_double_by_default_changes_no_number(dynamics):
    found, plan = [], actions(make_env(dynamics=dynamics), (2, 3), seed=3)
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        try:
            env = make_env(dynamics=dynamics)
            found.append(run(env, env.start(torch.tensor([0, 1])), plan))
            check_env_specs(with_rows(env, [2]))
        finally:
            torch.set_default_dtype(torch.float32)
    for key in (keys.STATE, keys.OWN, keys.OBJECTS, keys.POINTS):
        torch.testing.assert_close(found[1][key], found[0][key], atol=1e-5, rtol=1e-5)


def test_episodes_end_with_their_own_log():
    env = make_env(straight_road(steps=21), straight_road(steps=31, seed=1))
    out = run(env, env.start(torch.tensor([0, 1])), actions(env, (2, 30)))
    assert out["truncated"].squeeze(-1).int().argmax(1).tolist() == [19, 29]
    assert not out["terminated"].any()


def test_seed_decides_what_reset_draws():
    env = make_env()
    env.set_seed(3)
    first = env.reset(TensorDict(batch_size=[20]))
    env.set_seed(3)
    again, other = (env.reset(TensorDict(batch_size=[20])) for _ in range(2))
    assert (first == again).all()
    assert (first["stream"] != other["stream"]).all()


def test_partial_reset_keeps_the_rest():
    env = make_env()
    state = run(env, env.start(torch.tensor([0, 1, 0])), actions(env, (3, 5)))[:, -1]
    mask = torch.tensor([[True], [False], [False]])
    fresh = env.reset(state.clone().set("_reset", mask), set_state=False)
    assert fresh["step"].flatten().tolist() == [0, 5, 5]
    assert (fresh[1:] == state[1:].select(*fresh.keys(True, True))).all()


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_moving_the_world_changes_nothing_an_agent_sees(dynamics):
    worlds = [crossing(6), turned(crossing(6), 2.1, (310.0, -95.0))]
    more = {"route": True, "along": True, "gaps": True, "clearance": True, "foresight": (0.5, 1.0), "num_lights": 2}
    scenes = [collate([scene(s, [0, 1], LaneGraph(s.road))]) for s in worlds]
    here, there = (DrivingEnv(each, dynamics, replace(ALL, **more)) for each in scenes)
    plan, starts = actions(here, (1, 15)), [e.with_goals(e.start(torch.tensor([0]))) for e in (here, there)]
    choices = [e.choices(start)[keys.ROUTES] for e, start in zip((here, there), starts, strict=True)]
    torch.testing.assert_close(*choices, atol=1e-3, rtol=0)
    a, b = (run(e, start, plan) for e, start in zip((here, there), starts, strict=True))
    for key in (keys.OWN, keys.COLLISION, keys.OFFROAD, keys.REWARD, keys.ROUTE, keys.ROAD):
        torch.testing.assert_close(a[key], b[key], atol=2e-4, rtol=0)
    a[keys.GAP], b[keys.GAP] = a[keys.GAP][..., None], b[keys.GAP][..., None]
    for key in (keys.OBJECTS, keys.POINTS, keys.ALONG, keys.GAP, keys.GAP_AHEAD, keys.LIGHTS):
        # All elements fit, so pooling shows the same set whatever its order.
        torch.testing.assert_close(a[key].amax(-2), b[key].amax(-2), atol=2e-4, rtol=0)
        torch.testing.assert_close(a[key].mean(-2), b[key].mean(-2), atol=2e-4, rtol=0)


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_padded_interactive_agents_neither_act_nor_matter(dynamics):
    two, three = scene(crossing(6), [0, 1]), scene(straight_road(4), [0, 1, 2])
    config = replace(ALL, clearance=dynamics.discrete)  # off the road by what is seen, or not
    alone, padded = (DrivingEnv(collate(scenes), dynamics, config) for scenes in ([two], [two, three]))
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


def test_playback_follows_the_log_and_interactive_agents_do_not():
    segment = straight_road(4)
    env, brake = make_env(segment, config=ALL), torch.full((1, 50, 2), 10)
    out = run(env, env.start(torch.tensor([0])), brake)
    assert out[keys.STATE][0, -1, :, 3].max() == 0
    other, ego = (out[key][0, -1, 0] for key in (keys.OBJECTS, keys.STATE))
    offset = torch.from_numpy(segment.position[2:, 50, :2]) - ego[:2]
    assert all((other[:, :2] * 20 - o).norm(dim=-1).min() < 1e-3 for o in offset)


def test_collision_and_offroad_flags():
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


def test_step_gradient_matches_finite_differences():
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


def test_constant_velocity_keeps_its_speed_and_course():
    env = make_env(straight_road(), dynamics=Bicycle())
    policy, now = ConstantVelocity(Bicycle()), env.start(torch.tensor([0]))
    for _ in range(50):
        now = env.step(policy(now))["next"]
    # On a straight road at constant speeds that is the log itself.
    truth = torch.from_numpy(straight_road().position[:2, 50, :2])
    torch.testing.assert_close(now[keys.STATE][0, :, :2], truth, atol=0.01, rtol=0)
    # Who comes in reverse begins at rest: none of the actions reverses.
    for dynamics in (Bicycle(), Displacement()):
        back = make_env(straight_road().replace(velocity=-straight_road().velocity), dynamics=dynamics)
        assert not back.start(torch.tensor([0]))[keys.STATE][..., 3].any()


NOTHING = ObservationConfig.nothing()
EVERYTHING = ObservationConfig(num_objects=4, num_points=60, clearance=True, foresight=(0.5, 1.0))
KEYS = {"own", "objects", "objects_mask", "points", "points_mask", "gap", "gap_ahead", "road"}


@pytest.mark.parametrize(("config", "missing"), [
    (EVERYTHING, set()), (ObservationConfig(num_objects=0, num_points=0), KEYS - {"own"}),
    (ObservationConfig(num_objects=0, num_points=7), KEYS - {"own", "points", "points_mask"}),
    (ObservationConfig(3, 0), KEYS - {"own", "objects", "objects_mask"}),
    (ObservationConfig(0, 0, clearance=True, foresight=(1.0,)), KEYS - {"own", "road"}), (NOTHING, KEYS),
])  # fmt: skip
@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_there_are_entries_for_what_is_asked_for(config, missing, shape):
    env = make_env(config=config)
    start = env.reset(TensorDict(batch_size=shape))
    check_env_specs(env, tensordict=start)
    agents = start["agents"]
    seen = set(agents["observation"].keys()) if "observation" in agents.keys() else set()  # noqa: SIM118
    assert seen == KEYS - missing
    assert ("observation" in agents.keys()) == bool(seen)  # noqa: SIM118


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_what_is_observed_changes_no_state_and_no_flag(dynamics):
    seen = (EVERYTHING, NOTHING, ObservationConfig(0, 3))
    envs = [make_env(dynamics=dynamics, config=config) for config in seen]
    plan = actions(envs[0], (3, 25)) * (1 if dynamics.discrete else 3)
    one, *others = (run(env, env.start(torch.tensor([0, 1, 1]), torch.arange(3)), plan) for env in envs)
    for other in others:
        for key in (keys.STATE, keys.COLLISION, keys.OFFROAD, keys.REWARD, "done"):
            assert torch.equal(one[key], other[key])
    assert one[keys.REWARD].sum() < 0


def test_agents_see_their_size_their_speed_and_that_the_log_ends():
    scenes = collate([scene(s, [0, 1]) for s in (straight_road(steps=4), crossing(steps=6))])
    env = DrivingEnv(scenes, Bicycle(), ObservationConfig(num_objects=0, num_points=0))
    out = run(env, env.start(torch.arange(2)), torch.full((2, 6, 2), env.dynamics.num_actions // 2))
    own, sees = out[keys.OWN], env.observation
    torch.testing.assert_close(own[..., 0] * sees.speed_scale, out[keys.STATE][..., 3])
    expected = scenes.box_size[:, None, :2].expand(2, 6, 2, 2)
    torch.testing.assert_close(own[..., 1:3] * sees.size_scale, expected)
    # With three and five steps to take; what goes on after its end is told so, too.
    assert own[:, :, 0, 3].tolist() == [[k >= last for k in range(1, 7)] for last in (3, 5)]


def test_states_can_be_observed_without_an_environment():
    logs = [crossing(4, seed=1, steps=9), straight_road(4, steps=9)]
    scenes = collate([scene(log, [0, 1], LaneGraph(log.road)) for log in logs])
    config = replace(EVERYTHING, num_objects=3, num_points=12, route=True)
    env = DrivingEnv(scenes, None, config)
    now = env.start(torch.tensor([0, 1, 1]), goal=torch.tensor([[0, -1], [0, 0], [1, 0]]))
    for _ in range(3):
        now = env.step(now.set(keys.ACTION, torch.full((3, 2), 90)))["next"]
    row, step = now[keys.SCENE].squeeze(-1), now[keys.STEP].squeeze(-1)
    state, valid, goal, come = (now[key] for key in (keys.STATE, keys.VALID, keys.GOAL, keys.PROGRESS))
    seen, _ = observe_states(scenes, row, step, state, valid, config, goal=goal, progress=come)
    assert now[keys.ROUTE].any()
    for name, value in now["agents", "observation"].items():
        assert torch.equal(seen[name], value), name


def test_tables_follow_the_scenes():
    one, two = make_env(config=EVERYTHING), make_env(config=EVERYTHING)
    two.scenes = collate([scene(crossing(5), [0, 1]), scene(straight_road(3), [0, 1])])
    fresh = DrivingEnv(two.scenes, None, EVERYTHING)
    one.start(torch.tensor([0, 1]))
    one.scenes = two.scenes
    for env in (one, two):
        assert (env.start(torch.tensor([0, 1])) == fresh.start(torch.tensor([0, 1]))).all()


@pytest.mark.filterwarnings("ignore:The method <bound method TensorDictBase.__deepcopy__")
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])  # noqa: S301 - our own
def test_copies_simulate_the_same(copied):
    env = make_env(config=EVERYTHING)
    start = env.start(torch.tensor([0, 1])).set(keys.ACTION, torch.full((2, 2), 80))
    after, twin = env.step(start.clone())["next"], copied(env)
    assert (twin.step(start.clone())["next"] == after).all()
    kept = [made._kept() for made in (env, twin)]
    assert kept[0] is not kept[1]
    assert kept[1].scenes is twin.scenes


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_place_that_is_not_finite_spoils_what_is_seen_from_there_alone(wrong):
    env = make_env(config=ObservationConfig(num_objects=0, num_points=5))
    state = env.start(torch.tensor([0, 1]))
    good = env.at(state)[keys.POINTS]
    state[keys.STATE][1, 0, 0] = wrong
    found = env.at(state)[keys.POINTS]
    assert not found[1, 0].isfinite().all()
    assert torch.equal(found[0], good[0])
    assert torch.equal(found[1, 1], good[1, 1])


BAD = (math.nan, math.inf, -math.inf)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("who", [0, 3])
def test_others_still_collide(bad, who, monkeypatch):
    state = torch.zeros(1, 4, 5)
    state[0, :, 0] = torch.tensor([0.0, 50, 51, 100])
    state[0, who, 0] = bad
    objects = Objects(state, torch.ones(1, 4, dtype=torch.bool), torch.tensor([4.0, 2.0]).expand(1, 4, 2))
    index = torch.arange(4)[None]
    found = collision_flags(objects, index)
    assert found.tolist() == [[False, True, True, False]]
    monkeypatch.setattr(module, "on_host", lambda tensor: False)
    assert torch.equal(collision_flags(objects, index), found)


def test_masked_objects_are_zero_and_pass_no_gradient():
    scenes = scene(straight_road(3, steps=11), [0, 1, 2])
    env = DrivingEnv(scenes, Displacement(), ObservationConfig(num_objects=4, num_points=10, gaps=True))
    action = torch.zeros(1, 3, 2)
    action[..., 0] = 1.0
    action[0, 0, 0] = math.nan
    action.requires_grad_()
    after = env.step(env.start(torch.tensor([0])).set(keys.ACTION, action))["next"]
    seen = after["agents", "observation"]
    hidden = ~seen["objects_mask"][0, 1:]
    assert hidden.any()
    assert (seen["objects"][0, 1:][hidden] == 0).all()
    assert (seen["gap"][0, 1:][hidden] == 0).all()
    (gradient,) = torch.autograd.grad(seen["objects"][0, 1:].sum(), action)
    assert gradient[0, 1:].isfinite().all()
    assert gradient[0, 1:].any()


def test_lights_keep_their_last_state_after_the_log_however_long_others_are():
    config = ObservationConfig(num_objects=2, num_points=300)
    short, long = scene(crossing(3, steps=5, seed=1), [0]), scene(crossing(3, steps=15, seed=2), [0])
    found = []
    for scenes in (short, collate([short, long])):
        env = DrivingEnv(scenes, observation=config)
        now = env.start(torch.tensor([0]))
        for _ in range(7):
            now = env.step(now.set(keys.ACTION, torch.full((1, 1), 73)))["next"]
        seen = now["agents", "observation"]
        found.append(seen["points"][seen["points_mask"]])
        assert not seen["objects_mask"].any()
    assert torch.equal(*found)


def test_a_route_that_is_not_there_is_none():
    segment = crossing(3, steps=9, seed=1)
    scenes = scene(segment, [0, 1], LaneGraph(segment.road))
    env = DrivingEnv(scenes, observation=ObservationConfig(num_objects=2, num_points=2, route=True))
    start, many = env.start(torch.tensor([0])), scenes.route_count.shape[2]
    for goal in (-1, many, many + 1):
        seen = env.with_goals(start, torch.tensor([[goal, 0]]))["agents", "observation", "route"]
        assert not seen[0, 0].any()
        assert seen[0, 1].any()


@pytest.mark.parametrize("count", [0, 1, 2, 6])
@pytest.mark.parametrize("name", ["num_acceleration", "num_steering"])
def test_a_grid_without_a_middle_is_refused(name, count):
    with pytest.raises(ConfigError, match=name):
        Bicycle(**{name: count})


@pytest.mark.parametrize("bad", BAD)
def test_an_action_that_is_not_finite_ends_the_episode_of_its_scene(bad):
    scenes = collate([scene(straight_road(3, steps=11, seed=seed), [0, 1]) for seed in (0, 1)])
    env = DrivingEnv(scenes, Displacement(), ObservationConfig.nothing())
    action = torch.zeros(2, 2, 2)
    action[..., 0] = 1.0
    action[1, 1, 0] = bad
    after = env.step(env.start(torch.tensor([0, 1])).set(keys.ACTION, action))["next"]
    assert after["terminated"].tolist() == after["done"].tolist() == [[False], [True]]
    assert after["truncated"].tolist() == [[False], [False]]
    assert after[keys.REWARD].squeeze(-1).tolist() == [[0, 0], [0, -1]]
