"""Running a red light: crossing the stop point of a red signal on the lane it is for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.wosac.scorer.road import first_of_least

RED = (1, 4)  # states of a red signal: arrow stop and stop; flashing ones are not red


@dataclass(frozen=True)
class Lanes:
    """S segments of lanes, in the plane.

    On every lane with fewer points than the longest one, one more segment leads from the last point to the world's
    origin: the official scorer takes the first of the padding for one.
    """

    start: Float[Tensor, "S 2"]  # first point, metres
    along: Float[Tensor, "S 2"]  # from the first point to the last
    squared: Float[Tensor, " S"]  # squared length
    lane: Int[Tensor, " S"]  # id of the lane

    @classmethod
    def of(cls, lines: Sequence[Any], lane_id: Any) -> Lanes:
        """Cut lanes [P, 2 or 3] into segments, float32; lanes of one point have none."""
        pairs = [
            (np.asarray(line, np.float32)[:, :2], name)
            for line, name in zip(lines, lane_id, strict=True)
            if len(line) >= 2
        ]
        longest = max((len(line) for line, _ in pairs), default=0)
        origin = np.zeros((1, 2), np.float32)
        whole = [line if len(line) == longest else np.concatenate([line, origin]) for line, _ in pairs]
        start = torch.from_numpy(np.concatenate([origin[:0], *(line[:-1] for line in whole)]))
        along = torch.from_numpy(np.concatenate([origin[:0], *(np.diff(line, axis=0) for line in whole)]))
        lane = torch.tensor([int(name) for line, (_, name) in zip(whole, pairs, strict=True) for _ in line[1:]])
        return cls(start, along, along[:, 0] * along[:, 0] + along[:, 1] * along[:, 1], lane)

    def __getitem__(self, rows: Tensor) -> Lanes:
        return Lanes(self.start[rows], self.along[rows], self.squared[rows], self.lane[rows])

    @cached_property
    def _starts(self) -> shapely.STRtree:
        return shapely.STRtree(shapely.points(self.start.double().numpy()))

    def share(self, points: Float[Tensor, "*#shape 2"]) -> Float[Tensor, "*#shape"]:
        """Return where along the line through each segment a point is: 0 at its first point, 1 at its last."""
        away = points - self.start
        dot = away[..., 0] * self.along[..., 0] + away[..., 1] * self.along[..., 1]
        return torch.where(self.squared == 0, 0.0, dot / torch.where(self.squared == 0, 1.0, self.squared))

    def compared(self, points: Float[Tensor, "M 2"]) -> Float[Tensor, " M"]:
        """Return the official distance [M] of points to segments: ``|away + t along|``, where ``-`` would be true."""
        x, y = (points - self.start + self.share(points).clamp(0, 1)[:, None] * self.along).unbind(-1)
        return (x * x + y * y).sqrt()

    def nearest(self, points: Float[Tensor, "M 2"]) -> Int[Tensor, " M"]:
        """Return the index of the segment that the official scorer takes for the nearest; there must be one."""
        # What is compared is never less than the distance to the first point of a segment.
        places = shapely.points(points.double().numpy())
        bound = self[torch.from_numpy(self._starts.nearest(places))].compared(points).double()
        bound += 1e-3 + 1e-6 * points.abs().amax(-1)
        row, segment = torch.from_numpy(self._starts.query(places, "dwithin", bound.numpy()))
        return first_of_least(row, segment, self[segment].compared(points[row]), len(points))


@dataclass(frozen=True)
class Signals:
    """Q signals over T steps."""

    lane: Int[Tensor, " Q"]  # id of the lane
    red: Bool[Tensor, "Q T"]
    #: [Q, T, 2] where to stop, the world's origin at steps without an observation
    point: Float[Tensor, "Q T 2"]

    @classmethod
    def of(cls, step: Any, lane: Any, state: Any, point: Any, steps: int) -> Signals:
        """Bring M observations into a table; of several for one lane and step, the last one counts."""
        lanes, row = np.unique(lane, return_inverse=True)
        # Of several numbers for one place NumPy keeps the last.
        states = np.zeros((len(lanes), steps), np.int64)
        states[row, step] = state
        points = np.zeros((len(lanes), steps, 2), np.float32)
        points[row, step] = point
        return cls(*(torch.from_numpy(found) for found in (lanes, np.isin(states, RED), points)))


def red_light_violations(
    position: Float[Tensor, "*batch T 2"], valid: Bool[Tensor, "*batch T"], lanes: Lanes, signals: Signals
) -> Bool[Tensor, "*batch T"]:
    """Return at which steps a box's centre passes the stop point of a red signal while its lane is the signal's.

    The lane of a box is that of its nearest segment (see :meth:`Lanes.nearest`) at the step. Passing is to be before
    the stop point, along the signal lane's segment nearest to it, a step before, and beyond it now.
    """
    result = torch.zeros_like(valid)
    seen = torch.isin(signals.lane, lanes.lane) & signals.red.any(-1)
    for lane, red, point in zip(signals.lane[seen], signals.red[seen], signals.point[seen], strict=True):
        own = lanes[lanes.lane == lane]
        line = own[own.nearest(point)]
        ahead = line.share(position) - line.share(point)
        passes = torch.zeros_like(valid)
        passes[..., 1:] = (ahead[..., :-1] < 0) & (ahead[..., 1:] > 0)
        passes &= valid & red
        if passes.any():
            result[passes] |= lanes.lane[lanes.nearest(position[passes])] == lane
    return result
