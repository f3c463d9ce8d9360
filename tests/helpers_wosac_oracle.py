"""The WOSAC score of a record by plain NumPy in float64, looking at everything: slow, and written from the
definitions alone (docs/wosac.md), so that the scorer has something to differ from.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from helpers_wosac import Reals, box
from symphony.data.sources import womd_pb2 as pb
from symphony.wosac.scorer import SimulatedRollouts

Bools = NDArray[np.bool_]
BINS = {
    "linear_speed": (0, 25, 10),
    "linear_acceleration": (-12, 12, 11),
    "angular_speed": (-0.628, 0.628, 11),
    "angular_acceleration": (-3.14, 3.14, 11),
    "distance_to_nearest_object": (-5, 40, 10),
    "time_to_collision": (0, 5, 10),
    "distance_to_road_edge": (-20, 40, 10),
}
FLAGS = {
    "collision_indication": "collision_per_step",
    "offroad_indication": "offroad_per_step",
    "traffic_light_violation": "traffic_light_violation_per_step",
}
BUCKETS = {
    "kinematic": ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"),
    "interactive": ("distance_to_nearest_object", "collision_indication", "time_to_collision"),
    "map_based": ("distance_to_road_edge", "offroad_indication", "traffic_light_violation"),
}
WEIGHTS = {
    "2024": (0.05, 0.05, 0.05, 0.05, 0.1, 0.1, 0.1, 0.25, 0.25, 0.0),
    "2025": (0.05, 0.05, 0.05, 0.05, 0.1, 0.1, 0.05, 0.25, 0.25, 0.05),
}
"""Of the bins, then of the flags."""


class Track:
    """One object in one pass: 91 states."""

    def __init__(self, track: pb.Track, future: Reals | None) -> None:
        states = track.states
        logged = np.array([(s.center_x, s.center_y, s.center_z, s.heading) for s in states])
        self.x, self.y, self.z, self.heading = (
            logged if future is None else np.concatenate([logged[:11], future])
        ).T
        self.valid = np.array([s.valid for s in states]) | ((np.arange(91) > 10) & (future is not None))
        self.length, self.width, self.height = (
            float(getattr(states[10], name)) for name in ("length", "width", "height")
        )

    def speed(self, axes: str = "xyz") -> Reals:
        squares = [difference(getattr(self, axis)) ** 2 for axis in axes]
        return np.sqrt(np.sum(squares, axis=0)) / 0.1


def difference(values: Reals) -> Reals:
    """Half the difference of both neighbours."""
    found = np.full(len(values), np.nan)
    found[1:-1] = (values[2:] - values[:-2]) / 2
    return found


def short_way(values: Reals) -> Reals:
    return (2 * difference(values) + np.pi) % (2 * np.pi) / 2 - np.pi / 2


def oracle_features(
    record: pb.Scenario, rollouts: SimulatedRollouts | None, number: int = 0
) -> dict[str, NDArray[Any]]:
    """Features [E, 80] of one rollout, or of the log."""
    tracks = {}
    for track in record.tracks:
        if track.states[10].valid:
            future = None
            if rollouts is not None:
                row = rollouts.object_id.tolist().index(track.id)
                states = (rollouts.x, rollouts.y, rollouts.z, rollouts.heading)
                future = np.stack([values[number, row] for values in states], -1).astype(np.float64)
            tracks[track.id] = Track(track, future)
    indices = {record.sdc_track_index, *(p.track_index for p in record.tracks_to_predict)}
    scored = sorted(record.tracks[k].id for k in indices)
    order = [*scored, *(name for name in tracks if name not in scored)]
    found: dict[str, list[Any]] = {name: [] for name in (*BINS, "traffic_light_violation_per_step", "ade")}
    for name in scored:
        me, others = tracks[name], [(other, tracks[other]) for other in order]
        speed, turn = me.speed(), short_way(me.heading)
        found["linear_speed"].append(speed)
        found["linear_acceleration"].append(difference(speed) / 0.1)
        found["angular_speed"].append(turn / 0.1)
        found["angular_acceleration"].append(short_way(turn) / 0.01)
        found["distance_to_nearest_object"].append(nearest(name, me, others))
        found["time_to_collision"].append(collision_time(name, me, others))
        found["distance_to_road_edge"].append(road_edge(record, me))
        found["traffic_light_violation_per_step"].append(violations(record, me))
        log = next(Track(track, None) for track in record.tracks if track.id == name)
        away = np.sqrt((me.x - log.x) ** 2 + (me.y - log.y) ** 2 + (me.z - log.z) ** 2)
        found["ade"].append(away[log.valid].mean())
    arrays = {key: np.array(rows) if key == "ade" else np.array(rows)[:, 11:] for key, rows in found.items()}
    arrays["collision_per_step"] = arrays["distance_to_nearest_object"] < 0
    arrays["offroad_per_step"] = arrays["distance_to_road_edge"] > 0
    return arrays


def nearest(name: int, me: Track, others: list[tuple[int, Track]]) -> Reals:
    found = np.full(91, 1e10)
    for other, it in others:
        both = me.valid & it.valid
        if other != name and both.any():
            found[both] = np.minimum(found[both], gap(me, it, both))
    return found


def gap(a: Track, b: Track, steps: Bools) -> Reals:
    """Signed distances [N] of rounded boxes at N of the steps: by separating axes where cores overlap, else by their
    corners and sides."""
    radii = [0.7 * min(t.length, t.width) / 2 for t in (a, b)]
    p, q = (
        box(np.stack([t.x, t.y], -1)[steps], t.heading[steps], t.length - 2 * r, t.width - 2 * r)
        for t, r in zip((a, b), radii, strict=True)
    )
    sides = np.concatenate([np.roll(p, -1, -2) - p, np.roll(q, -1, -2) - q], -2)
    axes = np.stack([-sides[..., 1], sides[..., 0]], -1) / np.linalg.norm(sides, axis=-1)[..., None]
    one, two = p @ axes.swapaxes(-1, -2), q @ axes.swapaxes(-1, -2)
    apart = np.maximum(one.min(-2) - two.max(-2), two.min(-2) - one.max(-2)).max(-1)
    return np.where(apart > 0, np.minimum(to_sides(p, q), to_sides(q, p)), apart) - sum(radii)


def to_sides(points: Reals, corners: Reals) -> Reals:
    """Distances [N] between the nearest of points [N, 4, 2] and sides of boxes with corners [N, 4, 2]."""
    starts, sides = corners[:, None], (np.roll(corners, -1, -2) - corners)[:, None]
    away = points[:, :, None] - starts
    share = np.clip((away * sides).sum(-1) / (sides**2).sum(-1), 0, 1)
    return np.asarray(np.linalg.norm(away - share[..., None] * sides, axis=-1).min((-2, -1)))


def collision_time(name: int, me: Track, others: list[tuple[int, Track]]) -> Reals:
    found = np.full(91, 5.0)
    mine = me.speed("xy")
    theirs = {other: it.speed("xy") for other, it in others}
    for step in range(91):
        best = np.inf
        for other, it in others:
            turn = abs(it.heading[step] - me.heading[step])
            cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
            dx, dy = it.x[step] - me.x[step], it.y[step] - me.y[step]
            ahead = np.cos(me.heading[step]) * dx + np.sin(me.heading[step]) * dy
            aside = np.cos(me.heading[step]) * dy - np.sin(me.heading[step]) * dx
            room = ahead - me.length / 2 - it.length / 2 * cos - it.width / 2 * sin
            overlap = abs(aside) - me.width / 2 - it.length / 2 * sin - it.width / 2 * cos
            follows = room > 0 and turn <= np.radians(75) and overlap < 0
            follows &= bool(overlap < -0.5 or turn <= np.radians(10))
            if it.valid[step] and follows and room < best:
                best = room
                closing = mine[step] - theirs[other][step]
                found[step] = min(room / closing, 5.0) if closing > 0 else 5.0
    return found


def road_edge(record: pb.Scenario, me: Track) -> Reals:
    features = (
        f.road_edge.polyline for f in record.map_features if f.WhichOneof("feature_data") == "road_edge"
    )
    lines: list[Reals] = [np.array([(p.x, p.y, p.z) for p in line]) for line in features if len(line) > 1]
    found = np.full(91, -1e10)
    # The first steps are dropped anyway.
    steps = np.flatnonzero(me.valid & (np.arange(91) > 10))
    corners = box(np.stack([me.x, me.y], -1)[steps], me.heading[steps], me.length, me.width)
    bottom = np.broadcast_to((me.z[steps] - me.height / 2)[:, None, None], (*corners.shape[:2], 1))
    if len(steps):
        points = np.concatenate([corners, bottom], -1).reshape(-1, 3)
        found[steps] = edge_distances(points, lines).reshape(-1, 4).max(1)
    return found


def edge_distances(points: Reals, lines: list[Reals]) -> Reals:
    """Signed distances of points [M, 3], positive to the right of the nearest segment of all."""
    longest = max(map(len, lines))
    starts = np.concatenate([line[:-1] for line in lines])
    along = np.concatenate([np.diff(line, axis=0) for line in lines])
    before, after, first = [], [], 0
    for line in lines:
        count = len(line) - 1
        own = np.arange(first, first + count)
        closed = len(line) == longest and ((line[0] - line[-1]) ** 2).sum() < 1
        before.append(np.append(own[-1] if closed else -1, own[:-1]))
        after.append(np.append(own[1:], own[0] if closed else -1))
        first += count
    previous, following = np.concatenate(before), np.concatenate(after)
    result = []
    for point in points:
        away = point - starts
        squared = (along[:, :2] ** 2).sum(1)
        share = (away[:, :2] * along[:, :2]).sum(1) / np.where(squared == 0, 1, squared)
        offset = away - np.clip(share, 0, 1)[:, None] * along
        best = int((offset[:, 0] ** 2 + offset[:, 1] ** 2 + 9 * offset[:, 2] ** 2).argmin())
        right = np.sign(cross(away, along))
        sign = right[best]
        if share[best] < 0 and previous[best] >= 0:
            other = previous[best]
            left_turn = cross(along[other], along[best]) > 0
            sign = max(sign, right[other]) if left_turn else min(sign, right[other])
        elif share[best] > 1 and following[best] >= 0:
            other = following[best]
            left_turn = cross(along[best], along[other]) > 0
            sign = max(sign, right[other]) if left_turn else min(sign, right[other])
        result.append(sign * np.hypot(*offset[best, :2]))
    return np.array(result)


def cross(a: Reals, b: Reals) -> Reals:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def violations(record: pb.Scenario, me: Track) -> Bools:
    lanes = {
        f.id: np.array([(p.x, p.y) for p in f.lane.polyline])
        for f in record.map_features
        if f.WhichOneof("feature_data") == "lane" and f.lane.type == 2 and len(f.lane.polyline) > 1
    }
    found = np.zeros(91, bool)
    if not lanes or not record.dynamic_map_states:
        return found
    longest = max(map(len, lanes.values()))
    parts = {}
    for name, line in lanes.items():
        padded = line if len(line) == longest else np.concatenate([line, [(0.0, 0.0)]])
        parts[name] = padded[:-1], np.diff(padded, axis=0)
    for name in {light.lane for now in record.dynamic_map_states for light in now.lane_states} & set(lanes):
        seen = [
            [light for light in now.lane_states if light.lane == name] for now in record.dynamic_map_states
        ]
        state = [lights[-1].state if lights else 0 for lights in seen]
        stops = [(x[-1].stop_point.x, x[-1].stop_point.y) if x else (0.0, 0.0) for x in seen]
        beyond = []
        for step, stop in enumerate(stops):
            start, along = (part[int(odd_distance(stop, *parts[name]).argmin())] for part in parts[name])
            squared = along @ along
            here, there = (
                (np.subtract(point, start) @ along / squared if squared else 0.0)
                for point in ((me.x[step], me.y[step]), stop)
            )
            beyond.append(np.sign(here - there))
        for step in range(1, 91):
            crosses = beyond[step - 1] < 0 < beyond[step] and state[step] in (1, 4)
            if crosses and me.valid[step]:
                where = (me.x[step], me.y[step])
                best = min(parts, key=lambda lane: odd_distance(where, *parts[lane]).min())
                found[step] |= best == name
    return found


def odd_distance(point: tuple[float, float], start: Reals, along: Reals) -> Reals:
    """What the official scorer takes for the distance to each segment of a lane: plus, where minus is meant."""
    away, squared = np.asarray(point) - start, (along**2).sum(-1)
    share = np.clip((away * along).sum(-1) / np.where(squared == 0, 1, squared), 0, 1)
    return np.linalg.norm(away + share[:, None] * along, axis=-1)


def oracle_scores(
    record: pb.Scenario,
    log: dict[str, NDArray[Any]],
    simulated: dict[str, NDArray[Any]],
    year: str,
) -> dict[str, float]:
    """Likelihoods and the metametric from features of the log [E, 80] and of rollouts [R, E, 80]."""
    indices = {record.sdc_track_index, *(p.track_index for p in record.tracks_to_predict)}
    scored = sorted((record.tracks[k] for k in indices), key=lambda track: track.id)
    valid = np.array([[s.valid for s in track.states[11:]] for track in scored])
    vehicle = np.array([track.object_type == 1 for track in scored])
    both = np.zeros_like(valid)
    both[:, 1:-1] = valid[:, 2:] & valid[:, :-2]
    thrice = np.zeros_like(valid)
    thrice[:, 1:-1] = both[:, 2:] & both[:, :-2]
    masks = dict.fromkeys(BINS, valid)
    masks |= {"linear_speed": both, "angular_speed": both}
    masks |= {"linear_acceleration": thrice, "angular_acceleration": thrice}
    masks["time_to_collision"] = valid & vehicle[:, None]
    found = {}
    for name, (low, high, bins) in BINS.items():
        edges = np.float32(low) + np.arange(bins + 1, dtype=np.float32) * np.float32(
            (np.float32(high) - np.float32(low)) / bins
        )

        def bins_of(values: Reals, edges: Any = edges, bins: int = bins) -> NDArray[np.int64]:
            inside = np.searchsorted(edges[1:-1], values.astype(np.float32), side="right")
            return np.where(np.isnan(values), bins - 1, inside)

        terms = []
        for k in range(len(scored)):
            counts = 0.1 + np.bincount(bins_of(simulated[name][:, k].ravel()), minlength=bins)
            terms += [*np.log((counts / counts.sum())[bins_of(log[name][k][masks[name][k]])])]
        found[name] = float(np.exp(np.mean(terms)))
    for name, flag in FLAGS.items():
        there = valid & (vehicle[:, None] | (name != "traffic_light_violation"))
        truth, ever = (log[flag] & there).any(-1), (simulated[flag] & there).any(-1)
        share = ((ever == truth).sum(0) + 0.001) / (len(ever) + 0.002)
        found[name] = float(np.exp(np.log(share).mean()))
    weight = dict(zip(found, WEIGHTS[year], strict=True))
    meta = sum(weight[name] * value for name, value in found.items())
    ade = simulated["ade"]
    return {
        "metametric": meta,
        **{f"{name}_likelihood": value for name, value in found.items()},
        **{
            f"{bucket}_metrics": sum(weight[n] * found[n] for n in names) / sum(weight[n] for n in names)
            for bucket, names in BUCKETS.items()
        },
        "average_displacement_error": float(ade.mean()),
        "min_ade": float(ade.mean(-1).min()),
        "simulated_collision_rate": float((simulated["collision_per_step"] & valid).any(-1).mean()),
        "simulated_offroad_rate": float((simulated["offroad_per_step"] & valid).any(-1).mean()),
        "simulated_traffic_light_violation_rate": float(
            (simulated["traffic_light_violation_per_step"] & valid).any(-1).mean()
        ),
    }
