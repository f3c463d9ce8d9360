"""The collector where others run it: in the processes of TorchRL's multi-process collector and of Ray."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.testing import assert_close
from torchrl.collectors import MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import PendulumEnv

from helpers_collectors import STREAM, Policy, Walk, X, assert_same, distance, give_streams
from symphony.collectors import BeamSearchCollector, KeyScore, Systematic, with_rows

ROWS, STEPS, WORKERS = 3, 8, 2
FRAMES = ROWS * STEPS
SEARCH = {"branches": 4, "prune_every": 4, "prepare": give_streams, "slot_keys": [STREAM]}
EXTRAS = {("collector", name) for name in ("beam_score", "beam_total", "beam_slot", "mask")}


class FreshWalk(Walk):
    """Seeded by whatever the process would draw next, as unseeded environments are."""

    def __init__(self) -> None:
        super().__init__()
        self.set_seed(int(torch.randint(1 << 31, ())))


class Weighted(nn.Module):
    """Distance times a weight."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        return self.weight * distance(tensordict)


def make_env():
    return with_rows(Walk(), [ROWS])


def fresh_env():
    return with_rows(FreshWalk(), [ROWS])


def several(
    env=make_env, policy=None, *, workers=WORKERS, batches=2, search=SEARCH, score=distance, **kwargs
):
    frames = workers * FRAMES
    how = {
        "frames_per_batch": frames,
        "total_frames": batches * frames,
        "auto_register_policy_transforms": False,
    }
    how |= {} if "replay_buffer" in kwargs else {"use_buffers": False, "cat_results": "stack"}
    bound = BeamSearchCollector.bind(score=score, **search)
    return MultiSyncCollector([env] * workers, policy, collector_class=bound, **how, **kwargs)


@pytest.mark.slow
@pytest.mark.usefixtures("_started_quickly")
def test_a_worker_collects_what_the_collector_does_here():
    collector = several(policy=Policy(), workers=1)
    try:
        collector.set_seed(3)
        batches = [batch.clone() for batch in collector]
    finally:
        collector.shutdown()
    how = {"score": distance, "frames_per_batch": FRAMES, "total_frames": 2 * FRAMES, **SEARCH}
    local = BeamSearchCollector(make_env, Policy(), **how)
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
    collector = several(fresh_env, Policy(), score=score, batches=3, replay_buffer=buffer)
    try:
        seen = []
        for batch in collector:
            assert batch is None
            seen.append(len(buffer))
            score.weight.data.fill_(3.0)
    finally:
        collector.shutdown()
    assert len(buffer) == 3 * WORKERS * ROWS
    assert seen[0] == WORKERS * ROWS
    assert buffer.sample().shape == (5, STEPS)
    items = buffer[:]
    assert len(items.get(X)[:, 0].flatten(1).unique(dim=0)) == len(items)
    assert len(items.get(("collector", "traj_ids"))[:, 0].unique()) == len(items)
    factor = items.get(("collector", "beam_score")) / items.get(("next", *X)).squeeze(-1).abs()
    assert_close(factor.mean((-1, -2))[: seen[0]], torch.ones(seen[0]))
    assert_close(factor.mean((-1, -2))[-seen[0] :], torch.full((seen[0],), 3.0))


@pytest.mark.slow
@pytest.mark.usefixtures("_started_quickly")
def test_random_actions_in_other_processes():
    score = KeyScore("reward", negate=True)
    pendulum = with_rows(PendulumEnv(seed=0), [ROWS])
    collector = several(lambda: pendulum, None, workers=1, batches=1, score=score, search={"branches": 2})
    try:
        assert [batch.shape for batch in collector] == [(1, ROWS, STEPS)]
    finally:
        collector.shutdown()


def test_workers_that_nobody_seeded_draw_apart():
    """From the global generator, which begins alike in every process: the environment's starts, the random actions
    and the noise of the rule.
    """
    how = {"score": KeyScore("reward", negate=True), "branches": 4, "rule": Systematic(1.0)}
    collectors = []
    for worker in range(2):
        with torch.random.fork_rng([]):
            torch.manual_seed(0)
            collectors.append(
                BeamSearchCollector(
                    lambda: with_rows(PendulumEnv(), [ROWS]),
                    frames_per_batch=FRAMES,
                    worker_idx=worker,
                    **how,
                )
            )
    start = TensorDict(batch_size=[ROWS, 4])
    assert not torch.equal(*(collector.rule_noise(start) for collector in collectors))
    firsts = [collector.next() for collector in collectors]
    for key in ("th", "action"):
        assert not torch.isclose(firsts[0].get(key), firsts[1].get(key)).any()
