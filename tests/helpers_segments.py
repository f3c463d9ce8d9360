"""Small run segments for tests: a straight road, a crossing with lights, and arbitrary ones."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from symphony.data import segment as schema
from symphony.data.segment import AgentType, LaneType, MarkType, Polylines, RoadMap, RunSegment, validate

LANE_WIDTH = 3.5
CAR = (4.6, 1.9, 1.6)
CHARACTERS = "aZ09 .,:;-_|\\\"'<>&$*\n\t\0\x1b\u2028\ufeff\xe9\u6f22\U0001f600"  # all there are take a second to list


def make_road(
    lanes: list[Any], successors: Any = (), left: Any = (), right: Any = (), boundary: Any = (), marks: Any = ()
) -> RoadMap:
    """A map of surface streets with lane ids 100, 101, ...; marks are road lines."""

    def pairs(found: Any) -> NDArray[np.int32]:
        return np.asarray(found, np.int32).reshape(-1, 2)

    return RoadMap(
        lanes=Polylines.of(lanes), lane_id=100 + np.arange(len(lanes), dtype=np.int64),
        lane_type=np.full(len(lanes), LaneType.SURFACE_STREET, np.uint8),
        speed_limit=np.full(len(lanes), 14, np.float32),
        lane_width=np.full(len(lanes), LANE_WIDTH, np.float32), successors=pairs(successors),
        left_neighbors=pairs(left), right_neighbors=pairs(right), boundary=Polylines.of([*boundary]),
        marks=Polylines.of([*marks]), mark_type=np.full(len(marks), MarkType.ROAD_LINE, np.uint8),
    )  # fmt: skip


def make_segment(
    road: RoadMap, position: Any, heading: Any, velocity: Any, dt: float = 0.2, segment_id="made", **changes: Any
) -> RunSegment:
    """Cars that are valid throughout, the first being the ego; any other field by name."""
    agents, steps = heading.shape
    xyz = np.zeros((agents, steps, 3), np.float32)
    xyz[..., : position.shape[-1]] = position
    segment = RunSegment(
        segment_id=segment_id, source="made", dt=dt, ego=0, agent_id=np.arange(agents, dtype=np.int64) + 7,
        agent_type=np.full(agents, AgentType.VEHICLE, np.uint8),
        size=np.tile(np.asarray(CAR, np.float32), (agents, 1)), position=xyz,
        heading=np.asarray(heading, np.float32), velocity=np.asarray(velocity, np.float32),
        valid=np.ones((agents, steps), bool), road=road, signal_lane=np.zeros(0, np.int32),
        signal_point=np.zeros((0, 3), np.float32), signal_state=np.zeros((0, steps), np.uint8), origin=np.zeros(3),
    )  # fmt: skip
    return validate(segment.replace(**changes))


def hide(segment: RunSegment, agent: Any, steps: Any) -> RunSegment:
    """The segment with one agent not seen during some steps, or agents each at one step."""
    fields = {name: getattr(segment, name).copy() for name in schema.STATES}
    for array in fields.values():
        array[agent, steps] = 0
    return segment.replace(**fields)


def beginning(segment: RunSegment, steps: int) -> RunSegment:
    """Its first steps."""
    parts = {name: getattr(segment, name)[:, :steps] for name in (*schema.STATES, "signal_state")}
    return segment.replace(**parts)


def turned(segment: RunSegment, angle: float, shift: Any = 0.0) -> RunSegment:
    """The whole world turned counter-clockwise about its origin, and then moved."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s], [-s, c]])

    def moved(points: NDArray[Any], by: Any = shift) -> NDArray[np.float32]:
        return np.concatenate([points[..., :2] @ turn + by, points[..., 2:]], -1).astype(np.float32)

    road, there = segment.road, segment.valid
    lines = {
        name: Polylines(moved(old.points), old.offsets)
        for name, old in (("lanes", road.lanes), ("boundary", road.boundary), ("marks", road.marks))
    }
    return segment.replace(
        position=np.where(there[..., None], moved(segment.position), np.float32(0)),
        velocity=moved(segment.velocity, 0.0),
        heading=np.where(there, segment.heading + np.float32(angle), np.float32(0)),
        signal_point=moved(segment.signal_point),
        road=dataclasses.replace(road, **lines),
    )


def along(path: NDArray[Any], distance: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Position [..., 2] and heading [...] at distances [...] along a polyline [P, 2]."""
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])

    def at(s: NDArray[Any]) -> NDArray[Any]:
        return np.stack([np.interp(s, length, path[:, k]) for k in range(2)], -1)

    step = at(distance + 0.5) - at(distance - 0.5)
    return at(distance), np.unwrap(np.arctan2(step[..., 1], step[..., 0]))


def straight_road(num_agents=3, steps=51, dt=0.2, seed=0, num_lanes=3, **changes: Any) -> RunSegment:
    """Cars at 8-15 m/s along +x that never touch, agent k in lane k modulo ``num_lanes``; 0 is right, at y = 0."""
    rng = np.random.default_rng(seed)
    rows = -(-num_agents // num_lanes)
    length = 60 + 25 * rows + 15 * steps * dt
    x = np.arange(0, length + 2, 2.0)

    def line(y: float, xs: NDArray[Any] = x) -> NDArray[Any]:
        return np.stack([xs, np.full_like(xs, y)], -1)

    lane = np.arange(num_agents) % num_lanes
    speed = rng.uniform(8, 15, num_lanes)[lane]
    start = 20 + 25.0 * (np.arange(num_agents) // num_lanes) + rng.uniform(0, 10, num_lanes)[lane]
    px = start[:, None] + speed[:, None] * np.arange(steps) * dt
    top = (num_lanes - 0.5) * LANE_WIDTH
    lower = np.arange(num_lanes - 1)
    road = make_road(
        [line(k * LANE_WIDTH) for k in range(num_lanes)], left=np.stack([lower, lower + 1], -1),
        right=np.stack([lower + 1, lower], -1), boundary=[line(-LANE_WIDTH / 2), line(top, x[::-1])],
        marks=[line((k + 0.5) * LANE_WIDTH) for k in range(num_lanes - 1)],
    )  # fmt: skip
    return make_segment(
        road, np.stack([px, np.broadcast_to(lane[:, None] * LANE_WIDTH, px.shape)], -1), np.zeros_like(px),
        np.stack([np.broadcast_to(speed[:, None], px.shape), np.zeros_like(px)], -1), dt,
        **{"segment_id": f"straight-{seed}", **changes},
    )  # fmt: skip


def crossing_road(arm: float = 120.0) -> RoadMap:
    """Four arms with one lane each way (right-hand traffic), arms 0-3 to the south, east, north, west. Lanes: 0-3
    approaches, 4-7 exits, then per approach k: 8 + 3k straight, 9 + 3k left, 10 + 3k right.
    """
    half, box = LANE_WIDTH / 2, 12.0
    down = np.arange(-arm, -box + 1, 2.0)
    quarter = np.linspace(0, np.pi / 2, 12)

    def turned(line: NDArray[Any], arm_index: int) -> NDArray[Any]:
        c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][arm_index % 4]
        return line @ np.array([[c, s], [-s, c]])

    def arc(cx: float, cy: float, radius: float, angles: NDArray[Any]) -> NDArray[Any]:
        return np.stack([cx + radius * np.cos(angles), cy + radius * np.sin(angles)], -1)

    entry = np.stack([np.full_like(down, half), down], -1)
    leave = np.stack([np.full_like(down, -half), down[::-1]], -1)
    across = np.linspace(-box, box, 13)
    inner = [
        np.stack([np.full_like(across, half), across], -1),
        arc(-box, -box, box + half, quarter),
        arc(box, -box, box - half, np.pi - quarter),
    ]
    edge = np.concatenate([entry + np.array([half, 0]), arc(box, -box, box - 2 * half, np.pi - quarter)[1:]])
    edge = np.concatenate([edge, turned(leave - np.array([half, 0]), 1)[1:]])
    lanes = [turned(entry, k) for k in range(4)] + [turned(leave, k) for k in range(4)]
    lanes += [turned(line, k) for k in range(4) for line in inner]
    # Seen from approach k, straight on is arm k + 2, left is k + 3 and right is k + 1.
    successors = [(k, 8 + 3 * k + m) for k in range(4) for m in range(3)]
    successors += [(8 + 3 * k + m, 4 + (k + way) % 4) for k in range(4) for m, way in enumerate((2, 3, 1))]
    middle = np.stack([np.zeros_like(down), down], -1)
    edges, marks = ([turned(line, k) for k in range(4)] for line in (edge, middle))
    return make_road(lanes, successors, boundary=edges, marks=marks)


def crossing(num_agents=4, steps=51, dt=0.2, seed=0, **changes: Any) -> RunSegment:
    """Cars at 6 m/s that pass a crossing one after the other, 2.5 s apart, each turning as the seed says: agent k
    from arm k modulo 4. One light per lane inside the crossing: arms 0 and 2 have green first.
    """
    rng = np.random.default_rng(seed)
    speed, gap = 6.0, 2.5
    arm = np.ceil(max(120.0, speed * (gap * (num_agents + 2) + steps * dt)) / 2) * 2
    road = crossing_road(arm)
    time = np.arange(steps) * dt
    position, heading = np.zeros((num_agents, steps, 2)), np.zeros((num_agents, steps))
    for k in range(num_agents):
        turn = int(rng.integers(3))
        route = [k % 4, 8 + 3 * (k % 4) + turn, 4 + (k + (2, 3, 1)[turn]) % 4]
        path = np.concatenate([road.lanes[lane][:, :2] for lane in route])
        position[k], heading[k] = along(path, arm - speed * (1.5 + gap * k) + speed * time)
    half = steps // 2
    state = np.full((12, steps), schema.SignalState.STOP, np.uint8)
    state[[*range(3), *range(6, 9)], : max(half - 5, 1)] = schema.SignalState.GO
    state[[*range(3), *range(6, 9)], max(half - 5, 1) : half] = schema.SignalState.CAUTION
    state[[*range(3, 6), *range(9, 12)], half:] = schema.SignalState.GO
    lights = {"signal_lane": np.arange(8, 20, dtype=np.int32), "signal_state": state}
    lights["signal_point"] = np.stack([road.lanes[lane][0] for lane in range(8, 20)])
    velocity = speed * np.stack([np.cos(heading), np.sin(heading)], -1)
    more = {"segment_id": f"crossing-{seed}", **lights, **changes}
    return make_segment(road, position, heading, velocity, dt, **more)


def random_segment(segment_id="random", seed=0, agents=3, steps=5, lanes=2, lights=1, marks=2) -> RunSegment:
    """Numbers that fit the schema and mean nothing; tracks have gaps, some limits are unknown."""
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> NDArray[np.float32]:
        return rng.normal(0, 50, shape).astype(np.float32)

    def lines(count: int, least: int) -> Polylines:
        return Polylines.of([floats(int(rng.integers(least, 6)), 3) for _ in range(count)])

    def picks(below: int, *shape: int) -> NDArray[np.int32]:
        return rng.integers(0, below, shape).astype(np.int32)

    ego = int(rng.integers(agents))
    valid = rng.random((agents, steps)) < 0.8
    valid[ego, 0] = True
    road = make_road([floats(3, 3)] * lanes)
    road = dataclasses.replace(
        road, lanes=lines(lanes, 2), lane_id=rng.permutation(lanes).astype(np.int64) + 2**40,
        lane_type=picks(len(LaneType), lanes).astype(np.uint8),
        speed_limit=np.where(rng.random(lanes) < 0.5, np.nan, rng.uniform(5, 30, lanes)).astype(np.float32),
        successors=picks(lanes, int(rng.integers(4)), 2), left_neighbors=picks(lanes, int(rng.integers(3)), 2),
        right_neighbors=picks(lanes, int(rng.integers(3)), 2), boundary=lines(int(rng.integers(3)), 2),
        marks=lines(marks, 1), mark_type=picks(len(MarkType), marks).astype(np.uint8),
    )  # fmt: skip
    return make_segment(
        road,
        # Within the limits of speed even after smoothing: a metre or two from step to step.
        np.where(valid[..., None], floats(agents, 1, 3) + floats(agents, steps, 3) / 50, 0),
        np.where(valid, floats(agents, steps), 0),
        np.where(valid[..., None], floats(agents, steps, 2) / 5, 0), float(rng.uniform(0.05, 0.5)), segment_id,
        source=str(rng.choice(["womd", "commonroad"])), ego=ego,
        agent_id=rng.permutation(agents).astype(np.int64) - 1,
        agent_type=picks(len(AgentType), agents).astype(np.uint8),
        size=rng.uniform(0.5, 6, (agents, 3)).astype(np.float32), valid=valid,
        signal_lane=picks(lanes, lights), signal_point=floats(lights, 3),
        signal_state=picks(len(schema.SignalState), lights, steps).astype(np.uint8),
        origin=rng.normal(0, 1e6, 3), current_step=int(rng.integers(steps)),
        interest=picks(agents, int(rng.integers(3))), predict=picks(agents, int(rng.integers(3))),
        file=str(rng.choice(["", "kreuzung-ü.xml"])),
    )  # fmt: skip


def segments(segment_ids: st.SearchStrategy[str] | None = None) -> st.SearchStrategy[RunSegment]:
    """Small arbitrary segments of all shapes the schema allows."""
    names = segment_ids or st.text(CHARACTERS, min_size=1, max_size=8)
    return st.builds(
        random_segment, segment_id=names.filter(lambda name: name.isprintable()),
        seed=st.integers(0, 2**32 - 1), agents=st.integers(1, 5), steps=st.integers(2, 7),
        lanes=st.integers(1, 4), lights=st.integers(0, 3), marks=st.integers(0, 3),
    )  # fmt: skip


def ring(gap: float = 25.0, radius: float = 15.0, steps: int = 51, aside: float = 0.2) -> RunSegment:
    """A circle of two lanes that lead into one another; a car drives towards one that stands ahead, a bit aside."""
    angle = np.linspace(0.0, np.pi, 24)
    half = radius * np.stack([np.sin(angle), -np.cos(angle)], -1)
    road = make_road([half, -half], successors=[(0, 1), (1, 0)])
    time, speed = 0.2 * np.arange(steps), 4.0
    turn = np.stack([0.2 + 0.0 * time, 0.2 + (gap / radius) + 0.0 * time])
    # As logged it comes to a stop in time.
    turn[0] += (np.minimum(speed * time, gap - 10.0)) / radius
    place = (radius + aside) * np.stack([np.sin(turn), -np.cos(turn)], -1)
    moves = np.zeros((2, steps))
    moves[0] = np.where(speed * time < gap - 10.0, speed, 0.0)
    velocity = moves[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    return make_segment(road, place, turn, velocity, segment_id="ring")
