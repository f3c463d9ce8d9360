"""Changes that a user makes to agents: goals of single ones, their personas, and how bold their draws are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from symphony import keys
from symphony.config.evaluation import PERSONA_PARTS, persona_quantiles
from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.modules import inverse_cdf

REACH = 3.0
"""Metres from a route, on average, within which it goes to the end of a lane or past a point."""


class Tempered(TensorDictModuleBase):
    """Draws actions anew from a policy's logits divided by a temperature, by the same numbers.

    Args:
        temperature: 1 for the policy's own draw.
    """

    in_keys = [keys.LOGITS, keys.NOISE]  # noqa: RUF012 - the type TensorDictModuleBase declares
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self, temperature: float) -> None:
        super().__init__()
        self.temperature = temperature

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write actions [..., N]."""
        logits = tensordict.get(keys.LOGITS) / self.temperature
        return tensordict.set(keys.ACTION, inverse_cdf(logits, tensordict.get(keys.NOISE)))


def given_personas(personas: Float[Tensor, "M 2"] | None, asked: str) -> Float[Tensor, "M 2"] | None:
    """Personas to draw from, with the quantiles of headway and speed that are asked for in place of their own.

    Raises:
        ConfigError: for an agent without personas.
    """
    if not asked:
        return personas
    if personas is None:
        raise ConfigError(
            "this agent was trained without personas (agent.persona), so --persona means nothing to it"
        )
    found = personas.clone()
    for name, quantile in persona_quantiles(asked).items():
        found[:, PERSONA_PARTS.index(name)] = 2 * quantile - 1
    return found


def given_goals(
    goals: Sequence[str], segments: Sequence[RunSegment], scenes: SceneBatch, *, planned: bool = False
) -> Int[Tensor, "B N"]:
    """Numbers of the routes that agents are to follow, -1 where that is left open.

    Args:
        goals: such as ``7=lane:103``, for agent 7 a route over the lane of id 103, or ``7=12.5,-40``, one that comes
            past a point in the frame of the segment; the nearest of the agent's feasible routes.
        segments: behind the scenes, in their order; each goal must suit all of them.
        scenes: with routes.
        planned: whether a planner drives the ego, which then takes no goal.

    Raises:
        ConfigError: a goal that can't be read, names an agent that is not driven or has one already, or a lane that
            is not there, or that no feasible route of the agent comes near.
    """
    found = torch.full(scenes.interactive.shape, -1, dtype=torch.int64)
    for goal in goals:
        agent, _, where = goal.partition("=")
        if not agent.removeprefix("-").isdecimal() or not where:
            raise ConfigError(f"a goal is AGENT=lane:ID or AGENT=X,Y, not '{goal}'")
        for b, segment in enumerate(segments):
            row = np.flatnonzero(segment.agent_id == int(agent))
            driven = scenes.interactive_valid[b] & ~scenes.background[b]
            place = [n for n in driven.nonzero()[:, 0].tolist() if int(scenes.interactive[b, n]) in row]
            if not place:
                raise ConfigError(f"goal '{goal}': segment {segment.segment_id} has no driven agent {agent}")
            if planned and int(row[0]) == segment.ego:
                raise ConfigError(f"goal '{goal}': agent {agent} is the ego, which a planner drives")
            if int(found[b, place[0]]) >= 0:
                raise ConfigError(f"goal '{goal}': agent {agent} has been given another one")
            target = _place(goal, where, segment)
            away = _distances(scenes, b, place[0], target)
            if not len(away) or away.min() > REACH:
                near = f", the nearest stays {away.min():.1f} m away" if len(away) else ""
                raise ConfigError(
                    f"goal '{goal}': no feasible route of agent {agent} in segment {segment.segment_id} "
                    f"leads there{near}"
                )
            found[b, place[0]] = int(away.argmin())
    return found


def _place(goal: str, where: str, segment: RunSegment) -> NDArray[np.float64]:
    """Points [P, 2] that a route must come near."""
    if where.startswith("lane:"):
        name = where.removeprefix("lane:")
        known = {str(number): k for k, number in enumerate(segment.road.lane_id.tolist())}
        if name not in known:
            raise ConfigError(f"goal '{goal}': segment {segment.segment_id} has no lane {name}")
        # The agent may be on it already, but not past its end.
        lane = segment.road.lanes[known[name]][:, :2].astype(np.float64)
        return lane[len(lane) // 2 :]
    try:
        point = np.array([float(number) for number in where.split(",")])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ConfigError(f"a goal is AGENT=lane:ID or AGENT=X,Y, not '{goal}'")
    return point[None]


def _distances(scenes: SceneBatch, b: int, n: int, target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metres [G] from points to each route, on average."""
    found = []
    for route, count in enumerate(scenes.route_count[b, n].tolist()):
        if count < 2:
            found.append(np.inf)
            continue
        line = shapely.LineString(scenes.whole_route(b, n, route).cpu().numpy())
        found.append(float(shapely.distance(line, shapely.points(target)).mean()))
    return np.array(found)
