"""What is fuzzed: good files, how they are changed, and what is done with the result.

A reader is one entry of :data:`TARGETS`: :func:`reader` with its good files; their suffixes say how they are changed.
"""

from __future__ import annotations

import copy
import functools
import hashlib
import io
import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import fuzz_mutations as change
import fuzz_results
from fuzz_base import ABSURD, ACCEPTED, FOREIGN, REFUSED, Files, Rng, Target, one_in, written
from symphony.data.segment import RunSegment

USED = 12
"""One in so many good segments is used, which takes far more time than reading it."""
SHORT = range(30)
"""Steps of the recordings that are changed."""


def reader(name: str, good: Callable[[], Files], **mutations: Callable[[Rng, bytes], bytes]) -> Target:
    """A log format; files whose suffix has no mutation of its own are changed as bytes.

    Args:
        name: of the format.
        good: its files, the log first.
        mutations: by suffix, besides those of :data:`BY_SUFFIX`.
    """
    ways = {**BY_SUFFIX, **mutations}

    def mutate(rng: Rng, files: Files) -> Files:
        which = {change.pick(rng, list(files)) for _ in range(1 + (rng.random() < 0.2))}
        return {
            k: ways.get(k.rpartition(".")[2], change.bytes_)(rng, v) if k in which else v
            for k, v in files.items()
        }

    return Target(functools.cache(good), mutate, functools.partial(_read, name))


def _read(name: str, folder: Path, file: str) -> tuple[str, str]:
    from symphony.data.sources import get_reader
    from symphony.data.sources.base import UnexpectedError

    refused, good = False, []
    for item in get_reader(name).read(folder / file):
        if isinstance(item, UnexpectedError):
            return FOREIGN, item.message
        if isinstance(item, RunSegment):
            good.append(item)
            if absurd(item):
                return ABSURD, absurd(item)
        else:
            refused = True
    if good and one_in(USED, folder):
        _use(good[0], folder)
    return (REFUSED if refused else ACCEPTED), ""


def absurd(s: RunSegment) -> str:
    """What no run segment may have that is taken for a good one, said independently of the schema's own check."""
    seen = s.valid
    road = np.concatenate([lines.points for lines in (s.road.lanes, s.road.boundary, s.road.marks)])
    way = np.linalg.norm(np.diff(s.position[..., :2].astype(float), axis=1), axis=-1)
    jumps = way[seen[:, 1:] & seen[:, :-1]]
    numbers = (s.position, s.heading, s.velocity, s.size, road, s.origin, s.signal_point)
    found = {
        "a number that is not finite": not all(np.isfinite(each).all() for each in numbers),
        "a place over 30 km away": max(np.abs(s.position).max(), np.abs(road).max(initial=0)) > 3e4,
        "a speed over 400 m/s": np.abs(s.velocity).max() > 400,
        "a jump over 1.1 km": jumps.max(initial=0) > 1100,
        "a box of no size": bool((s.size[:, :2] < 0.01).any() or (s.size > 150).any()),
        "a heading of 10^4": np.abs(s.heading).max() > 1e4,
        "a time step": not 1e-3 < s.dt < 10,
        "more than the memory can hold": seen.size > 3e6 or len(road) > 2e6,
        "a name that can't be printed": not (s.segment_id + s.source + s.file).isprintable(),
    }
    return ", ".join(what for what, applies in found.items() if applies)


def _use(segment: RunSegment, folder: Path) -> None:
    """What becomes of a good segment: resampled, chosen from, stored, read, and made a scene with routes."""
    from symphony.data.parts import Preparation
    from symphony.data.sources import get_reader
    from symphony.data.sources.base import UnexpectedError
    from symphony.data.store import SegmentStore
    from symphony.data.store_writer import StoreWriter
    from symphony.errors import DataError
    from symphony.learning.demonstrations import SceneDataset

    recipe = Preparation(get_reader("commonroad"), 0.2, 0.3, 1)
    prepared = recipe._prepared(segment, "a")
    if not isinstance(prepared, RunSegment):
        if f"{UnexpectedError.__name__}" in prepared.message or "can't be read:" in prepared.message:
            raise RuntimeError(prepared.message)
        return
    with tempfile.TemporaryDirectory(dir=folder) as place:
        with StoreWriter(Path(place) / "store") as writer:
            writer.append(prepared)
        dataset = SceneDataset(SegmentStore(Path(place) / "store"), 1, routes=True)
        try:
            dataset.scene(0)
            dataset.experts(0)
        except DataError:
            return


# Good files


def _womd() -> Files:
    from helpers_sources import womd_scenario
    from symphony.data.sources.tfrecord import write_records

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        scenarios = [womd_scenario(f"{k:016x}", tracks=2 + k, steps=11) for k in range(2)]
        write_records(path, [scenario.SerializeToString() for scenario in scenarios])
        return {"a.tfrecord": path.read_bytes()}


def _records(rng: Rng, data: bytes) -> bytes:
    """A message changed, or its bytes; the checksums are right again, but for one time in ten."""
    from symphony.data.sources import womd_pb2 as pb
    from symphony.data.sources.tfrecord import write_records

    if rng.random() < 0.1:
        return change.bytes_(rng, data)
    payloads = list(_payloads(data))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        which = int(rng.integers(len(payloads)))
        if rng.random() < 0.25:
            payloads[which] = change.bytes_(rng, payloads[which])
        else:
            record = pb.Scenario.FromString(payloads[which])
            change.message(rng, record)
            payloads[which] = record.SerializeToString()
        if rng.random() < 0.75:  # alone, which takes half of the time
            payloads = payloads[which : which + 1]
        write_records(path, payloads)
        return path.read_bytes()


@functools.cache
def _payloads(data: bytes) -> tuple[bytes, ...]:
    from symphony.data.sources.tfrecord import read_records

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(data)
        return tuple(each for each in read_records(path) if isinstance(each, bytes))


def _commonroad() -> Files:
    from helpers_sources import ROAD, commonroad, driver, obstacle, state

    lights = (
        '<trafficLight id="30"><cycle><cycleElement><duration>3</duration><color>red</color></cycleElement>'
        "<cycleElement><duration>5</duration><color>green</color></cycleElement><timeOffset>1</timeOffset></cycle>"
        "<direction>all</direction></trafficLight>"
    )
    road = ROAD.replace('<successor ref="11"/>', '<successor ref="11"/><trafficLightRef ref="30"/>')
    polygon = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in ((0, 0), (2, 0), (2, 1)))
    parked = obstacle(9, [state(0, 30, 5)], role="static", shape=f"<polygon>{polygon}</polygon>")
    text = commonroad(road, driver(7), driver(8, x=20), parked, lights)
    return {"a.xml": text.encode()}


def _argoverse2() -> Files:
    import helpers_argoverse2 as helpers

    with tempfile.TemporaryDirectory() as folder:
        path = helpers.write(Path(folder))
        city = path.with_name(f"log_map_archive_{helpers.NAME}.json")
        return {path.name: path.read_bytes(), city.name: city.read_bytes()}


def _interaction(folder: Path) -> Path:
    from helpers_interaction import public, walker, with_area

    path = public(folder, _cars(), walkers=walker("P1", steps=SHORT))
    next(folder.glob("maps/*")).write_text(with_area())
    return path


def _test_area(folder: Path) -> Path:
    from helpers_interaction import taf

    return taf(folder, rows=_cars())


def _cars() -> list[str]:
    from helpers_interaction import track

    return [
        *track(3, steps=SHORT),
        *track(5, x=-10, y=6, speed=9, steps=SHORT),
        *track(9, x=20, speed=0)[:20],
    ]


def _scenarionet(folder: Path) -> Path:
    from helpers_scenarionet import write

    return write(folder)


def _parquet(rng: Rng, data: bytes) -> bytes:
    """Values, rows, columns or types changed; at times the bytes."""
    import pyarrow as pa
    from pyarrow import parquet

    if rng.random() < 0.2:
        return change.bytes_(rng, data)
    columns = dict(_columns(data))
    for _ in range(int(rng.integers(1, 4))):
        name = change.pick(rng, list(columns))
        values = list(columns[name])
        way = rng.random()
        if way < 0.05:
            del columns[name]
            continue
        if way < 0.15:
            values = [change.leaf(rng, values[0])] * len(values)
        elif way < 0.25:
            at = int(rng.integers(len(values)))
            rows = [at] * int(rng.integers(1, 40))
            columns = {key: [*column, *(column[k] for k in rows)] for key, column in columns.items()}
            continue
        else:
            for _ in range(int(rng.integers(1, 4))):
                at = int(rng.integers(len(values)))
                values[at] = change.leaf(rng, values[at])
        columns[name] = values
    buffer = io.BytesIO()
    try:
        parquet.write_table(pa.table(columns), buffer)
    except (pa.ArrowException, ValueError, TypeError, OverflowError, AttributeError):
        return change.bytes_(rng, data)  # nobody could write that
    return buffer.getvalue()


@functools.cache
def _columns(data: bytes) -> dict[str, list[Any]]:
    import pyarrow as pa
    from pyarrow import parquet

    return parquet.read_table(pa.BufferReader(data)).to_pydict()


BY_SUFFIX: Mapping[str, Callable[[Rng, bytes], bytes]] = {
    "tfrecord": _records,
    "xml": change.xml,
    "json": change.json_,
    "parquet": _parquet,
    "csv": change.csv,
    "osm": change.xml,
    "osm_xy": change.xml,
    "kml": change.xml,
    "pkl": change.pickle_,
}


# Stores, checkpoints and configurations


def _store() -> Files:
    from helpers_segments import crossing, straight_road
    from symphony.data.store_writer import StoreWriter

    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "store"
        with StoreWriter(place) as writer:
            writer.append(crossing(seed=1, steps=11), tags={"kind": "crossing"})
            writer.append(straight_road(seed=2, steps=11))
            writer.write_report({"converted": 2, "files": 1, "skipped": [], "settings": {}})
        return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(place.rglob("*")) if p.is_file()}


def _change_store(rng: Rng, files: Files) -> Files:
    """Some file changed; half of the time the hashes in the index are those of the changed content."""
    sized = [name for name, data in files.items() if data]
    name = change.pick(rng, sized)
    way = BY_SUFFIX["json"] if name.endswith(".json") else change.bytes_
    changed = {**files, name: way(rng, files[name])}
    return {**changed, "rehash": b""} if rng.random() < 0.5 else changed


def _read_store(folder: Path, _: str) -> tuple[str, str]:
    from symphony.data.convert import info
    from symphony.data.selection import choices
    from symphony.data.store import SegmentStore
    from symphony.errors import DataError

    place = folder / "store"
    try:
        if (folder / "rehash").exists():
            _rehash(place)
        store = SegmentStore(place)
        for k, segment in enumerate(store):
            wrong = absurd(segment)
            if wrong:
                return ABSURD, wrong
            store.tags(k)
        info(place)
        choices(store, 2)
        store.verify()
        if one_in(USED // 4, folder):
            _use(store[0], folder)
    except DataError:
        return REFUSED, ""
    return ACCEPTED, ""


def _rehash(place: Path) -> None:
    from symphony.data.segment import content_hash
    from symphony.data.store import SegmentStore
    from symphony.data.store_format import SEGMENTS

    store = SegmentStore(place)
    records = np.fromfile(SEGMENTS.index_path(place), SEGMENTS.record, len(store))
    for k in range(len(store)):
        records[k]["hash"] = np.frombuffer(bytes.fromhex(content_hash(store._read(k))), np.uint8)
    SEGMENTS.index_path(place).write_bytes(records.tobytes())


def _networks() -> dict[str, Any]:
    import torch

    with torch.random.fork_rng():
        torch.manual_seed(0)
        module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 2))
    optimizer = torch.optim.AdamW(module.parameters(), lr=0.1)
    module(torch.ones(4, 3)).sum().backward()
    optimizer.step()
    return {"modules": {"policy": module}, "optimizers": {"policy": optimizer}}


@functools.cache
def _kept() -> tuple[dict[str, Any], dict[str, Any]]:
    own = _networks()
    states = {name: each["policy"].state_dict() for name, each in own.items()}
    return own, copy.deepcopy(states)


def _networks_as_new() -> dict[str, Any]:
    """The same ones each time, in the state of new ones: making them takes longer than reading a file."""
    own, states = _kept()
    for name, state in states.items():
        own[name]["policy"].load_state_dict(copy.deepcopy(state))
    own["optimizers"]["policy"].zero_grad()
    return own


def _checkpoint() -> Files:
    from symphony.agents.checkpoint import MANIFEST, save_checkpoint

    extra = {
        "best": {"step": 3, "infractions": 1.5},
        "skips": {"total": 1, "in_row": {"policy": 0}},
        "processes": 1,
    }
    with tempfile.TemporaryDirectory() as folder:
        place = save_checkpoint(Path(folder), step=5, **_networks(), extra=extra)
        # As earlier versions wrote it: a checksum of its own would let no change get any farther.
        manifest = json.loads((place / MANIFEST).read_bytes())
        del manifest["sha256"]
        (place / MANIFEST).write_text(json.dumps(manifest))
        return {f"{place.name}/{p.name}": p.read_bytes() for p in sorted(place.iterdir())}


def _change_checkpoint(rng: Rng, files: Files) -> Files:
    """The manifest changed, or tensors with checksums that are right again."""
    manifest = next(name for name in files if name.endswith(".json"))
    if rng.random() < 0.7:
        return {**files, manifest: change.json_(rng, files[manifest])}
    name = change.pick(rng, [name for name in files if name != manifest])
    data = change.bytes_(rng, files[name])
    held = json.loads(files[manifest])
    if rng.random() < 0.8:
        part = Path(name).name.removesuffix(".safetensors")
        held["parts"][part]["sha256"] = hashlib.sha256(data).hexdigest()
    return {**files, name: data, manifest: json.dumps(held).encode()}


def _load_checkpoint(folder: Path, _: str) -> tuple[str, str]:
    from symphony.agents.checkpoint import checkpoints, load_checkpoint
    from symphony.agents.choice import Best
    from symphony.errors import DataError

    own = _networks_as_new()
    try:
        for place in checkpoints(folder):
            # As of a stranger's agent: what a run goes on from is its own.
            loaded = load_checkpoint(place, modules=own["modules"], partial=True, restore_rng=False)
            Best.of(loaded.extra)
    except DataError:
        return REFUSED, ""
    import torch

    if not all(bool(torch.isfinite(each).all()) for each in own["modules"]["policy"].state_dict().values()):
        return ABSURD, "a weight that is not finite"
    return ACCEPTED, ""


def _configuration() -> Files:
    from symphony.config import AgentSpec, DiscriminatorConfig, TrainConfig, to_json

    run = TrainConfig(method="mgail_ts_h", data=Path("data"), out=Path("out"))
    spec = AgentSpec(action_space="bicycle", dt=0.2, discriminator=DiscriminatorConfig(), searches=True)
    return {"config.json": to_json(run).encode(), "agent.json": to_json(spec).encode()}


def _change_one(rng: Rng, files: Files) -> Files:
    name = change.pick(rng, list(files))
    return {**files, name: change.json_(rng, files[name])}


def _read_configuration(folder: Path, _: str) -> tuple[str, str]:
    from symphony.config import AgentSpec, TrainConfig, read_json, to_json
    from symphony.errors import ConfigError

    try:
        for kind, name in ((TrainConfig, "config.json"), (AgentSpec, "agent.json")):
            to_json(read_json(kind, folder / name))
    except ConfigError:
        return REFUSED, ""
    return ACCEPTED, ""


TARGETS: dict[str, Target] = {
    "womd": reader("womd", _womd),
    "commonroad": reader("commonroad", _commonroad),
    "argoverse2": reader("argoverse2", _argoverse2),
    "interaction": reader("interaction", written(_interaction)),
    "test_area": reader("interaction", written(_test_area)),
    "scenarionet": reader("scenarionet", written(_scenarionet)),
    "store": Target(functools.cache(_store), _change_store, _read_store),
    "checkpoint": Target(functools.cache(_checkpoint), _change_checkpoint, _load_checkpoint),
    "configuration": Target(functools.cache(_configuration), _change_one, _read_configuration),
    "submission": fuzz_results.submission(_records),
    "rollouts": fuzz_results.saved_rollouts(),
}
