"""The beam search as a TorchRL collector."""

from __future__ import annotations

import copyreg
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import RandomPolicy

from symphony.collectors.backtracking import Backtrack
from symphony.collectors.beam_search import Aggregation, BeamSearchResult, Policy, Score, beam_search
from symphony.collectors.branching import below, branch, branched_env, check_branching, last_name, same_numbers
from symphony.collectors.rules import KeepBest, PruningRule, max_then_sum


class BeamSearchCollector(Collector):
    """Collects beam searches of an environment that keeps its whole state in the TensorDict: see :func:`beam_search`.

    Every batch starts from a reset: [*env.batch_size, T] with the best leaf of each row, or [*env.batch_size, L, T]
    with the L best. Everything else is as in :class:`torchrl.collectors.Collector`: replay buffers, weight updates,
    hooks, state, and being run by ``MultiSyncCollector`` or ``RayCollector``, see :meth:`bind`.

    Besides the usual entries a batch holds

    - ``("collector", "beam_score")`` [..., T, N]: score of each step and agent,
    - ``("collector", "beam_total")`` [..., T]: aggregate of the period that the step belongs to,
    - ``("collector", "beam_slot")`` [..., T] int64: slot in which the step was simulated,
    - ``("collector", "mask")`` [..., T] bool: False after the end of an episode, of the first agent's where they end
      apart; TorchRL's losses leave such steps out. With ``trajs_per_batch`` they are dropped.
    - with the rule :class:`Systematic`, ``("collector", "log_weight")`` [..., T]: of the leaf, relative to the mean
      weight of its tree. Its exponential weights leaves as the policy times ``exp(-total / temperature)`` does.
    - with `keep_tree`, ``"tree"``, a TensorDict [*env.batch_size, S, T] of all simulated steps, by slot, pruned
      branches included, with their ``("collector", "beam_score")``.

    Args:
        create_env_fn: as for :func:`beam_search`; for more than one row with a batch size: ``with_rows(env, [B])``.
        policy: as for :class:`Collector`; random actions by default.
        score: score of the state after a step, see :func:`beam_search`.
        branches: S.
        leaves: L; by default the best leaf alone, without a dimension of its own.
        prepare: function called on the branched start state [*env.batch_size, S], e.g. to give each branch a group.
        keep_tree: also return the pruned branches; with ``leaves=branches`` only.
        rule_noise: ``rule_noise(start, periods)`` gives numbers in [0, 1) for rules that draw, as `noise` of
            :func:`beam_search`; by default from a generator that :meth:`set_seed` sets.
        prune_every, rule, aggregate, value, accumulate, prune_last: as for :func:`beam_search`.
        until_done, slot_keys, group_key, keep, compile_step: as for :func:`beam_search`, too.
        kwargs: as for :class:`Collector`. `frames_per_batch` is rows x L x T, `simulated_frames` S / L times as many.
    """

    def __init__(
        self,
        create_env_fn: EnvBase | Callable[[], EnvBase],
        policy: Callable[[TensorDictBase], TensorDictBase] | None = None,
        *,
        score: Score,
        branches: int,
        leaves: int | None = None,
        prune_every: int = 10,
        rule: PruningRule | Backtrack = KeepBest(0.5),  # noqa: B008  (frozen)
        aggregate: Aggregation = max_then_sum,
        value: Score | None = None,
        accumulate: bool = False,
        prune_last: bool = True,
        until_done: bool = True,
        prepare: Callable[[TensorDictBase], TensorDictBase] | None = None,
        slot_keys: Sequence[NestedKey] = (),
        group_key: NestedKey | None = None,
        keep: Sequence[NestedKey] | None = None,
        keep_tree: bool = False,
        rule_noise: Callable[[TensorDictBase, int], Tensor] | None = None,
        compile_step: bool | Mapping[str, Any] = False,
        **kwargs: Any,
    ) -> None:
        if not 1 <= (1 if leaves is None else leaves) <= branches or (keep_tree and leaves != branches):
            raise ValueError(f"leaves must be 1 ... {branches} branches, keep_tree needs all, is {leaves}")
        if kwargs.get("split_trajs") or not kwargs.get("extend_buffer", True):
            raise ValueError("a search has no single steps: neither split_trajs nor extend_buffer=False")
        # Multi-process collectors pass their own choice; here each batch begins with a reset.
        kwargs["use_buffers"], kwargs["reset_at_each_iter"] = False, True
        if kwargs.get("auto_register_policy_transforms") is None:
            # What TorchRL 0.14 does when left unset, minus its warning about any policy that is a module.
            kwargs["auto_register_policy_transforms"] = False
        if kwargs.get("worker_idx") is not None:
            # The global generators of worker processes all begin alike.
            apart = (kwargs["worker_idx"] + 1) * 0x9E3779B97F4A7C15
            torch.manual_seed((torch.initial_seed() + apart) % (1 << 63))
        super().__init__(create_env_fn, policy, **kwargs)
        self.branches, self.leaves, self.prune_every, self.prepare = branches, leaves, prune_every, prepare
        self.simulated_frames = 0
        self._score, self._rule, self._rule_noise = score, rule, rule_noise
        self._rng = torch.Generator().manual_seed(torch.initial_seed() % (1 << 63))
        check_branching(self.env)
        self._done = [below(key) for key in self.env.done_keys]
        self._search: dict[str, Any] = {"prune_every": prune_every, "rule": rule, "aggregate": aggregate}
        self._search |= {"value": value, "accumulate": accumulate, "prune_last": prune_last}
        self._search |= {"until_done": until_done, "slot_keys": slot_keys, "group_key": group_key}
        self._search["compile_step"] = compile_step
        self._search["keep"] = None if keep is None else list(dict.fromkeys([*keep, *self._done]))
        # The leaves of a whole tree stay in the order of their slots.
        self._search |= {"keep_tree": keep_tree, "leaves": None if keep_tree else leaves or 1}
        rows = self.n_env * (leaves or 1)
        self.frames_per_batch = -(-kwargs["frames_per_batch"] // rows)
        self.requested_frames_per_batch = self.frames_per_batch * rows

    @classmethod
    def bind(cls, **settings: Any) -> type[Collector]:
        """Return a subclass with arguments given, for collectors that make collectors in other processes.

        ``MultiSyncCollector(..., collector_class=BeamSearchCollector.bind(score=score, branches=16))``; without a
        replay buffer also ``use_buffers=False, cat_results="stack"``. The arguments must be picklable. A network on
        the CPU that is part of them is shared with the processes of this machine, any other is copied.
        """
        return bind(cls, settings)

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Return the leaves of one search from a reset, [*env.batch_size, T] or [*env.batch_size, L, T]."""
        if self.pre_collect_hook is not None:
            self.pre_collect_hook()
        found = self._searched(self.env, self.env.reset())
        self.simulated_frames += found.simulated_steps
        return self._finish(found)

    def _searched(self, env: EnvBase, rows: TensorDictBase) -> BeamSearchResult:
        start = branch(rows, self.branches)
        start = start if self.prepare is None else self.prepare(start.copy())
        how = {"steps": self.frames_per_batch, "exploration_type": self.exploration_type, **self._search}
        return beam_search(env, self._acting(), self._score, start, noise=self.rule_noise(start), **how)

    def _finish(self, found: BeamSearchResult, *, fake: bool = False) -> TensorDictBase:
        leaves, totals = found.trajectories, found.leaf_totals
        period = torch.arange(self.frames_per_batch, device=found.slots.device) // self.prune_every
        if self.compact_obs:
            states = (*self.env.observation_keys, *self.env.state_keys)
            leaves = leaves.exclude(*(below(key) for key in states))
        flags = [leaves.get(key).flatten(leaves.ndim).any(-1) for key in self._done]
        ended = torch.stack(flags).any(0) & self._search["until_done"]
        extras = {
            "beam_score": found.scores,
            "beam_total": totals.transpose(-1, -2)[..., period],
            "beam_slot": found.slots.transpose(-1, -2)[..., period],
            "mask": ended.cumsum(-1) - ended.long() == 0,
        }
        if found.leaf_log_weights is not None:
            extras["log_weight"] = found.leaf_log_weights.float()[..., None].expand(leaves.shape).clone()
        if self.track_traj_ids:
            number = leaves.shape[:-1].numel()
            ids = torch.zeros(number, dtype=torch.int64, device=ended.device)
            ids = ids if fake else self._traj_pool.get_traj_and_increment(number, device=ended.device)
            extras["traj_ids"] = ids.reshape(*leaves.shape[:-1], 1).expand(leaves.shape).clone()
        for name, value in extras.items():
            leaves.set(("collector", name), value)
        if found.tree is not None:
            found.tree.set(("collector", "beam_score"), found.simulated_scores)
            leaves.set("tree", found.tree)
        leaves = leaves.squeeze(-2) if self.leaves is None else leaves
        leaves.refine_names(..., "time")
        leaves = leaves if self.storing_device is None else leaves.to(self.storing_device)
        leaves = self._truncate(leaves)
        return leaves if self.trajs_per_batch is None else self._cut(leaves)

    def _cut(self, leaves: TensorDictBase) -> TensorDictBase:
        """Put what follows an episode's end into one trajectory that never ends, so that none assembles it."""
        after, ids = ~leaves.get(("collector", "mask")), ("collector", "traj_ids")
        leaves.set(ids, leaves.get(ids).masked_fill(after, -1))
        for key in self._done:
            leaves.set(key, leaves.get(key) & ~expand_as_right(after, leaves.get(key)))
        return leaves

    def _truncate(self, leaves: TensorDictBase) -> TensorDictBase:
        """Declare the last step truncated, if the collector is to."""
        last = (torch.arange(leaves.shape[-1]) == leaves.shape[-1] - 1).expand(leaves.shape)
        for key in self._done if self.set_truncated else ():
            if last_name(key) == "truncated":
                for name in {key, (*key[:-1], "done")} & {*leaves.keys(True, True)}:
                    ended = leaves.get(name)
                    leaves.set(name, ended | expand_as_right(last, ended).to(ended.device))
        return leaves

    def _acting(self) -> Policy:
        """Return the policy of one search; random actions until `init_random_frames` are collected."""
        buffer, policy = self.replay_buffer, self._wrapped_policy
        seen = self.stats()["frames"] if buffer is None else buffer.write_count
        if isinstance(policy, RandomPolicy) or seen < (self.init_random_frames or 0):
            # The specs of a random policy have neither branches nor the lines that go back.
            return lambda td: branched_env(self.env, td.shape).rand_action(td)
        if self.policy_device is None or self.policy_device == self.env_device:
            return policy

        def elsewhere(tensordict: TensorDictBase) -> TensorDictBase:
            there = tensordict.to(self.policy_device)
            output = policy(there.copy())
            output = output.select(*(k for k, v in output.items(True, True) if v is not there.get(k, None)))
            return tensordict.update(output if self.env_device is None else output.to(self.env_device))

        return elsewhere

    def rule_noise(self, start: TensorDictBase) -> Float[Tensor, "*_"]:
        """Return numbers in [0, 1) for the pruning rule [*env.batch_size, P], given the start."""
        periods = -(-self.frames_per_batch // self.prune_every)
        if self._rule_noise is not None:
            return self._rule_noise(start, periods)
        return torch.rand((*start.shape[:-1], periods), generator=self._rng).to(self.env_device)

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the environment and the noise of the pruning rule; return the next seed."""
        self._rng.manual_seed(seed)
        return super().set_seed(seed, static_seed)

    @torch.no_grad()
    def fake_tensordict(self) -> TensorDictBase:
        """Return zeros in the shape and with the entries of a batch."""
        # Of copies, or running statistics would learn from zeros.
        env, rng = branched_env(self.env, self.env.batch_size, share=False), self._rng.get_state()
        start = self.env.fake_tensordict().exclude("next", *self.env.action_keys)
        with same_numbers(env):
            batch = self._finish(self._searched(env, start), fake=True)
        self._rng.set_state(rng)
        batch = batch if self.postproc is None else self.postproc(batch)
        batch = batch.exclude(*(key for key in batch.keys(True) if last_name(key).startswith("_")))
        return self._truncate(batch.apply(torch.zeros_like))

    def state_dict(self) -> OrderedDict:
        """Return state of the collector (policy, environment, counters) and of the search."""
        state = super().state_dict()
        state["beam_search"] = {"simulated_frames": self.simulated_frames, "rng": self._rng.get_state()}
        return state

    def load_state_dict(self, state_dict: OrderedDict, **kwargs: Any) -> None:
        """Load what :meth:`state_dict` returned; that of a plain collector works as well."""
        super().load_state_dict(state_dict, **kwargs)
        search = state_dict.get("beam_search")
        if search is not None:
            self.simulated_frames = int(search["simulated_frames"])
            self._rng.set_state(search["rng"])

    def stats(self) -> dict[str, int | float | bool]:
        """Return the progress in numbers; see :class:`Collector`."""
        return {**super().stats(), "simulated_frames": self.simulated_frames}


class BoundType(type(Collector)):  # type: ignore[misc]  # TorchRL's metaclass has no public name
    """The type of classes made at run time, which are pickled as their base and the bound arguments."""

    settings: dict[str, Any]


def bind(base: type[Collector], settings: dict[str, Any]) -> type[Collector]:
    """Return a subclass with arguments given; those of a call take precedence."""

    def __init__(self: Any, create_env_fn: Any, policy: Any = None, **kwargs: Any) -> None:  # noqa: N807
        base.__init__(self, create_env_fn, policy, **{**settings, **kwargs})

    members = {"__init__": __init__, "__module__": base.__module__, "settings": settings}
    return BoundType(base.__name__, (base,), members)


# pickle would look for a class in its module, unless its type has a reduction.
copyreg.pickle(BoundType, lambda bound: (bind, (bound.__base__, bound.settings)))  # type: ignore[arg-type, return-value]
