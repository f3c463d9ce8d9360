"""Rare manoeuvres made more frequent in a search, and by how much, so that true rates can still be estimated.

Legend: S branches, T steps of a period, N agents.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import pi

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from symphony import keys
from symphony.envs.driving import DrivingEnv
from symphony.geometry.frames import rotate, wrap
from symphony.imports import load_object

BRAKING = 4.0
"""m/s^2 from which on an agent brakes hard."""
CUT_IN = 15.0
"""Metres between the boxes within which an agent that comes in front of another cuts in."""
MOVING = 2.0
"""m/s below which nobody is cut in on."""
States = Float[Tensor, "*b S T N 4"]
Event = Callable[[Tensor, Tensor, Tensor, float], Tensor]
"""Called with states x, y, heading, speed before and after each step (far away where an agent is not there), boxes
[..., N, 2] and the seconds of a step; True at steps [..., S, T, N] at which it happens to an agent.
"""


def hard_braking(
    before: States, after: States, size: Float[Tensor, "*c N 2"], dt: float
) -> Bool[Tensor, "*b S T N"]:
    """Where an agent loses more than :data:`BRAKING` m/s^2."""
    return before[..., 3] - after[..., 3] > BRAKING * dt


def cut_in(
    before: States, after: States, size: Float[Tensor, "*c N 2"], dt: float
) -> Bool[Tensor, "*b S T N"]:
    """Where an agent moves sideways into the straight corridor of another driven one, which moves, close ahead."""
    pairs = (size[..., :, None, :] + size[..., None, :, :]) / 2
    length, width = pairs.unbind(-1)
    # In the frame that the other one had before, so that it is not the other that comes behind.
    was, aside = (_within(state, before)[..., 1].abs() for state in (before, after))
    ahead = _within(after, after)[..., 0]
    near = (ahead > 0) & (ahead - length < CUT_IN)
    turn = wrap(after[..., :, None, 2] - after[..., None, :, 2]).abs()
    moves = after[..., None, :, 3] > MOVING
    return (near & (aside < width) & (was >= width) & (turn < pi / 4) & moves).any(-1)


def _within(state: States, frames: States) -> Float[Tensor, "*b S T N N 2"]:
    """Each agent's place in the frame of each other one."""
    return rotate(state[..., :, None, :2] - frames[..., None, :, :2], -frames[..., None, :, 2])


EVENTS: dict[str, Event] = {"hard_braking": hard_braking, "cut_in": cut_in}


class Tilt:
    """Log-importance of branches after a period: ``strength`` where the event happened to any agent, else 0.

    Args:
        env: the environment.
        strength: of the tilt; such branches weigh exp(strength) times as much.
        event: a name of :data:`EVENTS`, or the import path of an :data:`Event`.
        ego: whether what the first agent does counts; not where a planner drives it.
    """

    def __init__(self, env: DrivingEnv, strength: float, event: str, *, ego: bool = True) -> None:
        self.env, self.strength, self.ego = env, strength, ego
        self.event: Event = load_object(event) if ":" in event else EVENTS[event]

    def __call__(self, records: Sequence[TensorDictBase]) -> Float[Tensor, "*b S"]:
        """Of the steps of a period, each [..., S]."""
        scenes, steps = self.env.scenes, TensorDict.stack(list(records), -1)
        row = steps.get(keys.SCENE).squeeze(-1)
        there = steps.get(keys.VALID) & steps.get(("next", *keys.VALID))
        # Far apart from one another, so that what is not there meets nobody.
        away = 1e6 * torch.arange(1, there.shape[-1] + 1, device=there.device)[:, None]
        before, after = (
            torch.where(there[..., None], state, away)
            for state in (steps.get(keys.STATE), steps.get(("next", *keys.STATE)))
        )
        index = scenes.interactive[row]
        size = scenes.box_size[row[..., None], index]
        happens = self.event(before, after, size, self.env.dt) & there & ~scenes.background[row]
        happens = happens & (steps.get(keys.STEP) < scenes.last_step[row][..., None])
        if not self.ego:
            happens = happens[..., 1:]
        return self.strength * happens.any(-1).any(-1).float()
