"""The collector: what TorchRL's own tests ask of one, its work in processes, and what it needs of TorchRL."""

from __future__ import annotations

import ast
import functools
import inspect
import pickle
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.testing import assert_close
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import PendulumEnv

import symphony.collectors
from helpers_collectors import ACTION, STREAM, Policy, Walk, X, assert_same, distance, give_streams
from symphony.collectors import BeamSearchCollector, KeyScore, Systematic, with_rows

ROWS, STEPS, FRAMES, WORKERS = 3, 8, 3 * 8, 2
SEARCH = {"branches": 4, "prune_every": 4, "prepare": give_streams, "slot_keys": [STREAM]}
PLAIN = {"auto_register_policy_transforms": False}
ROOM = Path(symphony.collectors.__file__).parents[1]
EXTRAS = [("collector", name) for name in ("beam_score", "beam_total", "beam_slot", "mask")]


def make_env(last=1000):
    return with_rows(Walk(last=last), [ROWS])


def make(env=make_env, policy=None, **kwargs):
    how = {"score": distance, "frames_per_batch": FRAMES, **SEARCH, **kwargs}
    how = {"total_frames": 3 * how["frames_per_batch"], **how}
    return BeamSearchCollector(env, policy or Policy(), **how)


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
    assert_close(batch.get(STREAM).squeeze(-1) % 100, slot)
    assert (batch.get(("collector", "traj_ids")).flatten(0, 1) == torch.arange(3, 9)[:, None]).all()
    assert batch.get(("collector", "mask")).all()
    assert collector.simulated_frames == ROWS * 4 * STEPS == collector.stats()["simulated_frames"]


def test_same_seed_same_data():
    def data(seed, fake=False):
        collector = make(rule=Systematic(0.5))
        following = collector.set_seed(seed)
        assert not fake or collector.fake_tensordict().shape == (ROWS, STEPS)
        drawn = collector.rule_noise(TensorDict(batch_size=[4, 2]))  # the numbers of the rule are seeded, too
        return torch.cat([batch.exclude("collector") for batch in collector]), drawn, following

    (first, drawn, seed), (again, redrawn, same), (other, others, another) = data(0), data(0, True), data(1)
    assert_same(first, again)
    assert torch.equal(drawn, redrawn)
    assert seed == same != another
    assert not torch.equal(first.get(ACTION), other.get(ACTION))
    assert not torch.equal(drawn, others)


def test_reloading():
    first = make(policy=Policy())
    next(iter(first))
    state = pickle.loads(pickle.dumps(first.state_dict()))  # noqa: S301
    second = make()
    second.policy.gain.data.fill_(0.5)
    second.load_state_dict(state)
    assert_close(second.policy.gain, first.policy.gain)
    assert second.simulated_frames == first.simulated_frames > 0
    assert torch.equal(*(each.rule_noise(TensorDict(batch_size=[4, 2])) for each in (first, second)))
    ids = [batch.get(("collector", "traj_ids")).unique() for batch in second]
    assert len(ids) == 2
    assert min(int(i.min()) for i in ids) >= 2 * ROWS
    assert second.stats()["frames"] == second.total_frames
    plain = Collector(make_env, Policy(), frames_per_batch=FRAMES, total_frames=FRAMES, **PLAIN)
    make().load_state_dict(plain.state_dict())


@pytest.mark.parametrize("leaves", [None, 2])
@pytest.mark.parametrize("options", [
    {}, {"compact_obs": True}, {"keep": [("next", *X), ACTION]}, {"set_truncated": True},
    {"postproc": lambda td: td.select("next", "action", strict=False)},
    {"postproc": lambda td: td.select(("next", "done"), ("next", *X)), "set_truncated": True},
])  # fmt: skip
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
    one = {"trajs_per_batch": 1, "traj_format": "cat"}
    assert not list(make(**one))
    assert len(list(make(set_truncated=True, **one))) == 3 * ROWS


@pytest.mark.parametrize("options", [{}, {"init_random_frames": FRAMES}])
def test_random_actions(options):
    env = with_rows(PendulumEnv(seed=0), [ROWS])
    how = {"score": KeyScore("reward", negate=True), "branches": 4, "frames_per_batch": FRAMES, **options}
    policy = (lambda td: td.set("action", torch.full((*td.shape, 1), 9.0))) if options else None
    collector = BeamSearchCollector(env, policy, total_frames=2 * FRAMES, **how)
    first, second = (batch.get("action") for batch in collector)
    assert first.abs().max() <= 2
    assert len(first.unique()) > FRAMES / 2
    assert bool((second == 9).all()) == bool(options)


def test_what_can_not_be_right_is_an_error():
    wrong = [("keep_tree", True, "keep_tree needs all"), ("split_trajs", True, "split_trajs")]
    wrong += [("leaves", count, "leaves must be 1 ... 4") for count in (0, 5)]
    for name, value, message in (*wrong, ("extend_buffer", False, "extend_buffer")):
        with pytest.raises(ValueError, match=message):
            make(**{name: value})
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


class FreshWalk(Walk):
    """Seeded by whatever the process would draw next, as unseeded environments are."""

    def __init__(self) -> None:
        super().__init__()
        self.set_seed(int(torch.randint(1 << 31, ())))


class Weighted(nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))

    def forward(self, tensordict):
        return self.weight * distance(tensordict)


def fresh_env():
    return with_rows(FreshWalk(), [ROWS])


def several(env, policy, *, workers=WORKERS, batches=2, score=distance, **kwargs):
    frames = workers * FRAMES
    how = {"frames_per_batch": frames, "total_frames": batches * frames} | PLAIN
    how |= {} if "replay_buffer" in kwargs else {"use_buffers": False, "cat_results": "stack"}
    bound = BeamSearchCollector.bind(score=score, **SEARCH)
    return MultiSyncCollector([env] * workers, policy, collector_class=bound, **how, **kwargs)


@pytest.mark.slow
@pytest.mark.usefixtures("_started_quickly")
def test_a_worker_collects_what_the_collector_does_here():
    collector = several(make_env, Policy(), workers=1)
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
        assert set(one.keys(True, True)) >= set(EXTRAS)


@pytest.mark.slow
@pytest.mark.usefixtures("_started_quickly")
def test_two_workers_fill_a_replay_buffer_with_data_of_their_own():
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


def test_workers_that_nobody_seeded_draw_apart():
    how = {"score": KeyScore("reward", negate=True), "branches": 4, "rule": Systematic(1.0)}
    collectors, pendulums = [], lambda: with_rows(PendulumEnv(), [ROWS])
    for worker in range(2):
        with torch.random.fork_rng([]):
            torch.manual_seed(0)
            collectors.append(BeamSearchCollector(pendulums, worker_idx=worker, frames_per_batch=FRAMES, **how))
    start = TensorDict(batch_size=[ROWS, 4])
    assert not torch.equal(*(collector.rule_noise(start) for collector in collectors))
    firsts = [collector.next() for collector in collectors]
    for key in ("th", "action"):
        assert not torch.isclose(firsts[0].get(key), firsts[1].get(key)).any()


def read_of_self(name: str) -> set[str]:
    """Attributes of `self` that a class of the collector's module reads and does not make itself."""
    tree = ast.parse(Path(inspect.getfile(BeamSearchCollector)).read_text())
    (found,) = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == name]
    own = {node.name for node in found.body if isinstance(node, ast.FunctionDef)}
    attributes = [node for node in ast.walk(found) if isinstance(node, ast.Attribute)]
    used = [node for node in attributes if isinstance(node.value, ast.Name) and node.value.id == "self"]
    own |= {node.attr for node in used if isinstance(node.ctx, ast.Store)}
    return {node.attr for node in used} - own


def test_members_that_the_collector_reads_are_there_and_do_what_is_asked_of_them():
    how = {"frames_per_batch": 8, "total_frames": 16, "auto_register_policy_transforms": False}
    plain = Collector(Walk(), Policy(), **how)
    read = read_of_self("BeamSearchCollector")
    assert {"env", "policy_device", "postproc", "storing_device", "set_truncated"} <= read
    assert {name for name in read if name.startswith("_")} == {"_wrapped_policy", "_traj_pool"}
    missing = sorted(name for name in read if not hasattr(plain, name))
    assert not missing, f"TorchRL's Collector no longer has {missing}"
    assert plain._wrapped_policy(plain.env.reset()).get(ACTION).shape == (2, 1)
    first, second = (plain._traj_pool.get_traj_and_increment(3, device=torch.device("cpu")) for _ in range(2))
    assert first.dtype == torch.int64
    assert len(torch.cat([first, second]).unique()) == 6


def test_what_the_base_class_calls_is_still_called_so():
    """Methods that the search replaces: an override that nothing calls any more would be silent."""
    replaced = {"rollout", "fake_tensordict", "set_seed", "state_dict", "load_state_dict", "stats"}
    assert replaced <= set(vars(BeamSearchCollector))
    gone = sorted(name for name in replaced if not callable(getattr(Collector, name, None)))
    assert not gone, f"TorchRL's Collector no longer has {gone}"
    calls = ast.walk(ast.parse(inspect.getsource(inspect.getmodule(Collector))))
    assert "rollout" in {node.attr for node in calls if isinstance(node, ast.Attribute)}
    # Trajectories of a batch never go on in the next one, by the public option.
    search = BeamSearchCollector(Walk(), Policy(), score=distance, branches=2, frames_per_batch=8)
    assert search.reset_at_each_iter


def test_bound_classes_are_classes_that_can_be_pickled():
    bound = BeamSearchCollector.bind(score=distance, branches=4, prune_every=2)
    again = pickle.loads(pickle.dumps(bound))  # noqa: S301
    for kind in (bound, again):
        assert issubclass(kind, BeamSearchCollector)
        collector = kind(Walk(), Policy(), frames_per_batch=8, total_frames=8)
        assert (collector.branches, collector.prune_every) == (4, 2)
        assert next(iter(collector)).shape == (8,)
    assert bound(Walk(), Policy(), frames_per_batch=8, branches=3).branches == 3
    more = pickle.loads(pickle.dumps(bound.bind(leaves=2)))  # noqa: S301
    assert more(Walk(), Policy(), frames_per_batch=8).leaves == 2
    assert not hasattr(BeamSearchCollector, "settings")


def test_collectors_and_objectives_stand_alone():
    """They import TorchRL, nothing private of it, jaxtyping, each their own, and how a step becomes one program."""
    allowed = {"torch", "tensordict", "torchrl", "jaxtyping", *sys.stdlib_module_names}
    for package in ("collectors", "objectives", "programs"):
        for source in (ROOM / package).glob("*.py") if package != "programs" else [ROOM / "programs.py"]:
            nodes = list(ast.walk(ast.parse(source.read_text())))
            names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
            imported = [node for node in nodes if isinstance(node, ast.ImportFrom)]
            for name in [*names, *(f"{node.module or ''}.{a.name}" for node in imported for a in node.names)]:
                first, *rest = name.split(".")
                own = name.startswith((f"symphony.{package}", "symphony.programs"))
                assert own or first in allowed, (source.name, name)
                private = first == "torchrl" and any(part.startswith("_") for part in rest)
                assert not private, (source.name, name)


class Remembers(Policy):
    """Each action is larger than the one before, by an entry that no start state has."""

    in_keys = [*Policy.in_keys, "memory"]  # noqa: RUF012
    out_keys = [*Policy.out_keys, "memory"]  # noqa: RUF012

    def forward(self, tensordict):
        memory = tensordict.get("memory", torch.zeros(*tensordict.shape, 1))
        super().forward(tensordict)
        tensordict.set(ACTION, tensordict.get(ACTION) + memory[..., None])
        return tensordict.set("memory", memory + 1)


@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")
def test_a_compiled_search_is_the_search_and_compiled_once():
    torch.compiler.reset()
    graphs = []
    kept = {"backend": lambda graph, _: graphs.append(graph) or graph.forward}
    for policy, programs in ((Policy(), 1), (Remembers(), 2)):
        graphs.clear()
        plain, compiled = make(policy=policy), make(policy=policy, compile_step=kept)
        for collector in (plain, compiled):
            collector.set_seed(3)
        for _ in range(2):
            assert_same(compiled.next(), plain.next())
        assert len(graphs) == programs  # the first step has no memory yet
