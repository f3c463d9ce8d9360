"""Which environments can be branched, and how a batch of rows and branches is made of one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from weakref import WeakSet

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import BatchSizeTransform, Compose, EnvBase, TransformedEnv

from symphony.errors import ConfigError

_PASSED: WeakSet[EnvBase] = WeakSet()


def branch(tensordict: TensorDictBase, branches: int) -> TensorDictBase:
    """[*b] to [*b, S]: S views of each row, to start a search from."""
    return tensordict.unsqueeze(-1).expand(*tensordict.batch_size, branches)


def check_branching(env: EnvBase, state: TensorDictBase | None = None) -> None:
    """Refuse an environment that keeps anything outside of the TensorDict: copies of its branches would share it.

    That rules out GymEnv, VmasEnv, SerialEnv, ParallelEnv and whatever wraps a simulator of its own. Environments
    with a batch size of their own are refused at once. Given a state, the environment is also stepped from it twice
    by the same random numbers, once in its lifetime: if the results differ, it remembers something. One whose class
    says ``branchable = True`` is spared that trial, which waits for the device.

    Args:
        env: to be branched.
        state: [...], from which it can be stepped.

    Raises:
        ConfigError: if it can't be branched.
    """
    if env.batch_locked or env.batch_size:
        kind = "is batch-locked" if env.batch_locked else f"has a batch size, {list(env.batch_size)}"
        raise ConfigError(_refusal(env, kind))
    if state is None or env in _PASSED or getattr(env, "branchable", False):
        return
    one = state[(0,) * state.ndim].unsqueeze(0)
    with torch.no_grad():
        with _same_numbers(env):
            acting = env.rand_action(one.copy())
        results = []
        for _ in range(2):
            with _same_numbers(env):
                results.append(env.step(acting.copy()).get("next"))
    changed = [key for key, value in results[0].items(True, True) if not _same(value, results[1].get(key))]
    if changed:
        raise ConfigError(
            _refusal(env, f"gave another {changed[0]!r} when stepped from the same state again")
        )
    _PASSED.add(env)


def _refusal(env: EnvBase, why: str) -> str:
    return (
        f"{type(env).__name__} can't be branched: it {why}. A search copies branches by copying TensorDicts, so the "
        "environment must keep all of its state there (batch_locked = False, an empty batch size); rows come from "
        "with_rows(env, [B]). GymEnv, VmasEnv, SerialEnv and ParallelEnv can't be branched"
    )


@contextmanager
def _same_numbers(env: EnvBase) -> Iterator[None]:
    """Put back the generators, the global ones and the environment's, as if nothing had been drawn."""
    device = torch.device("cpu") if env.device is None else env.device
    own = [
        value for part in env.modules() for value in vars(part).values() if isinstance(value, torch.Generator)
    ]
    states = [generator.get_state() for generator in own]
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        yield
    for generator, before in zip(own, states, strict=True):
        generator.set_state(before)


def _same(one: Tensor, other: Tensor | None) -> bool:
    if not isinstance(one, Tensor):
        return True
    if other is None or other.shape != one.shape:
        return False
    if one.is_floating_point():  # a device may add up in another order each time
        return torch.allclose(one, other, rtol=1e-4, atol=1e-5, equal_nan=True)
    return torch.equal(one, other)


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
    check_branching(found)
    return found
