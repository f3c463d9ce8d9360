"""Single saved rollouts as MCAP, for Foxglove (extra ``mcap``)."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from symphony.data.segment import SignalState
from symphony.errors import ConfigError
from symphony.saved.openscenario import HEIGHT
from symphony.saved.rollouts import SavedRollouts, world_of

RED, YELLOW, GREEN, GREY = (0.9, 0.1, 0.1), (1, 0.7, 0), (0, 0.7, 0.3), (0.6, 0.6, 0.65)
EGO, DRIVEN = (0, 0.45, 0.7), (0.84, 0.37, 0)
_LIGHTS = {"STOP": RED, "CAUTION": YELLOW, "GO": GREEN, "UNKNOWN": GREY}
_ROAD = {"lanes": ((0.4, 0.4, 0.4), 0.1), "boundary": (GREY, 0.3), "marks": ((0.8, 0.8, 0.7), 0.1)}
_FRAME = np.array([(1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0), (1, 1, 0)]) / 2
MAST = np.array([0, 0, 4])  # from a stop point to the light that is shown


def mcap(saved: SavedRollouts, rollout: int) -> bytes:
    """Return a rollout as an MCAP file: the map, and at each state the boxes, the lights and where the ego is.

    ``/map`` and ``/traffic`` are ``foxglove.SceneUpdate``, ``/tf`` is ``foxglove.FrameTransforms``. Entities are in
    the frame ``segment``, whose place in ``source`` is the segment's origin; another is ``ego``. Time begins at 0. At
    the step at which it collides an agent has a red frame.

    Raises:
        ConfigError: the extra is not installed.
    """
    try:
        from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms  # noqa: PLC0415 - an extra
        from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate  # noqa: PLC0415
        from google.protobuf.descriptor_pb2 import FileDescriptorSet  # noqa: PLC0415
        from mcap.writer import Writer  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError("MCAP needs its libraries: pip install 'symphony-traffic[mcap]'") from error
    segment, world, file = saved.segment, world_of(saved, rollout), io.BytesIO()
    writer, channels = Writer(file), {}
    writer.start(library="symphony")
    for topic, kind in (("/map", SceneUpdate), ("/traffic", SceneUpdate), ("/tf", FrameTransforms)):
        _describe(kind.DESCRIPTOR.file, needed := FileDescriptorSet())
        schema = writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", needed.SerializeToString())
        channels[topic] = kind, writer.register_channel(topic, "protobuf", schema)

    def write(topic: str, step: int, **content: Any) -> None:
        kind, channel = channels[topic]
        at = round(step * segment.dt * 1e9)
        writer.add_message(channel, at, kind(**content).SerializeToString(deterministic=True), at, step)

    shapes = [(getattr(segment.road, name), *style) for name, style in _ROAD.items()]
    deep = np.array([1, 1, world.height is not None])  # boxes on a map without levels are at 0
    road = [_line(lines[k] * deep, color, width) for lines, color, width in shapes for k in range(len(lines))]
    write("/map", 0, entities=[{"frame_id": "segment", "id": "map", "lines": road}])
    hit = np.zeros_like(world.valid)
    hit[saved.agents, 1:] = (saved.collision[rollout] & saved.counted[rollout]).T
    color = np.full((segment.num_agents, 3), GREY)
    color[saved.agents], color[segment.ego] = DRIVEN, EGO
    size = np.where(segment.size > 0, segment.size, HEIGHT).astype(np.float64)
    ground = np.zeros(hit.shape) if world.height is None else np.nan_to_num(world.height[..., 0])
    place = np.concatenate([world.position, ground[..., None]], -1)
    for step in range(saved.steps + 1):
        seconds, nanos = divmod(round(step * segment.dt * 1e9), 10**9)
        stamp = {"seconds": seconds, "nanos": nanos}
        about, entities = {"frame_id": "segment", "timestamp": stamp}, []
        for row in np.flatnonzero(world.valid[:, step]).tolist():
            cube = _solid(place[row, step] + [0, 0, size[row, 2] / 2], size[row], color[row])
            cube["pose"]["orientation"] = _turned(world.heading[row, step])
            lines = [_line(_FRAME * size[row], RED, 0.3) | {"pose": cube["pose"]}] if hit[row, step] else []
            entities.append(about | {"id": str(segment.agent_id[row]), "cubes": [cube], "lines": lines})
        names = [SignalState(k).name.split("_")[-1] for k in segment.signal_state[:, saved.start + step].tolist()]
        shown = zip(segment.signal_point, names, strict=True)
        spheres = [_solid(point * deep + MAST, np.ones(3), _LIGHTS[name]) for point, name in shown]
        entities.append(about | {"id": "lights", "spheres": spheres})
        write("/traffic", step, deletions=[{"timestamp": stamp, "type": "ALL"}], entities=entities)
        frames = [_transform("source", "segment", segment.origin, 0.0)]
        if world.valid[segment.ego, step]:
            frames.append(_transform("segment", "ego", place[segment.ego, step], world.heading[segment.ego, step]))
        write("/tf", step, transforms=[frame | {"timestamp": stamp} for frame in frames])
    writer.finish()
    return file.getvalue()


def _describe(file: Any, into: Any) -> None:
    """Add the description of a file of messages after those of the files that it needs."""
    if file.name not in [known.name for known in into.file]:
        for other in file.dependencies:
            _describe(other, into)
        file.CopyToProto(into.file.add())


def _named(names: str, values: Any) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


def _turned(heading: float) -> dict[str, float]:
    return _named("zw", (np.sin(heading / 2), np.cos(heading / 2)))


def _solid(place: Any, size: Any, color: Any) -> dict[str, Any]:
    found = {"size": _named("xyz", size), "color": _named("rgba", (*color, 1))}
    return {"pose": {"position": _named("xyz", place)}, **found}


def _line(points: Any, color: Any, thickness: float) -> dict[str, Any]:
    shown = {"points": [_named("xyz", point) for point in points], "color": _named("rgba", (*color, 1))}
    return shown | {"thickness": thickness}


def _transform(parent: str, child: str, place: Any, heading: float) -> dict[str, Any]:
    found = {"parent_frame_id": parent, "child_frame_id": child, "rotation": _turned(heading)}
    return found | {"translation": _named("xyz", place)}
