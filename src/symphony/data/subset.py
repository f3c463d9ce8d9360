"""A run segment without some of its agents or lanes, everything that refers to them renumbered."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import Bools, Polylines, RunSegment

OF_AGENTS = ("agent_id", "agent_type", "size", "position", "heading", "velocity", "valid")
"""Fields with a row for each agent."""


def with_agents(segment: RunSegment, kept: Bools) -> RunSegment:
    """The agents that a mask [A] keeps, the ego among them."""
    return segment.replace(
        ego=int(kept[: segment.ego].sum()),
        **{name: getattr(segment, name)[kept] for name in OF_AGENTS},
        interest=_renumbered(segment.interest[kept[segment.interest]], kept),
        predict=_renumbered(segment.predict[kept[segment.predict]], kept),
    )


def with_lanes(segment: RunSegment, kept: Bools) -> RunSegment:
    """The lanes that a mask [L] keeps, with the links between them and their lights."""
    road, lights = segment.road, kept[segment.signal_lane]

    def links(pairs: NDArray[Any]) -> NDArray[np.int32]:
        return _renumbered(pairs[kept[pairs].all(axis=1)], kept)

    return segment.replace(
        road=dataclasses.replace(
            road,
            lanes=lines_of(road.lanes, kept),
            lane_id=road.lane_id[kept],
            lane_type=road.lane_type[kept],
            speed_limit=road.speed_limit[kept],
            lane_width=road.lane_width[kept],
            successors=links(road.successors),
            left_neighbors=links(road.left_neighbors),
            right_neighbors=links(road.right_neighbors),
        ),
        signal_lane=_renumbered(segment.signal_lane[lights], kept),
        signal_point=segment.signal_point[lights],
        signal_state=segment.signal_state[lights],
    )


def lines_of(lines: Polylines, kept: Bools) -> Polylines:
    """The lines that a mask [K] keeps."""
    return Polylines.of([lines[k] for k in np.flatnonzero(kept).tolist()])


def _renumbered(index: NDArray[Any], kept: Bools) -> NDArray[np.int32]:
    """Indices into what is kept, all of which are."""
    return (np.cumsum(kept) - 1).astype(np.int32)[index]
