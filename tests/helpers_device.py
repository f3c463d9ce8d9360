"""A device that exists in name only, to test code for accelerators on a machine that has none.

Inside :func:`pretend` tensors have no numbers. PyTorch itself refuses to mix devices and to read a number; copies
between device and host, which would wait, are noted; constants that are made once per device are counted apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any
from unittest import mock

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils import backend_registration as registration
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Composite, Unbounded

from symphony.envs import DrivingEnv
from symphony.geometry import frames as constants

NAME = "fakegpu"

# Where there are two kinds, autograd takes streams from one and work from the other, and fails.
if torch.cuda.is_available():
    pytest.skip(
        "PyTorch takes one kind of accelerator in a process, here a real one; with CUDA_VISIBLE_DEVICES= in the "
        "environment these tests run",
        allow_module_level=True,
    )


class PretendDevice:
    """A device without numbers: copies between it and the host so far, as text, and how many constants were made."""

    def __init__(self) -> None:
        self.device = torch.device(NAME, 0)
        self.waits: list[str] = []
        self.constants = 0

    def constant(self, *given: Any) -> Tensor:
        """Return a constant that the package makes; the caller must keep it."""
        self.constants, waits = self.constants + 1, len(self.waits)
        made = _MADE(*given)
        del self.waits[waits:]
        return made


def _tensors(value: Any) -> list[Tensor]:
    """Return the tensors in what an operator takes or returns, which nests lists only."""
    if isinstance(value, Tensor):
        return [value]
    return [found for part in value for found in _tensors(part)] if isinstance(value, list | tuple) else []


class _Watch(TorchDispatchMode):
    def __init__(self, pretended: PretendDevice) -> None:
        super().__init__()
        self.pretended = pretended

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        # A single number of the host may take part in anything: it travels with the call.
        if "copy" in func.__name__:
            given = _tensors(args) + _tensors(tuple((kwargs or {}).values()))
            before, after = ({v.device.type for v in each} for each in (given, _tensors(out)))
            if len(before | after) > 1 and before:
                shapes = [tuple(v.shape) for v in given]
                self.pretended.waits.append(f"{func} {sorted(before)} -> {sorted(after)} {shapes}")
        return out


class _Backend(registration._DummyBackendModule):
    """The module that PyTorch and TensorDict take for the device's, such as ``torch.cuda``."""

    pretended: PretendDevice | None = None

    def is_available(self) -> bool:
        # Whatever else runs in this process must not find it.
        return self.pretended is not None

    # What forks of the random state ask every device for, long after the pretending is over.
    def get_rng_state(self, *_: Any) -> Tensor:
        return torch.get_rng_state()

    def set_rng_state(self, *_: Any) -> None:
        pass

    def synchronize(self, *_: Any) -> None:
        if self.pretended is not None:
            self.pretended.waits.append("synchronize")


_MADE = constants.made.__wrapped__
BACKEND = _Backend()


class _Hook(registration._DummyPrivateUse1Hook):
    def is_available(self) -> bool:
        return BACKEND.is_available()


# Without it PyTorch knows the device, but can't index its tensors. At once, because autograd counts the devices when
# it first runs in a process.
if torch._C._get_privateuse1_backend_name() != NAME:
    registration._setup_privateuseone_for_python_backend(NAME, BACKEND, _Hook())


@contextmanager
def pretend() -> Iterator[PretendDevice]:
    """Everything made inside is without numbers; what is made on the device is noted to be there."""
    BACKEND.pretended = device = PretendDevice()
    # Constants without numbers must not be found by what runs later, nor those with numbers by what runs here.
    try:
        with mock.patch.object(constants, "made", cache(device.constant)), FakeTensorMode(), _Watch(device):
            yield device
    finally:
        BACKEND.pretended = None


def on(device: PretendDevice, given: Any) -> Any:
    """A tensor, TensorDict, tensor class, or in place a module or environment, as it would be on the device."""

    def moved(value: Tensor, graph: bool = True) -> Tensor:
        fake = torch.empty(value.shape, dtype=value.dtype, device=device.device)
        return fake.requires_grad_(value.requires_grad) if graph else fake

    if isinstance(given, Tensor):
        return moved(given)
    if isinstance(given, DrivingEnv):
        given._scenes = on(device, given.scenes)
        if not given.dynamics.discrete:  # TorchRL looks at the numbers of bounds
            n = given.num_agents
            given.action_spec = Composite(agents=Composite(action=Unbounded((n, 2)), shape=(n,)))
        return given.to(device.device)
    if isinstance(given, nn.Module):
        for module in given.modules():
            for name, value in module._parameters.items():
                if value is not None:
                    module._parameters[name] = nn.Parameter(moved(value, graph=False), value.requires_grad)
            for name, value in module._buffers.items():
                if value is not None:
                    module._buffers[name] = moved(value)
        return given
    if isinstance(given, TensorDictBase) or hasattr(given, "apply"):
        return given.apply(moved, device=device.device)
    raise TypeError(f"can't move {type(given).__name__}")
