"""The effect of a search on the goals that were drawn.

Shapes: B segments, K rollouts, D draws (one per branch that was started), N interactive agents, G routes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from symphony.geometry import wrap

TURNS = ("right", "straight", "left")
TURNED = math.radians(45)  # a route turns where its direction has changed by this much since its beginning


def route_turns(points: Float[Tensor, "*b K 2"], count: Int[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """Return which way routes first turn, as the place in :data:`TURNS`; straight on where they never do. Takes the
    points of each route, in metres, and how many of them exist.
    """
    step = points.diff(dim=-2)
    direction = torch.atan2(step[..., 1], step[..., 0])
    change = functional.pad(wrap(direction.diff(dim=-1)).cumsum(-1), (0, 1))  # two points turn nowhere
    exists = torch.arange(change.shape[-1], device=points.device) < (count[..., None] - 2)
    turns = (change.abs() > TURNED) & exists
    first = turns.int().argmax(-1, keepdim=True)
    way = change.gather(-1, first).squeeze(-1).sign().long()
    return torch.where(turns.any(-1), way, torch.zeros_like(way)) + 1


@dataclass(frozen=True)
class Choice:
    """The effect of a search on the goals of one segment."""

    #: [3] agents of all branches by the turn of the route they drew, see :data:`TURNS`
    drawn: NDArray[np.int64]
    kept: NDArray[np.int64]  # [3] agents of the rollouts by the turn of the route they follow
    #: total variation between drawn and kept routes (0 to 1), mean over agents; NaN without a route
    variation: float
    founders: float  # first branches that some rollout descends from, mean over trees


def choices(
    drawn: Int[Tensor, "B D N"], kept: Int[Tensor, "B K N"], turn: Int[Tensor, "B N G"], founders: Float[Tensor, " B"]
) -> list[Choice]:
    """Return the effect of a search on the goals of each segment.

    Takes the numbers of the routes that the agents of all branches drew and that those of the rollouts follow, -1 for
    none; which way each route turns (:func:`route_turns`); and the first branches of each tree with descendants.
    """
    found = []
    for b in range(len(drawn)):
        turns, away = np.zeros((2, len(TURNS)), np.int64), []
        for n in range(drawn.shape[-1]):
            both = [goals[goals >= 0] for goals in (drawn[b, :, n], kept[b, :, n])]
            if not all(map(len, both)):
                continue
            shares = [np.bincount(goals, minlength=turn.shape[-1]) / len(goals) for goals in both]
            away.append(0.5 * float(np.abs(shares[0] - shares[1]).sum()))
            for k, goals in enumerate(both):
                turns[k] += np.bincount(turn[b, n][goals], minlength=len(TURNS))
        found.append(Choice(turns[0], turns[1], float(np.mean(away)) if away else math.nan, float(founders[b])))
    return found


def choice_numbers(found: list[Choice]) -> dict[str, float]:
    """Return the effect of searches on the goals of all segments together.

    Returns:
        ``goals_drawn_left`` (and ``straight``, ``right``), percent of the agents of all branches; ``goals_kept_left``
        and so on, of the rollouts; ``goals_turn_variation``, total variation between these two (0 to 1), and
        ``goals_variation``, that between the routes themselves, mean over segments; ``goals_founders``, first
        branches per tree that some rollout descends from.
    """
    shares = {}
    for name, counts in (("drawn", [one.drawn for one in found]), ("kept", [one.kept for one in found])):
        total = np.sum(counts, axis=0)
        shares[name] = total / total.sum() if total.sum() else np.full(len(TURNS), math.nan)
    variations = [one.variation for one in found if not math.isnan(one.variation)]
    return {
        **{
            f"goals_{name}_{turn}": 100.0 * float(share)
            for name, each in shares.items()
            for turn, share in zip(TURNS, each, strict=True)
        },
        "goals_turn_variation": 0.5 * float(np.abs(shares["drawn"] - shares["kept"]).sum()),
        "goals_variation": float(np.mean(variations)) if variations else math.nan,
        "goals_founders": float(np.mean([one.founders for one in found])),
    }
