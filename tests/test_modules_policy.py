"""Scene encoder and discrete policy over TensorDicts."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type

from symphony.keys import ACTION, LOGITS, NOISE, OBJECTS, OBJECTS_MASK, OWN, POINTS, POINTS_MASK, VALID
from symphony.modules import (
    ElementGroup,
    SceneEncoder,
    SceneNetwork,
    discrete_policy,
    inverse_cdf,
    scene_module,
)
from symphony.streams import uniform

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


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_shapes_and_types(batch):
    td = policy(return_log_prob=True)(scene(*batch))
    assert td[LOGITS].shape == (*batch, 3, 147)
    assert td[ACTION].shape == (*batch, 3)
    assert td[ACTION].dtype == torch.int64
    log_prob = td[LOGITS].log_softmax(-1).gather(-1, td[ACTION][..., None])[..., 0]
    torch.testing.assert_close(td["agents", "action_log_prob"], log_prob)


def test_a_seed_fixes_the_weights():
    a, b = policy().state_dict(), policy().state_dict()
    assert all(torch.equal(a[k], b[k]) for k in a)
    torch.manual_seed(1)
    c = discrete_policy(6, GROUPS).state_dict()
    assert not all(torch.equal(a[k], c[k]) for k in a)


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


def test_a_further_group_is_one_more_entry():
    key, mask_key = ("agents", "route"), ("agents", "route_mask")
    actor = discrete_policy(6, (*GROUPS, ElementGroup(key, mask_key, 4)), actions=5, hidden=8, head=(16,))
    td = scene(2)
    td[key], td[mask_key] = torch.randn(2, 3, 7, 4), torch.ones(2, 3, 7, dtype=torch.bool)
    assert key in actor.in_keys
    first = actor(td.clone())[LOGITS]
    assert first.shape == (2, 3, 5)
    td[key] += 1
    assert not torch.equal(actor(td)[LOGITS], first)


def test_keys_are_free():
    group = ElementGroup("points", "mask", 2)
    actor = discrete_policy(
        3,
        [group],
        actions=4,
        own_keys=("own",),
        valid_key="ok",
        logits_key="l",
        action_key="a",
        noise_key="u",
        return_log_prob=True,
        log_prob_key="lp",
    )
    td = TensorDict(
        own=torch.randn(5, 3),
        ok=torch.ones(5, dtype=torch.bool),
        points=torch.randn(5, 6, 2),
        mask=torch.ones(5, 6, dtype=torch.bool),
        u=torch.full((5,), 0.999999),
        batch_size=[5],
    )
    out = actor(td)
    assert (out["a"] == 3).all()
    torch.testing.assert_close(out["lp"], out["l"].log_softmax(-1)[:, 3])


def test_the_wrapped_encoder_gives_a_vector_of_its_width():
    encoder = SceneEncoder(6, [10, 9], hidden=16)
    td = scene_module(encoder, GROUPS, "vector")(scene(2))
    assert td["vector"].shape == (2, 3, encoder.width) == (2, 3, 48)
    with pytest.raises(ValueError, match="2 groups"):
        encoder(td[OWN], td[VALID], td[POINTS], td[POINTS_MASK])
    network = SceneNetwork(encoder, 7)
    assert scene_module(network, GROUPS, "out")(scene(2))["out"].shape == (2, 3, 7)
