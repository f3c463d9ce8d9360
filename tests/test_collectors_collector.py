"""The collector, by what TorchRL's own tests ask of one."""

from __future__ import annotations

import functools
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import EnvBase, PendulumEnv

from helpers_collectors import ACTION, STREAM, Policy, Walk, X, assert_same, distance, give_streams
from symphony.collectors import (
    BeamSearchCollector,
    KeyScore,
    Systematic,
    with_rows,
)

ROWS, STEPS, FRAMES = 3, 8, 3 * 8
EXTRAS = [("collector", name) for name in ("beam_score", "beam_total", "beam_slot", "mask")]


def make_env(last: int = 1000, *transforms) -> EnvBase:
    env = with_rows(Walk(last=last), [ROWS])
    for transform in transforms:
        env.append_transform(transform)
    return env


def make(env=make_env, policy=None, **kwargs) -> BeamSearchCollector:
    settings = {
        "score": distance,
        "branches": 4,
        "prune_every": 4,
        "prepare": give_streams,
        "slot_keys": [STREAM],
    }
    settings |= {"frames_per_batch": FRAMES, "total_frames": 3 * kwargs.get("frames_per_batch", FRAMES)}
    return BeamSearchCollector(env, policy or Policy(), **settings | kwargs)


def plain_collector(**kwargs) -> Collector:
    settings = {"frames_per_batch": FRAMES, "total_frames": 3 * FRAMES, **kwargs}
    return Collector(make_env, Policy(), auto_register_policy_transforms=False, **settings)


def test_best_leaf_and_its_search():
    (batch,) = collector = make(leaves=2, frames_per_batch=2 * FRAMES, total_frames=2 * FRAMES)
    assert batch.shape == (ROWS, 2, STEPS)
    assert not any(value.requires_grad for value in batch.values(True, True))
    score, total, slot = (batch.get(key) for key in EXTRAS[:3])
    assert_close(score, batch.get(("next", *X)).squeeze(-1).abs())
    for first in (0, 4):
        expected = score[:, :, first : first + 4].amax(2).sum(-1, keepdim=True).expand(ROWS, 2, 4)
        assert_close(total[:, :, first : first + 4], expected)
    assert (total[:, 0, -1] <= total[:, 1, -1]).all()
    # the stream tells the branch that drew the numbers
    assert_close(batch.get(STREAM).squeeze(-1) % 100, slot)
    assert (batch.get(("collector", "traj_ids")).flatten(0, 1) == torch.arange(3, 9)[:, None]).all()
    assert batch.get(("collector", "mask")).all()
    assert collector.simulated_frames == ROWS * 4 * STEPS == collector.stats()["simulated_frames"]


def test_same_seed_same_data():
    def data(seed):
        collector = make(rule=Systematic(0.5))
        following = collector.set_seed(seed)
        drawn = collector.rule_noise(TensorDict(batch_size=[4, 2]))  # the numbers of the rule are seeded, too
        return torch.cat([batch.exclude("collector") for batch in collector]), drawn, following

    (first, drawn, seed), (again, redrawn, same), (other, others, another) = data(0), data(0), data(1)
    assert_same(first, again)
    assert torch.equal(drawn, redrawn)
    assert seed == same != another
    assert not torch.equal(first.get(ACTION), other.get(ACTION))
    assert not torch.equal(drawn, others)


def test_reloading():
    """A reloaded collector has nothing left to do where the other had not, and counts on."""
    first = make(policy=Policy())
    next(iter(first))
    state = pickle.loads(pickle.dumps(first.state_dict()))  # noqa: S301
    changed = Policy()
    changed.gain.data.fill_(0.5)
    second = make(policy=changed)
    second.load_state_dict(state)
    assert_close(second.policy.gain, first.policy.gain)
    assert second.simulated_frames == first.simulated_frames > 0
    ids = [batch.get(("collector", "traj_ids")).unique() for batch in second]
    assert len(ids) == 2
    assert min(int(i.min()) for i in ids) >= 2 * ROWS
    assert second.stats()["frames"] == second.total_frames
    make().load_state_dict(plain_collector().state_dict())


@pytest.mark.parametrize("leaves", [None, 2])
@pytest.mark.parametrize(
    "options", [{}, {"compact_obs": True}, {"keep": [("next", *X), ACTION]}, {"set_truncated": True}]
)
def test_fake_batch_looks_like_a_real_one(options, leaves):
    collector = make(leaves=leaves, frames_per_batch=FRAMES * (leaves or 1), **options)
    fake, real = collector.fake_tensordict(), next(iter(collector))
    assert (fake.shape, fake.names) == (real.shape, real.names)
    assert set(fake.keys(True, True)) == set(real.keys(True, True))
    for key in real.keys(True, True):
        assert (fake.get(key).shape, fake.get(key).dtype) == (real.get(key).shape, real.get(key).dtype), key
    assert bool(real.get(("next", "done"))[..., -1, :].all()) == ("set_truncated" in options)
    assert ("compact_obs" in options) == (("next", *X) not in real.keys(True, True))


def test_trajectories_are_complete_and_stop_at_their_end():
    """Episodes of 6 of the 8 steps: what follows the end is masked, and no part of any assembled trajectory."""
    env = functools.partial(make_env, 6)
    for batch in make(env):
        assert batch.get(("collector", "mask")).tolist() == [[True] * 6 + [False] * 2] * ROWS
    for layout in ("padded", "cat"):
        for batch in make(env, trajs_per_batch=3, traj_format=layout):
            assert batch.shape == ((3, 6) if layout == "padded" else (18,))
            assert batch.get(("next", "done")).flatten().nonzero().flatten().tolist() == [5, 11, 17]
    sampler = SliceSampler(slice_len=6, end_key=("next", "done"))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200), sampler=sampler, batch_size=12)
    assert [batch for batch in make(env, replay_buffer=buffer, trajs_per_batch=1) if batch is not None] == []
    assert len(buffer) == 3 * ROWS * 6
    assert (buffer.sample().get("step").reshape(2, 6) == torch.arange(6)).all()
    # unfinished episodes are not trajectories, unless they are declared truncated
    one = {"trajs_per_batch": 1, "traj_format": "cat"}
    assert not list(make(**one))
    assert len(list(make(set_truncated=True, **one))) == 3 * ROWS


@pytest.mark.parametrize("options", [{}, {"init_random_frames": FRAMES}])
def test_random_actions(options):
    env = with_rows(PendulumEnv(seed=0), [ROWS])
    settings = {
        "score": KeyScore("reward", negate=True),
        "branches": 4,
        "frames_per_batch": FRAMES,
        **options,
    }
    policy = (lambda td: td.set("action", torch.full((*td.shape, 1), 9.0))) if options else None
    collector = BeamSearchCollector(env, policy, total_frames=2 * FRAMES, **settings)
    first, second = (batch.get("action") for batch in collector)
    assert first.abs().max() <= 2
    assert len(first.unique()) > FRAMES / 2
    assert bool((second == 9).all()) == bool(options)


def test_what_can_not_be_right_is_an_error():
    for options, message in (
        ({"keep_tree": True}, "keep_tree needs leaves=4"),
        ({"split_trajs": True}, "split_trajs"),
        ({"extend_buffer": False}, "extend_buffer"),
    ):
        with pytest.raises(ValueError, match=message):
            make(**options)
    with pytest.raises(ValueError, match="leaves must be"):
        make(leaves=5).next()
    with pytest.raises(TypeError, match="unknown"):
        make(unknown=3)

    class Failing(Walk):
        def _step(self, tensordict):
            raise RuntimeError("broken")

    collector = make(Failing)
    with pytest.raises(RuntimeError, match="broken"):
        next(iter(collector))
    assert collector.closed
    Failing.batch_locked = True
    with pytest.raises(ValueError, match="Failing can't be branched: it is batch-locked"):
        make(Failing)


def test_a_policy_on_a_device_of_its_own_gets_its_inputs_there():
    """What it is given is moved, and only what it writes comes back."""
    seen, batches = [], []

    class Elsewhere(Policy):
        def forward(self, tensordict):
            seen.append(tensordict.device)
            return super().forward(tensordict)

    for options in ({}, {"policy_device": "cpu"}):
        collector = make(policy=Elsewhere(), **options)
        collector.set_seed(3)
        seen.clear()
        batches.append(collector.next())
        assert set(seen) == {torch.device("cpu") if options else None}
    assert_same(batches[0].exclude("collector"), batches[1].exclude("collector"))
