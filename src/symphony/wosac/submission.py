"""Submissions to the Waymo Open Sim Agents Challenge: written, and checked offline before a server refuses them.

A submission is a ``.tar.gz`` of shards, each a ``SimAgentsChallengeSubmission`` message with some of the scenarios
and the same metadata in all of them.
"""

from __future__ import annotations

import contextlib
import glob
import gzip
import os
import re
import shutil
import tarfile
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import IO

import numpy as np
from google.protobuf.message import DecodeError

from symphony.errors import ConfigError, DataError
from symphony.files import lives, naming
from symphony.wosac import wosac_pb2 as pb
from symphony.wosac.meta import SubmissionMeta
from symphony.wosac.records import parse_scenario, read_scenarios, simulated_ids
from symphony.wosac.scorer import SimulatedRollouts
from symphony.wosac.scorer.config import CURRENT, FUTURE, ROLLOUTS
from symphony.wosac.scorer.scenario import STATES, check_agents

SIM_AGENTS = 1  # type of the submission
FIELDS = dict(zip(STATES, ("center_x", "center_y", "center_z", "heading"), strict=True))
"""Field of the message that holds each array."""

_PARAMETERS = re.compile(r"\d+(\.\d+)?[KMBT]?")
_SHARD = re.compile(r".+\.binproto-(\d{5})-of-(\d{5})")
_SCENARIO_TAG = b"\x0a"  # before a scenario on the wire of a shard: field 1, of a length that follows
_LARGEST = 128 << 20  # bytes of the rollouts of a scenario: of more than 3 000 agents
_MAX_REST = 1 << 16
"""Bytes of a shard beside the scenarios, and of a member of the archive beside its content: some lines of text."""
_DAMAGED = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError)


class _Member(tarfile.TarInfo):
    """A member of an archive; what is read into memory to know it, such as a long name, is small."""

    def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
        beside = self.type in (
            *(tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.GNUTYPE_SPARSE),
            *(tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE),
        )
        if beside and self.size > _MAX_REST:
            raise tarfile.ReadError(f"{self.size} bytes of a header")
        try:
            return super()._proc_member(archive)  # type: ignore[misc]
        except (ValueError, RecursionError) as error:
            raise tarfile.ReadError(f"a damaged header: {error}") from error

    def _proc_gnusparse_10(self, *_: object) -> None:
        raise tarfile.ReadError("a sparse file")  # whose map is as long as it says


def meta_message(meta: SubmissionMeta) -> pb.SimAgentsChallengeSubmission:
    """Return a submission without scenarios."""
    return pb.SimAgentsChallengeSubmission(submission_type=SIM_AGENTS, **vars(meta))


def meta_problems(message: pb.SimAgentsChallengeSubmission) -> Iterator[tuple[str, str]]:
    """Yield (field, what is wrong with it) of a submission's metadata."""
    if message.submission_type != SIM_AGENTS:
        yield "submission_type", f"is {message.submission_type}, expected {SIM_AGENTS} (sim agents)"
    if "@" not in message.account_name:
        yield "account_name", f"{message.account_name!r} is not an e-mail address"
    if not message.unique_method_name.strip():
        yield "unique_method_name", "missing"
    for field in ("uses_lidar_data", "uses_camera_data", "uses_public_model_pretraining"):
        if not message.HasField(field):
            yield field, "missing; must be said, yes or no"
    if message.uses_public_model_pretraining and not message.public_model_names:
        yield "public_model_names", "missing, though public models were used"
    if not _PARAMETERS.fullmatch(message.num_model_parameters):
        problem = f"{message.num_model_parameters!r} is not a number with a suffix, such as 200K"
        yield "num_model_parameters", problem
    if not message.acknowledge_complies_with_closed_loop_requirement:
        yield "acknowledge_complies_with_closed_loop_requirement", "not acknowledged"


def shard_name(shard: int, shards: int) -> str:
    """Return the file name of a shard, by which the server finds it."""
    return f"submission.binproto-{shard:05d}-of-{shards:05d}"


def write_submission(
    rollouts: Iterable[tuple[str, SimulatedRollouts]], meta: SubmissionMeta, out: Path, shards: int = 150
) -> int:
    """Write an archive; one scenario at a time is in memory, and ``out`` appears once all are written.

    Scenarios are dealt out in turn to ``shards`` files in the archive. Returns how many were written. Raises a
    :class:`ConfigError` where ``meta``, ``out`` (a ``.tar.gz``) or ``shards`` can't be used, and a :class:`DataError`
    that names scenario, field and agent for rollouts that the server would refuse.
    """
    if shards < 1:
        raise ConfigError(f"shards must be at least 1, is {shards}")
    if not out.name.endswith(".tar.gz"):
        raise ConfigError(f"{out}: a submission's name ends in .tar.gz")
    message = meta_message(meta)
    for field, problem in meta_problems(message):
        raise ConfigError(f"{field}: {problem}")
    seen: set[str] = set()
    out.parent.mkdir(parents=True, exist_ok=True)
    for left in out.parent.glob(f".{glob.escape(out.name)}.*.*"):  # by a process that was killed
        if (process := left.suffixes[-2][1:]).isdigit() and not lives(int(process)):
            shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.{os.getpid()}.") as folder:
        parts = [Path(folder) / shard_name(shard, shards) for shard in range(shards)]
        with contextlib.ExitStack() as stack:
            files = [stack.enter_context(part.open("wb")) for part in parts]
            for number, (name, arrays) in enumerate(rollouts):
                if name in seen or not name:
                    raise DataError("more than once" if name else "missing", segment=name, field="scenario_id")
                seen.add(name)
                # Messages one after the other are one message with the scenarios of all.
                part = pb.SimAgentsChallengeSubmission(scenario_rollouts=[scenario_message(name, arrays)])
                with naming(out):
                    files[number % shards].write(part.SerializeToString())
            if len(seen) < shards:
                raise ConfigError(f"{len(seen)} scenarios don't fill {shards} shards")
            with naming(out):
                for file in files:
                    file.write(message.SerializeToString(deterministic=True))
                    file.close()
        with naming(out):
            packed = Path(folder) / "packed"
            _pack(parts, packed)
            packed.replace(out)
    return len(seen)


def _pack(files: list[Path], out: Path) -> None:
    """Pack files into an archive without the machine or the hour, so that equal shards make equal archives."""
    with (
        out.open("wb") as raw,
        gzip.GzipFile("", "wb", compresslevel=6, fileobj=raw, mtime=0) as zipped,
        tarfile.open(fileobj=zipped, mode="w") as archive,
    ):
        for file in files:
            member = tarfile.TarInfo(file.name)
            member.size = file.stat().st_size
            with file.open("rb") as content:
                archive.addfile(member, content)


def scenario_message(scenario_id: str, rollouts: SimulatedRollouts) -> pb.ScenarioRollouts:
    """Return the message of a scenario's rollouts.

    Raises a :class:`DataError` for other than 32 rollouts of 80 steps of finite numbers, an agent twice, or an id
    that the format has no room for; names scenario, field and agent.
    """
    ids = rollouts.object_id
    try:
        rollouts.check(count=ROLLOUTS)
        if len(wide := ids[(ids < -(2**31)) | (ids >= 2**31)]):
            raise DataError(f"agent {wide[0]} has no number of 32 bits", field="object_id")
    except DataError as error:
        raise error.at(segment=scenario_id) from None
    message = pb.ScenarioRollouts(scenario_id=scenario_id)
    for rollout in range(ROLLOUTS):
        scene = message.joint_scenes.add()
        for agent, object_id in enumerate(ids.tolist()):
            states = {field: getattr(rollouts, name)[rollout, agent].tolist() for name, field in FIELDS.items()}
            scene.simulated_trajectories.add(object_id=object_id, **states)
    return message


@dataclass
class Report:
    """The findings in a submission: what a server would refuse, naming shard, scenario, agent and field, the first of
    each scenario; the names of its shards and the ids of its scenarios.
    """

    problems: list[DataError] = default(default_factory=list)
    shards: list[str] = default(default_factory=list)
    scenarios: set[str] = default(default_factory=set)


def required_agents(path: Path) -> dict[str, list[int]]:
    """Return the agents that each scenario's rollouts must hold, by scenario id, from WOMD scenario files (see
    :func:`symphony.wosac.records.read_scenarios`); those of the test set are enough. Raises a :class:`DataError`
    where a file or record can't be used; names it.
    """
    found: dict[str, list[int]] = {}
    for file, record, payload in read_scenarios(path):
        scenario = parse_scenario(payload, file, record)
        if scenario.scenario_id in found:
            raise DataError("more than once", file=file, segment=scenario.scenario_id, field="scenario_id")
        try:
            found[scenario.scenario_id] = simulated_ids(scenario)
        except DataError as error:
            raise error.at(file=file) from None
    return found


def check_submission(path: Path, required: Mapping[str, list[int]] | None = None) -> Report:
    """Read a submission from end to end, one scenario at a time.

    Without the ``required`` agents by scenario (see :func:`required_agents`), only the agents of a scenario's
    rollouts are compared with each other, not with those wanted.
    """
    report, metas = Report(), set[bytes]()
    try:
        with gzip.open(path) as unzipped:
            with tarfile.open(fileobj=unzipped, mode="r|", tarinfo=_Member) as archive:
                for member in archive:
                    if (stream := archive.extractfile(member)) is not None:
                        name = member.name.removeprefix("./")
                        metas.add(_check_shard(stream, name, f"{path}:{member.name}", report, required))
            # To the end, where the checksum of the whole lies.
            while unzipped.read(1 << 20):
                pass
    except _DAMAGED as error:
        report.problems.append(DataError(f"not a .tar.gz archive, or damaged: {error}", file=path))
        return report
    texts = _names_problem(report.shards) + ["metadata differ between shards"] * (len(metas - {b""}) > 1)
    report.problems += [DataError(text, file=path, field="shards") for text in texts]
    for missing in sorted(set(required or ()) - report.scenarios):
        report.problems.append(DataError("missing", file=path, segment=missing, field="scenario_id"))
    return report


def _check_shard(
    stream: IO[bytes], name: str, where: str, report: Report, required: Mapping[str, list[int]] | None
) -> bytes:
    """Note the problems of a shard; return its metadata as bytes, none where it is damaged."""
    problems = report.problems
    if not _SHARD.fullmatch(name):
        wanted = "NAME.binproto-NNNNN-of-NNNNN, by which the server finds shards"
        problems.append(DataError(f"not a shard: the name must be {wanted}", file=where))
        return b""
    report.shards.append(name)
    try:
        for message in _messages(stream):
            for scenario in message.scenario_rollouts:
                try:
                    _check_scenario(scenario, report.scenarios, required)
                except DataError as error:
                    problems.append(error.at(file=where, segment=scenario.scenario_id or None))
                report.scenarios.add(scenario.scenario_id)
        message.ClearField("scenario_rollouts")
        if any(isinstance(value, bytes) for _, value in message.ListFields()):
            raise DecodeError("text that is not UTF-8")
    except (DecodeError, UnicodeDecodeError) as error:
        text = f"not a SimAgentsChallengeSubmission message, or damaged: {error}"
        problems.append(DataError(text, file=where))
        return b""
    problems += [DataError(text, file=where, field=field) for field, text in meta_problems(message)]
    return message.SerializeToString(deterministic=True)


def _messages(stream: IO[bytes]) -> Iterator[pb.SimAgentsChallengeSubmission]:
    """Yield a shard in parts: its scenarios one by one, while they come first, then the rest with the metadata."""
    while (tag := stream.read(1)) == _SCENARIO_TAG:
        head = b""  # the length: seven bits in each byte, the last of which is below 0x80
        while len(head) < 5 and (byte := stream.read(1)):
            head += byte
            if byte[0] < 0x80:
                break
        length = sum((byte & 0x7F) << 7 * k for k, byte in enumerate(head))
        if length > _LARGEST:
            raise DecodeError(f"a scenario of {length} bytes, at most {_LARGEST} are read")
        yield pb.SimAgentsChallengeSubmission.FromString(tag + head + stream.read(length))
    rest = stream.read(_MAX_REST)
    if stream.read(1):
        raise DecodeError(f"more than {_MAX_REST} bytes after the scenarios, which come first")
    yield pb.SimAgentsChallengeSubmission.FromString(tag + rest)


def _names_problem(names: list[str]) -> list[str]:
    """Return the problems of the names of the shards, counted from 0, as the organisers' example does, or from 1."""
    numbers = [tuple(map(int, match.groups())) for name in names if (match := _SHARD.fullmatch(name))]
    totals = {total for _, total in numbers}
    if len(totals) != 1:
        return [f"names of {len(totals)} different numbers of shards" if totals else "no shards found"]
    (total,), there = totals, sorted(shard for shard, _ in numbers)
    first = int(total in there)
    wrong = there != list(range(first, total + first))
    return [f"shards {', '.join(map(str, there))} of {total}, expected each once"] * wrong


def _check_scenario(scenario: pb.ScenarioRollouts, seen: set[str], required: Mapping[str, list[int]] | None) -> None:
    name: str | bytes = scenario.scenario_id
    if not name or isinstance(name, bytes):
        raise DataError("missing, or not UTF-8", field="scenario_id")
    if name in seen:
        raise DataError("more than once in the submission", field="scenario_id")
    if required is not None and name not in required:
        raise DataError("not one of the scenarios to simulate", field="scenario_id")
    scenes = scenario.joint_scenes
    if len(scenes) != ROLLOUTS:
        raise DataError(f"{len(scenes)} rollouts, expected {ROLLOUTS}", field="joint_scenes")
    ids = [[one.object_id for one in scene.simulated_trajectories] for scene in scenes]
    wanted = ids[0] if required is None else required[name]
    for number, (agents, scene) in enumerate(zip(ids, scenes, strict=True)):
        try:
            check_agents(np.array(agents, np.int64), np.array(wanted, np.int64))
            for one in scene.simulated_trajectories:
                _check_trajectory(one)
        except DataError as error:
            raise DataError(f"rollout {number}: {error.message}", field=error.field) from None


def _check_trajectory(one: pb.SimulatedTrajectory) -> None:
    for field in FIELDS.values():
        values = np.array(getattr(one, field))
        if len(values) != FUTURE:
            message = f"agent {one.object_id}: {len(values)} steps, expected {FUTURE}"
            raise DataError(message, field=field)
        if not (good := np.isfinite(values)).all():
            step = CURRENT + 1 + int(good.argmin())
            raise DataError(f"agent {one.object_id}, step {step}: not finite", field=field)
