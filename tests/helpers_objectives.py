"""The demands of TorchRL's own tests on every loss module, and actors and batches for those that imitate."""

from __future__ import annotations

import copy
import inspect

import pytest
import torch
from tensordict import TensorDict
from tensordict import nn as parts
from torch import nn
from torch.distributions import Categorical, Independent, Normal

OBSERVATION, LOGITS, ACTION = ("agents", "observation"), ("agents", "logits"), ("agents", "action")
VALID, ROLLOUT = ("agents", "valid"), ("agents", "rollout")


def categorical_actor(classes=7, observation=OBSERVATION, action=ACTION, kind=Categorical):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, classes))
    how = {"distribution_class": kind, "default_interaction_type": parts.InteractionType.RANDOM}
    head = parts.ProbabilisticTensorDictModule(in_keys={"logits": LOGITS}, out_keys=[action], **how)
    body = parts.TensorDictModule(network, [observation], [LOGITS])
    return parts.ProbabilisticTensorDictSequential(body, head)


def independent_normal(loc, scale):
    return Independent(Normal(loc, scale), 1)


def gaussian_actor(observation=OBSERVATION, action=ACTION):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 4), parts.NormalParamExtractor())
    keys = {name: name if observation == "observation" else ("agents", name) for name in ("loc", "scale")}
    head = parts.ProbabilisticTensorDictModule(keys, [action], distribution_class=independent_normal)
    body = parts.TensorDictModule(network, [observation], [*keys.values()])
    return parts.ProbabilisticTensorDictSequential(body, head)


def batch(*shape, agents=3, classes=7, continuous=False):
    torch.manual_seed(1)
    td = TensorDict(batch_size=shape)
    td[OBSERVATION] = torch.randn(*shape, agents, 4)
    td[ACTION] = torch.randn(*shape, agents, 2) if continuous else torch.randint(classes, (*shape, agents))
    td[VALID] = torch.rand(*shape, agents) < 0.7
    # Whole entries come from one source, and there are many more rollouts than experts.
    td[ROLLOUT] = (torch.rand(*shape, 1) < 0.8).expand(*shape, agents).clone()
    return td


def learned(loss, td):
    """Return what a loss reports, and the gradients of its parameters."""
    loss.zero_grad(set_to_none=True)
    out = loss(td)
    next(out[key] for key in loss.out_keys if key.startswith("loss")).sum().backward()
    return [value.detach() for value in out.values()], [p.grad for p in loss.parameters()]


def check_contract(make, td, parameters, dirty=None):
    """Keys, dispatch, gradients, state, copies and refusals of a loss that ``make`` builds, always with the same
    weights, for a batch; its network trains so many ``parameters``; ``dirty`` batches differ in what does not count.
    """
    loss = make()
    (name,) = (key for key in loss.out_keys if key.startswith("loss"))
    _check_outputs(loss, td, name)
    _check_keys(make, td, name)
    _check_dispatch(make(), td, name)
    _, gradients = learned(make(), td)
    assert len(gradients) == parameters
    assert all(gradient is not None and gradient.norm() > 0 for gradient in gradients)
    if dirty is not None:
        torch.testing.assert_close(learned(make(), dirty), learned(make(), td), equal_nan=True)
    _check_state(make, td, name)
    _check_refusals(make, td)


def _check_outputs(loss, td, name):
    before = td.clone()
    out = loss(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert (td == before).all()
    assert out.batch_size == torch.Size([])
    assert set(out.keys()) == set(loss.out_keys)
    assert out[name].requires_grad
    # A trainer optimises the sum of all that starts with "loss".
    assert not any(out[key].requires_grad for key in loss.out_keys if key != name)
    assert out[name].isfinite().all()
    with torch.no_grad():
        silent = loss(td)
    assert not silent[name].requires_grad
    torch.testing.assert_close(silent[name], out[name].detach())


def _check_keys(make, td, name):
    with pytest.raises(ValueError, match="is not an accepted tensordict key"):
        make().set_keys(unknown="x")
    assert make().tensor_keys is not make().tensor_keys
    reference = make()(td)[name]
    for field in make().default_keys.__dataclass_fields__:
        default = getattr(make().tensor_keys, field)
        if default not in td.keys(True, True):
            continue
        for key in ("flat", ("deeply", "nested", "key")):
            loss, renamed = make(), td.clone()
            assert default in loss.in_keys
            renamed.rename_key_(default, key)
            if field != "valid":  # without a mask all count
                with pytest.raises(KeyError):
                    loss(renamed)
            loss.set_keys(**{field: key})
            assert key in loss.in_keys
            assert default not in loss.in_keys
            torch.testing.assert_close(loss(renamed)[name], reference)
            loss.set_keys(**{field: None})
            assert getattr(loss.tensor_keys, field) == default


def _check_dispatch(loss, td, name):
    present = [key for key in loss.in_keys if key in td.keys(True)]
    arguments = {key if isinstance(key, str) else "_".join(key): td[key] for key in present}
    from_td = loss(td)
    values = loss(**arguments)
    for value, key in zip(values if isinstance(values, tuple) else (values,), loss.out_keys, strict=True):
        torch.testing.assert_close(value, from_td[key], equal_nan=True)
    loss.select_out_keys(name)
    torch.testing.assert_close(loss(**arguments), from_td[name])


def _check_state(make, td, name):
    loss, other = make(), make()
    before = [p.detach().clone() for p in other.parameters()]
    other.reset_parameters_recursive()
    assert all(not torch.equal(a, b) for a, b in zip(before, other.parameters(), strict=True))
    value = loss(td)[name]
    assert not torch.equal(value, other(td)[name])
    other.load_state_dict(loss.state_dict())
    assert torch.equal(value, other(td)[name])
    clone = copy.deepcopy(loss)
    assert torch.equal(value, clone(td)[name])
    with torch.no_grad():
        for p in clone.parameters():
            p.zero_()
    assert torch.equal(value, loss(td)[name])
    assert not torch.equal(value, clone(td)[name])


def _check_refusals(make, td):
    wrong = {"reduction": ["median"], "gradient_penalty": [-1.0]}
    accepted = inspect.signature(type(make())).parameters
    for argument, values in wrong.items():
        for value in values if argument in accepted else ():
            with pytest.raises(ValueError, match=argument):
                make(**{argument: value})
    key = make().tensor_keys.valid
    for mask, message in ((td[key].float(), "is torch.float32"), (td[key][..., None], "has shape")):
        with pytest.raises(ValueError, match=message):
            make()(td.clone().set(key, mask))
