"""Running a red light: crossing the stop point of a red signal on the lane it is for."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.wosac.scorer.cells import Bounds, Boxes, Measure, nearest
from symphony.wosac.scorer.scenario import SURFACE_STREET, Lines, WosacScenario

RED = (1, 4)
"""States of a red signal: arrow stop and stop; flashing ones are none."""


@dataclass(frozen=True)
class Lanes:
    """S segments of lanes, in the plane.

    On every lane with fewer points than the longest one, one more segment leads from the last point to the world's
    origin: the official scorer takes the first of the padding for one.

    Attributes:
        start: [S, 2] first point, metres.
        along: [S, 2] from the first point to the last.
        squared: [S] squared length.
        lane: [S] id of the lane.
        number: [S] of the segment in its lane.
    """

    start: Float[Tensor, "S 2"]
    along: Float[Tensor, "S 2"]
    squared: Float[Tensor, " S"]
    lane: Int[Tensor, " S"]
    number: Int[Tensor, " S"]

    @classmethod
    def of(cls, lines: Lines, lane_id: Int[Tensor, " K"]) -> Lanes:
        """Cut lanes into segments, float32; lanes of one point have none."""
        kept = lines.counts >= 2
        lines, lane_id = lines.keep(kept), lane_id[kept]
        points, counts = lines.points[:, :2].float(), lines.counts
        line = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
        last = torch.ones_like(line, dtype=torch.bool)
        last[:-1] = line[1:] != line[:-1]
        following = torch.where(last[:, None], torch.zeros_like(points), points.roll(-1, 0))
        # Segment number k of a lane starts at its point k; the last point starts one only where there is padding.
        longest = counts.max() if len(counts) else counts.new_zeros(())
        starts = ~(last & (counts == longest)[line])
        along = (following - points)[starts]
        number = torch.arange(len(line), device=counts.device) - (counts.cumsum(0) - counts)[line]
        return cls(
            points[starts],
            along,
            along[:, 0] * along[:, 0] + along[:, 1] * along[:, 1],
            lane_id[line][starts],
            number[starts],
        )

    def __getitem__(self, rows: Tensor) -> Lanes:
        return Lanes(
            self.start[rows], self.along[rows], self.squared[rows], self.lane[rows], self.number[rows]
        )

    def fraction(self, points: Float[Tensor, "M 2"], segment: Int[Tensor, " M"]) -> Float[Tensor, " M"]:
        """Where along the line through each segment a point is: 0 at the first point, 1 at the last."""
        away, along, squared = points - self.start[segment], self.along[segment], self.squared[segment]
        share = (away[:, 0] * along[:, 0] + away[:, 1] * along[:, 1]) / torch.where(
            squared == 0, 1.0, squared
        )
        return torch.where(squared == 0, 0.0, share)

    def nearest(self, points: Float[Tensor, "M 2"]) -> Int[Tensor, " M"]:
        """Index of the segment that the official scorer takes for the nearest; there must be one.

        What it compares is ``|away + t along|``, where the distance would be ``|away - t along|``.
        """
        # What is compared is never less than the distance to the first point.
        boxes = Boxes(self.start, self.start)
        return nearest(points, boxes, torch.ones(2), self._bounds(), self._measure(points))

    def _measure(self, points: Tensor) -> Measure:
        def measure(point: Tensor, segment: Tensor) -> Tensor:
            chosen = points[point]
            share = self.fraction(chosen, segment).clamp(0, 1)[:, None]
            x, y = (chosen - self.start[segment] + share * self.along[segment]).unbind(-1)
            return (x * x + y * y).sqrt()

        return measure

    def _bounds(self) -> Bounds:
        length = self.squared.sqrt()

        def bounds(cells: Boxes, segment: Tensor) -> tuple[Tensor, Tensor]:
            # What is compared is at most the segment's length more than the distance to the first point.
            x, y = ((cells.low + cells.high) / 2 - self.start[segment]).unbind(-1)
            away = torch.hypot(x, y)
            size_x, size_y = (cells.high - cells.low).unbind(-1)
            radius = torch.hypot(size_x, size_y) / 2 + cells.slack
            low, high = (away - radius).clamp_(min=0), away + radius
            return low, high + torch.minimum(high, length[segment])

        return bounds


@dataclass(frozen=True)
class Signals:
    """Q signals over T steps.

    Attributes:
        lane: [Q] id of the lane.
        red: [Q, T].
        point: [Q, T, 2] where to stop, the world's origin at steps without an observation.
    """

    lane: Int[Tensor, " Q"]
    red: Bool[Tensor, "Q T"]
    point: Float[Tensor, "Q T 2"]

    @classmethod
    def of(
        cls,
        step: Int[Tensor, " M"],
        lane: Int[Tensor, " M"],
        state: Int[Tensor, " M"],
        point: Float[Tensor, "M 2"],
        steps: int,
    ) -> Signals:
        """Bring M observations into a table; of several for one lane and step, the last one counts."""
        lanes, row = lane.unique(return_inverse=True)
        cell = row * steps + step
        last = torch.full((len(lanes) * steps,), -1, device=lane.device)
        last = last.scatter_reduce(0, cell, torch.arange(len(cell), device=lane.device), "amax")
        there = last >= 0
        states, points = state.new_zeros(len(last)), torch.zeros(len(last), 2, device=point.device)
        states[there], points[there] = state[last[there]], point[last[there]].float()
        red = torch.isin(states, torch.tensor(RED, device=lane.device))
        return cls(lanes, red.view(-1, steps), points.view(-1, steps, 2))


def red_light_violations(
    position: Float[Tensor, "*batch T 2"], valid: Bool[Tensor, "*batch T"], lanes: Lanes, signals: Signals
) -> Bool[Tensor, "*batch T"]:
    """At which steps a box's centre passes the stop point of a red signal while its lane is the signal's.

    The lane of a box is that of its nearest segment (see :meth:`Lanes.nearest`) at the step. Passing means to be
    before the stop point, along the signal lane's segment nearest to it, at the step before, and beyond it at the
    step itself.
    """
    result = torch.zeros_like(valid)
    for lane, red, point in zip(*_on_lanes(signals, lanes), strict=True):
        own = lanes[lanes.lane == lane]
        segment = own.nearest(point)
        start, along, squared = own.start[segment], own.along[segment], own.squared[segment]
        ahead = _share(position, start, along, squared) - _share(point, start, along, squared)
        passes = torch.zeros_like(valid)
        passes[..., 1:] = (ahead[..., :-1] < 0) & (ahead[..., 1:] > 0)
        passes &= valid & red
        where = passes.nonzero(as_tuple=True)
        there = position[where]
        if len(there):
            result[where] |= lanes.lane[lanes.nearest(there)] == lane
    return result


def _on_lanes(signals: Signals, lanes: Lanes) -> tuple[Tensor, Tensor, Tensor]:
    """The signals whose lane is there, and that are red at all."""
    kept = torch.isin(signals.lane, lanes.lane) & signals.red.any(-1)
    return signals.lane[kept], signals.red[kept], signals.point[kept]


def _share(points: Tensor, start: Tensor, along: Tensor, squared: Tensor) -> Tensor:
    away = points - start
    dot = away[..., 0] * along[..., 0] + away[..., 1] * along[..., 1]
    return torch.where(squared == 0, 0.0, dot / torch.where(squared == 0, 1.0, squared))


def surface_street_lanes(scenario: WosacScenario) -> Lanes:
    """The lanes that count for traffic lights."""
    street = scenario.lane_type == SURFACE_STREET
    return Lanes.of(scenario.lanes.keep(street), scenario.lane_id[street])
