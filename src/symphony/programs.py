"""A step of an environment, with what acts and scores in it, as one compiled program."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

PROGRAMS = 64
"""The most programs that a compiled step may have in a process: one for all states of a shape."""


def compiled(step: Callable[..., Any], env: Any, how: bool | Mapping[str, Any]) -> Callable[..., Any]:
    """Return a step in an environment, compiled in one piece as :func:`torch.compile` takes it, for states that are
    :func:`ordered`. A ValueError, at the call, says why it can't be compiled.
    """
    _ = env._step_mdp, env.done_keys, env.reward_keys  # kept once read, on which a program depends
    more: dict[str, Any] = dict(how) if isinstance(how, Mapping) else {}
    program = torch.compile(step, **{"fullgraph": True, "recompile_limit": PROGRAMS} | more)

    def run(*given: Any) -> Any:
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "The .grad attribute of a Tensor that is not a leaf", UserWarning)
                return program(*given)
        except Exception as error:
            if not type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
                raise
            raise ValueError(f"a step can't be compiled: {str(error).strip().splitlines()[0]}") from error

    return run


def ordered(state: TensorDictBase, like: TensorDictBase) -> TensorDictBase:
    """Return the entries in the order of the first state and without views: anything else would be compiled again."""
    entries = {}
    for key in sorted(state.keys(), key=[*like.keys(), *state.keys()].index):
        value = state.get(key)
        if isinstance(value, TensorDictBase):
            value = ordered(value, like.get(key, value))
        elif value._is_view():
            value = value.clone(memory_format=torch.contiguous_format)
        entries[key] = value
    return TensorDict(entries, state.batch_size, device=state.device)
