"""The beam search as a TorchRL collector."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import BatchSizeTransform, Compose, EnvBase, TransformedEnv
from torchrl.envs.utils import RandomPolicy, _aggregate_end_of_traj

from symphony.collectors.beam_search import Aggregation, Score, beam_search, branch, score_state
from symphony.collectors.result import BeamSearchResult
from symphony.collectors.rules import KeepBest, PruningRule
from symphony.collectors.scores import max_then_sum
from symphony.errors import ConfigError


class BeamSearchCollector(Collector):
    """A TorchRL collector whose batches are the leaves of a beam search: see :func:`beam_search`.

    Every batch starts from a reset. Each of the environment's rows is simulated in S branches, and what is
    returned has the layout of any collector's batch: [*env.batch_size, T] with the best leaf of each row, or
    [*env.batch_size, L, T] with the L best. Everything else is :class:`torchrl.collectors.Collector`: replay
    buffers, weight updates, hooks, state, and being run by ``MultiSyncCollector`` or ``RayCollector``.

    Besides the usual entries a batch holds

    - ``("collector", "beam_score")`` [..., T, N]: score of each step and agent,
    - ``("collector", "beam_total")`` [..., T]: aggregate of the period that the step belongs to,
    - ``("collector", "beam_slot")`` [..., T] int64: slot in which the step was simulated,
    - ``("collector", "mask")`` [..., T] bool: False after the end of an episode that did not last T steps;
      TorchRL's losses leave such steps out. With ``trajs_per_batch`` they are dropped.
    - with `keep_tree`, ``("collector", "beam_rank")`` [..., T] int64: place of the leaf among those of its tree by
      the totals of their last periods, 0 for the best; and ``"tree"``, a TensorDict [*env.batch_size, S, T] of all
      that was simulated, by slot, pruned branches included, with their ``("collector", "beam_score")``.

    Frames are counted as returned; `simulated_frames` counts what was simulated for them, about S / L times as
    many.

    Args:
        create_env_fn: environment that keeps its state in the TensorDict and accepts any batch shape; for more
            than one row ``with_rows(env, [B])``. Other transforms are applied to the branches as well.
        policy: as for :class:`Collector`; random actions by default.
        score: of the state after a step, see :func:`beam_search`.
        branches: S.
        leaves: L; by default the best leaf alone, without a dimension of its own.
        prepare: called on the branched start state [*env.batch_size, S]; e.g. to give each branch a stream of
            random numbers or a group.
        keep_tree: also return what was pruned; with ``leaves=branches`` only.
        rule_noise: ``rule_noise(start, periods) -> [*env.batch_size, periods]``, numbers in [0, 1) for rules that
            draw, from the branched start state; by default from a generator that :meth:`set_seed` sets.
        prune_every, rule, aggregate, prune_last, slot_keys, group_key, keep, retries, retry_above, reseed: as
            for :func:`beam_search`.
        kwargs: as for :class:`Collector`. `frames_per_batch` is rows x L x T. Batches are never cut short by an
            interruptor, and trajectories all have one length, so `split_trajs` is not available.

    Raises:
        ConfigError: if the environment can't be branched, or for options that need single steps.
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
        rule: PruningRule = KeepBest(0.5),  # noqa: B008  (frozen)
        aggregate: Aggregation = max_then_sum,
        prune_last: bool = True,
        prepare: Callable[[TensorDictBase], TensorDictBase] | None = None,
        slot_keys: Sequence[NestedKey] = (),
        group_key: NestedKey | None = None,
        keep: Sequence[NestedKey] | None = None,
        keep_tree: bool = False,
        rule_noise: Callable[[TensorDictBase, int], Tensor] | None = None,
        retries: int = 0,
        retry_above: float | None = None,
        reseed: Callable[[TensorDictBase, int], TensorDictBase] | None = None,
        **kwargs: Any,
    ) -> None:
        if keep_tree and leaves != branches:
            raise ConfigError(f"keep_tree needs leaves={branches}, as many as branches; leaves is {leaves}")
        if leaves is not None and not 1 <= leaves <= branches:
            raise ConfigError(f"leaves must be 1 ... {branches} branches, is {leaves}")
        if kwargs.get("split_trajs"):
            raise ConfigError("split_trajs: the trajectories of a search all have one length")
        if not kwargs.get("extend_buffer", True):
            raise ConfigError("extend_buffer=False: a search has no single steps to write before it ends")
        # Multi-process collectors pass their own choice; here the batch is made anew each time.
        kwargs["use_buffers"] = False
        if kwargs.get("auto_register_policy_transforms") is None:
            # What TorchRL 0.14 does when left unset, minus its warning about any policy that is a module.
            kwargs["auto_register_policy_transforms"] = False
        super().__init__(create_env_fn, policy, **kwargs)
        self.branches = branches
        self.leaves = leaves
        self.prune_every = prune_every
        self.prepare = prepare
        self.simulated_frames = 0
        self._score = score
        self._aggregate = aggregate
        self._search = functools.partial(
            beam_search,
            prune_every=prune_every,
            rule=rule,
            aggregate=aggregate,
            prune_last=prune_last,
            slot_keys=slot_keys,
            group_key=group_key,
            retries=retries,
            retry_above=retry_above,
            reseed=reseed,
            # The leaves of a whole tree stay in the order of their slots.
            leaves=None if keep_tree else leaves or 1,
            keep_tree=keep_tree,
        )
        self._rule_noise = rule_noise
        self._rng = torch.Generator().manual_seed(torch.initial_seed() % (1 << 63))
        self._branched_env = branched_env(self.env)
        done = [("next", key) if isinstance(key, str) else ("next", *key) for key in self.env.done_keys]
        self._keep = None if keep is None else list(dict.fromkeys([*keep, *done]))
        rows = self.n_env * (leaves or 1)
        self.frames_per_batch = -(-kwargs["frames_per_batch"] // rows)
        self.requested_frames_per_batch = self.frames_per_batch * rows

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """One search from a reset: the leaves, [*env.batch_size, T] or [*env.batch_size, L, T]."""
        if self.pre_collect_hook is not None:
            self.pre_collect_hook()
        start = branch(self.env.reset(), self.branches)
        if self.prepare is not None:
            start = self.prepare(start.copy())
        found = self._search(
            self._branched_env,
            self._act,
            self._score,
            start,
            steps=self.frames_per_batch,
            noise=self.rule_noise(start),
            keep=self._keep,
            exploration_type=self.exploration_type,
        )
        self.simulated_frames += found.simulated_steps
        return self._finish(found)

    def _finish(self, found: BeamSearchResult) -> TensorDictBase:
        leaves, totals = found.trajectories, found.leaf_totals
        period = torch.arange(self.frames_per_batch, device=found.slots.device) // self.prune_every
        if self._compact_next_keys:
            leaves = leaves.exclude(*self._compact_next_keys)
        leaves.set(("collector", "beam_score"), found.scores)
        leaves.set(("collector", "beam_total"), totals.transpose(-1, -2)[..., period])
        leaves.set(("collector", "beam_slot"), found.slots.transpose(-1, -2)[..., period])
        if found.tree is not None:
            order = totals[..., -1, :].argsort(dim=-1, stable=True)
            rank = order.argsort(dim=-1, stable=True)
            leaves.set(("collector", "beam_rank"), rank[..., None].expand(leaves.shape).clone())
            found.tree.set(("collector", "beam_score"), found.simulated_scores)
            leaves.set("tree", found.tree)
        ended = _aggregate_end_of_traj(leaves.get("next"), done_keys=self.env.done_keys)
        mask = ended.cumsum(-1) - ended.long() == 0
        leaves.set(("collector", "mask"), mask)
        if self.track_traj_ids:
            number = leaves.shape[:-1].numel()
            ids = self._traj_pool.get_traj_and_increment(number, device=mask.device)
            leaves.set(
                ("collector", "traj_ids"), ids.reshape(*leaves.shape[:-1], 1).expand(leaves.shape).clone()
            )
        if self.leaves is None:
            leaves = leaves.squeeze(-2)
        leaves.refine_names(..., "time")
        if self.storing_device is not None:
            leaves = leaves.to(self.storing_device)
        leaves = self._maybe_set_truncated(leaves)
        return leaves if self.trajs_per_batch is None else self._cut(leaves)

    def _cut(self, leaves: TensorDictBase) -> TensorDictBase:
        """Put what follows an episode's end into one trajectory that never ends, so that none assembles it."""
        after = ~leaves.get(("collector", "mask"))
        ids = leaves.get(("collector", "traj_ids"))
        leaves.set(("collector", "traj_ids"), ids.masked_fill(after, -1))
        for key in self.env.done_keys:
            nested = ("next", key) if isinstance(key, str) else ("next", *key)
            done = leaves.get(nested)
            leaves.set(nested, done & ~after.reshape(after.shape + (1,) * (done.ndim - after.ndim)))
        return leaves

    def _act(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._should_use_random_frames() or isinstance(self._wrapped_policy, RandomPolicy):
            # The specs of a random policy have the rows of the collector's environment, but no branches.
            return self._branched_env.rand_action(tensordict)
        if not self._cast_to_policy_device or self.policy_device is None:
            return self._wrapped_policy(tensordict)
        output = self._wrapped_policy(tensordict.to(self.policy_device))
        output = output.select(*self._policy_output_keys)
        return tensordict.update(output if self.env_device is None else output.to(self.env_device))

    def rule_noise(self, start: TensorDictBase) -> Tensor:
        """Numbers [*env.batch_size, P] in [0, 1) for the pruning rule, from a branched start state."""
        periods = -(-self.frames_per_batch // self.prune_every)
        if self._rule_noise is not None:
            return self._rule_noise(start, periods)
        return torch.rand((*start.shape[:-1], periods), generator=self._rng).to(self.env_device)

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the environment and the noise of the pruning rule; returns the next seed."""
        self._rng.manual_seed(seed)
        return super().set_seed(seed, static_seed)

    @torch.no_grad()
    def fake_tensordict(self) -> TensorDictBase:
        """Zeros in the shape and with the entries of a batch."""
        if getattr(self, "_final_rollout", None) is None:
            self._maybe_make_final_rollout(make_rollout=True)
        plain = self._final_rollout.clone().zero_()
        first = branch(plain[..., 0].exclude("collector"), self.branches).clone()
        start = branch(self._carrier.exclude("collector"), self.branches)
        first.update(start if self.prepare is None else self.prepare(start.copy()))
        score = score_state(self._branched_env, self._score, first, first.exclude("next"))
        total = self._aggregate(score.unsqueeze(-2))
        if self.leaves is not None:
            plain = plain.unsqueeze(-2).expand(*plain.shape[:-1], self.leaves, plain.shape[-1]).clone()
        if self._keep is not None:
            plain = plain.select(*self._keep, "collector", strict=False)
        plain.set(("collector", "beam_score"), score.new_zeros(*plain.shape, score.shape[-1]))
        plain.set(("collector", "beam_total"), total.new_zeros(plain.shape))
        for name, dtype in (("beam_slot", torch.int64), ("mask", torch.bool)):
            plain.set(("collector", name), torch.zeros(plain.shape, dtype=dtype, device=score.device))
        if self._search.keywords["keep_tree"]:
            tree = plain.exclude("collector").clone()
            plain.set(
                ("collector", "beam_rank"), torch.zeros(plain.shape, dtype=torch.int64, device=score.device)
            )
            plain.set(
                "tree", tree.set(("collector", "beam_score"), plain.get(("collector", "beam_score")).clone())
            )
        plain.refine_names(..., "time")
        return self._postproc(self._maybe_set_truncated(plain))

    def state_dict(self) -> OrderedDict:
        """State of the collector (policy, environment, counters) and of the search."""
        state = super().state_dict()
        state["beam_search"] = {"simulated_frames": self.simulated_frames, "rng": self._rng.get_state()}
        return state

    def load_state_dict(self, state_dict: OrderedDict, **kwargs: Any) -> None:
        """Load what :meth:`state_dict` returned; that of a plain collector will do."""
        super().load_state_dict(state_dict, **kwargs)
        search = state_dict.get("beam_search")
        if search is not None:
            self.simulated_frames = int(search["simulated_frames"])
            self._rng.set_state(search["rng"])

    def stats(self) -> dict[str, int | float | bool]:
        """Progress in numbers; see :class:`Collector`."""
        return {**super().stats(), "simulated_frames": self.simulated_frames}

    def _discards_in_flight_trajectories(self) -> bool:
        return True


def with_rows(env: EnvBase, batch_size: Sequence[int]) -> TransformedEnv:
    """Give an environment that accepts any batch shape a fixed one, each row with a start of its own.

    A bare ``BatchSizeTransform(batch_size=...)`` resets once and starts all rows from the same state.
    """
    transform = BatchSizeTransform(batch_size=torch.Size(batch_size), reset_func=_reset_rows, env_kwarg=True)
    return TransformedEnv(env, transform)


def _reset_rows(
    tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase, env: TransformedEnv
) -> TensorDictBase:
    if tensordict_reset.batch_size == env.batch_size:  # rows were named, or only some are reset
        return tensordict_reset
    return env.base_env.reset(TensorDict({}, env.batch_size, device=env.device))


def branched_env(env: EnvBase) -> EnvBase:
    """The environment without a fixed batch size, for any number of branches.

    Raises:
        ConfigError: if it can only be stepped with its own batch size.
    """
    found = env
    if isinstance(env, TransformedEnv):
        chain = env.transform if isinstance(env.transform, Compose) else [env.transform]
        others = [transform.clone() for transform in chain if not isinstance(transform, BatchSizeTransform)]
        found = branched_env(env.base_env)
        found = TransformedEnv(found, Compose(*others)) if others else found
    if found.batch_locked or found.batch_size:
        raise ConfigError(
            f"{type(found).__name__} has a batch size of its own ({list(found.batch_size)}) and can't be stepped "
            "with branches; it needs batch_locked = False and an empty batch size, and gets its rows from "
            "with_rows(env, [B])"
        )
    return found
