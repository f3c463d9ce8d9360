"""Distillation of a search into the policy."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import nn
from torch.distributions import Categorical, Independent, Normal

from helpers_objectives import check_contract
from symphony.objectives import BCLoss, DistillationLoss

OBSERVATION, LOGITS = ("agents", "observation"), ("agents", "logits")
ACTION, VALID = ("agents", "action"), ("agents", "valid")
ROLLOUT = ("agents", "rollout")


def categorical_actor(classes=5):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, classes))
    return ProbabilisticTensorDictSequential(
        TensorDictModule(network, in_keys=[OBSERVATION], out_keys=[LOGITS]),
        ProbabilisticTensorDictModule(
            in_keys={"logits": LOGITS},
            out_keys=[ACTION],
            distribution_class=Categorical,
            default_interaction_type=InteractionType.RANDOM,
        ),
    )


def independent_normal(loc, scale):
    return Independent(Normal(loc, scale), 1)


def gaussian_actor():
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 4), NormalParamExtractor())
    loc, scale = ("agents", "loc"), ("agents", "scale")
    return ProbabilisticTensorDictSequential(
        TensorDictModule(network, in_keys=[OBSERVATION], out_keys=[loc, scale]),
        ProbabilisticTensorDictModule(
            in_keys={"loc": loc, "scale": scale}, out_keys=[ACTION], distribution_class=independent_normal
        ),
    )


def batch(*shape, agents=3, continuous=False):
    torch.manual_seed(1)
    td = TensorDict(batch_size=shape)
    td[OBSERVATION] = torch.randn(*shape, agents, 4)
    action = torch.randn(*shape, agents, 2) if continuous else torch.randint(5, (*shape, agents))
    td[ACTION] = action
    td[VALID] = torch.rand(*shape, agents) < 0.7
    # Whole entries come from one source, and there are many more rollouts than experts.
    td[ROLLOUT] = (torch.rand(*shape, 1) < 0.8).expand(*shape, agents).clone()
    return td


def bc(actor, td, mask, key="loss_bc", **arguments):
    td = td.clone()
    td[VALID] = mask
    return BCLoss(actor, **arguments)(td)[key]


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("reduction", [None, "sum"])
def test_it_is_one_bc_loss_per_kind(continuous, reduction):
    td = batch(30, continuous=continuous)
    actor = gaussian_actor() if continuous else categorical_actor()
    loss = DistillationLoss(actor, reduction=reduction)
    out = loss(td)
    expert, rollout = td[VALID] & ~td[ROLLOUT], td[VALID] & td[ROLLOUT]
    assert 0 < expert.sum() < rollout.sum()
    parts = [bc(actor, td, mask, reduction=reduction) for mask in (expert, rollout)]
    torch.testing.assert_close(out["loss_distillation"], parts[0] + parts[1])
    torch.testing.assert_close(out["nll_expert"], bc(actor, td, expert).detach())
    torch.testing.assert_close(out["nll_rollout"], bc(actor, td, rollout).detach())
    if not continuous:
        torch.testing.assert_close(out["accuracy"], bc(actor, td, expert, "accuracy"))
        torch.testing.assert_close(out["entropy"], bc(actor, td, expert, "entropy"))


def test_by_hand():
    """An actor with fixed probabilities 1/2, 1/4, 1/8, 1/8."""
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(nn.Linear(1, 4), in_keys=["x"], out_keys=["logits"]),
        ProbabilisticTensorDictModule(in_keys=["logits"], out_keys=["a"], distribution_class=Categorical),
    )
    with torch.no_grad():
        actor[0].module.bias.copy_(torch.tensor([0.5, 0.25, 0.125, 0.125]).log())
    td = TensorDict(x=torch.zeros(6, 1), a=torch.tensor([0, 1, 1, 3, 0, 0]), batch_size=[6])
    td["rollout"] = torch.tensor([False, False, True, True, True, True])
    td["valid"] = torch.tensor([True, True, True, True, True, False])
    loss = DistillationLoss(actor)
    loss.set_keys(action="a", valid="valid", rollout="rollout")
    out, bits = loss(td), (2 + 3 + 1) / 3
    expected = torch.tensor([1.5 + bits, 1.5, bits]) * torch.tensor(2.0).log()
    got = torch.stack([out["loss_distillation"], out["nll_expert"], out["nll_rollout"]])
    torch.testing.assert_close(got, expected)
    assert out["accuracy"] == 0.5


def test_without_reduction_it_keeps_the_shape():
    td = batch(6, 5)
    loss = DistillationLoss(categorical_actor(), reduction="none", label_smoothing=0.2)
    out = loss(td)
    plain = bc(categorical_actor(), td, td[VALID], reduction="none", label_smoothing=0.2)
    assert {value.shape for value in out.values()} == {td[VALID].shape}
    torch.testing.assert_close(out["loss_distillation"], plain)
    nll = bc(categorical_actor(), td, td[VALID], reduction="none").detach()
    torch.testing.assert_close(out["nll_expert"] + out["nll_rollout"], nll)
    assert (out["nll_expert"][td[ROLLOUT]] == 0).all()


def test_more_rollouts_weigh_no_more():
    td = batch(20)
    rollouts = td[td[ROLLOUT][:, 0]]
    many = torch.cat([td, rollouts, rollouts])
    one, other = (DistillationLoss(categorical_actor())(data) for data in (td, many))
    torch.testing.assert_close(one["loss_distillation"], other["loss_distillation"])


@pytest.mark.parametrize("absent", [True, False])
def test_a_kind_that_is_absent_adds_nothing(absent):
    td = batch(10)
    td[ROLLOUT] = torch.full_like(td[ROLLOUT], not absent)
    actor = categorical_actor()
    out = DistillationLoss(actor)(td)
    torch.testing.assert_close(out["loss_distillation"], bc(actor, td, td[VALID]))
    td[VALID] = torch.zeros_like(td[VALID])
    loss = DistillationLoss(actor)(td)["loss_distillation"]
    assert loss == 0
    loss.backward()
    assert all((p.grad == 0).all() for p in actor.parameters())


def test_what_padded_agents_hold_has_no_influence():
    td = batch(30)
    dirty = td.clone()
    dirty[ACTION] = torch.where(td[VALID], td[ACTION], -1)
    dirty[ROLLOUT] = td[ROLLOUT] ^ ~td[VALID]
    dirty[OBSERVATION] = torch.where(td[VALID][..., None], td[OBSERVATION], 1e4)
    results = []
    for data in (td, dirty):
        actor = categorical_actor()
        out = DistillationLoss(actor)(data)
        out["loss_distillation"].backward()
        results.append([*(v.detach() for v in out.values()), *(p.grad for p in actor.parameters())])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("continuous", [False, True])
def test_it_keeps_the_contract_of_torchrl(continuous):
    actor = gaussian_actor if continuous else categorical_actor
    td = batch(20, continuous=continuous)
    check_contract(
        lambda: DistillationLoss(actor(), use_mask=True),
        td,
        "loss_distillation",
        parameters=2 if continuous else 4,
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reduction": "median"}, "unknown reduction"),
        ({"label_smoothing": 1.0}, "label_smoothing must be in"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        DistillationLoss(categorical_actor(), **arguments)


def test_bad_inputs_are_refused():
    loss, td = DistillationLoss(categorical_actor()), batch(5)
    td[ROLLOUT] = td[ROLLOUT].long()
    with pytest.raises(ValueError, match=r"rollout flag .* is torch.int64"):
        loss(td)
