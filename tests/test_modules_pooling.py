"""Max-pooling through winners equals the dense one, and sets do not depend on their neighbours."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from symphony.modules import mlp, pool_elements, pooling


def make(n=7, count=60, features=5, hidden=16, share=0.6, dtype=torch.float64, seed=0):
    torch.manual_seed(seed)
    network = mlp((features, hidden, hidden)).to(dtype)
    elements = torch.randn(n, count, features, dtype=dtype)
    mask = torch.rand(n, count) < share
    mask[0] = False
    mask[1] = True
    return network, elements, mask


def results(network, elements, mask, mode):
    elements = elements.clone().requires_grad_()
    pooled = pool_elements(network, elements, mask, mode=mode)
    weights = torch.linspace(-1, 2, pooled.numel(), dtype=pooled.dtype, device=pooled.device).view_as(pooled)
    gradients = torch.autograd.grad((pooled * weights).sum(), [elements, *network.parameters()])
    return [pooled.detach(), *gradients]


def reference(network, elements, mask):
    """One set, one element at a time."""
    rows = []
    for row, row_mask in zip(elements, mask, strict=True):
        encoded = [network(element) for element, ok in zip(row, row_mask, strict=True) if ok]
        width = network(elements.new_zeros(elements.shape[-1])).shape[-1]
        rows.append(torch.stack(encoded).amax(0) if encoded else elements.new_zeros(width))
    return torch.stack(rows)


@pytest.mark.parametrize("mode", ["auto", "dense", "winner"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("rows", [1, 150, 100_000])
def test_values_and_gradients_equal_an_elementwise_reference(mode, dtype, tolerance, rows, monkeypatch):
    network, elements, mask = make(dtype=dtype)
    monkeypatch.setattr(pooling, "ROWS", rows)
    got = results(network, elements, mask, mode)
    leaf = elements.clone().requires_grad_()
    pooled = reference(network, leaf, mask)
    weights = torch.linspace(-1, 2, pooled.numel(), dtype=dtype).view_as(pooled)
    expected = [pooled, *torch.autograd.grad((pooled * weights).sum(), [leaf, *network.parameters()])]
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)
    with torch.no_grad():
        again = pool_elements(network, elements, mask, mode=mode)
    torch.testing.assert_close(again, pooled.detach(), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(
    "network",
    [
        nn.Linear(3, 4),
        nn.Sequential(nn.Linear(3, 4, bias=False), nn.Tanh()),
        mlp((3, 4)),
        mlp((3, 5, 4)),
        mlp((3, 4, 6, 4)),
    ],
)
@pytest.mark.parametrize("mode", ["dense", "winner"])
def test_gradcheck_for_any_row_wise_function(network, mode):
    torch.manual_seed(1)
    network = network.double()
    elements = torch.randn(3, 6, 3, dtype=torch.float64, requires_grad=True)
    mask = torch.tensor([[1, 1, 0, 1, 1, 1], [0] * 6, [0, 0, 0, 0, 1, 0]], dtype=torch.bool)
    parameters = list(network.parameters())

    def pooled(x, *_):
        return pool_elements(network, x, mask, mode=mode)

    assert torch.autograd.gradcheck(pooled, (elements, *parameters))
    assert torch.autograd.gradgradcheck(pooled, (elements, *parameters))


@pytest.mark.parametrize("mode", ["dense", "winner"])
def test_masked_elements_have_no_influence_whatever_they_hold(mode):
    network, elements, mask = make()
    clean = results(network, elements, mask, mode)
    for garbage in (1e30, torch.nan, torch.inf):
        dirty = results(network, torch.where(mask[..., None], elements, garbage), mask, mode)
        for a, b in zip(clean, dirty, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
        assert (dirty[1][~mask] == 0).all()


@pytest.mark.parametrize("mode", ["dense", "winner"])
def test_empty_sets_give_zeros_and_no_gradient(mode):
    network, elements, mask = make()
    pooled, gradient, *parameters = results(network, elements, torch.zeros_like(mask), mode)
    assert not any(t.any() for t in (pooled, gradient, *parameters))


@given(seed=st.integers(0, 10_000), extra=st.integers(1, 30))
@settings(max_examples=25, deadline=None)
def test_order_and_padding_of_the_elements_change_nothing(seed, extra):
    network, elements, mask = make(n=3, count=55, seed=seed)
    base = results(network, elements, mask, "winner")
    order = torch.randperm(elements.shape[1])
    shuffled = results(network, elements[:, order], mask[:, order], "winner")
    shuffled[1] = shuffled[1][:, order.argsort()]
    padding = torch.full((3, extra, elements.shape[2]), 1e6, dtype=elements.dtype)
    padded = results(
        network,
        torch.cat([padding, elements], 1),
        torch.cat([torch.zeros(3, extra, dtype=torch.bool), mask], 1),
        "winner",
    )
    padded[1] = padded[1][:, extra:]
    for other in (shuffled, padded):
        for a, b in zip(base, other, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("mode", ["dense", "winner"])
def test_among_equal_elements_the_first_gets_the_gradient(mode):
    network, elements, _ = make(n=2, dtype=torch.float32)
    same = elements[:1, :1].expand(1, 60, -1).clone()
    mask = torch.ones(1, 60, dtype=torch.bool)
    mask[:, :2] = False
    gradient = results(network, same, mask, mode)[1]
    assert gradient[0, 2].any()
    assert not gradient[0, 3:].any()


@pytest.mark.parametrize(("count", "hidden"), [(16, 64), (200, 64), (1000, 8), (13, 2)])
def test_a_result_does_not_depend_on_the_sets_beside_it(count, hidden):
    network, elements, mask = make(n=12, count=count, hidden=hidden, dtype=torch.float32)
    mask[2] &= torch.arange(count) == 5
    order = torch.randperm(12)
    with torch.no_grad():
        whole = pool_elements(network, elements, mask)
        for rows in (slice(0, 1), slice(5, 12), order):
            found = pool_elements(network, elements[rows], mask[rows])
            torch.testing.assert_close(found, whole[rows], rtol=1e-5, atol=1e-5)
        assert torch.equal(pool_elements(network, elements, mask), whole)


def test_only_valid_elements_are_encoded() -> None:
    network, elements, _ = make(n=100, count=16, dtype=torch.float32)
    mask = torch.zeros(100, 16, dtype=torch.bool)
    mask[::10, ::8] = True
    encoded = []
    network.register_forward_hook(lambda module, inputs, out: encoded.append(len(out)))
    pool_elements(network, elements, mask)
    with torch.no_grad():
        pool_elements(network, elements, mask)
    assert encoded == [20, 20]


class Doubled(nn.Sequential):
    """A network of plain layers that is more than these."""

    def forward(self, x: Tensor) -> Tensor:
        return 2.0 * super().forward(x)


def spectral(network: nn.Sequential) -> nn.Sequential:
    nn.utils.spectral_norm(network[0])  # a hook makes the weight anew at each call
    return network.eval()


def watched(network: nn.Sequential) -> nn.Sequential:
    network[1].register_forward_hook(lambda module, inputs, out: 0.5 * out)
    return network


def clipped(network: nn.Sequential) -> nn.Sequential:
    network[2].register_full_backward_hook(lambda module, above, below: tuple(0.1 * g for g in above))
    return network


@pytest.mark.parametrize("change", [lambda network: Doubled(*network), spectral, watched, clipped])
def test_what_a_network_does_beside_its_layers_is_done(change) -> None:
    _, elements, mask = make(dtype=torch.float32)
    network = change(mlp((5, 16, 16)))
    with torch.no_grad():
        for weight in network.parameters():
            weight.mul_(3.0)
        dense, winner = (pool_elements(network, elements, mask, mode=mode) for mode in ("dense", "winner"))
    torch.testing.assert_close(winner, dense)
    found = []
    for mode in ("dense", "winner"):
        network.zero_grad()
        pool_elements(network, elements, mask, mode=mode).square().sum().backward()
        found.append([weight.grad.clone() for weight in network.parameters()])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-4)


def test_leading_dimensions_and_empty_inputs():
    network, elements, mask = make(n=6)
    pooled = pool_elements(network, elements.view(2, 3, 60, 5), mask.view(2, 3, 60))
    assert torch.equal(pooled.view(6, -1), pool_elements(network, elements, mask))
    assert pool_elements(network, elements[:, :0], mask[:, :0]).eq(0).all()
    assert pool_elements(network, elements[:, :0], mask[:, :0]).shape == (6, 16)
    assert pool_elements(network, elements[:0], mask[:0]).shape == (0, 16)
    assert pool_elements(network, elements[0], mask[0]).shape == (16,)


def test_bad_arguments_are_refused():
    network, elements, mask = make()
    with pytest.raises(ValueError, match="bool mask of shape"):
        pool_elements(network, elements, mask[:, 1:])
    with pytest.raises(ValueError, match="bool mask of shape"):
        pool_elements(network, elements, mask.float())
    with pytest.raises(ValueError, match="unknown mode"):
        pool_elements(network, elements, mask, mode="fast")
    with pytest.raises(ValueError, match="input and an output"):
        mlp((3,))


@pytest.mark.parametrize("at_once", [1, 60, 100, 150, 420])
def test_elsewhere_many_elements_are_encoded_a_part_at_a_time(at_once, monkeypatch):
    network, elements, mask = make()
    monkeypatch.setattr(pooling, "AT_ONCE", at_once)
    monkeypatch.setattr(pooling, "on_host", lambda _: False)
    sizes = []
    network.register_forward_pre_hook(lambda _, given: sizes.append(len(given[0])))
    with torch.no_grad():
        pooled = pool_elements(network, elements, mask)
    assert max(sizes) <= max(at_once, 60)
    assert len(sizes) == -(-7 // max(1, at_once // 60))
    torch.testing.assert_close(pooled, reference(network, elements, mask))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("mode", ["auto", "dense", "winner"])
def test_cuda_agrees_with_the_cpu(mode):
    network, elements, mask = make()
    expected = results(network, elements, mask, "dense")
    got = results(network.cuda(), elements.cuda(), mask.cuda(), mode)
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a.cpu(), b, rtol=1e-9, atol=1e-9)


def test_many_sets_of_weights_at_once_give_what_each_gives_alone() -> None:
    """TorchRL runs critics under vmap, where nothing may be written in place or looked at."""
    networks = [mlp((5, 8, 8)) for _ in range(3)]
    elements, mask = torch.randn(4, 70, 5), torch.rand(4, 70) < 0.7
    parameters, _ = torch.func.stack_module_state(networks)
    encoder = networks[0]

    def pooled(weights: dict[str, Tensor], seen: Tensor) -> Tensor:
        def function(x: Tensor) -> Tensor:
            return torch.func.functional_call(encoder, weights, (x,))

        return pool_elements(function, elements, seen, mode="winner").relu()

    with torch.no_grad():
        masks = torch.stack([mask, ~mask, torch.ones_like(mask)])
        together = torch.func.vmap(pooled)(parameters, masks)
        for network, seen, found in zip(networks, masks, together, strict=True):
            torch.testing.assert_close(found, pool_elements(network, elements, seen, mode="dense").relu())
