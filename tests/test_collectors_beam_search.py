"""Laws of the beam search."""

from __future__ import annotations

import itertools

import pytest
import torch
from tensordict import NonTensorData, TensorDict
from tensordict.nn import TensorDictModule
from torch.testing import assert_close
from torchrl.envs import ParallelEnv, PendulumEnv, SerialEnv, TransformedEnv, UnaryTransform

from helpers_collectors import ACTION, LOG_PROB, STREAM, Policy, Walk, X, assert_same, distance, starts
from symphony import collectors


@pytest.fixture(autouse=True)
def no_gradients():
    with torch.no_grad():
        yield


def search(start, *, env=None, policy=None, score=distance, steps=12, prune_every=4, **kwargs):
    how = {"slot_keys": [STREAM], "steps": steps, "prune_every": prune_every, **kwargs}
    return collectors.beam_search(env or Walk(), policy or Policy(), score, start, **how)


def test_one_branch_is_a_plain_rollout():
    env, policy = Walk(), Policy()
    start = starts(env, 3, branches=1)
    found = search(start, env=env, policy=policy, steps=11)
    plain = env.rollout(11, policy, auto_reset=False, tensordict=start.clone(), break_when_any_done=False)
    assert_same(found.trajectories, plain)
    assert found.trajectories.names == plain.names
    assert found.trajectories.get("agents").batch_size == plain.get("agents").batch_size


def test_leaves_are_true_histories():
    """Replaying a leaf's actions from its start gives its states, log-probabilities and scores."""
    env, policy = Walk(), Policy()
    start = starts(env, 3, branches=8)
    before, versions = start.clone(), {k: v._version for k, v in start.items(True, True)}
    found = search(start, env=env, policy=policy, steps=14)
    assert_same(start, before)
    assert versions == {k: v._version for k, v in start.items(True, True)}
    leaves, now = found.trajectories, start
    for step in range(14):
        here = leaves[..., step]
        assert_close(here.get(X), now.get(X), rtol=0, atol=0)
        stepped = env.step(now.clone().set(ACTION, here.get(ACTION)))
        assert_close(policy.log_prob(stepped), here.get(LOG_PROB), rtol=0, atol=0)
        assert_close(stepped.get(("next", *X)), here.get(("next", *X)), rtol=0, atol=0)
        now = env.step_mdp(stepped)
        assert_close(found.scores[..., step, :], distance(now), rtol=0, atol=0)


def test_the_better_half_survives():
    # Rounded scores make ties, which must go to the lower slot.
    branches, ties = 6, 0
    found = search(starts(Walk(), 4, branches=branches), score=lambda td: distance(td).round(), steps=10)
    for row, (period, first) in itertools.product(range(4), enumerate(range(0, 10, 4))):
        scores = found.simulated_scores[row, :, first : first + 4].tolist()
        totals = [sum(max(step[agent] for step in one) for agent in range(2)) for one in scores]
        assert found.totals[row, period].tolist() == totals
        ties += len(set(totals)) < branches
        ranked = sorted(range(branches), key=lambda slot, t=totals: (t[slot], slot))[:3]
        assert found.parents[row, period].tolist() == ranked + ranked
    assert ties > 0


def test_the_last_period_may_be_short_and_unpruned():
    start = starts(Walk(), 2, branches=4)
    pruned, kept = search(start, steps=10), search(start, steps=10, prune_last=False)
    assert pruned.totals.shape == (2, 3, 4)
    assert (kept.parents[:, -1] == torch.arange(4)).all()
    assert_close(kept.simulated_scores, pruned.simulated_scores)
    last = pruned.parents[:, -1, :, None, None].expand(2, 4, 10, 2)
    assert_close(pruned.scores, kept.scores.gather(1, last))
    assert_close(search(start, steps=3, prune_every=10).totals, search(start, steps=3, prune_every=3).totals)


def test_rows_never_meet():
    start = starts(Walk(), 2, 3, branches=4)
    whole = search(start, keep_tree=True)
    flat = search(start.reshape(6, 4))
    assert_same(whole.trajectories.reshape(6, 4, 12), flat.trajectories)
    assert_close(whole.slots.reshape(6, 3, 4), flat.slots)
    for row in range(6):
        alone = search(start.reshape(6, 4)[row])
        assert_same(alone.trajectories, flat.trajectories[row])
        assert_close(alone.scores, flat.scores[row], rtol=0, atol=0)
    views = collectors.branch(Walk().reset(TensorDict({}, [3])), 4)  # of one row will do for a start
    assert_same(search(views).trajectories, search(views.clone()).trajectories)


def test_copies_draw_numbers_of_their_slot():
    start = starts(Walk(), 3, branches=4)

    def twins(**how):
        found = search(start, prune_last=False, **how).trajectories
        x = found.get(("next", *X))[:, :, -1]
        return torch.isclose(x[:, :2], x[:, 2:]).all(), found.get(STREAM)[:, :, -1]

    assert twins(slot_keys=())[0]
    alike, stream = twins()
    assert not alike
    assert_close(stream, start.get(STREAM))


class Counting(Walk):
    """Moves farther with every step it takes, whatever the state it is given says."""

    steps = 0

    def _step(self, tensordict):
        self.steps += 1
        out = super()._step(tensordict)
        return out.set(X, out.get(X) + self.steps)


class Drawing(Walk):
    """Draws from a generator of its own and the global one, and remembers nothing."""

    def _step(self, tensordict):
        out = super()._step(tensordict)
        drawn = torch.randn(out.get(X).shape, generator=self.rng)
        return out.set(X, out.get(X) + drawn + torch.rand(drawn.shape))


def noted():
    return TransformedEnv(Walk(), UnaryTransform([X], ["note"], fn=lambda x: NonTensorData("text", x.shape[:1])))


def remembering():
    env, calls = Walk(), itertools.count()
    search(starts(env, 1, branches=1), env=env)  # by itself it remembers nothing
    return TransformedEnv(env, UnaryTransform([X], [X], fn=lambda x: x + next(calls)))


@pytest.mark.parametrize(("env", "why"), [
    (lambda: SerialEnv(2, Walk), "batch-locked"),
    (lambda: ParallelEnv(1, Walk, mp_start_method="forkserver"), "batch-locked"),
    (noted, "no tensor, 'note'"), (remembering, r"another \('agents', 'x'\) when stepped"),
    (Counting, r"another \('agents', 'x'\) when stepped"),
])  # fmt: skip
def test_what_remembers_can_not_be_branched(env, why):
    with pytest.raises(ValueError, match=f"can't be branched: it .*{why}.* GymEnv, VmasEnv, SerialEnv and Para"):
        search(starts(Walk(), 2, branches=4), env=env())


@pytest.mark.parametrize("kind", [Drawing, Walk, PendulumEnv])
def test_random_numbers_are_no_memory(kind):
    env = kind()
    if isinstance(env, PendulumEnv):
        state, own = env.reset(env.gen_params(batch_size=[3]), set_state=False), None
    else:
        state, own = starts(env, 3, branches=1), env.rng.get_state()
    before = state.clone()
    torch.manual_seed(5)
    collectors.check_branching(env, state)
    assert_same(state, before)
    drawn = torch.rand(3)
    torch.manual_seed(5)
    assert torch.equal(drawn, torch.rand(3))
    assert own is None or torch.equal(own, env.rng.get_state())


def test_marks_of_the_tree():
    found = search(starts(Walk(), 3, branches=4), keep_tree=True)
    assert all(len(used.unique()) <= 2 for used in found.slots.flatten(0, -2))
    for row, leaf, step in itertools.product(range(3), range(4), range(12)):
        slot = found.slots[row, step // 4, leaf]
        assert_same(found.tree[row, slot, step], found.trajectories[row, leaf, step])
    assert_close(found.leaf_totals, collectors.max_then_sum(found.scores.unflatten(2, (3, 4)).transpose(1, 2)))


def test_leaves_are_the_best_and_distinct():
    start = starts(Walk(), 5, branches=6)
    whole, best = search(start), search(start, leaves=4)
    assert_same(best.trajectories, whole.trajectories[:, :4])  # three survivors, each twice
    assert_close(best.slots, whole.slots[..., :4])
    assert_close(best.scores, whole.scores[:, :4])
    free, chosen = (search(start, rule=collectors.KeepAll(), leaves=leaves) for leaves in (None, 6))
    assert torch.equal(chosen.slots[:, 0], free.totals[:, -1].argsort(-1))


def test_a_rule_may_mix_groups():
    """Branches of a bad group take over the goal of the branch they are copied from; several numbers are one goal."""
    generator, key = torch.Generator().manual_seed(0), ("agents", "goal")
    goals = torch.randint(3, (20, 6, 2), generator=generator)
    start = starts(Walk(), 20, branches=6).set(key, goals)
    noise = torch.rand(20, 3, generator=generator)
    found = search(start, rule=collectors.ReplaceBad(2.0), group_key=key, noise=noise)
    groups, mixed = goals, 0
    for parents, totals in zip(found.parents.unbind(1), found.totals.unbind(1), strict=True):
        after = groups.gather(1, parents[..., None].expand(20, 6, 2))
        good = totals <= 2.0
        for row, slot in (~good & good.any(1, True)).nonzero().tolist():
            same = ((groups[row] == groups[row, slot]).all(-1) & good[row]).any()
            assert bool(same) == bool((after[row, slot] == groups[row, slot]).all())
            mixed += not bool(same)
        groups = after
    assert mixed > 0
    kept = goals.gather(1, found.slots[:, 0][..., None].expand(20, 6, 2))
    assert torch.equal(found.trajectories.get(key)[:, :, -1], kept)
    assert torch.equal(groups, kept)


def test_only_what_is_kept_comes_back():
    start = starts(Walk(), 2, branches=4)
    found = search(start, keep=[("next", *X), ACTION], keep_tree=True)
    whole = search(start)
    assert set(found.trajectories.keys(True, True)) == {("next", *X), ACTION}
    assert_close(found.trajectories.get(ACTION), whole.trajectories.get(ACTION))
    assert found.tree.get(ACTION).shape == (2, 4, 12, 2, 1)
    assert whole.tree is None
    assert search(start, keep=[]).trajectories.is_empty()
    with pytest.raises(KeyError, match="nowhere"):
        search(start, keep=["nowhere"])


def test_scores_without_agents_of_the_reward_and_of_a_module():
    start = starts(Walk(), 2, branches=4)
    one = search(start, score=lambda td: distance(td).sum(-1), aggregate=collectors.mean_then_sum)
    assert one.scores.shape == (2, 4, 12, 1)
    plain, reward = search(start), search(start, score=collectors.KeyScore(("agents", "reward"), negate=True))
    assert_close(reward.scores, plain.scores)
    module = TensorDictModule(lambda x: x.abs(), in_keys=[X], out_keys=[("agents", "score")])
    written = search(start, score=collectors.KeyScore(("agents", "score"), module))
    for found in (reward, written):  # scores leave no trace
        assert set(found.trajectories.keys(True, True)) == set(plain.trajectories.keys(True, True))


def test_scores_of_any_usual_shape_become_one_number_per_agent():
    """Score three branches: without agents, with one or two, and with a last dimension like TorchRL's rewards."""
    for shape in ((3,), (3, 1), (3, 2), (3, 1, 1), (3, 2, 1)):
        values = torch.rand(5, *shape)
        found = collectors.KeyScore("score")(TensorDict({"score": values}, [5, 3]))
        assert torch.equal(found, values.reshape(5, 3, -1))
    td = TensorDict({"score": torch.tensor([[1.0, torch.nan]]), "valid": torch.tensor([[True, False]])}, [1])
    assert collectors.KeyScore("score", valid_key="valid")(td).tolist() == [[1.0, 0.0]]
    with pytest.raises(KeyError, match="absent"):
        collectors.KeyScore("score", valid_key="absent")(td)
    # A score of the whole branch would count once for each agent, another mask for other agents.
    for shape in ((1,), (1, 1), (1, 3)):
        with pytest.raises(ValueError, match="'valid' is"):
            collectors.KeyScore("one", valid_key="valid")(td.clone().set("one", torch.ones(shape)))


def test_aggregates_by_hand():
    scores = torch.tensor([[[[1.0, 5.0], [3.0, 0.0], [2.0, 1.0]]]])
    wanted = {("max", "sum"): 8.0, ("mean", "sum"): 4.0, ("sum", "max"): 6.0, ("last", "mean"): 1.5}
    for (time, agents), total in wanted.items():
        assert collectors.Aggregate(time, agents)(scores).tolist() == [[total]]
    for wrong in (("median", "sum"), ("max", "last")):
        with pytest.raises(ValueError, match="is one of"):
            collectors.Aggregate(*wrong)


@pytest.mark.parametrize(("changes", "message"), [
    ({"steps": 0}, "positive"), ({"prune_every": 0}, "positive"), ({"leaves": 5}, "leaves"),
    ({"group_key": STREAM}, "takes groups"), ({"group_key": "goal", "rule": collectors.ReplaceBad(0.0)}, "goal"),
    ({"group_key": X, "rule": collectors.ReplaceBad(0.0)}, "integers, one or some per branch"),
    ({"noise": torch.zeros(2, 2)}, "noise"), ({"rule": collectors.Systematic(1.0)}, "noise"),
    ({"rule": lambda totals, noise: totals}, "int64"),
    ({"rule": lambda totals, noise: 1 / 0}, "ZeroDivisionError: division by zero"),
    ({"rule": lambda totals, noise: totals.argsort(-1)[:, :2]}, "int64"),
    ({"rule": lambda totals, noise: totals.argsort(-1) + 1}, "outside"),
    ({"rule": lambda totals, noise: totals.argsort(-1) - 1}, "outside"), ({"value": distance}, "values must be"),
    ({"score": lambda td: td.get(X)}, "scores must be"), ({"aggregate": lambda scores: scores.sum()}, "aggregate"),
])  # fmt: skip
def test_contradictions_are_errors(changes, message):
    start = starts(Walk(), 2, branches=4)
    with pytest.raises(ValueError, match=message):
        search(start, **changes)
