"""Environments, transforms and policies as TorchRL's users have them, in the collector and in the planner."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl import envs, modules
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs.utils import check_env_specs

from helpers_collectors import Mass, hashed
from symphony.collectors import (
    BeamSearchCollector,
    BeamSearchPlanner,
    KeepAll,
    KeepBest,
    KeyScore,
    Systematic,
    beam_search,
    branch,
    with_rows,
)
from symphony.collectors import planner as planner_module

ROWS, STEPS = 3, 8
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore:.*VecNormV2:FutureWarning")

ENVIRONMENTS: dict[str, Callable[[], envs.EnvBase]] = {
    "rows": lambda: with_rows(Mass(), [ROWS]), "sticky": lambda: with_rows(Mass(sticky=True), [ROWS]),
    "own batch": lambda: Mass((ROWS,)), "agents": lambda: with_rows(Mass(agents=2), [ROWS]), "one": Mass,
    "endless": lambda: with_rows(Mass(limit=99.0), [ROWS]), "sticky, own batch": lambda: Mass((ROWS,), sticky=True),
    "sticky agents": lambda: with_rows(Mass(agents=2, sticky=True), [ROWS]),
    "agents, own batch": lambda: Mass((ROWS,), agents=2),
}  # fmt: skip
TRANSFORMS: dict[str, Callable[[Any], list[envs.Transform]]] = {
    "none": lambda key: [],
    "counters": lambda key: [envs.StepCounter(6), envs.RewardSum()],
    "init": lambda key: [envs.InitTracker()],
    "norm": lambda key: [envs.ObservationNorm(0.1, 2.0, in_keys=[key], standard_normal=True)],
    "frames": lambda key: [envs.CatFrames(3, -1, in_keys=[key], padding="same")],
    "statistics": lambda key: [envs.VecNormV2(in_keys=[key], reduce_batch_dims=True)],
    "scaled": lambda key: [envs.ActionScaling(acting(key, 2).out_keys)],
    "primed": lambda key: [envs.TensorDictPrimer(memory=Unbounded((1,)))],
    "statistics, old": lambda key: [envs.VecNorm(in_keys=[key], new_api=False)],
}


def acting(key: Any, features: int) -> TensorDictModule:
    torch.manual_seed(0)
    action = "action" if isinstance(key, str) else (*key[:-1], "action")
    return TensorDictModule(nn.Sequential(nn.Linear(features, 1), nn.Tanh()), [key], [action])


def recurrent(features: int = 2) -> tuple[modules.GRUModule, TensorDictSequential]:
    torch.manual_seed(0)
    memory = modules.GRUModule(input_size=features, hidden_size=4, in_key="observation", out_key="embedding")
    head = nn.Sequential(nn.Linear(4, 2), NormalParamExtractor())
    both = TensorDictSequential(memory, TensorDictModule(head, ["embedding"], ["loc", "scale"]))
    return memory, modules.ProbabilisticActor(both, ["loc", "scale"], distribution_class=modules.TanhNormal)


def beams(env: envs.EnvBase, policy: Any, *, key: Any = "reward", **kwargs: Any) -> BeamSearchCollector:
    frames = env.batch_size.numel() * STEPS
    how = {"branches": 1, "prune_every": 4, "frames_per_batch": frames, "total_frames": frames, **kwargs}
    return BeamSearchCollector(env, policy, score=KeyScore(key, negate=True), **how)


def assert_same_until_done(env: Callable[[], envs.EnvBase], policy: Any, **kwargs: Any) -> TensorDictBase:
    """The first batches of both collectors have the same entries, the same up to the first end of an episode."""
    one, ours = env(), beams(env(), policy, **kwargs)
    frames = one.batch_size.numel() * STEPS
    how = {"frames_per_batch": frames, "total_frames": frames, "reset_at_each_iter": True}
    plain = Collector(one, policy, auto_register_policy_transforms=False, **how)
    for collector in (plain, ours):
        collector.set_seed(1)
    ours.fake_tensordict()  # changes nothing
    expected, found = plain.next().exclude("collector"), ours.next()
    assert (expected.shape, expected.names) == (found.shape, found.names)
    assert plain.stats()["frames"] == ours.stats()["frames"]
    mask = found["collector", "mask"]
    assert mask[..., 0].all()
    entries = set(found.exclude("collector").keys(True, True))
    assert entries == set(expected.keys(True, True))
    for entry in entries:
        torch.testing.assert_close(found[entry][mask], expected[entry][mask], msg=f"{entry}")
    return found


@pytest.mark.parametrize(("env", "transforms", "inside"), [
    (e, t, inside)
    for e, t, inside in itertools.product(ENVIRONMENTS, TRANSFORMS, (False, True))
    # TorchRL's CatFrames takes no reset of each agent apart.
    if t.startswith("statistics") == (e == "endless") and not ("agents" in e and t == "frames")
    if (not inside or (e != "one" and "own" not in e)) and (t != "primed" or e == "one")
])  # fmt: skip
def test_one_branch_is_torchrls_collector(env, transforms, inside):
    # Statistics are of all rows, also of those that are reset: here no row is.
    key = ("agents", "observation") if "agents" in env else "observation"

    def make() -> envs.EnvBase:
        torch.manual_seed(0)
        if inside:  # the transforms are, the rows come last
            limit = 99.0 if env == "endless" else 1.5
            base = Mass(agents=2 if "agents" in env else None, sticky="sticky" in env, limit=limit)
            return with_rows(envs.TransformedEnv(base, envs.Compose(*TRANSFORMS[transforms](key))), [ROWS])
        return envs.TransformedEnv(ENVIRONMENTS[env](), envs.Compose(*TRANSFORMS[transforms](key)))

    reward = "reward" if isinstance(key, str) else ("agents", "reward")
    found = assert_same_until_done(make, acting(key, 6 if transforms == "frames" else 2), key=reward)
    if env == "rows" and transforms == "none":
        assert not found["collector", "mask"].all()


@pytest.mark.parametrize(
    ("env", "inside"), [(e, False) for e in ("rows", "sticky", "own batch", "sticky, own batch")] + [("rows", True)]
)
@pytest.mark.parametrize("transforms", ["none", "counters", "frames"])
def test_one_branch_with_memory_is_torchrls_collector(env, inside, transforms):
    memory, _ = recurrent(6 if transforms == "frames" else 2)
    policy = TensorDictSequential(memory, TensorDictModule(nn.Linear(4, 1), ["embedding"], ["action"]))

    def make() -> envs.EnvBase:
        added = [envs.InitTracker(), memory.make_tensordict_primer(), *TRANSFORMS[transforms]("observation")]
        base = Mass() if inside else ENVIRONMENTS[env]()
        made = envs.TransformedEnv(base, envs.Compose(*added))
        return with_rows(made, [ROWS]) if inside else made

    assert_same_until_done(make, policy)


@pytest.mark.parametrize("env", ["rows", "own batch", "one"])
@pytest.mark.parametrize("register", [False, True])
def test_hidden_states_are_copied_with_a_branch(env, register):
    """Along each leaf they are those that recurrent mode computes from its observations alone."""
    memory, policy = recurrent()
    made = ENVIRONMENTS[env]()
    if not register:
        made = envs.TransformedEnv(made, envs.Compose(envs.InitTracker(), memory.make_tensordict_primer()))
    collector = beams(made, policy, branches=4, leaves=4, auto_register_policy_transforms=register)
    collector.frames_per_batch = STEPS
    batch = collector.rollout()
    assert batch.shape == (*made.batch_size, 4, STEPS)
    assert bool((batch["collector", "beam_slot"] != torch.arange(4)[:, None]).any()), "nothing was copied"
    for row in batch.reshape(-1, STEPS):
        with torch.no_grad(), modules.set_recurrent_mode(True):
            again = memory(row[None].select(*memory.in_keys).clone())["embedding"]
        torch.testing.assert_close(again[0], row["embedding"])


@pytest.mark.parametrize("exploration", [modules.AdditiveGaussianModule, modules.EGreedyModule])
def test_exploration_takes_the_specs_of_the_environment(exploration):
    env = ENVIRONMENTS["rows"]()
    module = exploration(env.action_spec)
    before = module.spec.shape
    batch = beams(env, TensorDictSequential(acting("observation", 2), module), branches=4, leaves=4).next()
    action = batch["action"]
    assert action.abs().max() <= 1
    assert len(action.flatten().unique()) > action.numel() / 4
    assert module.spec.shape == before


@pytest.mark.parametrize("kind", ["rows", "one", "own batch"])
def test_a_policy_may_return_its_outputs_alone_or_be_safe(kind):
    policy, spec = acting("observation", 2), ENVIRONMENTS[kind]().action_spec
    safe = modules.SafeModule(policy.module, ["observation"], ["action"], spec, safe=True)
    for other in (safe, lambda td: policy(td).select("action")):
        one, two = (beams(ENVIRONMENTS[kind](), each, branches=4).next()["action"] for each in (policy, other))
        assert (one == two).all()


def test_rows_are_a_batch_of_an_environment():
    for env in (
        with_rows(envs.TransformedEnv(Mass(), envs.StepCounter()), [ROWS]),
        envs.TransformedEnv(with_rows(Mass(), [ROWS]), envs.StepCounter()),
    ):
        check_env_specs(env)
        assert len(env.reset()["observation"].unique(dim=0)) == ROWS
        assert env.rollout(5, break_when_any_done=False).shape == (ROWS, 5)
        assert env.rollout(50, break_when_all_done=True).shape[0] == ROWS
    with pytest.raises(ValueError, match=r"has a batch size, \[3\]"):
        with_rows(Mass((ROWS,)), [2])


def test_what_can_not_be_right_is_refused():
    seen = {"in_keys": ["observation"]}
    twice = envs.Compose(envs.CatFrames(2, -1, **seen), envs.ObservationNorm(0.0, 1.0, **seen))
    pool = envs.TimeMaxPool(**seen, T=2)
    wrong = ((envs.VecNormV2(**seen), "reduce_batch_dims"), (twice, "must come after"), (pool, "TimeMaxPool keeps"))
    for transform, why in wrong:
        env = envs.TransformedEnv(with_rows(Mass(), [ROWS]), transform)
        with pytest.raises(ValueError, match=why):
            beams(env, None, branches=2).next()
        with pytest.raises(ValueError, match=why):
            with_rows(envs.TransformedEnv(Mass(), transform.clone()), [ROWS])


HORIZON, BRANCHES = 6, 8


def returns(env: envs.EnvBase, start: TensorDictBase, value: Any = None) -> tuple[Tensor, Tensor]:
    """Return each slot's return of its constant action, and that action."""
    now, total = start.unsqueeze(-1).expand(*start.shape, BRANCHES).clone(), 0.0
    action, came = hashed(now.copy())["action"], now
    for _ in range(HORIZON):
        after = env.step(now.clone().set("action", action))["next"]
        total = total + torch.where(came["done"], 0.0, after["reward"])
        now = after.exclude("reward")
        came = torch.where(came["done"].squeeze(-1), came, now)
    ahead = 0.0 if value is None else torch.where(came["terminated"], 0.0, value(came["place"]))
    return (total + ahead).squeeze(-1), action


@pytest.mark.parametrize("valued", [False, True])
@pytest.mark.parametrize("limit", [None, HORIZON - 2])
def test_without_pruning_it_is_the_best_of_all_branches(valued, limit):
    """A value counts where episodes go on, and where they were truncated, but not where they have terminated."""
    env = envs.TransformedEnv(Mass(limit=0.8), envs.StepCounter(limit))
    start = with_rows(env, [ROWS]).reset()

    def worth(place: Tensor) -> Tensor:
        return 3.0 * place[..., :1]

    network = TensorDictModule(worth, ["place"], ["state_value"]) if valued else None
    how = {"policy": hashed, "value_network": network, "rule": KeepAll(), "prune_every": 2}
    planner = BeamSearchPlanner(env, HORIZON, BRANCHES, temperature=0.5, **how)
    planned = planner(start.clone())
    expected, actions = returns(env, start, worth if valued else None)
    best = expected.argmax(-1)
    torch.testing.assert_close(planned["action"], actions[torch.arange(ROWS), best])
    torch.testing.assert_close(planned["planner", "weight"], torch.softmax(expected / 0.5, -1))
    torch.testing.assert_close(planned["planner", "value"].squeeze(-1), expected.amax(-1))
    torch.testing.assert_close(planned["planner", "action"], actions)


@pytest.mark.parametrize("rule", [KeepBest(), Systematic(temperature=5.0)])
def test_the_best_branch_is_that_of_the_highest_return(rule, monkeypatch):
    """Also where the rule sees less than all of it."""
    start, searched = with_rows(Mass(limit=9.0), [ROWS]).reset(), list[Any]()
    spy = lambda *args, **how: searched.append(beam_search(*args, **how)) or searched[0]  # noqa: E731
    monkeypatch.setattr(planner_module, "beam_search", spy)
    how = {"policy": hashed, "rule": rule, "prune_every": 2, "noise": lambda td, n: torch.full((*td.shape, n), 0.3)}
    planned = BeamSearchPlanner(Mass(limit=9.0), HORIZON, BRANCHES, **how)(start)
    found = -searched[0].leaf_totals.sum(-2)
    torch.testing.assert_close(planned["planner", "value"].squeeze(-1), found.amax(-1))
    torch.testing.assert_close(found[:, 0], found.amax(-1))


def test_the_last_period_of_an_episode_is_the_last_of_its_row():
    """Whatever other rows go on to: nothing is pruned after it."""
    env = envs.TransformedEnv(with_rows(Mass(limit=9.0), [ROWS]), envs.StepCounter(4))
    start = branch(env.reset(), BRANCHES)
    given, how = (env, hashed, KeyScore("reward", negate=True)), {"prune_every": 2, "prune_last": False}
    short, long = (beam_search(*given, start.clone(), steps=steps, **how) for steps in (4, 8))
    slots = torch.arange(BRANCHES).expand(ROWS, -1)
    assert (short.parents[:, 0] != slots).any()
    assert torch.equal(short.parents[:, 1], slots)
    assert torch.equal(short.parents, long.parents[:, :2])


def test_agents_of_a_group_are_planned_for():
    env = with_rows(Mass(agents=2), [ROWS])
    keys = {"reward_key": ("agents", "reward"), "action_key": ("agents", "action")}
    planned = env.rollout(3, BeamSearchPlanner(env, HORIZON, BRANCHES, **keys), break_when_any_done=False)
    assert planned["planner", "action"].shape == (ROWS, 3, BRANCHES, 2, 1)


@pytest.mark.parametrize("key", [("next", "memory"), "memory"])
def test_a_policy_that_remembers_proposes_and_remembers_what_is_made(key):
    """With one branch it drives as alone."""

    def remembering(memory: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
        action = (memory + observation.sum(-1, keepdim=True)).sin()
        return action, memory + action + 1

    policy = TensorDictModule(remembering, ["memory", "observation"], ["action", key])
    primer = envs.TensorDictPrimer(memory=Unbounded((1,)), expand_specs=True)
    env = envs.TransformedEnv(with_rows(Mass(limit=99.0), [ROWS]), primer)
    start, planner = env.reset(), BeamSearchPlanner(env, 3, 1, policy=policy)
    planned, alone = (env.rollout(5, one, auto_reset=False, tensordict=start.clone()) for one in (planner, policy))
    torch.testing.assert_close(planned.select(*alone.keys(True, True)), alone)


@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs:UserWarning")
@pytest.mark.parametrize("outer", [None, envs.StepCounter, "frames"])
def test_it_is_a_policy_of_torchrl(outer):
    def make() -> Any:
        env = with_rows(Mass(limit=1.0), [ROWS])
        if outer is None:
            return env
        frames = envs.CatFrames(2, -1, in_keys=["observation"])
        return envs.TransformedEnv(env, frames if outer == "frames" else outer())

    planner = BeamSearchPlanner(make(), HORIZON, 32, rule=KeepBest(0.5), prune_every=3)
    assert isinstance(planner, modules.MPCPlannerBase)
    torch.manual_seed(0)
    planned, drawn = (make().rollout(20, policy, break_when_any_done=False) for policy in (planner, None))
    assert planned["next", "reward"].mean() > drawn["next", "reward"].mean() + 0.2
    torch.testing.assert_close(planned["planner", "weight"].sum(-1), torch.ones(ROWS, 20))
    how = {"frames_per_batch": ROWS * 4, "total_frames": ROWS * 4, "auto_register_policy_transforms": False}
    collector = Collector(make(), planner, **how)
    assert next(iter(collector))["planner", "action"].shape == (ROWS, 4, 32, 1)
