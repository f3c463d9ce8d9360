"""The behavioural-cloning loss, as TorchRL tests its own losses."""

from __future__ import annotations

import copy
import warnings

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
from torch.nn import functional
from torchrl.modules import MaskedCategorical, OneHotCategorical
from torchrl.objectives import BCLoss as TorchRLBCLoss

from symphony.objectives import BCLoss

OBSERVATION, LOGITS = ("agents", "observation"), ("agents", "logits")
ACTION, VALID = ("agents", "action"), ("agents", "valid")


def categorical_actor(classes=7, observation=OBSERVATION, logits=LOGITS, action=ACTION):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, classes))
    return ProbabilisticTensorDictSequential(
        TensorDictModule(network, in_keys=[observation], out_keys=[logits]),
        ProbabilisticTensorDictModule(
            in_keys={"logits": logits},
            out_keys=[action],
            distribution_class=Categorical,
            default_interaction_type=InteractionType.RANDOM,
        ),
    )


def independent_normal(loc, scale):
    return Independent(Normal(loc, scale), 1)


def gaussian_actor(observation="observation", action="action"):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 4), NormalParamExtractor())
    return ProbabilisticTensorDictSequential(
        TensorDictModule(network, in_keys=[observation], out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"], out_keys=[action], distribution_class=independent_normal
        ),
    )


def batch(*shape, agents=3, classes=7, observation=OBSERVATION, action=ACTION, valid=VALID):
    torch.manual_seed(1)
    td = TensorDict(batch_size=shape)
    td[observation] = torch.randn(*shape, agents, 4)
    td[action] = torch.randint(classes, (*shape, agents))
    td[valid] = torch.rand(*shape, agents) < 0.7
    return td


def expected(loss, td, smoothing=0.0, reduction="mean"):
    """Torch's cross entropy over the valid entries alone."""
    logits = loss.get_stateful_net("actor_network")[0].module(td[OBSERVATION][td[VALID]])
    return functional.cross_entropy(
        logits, td[ACTION][td[VALID]], label_smoothing=smoothing, reduction=reduction
    )


@pytest.mark.parametrize("shape", [(), (6,), (4, 5)])
@pytest.mark.parametrize("smoothing", [0.0, 0.1])
@pytest.mark.parametrize("reduction", [None, "mean", "sum", "none"])
def test_it_is_cross_entropy_over_valid_agents(shape, smoothing, reduction):
    td = batch(*shape)
    td[VALID][..., 0] = True
    loss = BCLoss(categorical_actor(), reduction=reduction, label_smoothing=smoothing)
    before = td.clone()
    out = loss(td)
    assert (td == before).all()
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert out.batch_size == torch.Size([])
    assert set(out.keys()) == {"loss_bc", "entropy", "accuracy"}
    reference = expected(loss, td, smoothing, reduction or "mean")
    if reduction == "none":
        assert out["loss_bc"].shape == out["accuracy"].shape == td[VALID].shape
        torch.testing.assert_close(out["loss_bc"][td[VALID]], reference)
        assert (out["loss_bc"][~td[VALID]] == 0).all()
    else:
        torch.testing.assert_close(out["loss_bc"], reference)


def test_entropy_and_accuracy_are_means_over_valid_agents_and_carry_no_gradient():
    td = batch(40)
    actor = categorical_actor()
    out = BCLoss(actor, reduction="sum")(td)
    logits = actor[0](td.clone())[LOGITS][td[VALID]]
    torch.testing.assert_close(out["entropy"], Categorical(logits=logits).entropy().mean())
    torch.testing.assert_close(out["accuracy"], (logits.argmax(-1) == td[ACTION][td[VALID]]).float().mean())
    assert out["loss_bc"].requires_grad
    assert not out["entropy"].requires_grad
    assert not out["accuracy"].requires_grad
    assert [key for key in out.keys() if key.startswith("loss")] == ["loss_bc"]  # noqa: SIM118 - a TensorDict


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_without_valid_agents_it_is_zero_with_zero_gradient(reduction):
    td = batch(5)
    td[VALID] = torch.zeros_like(td[VALID])
    actor = categorical_actor()
    loss = BCLoss(actor, reduction=reduction)(td)["loss_bc"]
    assert (loss == 0).all()
    loss.sum().backward()
    assert all((p.grad == 0).all() for p in actor.parameters())


def test_what_padded_agents_hold_has_no_influence():
    td = batch(30)
    dirty = td.clone()
    dirty[ACTION] = torch.where(td[VALID], td[ACTION], -1)
    dirty[OBSERVATION] = torch.where(td[VALID][..., None], td[OBSERVATION], 1e4)
    results = []
    for data in (td, dirty):
        actor = categorical_actor()
        loss = BCLoss(actor)(data)["loss_bc"]
        loss.backward()
        results.append([loss.detach(), *(p.grad for p in actor.parameters())])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)


def test_it_agrees_with_torchrl_on_flat_keys():
    td = TensorDict(observation=torch.randn(20, 4), action=torch.randn(20, 2), batch_size=[20])
    loss = BCLoss(gaussian_actor())
    loss.set_keys(action="action")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The name target_actor_network_params", UserWarning)
        theirs = TorchRLBCLoss(gaussian_actor())
    out = loss(td)
    assert set(out.keys()) == {"loss_bc"} == set(loss.out_keys)
    torch.testing.assert_close(out["loss_bc"], theirs(td)["loss_bc"])


def test_flat_keys_and_other_labels():
    actor = categorical_actor(observation="observation", logits="logits", action="action")
    td = TensorDict(observation=torch.randn(20, 4), goal=torch.randint(7, (20,)), batch_size=[20])
    loss = BCLoss(actor)
    loss.set_keys(action="goal")
    logits = actor[0](td.clone())["logits"]
    torch.testing.assert_close(loss(td)["loss_bc"], functional.cross_entropy(logits, td["goal"]))


def test_accepted_keys():
    loss = BCLoss(categorical_actor())
    with pytest.raises(ValueError, match="is not an accepted tensordict key"):
        loss.set_keys(unknown="x")
    assert loss.tensor_keys.action == ACTION
    assert loss.tensor_keys.valid == VALID
    assert set(loss.in_keys) == {OBSERVATION, ACTION, VALID}
    assert loss.tensor_keys is not BCLoss(categorical_actor()).tensor_keys


@pytest.mark.parametrize("name", ["action", "valid"])
@pytest.mark.parametrize("key", ["flat", ("deeply", "nested", "key")])
def test_each_key_can_be_set(name, key):
    loss = BCLoss(categorical_actor(), use_mask=True)
    td = batch(5)
    assert len(loss.in_keys) == 3
    reference = loss(td)["loss_bc"]
    default = getattr(loss.tensor_keys, name)
    td.rename_key_(default, key)
    with pytest.raises(KeyError):
        loss(td)
    loss.set_keys(**{name: key})
    assert key in loss.in_keys
    assert default not in loss.in_keys
    torch.testing.assert_close(loss(td)["loss_bc"], reference)
    loss.set_keys(**{name: None})
    assert getattr(loss.tensor_keys, name) == default


def test_dispatch_equals_a_tensordict():
    loss = BCLoss(categorical_actor())
    td = batch(6)
    by_key = loss(**{"_".join(key): td[key] for key in loss.in_keys})
    from_td = loss(td)
    for value, key in zip(by_key, loss.out_keys, strict=True):
        torch.testing.assert_close(value, from_td[key])
    loss.select_out_keys("loss_bc")
    torch.testing.assert_close(loss(**{"_".join(key): td[key] for key in loss.in_keys}), from_td["loss_bc"])


def test_all_parameters_of_the_actor_and_only_those_get_a_gradient():
    actor = categorical_actor()
    loss = BCLoss(actor)
    td = batch(20)
    td[OBSERVATION] = td[OBSERVATION].requires_grad_()
    loss(td)["loss_bc"].backward()
    named = dict(loss.named_parameters())
    assert len(named) == len(list(actor.parameters())) == 4
    assert all(p.grad is not None and p.grad.norm() > 0 for p in named.values())
    assert {id(p) for p in named.values()} == {id(p) for p in actor.parameters()}


def test_training_it_imitates():
    torch.manual_seed(3)
    td = batch(200)
    td[ACTION] = (td[OBSERVATION][..., 0] > 0).long() + 2 * (td[OBSERVATION][..., 1] > 0).long()
    loss = BCLoss(categorical_actor())
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.03)
    for _ in range(150):
        optimizer.zero_grad()
        out = loss(td)
        out["loss_bc"].backward()
        optimizer.step()
    assert out["accuracy"] > 0.95


def test_reset_parameters_recursive():
    loss = BCLoss(categorical_actor())
    before = [p.detach().clone() for p in loss.parameters()]
    loss.reset_parameters_recursive()
    assert all(not torch.equal(a, b) for a, b in zip(before, loss.parameters(), strict=True))


def test_state_dict_round_trip():
    torch.manual_seed(0)
    loss, other = BCLoss(categorical_actor()), BCLoss(categorical_actor())
    other.reset_parameters_recursive()
    td = batch(5)
    assert loss(td)["loss_bc"] != other(td)["loss_bc"]
    other.load_state_dict(loss.state_dict())
    assert loss(td)["loss_bc"] == other(td)["loss_bc"]


def test_deepcopy_is_independent():
    loss = BCLoss(categorical_actor())
    td = batch(5)
    loss(td)
    clone = copy.deepcopy(loss)
    value = loss(td)["loss_bc"]
    assert clone(td)["loss_bc"] == value
    with torch.no_grad():
        for p in clone.parameters():
            p.zero_()
    assert loss(td)["loss_bc"] == value != clone(td)["loss_bc"]


def test_a_mask_counts_where_there_is_one():
    """And must be there if it is demanded, or read by the network anyway; False never reads it."""
    td = batch(20)
    assert not td[VALID].all()
    masked, bare = BCLoss(categorical_actor())(td)["loss_bc"], td.exclude(VALID)
    everyone = td.clone().set(VALID, torch.ones_like(td[VALID]))
    for loss, data in (
        (BCLoss(categorical_actor()), bare),
        (BCLoss(categorical_actor(), use_mask=False), td),
    ):
        torch.testing.assert_close(loss(data)["loss_bc"], BCLoss(categorical_actor())(everyone)["loss_bc"])
        assert not torch.isclose(loss(data)["loss_bc"], masked)
    torch.testing.assert_close(BCLoss(categorical_actor(), use_mask=True)(td)["loss_bc"], masked)
    assert VALID not in BCLoss(categorical_actor(), use_mask=False).in_keys
    # A network that reads the mask: what is without one can't be told from what is to be trained on.
    reading = BCLoss(categorical_actor(observation=VALID), use_mask=None)
    with pytest.raises(KeyError, match="use_mask=False"):
        reading._mask(bare)
    reading.set_keys(valid="other")
    assert reading._mask(bare) is None


def test_torchrl_masks_count_too():
    td = batch(4, 5)
    td[VALID] = torch.ones_like(td[VALID])
    keep = torch.rand(4, 5, 1) < 0.5
    td["collector", "mask"] = keep
    loss = BCLoss(categorical_actor())
    got = loss(td)["loss_bc"]
    td[VALID] = keep.expand(4, 5, 3)
    torch.testing.assert_close(got, expected(loss, td))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"label_smoothing": 1.0}, "label_smoothing must be in"),
        ({"label_smoothing": -0.1}, "label_smoothing must be in"),
        ({"reduction": "median"}, "unknown reduction"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        BCLoss(categorical_actor(), **arguments)


def test_bad_inputs_are_refused():
    with pytest.raises(ValueError, match="needs an actor whose distribution"):
        BCLoss(gaussian_actor(), label_smoothing=0.1)
    loss, td = BCLoss(categorical_actor(), use_mask=True), batch(5)
    with pytest.raises(KeyError, match="use_mask=False"):
        loss(td.exclude(VALID))
    with pytest.raises(KeyError, match="no expert action"):
        loss(td.exclude(ACTION))
    td[VALID] = td[VALID][:, :1]
    with pytest.raises(ValueError, match=r"mask .* has shape \(5, 1\).*\(5, 3\)"):
        loss(td)


@pytest.mark.parametrize("shape", [(6, 1), (6, 6), (1,), ()])
def test_an_action_of_another_shape_is_refused_where_it_would_be_broadcast(shape):
    loss, td = BCLoss(categorical_actor(action="action"), use_mask=False), TensorDict(batch_size=[])
    loss.set_keys(action="action")
    td[OBSERVATION], td["action"] = torch.randn(6, 4), torch.zeros(shape, dtype=torch.int64)
    with pytest.raises(ValueError, match="action 'action' has shape"):
        loss(td)
    loss = BCLoss(gaussian_actor())
    loss.set_keys(action="action")
    with pytest.raises(ValueError, match=r"has shape \(5, 1\), the actor's are \(5, 2\)"):
        loss(TensorDict(observation=torch.randn(5, 4), action=torch.randn(5, 1), batch_size=[5]))


def other_actor(kind):
    """Logits [..., 7] of the network are those of another categorical, one that may have a mask."""
    actor = categorical_actor()
    keys = {"logits": LOGITS, "mask": "mask"} if kind is MaskedCategorical else {"logits": LOGITS}
    head = ProbabilisticTensorDictModule(in_keys=keys, out_keys=[ACTION], distribution_class=kind)
    return ProbabilisticTensorDictSequential(actor[0], head)


@pytest.mark.parametrize("agents", [3, 7])
@pytest.mark.parametrize("smoothing", [0.0, 0.2])
def test_one_hot_actions_are_those_of_their_indices(agents, smoothing):
    td = batch(4, agents=agents)
    one_hot = td.clone().set(ACTION, functional.one_hot(td[ACTION], 7))
    wanted = BCLoss(categorical_actor(), label_smoothing=smoothing)(td)
    found = BCLoss(other_actor(OneHotCategorical), label_smoothing=smoothing)(one_hot)
    torch.testing.assert_close(dict(found.items()), dict(wanted.items()))


def test_label_smoothing_expects_nothing_of_categories_that_are_impossible():
    td = batch(5)
    td[ACTION] = td[ACTION] % 4
    td["mask"] = (torch.arange(7) < 4).expand(5, 3, 7)
    found = BCLoss(other_actor(MaskedCategorical), label_smoothing=0.2)(td)
    found["loss_bc"].backward()
    actor = categorical_actor()
    last = actor[0].module[-1]
    last.weight, last.bias = nn.Parameter(last.weight[:4]), nn.Parameter(last.bias[:4])
    fewer = BCLoss(actor, label_smoothing=0.2)(td)
    torch.testing.assert_close(found["loss_bc"], fewer["loss_bc"])
