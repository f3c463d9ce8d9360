"""The discriminator: what it observes, what it does not, and which way its score points."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from symphony.keys import (
    GAP,
    GAP_AHEAD,
    OBJECTS,
    OBJECTS_MASK,
    OWN,
    POINTS,
    POINTS_MASK,
    ROAD,
    ROUTE,
    SCORE,
    SIMULATED,
    VALID,
)
from symphony.modules import FORESIGHT, discriminator
from symphony.modules.encoder import gap_features, road_features
from symphony.objectives import DiscriminatorLoss

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


@pytest.mark.parametrize("features", ["foresight"])
@torch.no_grad()
def test_the_order_of_elements_and_their_padding_change_nothing(features):
    td, network = observation(6), realism(features)
    plain = network(td.clone())[SCORE]
    mixed = td.clone()
    order = torch.tensor([3, 0, 4, 1, 2])
    for key in (OBJECTS, OBJECTS_MASK, GAP, GAP_AHEAD):
        mixed[key] = td[key].index_select(2, order)
    assert torch.equal(network(mixed)[SCORE], plain)
    wide = td.clone()
    for key in (OBJECTS, OBJECTS_MASK, GAP, GAP_AHEAD, POINTS, POINTS_MASK):
        wide[key] = torch.cat([td[key], torch.zeros_like(td[key])], 2)
    assert torch.equal(network(wide)[SCORE], plain)
    masked = td.clone()
    for key, mask in ((OBJECTS, OBJECTS_MASK), (GAP, OBJECTS_MASK), (POINTS, POINTS_MASK)):
        masked[key][~td[mask]] = torch.nan
    assert torch.equal(network(masked)[SCORE], plain)


def test_each_kind_reads_what_it_needs_and_no_more():
    td = observation(4)
    reads = {
        "paper": set(),
        "clearance": {ROAD, GAP},
        "foresight": {ROAD, GAP, GAP_AHEAD},
    }
    for features, more in reads.items():
        network = realism(features)
        assert set(network.in_keys) == {OWN, VALID, OBJECTS, OBJECTS_MASK, POINTS, POINTS_MASK} | more
        small = td.select(*network.in_keys)
        plain = network(small.clone())[SCORE]
        for key in more:
            changed = small.clone()
            changed[key] = changed[key] + 1.0
            assert not torch.equal(network(changed)[SCORE], plain), key


@torch.no_grad()
def test_it_is_given_the_goal():
    torch.manual_seed(0)
    network = discriminator(4 + 6, 5, 4, hidden=16, head=(16,), own_keys=(OWN, ROUTE), features="clearance")
    td = observation(3)
    plain = network(td.clone())[SCORE]
    td[ROUTE] = -td[ROUTE]
    assert (network(td)[SCORE] != plain)[td[VALID]].all()


@given(st.floats(-200, 200), st.floats(0, 10))
def test_clearances_are_squashed_in_order(distance, more):
    for features in (gap_features, road_features):
        value = torch.tensor([distance]).double()
        a, b = features(value), features(value + more)
        assert (a.abs() <= 1).all()
        assert (b >= a).all()
        assert torch.equal(features(-value), -a)


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


def test_overlap_alone_can_be_learned_from_gaps_but_not_without():
    """Clearance is what tells contact from nearly that."""
    td = observation(300, agents=1, seed=3)
    td[VALID][:], td[OBJECTS_MASK][:] = True, True
    td[OBJECTS] = 0.1 * td[OBJECTS]
    td[GAP] = td[GAP].abs() + 0.3
    td[SIMULATED] = torch.rand(300, 1, generator=torch.Generator().manual_seed(4)) < 0.5
    td[GAP][..., 0] = torch.where(td[SIMULATED], -0.3, td[GAP][..., 0])
    found = {}
    for features in ("paper", "clearance"):
        loss = DiscriminatorLoss(realism(features))
        optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
        for _ in range(25):
            optimizer.zero_grad()
            loss(td)["loss_discriminator"].backward()
            optimizer.step()
        found[features] = loss(td)["auc"].item()
    assert found["clearance"] > 0.95
    assert found["paper"] < 0.85


@pytest.mark.parametrize("features", ["clearance", "foresight"])
def test_gradient_flows_through_every_floating_input(features):
    td, network = observation(30), realism(features)
    leaves = {k: td[k].requires_grad_() for k in network.in_keys if td[k].is_floating_point()}
    network(td)[SCORE].sum().backward()
    for key, leaf in leaves.items():
        assert torch.isfinite(leaf.grad).all(), key
        assert (leaf.grad != 0).any(), key
