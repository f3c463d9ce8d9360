"""The likelihood of goals."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.nn import functional

from helpers_objectives import VALID, check_contract, learned
from symphony.objectives import GoalLoss

ROUTES, LOGITS = ("agents", "routes"), ("agents", "goal_logits")
MASK, LABEL, SET = ("agents", "routes_mask"), ("agents", "goal"), ("agents", "goal_set")


class Choice(nn.Module):
    """A score for each route, whatever their number."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, 1, bias=False))

    def forward(self, routes):
        return self.net(routes).squeeze(-1)


def goal_network():
    torch.manual_seed(0)
    return TensorDictModule(Choice(), in_keys=[ROUTES], out_keys=[LOGITS])


def batch(*shape, agents=3, goals=6):
    torch.manual_seed(1)
    td = TensorDict(batch_size=shape)
    td[ROUTES] = torch.randn(*shape, agents, goals, 4)
    td[MASK] = torch.rand(*shape, agents, goals) < 0.6
    feasible = td[MASK].float() + 1e-9 * ~td[MASK].any(-1, keepdim=True)
    label = torch.multinomial(feasible.reshape(-1, goals), 1).reshape(*shape, agents)
    td[LABEL] = torch.where(td[MASK].any(-1) & (torch.rand(*shape, agents) < 0.9), label, -1)
    td[VALID] = torch.rand(*shape, agents) < 0.8
    return td


def counted(td):
    return td[VALID] & (td[LABEL] >= 0)


def fixed(logits):
    """A loss on given logits [..., N, G]."""
    network = TensorDictModule(nn.Identity(), in_keys=[LOGITS], out_keys=[LOGITS])
    td = TensorDict(batch_size=[])
    td[LOGITS] = logits
    return GoalLoss(network), td


@pytest.mark.parametrize("shape", [(40,), (8, 5)])
@pytest.mark.parametrize("reduction", [None, "mean", "sum", "none"])
def test_it_is_cross_entropy_over_the_feasible_goals(shape, reduction):
    td = batch(*shape)
    loss = GoalLoss(goal_network(), reduction=reduction)
    out = loss(td)
    logits = goal_network()(td.clone())[LOGITS]
    rows = zip(logits[counted(td)], td[MASK][counted(td)], td[LABEL][counted(td)], strict=True)
    values = torch.stack([functional.cross_entropy(row[mask], mask[:goal].sum()) for row, mask, goal in rows])
    assert len(values) > 20
    if reduction == "none":
        assert {value.shape for value in out.values()} == {td[VALID].shape}
        torch.testing.assert_close(out["loss_goal"][counted(td)], values)
        assert (out["loss_goal"][~counted(td)] == 0).all()
    else:
        torch.testing.assert_close(out["loss_goal"], values.sum() if reduction == "sum" else values.mean())


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_a_set_of_one_is_that_label(reduction):
    td = batch(30)
    sets = td.clone().set(SET, torch.arange(6) == td[LABEL][..., None]).exclude(LABEL)
    one, other = (learned(GoalLoss(goal_network(), reduction=reduction), data) for data in (td, sets))
    torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_of_several_right_goals_the_probabilities_are_added():
    probability = torch.tensor([[0.4, 0.3, 0.2, 0.1], [0.4, 0.3, 0.2, 0.1], [0.25, 0.25, 0.5, 0.0]])
    loss, td = fixed(probability.log().clamp(min=-50).requires_grad_())
    td[MASK] = torch.tensor([[1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]]).bool()
    td[SET] = torch.tensor([[0, 1, 0, 1], [1, 0, 0, 1], [1, 1, 1, 0]]).bool()
    td[LABEL] = torch.tensor([99, -1, 3])  # not read
    out = loss(td)
    torch.testing.assert_close(out["loss_goal"], -torch.tensor([0.4, 0.5, 1.0]).log().mean())
    torch.testing.assert_close(out["accuracy"], torch.tensor(2 / 3))
    torch.testing.assert_close(out["accuracy_top3"], torch.tensor(1.0))
    # Whatever goals are right, all of them become likelier together: the posterior shares the gradient out.
    (gradient,) = torch.autograd.grad(out["loss_goal"], td[LOGITS])
    share = torch.where(td[SET], probability, 0.0)
    share = share / share.sum(-1, keepdim=True)
    torch.testing.assert_close(gradient, (probability - share) / 3, atol=1e-6, rtol=0)


@pytest.mark.parametrize("why", ["no goal is known", "none is feasible", "all are padding", "there are none"])
def test_where_nothing_counts_it_is_zero_with_zero_gradient(why):
    td = batch(5)
    if why == "no goal is known":
        td[LABEL] = torch.full_like(td[LABEL], -1)
    elif why == "there are none":
        td[MASK], td[ROUTES] = td[MASK][..., :0], td[ROUTES][..., :0, :]
    else:
        key = MASK if why == "none is feasible" else VALID
        td[key] = torch.zeros_like(td[key])
    values, gradients = learned(GoalLoss(goal_network()), td)
    assert all((value == 0).all() for value in [*values, *gradients])


def test_it_keeps_the_contract_of_torchrl():
    td = batch(20)
    dirty = torch.cat([td, td[:4]])
    dirty[VALID][20:] = False
    dirty[LABEL] = torch.where(dirty[VALID], dirty[LABEL], 99)
    used = dirty[MASK] & counted(dirty)[..., None]
    dirty[ROUTES] = dirty[ROUTES].masked_fill(~used[..., None], 1e3)
    dirty[MASK] = torch.cat([dirty[MASK], torch.zeros(24, 3, 2, dtype=torch.bool)], -1)
    dirty[ROUTES] = torch.cat([dirty[ROUTES], dirty[ROUTES][..., :2, :]], -2)

    def make(**arguments):
        return GoalLoss(goal_network(), **arguments)

    check_contract(make, td, 3, dirty)


def test_bad_inputs_are_refused():
    loss, td = GoalLoss(goal_network()), batch(5)
    td[VALID][2, 1], td[MASK][2, 1, 3], td[MASK][2, 1, 0] = True, False, True
    for label in (3, 6):
        td[LABEL][2, 1] = label
        with pytest.raises(ValueError, match=r"at \[2, 1\] is not one of the feasible"):
            loss(td)
    td[SET] = td[MASK] | (torch.arange(6) == 3)
    with pytest.raises(ValueError, match="is not one of the feasible"):
        loss(td)
    del td[SET]
    td[MASK] = td[MASK][..., :4]
    with pytest.raises(ValueError, match=r"mask of goals .* has shape \(5, 3, 4\).*\(5, 3, 6\)"):
        loss(td)
