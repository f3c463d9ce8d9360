"""Scenes and expert states of a store, prepared once per segment and kept in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from symphony import keys
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import MOVING, travel
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig, objects_at, observe
from symphony.envs.scene import SceneBatch, collate, scene
from symphony.roadgraph import LaneGraph, lane_of

IN_LANE = 1.0
"""Metres from a centre line within which a standing vehicle is taken to wait rather than to be parked."""


@dataclass(frozen=True)
class Experts:
    """Logged vehicles of one segment as demonstrations, after the fit to the action space.

    Attributes:
        agent: [K] rows of the segment's agents.
        states: [K, T, 4] fitted x, y, heading, speed.
        actions: [K, T - 1] or [K, T - 1, 2].
        valid: [K, T - 1] where the log is valid before and after the action.
        error: [K] metres between the last valid fitted and logged position.
    """

    agent: Tensor
    states: Tensor
    actions: Tensor
    valid: Tensor
    error: Tensor


def experts(segment: RunSegment, dynamics: Bicycle | Displacement) -> Experts:
    """Fit every vehicle of a segment that moves or stands in a lane (waiting is driving, parking is not), and the
    ego in any case.
    """
    valid = segment.valid
    everyone, first = np.arange(segment.num_agents), valid.argmax(1)
    lane = lane_of(
        LaneGraph(segment.road),
        segment.position[everyone, first, :2],
        segment.heading[everyone, first],
        tolerance=IN_LANE,
    )
    chosen = (segment.agent_type == AgentType.VEHICLE) & ((travel(segment) > MOVING) | (lane >= 0))
    chosen[segment.ego] = True
    chosen &= (valid[:, 1:] & valid[:, :-1]).any(1)
    rows = np.flatnonzero(chosen)

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array[rows]))

    position, heading, velocity = (
        tensor(segment.position[..., :2]),
        tensor(segment.heading),
        tensor(segment.velocity),
    )
    speed = velocity[..., 0] * heading.cos() + velocity[..., 1] * heading.sin()
    mask = tensor(valid)
    # An agent that appears later is fitted from its first valid state; its rows before that are masked.
    actions, states = dynamics.fit(position, heading, speed, mask, tensor(segment.size[:, :2]), segment.dt)
    last = mask.shape[1] - 1 - mask.flip(1).int().argmax(1)
    which = torch.arange(len(rows))
    error = (states[which, last, :2] - position[which, last]).norm(dim=-1)
    return Experts(torch.from_numpy(rows), states, actions, mask[:, 1:] & mask[:, :-1], error)


class SceneDataset:
    """Random access to the scenes and experts of a store.

    Args:
        store: the run segments.
        interactive: agents per segment that act.
        dynamics: action space the experts are fitted to.
        indices: rows of the store to use; all by default.
    """

    def __init__(
        self,
        store: SegmentStore,
        interactive: int = 2,
        dynamics: Bicycle | Displacement | None = None,
        indices: Sequence[int] | None = None,
    ) -> None:
        self.store = store
        self.interactive = interactive
        self.dynamics = Bicycle() if dynamics is None else dynamics
        self.indices = list(range(len(store))) if indices is None else list(indices)
        self._scenes: dict[int, SceneBatch] = {}
        self._experts: dict[int, Experts] = {}

    def __len__(self) -> int:
        return len(self.indices)

    def segment(self, i: int) -> RunSegment:
        """The run segment behind item ``i``."""
        return self.store[self.indices[i]]

    def scene(self, i: int) -> SceneBatch:
        """Item ``i`` as a batch of one scene."""
        if i not in self._scenes:
            self._scenes[i] = scene(self.segment(i), self.interactive)
        return self._scenes[i]

    def scenes(self, items: Sequence[int]) -> SceneBatch:
        """Several items as one padded batch."""
        return collate([self.scene(i) for i in items])

    def experts(self, i: int) -> Experts:
        """The demonstrations of item ``i``."""
        if i not in self._experts:
            self._experts[i] = experts(self.segment(i), self.dynamics)
        return self._experts[i]

    def sample_states(
        self,
        segments: int,
        states: int,
        observation: ObservationConfig,
        rng: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> TensorDict:
        """A training batch: expert states drawn uniformly from a few random segments.

        Returns:
            TensorDict [states], one agent per row: observation, ``valid`` and the expert's ``action``.
        """
        order = torch.randperm(len(self), generator=rng)[:segments].tolist()
        found = [self.experts(i) for i in order]
        scene_of, agent, step, state, action = [], [], [], [], []
        for row, expert in enumerate(found):
            which, when = expert.valid.nonzero(as_tuple=True)
            scene_of.append(torch.full_like(which, row))
            agent.append(expert.agent[which])
            step.append(when)
            state.append(expert.states[which, when])
            action.append(expert.actions[which, when])
        available = sum(map(len, step))
        pick = torch.randint(available, (states,), generator=rng)

        def choose(parts: list[Tensor]) -> Tensor:
            return torch.cat(parts)[pick].to(device)

        return expert_batch(
            self.scenes(order).to(device),
            choose(scene_of),
            choose(step),
            choose(agent),
            choose(state),
            choose(action),
            observation,
        )


def expert_batch(
    scenes: SceneBatch,
    scene_of: Tensor,
    step: Tensor,
    agent: Tensor,
    state: Tensor,
    action: Tensor,
    observation: ObservationConfig,
) -> TensorDict:
    """Observations of agents [M] in given states [M, 4], everyone else as logged, beside their actions."""
    index, here = agent[:, None], state[:, None]
    real = torch.ones_like(index, dtype=torch.bool)
    objects = objects_at(scenes, scene_of, step, here, index, real)
    seen = observe(scenes, scene_of, step, objects, index, observation)
    batch = TensorDict({}, batch_size=[len(step)], device=state.device)
    for key, value in (
        (keys.OWN, seen.own),
        (keys.OBJECTS, seen.objects),
        (keys.OBJECTS_MASK, seen.objects_mask),
        (keys.POINTS, seen.points),
        (keys.POINTS_MASK, seen.points_mask),
        (keys.VALID, real),
        (keys.ACTION, action[:, None]),
    ):
        batch.set(key, value)
    return batch
