"""Training by several processes, as ``torchrun`` starts them, with torch's DistributedDataParallel.

Means of losses are over the entries of all processes, so that W processes with batches of B do what one would do with
a batch of W x B, however uneven the shards are.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from jaxtyping import Float, Num
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from symphony.errors import ConfigError
from symphony.objectives.base import MaskedLoss
from symphony.streams import stream_of

_SEED_STRIDE = 1 << 20
# One may be validating while the others wait; torchrun itself notices one that has died.
_PATIENCE = timedelta(days=1)


class SharedLoss(DistributedDataParallel):
    """A loss whose gradients are averaged over all processes; its attributes are those of the loss."""

    def __init__(self, loss: MaskedLoss) -> None:
        # DDP can't look for unused parameters: a TensorDict of losses hides from it what they depend on.
        super().__init__(loss)

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name == "module":
                raise
            return getattr(self.module, name)


@dataclass(frozen=True)
class Processes:
    """The processes that train one run together, seen from the one of a `rank`, which computes on a device."""

    device: torch.device
    rank: int = 0
    count: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this is the process that validates, writes and prints."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """Return the seed of the data that this process draws, the run's own in the leading one."""
        return seed + self.rank * _SEED_STRIDE

    def reseed(self, seed: int, step: int) -> None:
        """Seed the global random numbers from (seed, update, process): a checkpoint holds one process's."""
        if self.count > 1:
            torch.manual_seed(stream_of(f"update {seed} {self.rank} {step}"))

    def wrap_ddp(self, loss: MaskedLoss) -> MaskedLoss | SharedLoss:
        """Return a loss over the batches of all processes; the loss itself if there is only one process."""
        if self.count == 1:
            return loss
        loss.share_count = self._mean
        return SharedLoss(loss)

    def mean(self, values: Mapping[str, Num[Tensor, ""]]) -> dict[str, Num[Tensor, ""]]:
        """Return means over the processes of numbers under the same names, NaN left out: of what a loss reports
        exactly its value on the joint batch, of AUCs and what searches report the mean of the processes' own.
        """
        if self.count == 1 or not values:
            return dict(values)
        names = sorted(values)
        own = torch.stack([values[name].detach().double() for name in names])
        known = ~own.isnan()
        both = torch.stack([own.nan_to_num(0.0, torch.inf, -torch.inf), known.double()])
        dist.all_reduce(both)
        total, number = both.unbind()
        return dict(zip(names, (total / number).unbind(), strict=True))

    def wait(self) -> None:
        """Wait until all processes have got here."""
        if self.count > 1:
            # A reduction, as a barrier of NCCL guesses the device.
            dist.all_reduce(torch.zeros((), device=self.device))

    def _mean(self, number: Num[Tensor, ""]) -> Float[Tensor, ""]:
        total = number.double()
        dist.all_reduce(total)
        return (total / self.count).float()


@contextmanager
def processes(device: torch.device) -> Iterator[Processes]:
    """Yield the processes that ``torchrun`` started or that form a group; else this one. ConfigError: no GPU."""
    begun = dist.is_available() and dist.is_initialized()
    own = dist.is_available() and not begun and dist.is_torchelastic_launched()
    if not own and not begun:
        yield Processes(device)
        return
    if device.type == "cuda":
        place = int(os.environ.get("LOCAL_RANK", "0"))
        if place >= torch.cuda.device_count():
            raise ConfigError(f"process {place} of this machine has no CUDA device of its own")
        device = torch.device("cuda", place)
        torch.cuda.set_device(device)
    if own:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=_PATIENCE)
    yield Processes(device, dist.get_rank(), dist.get_world_size())
    if own:
        # Not after an error: the others would be waited for.
        dist.destroy_process_group()
