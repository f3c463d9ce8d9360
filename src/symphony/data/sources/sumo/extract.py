"""Cutting run segments out of a simulation, and leaving out those that are not physical."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import shapely

from symphony.data.overlaps import box_depth
from symphony.data.segment import AgentType, Bools, Floats, RunSegment, validate
from symphony.data.selection import MOVING
from symphony.data.sources.base import Doubles, motion
from symphony.data.sources.sumo.roads import Crop, Network, crop_network
from symphony.data.sources.sumo.traffic import STEP, Traffic

DT = 0.2
EVERY = round(DT / STEP)
MAX_OVERLAP = 0.05
MAX_ACCELERATION = 7.5
MAX_YAW_RATE = 1.6
MAX_LATERAL_SPEED = 1.5
_EGO_TRAVEL, _STANDS = 8.0, 0.1
_MIN_STEPS = 5
_TURN, _NEAR, _SPEED_CHANGE = 0.5, 6.0, 4.0


@dataclass(frozen=True)
class CropRule:
    """The choice of maps and egos; distances in metres."""

    radius: float = 110.0  # around the focus, that the map covers
    ego_radius: float = 78.0  # within which the ego stays throughout, so that road lies ahead of it
    agent_radius: float = 95.0  # within which other vehicles are seen
    partner_distance: float = 40.0  # from the ego to the nearest other vehicle that moves, at the first step
    focuses: int = 6  # points of the network, at most
    per_focus: int = 12  # segments that share one map, at most
    steps: int = 51  # of a segment, its first state included
    interactive: int = 2  # moving vehicles a segment must have at its first step (N_I)
    turn_interest: float = 1.2  # what a turn adds to the chance of being the ego, where driving on has 0.3


def crop_rule(kind: str, seconds: float = 10.0, interactive: int = 2) -> CropRule:
    """Return the kind's rule for segments of the given length.

    Longer segments get larger maps, so that a vehicle which drives on has road ahead of it to the end; freeways need
    longer maps for the same ten seconds, and from fewer points of the network, as those maps overlap more.
    """
    ramp = kind == "ramp"
    rule = CropRule(radius=190, ego_radius=165, agent_radius=180, focuses=4) if ramp else CropRule()
    grown = max(0.0, seconds - 10.0) * (13.5 if ramp else 4.5)
    radii = {name: getattr(rule, name) + grown for name in ("radius", "ego_radius", "agent_radius")}
    return replace(rule, **radii, steps=round(seconds / DT) + 1, interactive=interactive)


def cut_segments(
    name: str, network: Network, traffic: Traffic, rng: np.random.Generator, rule: CropRule
) -> tuple[list[RunSegment], Counter[str]]:
    """Cut segments, one ego each, from windows that do not overlap at each focus; also say why windows gave none.
    Segments of one focus share one :class:`RoadMap` object and one origin.
    """
    tracks, wild = _at_steps(traffic)
    segments: list[RunSegment] = []
    reasons: Counter[str] = Counter()
    for focus, center in enumerate(_focuses(network, rng, rule)):
        crop = crop_network(network, center, rule.radius)
        shapely.prepare(crop.drivable)
        most = len(segments) + rule.per_focus
        offset = int(rng.integers(0, rule.steps // 2))
        last = tracks.present.shape[1] - rule.steps
        for window, start in enumerate(range(offset, last + 1, rule.steps)):
            if len(segments) == most:
                break
            result = _cut(f"{name}-f{focus}-w{window:02d}", crop, tracks, wild, start, rng, rule)
            if isinstance(result, str):
                reasons[result] += 1
            else:
                segments.append(result)
    return segments, reasons


def _focuses(network: Network, rng: np.random.Generator, rule: CropRule) -> list[Doubles]:
    """Return junctions, rounded to metres, at least half a radius apart."""
    chosen: list[Doubles] = []
    for center in np.round(rng.permutation(network.centers)):
        near = [float(np.linalg.norm(center - other)) < rule.radius / 2 for other in chosen]
        if len(chosen) < rule.focuses and not any(near):
            chosen.append(center)
    return chosen


def _at_steps(traffic: Traffic) -> tuple[Traffic, Bools]:
    """Return traffic at the steps of segments, and which of these states [V, N] are not physical."""
    velocity, heading = traffic.velocity, traffic.heading
    with np.errstate(invalid="ignore"):
        # Over 0.2 s, as the limits were measured.
        acceleration = (velocity[:, EVERY:] - velocity[:, :-EVERY]) / DT
        yaw_rate = (heading[:, EVERY:] - heading[:, :-EVERY]) / DT
        sideways = velocity[..., 1] * np.cos(heading) - velocity[..., 0] * np.sin(heading)
        wild = np.atleast_2d(np.abs(sideways) > MAX_LATERAL_SPEED)
        wild[:, EVERY:] |= np.linalg.norm(acceleration, axis=-1) > MAX_ACCELERATION
        wild[:, EVERY:] |= np.abs(yaw_rate) > MAX_YAW_RATE
    picked = {name: getattr(traffic, name)[:, ::EVERY] for name in ("position", "heading", "velocity", "present")}
    wild[traffic.agent_type == AgentType.PEDESTRIAN] = False  # they turn on the spot
    lights = {light: states[:, ::EVERY] for light, states in traffic.lights.items()}
    return replace(traffic, lights=lights, **picked), wild[:, ::EVERY]


def _cut(
    name: str, crop: Crop, tracks: Traffic, unphysical: Bools, start: int, rng: np.random.Generator, rule: CropRule
) -> RunSegment | str:
    """Return one segment, or why there is none."""
    window = slice(start, start + rule.steps)
    position = tracks.position[:, window] - crop.center
    away = np.linalg.norm(position, axis=-1)
    with np.errstate(invalid="ignore"):
        valid = tracks.present[:, window] & (away <= rule.agent_radius)
        stays = valid.all(1) & (away <= rule.ego_radius).all(1)
    agents = np.flatnonzero(valid.sum(1) >= _MIN_STEPS)
    if not stays[agents].any():
        return "no vehicle stays near the focus"
    position, valid, stays, size = position[agents], valid[agents], stays[agents], tracks.size[agents]
    agent_type = tracks.agent_type[agents]
    walks = agent_type == AgentType.PEDESTRIAN
    heading, velocity = tracks.heading[agents, window], tracks.velocity[agents, window]
    rows, seen = np.arange(len(agents)), valid.argmax(1)
    # The farthest each gets from where it is first seen.
    travel = np.where(valid, np.linalg.norm(position - position[rows, seen, None], axis=-1), 0).max(1)
    drives = (agent_type == AgentType.VEHICLE) & (travel > MOVING)
    weight = _interest(position, heading, velocity, valid, drives, rule) * (stays & drives & (travel > _EGO_TRAVEL))
    if weight.sum() == 0:
        return "no moving ego with a moving partner"
    if (valid[:, 0] & drives).sum() < rule.interactive:
        return "too few moving vehicles at the first step"
    wild = bool((unphysical[agents, window] & valid).any())
    if wild or _overlap(position, heading, size, valid, walks):
        return "unphysical motion" if wild else "overlap"
    drove = position[valid & (~walks & (travel > _STANDS))[:, None]]
    off = not shapely.contains_xy(crop.drivable, *drove.T).all()
    if off or shapely.contains_xy(crop.unwalked, *position[valid & walks[:, None]].T).any():
        return "off the road" if off else "people on the road"
    ego = int(rng.choice(len(agents), p=weight / weight.sum()))
    lights = [tracks.lights[light][link, window] for light, link in crop.signals]
    # Unwrapped since the vehicle appeared; whole turns before the window mean nothing here.
    turns = np.round(np.nan_to_num(heading[rows, seen]) / (2 * np.pi))
    return validate(
        RunSegment(
            segment_id=f"{name}-v{agents[ego]}",
            source="sumo",
            dt=DT,
            ego=ego,
            agent_id=agents.astype(np.int64),
            agent_type=agent_type,
            size=size,
            **motion(position, heading - 2 * np.pi * turns[:, None], velocity, valid),
            road=crop.road,
            signal_lane=crop.signal_lane,
            signal_point=crop.signal_point,
            signal_state=np.array(lights, np.uint8).reshape(len(lights), rule.steps),
            origin=np.array([*crop.center, 0.0]),
        )
    )


def _interest(
    position: Doubles, heading: Doubles, velocity: Doubles, valid: Bools, drives: Bools, rule: CropRule
) -> Doubles:
    """Return [A] the chance to be the ego, 0 with nobody near by: turns, closeness and changes of speed count."""
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    distance = np.where(valid[:, None] & valid[None], distance, np.inf)
    distance[np.arange(len(position)), np.arange(len(position))] = np.inf
    whole: Bools = np.all(valid, axis=1)
    partner = np.flatnonzero(whole & drives)
    has_partner = np.any(distance[:, partner, 0] < rule.partner_distance, axis=1)
    speed = np.where(whole[:, None], np.linalg.norm(velocity, axis=-1), 0)
    turns = np.where(whole, np.abs(heading[:, -1] - heading[:, 0]), 0) > _TURN
    near = distance.min((1, 2)) < _NEAR
    changes = np.ptp(speed, axis=1) > _SPEED_CHANGE
    return has_partner * (0.3 + rule.turn_interest * turns + 0.5 * near + 0.5 * changes)


def _overlap(position: Doubles, heading: Doubles, size: Floats, valid: Bools, walks: Bools) -> bool:
    """Return whether two boxes, not both of people who walk, ever share more than :data:`MAX_OVERLAP` metres."""
    first, second = np.triu_indices(len(position), 1)
    first, second = first[~(walks[first] & walks[second])], second[~(walks[first] & walks[second])]
    sides = size[:, :2].astype(np.float64)
    reach = np.linalg.norm(sides / 2, axis=-1)
    gap = np.linalg.norm(position[first] - position[second], axis=-1)
    close = np.nan_to_num(gap, nan=np.inf) < (reach[first] + reach[second])[:, None]
    pair, step = np.nonzero(valid[first] & valid[second] & close)
    a, b = first[pair], second[pair]
    way = position[b, step] - position[a, step]
    return bool((box_depth(way, heading[a, step], sides[a], heading[b, step], sides[b]) > MAX_OVERLAP).any())
