"""Logged history and simulated future of every agent as one track; the logged future is one more rollout."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.wosac.scorer.config import CURRENT
from symphony.wosac.scorer.scenario import SimulatedRollouts, WosacScenario


@dataclass(frozen=True)
class Composite:
    """R tracks of n agents over 91 steps, float32 as the definitions have it.

    Row 0 of R is the log itself, with the log's own validity. The others are rollouts: history as logged, valid where
    it was, and a future that is valid throughout. Boxes have the size of step 10 throughout.

    Attributes:
        object_id: [n], the E evaluated objects first, by ascending id.
        object_type: [n].
        evaluated: E.
        x, y, z: [R, n, 91] box centres, metres.
        heading: [R, n, 91] radians, as logged or simulated.
        valid: [R, n, 91].
        size: [n, 3].
    """

    object_id: Int[Tensor, " n"]
    object_type: Int[Tensor, " n"]
    evaluated: int
    x: Float[Tensor, "R n 91"]
    y: Float[Tensor, "R n 91"]
    z: Float[Tensor, "R n 91"]
    heading: Float[Tensor, "R n 91"]
    valid: Bool[Tensor, "R n 91"]
    size: Float[Tensor, "n 3"]

    @classmethod
    def of(cls, scenario: WosacScenario, rollouts: SimulatedRollouts) -> Composite:
        """Put history and future together; both were checked before."""
        scored = scenario.evaluated.unique()
        ids = scenario.sim_agents
        # Stable: the others stay in the log's order.
        rank = torch.where(torch.isin(ids, scored), torch.searchsorted(scored, ids), len(scored))
        ids = ids[rank.argsort(stable=True)]
        rows, columns = _positions(scenario.object_id, ids), _positions(rollouts.object_id, ids)
        log = scenario.position[rows].float()

        def joined(logged: Tensor, simulated: Tensor) -> Tensor:
            future = torch.cat([logged[None, :, CURRENT + 1 :], simulated[:, columns].float()])
            return torch.cat([logged[None, :, : CURRENT + 1].expand(len(future), -1, -1), future], dim=-1)

        valid = scenario.valid[rows]
        always = torch.ones_like(valid[None, :, CURRENT + 1 :]).expand(len(rollouts.x), -1, -1)
        return cls(
            object_id=ids,
            object_type=scenario.object_type[rows],
            evaluated=len(scored),
            x=joined(log[..., 0], rollouts.x),
            y=joined(log[..., 1], rollouts.y),
            z=joined(log[..., 2], rollouts.z),
            heading=joined(scenario.heading[rows].float(), rollouts.heading),
            valid=joined_valid(valid, always),
            size=scenario.size[rows].float(),
        )


def joined_valid(valid: Bool[Tensor, "n 91"], future: Bool[Tensor, "R n 80"]) -> Bool[Tensor, "R+1 n 91"]:
    """The log's validity, and that of each rollout."""
    history = valid[None, :, : CURRENT + 1].expand(len(future), -1, -1)
    return torch.cat([valid[None], torch.cat([history, future], dim=-1)])


def _positions(ids: Tensor, wanted: Tensor) -> Tensor:
    """Index of each wanted id, all of which are there."""
    ordered, order = ids.sort()
    return order[torch.searchsorted(ordered, wanted)]
