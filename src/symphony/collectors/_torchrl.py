"""Where the collector meets TorchRL: what it uses that is private there, and how it is built in other processes."""

from __future__ import annotations

import copyreg
from collections.abc import Callable
from typing import Any

import torch
import torchrl
from jaxtyping import Int
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector

PRIVATE = {
    "_wrapped_policy": "the policy, made to take TensorDicts and compiled if asked for",
    "_traj_pool": "numbers of trajectories, unique among the workers of a multi-process collector",
}
"""Members of :class:`torchrl.collectors.Collector`, and what for."""


def policy_of(collector: Collector) -> Callable[[TensorDictBase], TensorDictBase]:
    """The policy as the collector itself calls it."""
    return _member(collector, "_wrapped_policy")


def new_trajectories(collector: Collector, number: int, device: torch.device) -> Int[Tensor, " K"]:
    """Numbers [K] of K trajectories, never given before."""
    return _member(collector, "_traj_pool").get_traj_and_increment(number, device=device)


def _member(collector: Collector, name: str) -> Any:
    if not hasattr(type(collector), name) and name not in vars(collector):
        raise RuntimeError(
            f"TorchRL {torchrl.__version__} has no Collector.{name} ({PRIVATE[name]}), which BeamSearchCollector "
            "needs: install torchrl>=0.14.1,<0.15"
        )
    return getattr(collector, name)


class BoundType(type(Collector)):  # type: ignore[misc]  # TorchRL's metaclass has no public name
    """Of classes made at run time, which are pickled as their base and the arguments bound."""

    settings: dict[str, Any]


def bind(base: type[Collector], settings: dict[str, Any]) -> type[Collector]:
    """A subclass with arguments given; those of a call take precedence."""

    def __init__(self: Any, create_env_fn: Any, policy: Any = None, **kwargs: Any) -> None:  # noqa: N807
        base.__init__(self, create_env_fn, policy, **{**settings, **kwargs})

    members = {"__init__": __init__, "__module__": base.__module__, "settings": settings}
    return BoundType(base.__name__, (base,), members)


def _reduced(bound: BoundType) -> tuple[Any, ...]:
    return bind, (bound.__base__, bound.settings)


# pickle would look for a class in its module, unless its type has a reduction.
copyreg.pickle(BoundType, _reduced)


def seed_worker(worker: int | None) -> None:
    """Tell the random numbers of worker processes apart, which all begin with the same global generator."""
    if worker is not None:
        torch.manual_seed((torch.initial_seed() + (worker + 1) * 0x9E3779B97F4A7C15) % (1 << 63))
