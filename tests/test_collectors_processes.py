"""The collector where others run it: in the processes of TorchRL's multi-process collector and of Ray."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close
from torchrl.collectors import MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import PendulumEnv

from helpers_collectors import (
    ACTION,
    STREAM,
    FreshWalk,
    Policy,
    Walk,
    Weighted,
    X,
    distance,
    give_streams,
    noise,
)
from symphony.collectors import BeamSearchCollector, KeyScore, Systematic, with_rows

ROWS, STEPS, WORKERS = 3, 8, 2
FRAMES = ROWS * STEPS
EXTRAS = {("collector", name) for name in ("beam_score", "beam_total", "beam_slot", "mask")}


def make_env():
    return with_rows(Walk(), [ROWS])


def fresh_env():
    return with_rows(FreshWalk(), [ROWS])


def several(env=make_env, policy=None, *, workers=WORKERS, score=distance, batches=2, **kwargs):
    bound = BeamSearchCollector.bind(
        score=score, branches=4, prune_every=4, prepare=give_streams, slot_keys=[STREAM]
    )
    if "replay_buffer" not in kwargs:
        kwargs |= {"use_buffers": False, "cat_results": "stack"}
    return MultiSyncCollector(
        [env] * workers,
        Policy() if policy is None else policy,
        collector_class=bound,
        frames_per_batch=workers * FRAMES,
        total_frames=batches * workers * FRAMES,
        auto_register_policy_transforms=False,
        **kwargs,
    )


def assert_same(first, second):
    assert set(first.keys(True, True)) == set(second.keys(True, True))
    for key in first.keys(True, True):
        assert_close(first.get(key), second.get(key), rtol=0, atol=0, equal_nan=True, msg=str(key))


@pytest.mark.slow
@pytest.mark.usefixtures("_started_quickly")
def test_a_worker_collects_what_the_collector_does_here():
    collector = several(workers=1)
    try:
        collector.set_seed(3)
        batches = [batch.clone() for batch in collector]
    finally:
        collector.shutdown()
    local = BeamSearchCollector(
        make_env,
        Policy(),
        score=distance,
        branches=4,
        prune_every=4,
        prepare=give_streams,
        slot_keys=[STREAM],
        frames_per_batch=FRAMES,
        total_frames=2 * FRAMES,
    )
    local.set_seed(3)
    local.reset()  # as the multi-process collector does after seeding
    for one, other in zip(batches, local, strict=True):
        assert one.shape == (1, ROWS, STEPS)
        assert_same(one[0].exclude("collector"), other.exclude("collector"))
        assert set(one.keys(True, True)) >= EXTRAS


@pytest.mark.slow
@pytest.mark.usefixtures("_started_quickly")
def test_two_workers_fill_a_replay_buffer_with_data_of_their_own():
    """Nobody seeded them; a score's network is the one that is trained here."""
    score = Weighted()
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100, shared_init=True), batch_size=5)
    collector = several(fresh_env, score=score, batches=3, replay_buffer=buffer)
    try:
        seen = []
        for done, batch in enumerate(collector, 1):
            assert batch is None
            seen.append(len(buffer))
            if done == 1:
                score.weight.data.fill_(3.0)
    finally:
        collector.shutdown()
    assert len(buffer) == 3 * WORKERS * ROWS
    assert seen[0] == WORKERS * ROWS
    assert buffer.sample().shape == (5, STEPS)
    items = buffer[:]
    starts = items.get(X)[:, 0].flatten(1)
    assert len(starts.unique(dim=0)) == len(items)
    assert len(items.get(("collector", "traj_ids"))[:, 0].unique()) == len(items)
    factor = items.get(("collector", "beam_score")) / items.get(("next", *X)).squeeze(-1).abs()
    assert_close(factor.mean(-1).mean(-1)[: seen[0]], torch.ones(seen[0]))
    assert_close(factor.mean(-1).mean(-1)[-WORKERS * ROWS :], torch.full((WORKERS * ROWS,), 3.0))


def test_workers_that_nobody_seeded_draw_apart():
    """From the global generator, which begins alike in every process: the environment's starts, the random actions
    and the noise of the rule.
    """
    collectors = []
    for worker in range(2):
        state = torch.get_rng_state()
        torch.manual_seed(0)
        collectors.append(
            BeamSearchCollector(
                lambda: with_rows(PendulumEnv(), [ROWS]),
                score=KeyScore("reward", negate=True),
                branches=4,
                rule=Systematic(1.0),
                frames_per_batch=FRAMES,
                worker_idx=worker,
            )
        )
        torch.set_rng_state(state)
    start = TensorDict(batch_size=[ROWS, 4])
    noises = [collector.rule_noise(start) for collector in collectors]
    assert not torch.equal(*noises)
    assert collectors[0].env.base_env.rng is not None
    firsts = [collector.next() for collector in collectors]
    for key in ("th", "action"):
        assert not torch.isclose(firsts[0].get(key), firsts[1].get(key)).any()


@pytest.mark.slow
def test_through_ray():
    """One worker, since each takes seconds to start; that several draw apart is shown above."""
    ray = pytest.importorskip("ray")
    from torchrl.collectors.distributed import RayCollector

    path = [str(Path(__file__).parent), *sys.path]
    ray.init(num_cpus=1, include_dashboard=False, runtime_env={"env_vars": {"PYTHONPATH": ":".join(path)}})
    try:
        bound = BeamSearchCollector.bind(
            score=distance, branches=4, prune_every=4, prepare=give_streams, slot_keys=[STREAM]
        )
        policy = Policy()
        collector = RayCollector(
            [fresh_env],
            policy,
            collector_class=bound,
            frames_per_batch=FRAMES,
            total_frames=2 * FRAMES,
            remote_configs={"num_cpus": 1, "num_gpus": 0},
            sync=True,
        )
        policy.gain.data.fill_(-0.9)
        collector.update_policy_weights_(TensorDict.from_module(policy))
        batches = [batch.clone() for batch in collector]
        collector.shutdown()
    finally:
        ray.shutdown()
    assert len(batches) == 2
    for batch in batches:
        assert batch.numel() == FRAMES
        assert set(batch.keys(True, True)) >= EXTRAS
        assert_close(batch.get(ACTION), -0.9 * batch.get(X) + noise(batch, 2))
    starts = torch.cat([batch.get(X)[..., 0, :, 0].reshape(-1, 2) for batch in batches])
    assert len(starts.unique(dim=0)) == 2 * ROWS
