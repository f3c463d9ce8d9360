"""The losses that imitate, as TorchRL tests its own: behavioural cloning and distillation of a search."""

from __future__ import annotations

import inspect
import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torch.distributions import Categorical, LogNormal, Weibull
from torch.nn import functional
from torchrl.modules import OneHotCategorical, ProbabilisticActor
from torchrl.objectives import BCLoss as TorchRLBCLoss

from helpers_objectives import OBSERVATION, batch, categorical_actor, check_contract, gaussian_actor, learned
from symphony.keys import ACTION, LOGITS, ROLLOUT, VALID
from symphony.objectives import BCLoss, DistillationLoss

KINDS = pytest.mark.parametrize("kind", [BCLoss, DistillationLoss])


def bc(td, mask=None, key="loss_bc", actor=categorical_actor, **arguments):
    """Return what cloning reports of the entries of a mask."""
    return BCLoss(actor(), **arguments)(td if mask is None else td.clone().set(VALID, mask))[key]


@pytest.mark.parametrize("shape", [(), (4, 5)])
@pytest.mark.parametrize("reduction", [None, "sum", "none"])
def test_cloning_is_cross_entropy_over_valid_agents(shape, reduction):
    td = batch(*shape)
    td[VALID][..., 0] = True
    out = BCLoss(categorical_actor(), reduction=reduction)(td)
    logits, action = categorical_actor()[0](td.clone())[LOGITS][td[VALID]], td[ACTION][td[VALID]]
    expected = functional.cross_entropy(logits, action, reduction=reduction or "mean")
    if reduction == "none":
        assert out["loss_bc"].shape == out["accuracy"].shape == td[VALID].shape
        torch.testing.assert_close(out["loss_bc"][td[VALID]], expected)
        assert (out["loss_bc"][~td[VALID]] == 0).all()
    else:
        torch.testing.assert_close(out["loss_bc"], expected)
        torch.testing.assert_close(out["entropy"], Categorical(logits=logits).entropy().mean())
        torch.testing.assert_close(out["accuracy"], (logits.argmax(-1) == action).float().mean())


def test_cloning_agrees_with_torchrl_on_flat_keys():
    td = TensorDict(observation=torch.randn(20, 4), action=torch.randn(20, 2), batch_size=[20])
    actors = [gaussian_actor("observation", "action") for _ in range(2)]
    loss = BCLoss(actors[0])
    loss.set_keys(action="action")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The name target_actor_network_params", UserWarning)
        theirs = TorchRLBCLoss(actors[1])
    assert set(loss(td).keys()) == {"loss_bc"} == set(loss.out_keys)
    torch.testing.assert_close(loss(td)["loss_bc"], theirs(td)["loss_bc"])


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("reduction", [None, "sum"])
def test_distillation_is_one_bc_loss_per_kind(continuous, reduction):
    td, actor = batch(30, continuous=continuous), gaussian_actor if continuous else categorical_actor
    out = DistillationLoss(actor(), reduction=reduction)(td)
    expert, rollout = td[VALID] & ~td[ROLLOUT], td[VALID] & td[ROLLOUT]
    assert 0 < expert.sum() < rollout.sum()
    parts = [bc(td, mask, actor=actor, reduction=reduction) for mask in (expert, rollout)]
    torch.testing.assert_close(out["loss_distillation"], parts[0] + parts[1])
    for name, mask in (("nll_expert", expert), ("nll_rollout", rollout)):
        torch.testing.assert_close(out[name], bc(td, mask, actor=actor).detach())
    for name in () if continuous else ("accuracy", "entropy"):
        torch.testing.assert_close(out[name], bc(td, expert, name))


def test_weights_of_rollouts_make_a_policy_gradient():
    """The loss is linear in the weights; experts have none, and a weight of 1 is like none."""
    td, loss = batch(30), DistillationLoss(categorical_actor())
    weight, plain = torch.randn(td[VALID].shape), loss(td)["loss_distillation"]
    tds = (td.clone().set(("agents", "weight"), w) for w in (0 * weight + 1, weight))
    weighted = [loss(each)["loss_distillation"] for each in tds]
    torch.testing.assert_close(weighted[0], plain)
    rollout = td[VALID] & td[ROLLOUT]
    each = DistillationLoss(categorical_actor(), reduction="none")(td)["loss_distillation"]
    torch.testing.assert_close(weighted[1], plain + ((weight - 1) * each)[rollout].mean())
    with pytest.raises(ValueError, match="weight"):
        loss(td.clone().set(("agents", "weight"), weight[:, :1]))
    # Whoever selects what the loss reads keeps them; those of other entries need not be numbers.
    td = td.set(("agents", "weight"), weight.masked_fill(~rollout, torch.nan))
    out = loss(td.select(*loss.in_keys))
    torch.testing.assert_close(out["loss_distillation"], weighted[1])
    out["loss_distillation"].backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters())


def test_more_rollouts_weigh_no_more_and_a_kind_that_is_absent_adds_nothing():
    td = batch(20)
    rollouts = td[td[ROLLOUT][:, 0]]
    one, other = (DistillationLoss(categorical_actor())(x) for x in (td, torch.cat([td, rollouts, rollouts])))
    torch.testing.assert_close(one["loss_distillation"], other["loss_distillation"])
    for kind in (True, False):
        td[ROLLOUT] = torch.full_like(td[ROLLOUT], kind)
        found = DistillationLoss(categorical_actor())(td)["loss_distillation"]
        torch.testing.assert_close(found, bc(td))


@KINDS
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_without_valid_agents_it_is_zero_with_zero_gradient(kind, reduction):
    td = batch(5)
    td[VALID] = torch.zeros_like(td[VALID])
    values, gradients = learned(kind(categorical_actor(), reduction=reduction), td)
    assert all((value == 0).all() for value in [*values, *gradients])


@KINDS
@pytest.mark.parametrize("continuous", [False, True])
def test_it_keeps_the_contract_of_torchrl(kind, continuous):
    actor, td = gaussian_actor if continuous else categorical_actor, batch(20, continuous=continuous)
    td = td if kind is DistillationLoss else td.exclude(ROLLOUT)
    dirty, padded = td.clone(), ~td[VALID]
    dirty[ACTION][padded] = -1
    dirty[OBSERVATION][padded] = 1e4
    if kind is DistillationLoss:
        dirty[ROLLOUT] = td[ROLLOUT] ^ padded

    def make(**arguments):
        return kind(actor(), **arguments)

    check_contract(make, td, 2 if continuous else 4, dirty)


def test_a_mask_counts_where_there_is_one():
    td = batch(20)
    masked, bare = bc(td), td.exclude(VALID)
    everyone = bc(td, torch.ones_like(td[VALID]))
    assert not torch.isclose(everyone, masked)
    torch.testing.assert_close(bc(bare), everyone)
    with pytest.raises(KeyError, match="no mask"):  # nobody could tell padding from what is to be trained on
        BCLoss(categorical_actor(observation=VALID))._mask(bare)
    # TorchRL's own masks count, too.
    td = batch(4, 5)
    keep = torch.rand(4, 5, 1) < 0.5
    found = bc(td.clone().set(("collector", "mask"), keep))
    torch.testing.assert_close(found, bc(td, td[VALID] & keep))


@pytest.mark.parametrize("kind", [LogNormal, Weibull])
def test_padding_leaves_gradients_finite_where_zero_has_no_likelihood(kind):
    td = TensorDict(observation=torch.randn(3, 4), action=torch.rand(3, 2) + 0.5, batch_size=[3])
    td[VALID], parameters = torch.tensor([[True], [False], [True]]).expand(3, 2), ["loc", "scale"]
    gradients = []
    for one in (td, td[[0, 2]]):
        torch.manual_seed(0)
        network = nn.Sequential(nn.Linear(4, 4), nn.Softplus(), NormalParamExtractor())
        names = dict(zip(inspect.signature(kind).parameters, parameters, strict=False))
        module = TensorDictModule(network, ["observation"], parameters)
        loss = BCLoss(ProbabilisticActor(module, names, distribution_class=kind))
        loss.set_keys(action="action")
        loss(one)["loss_bc"].backward()
        gradients.append([parameter.grad for parameter in loss.parameters()])
    torch.testing.assert_close(*gradients)


def test_bad_inputs_are_refused():
    with pytest.raises(KeyError, match="no expert action"):
        BCLoss(categorical_actor())(batch(5).exclude(ACTION))
    td = batch(5)
    td[ROLLOUT] = td[ROLLOUT].long()
    with pytest.raises(ValueError, match=r"rollout flag .* is torch.int64"):
        DistillationLoss(categorical_actor())(td)


@pytest.mark.parametrize("shape", [(6, 1), (6, 6), (1,), ()])
def test_an_action_of_another_shape_is_refused_where_it_would_be_broadcast(shape):
    td = TensorDict(batch_size=[])
    td[OBSERVATION], td[ACTION] = torch.randn(6, 4), torch.zeros(shape, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"action .* has shape"):
        BCLoss(categorical_actor())(td)
    td[ACTION] = torch.randn(6, 1)
    with pytest.raises(ValueError, match=r"has shape \(6, 1\), the actor's are \(6, 2\)"):
        BCLoss(gaussian_actor())(td)


@pytest.mark.parametrize("agents", [3, 7])
def test_one_hot_actions_are_those_of_their_indices(agents):
    td = batch(4, agents=agents)
    one_hot = td.clone().set(ACTION, functional.one_hot(td[ACTION], 7))
    wanted = BCLoss(categorical_actor())(td)
    found = BCLoss(categorical_actor(kind=OneHotCategorical))(one_hot)
    torch.testing.assert_close(dict(found.items()), dict(wanted.items()))
