"""Policies, the goal policy, the discriminator and pooling: what they observe, and that nothing else matters."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch import nn

from symphony import keys, modules
from symphony.modules.policy import NO_ROUTE
from symphony.objectives import GoalLoss
from symphony.streams import uniform


def make(n=7, count=60, features=5, hidden=16, share=0.6, dtype=torch.float64, seed=0):
    torch.manual_seed(seed)
    network = modules.mlp((features, hidden, hidden)).to(dtype)
    elements, mask = torch.randn(n, count, features, dtype=dtype), torch.rand(n, count) < share
    mask[0] = False
    mask[1] = True
    return network, elements, mask


def results(network, elements, mask, mode):
    elements = elements.clone().requires_grad_()
    plain = mode == "reference"
    pooled = (reference if plain else partial(modules.pool_elements, mode=mode))(network, elements, mask)
    weights = torch.linspace(-1, 2, pooled.numel(), dtype=pooled.dtype, device=pooled.device).view_as(pooled)
    gradients = torch.autograd.grad((pooled * weights).sum(), [elements, *network.parameters()])
    return [pooled.detach(), *gradients]


def reference(network, elements, mask):
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
    monkeypatch.setattr(modules.pooling, "ROWS", rows)
    got, expected = (results(network, elements, mask, how) for how in (mode, "reference"))
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)
    with torch.no_grad():
        again = modules.pool_elements(network, elements, mask, mode=mode)
    torch.testing.assert_close(again, expected[0], rtol=tolerance, atol=tolerance)


UNEVEN = nn.Sequential(nn.Linear(3, 4, bias=False), nn.Tanh())


@pytest.mark.parametrize("network", [nn.Linear(3, 4), UNEVEN, modules.mlp((3, 5, 4))])
@pytest.mark.parametrize("mode", ["dense", "winner"])
def test_gradcheck_for_any_row_wise_function(network, mode):
    torch.manual_seed(1)
    network = network.double()
    elements = torch.randn(3, 6, 3, dtype=torch.float64, requires_grad=True)
    mask = torch.tensor([[1, 1, 0, 1, 1, 1], [0] * 6, [0, 0, 0, 0, 1, 0]], dtype=torch.bool)
    parameters = list(network.parameters())

    def pooled(x, *_):
        return modules.pool_elements(network, x, mask, mode=mode)

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


@given(seed=st.integers(0, 10_000), extra=st.integers(1, 30))
@settings(max_examples=25, deadline=None)
def test_order_and_padding_of_the_elements_change_nothing(seed, extra):
    network, elements, mask = make(n=3, count=55, seed=seed)
    base, order = results(network, elements, mask, "winner"), torch.randperm(elements.shape[1])
    shuffled = results(network, elements[:, order], mask[:, order], "winner")
    shuffled[1] = shuffled[1][:, order.argsort()]
    padding = torch.full((3, extra, elements.shape[2]), 1e6, dtype=elements.dtype)
    wider = torch.cat([padding, elements], 1), torch.cat([padding[..., 0] < 0, mask], 1)
    padded = results(network, *wider, "winner")
    padded[1] = padded[1][:, extra:]
    for other in (shuffled, padded):
        for a, b in zip(base, other, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("mode", ["dense", "winner"])
def test_among_equal_elements_the_first_gets_the_gradient(mode):
    network, elements, _ = make(n=2, dtype=torch.float32)
    same, mask = elements[:1, :1].expand(1, 60, -1).clone(), torch.ones(1, 60, dtype=torch.bool)
    mask[:, :2] = False
    gradient = results(network, same, mask, mode)[1]
    assert gradient[0, 2].any()
    assert not gradient[0, 3:].any()


@pytest.mark.parametrize("change", ["spectral", "clipped"])
def test_what_a_network_does_beside_its_layers_is_done(change):
    _, elements, mask = make(dtype=torch.float32)
    network, found = modules.mlp((5, 16, 16)), []
    if change == "spectral":
        nn.utils.spectral_norm(network[0])  # a hook makes the weight anew at each call
        network.eval()
    else:
        network[2].register_full_backward_hook(lambda module, above, below: tuple(0.1 * g for g in above))
    with torch.no_grad():
        for weight in network.parameters():
            weight.mul_(3.0)
    for mode in ("dense", "winner"):
        network.zero_grad()
        pooled = modules.pool_elements(network, elements, mask, mode=mode)
        pooled.square().sum().backward()
        found.append([pooled.detach(), *(weight.grad.clone() for weight in network.parameters())])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("at_once", [1, 60, 100, 150, 420])
def test_elsewhere_many_elements_are_encoded_a_part_at_a_time(at_once, monkeypatch):
    network, elements, mask = make()
    monkeypatch.setattr(modules.pooling, "AT_ONCE", at_once)
    monkeypatch.setattr(modules.pooling, "on_host", lambda _: False)
    sizes = []
    network.register_forward_pre_hook(lambda _, given: sizes.append(len(given[0])))
    with torch.no_grad():
        pooled = modules.pool_elements(network, elements, mask)
    assert max(sizes) <= max(at_once, 60)
    assert len(sizes) == -(-7 // max(1, at_once // 60))
    torch.testing.assert_close(pooled, reference(network, elements, mask))


def scene(*batch, agents=3, seed=0, own=6, objects=(4, 10), points=(60, 9), routes=(6, 7), valid=0.8):
    """Return random observations of some elements and features; agent 0 has all its routes, the last one none."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, agents)

    def randn(*size):
        return torch.randn(*shape, *size, generator=generator)

    def chance(p, *size):
        return torch.rand(*shape, *size, generator=generator) < p

    td = TensorDict(batch_size=batch)
    td[keys.OWN], td[keys.ROUTE], td[keys.ROAD] = randn(own), randn(6), 5 * randn(5)
    td[keys.OBJECTS], td[keys.OBJECTS_MASK] = randn(*objects), chance(0.7, objects[0])
    td[keys.POINTS], td[keys.POINTS_MASK] = randn(*points), chance(0.7, points[0])
    td[keys.GAP], td[keys.GAP_AHEAD] = 5 * randn(objects[0]), 5 * randn(objects[0], len(modules.FORESIGHT))
    td[keys.ROUTES], td[keys.ROUTES_MASK] = randn(*routes), chance(0.6, routes[0])
    td[keys.ROUTES_MASK][..., 0, :], td[keys.ROUTES_MASK][..., -1, :] = True, False
    td[keys.VALID] = chance(valid)
    td[keys.VALID][..., 0] = True
    return td


NAMES = (keys.OBJECTS, keys.OBJECTS_MASK, 10), (keys.POINTS, keys.POINTS_MASK, 9)
GROUPS = tuple(modules.ElementGroup(*names) for names in NAMES)


def policy(**kwargs):
    torch.manual_seed(0)
    return modules.discrete_policy(6, GROUPS, **kwargs)


def test_exploration_type_decides_how_actions_are_drawn():
    actor, td = policy(), scene(400)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        greedy = actor(td.clone())
    assert torch.equal(greedy[keys.ACTION], greedy[keys.LOGITS].argmax(-1))
    td[keys.NOISE] = torch.rand(400, 3)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        assert torch.equal(actor(td.clone())[keys.ACTION], greedy[keys.ACTION])
    with set_interaction_type(InteractionType.RANDOM):
        drawn = actor(td.clone())
    assert torch.equal(drawn[keys.ACTION], modules.inverse_cdf(drawn[keys.LOGITS], td[keys.NOISE]))
    assert torch.equal(actor(td.clone())[keys.ACTION], drawn[keys.ACTION])  # RANDOM unless told otherwise
    free = td.exclude(keys.NOISE)
    torch.manual_seed(5)
    first = actor(free.clone())[keys.ACTION]
    assert not torch.equal(actor(free.clone())[keys.ACTION], first)
    torch.manual_seed(5)
    assert torch.equal(actor(free.clone())[keys.ACTION], first)


def test_logits_and_actions_do_not_depend_on_the_batch():
    actor, td = policy(return_log_prob=True), scene(20, points=(200, 9))
    td[keys.NOISE] = uniform(0, torch.arange(60).view(20, 3), 0)
    with torch.no_grad():
        whole = actor(td.clone())
        assert torch.equal(actor(td.clone())[keys.LOGITS], whole[keys.LOGITS])
        for part in (slice(0, 1), slice(4, 9), torch.arange(19, -1, -1)):
            found = actor(td[part].clone())
            for key in (keys.LOGITS, keys.ACTION, ("agents", "action_log_prob")):
                torch.testing.assert_close(found[key], whole[key][part], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("points", [40, 60])
def test_padding_and_order_change_nothing_for_valid_agents(points):
    actor, td = policy(), scene(8, points=(points, 9))
    logits = actor(td.clone())[keys.LOGITS]
    order = torch.tensor([2, 0, 1])
    agents = td["agents"].clone().auto_batch_size_(2)[:, order]
    permuted = actor(TensorDict({"agents": agents}, [8]))[keys.LOGITS]
    torch.testing.assert_close(permuted, logits[:, order], rtol=1e-5, atol=1e-6)
    dirty = td.clone()
    for key, mask, _ in NAMES:
        dirty[key] = torch.where(td[mask][..., None], td[key], torch.nan)
    absent = ~td[keys.VALID]
    assert absent.any()
    for key in (keys.OWN, keys.POINTS, keys.OBJECTS):
        dirty[key][absent] = torch.nan
    parameters = list(actor.parameters())
    clean_gradients = torch.autograd.grad(logits[td[keys.VALID]].square().sum(), parameters)
    got = actor(dirty)[keys.LOGITS]
    torch.testing.assert_close(got[td[keys.VALID]], logits[td[keys.VALID]], rtol=1e-5, atol=1e-6)
    gradients = torch.autograd.grad(got[td[keys.VALID]].square().sum(), parameters)
    for a, b in zip(gradients, clean_gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def goals(*batch):
    torch.manual_seed(0)
    return scene(*batch, valid=2.0), modules.goal_policy(6, GROUPS, 7, hidden=16)


@given(st.permutations(range(6)))
@torch.no_grad()
def test_the_order_of_routes_is_kept(order):
    td, network = goals(4)
    plain = network(td.clone())[keys.GOAL_LOGITS]
    td[keys.ROUTES], td[keys.ROUTES_MASK] = td[keys.ROUTES][..., order, :], td[keys.ROUTES_MASK][..., order]
    assert torch.equal(network(td)[keys.GOAL_LOGITS], plain[..., order])


@torch.no_grad()
def test_padding_of_routes_changes_nothing_whatever_it_holds():
    td, network = goals(50)
    td[keys.GOAL_NOISE] = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    plain = network(td.clone())
    for fill in (0.0, 1e9, float("nan"), float("inf")):
        wide = td.clone()
        wide[keys.ROUTES] = torch.cat([td[keys.ROUTES], torch.full((50, 3, 4, 7), fill)], -2)
        wide[keys.ROUTES_MASK] = nn.functional.pad(td[keys.ROUTES_MASK], (0, 4))
        out = network(wide)
        assert torch.equal(out[keys.GOAL_LOGITS][..., :6], plain[keys.GOAL_LOGITS])
        drawn = (modules.drawn_goals(each[keys.GOAL], each[keys.ROUTES_MASK]) for each in (out, plain))
        assert torch.equal(*drawn)
        masked = td.clone()
        masked[keys.ROUTES] = torch.where(td[keys.ROUTES_MASK][..., None], td[keys.ROUTES], fill)
        assert torch.equal(network(masked)[keys.GOAL_LOGITS], plain[keys.GOAL_LOGITS])


def test_padding_gets_no_gradient_and_gives_none_that_is_not_finite():
    td, network = goals(20)
    routes = torch.where(td[keys.ROUTES_MASK][..., None], td[keys.ROUTES], float("nan")).requires_grad_()
    td[keys.ROUTES] = routes
    td[keys.GOAL] = modules.drawn_goals(td[keys.ROUTES_MASK].int().argmax(-1), td[keys.ROUTES_MASK])
    loss = GoalLoss(network)
    loss(td)["loss_goal"].backward()
    assert all(torch.isfinite(p.grad).all() for p in loss.parameters())
    mask = td[keys.ROUTES_MASK]
    assert (routes.grad[~mask] == 0).all()
    assert torch.isfinite(routes.grad[mask]).all()
    assert (routes.grad[mask] != 0).any()


@torch.no_grad()
def test_agents_and_routes_do_not_influence_each_other():
    td, network = goals(4)
    plain = network(td.clone())[keys.GOAL_LOGITS]
    other = td.clone()
    other[keys.ROUTES][:, 0, 2] = 5.0
    other[keys.OWN][:, 1] = -3.0
    out = network(other)[keys.GOAL_LOGITS]
    changed = (out != plain).any(0)
    # Only the route itself, and what the second agent thinks of its own.
    assert changed[0].tolist() == [False, False, True, False, False, False]
    assert torch.equal(changed[1], td[keys.ROUTES_MASK][:, 1].any(0))
    assert not changed[2].any()


@torch.no_grad()
def test_an_agent_without_a_route_or_that_is_padding_gets_none_and_no_other_one_that_does_not_exist():
    td, network = goals(200)
    td[keys.VALID][:50, 0] = False
    td[keys.GOAL_NOISE] = torch.rand(200, 3)
    out = network(td)
    assert (out[keys.GOAL_LOGITS][:50, 0] == NO_ROUTE).all()
    assert (out[keys.GOAL_LOGITS][:, 1] > NO_ROUTE).any()
    goal = modules.drawn_goals(out[keys.GOAL], td[keys.ROUTES_MASK])
    assert torch.equal(goal == -1, ~td[keys.ROUTES_MASK].any(-1))
    exists = td[keys.ROUTES_MASK].gather(-1, goal.clamp_min(0)[..., None]).squeeze(-1)
    assert exists[td[keys.VALID] & (goal >= 0)].all()


KINDS = ("paper", "clearance", "foresight")


def observation(*batch, seed=0):
    return scene(*batch, seed=seed, own=4, objects=(5, 5), points=(12, 4), valid=0.7)


def realism(features="clearance", seed=0, **changes):
    torch.manual_seed(seed)
    return modules.discriminator(4, 5, 4, hidden=16, head=(16,), features=features, **changes)


@pytest.mark.parametrize("features", KINDS)
@pytest.mark.parametrize("batch", [(), (20,), (2, 3)])
@torch.no_grad()
def test_one_score_per_agent_and_none_for_padding_that_may_hold_anything(batch, features):
    td, network = observation(*batch), realism(features)
    score = network(td.clone())[keys.SCORE]
    assert score.shape == (*batch, 3)
    assert torch.equal(score != 0, td[keys.VALID])
    empty = ~td[keys.VALID]
    for key in network.in_keys:
        if td[key].is_floating_point():
            td[key][empty] = torch.nan
    assert torch.equal(network(td)[keys.SCORE], score)


@torch.no_grad()
@settings(max_examples=10)
@given(st.floats(0, 6.28), st.floats(1.001, 50), st.floats(0, 0.999), st.sampled_from(KINDS[1:]))
def test_nothing_beyond_the_radius_matters(angle, far, near, features):
    network, td = realism(features, radius=0.8), observation()
    td[keys.OBJECTS_MASK][0, 1] = td[keys.POINTS_MASK][0, 4] = True
    turn = torch.tensor([angle, angle - torch.pi / 2]).cos()

    def with_elements_at(distance, value):
        changed = td.clone()
        for key, row in ((keys.OBJECTS, 1), (keys.POINTS, 4)):
            changed[key][0, row] = value
            changed[key][0, row, :2] = 0.8 * distance * turn
        changed[keys.GAP][0, 1] = value
        return network(changed)[keys.SCORE]

    assert torch.equal(with_elements_at(far, 3.0), with_elements_at(far, -7.0))
    gone = td.clone()
    gone[keys.OBJECTS_MASK][0, 1] = gone[keys.POINTS_MASK][0, 4] = False
    assert torch.equal(with_elements_at(far, 3.0), network(gone)[keys.SCORE])
    assert not torch.equal(with_elements_at(near, 30.0)[0], with_elements_at(near, -70.0)[0])


@pytest.mark.parametrize("features", KINDS[1:])
def test_gradient_flows_through_every_floating_input(features):
    td, network = observation(30), realism(features)
    leaves = {k: td[k].requires_grad_() for k in network.in_keys if td[k].is_floating_point()}
    network(td)[keys.SCORE].sum().backward()
    for key, leaf in leaves.items():
        assert torch.isfinite(leaf.grad).all(), key
        assert (leaf.grad != 0).any(), key
