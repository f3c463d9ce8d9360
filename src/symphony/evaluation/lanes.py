"""The lanes of a run segment, and which of them are on the level of a place (see :mod:`symphony.data.levels`)."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import from_numpy

from symphony.data.levels import levels_of
from symphony.data.segment import LaneType, RunSegment
from symphony.evaluation.contacts import Bools, Indices, Reals
from symphony.geometry import levels_apart
from symphony.roadgraph import LaneGraph, lane_of
from symphony.roadgraph.lines import Near

NOMINAL_WIDTH = 3.6
"""Metres, of lanes whose width is not known."""
BIKE_WIDTH = 1.6
Heights = NDArray[np.float32] | None
"""Height and level [..., 2] of places; None where the map has no levels, so that all are on one."""


class Lanes:
    """The lanes of a run segment.

    Attributes:
        segment: the map and its lights.
        graph: how lanes connect.
        width: [L] metres, nominal ones where the source has none.
    """

    def __init__(self, segment: RunSegment) -> None:
        road = segment.road
        self.segment, self.graph, self._levels = segment, LaneGraph(road), levels_of(segment)
        nominal = np.where(road.lane_type == LaneType.BIKE_LANE, BIKE_WIDTH, NOMINAL_WIDTH)
        self.width = np.where(np.isnan(road.lane_width), nominal, road.lane_width).astype(np.float64)

    def near(self, position: Reals, reach: float, height: Heights) -> Near:
        """Pairs of a position [n, 2] and a lane on its level at most ``reach`` metres away."""
        found = self.graph.index.near(position, reach)
        return found if height is None else found.only(self._kept(found, height))

    def lane_of(self, position: Reals, heading: Reals, height: Heights) -> Indices:
        """The lane on its level that each agent [n] is in, -1 for none; see :func:`symphony.roadgraph.lane_of`."""
        keep = None if height is None else lambda near: self._kept(near, height)
        return lane_of(self.graph, position, heading, keep=keep)

    @cached_property
    def light_height(self) -> NDArray[np.float32]:
        """[Q, 2] height and level of the lights, taken from their lanes."""
        place = np.zeros((len(self.segment.signal_lane), 3))
        for light, lane in enumerate(self.segment.signal_lane.tolist()):
            line = self.segment.road.lanes[lane]
            away = np.linalg.norm(line[:, :2] - self.segment.signal_point[light, :2], axis=-1)
            place[light] = line[away.argmin()]
        return self._levels.at(place)

    def _kept(self, near: Near, height: NDArray[np.float32]) -> Bools:
        place = np.zeros((len(near.line), 3))
        for number in np.unique(near.line):
            mine = near.line == number
            line = self.segment.road.lanes[int(self.graph.usable_lanes[number])].astype(np.float64)
            arc = np.append(0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T)))
            place[mine] = np.stack([np.interp(near.along[mine], arc, part) for part in line.T], -1)
        there = from_numpy(self._levels.at(place))
        return ~levels_apart(there, from_numpy(height[near.point])).numpy()
