"""The folder that saved rollouts lie in: ``docs/formats.md`` describes the format."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from symphony.config.files import from_dict
from symphony.data.segment import Polylines, RoadMap, RunSegment, validate
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.files import Lock, naming, read_object, replacing, write_json
from symphony.saved.rollouts import SavedRollouts, SavedTrees

KEY = "symphony"  # the name of the JSON in the header of a file
MAX_LENGTH = 100_000  # rollouts, steps or agents
# Metres, radians and m/s that a simulated state may have: some times those of a log, as nobody steers it back.
MAX_STATE = {"x": 1e5, "y": 1e5, "heading": 1e4, "speed": 1e3}
_SCALARS: dict[str, type] = dict.fromkeys(("segment_id", "source", "file", "group"), str)
_SCALARS |= {"dt": float, "ego": int, "current_step": int}
# Types (b bool, f float32, i int64), and shapes by letter: K rollouts, N driven agents, T steps, U = T + 1; R trees,
# S branches, P periods, L leaves.
_TYPES = {"b": np.bool_, "f": np.float32, "i": np.int64}
_SHAPES = {"agents": "iN", "state": "fKUN4", "goal": "iKN"}
_SHAPES |= dict.fromkeys(("counted", "collision", "offroad"), "bKTN")
_TREE_SHAPES = {"state": "fRSTN4", "score": "fRSTN", "totals": "fRPS", "parents": "iRPS", "slots": "iRPL"}
_TREE_SHAPES |= dict.fromkeys(("there", "collision", "offroad"), "bRSTN")

FORMAT = 1
MANIFEST, INDEX, SEGMENTS, LOCK = "manifest.json", "index.jsonl", "segments", "rollouts.lock"
_KINDS = {"agent": str, "seed": int, "drivers": dict, "settings": dict, "store": dict}


@dataclass(frozen=True)
class About:
    """Facts that all rollouts of a folder have in common: the name of what is evaluated, the seed, who drove whom,
    such as ``{"interactive": "bc", "others": "playback"}``, settings, and ``path`` and ``checksum`` of the store.
    """

    agent: str
    seed: int = 0
    drivers: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    store: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, agent: str, store: SegmentStore, settings: Mapping[str, Any], *, seed: int = 0, planner: str = ""
    ) -> About:
        """Return the facts of rollouts of one agent beside log playback, and of a planner of the ego, if any."""
        drivers = {"interactive": agent, "others": str(settings.get("others", "log")).replace("log", "playback")}
        if planner:
            agent, drivers = f"{planner} among {agent}", {"ego": planner, **drivers}
        plain = json.loads(json.dumps(settings, default=str))  # as it is read back, to be compared
        return cls(agent, seed, drivers, plain, {"path": str(store.path.resolve()), "checksum": store.checksum()})


@dataclass(frozen=True)
class Entry:
    """One run segment of a folder; ``failed`` says why there are no rollouts of it, with the group of the segment."""

    segment: str
    rollouts: int
    file: str = ""
    sha256: str = ""
    dt: float = math.nan
    failed: str | None = None
    group: str = ""


class RolloutWriter(AbstractContextManager["RolloutWriter"]):
    """Adds segments to a folder of rollouts, each stored once :meth:`add` returns; a DataError if the folder holds
    something else or rollouts of another simulation, or another process writes it.
    """

    def __init__(self, path: str | Path, about: About) -> None:
        self.path = Path(path)
        with naming(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
        there = {name for name in os.listdir(self.path) if not name.startswith(f".{Path(MANIFEST).stem}.")}
        # Of a writer that was killed before there was a manifest its lock is left, or a draft of it.
        if MANIFEST not in there and there and (LOCK not in there or there - {LOCK, SEGMENTS, INDEX}):
            raise DataError("not empty and not a folder of rollouts: refusing to write into it", file=self.path)
        self._lock = Lock(self.path / LOCK)
        self.close = self._lock.close
        try:
            self._begin({"format": FORMAT, **dataclasses.asdict(about)})
        except BaseException:
            self.close()
            raise

    def _begin(self, manifest: dict[str, Any]) -> None:
        file, changed = self.path / MANIFEST, list(manifest)
        if file.exists():
            held = _read_manifest(self.path)
            changed = [name for name in manifest if manifest[name] != held.get(name)]
            if "store" in changed and isinstance(held.get("store"), dict):  # it may have been moved
                changed.remove("store")
                changed += ["store"] * (manifest["store"].get("checksum") != held["store"].get("checksum"))
            if "settings" in changed and isinstance(held.get("settings"), dict):
                now, before = manifest["settings"], held["settings"]
                changed.remove("settings")
                changed += [f"settings.{n}" for n in {**now, **before} if now.get(n) != before.get(n)]
            # An empty folder belongs to no simulation.
            begun = (self.path / INDEX).exists() and _read_index(self.path)
            if changed and (begun or any((self.path / SEGMENTS).glob("*"))):
                message = f"holds the rollouts of another simulation, which differs in {', '.join(changed)}"
                raise DataError(message, file=file, field=changed[0].partition(".")[0])
        if changed:  # first: a folder with others' files and no manifest is refused
            write_json(file, manifest)
        with naming(self.path):
            (self.path / SEGMENTS).mkdir(exist_ok=True)
            with (self.path / INDEX).open("ab+") as index:  # a line that was not finished is cut off
                index.seek(0)
                index.truncate(index.read().rfind(b"\n") + 1)
        self._entries = _read_index(self.path)

    def __exit__(self, *error: object) -> None:
        self.close()

    def has(self, segment_id: str) -> bool:
        """Return whether the rollouts of that segment are in the folder."""
        return segment_id in self._entries and self._entries[segment_id].failed is None

    def add(self, saved: SavedRollouts) -> None:
        """Write the rollouts of one segment; a DataError if they break the format or are there already."""
        name = saved.segment.segment_id
        if self.has(name):
            raise DataError("the rollouts of this segment exist already", file=self.path, segment=name)
        arrays, facts = tensors_of(saved)
        data = save(arrays, {KEY: json.dumps(facts)})
        file = f"{SEGMENTS}/{file_stem(name)}.safetensors"
        read_tensors(data, self.path / file, name)  # or it must not be written
        with replacing(self.path / file) as draft:
            draft.write_bytes(data)
        self._record(Entry(name, saved.rollouts, file, hashlib.sha256(data).hexdigest(), saved.segment.dt))

    def fail(self, segment_id: str, rollouts: int, reason: str, group: str = "") -> None:
        """Record that a segment could not be simulated; it is tried again when the folder is continued."""
        self._record(Entry(segment_id, rollouts, failed=reason, group=group))

    def _record(self, entry: Entry) -> None:
        self._lock.check()
        absent = {"" if entry.group else "group", "" if entry.failed is None else "dt"}
        given = {name: value for name, value in vars(entry).items() if name not in absent}
        path = self.path / INDEX
        with naming(path), path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(given) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self._entries[entry.segment] = entry


class RolloutFolder:
    """Read access to a folder of rollouts: ``folder[i]`` reads that segment only; what is damaged is a DataError."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        manifest = _read_manifest(self.path)
        for name, kind in _KINDS.items():
            if type(manifest.get(name)) is not kind:
                raise DataError(f"must be {kind.__name__}", file=self.path / MANIFEST, field=name)
        self.about = About(**{name: manifest[name] for name in _KINDS})
        found = _read_index(self.path).values()
        self.entries = [entry for entry in found if entry.failed is None]
        self.failures = [entry for entry in found if entry.failed is not None]

    def only(self, segments: Iterable[str]) -> RolloutFolder:
        """Return the folder with some of its segments only."""
        wanted, found = set(segments), copy.copy(self)
        found.entries = [entry for entry in self.entries if entry.segment in wanted]
        found.failures = [entry for entry in self.failures if entry.segment in wanted]
        return found

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> SavedRollouts:
        entry = self.entries[index]
        file, segment = self.path / entry.file, entry.segment
        try:
            data = file.read_bytes()
        except OSError as error:
            raise DataError(f"can't be read: {error.strerror}", file=file, segment=segment) from error
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise DataError("damaged: not what was written", file=file, segment=segment, field="sha256")
        saved = read_tensors(data, file, segment)
        for name, told, held in (("rollouts", entry.rollouts, saved.rollouts), ("dt", entry.dt, saved.segment.dt)):
            if told != held and not math.isnan(told):  # older ones lack dt
                raise DataError(f"is {held:g}, the index says {told:g}", file=file, segment=segment, field=name)
        return saved

    def __iter__(self) -> Iterator[SavedRollouts]:
        return (self[i] for i in range(len(self)))

    @property
    def ids(self) -> list[str]:
        """Segment ids in the order they were written."""
        return [entry.segment for entry in self.entries]

    def of(self, segment_id: str) -> SavedRollouts:
        """Return the rollouts of a segment, by its id; a DataError if there are none."""
        if segment_id not in self.ids:
            raise DataError("no rollouts of this segment", file=self.path, segment=segment_id)
        return self[self.ids.index(segment_id)]


def save_rollouts(path: str | Path, about: About, found: Iterable[SavedRollouts]) -> RolloutFolder:
    """Write rollouts of segments by a :class:`RolloutWriter`; those that exist already are skipped."""
    with RolloutWriter(path, about) as writer:
        for saved in found:
            if not writer.has(saved.segment.segment_id):
                writer.add(saved)
    return RolloutFolder(path)


load_rollouts = RolloutFolder
"""Opens a folder of rollouts; each segment is checked as it is read."""


def file_stem(segment_id: str) -> str:
    """Return a name for files of a segment: safe on any system, and different for every segment."""
    name, digest = quote(segment_id, safe=""), hashlib.sha256(segment_id.encode()).hexdigest()
    return name if len(name) <= 120 else f"{name[:103]}-{digest[:16]}"


def _read_manifest(path: Path) -> dict[str, Any]:
    file = path / MANIFEST
    if not file.is_file():
        raise DataError(f"not a folder of rollouts: it has no {MANIFEST}", file=path)
    values = read_object(file)
    if values.get("format") != FORMAT:
        raise DataError(f"of another version, this one reads format {FORMAT}", file=file, field="format")
    return values


def _read_index(path: Path) -> dict[str, Entry]:
    """Return entries by segment; a later one replaces an earlier one. A line that was cut short is left out."""
    file = path / INDEX
    if not file.is_file():
        raise DataError("is missing", file=file)
    *lines, _ = file.read_text(encoding="utf-8", errors="replace").split("\n")
    found: dict[str, Entry] = {}
    for number, line in enumerate(lines, start=1):
        try:
            entry = from_dict(Entry, json.loads(line))
        except (ConfigError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise DataError(f"line {number} is damaged ({error})", file=file) from error
        folder, _, name = entry.file.partition("/")
        named = entry.failed is not None or (folder == SEGMENTS and "/" not in name and name.isprintable())
        if not named or not 0 <= entry.rollouts <= MAX_LENGTH:
            wrong = f"{entry.rollouts} rollouts" if named else "names no file of this folder"
            raise DataError(f"line {number}: {wrong}", file=file, segment=entry.segment)
        found.pop(entry.segment, None)
        found[entry.segment] = entry
    return found


def tensors_of(saved: SavedRollouts) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return all arrays of a file by name, and what JSON holds beside them."""
    segment, trees = saved.segment, saved.trees
    arrays: dict[str, NDArray[Any]] = {}
    for prefix, part in (("", saved), ("log.", segment), ("road.", segment.road), ("tree.", trees)):
        for item in fields(part) if part is not None else ():
            value, name = getattr(part, item.name), f"{prefix}{item.name}"
            if isinstance(value, Polylines):
                arrays |= {f"{name}.points": value.points, f"{name}.offsets": value.offsets}
            elif isinstance(value, np.ndarray):
                arrays[name] = value
    facts: dict[str, Any] = {name: kind(getattr(segment, name)) for name, kind in _SCALARS.items()}
    facts |= {"start": saved.start, "drivers": list(saved.drivers)}
    facts |= {name: held for name in ("logged", "goal") if (held := getattr(segment, name))}
    facts["failed"] = {str(number): reason for number, reason in saved.failed.items()}
    facts |= {} if trees is None else {"prune_every": int(trees.prune_every)}
    # Only contiguous arrays are written as they are meant.
    return {name: np.ascontiguousarray(value) for name, value in arrays.items()}, facts


def read_tensors(data: bytes, file: Path, segment_id: str) -> SavedRollouts:
    """Return saved rollouts from the bytes of their file; a DataError names the segment and the wrong field."""
    try:
        arrays = load(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])  # after its length as 8 bytes
        saved = _assembled(arrays, json.loads(header["__metadata__"][KEY]))
        _check(saved, segment_id)
        return saved
    except DataError as error:
        raise DataError(error.message, file=file, segment=segment_id, field=error.field) from error
    except KeyError as error:
        raise DataError("is missing", file=file, segment=segment_id, field=error.args[0]) from error
    except (SafetensorError, ValueError, TypeError, RecursionError) as error:
        raise DataError(f"damaged ({error})", file=file, segment=segment_id) from error


def _assembled(arrays: dict[str, NDArray[Any]], facts: dict[str, Any]) -> SavedRollouts:
    kinds = {**_SCALARS, "start": int, "drivers": list, "failed": dict, "logged": int}
    facts = {"logged": 0, "goal": None, **facts}
    for name, kind in (kinds | {"prune_every": int} if "prune_every" in facts else kinds).items():
        if type(facts[name]) is not kind:
            raise DataError(f"is {facts[name]!r:.80}, which is of the wrong type", field=name)
    if not all(re.fullmatch("[0-9]{1,9}", number) for number in facts["failed"]):
        raise DataError("must name rollouts by number", field="failed")
    if not all(isinstance(name, str) for name in facts["drivers"]):
        raise DataError("must be names", field="drivers")

    def built(kind: type[Any], prefix: str, **held: Any) -> Any:
        for item in fields(kind):
            name = f"{prefix}{item.name}"
            if item.type == "Polylines":
                lines = held[item.name] = Polylines(arrays[f"{name}.points"], arrays[f"{name}.offsets"])
                flat = lines.offsets.ndim == 1 and len(lines.offsets) > 0 and lines.points.ndim == 2
                if not flat or lines.offsets.dtype != np.int64:
                    raise DataError("must be points [P, 3] and int64 offsets", field=name)
            elif item.name not in held and item.metadata.get("hashed", True) is True:
                held[item.name] = arrays[name]
        return kind(**held)

    trees = None
    if "prune_every" in facts:
        trees = built(SavedTrees, "tree.", prune_every=facts["prune_every"])
    road, scalars = built(RoadMap, "road."), {name: facts[name] for name in _SCALARS}
    segment = built(RunSegment, "log.", road=road, **scalars).replace(logged=facts["logged"], goal=facts["goal"])
    drivers = tuple(facts["drivers"])
    failed = {int(number): str(reason) for number, reason in facts["failed"].items()}
    held = {"segment": segment, "start": facts["start"], "drivers": drivers, "failed": failed, "trees": trees}
    return built(SavedRollouts, "", **held, plan=arrays.get("plan"))


def _check(saved: SavedRollouts, segment_id: str) -> None:
    segment, trees, routes = validate(saved.segment), saved.trees, saved.routes
    size = {"4": 4}
    for name, shape in _SHAPES.items():
        _check_shape(name, getattr(saved, name), shape, size)
    points, offsets = routes.points, routes.offsets  # differences of damaged ones can overflow
    whole = offsets[0] == 0 and offsets[-1] == len(points) and bool((offsets[1:] >= offsets[:-1]).all())
    outside = f"steps {saved.start} to {saved.last} are outside the {segment.num_steps} of the log"
    demanded = [
        ("segment_id", segment.segment_id == segment_id, f"is of segment {segment.segment_id}"),
        ("state", size["U"] == size["T"] + 1, f"{size['U']} states for {size['T']} steps"),
        ("agents", len(np.unique(saved.agents)) == len(saved.agents), "names an agent twice"),
        ("agents", _inside(saved.agents, 0, segment.num_agents), "is outside the agents of the log"),
        ("routes", whole, "offsets do not match the points"),
        ("routes", points.dtype == np.float32 and points.shape[1:] == (3,), "must be float32 [P, 3]"),
        ("routes", bool(np.isfinite(points).all()), "holds numbers that are not finite"),
        ("goal", _inside(saved.goal, -1, len(routes)), f"outside the {len(routes)} routes"),
        ("start", saved.start >= 0 and saved.last < segment.num_steps, outside),
        ("drivers", len(saved.drivers) == size["N"], f"{len(saved.drivers)} for {size['N']} agents"),
        ("failed", all(k < size["K"] for k in saved.failed), f"names a rollout outside the {size['K']}"),
    ]
    states = {"state": saved.state[saved.there]} if all(good for _, good, _ in demanded) else {}
    if saved.plan is not None:
        _check_shape("plan", saved.plan, "fKPTH2", {name: size[name] for name in "KT"} | {"2": 2})
        few = saved.plan.shape[1] <= size["N"]
        demanded += [("plan", few, f"{saved.plan.shape[1]} planners for {size['N']} agents")]
        states["plan"] = saved.plan[~np.isnan(saved.plan).any(-1)]
    if trees is not None:
        for name, shape in _TREE_SHAPES.items():
            _check_shape(f"tree.{name}", getattr(trees, name), shape, size)
        every, slots = trees.prune_every, f"outside the {size['S']} branches"
        periods = f"{size['P']} periods of {every} for {size['T']} steps"
        leaves = f"{size['R']} trees of {size['L']} leaves are not {size['K']} rollouts"
        demanded += [
            ("tree.prune_every", every > 0 and size["P"] == -(-size["T"] // max(every, 1)), periods),
            ("tree.slots", size["R"] * size["L"] == size["K"], leaves),
            ("tree.parents", _inside(trees.parents, 0, size["S"]), slots),
            ("tree.slots", _inside(trees.slots, 0, size["S"]), slots),
            ("tree.score", not np.isinf(trees.score).any(), "holds an infinite number"),
        ]
        states["tree.state"] = trees.state[trees.there]
    for name, good, message in demanded:
        if not good:
            raise DataError(message, field=name)
    for name, values in states.items():
        if not np.isfinite(values).all():
            raise DataError("holds numbers that are not finite", field=name)
        far = np.abs(values).max(0, initial=0)
        for (what, bound), found in zip(MAX_STATE.items(), far.tolist(), strict=False):
            if found > bound:
                raise DataError(f"a {what} of {found:.4g}, at most {bound:g} is plausible", field=name)


def _check_shape(name: str, value: NDArray[Any], wanted: str, size: dict[str, int]) -> None:
    """Check type and shape; a letter that is new takes the size it meets."""
    dtype, letters, shape, message = np.dtype(_TYPES[wanted[0]]), wanted[1:], list(value.shape), ""
    if value.dtype != dtype:
        message = f"dtype {value.dtype}, expected {dtype}"
    elif len(shape) != len(letters) or max(shape) > MAX_LENGTH:  # arrays without elements have any shape
        message = f"shape {shape}, expected {len(letters)} dimensions of at most {MAX_LENGTH}"
    elif wrong := [(n, size[k]) for k, n in zip(letters, shape, strict=True) if size.setdefault(k, n) != n]:
        message = f"shape {shape}: {wrong[0][0]} where {wrong[0][1]} is expected"
    if message:
        raise DataError(message, field=name)


def _inside(values: NDArray[Any], low: int, high: int) -> bool:
    return not values.size or (values.min() >= low and values.max() < high)
