"""Results that are read again, as things to be fuzzed: submissions to the challenge, and saved rollouts."""

from __future__ import annotations

import functools
import gzip
import hashlib
import io
import json
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import fuzz_mutations as change
from fuzz_base import ABSURD, ACCEPTED, REFUSED, Files, Rng, Target, one_in, written

NAMES = ("aaaa", "bbbb")
BOMB = 32 << 20
"""Bytes of zeros in a member of an archive, at times."""


USED = 4
"""One in so many good folders of rollouts is reported and played, which takes far more time than reading it."""


def submission(records: Callable[[Rng, bytes], bytes]) -> Target:
    """The check of a submission against its scenarios, which ``records`` changes."""

    def mutate(rng: Rng, files: Files) -> Files:
        if rng.random() < 0.15:
            return {**files, "a.tfrecord": records(rng, files["a.tfrecord"])}
        return {**files, "a.tar.gz": _change_archive(rng, files["a.tar.gz"])}

    return Target(functools.cache(_submission), mutate, _check_submission)


def _submission() -> Files:
    from helpers_wosac import record_rollouts, womd_record
    from symphony.data.sources.tfrecord import write_records
    from symphony.wosac.meta import SubmissionMeta
    from symphony.wosac.submission import write_submission

    meta = SubmissionMeta(
        account_name="somebody@example.org",
        unique_method_name="made",
        uses_lidar_data=False,
        uses_camera_data=False,
        uses_public_model_pretraining=False,
        num_model_parameters="200K",
        acknowledge_complies_with_closed_loop_requirement=True,
        authors=("A",),
        affiliation="Nowhere",
    )
    with tempfile.TemporaryDirectory() as folder:
        scenarios = [womd_record(name, tracks=2 - k) for k, name in enumerate(NAMES)]
        write_records(Path(folder) / "a", [each.SerializeToString() for each in scenarios])
        rollouts = [(each.scenario_id, record_rollouts(each)) for each in scenarios]
        write_submission(rollouts, meta, Path(folder) / "a.tar.gz", shards=2)
        return {
            "a.tar.gz": (Path(folder) / "a.tar.gz").read_bytes(),
            "a.tfrecord": (Path(folder) / "a").read_bytes(),
        }


def _change_archive(rng: Rng, data: bytes) -> bytes:
    """Fields of a shard's message, its bytes, the members' names, the archive's bytes, or those of all of it."""
    from symphony.wosac import wosac_pb2 as pb

    way = rng.random()
    if way < 0.1:
        return change.bytes_(rng, data)
    plain, kept = _unpacked(data)
    if way < 0.25:
        return _packed(change.bytes_(rng, plain))
    members = list(kept)
    which = int(rng.integers(len(members)))
    name, content = members[which]
    if way < 0.75:
        message = pb.SimAgentsChallengeSubmission.FromString(content)
        change.message(rng, message)
        members[which] = name, message.SerializeToString()
    elif way < 0.88:
        members[which] = name, change.bytes_(rng, content)
    elif way < 0.998:
        other = change.pick(
            rng, (*change.TEXTS, "../" + name, "./" + name, name.replace("2", "99999"), name + "0")
        )
        members[which] = other or "x", content
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
    return _packed(out.getvalue())


@functools.cache
def _unpacked(data: bytes) -> tuple[bytes, tuple[tuple[str, bytes], ...]]:
    plain = gzip.decompress(data)
    with tarfile.open(fileobj=io.BytesIO(plain)) as archive:
        return plain, tuple((each.name, archive.extractfile(each).read()) for each in archive)  # type: ignore[union-attr]


def _packed(data: bytes) -> bytes:
    """As gzip; compressed only where it would be large otherwise."""
    return gzip.compress(data, int(len(data) >= BOMB), mtime=0)


def _check_submission(folder: Path, file: str) -> tuple[str, str]:
    from symphony.errors import DataError
    from symphony.wosac.submission import check_submission, required_agents

    try:
        required = required_agents(folder / "a.tfrecord")
    except DataError:
        return REFUSED, ""
    report = check_submission(folder / file, required)
    for problem in report.problems:
        str(problem)
    if report.problems:
        return REFUSED, ""
    wrong = _unfit(folder / file, {name: set(agents) for name, agents in required.items()})
    return (ABSURD, wrong) if wrong else (ACCEPTED, "")


def _unfit(file: Path, required: dict[str, set[int]]) -> str:
    """What a server would refuse in a submission, said independently of the check."""
    from symphony.wosac import wosac_pb2 as pb

    found: dict[str, Any] = {}
    with tarfile.open(file) as archive:
        for member in archive:
            if member.isfile():
                content = archive.extractfile(member).read()  # type: ignore[union-attr]
                found |= {
                    s.scenario_id: s
                    for s in pb.SimAgentsChallengeSubmission.FromString(content).scenario_rollouts
                }
    if found.keys() != required.keys():
        return "other scenarios than are asked for"
    for name, scenario in found.items():
        for scene in scenario.joint_scenes:
            if sorted(t.object_id for t in scene.simulated_trajectories) != sorted(required[name]):
                return "other agents than are asked for"
            for track in scene.simulated_trajectories:
                numbers = np.array(
                    [track.center_x, track.center_y, track.center_z, track.heading], np.float64
                )
                if numbers.shape != (4, 80) or not np.isfinite(numbers).all():
                    return "a trajectory that is not 80 finite numbers"
    return "" if all(len(each.joint_scenes) == 32 for each in found.values()) else "not 32 rollouts"


def saved_rollouts() -> Target:
    """Everything that reads saved rollouts: the folder itself, the report, and the page that plays them."""
    return Target(functools.cache(written(_save)), _change_saved, _read_saved)


def _save(folder: Path) -> Path:
    from helpers_saved import played, random_trees
    from helpers_segments import crossing, straight_road
    from symphony.saved.folder import MANIFEST, About, RolloutWriter

    writer = RolloutWriter(
        folder / "saved", About("made", 3, {"interactive": "a"}, {"rollouts": 2}, {"checksum": "ab"})
    )
    for segment in (crossing(3, steps=7), straight_road(3, steps=6)):
        saved = played(segment, (0, 2), 2)
        writer.add(played(segment, (0, 2), 2, trees=random_trees(saved), failed={1: "made"}))
    writer.fail("another", 2, "no routes")
    return writer.path / MANIFEST


def _change_saved(rng: Rng, files: Files) -> Files:
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
    from safetensors.numpy import load, save

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


def _read_saved(folder: Path, file: str) -> tuple[str, str]:
    from symphony.cli.view import write_view
    from symphony.errors import DataError
    from symphony.evaluation.report import report
    from symphony.saved.folder import RolloutWriter, load_rollouts

    place = (folder / file).parent
    try:
        found = load_rollouts(place)
        for saved in found:
            there = np.concatenate([saved.counted[:, :1], saved.counted], 1)
            if not np.isfinite(saved.state[there]).all() or np.abs(saved.state[there]).max(initial=0) > 1e5:
                return ABSURD, "a state that nobody can be in"
        if one_in(USED, folder):
            report(found).plain()
            write_view(found, folder / "view.html")
        RolloutWriter(place, found.about)
    except DataError:
        return REFUSED, ""
    return ACCEPTED, ""
