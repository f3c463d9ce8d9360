"""Logged vehicles as demonstrations: the actions that reproduce their motion, fitted many segments at a time and kept
with their store; their states in the log, and what they would observe.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

import symphony
from symphony import keys
from symphony.data.npz import read_npz
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import MOVING, travel
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.objects import objects_at
from symphony.envs.observation import ObservationConfig, observe
from symphony.envs.routes import FollowedRoutes, RouteTable, RouteWindow, logged_progress, route_table
from symphony.envs.scene import SceneBatch
from symphony.errors import DataError
from symphony.files import replacing
from symphony.geometry.frames import with_speed
from symphony.roadgraph import LaneGraph, lane_of

IN_LANE = 1.0
"""Metres from a centre line within which a standing vehicle is taken to wait rather than to be parked."""
FOLLOWS = 2.0
"""Metres between log and fit up to which a step is a demonstration."""

VERSION = 8
"""Version of the fit: raised when it gives other numbers or routes for the same segment (a test says when)."""
PACKAGE = Path(symphony.__file__).parent
_TENSORS = ("agent", "states", "actions", "valid", "progress")

TOGETHER = 256
"""Vehicles fitted at a time: more would save few calls, and their temporaries would leave the cache."""


@dataclass(frozen=True)
class Experts:
    """Logged vehicles of one segment as demonstrations, after the fit to the action space.

    Attributes:
        agent: [K] rows of the segment's agents.
        states: [K, T, 4] fitted x, y, heading, speed.
        actions: [K, T - 1] int16 or [K, T - 1, 2].
        valid: [K, T - 1] where the log is valid before and after the action, and the fit near it.
        progress: [K, T] metres that each has come along its route; [K, 0] where routes were not asked for.
        routes: feasible routes of each expert from its first valid state; empty where not asked for.
    """

    agent: Tensor
    states: Tensor
    actions: Tensor
    valid: Tensor
    progress: Tensor
    routes: tuple[RouteTable, ...] = ()

    @property
    def nbytes(self) -> int:
        """The bytes that it takes in memory."""
        tables = sum(t.points.nbytes + t.count.nbytes + t.right.nbytes for t in self.routes)
        carried = sum(line.nbytes for t in self.routes for line in t.carried.values())
        return sum(getattr(self, name).nbytes for name in _TENSORS) + tables + carried


def fit_experts(
    segments: Sequence[RunSegment],
    dynamics: Bicycle | Displacement,
    graphs: Sequence[LaneGraph] | None = None,
    *,
    routes: bool = False,
) -> list[Experts]:
    """Fit the ego and every other vehicle of some segments that moves or stands in a lane (waiting is driving,
    parking is not), each independently of the others.

    Args:
        segments: the run segments.
        dynamics: the action space.
        graphs: lane graphs of the segments, built here if not given.
        routes: whether to find the experts' routes.
    """
    graphs = [LaneGraph(segment.road) for segment in segments] if graphs is None else graphs
    rows = [_demonstrators(segment, graph) for segment, graph in zip(segments, graphs, strict=True)]
    fits = _fit(segments, rows, dynamics)
    found = []
    for segment, graph, chosen, (actions, states) in zip(segments, graphs, rows, fits, strict=True):
        # Where no actions follow the log, as a track begins with a wrong velocity, nothing is learned.
        away = torch.linalg.norm(states[..., :2] - torch.from_numpy(segment.position[chosen][..., :2]), dim=-1)
        mask = torch.from_numpy(segment.valid[chosen]) & (away <= FOLLOWS)
        tables = tuple(route_table(segment, graph, int(row)) for row in chosen) if routes else ()
        come = np.zeros((len(chosen), 0), np.float32)
        if routes:
            # Along what was fitted, as that is what is learned from; it exists from the first valid state on.
            path, there = states[..., :2].numpy(), np.maximum.accumulate(segment.valid[chosen], 1)
            come = logged_progress(tables, path, there)
        known = mask[:, 1:] & mask[:, :-1]
        found.append(Experts(torch.from_numpy(chosen), states, actions, known, torch.from_numpy(come), tables))
    return found


def _demonstrators(segment: RunSegment, graph: LaneGraph) -> NDArray[np.int64]:
    valid = segment.valid
    at = np.arange(segment.num_agents), valid.argmax(1)
    lane = lane_of(graph, segment.position[at][:, :2], segment.heading[at], tolerance=IN_LANE)
    chosen = (segment.agent_type == AgentType.VEHICLE) & ((travel(segment) > MOVING) | (lane >= 0))
    chosen[segment.ego] = True
    chosen &= (valid[:, 1:] & valid[:, :-1]).any(1)
    return np.flatnonzero(chosen)


def _fit(
    segments: Sequence[RunSegment], rows: Sequence[NDArray[np.int64]], dynamics: Bicycle | Displacement
) -> list[tuple[Tensor, Tensor]]:
    """Return actions [K, T - 1(, 2)], joint indices as int16, and states [K, T, 4] of the rows of each segment."""
    found: dict[int, tuple[Tensor, Tensor]] = {}
    number = np.cumsum([len(each) for each in rows]) // TOGETHER
    groups: dict[tuple[float, int], list[int]] = {}
    for k, segment in enumerate(segments):
        groups.setdefault((segment.dt, number[k]), []).append(k)
    for group in groups.values():
        found.update(_fit_together(segments, rows, group, dynamics))
    return [found[k] for k in range(len(segments))]


def _fit_together(
    segments: Sequence[RunSegment],
    rows: Sequence[NDArray[np.int64]],
    group: Sequence[int],
    dynamics: Bicycle | Displacement,
) -> dict[int, tuple[Tensor, Tensor]]:
    """Return actions and states by segment, for a group of segments with one time step."""
    steps = max(segments[k].num_steps for k in group)

    def joined(name: str) -> Tensor:
        parts = [getattr(segments[k], name)[rows[k]] for k in group]
        # Shorter segments are padded with steps that are not valid, which come after theirs and change nothing.
        late = [[(0, 0), (0, steps - part.shape[1])] + [(0, 0)] * (part.ndim - 2) for part in parts]
        return torch.from_numpy(np.concatenate([*map(np.pad, parts, late)]))

    position, heading, velocity, valid = map(joined, ("position", "heading", "velocity", "valid"))
    size = torch.from_numpy(np.concatenate([segments[k].size[rows[k], :2] for k in group]))
    # An agent that appears later is fitted from its first valid state; its rows before that are masked.
    log = with_speed(torch.cat([position[..., :2], heading[..., None], velocity[..., :2]], -1))
    actions, states = dynamics.fit(log, valid, size, segments[group[0]].dt)
    actions = actions.to(torch.int16) if dynamics.discrete else actions
    counts, found = [len(rows[k]) for k in group], {}
    for k, action, state in zip(group, actions.split(counts), states.split(counts), strict=True):
        length = segments[k].num_steps
        # Copies, so that a segment kept in memory doesn't keep the whole group.
        found[k] = action[:, : length - 1].clone(), state[:, :length].clone()
    return found


def logged_routes(tables: Sequence[RouteTable], row: Int[Tensor, " M"]) -> FollowedRoutes:
    """Return the routes that experts took, one expert in each row [M, 1]."""
    none = np.zeros((0, 2), np.float32)
    lines = [table.followed(table.logged) if table.logged >= 0 else none for table in tables]
    count = torch.tensor([len(line) for line in lines])
    begin = count.cumsum(0) - count
    return FollowedRoutes(torch.from_numpy(np.concatenate(lines)), begin[row][:, None], count[row][:, None])


def logged(scenes: SceneBatch) -> tuple[Float[Tensor, "B T N 4"], Bool[Tensor, "B T N"]]:
    """Return the states of the interactive agents in the log, and where they are valid."""
    steps = scenes.log_valid.shape[1]
    index = scenes.interactive[:, None].expand(-1, steps, -1)
    log = scenes.log_state.gather(2, index[..., None].expand(*index.shape, 5))
    valid = scenes.log_valid.gather(2, index) & scenes.interactive_valid[:, None]
    return with_speed(log), valid


def logged_heights(scenes: SceneBatch) -> Float[Tensor, "B T N 2"] | None:
    """Return height and level of the interactive agents in the log; None where no scene has levels."""
    if not scenes.agent_height.shape[1]:
        return None
    return scenes.agent_height.take_along_dim(scenes.interactive[:, None, :, None], 2)


def expert_batch(
    scenes: SceneBatch,
    scene_of: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    agent: Int[Tensor, " M"],
    state: Float[Tensor, "M 4"],
    observation: ObservationConfig,
    *,
    action: Tensor | None = None,
    routes: RouteWindow | None = None,
) -> TensorDict:
    """Return what agents [M] see in states [M, 4] among all others as logged; with actions and routes, if given."""
    index, here = agent[:, None], state[:, None]
    real = torch.ones_like(index, dtype=torch.bool)
    objects = objects_at(scenes, scene_of, step, here, index, real)
    seen = observe(scenes, scene_of, step, objects, index, observation, routes=routes)
    batch = TensorDict({}, batch_size=[len(step)], device=state.device)
    batch.set(keys.VALID, real)
    batch.set(keys.STATE, here)
    for name, value in seen.items():
        batch.set(("agents", "observation", name), value)
    if action is not None:
        batch.set(keys.ACTION, action[:, None])
    return batch


class KeptExperts:
    """Demonstrations kept in a folder of their store, so that a segment is fitted once and not in every run.

    Files of arrays, nothing pickled, are named after all that they depend on. They are a cache: one that is missing
    or damaged is made again, and where the folder can't be written or belongs to the package, nothing is kept.

    Args:
        store: the store's folder.
        settings: what the fit depends on beside the segment's content.
    """

    def __init__(self, store: Path, settings: str) -> None:
        self.settings = settings
        self.folder: Path | None = None if PACKAGE in store.resolve().parents else store / "experts"
        try:
            if self.folder is not None:
                self.folder.mkdir(exist_ok=True)
        except OSError:
            self.folder = None

    def _path(self, content: str) -> Path | None:
        key = hashlib.sha256(f"{VERSION} {content} {self.settings}".encode()).hexdigest()
        return None if self.folder is None else self.folder / f"{key[:32]}.npz"

    @property
    def writable(self) -> bool:
        """Whether anything can be kept."""
        return self.folder is not None and os.access(self.folder, os.W_OK)

    def load(self, content: str) -> Experts | None:
        """Return the demonstrations of the segment with this hash; None where there are none that can be read."""
        path = self._path(content)
        if path is None or not path.is_file():
            return None
        try:
            arrays = read_npz(path)
            ends = arrays["route_number"].cumsum()
            # Points of the routes of each agent end where those of its last route do.
            point_ends = np.append(0, arrays["route_count"].cumsum())[np.append(0, ends)]
            carried = np.split(arrays["carried_points"], arrays["carried_count"].cumsum()[:-1])
            followed = dict(zip(arrays["carried_route"].tolist(), carried, strict=False))
            tables = tuple(
                RouteTable(
                    arrays["route_points"][point_ends[k] : point_ends[k + 1]],
                    arrays["route_count"][end - count : end],
                    arrays["route_right"][end - count : end],
                    arrays["route_change"][end - count : end],
                    int(arrays["route_logged"][k]),
                    {g: followed[end - count + g] for g in range(count) if end - count + g in followed},
                )
                for k, (end, count) in enumerate(zip(ends, arrays["route_number"], strict=True))
            )
            return Experts(**{name: torch.from_numpy(arrays[name]) for name in _TENSORS}, routes=tables)
        except (DataError, OSError, ValueError, KeyError, IndexError):
            return None

    def save(self, content: str, experts: Experts) -> None:
        """Keep the demonstrations of a segment, if the folder can be written and the disk has room."""
        path, routes = self._path(content), experts.routes
        if path is None or not self.writable:
            return
        # Routes that are carried on, by their places among those of all agents.
        begin = np.cumsum([0, *(len(table.count) for table in routes)])
        carried = {int(begin[k]) + g: line for k, table in enumerate(routes) for g, line in table.carried.items()}
        arrays = {name: getattr(experts, name).numpy() for name in _TENSORS} | {
            "route_number": np.array([len(table.count) for table in routes], np.int64),
            "route_points": np.concatenate([np.zeros((0, 2), np.float32), *(t.points for t in routes)]),
            "route_count": np.concatenate([np.zeros(0, np.int64), *(t.count for t in routes)]),
            "route_right": np.concatenate([np.zeros(0, np.bool_), *(t.right for t in routes)]),
            "route_change": np.concatenate([np.zeros(0, np.float32), *(t.change for t in routes)]),
            "route_logged": np.array([table.logged for table in routes], np.int64),
            "carried_route": np.array(list(carried), np.int64),
            "carried_count": np.array([len(line) for line in carried.values()], np.int64),
            "carried_points": np.concatenate([np.zeros((0, 2), np.float32), *carried.values()]),
        }
        try:
            with replacing(path) as draft, zipfile.ZipFile(draft, "w") as file:
                for name, array in arrays.items():
                    part = io.BytesIO()
                    np.save(part, array)
                    # Of no date, so that equal arrays are equal files.
                    file.writestr(zipfile.ZipInfo(f"{name}.npy"), part.getvalue(), zipfile.ZIP_DEFLATED, 1)
        except DataError:
            self.folder = None
