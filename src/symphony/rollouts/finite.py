"""Numbers that are not finite end a simulation: comparisons with NaN would choose in silence."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from symphony import keys
from symphony.envs.driving import DrivingEnv
from symphony.errors import SymphonyError
from symphony.geometry.nearest import on_host

_NEVER = 1 << 30


class NotFiniteError(SymphonyError):
    """A network put out a number that is not finite.

    Attributes:
        what: the network.
        row: of the scene, in its batch.
        step: at which it was first.
        agent: number of the interactive agent, the ego being 0.
        name: of the segment, once it is known.
    """

    def __init__(self, what: str, row: int, step: int, agent: int, name: str = "") -> None:
        where = f"segment {name}: " if name else ""
        super().__init__(
            f"{where}the {what} put out a number that is not finite for agent {agent} at step {step}"
        )
        self.what, self.row, self.step, self.agent, self.name = what, row, step, agent, name

    def __reduce__(self) -> tuple[type[NotFiniteError], tuple[str, int, int, int, str]]:
        return NotFiniteError, (self.what, self.row, self.step, self.agent, self.name)

    def named(self, segment: str) -> NotFiniteError:
        """The same error, with the segment's name."""
        return NotFiniteError(self.what, self.row, self.step, self.agent, segment)


class NaNGuard(TensorDictModuleBase):
    """A module that remembers in which scenes, and when first, what it put out was not finite; looked at once, at the
    end, so that no step waits for the device.

    Args:
        env: of the simulation.
        module: reads and writes TensorDicts of the environment.
        guarded: floating-point entries [*b, N, ...] that must be finite for valid agents; absent ones are not looked
            at.
        what: its name in the error.
        scores: whether it scores states, the last of a scene among them; others act in those before. Past a scene's
            end there is only the padding of its batch.
    """

    def __init__(
        self,
        env: DrivingEnv,
        module: TensorDictModuleBase,
        guarded: Sequence[keys.Key],
        what: str,
        *,
        scores: bool = False,
    ) -> None:
        super().__init__()
        self.env, self.module, self.guarded, self.what, self.scores = env, module, guarded, what, scores
        self.in_keys, self.out_keys = module.in_keys, module.out_keys
        self._first: Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Call the module."""
        out = self.module(tensordict)
        for key in self.guarded:
            value = out.get(key, None)
            if value is not None and value.is_floating_point():
                self._see(out, value)
        return out

    def _see(self, tensordict: TensorDictBase, value: Tensor) -> None:
        if on_host(value) and bool(value.sum().isfinite()):
            return  # a sum of numbers one of which is not finite isn't either
        valid = tensordict.get(keys.VALID)
        finite = value.isfinite()
        finite = finite.flatten(valid.ndim).all(-1) if finite.ndim > valid.ndim else finite
        scene, step = tensordict.get(keys.SCENE).squeeze(-1), tensordict.get(keys.STEP).squeeze(-1)
        wrong = valid & ~finite
        bad = wrong.any(-1) & (step < self.env.scenes.last_step[scene] + self.scores)
        # The step, then the first agent of it.
        step = torch.where(bad, step * self.env.num_agents + wrong.int().argmax(-1), _NEVER)
        if self._first is None:
            self._first = torch.full((len(self.env.scenes),), _NEVER, dtype=step.dtype, device=step.device)
        # Branches of a scene share its row: the earliest of them counts.
        self._first = self._first.scatter_reduce(0, scene.flatten(), step.flatten(), "amin")

    def check(self) -> None:
        """Raise NotFiniteError for the first scene in which something was not finite."""
        if self._first is None:
            return
        bad = (self._first < _NEVER).nonzero()
        if len(bad):
            row = int(bad[0])
            raise NotFiniteError(self.what, row, *divmod(int(self._first[row]), self.env.num_agents))
