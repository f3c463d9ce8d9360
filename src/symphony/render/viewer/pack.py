"""The data of a page for each run segment: arrays of small integers, deflated, in base64.

The log of a segment is a block, and so are the rollouts of each planner: the deflated (zlib) form of the length of a
header (4 bytes, little-endian), the header as JSON, the arrays one after the other. The header has ``facts`` and
``arrays``; of each array its ``name``, ``type``, ``shape``, ``offset`` behind the header, the ``scale`` its integers
are multiplied with, and whether they are differences along the last axis (``delta``).
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import Polylines, content_hash, wrap
from symphony.errors import DataError
from symphony.files import finite

if TYPE_CHECKING:
    from symphony.saved.rollouts import SavedRollouts, SavedTrees


SCRIPTS = ("data.js", "map.js", "scene.js", "search.js", "panels.js", "main.js")


def view_page(names: Sequence[str], found: Iterable[Sequence[Replay | None]]) -> str:
    """Return a self-contained page that plays rollouts: canvas and plain JavaScript, nothing is loaded from the net.

    ``#segment=ID&rollout=K&t=SECONDS&agent=ID`` behind its address names what it shows.

    Takes the names of those that are shown side by side, and for each segment the replay of each of them, None for
    nothing. Raises a :class:`DataError` for those of different logs or steps, or a number too large for the page.
    """
    segments: list[dict[str, Any]] = []
    blocks: list[str] = []
    for number, replays in enumerate(found):
        first = next(replay.saved for replay in replays if replay is not None)
        log, name = (content_hash(first.segment), first.start, first.steps), first.segment.segment_id
        try:
            texts = {f"segment-{number}": packed_log(first)}
            for place, one in enumerate(replays):
                if one is None:
                    continue
                if (content_hash(one.saved.segment), one.saved.start, one.saved.steps) != log:
                    raise DataError(f"{names[place]} was simulated on another log, or for other steps")
                texts[f"segment-{number}-{place}"] = packed(one)
        except DataError as error:
            raise error.at(segment=name) from None
        blocks += [f'<script type="text/plain" id="{id}">{text}</script>' for id, text in texts.items()]
        segments.append({"id": name, "kinds": [None if one is None else _kinds(one) for one in replays]})
    parts = {
        "/*TITLE*/": escape(f"{', '.join(names)}: rollouts"),
        "/*STYLE*/": template("view.css"),
        "/*ABOUT*/": script_json({"names": list(names), "segments": segments}),
        "/*SEGMENTS*/": "\n".join(blocks),
        "/*SCRIPT*/": "\n".join(template(name) for name in SCRIPTS),
    }
    return filled(template("view.html"), parts)


def _kinds(replay: Replay) -> list[list[str]]:
    """Return the kinds of events of each rollout, to choose rollouts by."""
    found = [{"failed"} if k in replay.saved.failed else set[str]() for k in range(replay.saved.rollouts)]
    for event in replay.events:
        found[event.rollout] |= {event.kind} | ({"fault"} if event.fault else set())
    return [sorted(kinds) for kinds in found]


def template(name: str) -> str:
    """Return a file that lies beside this one."""
    return (files(__package__) / name).read_text(encoding="utf-8")


def script_json(value: Any) -> str:
    """Return JSON that can stand within a script element; numbers that are not finite become null."""
    return json.dumps(finite(value), ensure_ascii=False, allow_nan=False, default=str).replace("<", "\\u003c")


def filled(page: str, parts: Mapping[str, str]) -> str:
    """Return a page with its markers replaced, each once; the replacements are not searched for markers."""
    for marker in parts:
        before, found, after = page.partition(marker)
        if not found:
            raise ValueError(f"the template has no {marker}")
        page = f"{before}\0{marker}\0{after}"
    return "".join(parts.get(piece, piece) for piece in page.split("\0"))


_TYPES = {"i32": np.int32, "i16": np.int16, "u8": np.uint8, "f32": np.float32}
MILLIMETRE, CENTIMETRE, ANGLE = 1e-3, 1e-2, 1e-4
"""What places (metres), sizes and speeds (metres, m/s) and headings (radians) are rounded to."""
FAR = 10.2  # seconds to a collision above which the page knows none


@dataclass(frozen=True)
class Event:
    """An event to mark in a replay."""

    rollout: int  # its number
    step: int  # the state at which it happens, from 0
    agent: int  # row of the log
    kind: str  # `collision`, `offroad`, `redlight` or `blocking`
    text: str  # what happened, behind the agent's id (of a collision: its kind)
    other: int = -1  # row of the other agent of a collision
    fault: bool | None = None  # of a collision, whether the agent is at fault, where that is known
    label: str = ""  # short, for a list of rollouts


class Replay(NamedTuple):
    """The rollouts of a run segment as a page shows them."""

    saved: SavedRollouts
    events: Sequence[Event] = ()
    collision_in: NDArray[Any] | None = None  # [K, T, N] seconds after each step, not finite where there is none


class _Packer:
    def __init__(self) -> None:
        self.arrays: list[dict[str, Any]] = []
        self.data: list[bytes] = []
        self.offset = 0

    def add(self, name: str, kind: str, values: Any, scale: float = 0, *, delta: bool = False) -> None:
        array = np.asarray(values, np.float64)
        # Rounded first and then differenced: errors don't add up.
        whole = np.rint(array / scale) if scale else array
        if delta:
            whole = np.diff(whole, axis=-1, prepend=0.0) if whole.size else whole
        packed_values = np.ascontiguousarray(whole, dtype=_TYPES[kind])
        if kind != "f32" and not np.array_equal(packed_values, whole):
            raise DataError(f"numbers beyond what {kind} holds", field=name)
        item: dict[str, Any] = {"name": name, "type": kind, "shape": list(array.shape), "offset": self.offset}
        item |= ({"scale": scale} if scale else {}) | ({"delta": True} if delta else {})
        self.arrays.append(item)
        raw = packed_values.tobytes()
        # Browsers read numbers at multiples of their size only.
        raw += b"\0" * (-len(raw) % 4)
        self.data.append(raw)
        self.offset += len(raw)

    def lines(self, name: str, lines: Polylines) -> None:
        self.add(f"{name}.offsets", "i32", lines.offsets, delta=True)
        for axis, letter in enumerate("xy"):
            self.add(f"{name}.{letter}", "i32", lines.points[:, axis], MILLIMETRE, delta=True)

    def states(self, name: str, state: NDArray[Any]) -> None:
        """Add states [..., T, 4], zero where there are none."""
        heading = wrap(state[..., 2].astype(np.float64))
        for axis, letter in enumerate("xy"):
            self.add(f"{name}.{letter}", "i32", state[..., axis], MILLIMETRE, delta=True)
        self.add(f"{name}.h", "i16", heading, ANGLE)
        self.add(f"{name}.s", "i16", state[..., 3], CENTIMETRE)

    def text(self, facts: dict[str, Any]) -> str:
        told = {"facts": facts, "arrays": self.arrays}
        header = json.dumps(told, allow_nan=False).encode()
        header += b" " * (-len(header) % 4)
        block = len(header).to_bytes(4, "little") + header + b"".join(self.data)
        return base64.b64encode(zlib.compress(block, 9)).decode()


def packed(replay: Replay) -> str:
    """Return the simulated rollouts of a run segment; a DataError names an array with too large a number."""
    saved, packer = replay.saved, _Packer()
    facts: dict[str, Any] = {
        "rollouts": saved.rollouts,
        "drivers": list(saved.drivers),
        "failed": {str(number): reason for number, reason in saved.failed.items()},
        "events": [asdict(event) for event in replay.events],
    }
    packer.add("agents", "i16", saved.agents)
    there = saved.there
    packer.states("sim", np.where(there[..., None], saved.state, 0).swapaxes(1, 2))
    packer.add("sim.valid", "u8", there.swapaxes(1, 2))
    packer.add("goal", "i16", saved.goal)
    packer.lines("routes", saved.routes)
    if replay.collision_in is not None:
        seconds = np.nan_to_num(replay.collision_in, nan=FAR).clip(0, FAR)
        packer.add("ttc", "u8", seconds.swapaxes(1, 2), FAR / 255)
    if saved.plan is not None:
        planned = np.isfinite(saved.plan).all(-1)
        packer.add("plan.count", "u8", planned.sum(-1))
        for axis, letter in enumerate("xy"):
            place = np.where(planned, saved.plan[..., axis], 0)
            packer.add(f"plan.{letter}", "i32", place, CENTIMETRE, delta=True)
    if saved.trees is not None:
        facts |= _pack_trees(packer, saved.trees)
    return packer.text(facts)


def packed_log(saved: SavedRollouts) -> str:
    """Return the log of a run segment while it was simulated, its map and its lights; see :func:`packed`."""
    segment, packer, within = saved.segment, _Packer(), slice(saved.start, saved.last + 1)
    facts: dict[str, Any] = {
        "id": segment.segment_id,
        "source": segment.source,
        "dt": float(segment.dt),
        "ego": int(segment.ego),
        "ids": [str(number) for number in segment.agent_id.tolist()],
        "steps": saved.steps,
        "log_end": segment.log_steps - 1 - saved.start,
    }
    heading, velocity = segment.heading[:, within], segment.velocity[:, within]
    speed = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
    place = segment.position[:, within, :2]
    packer.states("log", np.concatenate([place, heading[..., None], speed[..., None]], -1))
    packer.add("log.valid", "u8", segment.valid[:, within])
    packer.add("size", "i16", segment.size[:, :2], CENTIMETRE)
    packer.add("type", "u8", segment.agent_type)
    for axis, letter in enumerate("xy"):
        packer.add(f"lights.{letter}", "i32", segment.signal_point[:, axis], MILLIMETRE)
    packer.add("lights.state", "u8", segment.signal_state[:, within])
    road = segment.road
    packer.lines("lanes", road.lanes)
    packer.add("lanes.width", "i16", road.widths, CENTIMETRE)
    packer.lines("boundary", road.boundary)
    packer.lines("marks", road.marks)
    packer.add("marks.type", "u8", road.mark_type)
    return packer.text(facts)


def _pack_trees(packer: _Packer, trees: SavedTrees) -> dict[str, Any]:
    # Time last, as everywhere in the page.
    packer.states("tree", np.where(trees.there[..., None], trees.state, 0).swapaxes(2, 3))
    packer.add("tree.valid", "u8", trees.there.swapaxes(2, 3))
    packer.add("tree.score", "f32", trees.score.swapaxes(2, 3))
    for name in ("totals", "parents", "slots"):
        packer.add(f"tree.{name}", "f32" if name == "totals" else "i16", getattr(trees, name))
    _, periods, branches = trees.parents.shape
    leaves = trees.slots.shape[-1]
    return {"periods": periods, "branches": branches, "leaves": leaves, "prune_every": trees.prune_every}
