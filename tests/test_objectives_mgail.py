"""The loss of MGAIL: what it counts, whose gradient it is, and that it is the right one."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torch.distributions import Normal
from torchrl.envs import InitTracker, PendulumEnv
from torchrl.modules import GRUModule, IndependentNormal

from helpers_collectors import STREAM, Mass, Walk, X, starts
from helpers_collectors import noise as hashed
from helpers_objectives import check_contract
from helpers_segments import crossing, straight_road
from symphony.collectors import KeepAll, KeepBest, with_rows
from symphony.envs import Displacement, DrivingEnv, ObservationConfig, collate, scene
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES
from symphony.keys import ACTION, NOISE, OBJECTS, OWN, POINTS, SCORE, VALID
from symphony.modules import NoiseSampler, discriminator, displacement_policy
from symphony.objectives import MGAILLoss
from symphony.rollouts.search import search
from test_modules_displacement import GROUPS

PLAN, SEEN = "noise_plan", [OWN, OBJECTS, POINTS]
STEPS = 3
SEES = ObservationConfig(num_objects=4, num_points=20, clearance=True)


def world(*agents):
    """In float64: a crossing of 4 steps and a road of 2, with as many interactive agents as given for each."""
    segments = (crossing(4, steps=5, seed=1), straight_road(4, steps=3))
    scenes = [scene(s, list(range(n))) for s, n in zip(segments, agents or (2, 2), strict=False)]
    exact = collate(scenes).apply(lambda t: t.double() if t.is_floating_point() else t)
    return DrivingEnv(exact, Displacement(), SEES)


@pytest.fixture(scope="module", name="env")
def _env():
    return world()


def actor():
    torch.manual_seed(0)
    return displacement_policy(SELF_FEATURES, GROUPS, dt=0.2, hidden=8, head=(8,)).double()


def realism():
    torch.manual_seed(1)
    return discriminator(SELF_FEATURES, OBJECT_FEATURES, POINT_FEATURES, hidden=8, head=(8,)).double()


def planned(env, *scenes, steps=STEPS, seed=0):
    torch.manual_seed(seed)
    start = env.start(torch.tensor(scenes or list(range(len(env.scenes)))))
    noise = torch.rand(*start.shape, steps, env.num_agents, 2, dtype=torch.float64)
    return start.set(PLAN, noise)


def make(env=None, **arguments):
    return MGAILLoss(actor(), realism(), world() if env is None else env, **arguments)


def value_and_gradient(loss, td):
    value = loss(td)["loss_mgail"]
    return value.detach(), torch.autograd.grad(value.sum(), list(loss.parameters()))


def added(*parts):
    values, gradients = zip(*parts, strict=True)
    return sum(values), tuple(map(sum, zip(*gradients, strict=True)))


def assert_same(one, other):
    torch.testing.assert_close((one[0], *one[1]), (other[0], *other[1]))


def assert_other_gradient(one, other, by):
    torch.testing.assert_close(one[0], other[0])
    assert any((a - b).norm() > by * a.norm() for a, b in zip(one[1], other[1], strict=True))


def by_hand(env, policy, network, td):
    """States and logits along a plan, without the loss."""
    now, states, scores = td.exclude(PLAN), [td.exclude(PLAN)], []
    for numbers in td[PLAN].unbind(td.ndim):
        now = env.step_mdp(env.step(policy(now.copy().set(NOISE, numbers))))
        states.append(now)
        scores.append(network(now.copy())[SCORE])
    return states, torch.stack(scores, td.ndim)


@pytest.mark.parametrize("cost", ["log_d", "non_saturating", "logit"])
def test_it_is_the_mean_cost_of_what_the_actor_drives_into(env, cost):
    td = planned(env)
    score = by_hand(env, actor(), realism(), td)[1]
    d = score.sigmoid()
    costs = {"log_d": d.log(), "non_saturating": -(1 - d).log(), "logit": score}[cost]
    # The road ends after two steps.
    counted = torch.ones(2, STEPS, 2, dtype=torch.bool)
    counted[1, 2:] = False
    of = costs[counted]
    for reduction, value in (("mean", of.mean()), ("sum", of.sum()), ("none", torch.where(counted, costs, 0.0))):
        out = make(env, cost=cost, reduction=reduction)(td)
        torch.testing.assert_close(out["loss_mgail"], value)
        torch.testing.assert_close(out["mgail_score"], score[counted].mean().detach())


@pytest.mark.parametrize("arguments", [{}, {"cost": "logit"}])
def test_gradients_by_differences(env, arguments):
    td, loss, eps = planned(env), make(env, **arguments), 1e-6
    pairs = list(zip(loss.parameters(), value_and_gradient(loss, td)[1], strict=True))
    for weight, gradient in pairs[::5]:
        at, values = gradient.abs().argmax(), []
        for sign in (1, -1):
            with torch.no_grad():
                weight.view(-1)[at] += sign * eps
                values.append(loss(td)["loss_mgail"])
                weight.view(-1)[at] -= sign * eps
        difference = (values[0] - values[1]) / (2 * eps)
        torch.testing.assert_close(difference, gradient.view(-1)[at], rtol=1e-4, atol=1e-8)
        assert gradient.norm() > 0


def test_only_the_actor_receives_a_gradient(env):
    policy, network = actor(), realism()
    before = list(network.parameters())
    loss = MGAILLoss(policy, network, env)
    assert all(a is b for a, b in zip(policy.parameters(), loss.parameters(), strict=True))
    loss(planned(env))["loss_mgail"].backward()
    assert all(p.grad is not None and p.grad.norm() > 0 for p in policy.parameters())
    assert all(a is b and b.requires_grad for a, b in zip(before, network.parameters(), strict=True))
    assert all(p.grad is None for p in network.parameters())
    network(env.start(torch.tensor([0])))[SCORE].sum().backward()
    assert any(p.grad is not None for p in network.parameters())


def test_cut_at_every_step_it_is_the_sum_of_single_steps(env):
    td = planned(env)
    with torch.no_grad():
        states, _ = by_hand(env, actor(), realism(), td)
    single = make(env, reduction="sum")
    ones = (states[t].copy().set(PLAN, td[PLAN][:, t : t + 1]) for t in range(STEPS))
    total = added(*(value_and_gradient(single, one) for one in ones))
    cut = make(env, reduction="sum", truncate=1)
    assert_same(value_and_gradient(cut, td), total)
    whole = value_and_gradient(make(env, reduction="sum"), td)
    for truncate in (1, 2):
        other = value_and_gradient(make(env, reduction="sum", truncate=truncate), td)
        assert_other_gradient(whole, other, by=1e-3)
    assert_same(value_and_gradient(make(env, reduction="sum", truncate=STEPS), td), whole)


def test_reactions_can_be_left_out_of_the_gradient(env):
    td = planned(env)
    found = [value_and_gradient(make(env, detach_keys=k), td) for k in ([], [OWN], SEEN)]
    assert_other_gradient(found[0], found[1], by=1e-6)
    assert_other_gradient(found[1], found[2], by=1e-6)
    short = planned(env, steps=1)
    assert_same(*(value_and_gradient(make(env, detach_keys=k), short) for k in ([], SEEN)))


@pytest.mark.parametrize("rule", [KeepAll(), KeepBest(0.5)])
def test_the_gradient_is_that_through_the_surviving_branches(env, rule):
    policy, network = actor(), realism()
    branch = torch.arange(4).expand(2, 4)
    start = env.start(torch.tensor([[0], [1]]).expand(2, 4), branch)
    result = search(env, policy, network, start.copy(), seed=5, rule=rule, prune_every=2)
    forked = not torch.equal(result.slots[:, 0], branch)
    assert forked == isinstance(rule, KeepBest)
    counted = result.alive[..., None].expand_as(result.scores)
    assert counted[0].all()
    assert not counted[1].all()
    total = result.scores[counted].mean()
    gradient = torch.autograd.grad(total, list(policy.parameters()))
    loss = MGAILLoss(policy, network, env, cost="logit")
    td = start.copy().set(PLAN, result.trajectories[NOISE])
    assert_same(value_and_gradient(loss, td), (total.detach(), gradient))
    torch.testing.assert_close(loss(td)["mgail_score"], total.detach())


def test_scenes_padding_and_batches_add_up():
    env, alone = world(3, 2), (world(3), DrivingEnv(world(3, 2).scenes[1:], Displacement(), SEES))
    td = planned(env)
    assert not td[VALID].all()
    both = value_and_gradient(make(env, reduction="sum"), td)
    parts = []
    for k, steps in enumerate((STEPS, 2)):
        one = planned(alone[k], 0).set(PLAN, td[PLAN][k : k + 1, :steps])
        parts.append(value_and_gradient(make(alone[k], reduction="sum"), one))
    assert_same(both, added(*parts))
    again = torch.stack([td, td.flip(0)], 1)
    assert_same(value_and_gradient(make(env, reduction="sum"), again), added(both, both))
    assert_same(value_and_gradient(make(env), again), value_and_gradient(make(env), td))
    none = make(env, reduction="none")
    assert none(again)["loss_mgail"].shape == (2, 2, STEPS, 3)
    torch.testing.assert_close(none(td[0])["loss_mgail"], none(td)["loss_mgail"][0])


def test_without_given_numbers_it_draws_anew(env):
    loss, start = make(env, horizon=4), env.start(torch.tensor([0]))
    torch.manual_seed(0)
    first, second = (loss(start)["loss_mgail"] for _ in range(2))
    torch.manual_seed(0)
    # Left behind by someone who drove from here before.
    used = start.copy().set(NOISE, torch.full((1, 2, 2), 0.5))
    assert first == loss(used)["loss_mgail"] != second


def test_the_environment_may_change_between_calls(env):
    other, loss = world(3, 3), make(env)
    expected = value_and_gradient(make(env), planned(env))
    value = loss(planned(env))["loss_mgail"]
    loss.env = other
    assert loss.env is other
    assert_same((value.detach(), torch.autograd.grad(value, list(loss.parameters()))), expected)
    td = planned(other, 1, 0, 1)
    assert_same(value_and_gradient(loss, td), value_and_gradient(make(other), td))


def numbers(x, step, stream):
    """In (0, 1), decided by the state's identity alone."""
    return 0.5 + 0.49 * hashed(TensorDict({"step": step, STREAM: stream}, x.shape[:-2]), x.shape[-2])


def walkers(agents, **arguments):
    torch.manual_seed(0)
    body = nn.Sequential(nn.Linear(1, 8), nn.Tanh(), nn.Linear(8, 2), NormalParamExtractor())
    parameters = {name: ("agents", name) for name in ("loc", "scale")}
    policy = ProbabilisticTensorDictSequential(
        TensorDictModule(numbers, in_keys=[X, "step", STREAM], out_keys=[NOISE]),
        TensorDictModule(body, in_keys=[X], out_keys=list(parameters.values())),
        NoiseSampler(parameters, ACTION, distribution_class=Normal),
    )
    network = TensorDictModule(lambda x: x.square().squeeze(-1), in_keys=[X], out_keys=[SCORE])
    return MGAILLoss(policy, network, Walk(agents), horizon=3, **arguments)


@pytest.mark.parametrize("agents", [1, 2])
@pytest.mark.parametrize("arguments", [{}, {"truncate": 2, "reduction": "none"}])
def test_it_keeps_the_contract_of_torchrl(agents, arguments):
    td = starts(Walk(agents), 5, branches=1)[:, 0]
    td[VALID] = torch.ones(5, agents, dtype=torch.bool)
    check_contract(lambda **more: walkers(agents, **{**arguments, **more}), td, 4)


def test_an_actor_with_memory_acts_as_in_a_rollout():
    memory = GRUModule(input_size=1, hidden_size=4, in_key="seen", out_key="h")
    column = lambda key: TensorDictModule(lambda x: x[..., None], in_keys=["thdot"], out_keys=[key])  # noqa: E731
    narrow = TensorDictModule(lambda mean: (mean, 0 * mean + 1e-9), in_keys=["mean"], out_keys=["loc", "scale"])
    policy = ProbabilisticTensorDictSequential(
        column("seen"), memory, TensorDictModule(nn.Linear(4, 1), in_keys=["h"], out_keys=["mean"]), narrow,
        ProbabilisticTensorDictModule(["loc", "scale"], ["action"], distribution_class=IndependentNormal),
    )  # fmt: skip
    env = with_rows(PendulumEnv(seed=0), [4])
    env = env.append_transform(InitTracker()).append_transform(memory.make_tensordict_primer())
    start = env.reset()
    loss = MGAILLoss(policy, column("score"), env, horizon=6, cost="logit", reduction="none")
    loss.set_keys(score="score")
    driven = env.rollout(6, policy, auto_reset=False, tensordict=start.clone(), break_when_any_done=False)
    torch.testing.assert_close(loss(start)["loss_mgail"].squeeze(-1), driven["next", "thdot"])


@pytest.mark.filterwarnings("ignore:The method <bound method TensorDictBase.__deepcopy__")
def test_copies_have_a_discriminator_of_their_own(env):
    td, loss = planned(env), make(env)
    clone = copy.deepcopy(loss)
    for p in clone.discriminator.parameters():
        p.data.zero_()
    assert clone(td)["mgail_score"] == 0 != loss(td)["mgail_score"]
    loss.reset_parameters_recursive()
    assert all(map(torch.equal, loss.discriminator.parameters(), realism().parameters()))
    assert len(list(loss.parameters())) == len(list(actor().parameters()))


def test_bad_calls_are_refused(env):
    td = planned(env)
    with pytest.raises(KeyError, match="end of the episode"):
        make(env)(td.exclude("done"))
    with pytest.raises(ValueError, match="nothing to simulate"):
        make(env)(td.exclude(PLAN))
    with pytest.raises(ValueError, match="no environment"):
        MGAILLoss(actor(), realism())(td)
    for bad in ({"cost": "d"}, {"horizon": -1}, {"truncate": -1}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            make(env, **bad)


@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
def test_compiled_steps_give_the_same_loss_and_gradient():
    torch.compiler.reset()
    programs = []
    kept = {"backend": lambda graph, _: programs.append(graph) or graph.forward}
    td, how = starts(Walk(2), 5, branches=1)[:, 0], {"detach_keys": [X], "truncate": 2}
    td[VALID] = torch.ones(5, 2, dtype=torch.bool)
    plain, compiled = value_and_gradient(walkers(2, **how), td), walkers(2, **how, compile_step=kept)
    for _ in range(2):
        assert_same(value_and_gradient(compiled, td), plain)
    assert len(programs) == 2  # of states with and without a gradient


@pytest.mark.parametrize("agents", [None, 2])
def test_an_episode_ends_once(agents):
    """An environment that comes back into its bounds is scored like one that stays out, unless told otherwise."""
    torch.manual_seed(0)

    def of(*names: str) -> list[Any]:
        return list(names) if agents is None else [("agents", name) for name in names]

    how = {"distribution_class": IndependentNormal, "default_interaction_type": "random"}
    body = TensorDictModule(nn.Sequential(nn.Linear(2, 2), NormalParamExtractor()), of("place"), of("loc", "scale"))
    named = dict(zip(("loc", "scale"), of("loc", "scale"), strict=True))
    policy = ProbabilisticTensorDictSequential(body, ProbabilisticTensorDictModule(named, of("action"), **how))
    far = TensorDictModule(lambda place: place[..., 0].abs(), of("place"), of("score"))
    start = with_rows(Mass(agents=agents), [30]).reset()
    values = []
    for sticky, until in ((True, True), (False, True), (False, False)):
        torch.manual_seed(0)
        how = {"horizon": 12, "reduction": "none", "cost": "logit", "until_done": until}
        loss = MGAILLoss(policy, far, Mass(agents=agents, sticky=sticky), **how)
        loss.set_keys(score=of("score")[0], done=of("done")[0])
        values.append(loss(start)["loss_mgail"].detach())
    assert torch.equal(*values[:2])
    assert values[0].shape == (30, 12, *([] if agents is None else [agents]))
    assert (values[0] > 1.5).any()
    over = (values[0] > 1.5).cumsum(1)
    assert (values[0][over > 1] == 0).all()
    assert (values[2] != 0).all()
    torch.testing.assert_close(values[2][values[0] != 0], values[0][values[0] != 0])
