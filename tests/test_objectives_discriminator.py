"""The discriminator's loss and the rank statistic it reports."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.nn import functional

import helpers_objectives as objectives
from helpers_objectives import OBSERVATION, VALID, check_contract
from symphony.objectives import DiscriminatorLoss, auc

SCORE, SIMULATED = ("agents", "score"), ("agents", "simulated")
PENALTY = {"gradient_penalty": 0.3}


def discriminator(*layers):
    torch.manual_seed(0)
    net = nn.Sequential(*(layers or (nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 1))), nn.Flatten(-2))
    return TensorDictModule(net, in_keys=[OBSERVATION], out_keys=[SCORE])


def batch(*shape):
    return objectives.batch(*shape).rename_key_(objectives.ROLLOUT, SIMULATED)


def fixed(score, simulated, **arguments):
    """A loss on given logits."""
    network = TensorDictModule(nn.Identity(), in_keys=["x"], out_keys=["score"])
    loss = DiscriminatorLoss(network, **arguments)
    loss.set_keys(score="score", simulated="simulated")
    return loss(TensorDict(x=score, simulated=simulated, batch_size=[]))


def test_by_hand():
    probability = torch.tensor([0.5, 0.8, 0.9, 0.2, 0.1, 0.5])  # one half decides for neither
    simulated = torch.tensor([True, True, True, True, False, False])
    out = fixed(probability.logit(), simulated)
    fake = torch.tensor([0.5, 0.8, 0.9, 0.2]).log().mean()
    real = torch.tensor([0.9, 0.5]).log().mean()
    torch.testing.assert_close(out["loss_discriminator"], -(fake + real) / 2)
    assert (out["accuracy_simulated"], out["accuracy_data"]) == (0.5, 0.5)
    torch.testing.assert_close(out["score_simulated"], probability[:4].logit().mean())
    torch.testing.assert_close(out["score_data"], probability[4:].logit().mean())
    assert out["auc"] == 6.5 / 8


@pytest.mark.parametrize("shape", [(40,), (8, 5)])
@pytest.mark.parametrize("reduction", [None, "sum", "none"])
def test_it_is_cross_entropy_with_a_mean_per_kind(shape, reduction):
    td = batch(*shape)
    out = DiscriminatorLoss(discriminator(), reduction=reduction)(td)
    logit = discriminator()(td.clone())[SCORE]
    classes = torch.stack([torch.zeros_like(logit), logit], -1).flatten(0, -2)
    entropy = functional.cross_entropy(classes, td[SIMULATED].long().flatten(), reduction="none").reshape(logit.shape)
    fake, real = td[VALID] & td[SIMULATED], td[VALID] & ~td[SIMULATED]
    assert 0 < real.sum() < fake.sum() / 2
    expected = {
        None: (entropy[fake].mean() + entropy[real].mean()) / 2,
        "sum": entropy[td[VALID]].sum(),
        "none": torch.where(td[VALID], entropy, 0.0),
    }[reduction]
    torch.testing.assert_close(out["loss_discriminator"], expected)
    assert all(out[key].ndim == 0 for key in ("auc", "accuracy_data", "score_simulated"))


def test_a_kind_that_is_absent_adds_nothing():
    td = batch(10)
    td[SIMULATED] = torch.ones_like(td[SIMULATED])
    network = discriminator()
    out = DiscriminatorLoss(network, **PENALTY)(td)
    logit = network(td.clone())[SCORE][td[VALID]]
    entropy = -functional.logsigmoid(logit).mean() / 2
    torch.testing.assert_close(out["loss_discriminator"], entropy + 0.3 * out["gradient_penalty"])
    assert out["gradient_penalty"] == 0
    assert all(out[key].isnan() for key in ("accuracy_data", "score_data", "auc"))
    assert out["accuracy_simulated"].isfinite()
    assert DiscriminatorLoss(network, **PENALTY)(td[:0])["loss_discriminator"] == 0
    td[VALID] = torch.zeros_like(td[VALID])
    loss = DiscriminatorLoss(network, **PENALTY)(td)["loss_discriminator"]
    assert loss == 0
    loss.backward()
    assert all((p.grad == 0).all() for p in network.parameters())


@pytest.mark.parametrize("arguments", [{}, PENALTY, {**PENALTY, "reduction": "none"}])
def test_it_keeps_the_contract_of_torchrl(arguments):
    td = batch(20)
    dirty, padded = td.clone(), ~td[VALID]
    dirty[SIMULATED] = td[SIMULATED] ^ padded
    dirty[OBSERVATION][padded] = 1e3

    def make(**more):
        return DiscriminatorLoss(discriminator(), **{**arguments, **more})

    check_contract(make, td, 4, dirty)


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_the_penalty_of_a_linear_discriminator_is_its_weight(reduction):
    """The gradient of w . x is w wherever x is."""
    td, net = batch(20), nn.Linear(4, 1)
    loss, without = (DiscriminatorLoss(discriminator(net), gradient_penalty=k, reduction=reduction) for k in (0.5, 0))
    out, plain = loss(td), without(td)
    with torch.inference_mode():
        assert (loss(td)["loss_discriminator"] == out["loss_discriminator"]).all()
    squared, where = net.weight.square().sum(), td[VALID] & ~td[SIMULATED]
    torch.testing.assert_close(out["gradient_penalty"], squared.detach())
    added = {"mean": torch.tensor(1.0), "sum": where.sum(), "none": where.float()}[reduction]
    more = out["loss_discriminator"] - plain["loss_discriminator"]
    torch.testing.assert_close(more, added * 0.5 * squared)
    torch.testing.assert_close(torch.autograd.grad(more.sum(), net.weight)[0], added.sum() * net.weight)


def test_bad_inputs_are_refused():
    td, loss = batch(5), DiscriminatorLoss(discriminator())
    with pytest.raises(KeyError, match="no flag under"):
        loss(td.exclude(SIMULATED))
    wrong = td.clone().set(SIMULATED, td[SIMULATED].float())
    with pytest.raises(ValueError, match=r"flag .* is torch.float32"):
        loss(wrong)
    wrong[SIMULATED] = td[SIMULATED][..., None]
    with pytest.raises(ValueError, match=r"flag .* has shape \(5, 3, 1\).*\(5, 3\)"):
        loss(wrong)
    shared = TensorDictModule(lambda x, y: x.sum(-1) + y.sum(), [OBSERVATION, "shared"], [SCORE])
    td["shared"] = torch.randn(5, 2)
    with pytest.raises(ValueError, match=r"penalised input has shape \(5, 2\), expected \(5, 3\) in front"):
        DiscriminatorLoss(shared, gradient_penalty=1.0)(td)


scores = st.sampled_from([-torch.inf, -2.0, -0.0, 0.0, 0.5, 1.0, torch.inf]) | st.floats(-3, 3, width=32)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(scores, st.booleans(), st.booleans()), max_size=30))
def test_auc_counts_pairs(entries):
    score = torch.tensor([s for s, _, _ in entries], dtype=torch.float32)
    positive, valid = (torch.tensor([e[k] for e in entries], dtype=torch.bool) for k in (1, 2))
    a, b = score[positive & valid][:, None], score[~positive & valid]
    found = auc(score, positive, valid)
    if a.numel() and b.numel():
        assert float(found) == pytest.approx(float(((a > b).double() + 0.5 * (a == b)).mean()), abs=1e-6)
    else:
        assert found.isnan()


def test_auc_of_strange_scores():
    positive = torch.tensor([True, False, True])
    assert auc(torch.tensor([1.0, 0.0, torch.nan]), positive).isnan()
    assert auc(torch.tensor([1.0, 0.0, torch.nan]), positive, torch.tensor([True, True, False])) == 1
    with pytest.raises(ValueError, match=r"positive is torch\.int64"):
        auc(torch.rand(3), positive.long())
    with pytest.raises(ValueError, match=r"valid is torch.bool \(1, 3\)"):
        auc(torch.rand(3), positive, positive[None])
