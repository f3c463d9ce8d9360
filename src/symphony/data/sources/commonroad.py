"""Reader of CommonRoad scenarios: XML files of version 2018b or 2020a.

An own reader, because every release of ``commonroad-io`` since 2023 pins protobuf 3.20, which nothing else here
can live with, and the last that installs (2022.1) brings scipy and does not refuse XML entities.

How the format maps onto :class:`~symphony.data.segment.RunSegment`:

- ``segment_id`` and ``group`` are the benchmark id. Steps run from the first to the last at which any dynamic
  obstacle exists.
- Coordinates are taken relative to the first position, rounded to metres, of the ego that ``egos="one"`` picks; z is
  0 throughout.
- A state variable given as an interval, or a position given as a region, becomes its middle. The velocity is the
  logged speed along the logged orientation, or a finite difference of positions where no speed is logged. A box
  bounds the obstacle's shape (the rectangle itself, usually). Static obstacles are at rest at every step.
- Types: bicycles are cyclists; cars, trucks, buses, taxis, trains and motorcycles are vehicles; whatever is
  neither that nor a pedestrian is OTHER; scenery (buildings, pillars, road boundaries, median strips) is left out.
- A lane is halfway between a lanelet's bounds; neighbours are adjacent lanelets of the same direction. The
  boundary encloses the union of the lanelets, and is open where the network is cut, at lanelets without successor or
  predecessor. Sidewalks are left out, crosswalks are marks.
- Nobody in these files is the ego, so the reader picks one (:class:`CommonRoadReader`).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from symphony.data.segment import RunSegment
from symphony.data.sources.base import Item, Reader, to_float32
from symphony.data.sources.commonroad_map import Network, read_network, read_signals, road_map
from symphony.data.sources.commonroad_tracks import Tracks, read_tracks
from symphony.data.sources.commonroad_xml import load_xml, number
from symphony.data.sources.egos import busiest_first
from symphony.errors import ConfigError, DataError

VERSIONS = ("2018b", "2020a")


class CommonRoadReader(Reader):
    """Reads CommonRoad XML files.

    Args:
        egos: ``"one"`` picks, among the dynamic vehicles that move and are observed at every step, the one with
            the most moving neighbours (within 50 m, summed over the steps; the lowest id on ties). ``"all"``
            yields a segment for each of those vehicles, in order of id, with ``_ego<ID>`` added to its name; all
            in one frame, on one map.

    Raises:
        ConfigError: ``egos`` is neither.
    """

    name = "commonroad"
    patterns = ("*.xml",)

    def __init__(self, egos: Literal["one", "all"] = "one") -> None:
        if egos not in {"one", "all"}:
            raise ConfigError(f"egos must be 'one' or 'all', is {egos!r}")
        self.egos = egos

    def _read(self, path: Path) -> Iterator[Item]:
        root = load_xml(path)
        if root.tag != "commonRoad":
            raise DataError(f"not a CommonRoad file: its root is <{root.tag[:40]}>", field="commonRoad")
        version = root.get("commonRoadVersion")
        if version not in VERSIONS:
            raise DataError(
                f"version {version!r}, expected one of {', '.join(VERSIONS)}", field="commonRoadVersion"
            )
        name = root.get("benchmarkID", "")
        if not name:
            raise DataError("missing", field="benchmarkID")
        try:
            yield from self._segments(root, name, path)
        except DataError as error:
            raise error.at(segment=name) from error

    def _segments(self, root: ET.Element, name: str, path: Path) -> Iterator[Item]:
        dt = number(root.get("timeStepSize"), "timeStepSize")
        if dt <= 0:
            raise DataError(f"must be positive, is {dt:g}", field="timeStepSize")
        tracks = read_tracks(root, dt)
        network = read_network(root)
        candidates = busiest_first(
            tracks.agent_id, tracks.agent_type, tracks.position, tracks.valid, tracks.dynamic
        )
        if not len(candidates):
            raise DataError("no moving vehicle is observed at every step", field="dynamicObstacle")
        first = _segment(root, network, tracks, int(candidates[0]), name, dt, path.name)
        if self.egos == "one":
            yield first
            return
        # All in the frame of the first, so that a store keeps one map for them.
        for ego in sorted(candidates.tolist(), key=lambda row: int(tracks.agent_id[row])):
            yield first.replace(ego=ego, segment_id=f"{name}_ego{tracks.agent_id[ego]}")


def _segment(
    root: ET.Element, network: Network, tracks: Tracks, ego: int, name: str, dt: float, file: str
) -> RunSegment:
    steps = tracks.valid.shape[1]
    origin = np.round(tracks.position[ego, np.argmax(tracks.valid[ego])])
    position = np.where(tracks.valid[..., None], tracks.position - origin, 0.0)
    signal_lane, signal_point, signal_state = read_signals(root, network, tracks.first_step, steps, origin)
    return RunSegment(
        segment_id=name,
        source=CommonRoadReader.name,
        dt=dt,
        ego=ego,
        agent_id=tracks.agent_id,
        agent_type=tracks.agent_type,
        size=to_float32(tracks.size),
        position=to_float32(np.pad(position, ((0, 0), (0, 0), (0, 1)))),
        heading=to_float32(tracks.heading),
        velocity=to_float32(tracks.velocity),
        valid=tracks.valid,
        road=road_map(network, origin),
        signal_lane=signal_lane,
        signal_point=signal_point,
        signal_state=signal_state,
        origin=np.array([*origin, 0.0]),
        file=file,
        group=name,
    )
