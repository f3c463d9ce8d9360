"""The targets of the fuzzing: good files, how they are changed, and what is done with the result.

A reader is one entry of :data:`TARGETS`: :func:`reader` with its good files; their suffixes say how they are changed.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
import io
import json
import tarfile
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load, save

import fuzz_mutations as change
from fuzz_mutations import ABSURD, ACCEPTED, FOREIGN, REFUSED, Files, Rng, Target, one_in, written
from helpers_interaction import public, taf, track, walker, with_area
from helpers_saved import played, random_trees
from helpers_scenarionet import write as scenarionet
from helpers_segments import crossing, straight_road
from helpers_sources import ROAD, commonroad, driver, obstacle, state, womd_scenario, write_records
from helpers_store import rehash
from helpers_wosac import META, record_rollouts, womd_record
from symphony.agents.checkpoint import MANIFEST, checkpoints, load_checkpoint, save_checkpoint
from symphony.agents.choice import Best
from symphony.cli.rollouts import write_view
from symphony.data.convert import Preparation, info
from symphony.data.segment import RunSegment
from symphony.data.selection import choices
from symphony.data.sources import get_reader, womd_pb2
from symphony.data.sources.base import UnexpectedError
from symphony.data.sources.womd import read_records
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError
from symphony.evaluation.report import report
from symphony.learning.demonstrations import SceneDataset
from symphony.saved import folder as saved_folder
from symphony.saved.folder import About, RolloutWriter, load_rollouts
from symphony.wosac import wosac_pb2 as pb
from symphony.wosac.submission import check_submission, required_agents, write_submission

USED, REPORTED = 12, 4
"""One in so many good segments is used, and saved rollouts reported: it takes far longer."""
SHORT = range(30)  # steps of the recordings that are changed
NAMES = ("aaaa", "bbbb")
BOMB = 32 << 20  # bytes of zeros in a member of an archive, at times


def reader(name: str, good: Callable[[Path], Path]) -> Target:
    """A log format and what writes its files."""
    return Target(written(good), _change_some, functools.partial(_read, name))


def _change_some(rng: Rng, files: Files) -> Files:
    """One or two files changed; those whose suffix has no mutation of its own as bytes."""
    which = {change.pick(rng, list(files)) for _ in range(1 + (rng.random() < 0.2))}
    ways = {name: BY_SUFFIX.get(name.rpartition(".")[2], change.bytes_) for name in files}
    return {name: ways[name](rng, data) if name in which else data for name, data in files.items()}


def _read(name: str, folder: Path, file: str) -> tuple[str, str]:
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
    """Return what no valid run segment may have, said independently of the schema's own check."""
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
    """Use a good segment: it is resampled, chosen from, stored, read, and made a scene with routes."""
    prepared = Preparation(get_reader("commonroad"), 0.2, 0.3, 1)._prepared(segment, "a")
    if not isinstance(prepared, RunSegment):
        if "can't be read:" in prepared.message:
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


def _womd(folder: Path) -> Path:
    scenarios = [womd_scenario(f"{k:016x}", tracks=2 + k, steps=11) for k in range(2)]
    write_records(folder / "a.tfrecord", [scenario.SerializeToString() for scenario in scenarios])
    return folder / "a.tfrecord"


def _records(rng: Rng, data: bytes) -> bytes:
    """A message changed, or its bytes; the checksums are right again, but for one time in ten."""
    if rng.random() < 0.1:
        return change.bytes_(rng, data)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(data)
        payloads = [each for each in read_records(path) if isinstance(each, bytes)]
        which = int(rng.integers(len(payloads)))
        if rng.random() < 0.25:
            payloads[which] = change.bytes_(rng, payloads[which])
        else:
            record = womd_pb2.Scenario.FromString(payloads[which])
            change.message(rng, record)
            payloads[which] = record.SerializeToString()
        if rng.random() < 0.75:  # alone, which takes half of the time
            payloads = payloads[which : which + 1]
        write_records(path, payloads)
        return path.read_bytes()


def _commonroad(folder: Path) -> Path:
    lights = (
        '<trafficLight id="30"><cycle><cycleElement><duration>3</duration><color>red</color></cycleElement>'
        "<cycleElement><duration>5</duration><color>green</color></cycleElement><timeOffset>1</timeOffset></cycle>"
        "<direction>all</direction></trafficLight>"
    )
    road = ROAD.replace('<successor ref="11"/>', '<successor ref="11"/><trafficLightRef ref="30"/>')
    polygon = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in ((0, 0), (2, 0), (2, 1)))
    parked = obstacle(9, [state(0, 30, 5)], role="static", shape=f"<polygon>{polygon}</polygon>")
    (folder / "a.xml").write_text(commonroad(road, driver(7), driver(8, x=20), parked, lights))
    return folder / "a.xml"


def _argoverse2(folder: Path) -> Path:
    import helpers_argoverse2

    return helpers_argoverse2.write(folder)


def _interaction(folder: Path) -> Path:
    path = public(folder, _cars(), walkers=walker("P1", steps=SHORT))
    next(folder.glob("maps/*")).write_text(with_area())
    return path


def _cars() -> list[str]:
    slow, stands = track(5, x=-10, y=6, speed=9, steps=SHORT), track(9, x=20, speed=0)[:20]
    return [*track(3, steps=SHORT), *slow, *stands]


def _parquet(rng: Rng, data: bytes) -> bytes:
    """Values, rows, columns or types changed; at times the bytes."""
    import pyarrow as pa
    from pyarrow import parquet

    if rng.random() < 0.2:
        return change.bytes_(rng, data)
    columns: dict[str, list[Any]] = parquet.read_table(pa.BufferReader(data)).to_pydict()
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


BY_SUFFIX: Mapping[str, Callable[[Rng, bytes], bytes]] = {
    **{"tfrecord": _records, "json": change.json_, "parquet": _parquet, "csv": change.csv},
    **{"xml": change.xml, "osm": change.xml, "osm_xy": change.xml, "kml": change.xml, "pkl": change.pickle_},
}


def _store(folder: Path) -> Path:
    with StoreWriter(folder / "store") as writer:
        writer.append(crossing(seed=1, steps=11), tags={"kind": "crossing"})
        writer.append(straight_road(seed=2, steps=11))
        writer.write_report({"converted": 2, "files": 1, "skipped": [], "settings": {}})
    return folder / "store" / "store.json"


def _change_store(rng: Rng, files: Files) -> Files:
    """Some file changed; half of the time the hashes in the index are those of the changed content."""
    name = change.pick(rng, [name for name, data in files.items() if data])
    way = change.json_ if name.endswith(".json") else change.bytes_
    changed = {**files, name: way(rng, files[name])}
    return {**changed, "rehash": b""} if rng.random() < 0.5 else changed


def _read_store(folder: Path, file: str) -> tuple[str, str]:
    place = (folder / file).parent
    try:
        store = SegmentStore(place)
        if (folder / "rehash").exists():
            rehash(place)
            store = SegmentStore(place)
        for segment in store:
            if wrong := absurd(segment):
                return ABSURD, wrong
        info(place)
        choices(store, 2)
        store.verify()
        if one_in(USED // 4, folder):
            _use(store[0], folder)
    except DataError:
        return REFUSED, ""
    return ACCEPTED, ""


def _networks() -> dict[str, Any]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 2))
    optimizer = torch.optim.AdamW(module.parameters(), lr=0.1)
    module(torch.ones(4, 3)).sum().backward()
    optimizer.step()
    return {"modules": {"policy": module}, "optimizers": {"policy": optimizer}}


def _checkpoint(folder: Path) -> Path:
    best = {"step": 3, "infractions": 1.5}
    extra = {"best": best, "skips": {"total": 1, "in_row": {"policy": 0}}, "processes": 1}
    place = save_checkpoint(folder, step=5, **_networks(), extra=extra)
    # As earlier versions wrote it: a checksum of its own would let no change get any farther.
    manifest = json.loads((place / MANIFEST).read_bytes())
    del manifest["sha256"]
    (place / MANIFEST).write_text(json.dumps(manifest))
    return place / MANIFEST


def _change_checkpoint(rng: Rng, files: Files) -> Files:
    """The manifest changed, or tensors with checksums that are right again."""
    manifest = next(iter(files))
    if rng.random() < 0.7:
        return {**files, manifest: change.json_(rng, files[manifest])}
    name = change.pick(rng, [name for name in files if name != manifest])
    data = change.bytes_(rng, files[name])
    held = json.loads(files[manifest])
    if rng.random() < 0.8:
        held["parts"][Path(name).stem]["sha256"] = hashlib.sha256(data).hexdigest()
    return {**files, name: data, manifest: json.dumps(held).encode()}


def _load_checkpoint(folder: Path, _: str) -> tuple[str, str]:
    own = _networks()["modules"]
    try:
        for place in checkpoints(folder):
            # As of a stranger's agent: what a run goes on from is its own.
            Best.of(load_checkpoint(place, modules=own, partial=True, restore_rng=False).extra)
    except DataError:
        return REFUSED, ""
    if not all(bool(torch.isfinite(each).all()) for each in own["policy"].state_dict().values()):
        return ABSURD, "a weight that is not finite"
    return ACCEPTED, ""


def _submission(folder: Path) -> Path:
    scenarios = [womd_record(name, tracks=2 - k) for k, name in enumerate(NAMES)]
    write_records(folder / "a.tfrecord", [each.SerializeToString() for each in scenarios])
    rollouts = [(each.scenario_id, record_rollouts(each)) for each in scenarios]
    write_submission(rollouts, META, folder / "a.tar.gz", shards=2)
    return folder / "a.tar.gz"


def _change_submission(rng: Rng, files: Files) -> Files:
    if rng.random() < 0.15:
        return {**files, "a.tfrecord": _records(rng, files["a.tfrecord"])}
    return {**files, "a.tar.gz": _change_archive(rng, files["a.tar.gz"])}


def _change_archive(rng: Rng, data: bytes) -> bytes:
    """Fields of a shard's message, its bytes, the members' names, the archive's bytes, or those of all of it."""
    way = rng.random()
    if way < 0.1:
        return change.bytes_(rng, data)
    plain = gzip.decompress(data)
    if way < 0.25:
        return gzip.compress(change.bytes_(rng, plain), 0, mtime=0)
    members = _members(io.BytesIO(plain))
    which = int(rng.integers(len(members)))
    name, content = members[which]
    if way < 0.75:
        message = pb.SimAgentsChallengeSubmission.FromString(content)
        change.message(rng, message)
        members[which] = name, message.SerializeToString()
    elif way < 0.88:
        members[which] = name, change.bytes_(rng, content)
    elif way < 0.998:
        others = (*change.TEXTS, "../" + name, "./" + name, name.replace("2", "99999"), name + "0")
        members[which] = change.pick(rng, others) or "x", content
        if rng.random() < 0.3:
            members.append((name, content))
    else:
        members.append((name, b"\0" * BOMB))
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for name, content in members:
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return gzip.compress(out.getvalue(), int(out.tell() >= BOMB), mtime=0)


def _members(file: Any) -> list[tuple[str, bytes]]:
    with tarfile.open(fileobj=file) as archive:
        return [(each.name, archive.extractfile(each).read()) for each in archive if each.isfile()]  # type: ignore[union-attr]


def _check_submission(folder: Path, file: str) -> tuple[str, str]:
    try:
        required = required_agents(folder / "a.tfrecord")
    except DataError:
        return REFUSED, ""
    problems = check_submission(folder / file, required).problems
    if problems:
        return REFUSED, str(problems)[:0]
    wrong = _unfit(folder / file, {name: set(agents) for name, agents in required.items()})
    return (ABSURD, wrong) if wrong else (ACCEPTED, "")


def _unfit(file: Path, required: dict[str, set[int]]) -> str:
    """Return what a server would refuse in a submission, said independently of the check."""
    shards = [content for _, content in _members(io.BytesIO(gzip.decompress(file.read_bytes())))]
    parsed = [pb.SimAgentsChallengeSubmission.FromString(content) for content in shards]
    found = {each.scenario_id: each for shard in parsed for each in shard.scenario_rollouts}
    if found.keys() != required.keys():
        return "other scenarios than are asked for"
    for name, scenario in found.items():
        for scene in scenario.joint_scenes:
            if sorted(t.object_id for t in scene.simulated_trajectories) != sorted(required[name]):
                return "other agents than are asked for"
            for t in scene.simulated_trajectories:
                numbers = np.array([t.center_x, t.center_y, t.center_z, t.heading], np.float64)
                if numbers.shape != (4, 80) or not np.isfinite(numbers).all():
                    return "a trajectory that is not 80 finite numbers"
    return "" if all(len(each.joint_scenes) == 32 for each in found.values()) else "not 32 rollouts"


# Saved rollouts: the folder itself, the report, and the page that plays them


def _rollouts(folder: Path) -> Path:
    about = About("made", 3, {"interactive": "a"}, {"rollouts": 2}, {"checksum": "ab"})
    writer = RolloutWriter(folder / "saved", about)
    for segment in (crossing(3, steps=7), straight_road(3, steps=6)):
        saved = played(segment, (0, 2), 2)
        writer.add(played(segment, (0, 2), 2, trees=random_trees(saved), failed={1: "made"}))
    writer.fail("another", 2, "no routes")
    return writer.path / saved_folder.MANIFEST


def _change_rollouts(rng: Rng, files: Files) -> Files:
    """Some file changed; the checksums in the index are right again, but for one time in five."""
    name = change.pick(rng, list(files))
    ways = {"json": change.json_, "jsonl": _lines, "safetensors": _tensors}
    changed = {**files, name: ways[name.rpartition(".")[2]](rng, files[name])}
    if name.endswith(".safetensors") and rng.random() < 0.8:
        index = next(each for each in files if each.endswith(".jsonl"))
        old, new = (hashlib.sha256(each[name]).hexdigest().encode() for each in (files, changed))
        changed[index] = files[index].replace(old, new)
    return changed


def _lines(rng: Rng, data: bytes) -> bytes:
    """Lines of JSON, some of them changed, gone, repeated or moved; at times as bytes."""
    lines = data.splitlines()
    at, way = int(rng.integers(len(lines))), rng.random()
    if way < 0.15:
        return change.bytes_(rng, data)
    if way < 0.2:
        del lines[at]
    elif way < 0.3:
        lines.append(lines[at])
    else:
        lines[at] = change.json_(rng, lines[at])
    return b"".join(line + b"\n" for line in lines)


def _tensors(rng: Rng, data: bytes) -> bytes:
    """Arrays or facts changed; at times the header, which says of what kind they are, or all as bytes."""
    size = int.from_bytes(data[:8], "little")
    header, way = json.loads(data[8 : 8 + size]), rng.random()
    if way < 0.15:
        return change.bytes_(rng, data)
    if way < 0.35:
        text = json.dumps(change.tree(rng, header)).encode("utf-8", "surrogatepass")
        return len(text).to_bytes(8, "little") + text + data[8 + size :]
    held = header["__metadata__"]["symphony"]
    if way < 0.6:
        facts = change.json_(rng, held.encode()).decode("utf-8", "replace")
        return save(load(data), {"symphony": facts})
    arrays = dict(sorted(load(data).items()))
    for _ in range(int(rng.integers(1, 4))):
        name = change.pick(rng, list(arrays))
        value = change.leaf(rng, arrays[name])
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            arrays[name] = np.ascontiguousarray(value)
        elif len(arrays) > 1:
            del arrays[name]
    return save(arrays, {"symphony": held})


def _read_rollouts(folder: Path, file: str) -> tuple[str, str]:
    place = (folder / file).parent
    try:
        found = load_rollouts(place)
        for saved in found:
            there = np.concatenate([saved.counted[:, :1], saved.counted], 1)
            if not np.isfinite(saved.state[there]).all() or np.abs(saved.state[there]).max(initial=0) > 1e5:
                return ABSURD, "a state that nobody can be in"
        if one_in(REPORTED, folder):
            told = report(found)
            told.plain()
            write_view([found], [told], folder / "view.html")
        RolloutWriter(place, found.about)
    except DataError:
        return REFUSED, ""
    return ACCEPTED, ""


TARGETS: dict[str, Target] = {
    "womd": reader("womd", _womd), "commonroad": reader("commonroad", _commonroad),
    "argoverse2": reader("argoverse2", _argoverse2), "interaction": reader("interaction", _interaction),
    "test_area": reader("interaction", lambda folder: taf(folder, rows=_cars())),
    "scenarionet": reader("scenarionet", scenarionet), "store": Target(written(_store), _change_store, _read_store),
    "checkpoint": Target(written(_checkpoint), _change_checkpoint, _load_checkpoint),
    "submission": Target(written(_submission), _change_submission, _check_submission),
    "rollouts": Target(written(_rollouts), _change_rollouts, _read_rollouts),
}  # fmt: skip
