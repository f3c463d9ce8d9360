"""What TorchRL's own tests ask of every loss module."""

from __future__ import annotations

import copy

import pytest
import torch


def check_contract(make, td, name, parameters):
    """Keys, dispatch, gradients, state and copies of a loss.

    `make()` builds the loss with a network of its own, always with the same weights; `td` is a batch for it,
    `name` the loss among its outputs and `parameters` how many tensors its network trains.
    """
    _check_outputs(make(), td, name)
    _check_keys(make, td, name)
    _check_dispatch(make(), td, name)
    _check_gradients(make(), td, name, parameters)
    _check_state(make, td, name)


def _check_outputs(loss, td, name):
    before = td.clone()
    out = loss(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert (td == before).all()
    assert out.batch_size == torch.Size([])
    assert set(out.keys()) == set(loss.out_keys)
    # A trainer optimises the sum of all that starts with "loss".
    assert [key for key in loss.out_keys if key.startswith("loss")] == [name]
    assert out[name].requires_grad
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
    for value, key in zip(loss(**arguments), loss.out_keys, strict=True):
        torch.testing.assert_close(value, from_td[key], equal_nan=True)
    loss.select_out_keys(name)
    torch.testing.assert_close(loss(**arguments), from_td[name])


def _check_gradients(loss, td, name, parameters):
    loss(td)[name].sum().backward()
    named = dict(loss.named_parameters())
    assert len(named) == parameters
    assert all(p.grad is not None and p.grad.norm() > 0 for p in named.values())


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
