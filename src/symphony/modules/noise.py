"""Random numbers that decide actions, as a function of what they are for."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from symphony.keys import NOISE, STEP, STREAM, VALID
from symphony.streams import fold_in, uniform


class SeededNoise(TensorDictModuleBase):
    """Gives every agent the random number its next action is decided by.

    It depends on the seed, the rollout's identity, the step and the agent's place alone (never on the batch).

    Args:
        seed: of all rollouts.
        numbers: per agent; 0 for a single one without a dimension of its own.
    """

    in_keys = [STREAM, STEP, VALID]  # noqa: RUF012 - the type TensorDictModuleBase declares
    out_keys = [NOISE]  # noqa: RUF012

    def __init__(self, seed: int, numbers: int = 0) -> None:
        super().__init__()
        self.seed, self.numbers = seed, numbers

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write numbers [..., N] or [..., N, numbers] in (0, 1)."""
        agents = tensordict.get(VALID).shape[-1]
        place = torch.arange(agents, device=tensordict.device)
        stream, step = fold_in(tensordict.get(STREAM), place), tensordict.get(STEP)
        if self.numbers:
            stream = fold_in(stream[..., None], torch.arange(self.numbers, device=stream.device))
            step = step[..., None]
        return tensordict.set(NOISE, uniform(self.seed, stream, step))
