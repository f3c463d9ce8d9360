"""The goal policy: routes are a set, draws follow the softmax and nothing else."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type

from symphony.keys import (
    GOAL,
    GOAL_LOGITS,
    GOAL_NOISE,
    OBJECTS,
    OBJECTS_MASK,
    OWN,
    POINTS,
    POINTS_MASK,
    ROUTES,
    ROUTES_MASK,
    VALID,
)
from symphony.modules import ElementGroup, drawn_goals, goal_policy
from symphony.modules.goals import NO_ROUTE
from symphony.objectives import GoalLoss
from symphony.streams import fold_in, uniform

GROUPS = (ElementGroup(OBJECTS, OBJECTS_MASK, 5), ElementGroup(POINTS, POINTS_MASK, 4))
FEATURES = 7


def scene(*batch, agents=3, routes=6, seed=0):
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


def policy(seed=0, hidden=16):
    torch.manual_seed(seed)
    return goal_policy(4, GROUPS, FEATURES, hidden=hidden)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_shapes_and_types(batch):
    td = policy()(scene(*batch))
    assert td[GOAL_LOGITS].shape == (*batch, 3, 6)
    assert td[GOAL].shape == (*batch, 3)
    assert td[GOAL].dtype == torch.int64


@settings(max_examples=20)
@given(st.permutations(range(6)))
@torch.no_grad()
def test_the_order_of_routes_is_kept(order):
    td, network = scene(4), policy()
    plain = network(td.clone())[GOAL_LOGITS]
    td[ROUTES], td[ROUTES_MASK] = td[ROUTES][..., order, :], td[ROUTES_MASK][..., order]
    assert torch.equal(network(td)[GOAL_LOGITS], plain[..., order])


def drawn(td):
    return drawn_goals(td[GOAL], td[ROUTES_MASK])


@torch.no_grad()
def test_padding_of_routes_changes_nothing_whatever_it_holds():
    td, network = scene(50), policy()
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
    td, network = scene(20), policy()
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
    td, network = scene(4), policy()
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
    td, network = scene(200), policy()
    td[VALID][:50, 0] = False
    td[GOAL_NOISE] = torch.rand(200, 3)
    goal = drawn_goals(network(td)[GOAL], td[ROUTES_MASK])
    assert torch.equal(goal == -1, ~td[ROUTES_MASK].any(-1))
    exists = td[ROUTES_MASK].gather(-1, goal.clamp_min(0)[..., None]).squeeze(-1)
    assert exists[td[VALID] & (goal >= 0)].all()


@torch.no_grad()
def test_an_agent_that_is_padding_has_no_route_whatever_is_said_of_it():
    td = scene(2)
    td[VALID][:, 0] = False
    logits = policy()(td)[GOAL_LOGITS]
    assert (logits[:, 0] == NO_ROUTE).all()
    assert (logits[:, 1] > NO_ROUTE).any()


@torch.no_grad()
def test_a_scene_without_any_route_is_no_error():
    td, network = scene(3, routes=0), policy()
    td[GOAL_NOISE] = torch.rand(3, 3)
    out = network(td)
    assert out[GOAL_LOGITS].shape == (3, 3, 0)
    assert (drawn_goals(out[GOAL], td[ROUTES_MASK]) == -1).all()


@torch.no_grad()
def test_draws_do_not_depend_on_the_batch():
    td, network = scene(70), policy()
    td[GOAL_NOISE] = uniform(3, fold_in(torch.arange(70)[:, None], torch.arange(3)), 0)
    whole = network(td.clone())
    for rows in (slice(0, 1), slice(5, 38), slice(66, 70)):
        part = network(td[rows].clone())
        torch.testing.assert_close(part[GOAL_LOGITS], whole[GOAL_LOGITS][rows], rtol=1e-5, atol=1e-5)
        assert torch.equal(part[GOAL], whole[GOAL][rows])


@torch.no_grad()
def test_draws_follow_the_softmax():
    draws, network = 20_000, policy()
    td = network(scene())
    logits = 3 * td[GOAL_LOGITS].expand(draws, 3, 6)
    # The sampler alone, with the numbers that rollouts draw from.
    noise = uniform(0, fold_in(torch.arange(draws)[:, None], torch.arange(3)), 0)
    sampler = network[-1]
    drawn = sampler(TensorDict({GOAL_LOGITS: logits, GOAL_NOISE: noise}, batch_size=[draws]))[GOAL]
    for agent in (0, 1):
        mask = td[ROUTES_MASK][agent]
        expected = draws * logits[0, agent].softmax(-1)
        count = torch.bincount(drawn[:, agent], minlength=6)
        assert (count[~mask] == 0).all()
        chi = ((count - expected).square() / expected)[mask].sum()
        # Five standard deviations above the mean of a chi-square of this many degrees of freedom.
        freedom = mask.sum() - 1
        assert freedom > 0
        assert chi < freedom + 5 * (2 * freedom) ** 0.5
    # Neighbouring agents draw independently.
    same = (drawn[:, 0] == drawn[:, 1]).float().mean()
    share = (logits[0, 0].softmax(-1) * logits[0, 1].softmax(-1)).sum()
    assert abs(same - share) < 0.02


@torch.no_grad()
def test_exploration_type_decides_how_goals_are_drawn():
    td, network = scene(100), policy()
    td[GOAL_NOISE] = torch.rand(100, 3)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        greedy = network(td.clone())
    assert torch.equal(greedy[GOAL], greedy[GOAL_LOGITS].argmax(-1))
    with set_interaction_type(InteractionType.RANDOM):
        assert not torch.equal(network(td.clone())[GOAL], greedy[GOAL])


def test_it_learns_which_route_is_taken():
    td, network = scene(40), policy()
    # The route with the largest first feature, whatever its place, unless the agent's own feature says otherwise.
    best = torch.where(td[OWN][..., :1] > 0, td[ROUTES][..., 0], -td[ROUTES][..., 0])
    label = best.masked_fill(~td[ROUTES_MASK], -torch.inf).argmax(-1)
    td[GOAL] = drawn_goals(label, td[ROUTES_MASK])
    loss = GoalLoss(network)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    first = loss(td)
    for _ in range(50):
        optimizer.zero_grad()
        last = loss(td)
        last["loss_goal"].backward()
        optimizer.step()
    assert first["accuracy"] < 0.6
    assert last["accuracy"] > 0.95
    assert last["loss_goal"] < 0.3 * first["loss_goal"]
