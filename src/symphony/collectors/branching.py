"""Environments in several copies: which ones can be branched, their batch shapes, and rows of their states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from weakref import WeakSet

import torch
from jaxtyping import Int, Shaped
from tensordict import NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor, is_non_tensor, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import (
    ActionScaling,
    BatchSizeTransform,
    CatFrames,
    Compose,
    EnvBase,
    TensorDictPrimer,
    TimeMaxPool,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)

_PASSED: WeakSet[EnvBase] = WeakSet()
"""Environments that have been tried and found to remember nothing."""


def branch(tensordict: TensorDictBase, branches: int) -> TensorDictBase:
    """Expand [*b] to [*b, S]: S views of each row, to start a search from."""
    return tensordict.unsqueeze(-1).expand(*tensordict.batch_size, branches)


class BatchedEnv(EnvBase):
    """A view of an environment in which its specs have a batch size, with the environment's own in front."""

    # Or TorchRL would step some rows alone, where others have ended, and take their specs for those of all.
    batch_locked = True

    def __init__(self, env: EnvBase, batch_size: Sequence[int]) -> None:
        super().__init__(device=env.device, batch_size=torch.Size(batch_size))
        self.inner = env
        self._supports_set_state = env._supports_set_state
        for name in ("observation", "state", "action", "reward", "done"):
            spec = getattr(env, f"full_{name}_spec")
            setattr(self, f"{name}_spec", _expanded(spec, env.batch_size, self.batch_size))

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name == "inner" or name.startswith("_"):
                raise
            return getattr(self.inner, name)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if tensordict is None:
            # Thrown away. BatchSizeTransform resets once for nothing, too, and seeds are to mean what they meant.
            self.inner._reset(None, **kwargs)
            tensordict = TensorDict({}, self.batch_size, device=self.device)
        found = self.inner._reset(tensordict, **kwargs)
        if found.batch_size != self.batch_size:
            # It looks at nothing but its own batch size, or takes an empty TensorDict for none.
            more = self.batch_size[len(self.inner.batch_size) :].numel()
            each = [found, *(self.inner._reset(None, **kwargs) for _ in range(more - 1))]
            dim = self.inner.batch_dims
            found = torch.stack(each, dim).reshape(self.batch_size)
        return found

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.inner._step(tensordict)

    def _set_seed(self, seed: int | None) -> None:
        self.inner._set_seed(seed)

    def to(self, device: torch.device | str | int) -> BatchedEnv:
        """Move this view and its environment to a device."""
        self.inner = self.inner.to(device)
        return super().to(device)


def _expanded(spec: Composite, own: torch.Size, shape: torch.Size) -> Composite:
    """Return a spec of batch size `own` with the batch size `shape`, which begins with `own`."""
    if spec.shape != own:
        spec = spec.clone()
        spec.shape = own
    for _ in range(len(shape) - len(own) if own else 0):
        spec = spec.unsqueeze(len(own))
    return spec.expand(*shape) if shape else spec.clone()


def with_rows(env: EnvBase, batch_size: Sequence[int]) -> TransformedEnv:
    """Give an environment that accepts any batch shape a fixed one, each row with its own start.

    Transforms of the environment are applied to the batch; others may be appended. (A bare
    ``BatchSizeTransform(batch_size=...)`` resets once and starts all rows from the same state.)
    """
    base, transforms = parts_of(env)
    _check_shape(base, torch.Size(batch_size))
    for number, transform in enumerate(transforms):
        _check_transform(transform, transforms[number + 1 :])
    rows = BatchedEnv(base, batch_size)
    return TransformedEnv(rows, Compose(*(transform.clone() for transform in transforms)))


def branched_env(env: EnvBase, shape: Sequence[int], *, share: bool = True) -> EnvBase:
    """Return the environment for states of a batch shape, with its transforms; ValueError if it can't be branched.

    Args:
        env: an environment with rows [*b], or for any batch shape.
        shape: the batch shape of the states, [*b, S].
        share: what its transforms learn, as VecNorm's statistics, is one with the environment's; else frozen copies.
    """
    base, transforms = parts_of(env)
    _check_shape(base, torch.Size(shape))
    if not transforms and not base.batch_size:
        return base
    copies = []
    for number, transform in enumerate(transforms):
        _check_transform(transform, transforms[number + 1 :])
        copy = Transform.clone(transform) if share else transform.clone()
        first = (0,) * env.batch_dims
        if isinstance(copy, TensorDictPrimer) and copy.primers.shape == env.batch_size:
            # It adds the batch of its environment to its specs, but can't replace another one.
            copy.primers = copy.primers[first] if first else copy.primers.clone()
            copy.expand_specs = True
        if isinstance(copy, ActionScaling) and copy.initialized and copy.loc.shape[: len(first)] == env.batch_size:
            copy.loc, copy.scale = copy.loc[first], copy.scale[first]
        if isinstance(copy, VecNorm | VecNormV2) and not share:
            copy.freeze()
        copies.append(copy)
    return TransformedEnv(BatchedEnv(base, shape), Compose(*copies))


def parts_of(env: EnvBase) -> tuple[EnvBase, list[Transform]]:
    """Return the innermost environment and the transforms around it, except those that only give it a batch size."""
    transforms: list[Transform] = []
    while isinstance(env, TransformedEnv):
        transforms = [*_flat(env.transform), *transforms]
        env = env.base_env
    env = env.inner if isinstance(env, BatchedEnv) else env
    return env, [one for one in transforms if not isinstance(one, BatchSizeTransform)]


def _flat(transform: Transform) -> list[Transform]:
    return [p for one in transform for p in _flat(one)] if isinstance(transform, Compose) else [transform]


def _check_shape(base: EnvBase, shape: torch.Size) -> None:
    own = base.batch_size
    if base.batch_locked:
        raise _refusal(base, "is batch-locked")
    if shape[: len(own)] != own:
        raise _refusal(base, f"has a batch size, {list(own)}, which {list(shape)} does not begin with")


def _check_transform(transform: Transform, later: Sequence[Transform]) -> None:
    if isinstance(transform, VecNormV2) and not transform.reduce_batch_dims:
        raise ValueError("VecNormV2 needs reduce_batch_dims=True: its statistics are those of all branches")
    if isinstance(transform, TimeMaxPool):
        raise ValueError("TimeMaxPool keeps frames that are not in the TensorDict; CatFrames has them there")
    written = {key for other in later for key in other.out_keys or ()}
    if isinstance(transform, CatFrames) and written & set(transform.out_keys):
        raise ValueError("CatFrames must come after other transforms of the entries that it writes")


def recall(env: EnvBase, state: TensorDictBase) -> None:
    """Let transforms that keep frames of their own continue from those in a state."""
    for transform in parts_of(env)[1]:
        if isinstance(transform, CatFrames):
            for into, key in zip(transform.in_keys, transform.out_keys, strict=True):
                setattr(transform, f"_cat_buffers_{into}", state.get(key).clone())


@contextmanager
def branched_specs(policy: Any, own: torch.Size, shape: torch.Size) -> Iterator[None]:
    """Expand the specs of exploration modules, which are made for rows [*b], to the branches [*b, S] of a search."""
    changed = []
    for module in policy.modules() if isinstance(policy, nn.Module) else ():
        spec = vars(module).get("_spec")
        leaves = [*filter(None, spec.values(True, True))] if isinstance(spec, Composite) else []
        if own and leaves and all(leaf.shape[: len(own)] == own for leaf in leaves):
            changed.append((module, spec))
            vars(module)["_spec"] = _expanded(spec, own, shape)
    try:
        yield
    finally:
        for module, spec in changed:
            vars(module)["_spec"] = spec


def check_branching(env: EnvBase, state: TensorDictBase | None = None) -> None:
    """Refuse an environment that keeps anything outside the TensorDict: copies of its branches would share it.

    It must accept any batch shape, or any that begins with its own, which rules out GymEnv, VmasEnv, SerialEnv,
    ParallelEnv and whatever wraps a simulator of its own; generators of torch of its own are allowed. Given a state,
    all entries of which must be tensors, it is also stepped from it twice by the same random numbers, once in its
    lifetime: if the results differ, it remembers something, or draws other random numbers than torch's. One whose
    class says ``branchable = True`` skips that trial, which waits for the device.

    Raises ValueError if it can't be branched.
    """
    base, transforms = parts_of(env)
    _check_shape(base, base.batch_size if state is None else state.shape)
    if state is not None:
        _check_tensors(env, state)
    if state is None or env in _PASSED or (getattr(base, "branchable", False) and not transforms):
        return
    one = state[..., :1]
    trial = branched_env(env, one.shape, share=False)
    with torch.no_grad():
        with same_numbers(trial):
            acting = trial.rand_action(one.copy())
        results = []
        for _ in range(2):
            with same_numbers(trial):
                recall(trial, one)
                results.append(trial.step(acting.copy()).get("next"))
    _check_tensors(env, results[0])
    for key, value in results[0].items(True, True):
        # A device may add up in another order each time.
        if not torch.allclose(results[1].get(key), value, rtol=1e-4, atol=1e-5, equal_nan=True):
            why = f"gave another {key!r} when stepped from the same state again, or draws random numbers not of torch"
            raise _refusal(env, why)
    _PASSED.add(env)


def _check_tensors(env: EnvBase, state: TensorDictBase) -> None:
    for key, value in state.items(True, is_leaf=is_leaf_nontensor):
        if is_non_tensor(value):
            raise _refusal(env, f"has an entry that is no tensor, {key!r}")


def _refusal(env: EnvBase, why: str) -> ValueError:
    return ValueError(
        f"{type(env).__name__} can't be branched: it {why}. A search copies branches by copying TensorDicts, so the "
        "environment must keep all of its state there and step any batch shape (batch_locked = False). GymEnv, "
        "VmasEnv, SerialEnv and ParallelEnv can't be branched"
    )


@contextmanager
def same_numbers(env: EnvBase) -> Iterator[None]:
    """Restore the global random generators and the environment's, as if nothing had been drawn."""
    held = [value for part in env.modules() for value in vars(part).values()]
    own = [value for value in held if isinstance(value, torch.Generator)]
    states = [generator.get_state() for generator in own]
    with torch.random.fork_rng([env.device] if env.device is not None and env.device.type == "cuda" else []):
        yield
    for generator, before in zip(own, states, strict=True):
        generator.set_state(before)


def take(tensordict: TensorDictBase, rows: Int[Tensor, "*c"], dims: int | None = None) -> TensorDictBase:
    """Return rows of the flattened batch, or of its first `dims` dimensions, in a batch of the shape of `rows`."""
    dims = tensordict.batch_dims if dims is None else dims
    taken = {
        key: take(value, rows, dims) if isinstance(value, TensorDictBase) else take_values(value, rows, dims)
        for key, value in tensordict.items()
    }
    return TensorDict(taken, [*rows.shape, *tensordict.batch_size[dims:]], device=tensordict.device)


def take_values(values: Shaped[Tensor, "*_"], rows: Int[Tensor, "*c"], dims: int) -> Shaped[Tensor, "*_"]:
    """Return rows of the first `dims` dimensions, flattened, in the shape of `rows`."""
    # index_select on whole rows is many times faster than gather or advanced indexing on wide entries.
    taken = values.flatten(0, dims - 1).index_select(0, rows.flatten())
    return taken.reshape(*rows.shape, *values.shape[dims:])


def below(key: NestedKey) -> tuple[str, ...]:
    """Return the key under ``"next"``."""
    return unravel_key(("next", key))


def last_name(key: NestedKey) -> str:
    """Return the last part of a key."""
    return key if isinstance(key, str) else key[-1]
