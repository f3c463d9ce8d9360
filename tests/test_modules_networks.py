"""Policies, the goal policy, the discriminator and pooling: what they observe, and that nothing else matters."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch import Tensor, nn

from symphony.keys import (
    ACTION,
    GAP,
    GAP_AHEAD,
    GOAL,
    GOAL_LOGITS,
    GOAL_NOISE,
    LOGITS,
    NOISE,
    OBJECTS,
    OBJECTS_MASK,
    OWN,
    POINTS,
    POINTS_MASK,
    ROAD,
    ROUTE,
    ROUTES,
    ROUTES_MASK,
    SCORE,
    SIMULATED,
    VALID,
)
from symphony.modules import (
    FORESIGHT,
    ElementGroup,
    discrete_policy,
    discriminator,
    drawn_goals,
    goal_policy,
    inverse_cdf,
    mlp,
    pool_elements,
    pooling,
)
from symphony.modules.goals import NO_ROUTE
from symphony.objectives import DiscriminatorLoss, GoalLoss
from symphony.streams import uniform


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


def spectral(network: nn.Sequential) -> nn.Sequential:
    nn.utils.spectral_norm(network[0])  # a hook makes the weight anew at each call
    return network.eval()


def clipped(network: nn.Sequential) -> nn.Sequential:
    network[2].register_full_backward_hook(lambda module, above, below: tuple(0.1 * g for g in above))
    return network


@pytest.mark.parametrize("change", [spectral, clipped])
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


GROUPS = (ElementGroup(OBJECTS, OBJECTS_MASK, 10), ElementGroup(POINTS, POINTS_MASK, 9))


def scene(*batch, agents=3, objects=4, points=60, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, agents)

    def randn(*size):
        return torch.randn(*shape, *size, generator=generator)

    def chance(p, *size):
        return torch.rand(*shape, *size, generator=generator) < p

    td = TensorDict(batch_size=batch)
    td[OWN] = randn(6)
    td[OBJECTS], td[OBJECTS_MASK] = randn(objects, 10), chance(0.7, objects)
    td[POINTS], td[POINTS_MASK] = randn(points, 9), chance(0.7, points)
    td[VALID] = chance(0.8)
    td[VALID][..., 0] = True
    return td


def policy(**kwargs):
    torch.manual_seed(0)
    return discrete_policy(6, GROUPS, **kwargs)


def test_exploration_type_decides_how_actions_are_drawn():
    actor, td = policy(), scene(400)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        greedy = actor(td.clone())
    assert torch.equal(greedy[ACTION], greedy[LOGITS].argmax(-1))
    td[NOISE] = torch.rand(400, 3)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        assert torch.equal(actor(td.clone())[ACTION], greedy[ACTION])
    with set_interaction_type(InteractionType.RANDOM):
        drawn = actor(td.clone())
    assert torch.equal(drawn[ACTION], inverse_cdf(drawn[LOGITS], td[NOISE]))
    assert torch.equal(actor(td.clone())[ACTION], drawn[ACTION])  # RANDOM unless told otherwise
    free = td.exclude(NOISE)
    torch.manual_seed(5)
    first = actor(free.clone())[ACTION]
    assert not torch.equal(actor(free.clone())[ACTION], first)
    torch.manual_seed(5)
    assert torch.equal(actor(free.clone())[ACTION], first)


def test_logits_and_actions_do_not_depend_on_the_batch():
    """To rounding; the same batch gives the same bits."""
    actor, td = policy(return_log_prob=True), scene(20, points=200)
    td[NOISE] = uniform(0, torch.arange(60).view(20, 3), 0)
    with torch.no_grad():
        whole = actor(td.clone())
        assert torch.equal(actor(td.clone())[LOGITS], whole[LOGITS])
        for part in (slice(0, 1), slice(4, 9), torch.arange(19, -1, -1)):
            found = actor(td[part].clone())
            for key in (LOGITS, ACTION, ("agents", "action_log_prob")):
                torch.testing.assert_close(found[key], whole[key][part], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("points", [40, 60])
def test_padding_and_order_change_nothing_for_valid_agents(points):
    actor, td = policy(), scene(8, points=points)
    logits = actor(td.clone())[LOGITS]
    order = torch.tensor([2, 0, 1])
    agents = td["agents"].clone().auto_batch_size_(2)[:, order]
    permuted = actor(TensorDict({"agents": agents}, [8]))[LOGITS]
    torch.testing.assert_close(permuted, logits[:, order], rtol=1e-5, atol=1e-6)
    dirty = td.clone()
    for key, mask in ((POINTS, POINTS_MASK), (OBJECTS, OBJECTS_MASK)):
        dirty[key] = torch.where(td[mask][..., None], td[key], torch.nan)
    absent = ~td[VALID]
    assert absent.any()
    for key in (OWN, POINTS, OBJECTS):
        dirty[key][absent] = torch.nan
    parameters = list(actor.parameters())
    clean_gradients = torch.autograd.grad(logits[td[VALID]].square().sum(), parameters)
    got = actor(dirty)[LOGITS]
    torch.testing.assert_close(got[td[VALID]], logits[td[VALID]], rtol=1e-5, atol=1e-6)
    gradients = torch.autograd.grad(got[td[VALID]].square().sum(), parameters)
    for a, b in zip(gradients, clean_gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_every_parameter_gets_a_gradient():
    actor = policy()
    actor(scene(8))[LOGITS].square().sum().backward()
    assert all(p.grad is not None and p.grad.norm() > 0 for p in actor.parameters())


GROUPS_GOALS = (ElementGroup(OBJECTS, OBJECTS_MASK, 5), ElementGroup(POINTS, POINTS_MASK, 4))
FEATURES = 7


def goals_scene(*batch, agents=3, routes=6, seed=0):
    """Random observations; agent 0 has all its routes, the last one none."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, agents)

    def randn(*size):
        return torch.randn(*shape, *size, generator=generator)

    td = TensorDict(batch_size=batch)
    td[OWN], td[VALID] = randn(4), torch.ones(shape, dtype=torch.bool)
    td[OBJECTS], td[OBJECTS_MASK] = randn(3, 5), torch.rand(*shape, 3, generator=generator) < 0.7
    td[POINTS], td[POINTS_MASK] = randn(8, 4), torch.rand(*shape, 8, generator=generator) < 0.7
    td[ROUTES], mask = randn(routes, FEATURES), torch.rand(*shape, routes, generator=generator) < 0.6
    mask[..., 0, :], mask[..., -1, :] = True, False
    td[ROUTES_MASK] = mask
    return td


def goals_policy(seed=0, hidden=16):
    torch.manual_seed(seed)
    return goal_policy(4, GROUPS_GOALS, FEATURES, hidden=hidden)


@settings(max_examples=20)
@given(st.permutations(range(6)))
@torch.no_grad()
def test_the_order_of_routes_is_kept(order):
    td, network = goals_scene(4), goals_policy()
    plain = network(td.clone())[GOAL_LOGITS]
    td[ROUTES], td[ROUTES_MASK] = td[ROUTES][..., order, :], td[ROUTES_MASK][..., order]
    assert torch.equal(network(td)[GOAL_LOGITS], plain[..., order])


def drawn(td):
    return drawn_goals(td[GOAL], td[ROUTES_MASK])


@torch.no_grad()
def test_padding_of_routes_changes_nothing_whatever_it_holds():
    td, network = goals_scene(50), goals_policy()
    td[GOAL_NOISE] = torch.rand(50, 3, generator=torch.Generator().manual_seed(1))
    plain = network(td.clone())
    for fill in (0.0, 1e9, float("nan"), float("inf")):
        wide = td.clone()
        wide[ROUTES] = torch.cat([td[ROUTES], torch.full((50, 3, 4, FEATURES), fill)], -2)
        wide[ROUTES_MASK] = torch.cat([td[ROUTES_MASK], torch.zeros(50, 3, 4, dtype=torch.bool)], -1)
        out = network(wide)
        assert torch.equal(out[GOAL_LOGITS][..., :6], plain[GOAL_LOGITS])
        assert torch.equal(drawn(out), drawn(plain))
        masked = td.clone()
        masked[ROUTES] = torch.where(td[ROUTES_MASK][..., None], td[ROUTES], fill)
        assert torch.equal(network(masked)[GOAL_LOGITS], plain[GOAL_LOGITS])


def test_padding_gets_no_gradient_and_gives_none_that_is_not_finite():
    td, network = goals_scene(20), goals_policy()
    routes = torch.where(td[ROUTES_MASK][..., None], td[ROUTES], float("nan")).requires_grad_()
    td[ROUTES] = routes
    td[GOAL] = drawn_goals(td[ROUTES_MASK].int().argmax(-1), td[ROUTES_MASK])
    loss = GoalLoss(network)
    loss(td)["loss_goal"].backward()
    assert all(torch.isfinite(p.grad).all() for p in loss.parameters())
    mask = td[ROUTES_MASK]
    assert (routes.grad[~mask] == 0).all()
    assert torch.isfinite(routes.grad[mask]).all()
    assert (routes.grad[mask] != 0).any()


@torch.no_grad()
def test_agents_and_routes_do_not_influence_each_other():
    td, network = goals_scene(4), goals_policy()
    plain = network(td.clone())[GOAL_LOGITS]
    other = td.clone()
    other[ROUTES][:, 0, 2] = 5.0
    other[OWN][:, 1] = -3.0
    out = network(other)[GOAL_LOGITS]
    changed = (out != plain).any(0)
    # Only the route itself, and what the second agent thinks of its own.
    assert changed[0].tolist() == [False, False, True, False, False, False]
    assert torch.equal(changed[1], td[ROUTES_MASK][:, 1].any(0))
    assert not changed[2].any()


@torch.no_grad()
def test_an_agent_without_a_route_gets_none_and_no_other_one_that_does_not_exist():
    td, network = goals_scene(200), goals_policy()
    td[VALID][:50, 0] = False
    td[GOAL_NOISE] = torch.rand(200, 3)
    goal = drawn_goals(network(td)[GOAL], td[ROUTES_MASK])
    assert torch.equal(goal == -1, ~td[ROUTES_MASK].any(-1))
    exists = td[ROUTES_MASK].gather(-1, goal.clamp_min(0)[..., None]).squeeze(-1)
    assert exists[td[VALID] & (goal >= 0)].all()


@torch.no_grad()
def test_an_agent_that_is_padding_has_no_route_whatever_is_said_of_it():
    td = goals_scene(2)
    td[VALID][:, 0] = False
    logits = goals_policy()(td)[GOAL_LOGITS]
    assert (logits[:, 0] == NO_ROUTE).all()
    assert (logits[:, 1] > NO_ROUTE).any()


KINDS = ("paper", "clearance", "foresight")


def observation(*batch, agents=3, objects=5, points=12, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, agents)

    def randn(*size):
        return torch.randn(*shape, *size, generator=generator)

    def chance(p, *size):
        return torch.rand(*shape, *size, generator=generator) < p

    td = TensorDict(batch_size=batch)
    td[OWN], td[ROUTE] = randn(4), randn(6)
    td[OBJECTS], td[OBJECTS_MASK] = randn(objects, 5), chance(0.8, objects)
    td[POINTS], td[POINTS_MASK] = randn(points, 4), chance(0.8, points)
    td[GAP], td[GAP_AHEAD] = 5 * randn(objects), 5 * randn(objects, len(FORESIGHT))
    td[ROAD] = 5 * randn(5)
    td[VALID] = chance(0.7)
    td[VALID][..., 0] = True
    return td


def realism(features="clearance", seed=0, **changes):
    torch.manual_seed(seed)
    return discriminator(4, 5, 4, hidden=16, head=(16,), features=features, **changes)


@pytest.mark.parametrize("features", KINDS)
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_one_score_per_agent_and_none_for_padding(batch, features):
    td = observation(*batch)
    score = realism(features)(td)[SCORE]
    assert score.shape == (*batch, 3)
    assert (score[~td[VALID]] == 0).all()
    assert (score[td[VALID]] != 0).all()


@pytest.mark.parametrize("features", KINDS)
@torch.no_grad()
def test_a_padded_agent_may_hold_anything(features):
    td, network = observation(20), realism(features)
    plain = network(td.clone())[SCORE]
    empty = ~td[VALID]
    for key in network.in_keys:
        if td[key].is_floating_point():
            td[key][empty] = torch.nan
    assert torch.equal(network(td)[SCORE], plain)


@torch.no_grad()
@settings(max_examples=10)
@given(
    st.floats(0, 6.28), st.floats(1.001, 50), st.floats(0, 0.999), st.sampled_from(["clearance", "foresight"])
)
def test_nothing_beyond_the_radius_matters(angle, far, near, features):
    network, td = realism(features, radius=0.8), observation()
    td[OBJECTS_MASK][0, 1] = td[POINTS_MASK][0, 4] = True
    turn = torch.tensor([angle]).cos(), torch.tensor([angle]).sin()

    def with_elements_at(distance, value):
        changed = td.clone()
        for key, row in ((OBJECTS, 1), (POINTS, 4)):
            changed[key][0, row] = value
            changed[key][0, row, :2] = 0.8 * distance * torch.cat(turn)
        changed[GAP][0, 1] = value
        return network(changed)[SCORE]

    assert torch.equal(with_elements_at(far, 3.0), with_elements_at(far, -7.0))
    gone = td.clone()
    gone[OBJECTS_MASK][0, 1] = gone[POINTS_MASK][0, 4] = False
    assert torch.equal(with_elements_at(far, 3.0), network(gone)[SCORE])
    assert not torch.equal(with_elements_at(near, 30.0)[0], with_elements_at(near, -70.0)[0])


@pytest.mark.parametrize("features", KINDS)
def test_simulated_states_come_to_score_higher(features):
    network, td = realism(features), observation(200, seed=1)
    td[VALID][:] = True
    td[SIMULATED] = torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) < 0.5
    # Separable by the agent's own first feature.
    td[OWN][..., 0] = torch.where(td[SIMULATED], 1.0, -1.0) + 0.1 * td[OWN][..., 0]
    loss = DiscriminatorLoss(network)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for _ in range(25):
        optimizer.zero_grad()
        loss(td)["loss_discriminator"].backward()
        optimizer.step()
    with torch.no_grad():
        score = network(td.clone())[SCORE]
        assert loss(td)["auc"] > 0.95
    assert score[td[SIMULATED]].mean() > 0.5
    assert score[~td[SIMULATED]].mean() < -0.5


@pytest.mark.parametrize("features", ["clearance", "foresight"])
def test_gradient_flows_through_every_floating_input(features):
    td, network = observation(30), realism(features)
    leaves = {k: td[k].requires_grad_() for k in network.in_keys if td[k].is_floating_point()}
    network(td)[SCORE].sum().backward()
    for key, leaf in leaves.items():
        assert torch.isfinite(leaf.grad).all(), key
        assert (leaf.grad != 0).any(), key
