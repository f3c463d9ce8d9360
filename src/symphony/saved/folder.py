"""The folder that saved rollouts lie in: ``docs/formats.md`` describes the format."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType
from typing import Any
from urllib.parse import quote

from safetensors.numpy import save

from symphony.data.store import SegmentStore
from symphony.errors import DataError
from symphony.files import Lock, naming, replacing, write_json
from symphony.saved.rollouts import SavedRollouts
from symphony.saved.tensors import KEY, MAX_LENGTH, read_tensors, tensors_of

FORMAT = 1
MANIFEST, INDEX, SEGMENTS = "manifest.json", "index.jsonl", "segments"
LOCK = "rollouts.lock"
"""Held by who writes."""
LATER = ("weights", "specification", "planner", "planner_seconds")
"""Settings that a manifest has since November 2026."""
_BEGUN = (LOCK, SEGMENTS, INDEX)
"""Names in a folder whose writer died before there was a manifest."""
_LONGEST = 120
"""Letters of a file's name."""
_MANIFEST_KINDS = {"agent": str, "seed": int, "drivers": dict, "settings": dict, "store": dict}
_ENTRY_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("segment", "file", "sha256", "group"), (str,)),
    "rollouts": (int,),
    "dt": (int, float),
    "failed": (str, NoneType),
}


@dataclass(frozen=True)
class About:
    """Facts that all rollouts of a folder have in common.

    Attributes:
        agent: name of what is evaluated.
        seed: of everything drawn at random.
        drivers: who drove whom, such as ``{"interactive": "bc", "others": "playback"}``.
        settings: of the simulation, as JSON can hold them.
        store: ``path`` and ``checksum`` of the run segments.
    """

    agent: str
    seed: int = 0
    drivers: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    store: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, agent: str, store: SegmentStore, settings: Any, *, seed: int = 0, planner: str = "") -> About:
        """The facts of rollouts of one agent beside log playback.

        Args:
            agent: its name.
            store: the run segments.
            settings: a dataclass such as :class:`symphony.config.EvaluateConfig`, or a dictionary.
            seed: of everything drawn at random.
            planner: of the ego, which the agent then does not drive.
        """
        plain = dataclasses.asdict(settings) if dataclasses.is_dataclass(settings) else dict(settings)  # type: ignore[arg-type]
        drivers = {"interactive": agent, "others": "playback"}
        if planner:
            agent, drivers = f"{planner} among {agent}", {"ego": planner, **drivers}
        # As JSON gives it back, so that an equal simulation is seen to be equal.
        plain = json.loads(json.dumps(plain, default=str))
        return cls(agent, seed, drivers, plain, {"path": str(store.path), "checksum": store.checksum()})


@dataclass(frozen=True)
class Entry:
    """One run segment of a folder; ``failed`` says why there are no rollouts of it, and is None else; then ``group``
    is that of the segment, as no file tells.
    """

    segment: str
    rollouts: int
    file: str = ""
    sha256: str = ""
    dt: float = math.nan
    failed: str | None = None
    group: str = ""


class RolloutWriter:
    """Adds segments to a folder of rollouts; each is on record once :meth:`add` returns. One writer at a time.

    A folder that the same simulation was being written to is continued.

    Args:
        path: the folder; made if it isn't there.
        about: what the rollouts have in common.

    Raises:
        DataError: the folder holds something else, or rollouts of another simulation, or another process writes it.
    """

    def __init__(self, path: str | Path, about: About) -> None:
        self.path = Path(path)
        foreign = DataError("not empty and no folder of rollouts: refusing to write into it", file=self.path)
        known = (self.path / MANIFEST, self.path / LOCK)  # with a lock, that of one who has just begun
        if self.path.exists() and any(self.path.iterdir()) and not any(path.exists() for path in known):
            raise foreign
        with naming(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
        self._lock = Lock(self.path / LOCK)
        try:
            manifest = {"format": FORMAT, **dataclasses.asdict(about)}
            changed = list(manifest)
            if (self.path / MANIFEST).exists():
                changed = _differing(manifest, _read_manifest(self.path))
                # One that holds nothing yet is nobody's.
                if changed and (_read_index(self.path) or any((self.path / SEGMENTS).glob("*"))):
                    message = (
                        f"holds the rollouts of another simulation, which differs in {', '.join(changed)}"
                    )
                    at = changed[0].partition(".")[0]
                    raise DataError(message, file=self.path / MANIFEST, field=at)
            elif any(path.name not in _BEGUN for path in self.path.iterdir()):
                raise foreign
            with naming(self.path):
                (self.path / SEGMENTS).mkdir(exist_ok=True)
                with (self.path / INDEX).open("ab+") as file:  # a line that was not finished is cut off
                    file.seek(0)
                    file.truncate(file.read().rfind(b"\n") + 1)
            if changed:
                write_json(self.path / MANIFEST, manifest)
            self._entries = _read_index(self.path)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let others write."""
        self._lock.close()

    def __enter__(self) -> RolloutWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def has(self, segment_id: str) -> bool:
        """Whether the rollouts of that segment are there."""
        return segment_id in self._entries and self._entries[segment_id].failed is None

    def add(self, saved: SavedRollouts) -> None:
        """Write the rollouts of one segment.

        Raises:
            DataError: they break the format, are there already, or the disk refuses.
        """
        name = saved.segment.segment_id
        if self.has(name):
            raise DataError("the rollouts of this segment are there already", file=self.path, segment=name)
        arrays, facts = tensors_of(saved)
        data = save(arrays, {KEY: json.dumps(facts, ensure_ascii=False)})
        file = f"{SEGMENTS}/{file_stem(name)}.safetensors"
        # What can't be read back must not be written.
        read_tensors(data, self.path / file, name)
        with replacing(self.path / file) as draft:
            draft.write_bytes(data)
        digest = hashlib.sha256(data).hexdigest()
        self._record(Entry(name, saved.rollouts, file, digest, saved.segment.dt))

    def fail(self, segment_id: str, rollouts: int, reason: str, group: str = "") -> None:
        """Put on record that a segment could not be simulated; it is tried again when the folder is continued."""
        self._record(Entry(segment_id, rollouts, failed=reason, group=group))

    def _record(self, entry: Entry) -> None:
        self._lock.check()
        path, given = self.path / INDEX, dataclasses.asdict(entry)
        if not entry.group:
            del given["group"]
        if entry.failed is not None:
            del given["dt"]
        with naming(path), path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(given, ensure_ascii=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self._entries[entry.segment] = entry


def _differing(mine: Mapping[str, Any], held: Mapping[str, Any]) -> list[str]:
    """Names of what two manifests differ in; of their settings each."""
    found = [name for name in mine if name != "settings" and mine[name] != held.get(name)]
    now, before = mine["settings"], held.get("settings")
    if not isinstance(before, dict):
        return [*found, "settings"]
    # Folders from before the later settings were kept don't say.
    names = [name for name in dict.fromkeys([*now, *before]) if name not in LATER or name in before]
    return found + [f"settings.{name}" for name in names if now.get(name) != before.get(name)]


class RolloutFolder:
    """Read access to a folder of rollouts: ``folder[i]`` reads and checks that segment only.

    Args:
        path: the folder.

    Raises:
        DataError: no such folder, of another version, or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        manifest = _read_manifest(self.path)
        for name, kind in _MANIFEST_KINDS.items():
            if type(manifest.get(name)) is not kind:
                raise DataError(f"must be {kind.__name__}", file=self.path / MANIFEST, field=name)
        self.about = About(**{name: manifest[name] for name in _MANIFEST_KINDS})
        found = _read_index(self.path).values()
        self.entries = [entry for entry in found if entry.failed is None]
        self.failures = [entry for entry in found if entry.failed is not None]

    def only(self, segments: Iterable[str]) -> RolloutFolder:
        """The folder with some of its segments only."""
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
            message = f"can't be read: {error.strerror or error}"
            raise DataError(message, file=file, segment=segment) from error
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise DataError("damaged: not what was written", file=file, segment=segment, field="sha256")
        saved = read_tensors(data, file, segment)
        if saved.rollouts != entry.rollouts:
            message = f"holds {saved.rollouts} rollouts, the index says {entry.rollouts}"
            raise DataError(message, file=file, segment=segment, field="state")
        return saved

    def __iter__(self) -> Iterator[SavedRollouts]:
        return (self[i] for i in range(len(self)))

    @property
    def ids(self) -> list[str]:
        """Segment ids in the order they were written."""
        return [entry.segment for entry in self.entries]

    def of(self, segment_id: str) -> SavedRollouts:
        """The rollouts of a segment, by its id.

        Raises:
            DataError: there are none.
        """
        if segment_id not in self.ids:
            raise DataError("no rollouts of this segment", file=self.path, segment=segment_id)
        return self[self.ids.index(segment_id)]


def save_rollouts(path: str | Path, about: About, found: Iterable[SavedRollouts]) -> RolloutFolder:
    """Write rollouts to a folder; those of segments that are there already, from a run cut short, are passed over.

    Args:
        path: the folder.
        about: what they have in common.
        found: the rollouts of each segment.

    Raises:
        DataError: as :class:`RolloutWriter`.
    """
    with RolloutWriter(path, about) as writer:
        for saved in found:
            if not writer.has(saved.segment.segment_id):
                writer.add(saved)
    return RolloutFolder(path)


def load_rollouts(path: str | Path) -> RolloutFolder:
    """Open a folder of rollouts; each segment is checked as it is read.

    Raises:
        DataError: as :class:`RolloutFolder`.
    """
    return RolloutFolder(path)


def file_stem(segment_id: str) -> str:
    """A name for files of a segment: safe on any system, another one for every segment."""
    name = quote(segment_id, safe="")
    if len(name) > _LONGEST:
        name = f"{name[: _LONGEST - 17]}-{hashlib.sha256(segment_id.encode()).hexdigest()[:16]}"
    return name


def _read_manifest(path: Path) -> dict[str, Any]:
    file = path / MANIFEST
    if not file.is_file():
        raise DataError(f"no folder of rollouts: it has no {MANIFEST}", file=path)
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(f"not valid JSON ({error})", file=file) from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise DataError(f"of another version, this one reads format {FORMAT}", file=file, field="format")
    return values


def _read_index(path: Path) -> dict[str, Entry]:
    """Entries by segment; a later one takes the place of an earlier one. A line that was cut short is left out."""
    file = path / INDEX
    if not file.is_file():
        raise DataError("is missing", file=file)
    *lines, _ = file.read_text(encoding="utf-8", errors="replace").split("\n")
    found: dict[str, Entry] = {}
    for number, line in enumerate(lines, start=1):
        try:
            entry = Entry(**json.loads(line))
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise DataError(f"line {number} is damaged ({error})", file=file) from error
        for name, kinds in _ENTRY_KINDS.items():
            if type(getattr(entry, name)) not in kinds:
                raise DataError(f"line {number}: of a wrong type", file=file, field=name)
        if not 0 <= entry.rollouts <= MAX_LENGTH:
            raise DataError(f"line {number}: {entry.rollouts} rollouts", file=file, field="rollouts")
        inside = entry.file.startswith(f"{SEGMENTS}/") and entry.file.count("/") == 1
        if entry.failed is None and not (inside and entry.file.isprintable()):
            raise DataError(f"line {number} names no file of this folder", file=file, segment=entry.segment)
        found.pop(entry.segment, None)
        found[entry.segment] = entry
    return found
