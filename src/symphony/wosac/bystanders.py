"""What needs no driver in whole traffic: vehicles that stand, and people who walk.

Only the present and the last second are looked at. Legend: A agents, n of them, R rollouts, F future steps.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from symphony.data.resample import wrap
from symphony.data.segment import AgentType, RunSegment, SignalState
from symphony.streams import Stream, fold_in, stream_of, uniform

STILL = 0.2
"""Metres that a vehicle that stands has moved in the last second, at most; at speeds up to twice that a second."""
AHEAD, ASIDE = 60.0, 3.0
"""Metres ahead and to a side within which a light is a vehicle's own."""
PACE, COURSE = 0.4, 0.17
"""How much people's speeds (a share) and courses (radians, 10 degrees) differ between rollouts, either way."""
_GO = (SignalState.ARROW_GO, SignalState.GO)
_STOP = (SignalState.ARROW_STOP, SignalState.STOP)


def standing(segment: RunSegment) -> NDArray[np.bool_]:
    """[A] vehicles that have stood for the last second and have no reason to go: no green light ahead of them.

    In logs, those under a green light go within 8 s, of the others one in eight or fewer.
    """
    now = segment.current_step
    past = slice(max(now - round(1 / segment.dt), 0), now + 1)
    away = np.linalg.norm(segment.position[:, past, :2] - segment.position[:, now, None, :2], axis=-1)
    still = np.where(segment.valid[:, past], away, 0.0).max(1) <= STILL
    still &= np.linalg.norm(segment.velocity[:, now], axis=-1) <= 2 * STILL
    still &= segment.valid[:, now] & (segment.agent_type == AgentType.VEHICLE)
    # The latest state seen of each light, and where it is in the frame of each vehicle.
    seen = segment.signal_state[:, now::-1]
    shown = seen[np.arange(len(seen)), (seen != SignalState.UNKNOWN).argmax(1)]
    delta = segment.signal_point[None, :, :2] - segment.position[:, now, None, :2]
    cos, sin = np.cos(segment.heading[:, now, None]), np.sin(segment.heading[:, now, None])
    along, aside = cos * delta[..., 0] + sin * delta[..., 1], cos * delta[..., 1] - sin * delta[..., 0]
    own = (along > 0) & (along < AHEAD) & (np.abs(aside) < ASIDE)
    green, red = ((own & np.isin(shown, states)).any(1) for states in (_GO, _STOP))
    return np.asarray(still & ~(green & ~red))


def walks(
    segment: RunSegment, rows: NDArray[np.int64], rollouts: int, steps: int, seed: int
) -> NDArray[np.float64]:
    """[R, n, F, 3] x, y, heading of pedestrians and whoever else is driven by nobody.

    They keep their velocity, each rollout with a pace and a course of its own, and their headings change as they did
    at some step of the last second, drawn anew for each step.
    """
    now = segment.current_step
    stream = fold_in(torch.tensor(stream_of(segment.segment_id)), Stream.WALKS)
    agents = torch.from_numpy(segment.agent_id[rows].astype(np.int64))
    line = fold_in(fold_in(stream, torch.arange(rollouts)[:, None]), agents)[..., None]
    drawn = uniform(seed, line, torch.arange(steps + 2)).double().numpy()
    pace, course = 1 + PACE * (2 * drawn[..., 0] - 1), COURSE * (2 * drawn[..., 1] - 1)
    velocity = segment.velocity[rows, now].astype(np.float64)
    cos, sin = pace * np.cos(course), pace * np.sin(course)
    x, y = cos * velocity[:, 0] - sin * velocity[:, 1], sin * velocity[:, 0] + cos * velocity[:, 1]
    time = np.arange(1, steps + 1) * segment.dt
    path = segment.position[rows, now, None, :2] + np.stack([x, y], -1)[:, :, None] * time[:, None]
    past = slice(max(now - round(1 / segment.dt), 0), now + 1)
    heading, valid = segment.heading[rows, past].astype(np.float64), segment.valid[rows, past]
    turns = np.where(valid[:, 1:] & valid[:, :-1], wrap(np.diff(heading)), 0.0)
    turns -= turns.mean(1, keepdims=True)
    which = (drawn[..., 2:] * turns.shape[1]).astype(np.int64)
    turned = np.take_along_axis(np.broadcast_to(turns, (rollouts, *turns.shape)), which, -1).cumsum(-1)
    found = wrap(heading[:, -1, None] + course[..., None] + turned)
    return np.concatenate([path, found[..., None]], -1)
