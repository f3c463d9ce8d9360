"""The criticality of driving for the ego: the hardest run segments of a store, or rollouts of a folder.

Sources: least time to collision (Hayward 1972), post-encroachment time (Allen, Shin and Cooper 1978).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import torch
from numpy.typing import NDArray

from symphony.data.levels import agent_heights, levels_of
from symphony.data.segment import RunSegment, wrap
from symphony.data.store import SegmentStore
from symphony.evaluation.contacts import time_to_collision
from symphony.geometry import box_corners, levels_apart
from symphony.saved.folder import RolloutFolder
from symphony.saved.rollouts import SavedRollouts, World, world_of

LONGEST = 3.0
"""Seconds, of time to collision and of encroachment, above which nothing is critical."""
GENTLE, HARD = 2.0, 6.0
"""m/s² of braking at which it begins to be critical, and at which it is as critical as a collision."""
CROSSING = 0.35
"""Radians between two headings from which on one path crosses another."""
NEAR_EDGE = 0.5
"""Metres to the road's boundary below which it is critical."""


@dataclass(frozen=True)
class Criticality:
    """The criticality of a drive of the ego.

    Attributes:
        segment: id.
        time_to_collision: least, seconds; infinite if there is none within 5 s.
        encroachment: least seconds between the ego's leaving a place and another's arriving there, or the other way
            around; infinite if they share none within :data:`LONGEST`.
        braking: most, m/s²; 0 without any.
        margin: least metres from the ego's box to the road's boundary; infinite without one.
        rollout: number; None for the log.
    """

    segment: str
    time_to_collision: float
    encroachment: float
    braking: float
    margin: float
    rollout: int | None = None

    @property
    def score(self) -> float:
        """A score from 0 (nothing is critical) to 4: each of the four quantities adds up to 1."""
        parts = (
            1 - self.time_to_collision / LONGEST,
            1 - self.encroachment / LONGEST,
            (self.braking - GENTLE) / (HARD - GENTLE),
            1 - self.margin / NEAR_EDGE,
        )
        return sum(max(0.0, min(1.0, part)) for part in parts)


def criticality(found: RunSegment | SavedRollouts, rollout: int | None = None) -> Criticality:
    """Return how critical a log or a rollout is for its ego; what is on another level does not count. Boxes that
    overlap in a log are measurement errors; in a rollout the ego collides, and the time to collision is 0.
    """
    if isinstance(found, SavedRollouts):
        segment, world = found.segment, world_of(found, rollout or 0)
        hits = bool((found.collision & found.counted)[rollout or 0, :, found.agents == segment.ego].any())
    else:
        segment, heights, hits = found, agent_heights(found), False
        moves = (segment.position[..., :2], segment.heading, segment.velocity)
        height = heights.swapaxes(0, 1) if len(heights) else None
        size = segment.size[:, :2].astype(np.float64)
        position, heading, velocity = (part.astype(np.float64) for part in moves)
        world = World(position, heading, velocity, segment.valid, size, height)
    seen = np.flatnonzero(world.valid[segment.ego])
    slower = np.diff(world.speed[segment.ego, seen]) / (np.diff(seen) * segment.dt)
    ttc = time_to_collision(world, np.array([segment.ego]))
    return Criticality(
        segment.segment_id,
        0.0 if hits else float(ttc[ttc > 0].min(initial=math.inf)),
        _encroachment(world, segment, seen),
        float(-slower.min(initial=0.0)) + 0.0,
        _margin(world, segment, seen),
        rollout,
    )


def _margin(world: World, segment: RunSegment, seen: NDArray[np.int64]) -> float:
    """Return the least metres between the ego's box and the boundary of its level."""
    lines, boxes = segment.road.boundary, _boxes(world, segment.ego, seen)
    ends = [np.stack([lines[k][:-1], lines[k][1:]], 1) for k in range(len(lines))]
    pieces = np.concatenate([*ends, np.zeros((0, 2, 3))])
    edges = shapely.linestrings(pieces[..., :2])
    if world.height is None or (levels := levels_of(segment)).flat:
        return float(shapely.STRtree(edges).query_nearest(boxes, return_distance=True)[1].min(initial=math.inf))
    there = torch.from_numpy(levels.at(pieces.mean(1)))
    apart = levels_apart(torch.from_numpy(world.height[segment.ego, seen])[:, None], there)
    return float(shapely.distance(boxes[:, None], edges)[~apart.numpy()].min(initial=math.inf))


def _encroachment(world: World, segment: RunSegment, seen: NDArray[np.int64]) -> float:
    """Return the least seconds between the ego's box and that of an agent crossing its path at the same place."""
    who, step = world.valid.nonzero()
    who, step = who[who != segment.ego], step[who != segment.ego]
    tree = shapely.STRtree(_boxes(world, who, step, swept=1))
    mine, theirs = tree.query(_boxes(world, segment.ego, seen, swept=1), predicate="intersects")
    mine, who, step = seen[mine], who[theirs], step[theirs]
    apart = np.abs(mine - step) * segment.dt
    # A follower in a lane reaches each place soon after: that is a headway.
    turn = world.heading[segment.ego, mine] - world.heading[who, step]
    crosses = np.abs(wrap(turn)) > CROSSING
    if world.height is not None:
        places = ((segment.ego, mine), (who, step))
        one, two = (torch.from_numpy(world.height[place]) for place in places)
        crosses &= ~levels_apart(one, two).numpy()
    least = float(apart[crosses & (apart > 0)].min(initial=math.inf))
    return least if least <= LONGEST else math.inf


def _boxes(world: World, row: Any, step: NDArray[np.int64], swept: int = 0) -> NDArray[np.object_]:
    """Return the boxes of agents at steps, or what they sweep up to the next state, as polygons."""
    later = np.minimum(step + swept, world.valid.shape[1] - 1)
    row, corners = np.broadcast_to(row, step.shape), []
    for at in (step, np.where(world.valid[row, later], later, step)):
        parts = world.position[row, at], world.heading[row, at], world.size[row]
        corners.append(box_corners(*map(torch.from_numpy, parts)).numpy())
    return np.asarray(shapely.convex_hull(shapely.multipoints(np.concatenate(corners, 1))))


def hardest(
    source: SegmentStore | RolloutFolder,
    count: int,
    items: Sequence[int] | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> list[tuple[int, Criticality]]:
    """Return the ``count`` most critical run segments of a store (or of its rows ``items``), or rollouts of a folder,
    the hardest first; equal ones in their order. ``progress`` is called with the number looked at and the total.
    """
    rows, found = range(len(source)) if items is None else items, list[tuple[int, Criticality]]()
    for number, row in enumerate(rows):
        one = source[row]
        runs = range(one.rollouts) if isinstance(one, SavedRollouts) else [None]
        found += [(row, criticality(one, k)) for k in runs]
        progress(number + 1, len(rows))
    return sorted(found, key=lambda one: -one[1].score)[:count]
