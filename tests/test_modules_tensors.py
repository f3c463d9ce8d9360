"""A module of tensors does what TensorDict's own does, whatever it is asked."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential, set_skip_existing
from torch import Tensor, nn

from symphony.modules.tensors import TensorModule

X, Y, Z = ("agents", "x"), ("agents", "y"), "z"
KINDS = [TensorDictModule, TensorModule]


class Both(nn.Module):
    """Two numbers of two."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(3.0))

    def forward(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return self.factor * x, x + y


def given() -> TensorDict:
    return TensorDict({X: torch.rand(4, generator=torch.Generator().manual_seed(0)), Y: torch.ones(4)}, [4])


@pytest.mark.parametrize("kind", KINDS)
def test_results_are_written_where_they_belong(kind: type[TensorDictModule]) -> None:
    module, data = kind(Both(), in_keys=[X, Y], out_keys=[Z, Y]), given()
    assert module(data) is data
    torch.testing.assert_close(data[Z], 3.0 * data[X])
    torch.testing.assert_close(data[Y], data[X] + 1.0)
    data[Z].sum().backward()
    assert module.module.factor.grad is not None
    assert list(module.state_dict()) == ["module.factor"]


@pytest.mark.parametrize("kind", KINDS)
def test_one_result_needs_no_tuple(kind: type[TensorDictModule]) -> None:
    found = kind(torch.neg, in_keys=[X], out_keys=[Z])(given())
    torch.testing.assert_close(found[Z], -given()[X])


@pytest.mark.parametrize("kind", KINDS)
def test_results_go_elsewhere_if_asked(kind: type[TensorDictModule]) -> None:
    module, data, out = kind(Both(), in_keys=[X, Y], out_keys=[Z, "w"]), given(), TensorDict({}, [4])
    assert module(data, tensordict_out=out) is out
    assert set(out.keys()) == {Z, "w"}
    assert Z not in data.keys()  # noqa: SIM118 - a TensorDict has no other way to ask


@pytest.mark.parametrize("kind", KINDS)
def test_only_some_results_are_kept_if_asked(kind: type[TensorDictModule]) -> None:
    module, data = kind(Both(), in_keys=[X, Y], out_keys=[Z, "w"]), given()
    module.select_out_keys("w")
    assert module.out_keys == ["w"]
    assert {"w"} == set(module(data).keys()) - {"agents"}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_there_stays_if_asked(kind: type[TensorDictModule]) -> None:
    module, data = kind(torch.neg, in_keys=[X], out_keys=[Z]), given().set(Z, torch.full((4,), 7.0))
    with set_skip_existing(True):
        assert (module(data)[Z] == 7.0).all()
    assert (module(data)[Z] < 7.0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_tensors_will_do_for_entries(kind: type[TensorDictModule]) -> None:
    module = kind(Both(), in_keys=["x", "y"], out_keys=[Z, "w"])
    first, second = module(x=torch.ones(3), y=torch.zeros(3))
    assert (first == 3.0).all()
    assert (second == 1.0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_missing_is_named(kind: type[TensorDictModule]) -> None:
    sequence = TensorDictSequential(kind(Both(), in_keys=[X, "nowhere"], out_keys=[Z, "w"]))
    with pytest.raises((KeyError, TypeError), match=r"nowhere|None"):
        sequence(given())


def test_as_many_results_as_there_are_names() -> None:
    for names in ([Z], [Z, "w", "v"]):
        with pytest.raises(ValueError, match="zip"):
            TensorModule(Both(), in_keys=[X, Y], out_keys=names)(given())
