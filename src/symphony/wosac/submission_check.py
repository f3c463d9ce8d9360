"""Checking a submission to the Waymo Open Sim Agents Challenge offline, before a server refuses it."""

from __future__ import annotations

import gzip
import math
import re
import tarfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import IO

from google.protobuf.message import DecodeError

from symphony.errors import DataError
from symphony.wosac import wosac_pb2 as pb
from symphony.wosac.records import parse_scenario, read_scenario_payloads, scenario_files, simulated_ids
from symphony.wosac.submission import FIELDS, FUTURE, ROLLOUTS, meta_problems

_SHARD = re.compile(r".+\.binproto-(\d{5})-of-(\d{5})")
_SCENARIO_KEY = (1 << 3) | 2
"""Tag on the wire of a shard's field ``scenario_rollouts``."""
_DAMAGED = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError)
_NAMED, _KEPT = 5, 1000
_MAX_REST = 1 << 16
"""Bytes of a shard that are no scenarios: some lines of text."""
MAX_SCENARIO = 128 << 20
"""Bytes of the rollouts of a scenario: of more than 3 000 agents."""
_MAX_NAME = 1 << 16
"""Bytes that a member of an archive may have beside its content, such as a long name."""


class _Member(tarfile.TarInfo):
    """A member of an archive; what is read into memory to know it is small."""

    def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
        beside = self.type in (
            *(tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.GNUTYPE_SPARSE),
            *(tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE),
        )
        if beside and self.size > _MAX_NAME:
            raise tarfile.ReadError(f"{self.size} bytes of a header")
        return super()._proc_member(archive)  # type: ignore[misc]

    def _proc_gnusparse_10(self, *_: object) -> None:
        raise tarfile.ReadError("a sparse file")  # whose map is as long as it says


@dataclass
class Report:
    """What was found in a submission.

    Attributes:
        problems: what a server would refuse, each naming shard, scenario, agent and field; the first thousand.
        count: of all problems, 0 if all is well.
        shards: how many were read.
        scenarios: ids of the scenarios in it.
    """

    problems: list[DataError] = default(default_factory=list)
    count: int = 0
    shards: int = 0
    scenarios: set[str] = default(default_factory=set)

    def add(self, *problems: DataError) -> None:
        """Note problems."""
        self.count += len(problems)
        self.problems += problems[: _KEPT - len(self.problems)]


def required_agents(path: Path) -> dict[str, frozenset[int]]:
    """The agents that each scenario's rollouts must hold, by scenario id.

    Args:
        path: file, folder or pattern of WOMD scenario files; those of the test set will do.

    Raises:
        DataError: a file or record can't be used; names it.
    """
    found: dict[str, frozenset[int]] = {}
    for file, record, payload in read_scenario_payloads(scenario_files(path)):
        scenario = parse_scenario(payload, file, record)
        if scenario.scenario_id in found:
            raise DataError("more than once", file=file, segment=scenario.scenario_id, field="scenario_id")
        try:
            found[scenario.scenario_id] = frozenset(simulated_ids(scenario))
        except DataError as error:
            raise error.at(file=file) from None
    return found


def check_submission(path: Path, required: Mapping[str, frozenset[int]] | None = None) -> Report:
    """Read a submission from end to end, one scenario at a time.

    Args:
        path: the ``.tar.gz``.
        required: agents by scenario (see :func:`required_agents`). Without it, that scenarios and agents are the
            right ones is not checked; only that all rollouts of a scenario have the same agents.

    Raises:
        OSError: the file can't be opened.
    """
    report = Report()
    shards: dict[str, str] = {}
    metas: dict[str, bytes] = {}
    try:
        with gzip.open(path) as unzipped:
            with tarfile.open(fileobj=unzipped, mode="r|", tarinfo=_Member) as archive:
                for member in archive:
                    _check_member(archive, member, path, report, required, shards, metas)
            # To the end, where the checksum of the whole lies.
            while unzipped.read(1 << 20):
                pass
    except _DAMAGED as error:
        report.add(DataError(f"not a .tar.gz archive, or damaged: {error}", file=path))
        return report
    report.shards = len(shards)
    report.add(*(DataError(text, file=path, field="shards") for text in _shard_problems(list(shards))))
    first = next(iter(metas), "")
    for name, meta in metas.items():
        if meta != metas[first]:
            report.add(DataError(f"metadata differ from those of {first}", file=f"{path}:{name}"))
    for missing in sorted(set(required or ()) - report.scenarios):
        report.add(DataError("missing", file=path, segment=missing, field="scenario_id"))
    return report


def _check_member(
    archive: tarfile.TarFile,
    member: tarfile.TarInfo,
    path: Path,
    report: Report,
    required: Mapping[str, frozenset[int]] | None,
    shards: dict[str, str],
    metas: dict[str, bytes],
) -> None:
    where = f"{path}:{member.name}"
    name = member.name.removeprefix("./")
    stream = archive.extractfile(member) if member.isfile() else None
    if stream is None or not _SHARD.fullmatch(name):
        if not member.isdir():
            wanted = "NAME.binproto-NNNNN-of-NNNNN, by which the server finds shards"
            report.add(DataError(f"not a shard: the name must be {wanted}", file=where))
        return
    if name in shards:
        report.add(DataError("more than once in the archive", file=where))
    shards[name] = where
    rest = bytearray()
    try:
        for scenario, raw in _messages(stream, member.size):
            if scenario is None:
                rest += raw
                if len(rest) > _MAX_REST:
                    raise DecodeError(f"more than {_MAX_REST} bytes beside the scenarios")
            else:
                report.add(*_scenario_problems(scenario, where, report.scenarios, required))
                report.scenarios.add(scenario.scenario_id)
        meta = pb.SimAgentsChallengeSubmission.FromString(bytes(rest))
    except (DecodeError, UnicodeDecodeError) as error:
        message = f"not a SimAgentsChallengeSubmission message, or damaged: {error}"
        report.add(DataError(message, file=where))
        return
    report.add(*(DataError(text, file=where, field=field) for field, text in meta_problems(meta)))
    metas[name] = meta.SerializeToString(deterministic=True)


def _messages(stream: IO[bytes], size: int) -> Iterator[tuple[pb.ScenarioRollouts | None, bytes]]:
    """The scenarios of a shard one by one, then what else it holds as it is."""
    while size > 0:
        key, used = _varint(stream)
        if key >> 3 == 0:
            raise DecodeError("no field has the number 0")
        if key != _SCENARIO_KEY:
            # All fields but the scenarios are small, and writers put them last or first: kind 0 or 2.
            head = _encoded(key)
            if key & 7 == 0:
                value, more = _varint(stream)
                yield None, head + _encoded(value)
                size -= used + more
                continue
            if key & 7 != 2:
                raise DecodeError(f"unexpected wire type {key & 7}")
        length, more = _varint(stream)
        size -= used + more + length
        if size < 0:
            raise DecodeError("cut short")
        if length > (limit := MAX_SCENARIO if key == _SCENARIO_KEY else _MAX_REST):
            raise DecodeError(f"a message of {length} bytes, at most {limit} are read")
        payload = stream.read(length)
        if key == _SCENARIO_KEY:
            yield pb.ScenarioRollouts.FromString(payload), b""
        else:
            yield None, head + _encoded(length) + payload


def _varint(stream: IO[bytes]) -> tuple[int, int]:
    """(value, bytes it took)."""
    value = 0
    for used in range(10):
        byte = stream.read(1)
        if not byte:
            raise DecodeError("cut short")
        value |= (byte[0] & 0x7F) << (7 * used)
        if byte[0] < 0x80:
            return value, used + 1
    raise DecodeError("a number without an end")


def _encoded(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _shard_problems(names: Sequence[str]) -> list[str]:
    if not names:
        return ["no shards found"]
    numbers = [tuple(map(int, match.groups())) for name in names if (match := _SHARD.fullmatch(name))]
    totals = {total for _, total in numbers}
    if len(totals) > 1:
        return [f"names of {len(totals)} different numbers of shards: {', '.join(map(str, sorted(totals)))}"]
    (total,) = totals
    there = {shard for shard, _ in numbers}
    # Counted from 0, as the organisers' example does, or from 1.
    wanted = set(range(1, total + 1)) if total in there else set(range(total))
    found = [f"shard {shard} of {total} missing" for shard in sorted(wanted - there)[:_NAMED]]
    return found + [
        f"shard {shard} is beyond the {total} there are" for shard in sorted(there - wanted)[:_NAMED]
    ]


def _scenario_problems(
    scenario: pb.ScenarioRollouts,
    where: str,
    seen: set[str],
    required: Mapping[str, frozenset[int]] | None,
) -> Iterator[DataError]:
    name: str | bytes = scenario.scenario_id
    if not isinstance(name, str):
        yield DataError(f"{name!r} is not UTF-8", file=where, field="scenario_id")
        return

    def problem(message: str, what: str) -> DataError:
        return DataError(message, file=where, segment=name or None, field=what)

    if not name:
        yield problem("missing", "scenario_id")
        return
    if name in seen:
        yield problem("more than once in the submission", "scenario_id")
    if required is not None and name not in required:
        yield problem("none of the scenarios to simulate", "scenario_id")
    if len(scenario.joint_scenes) != ROLLOUTS:
        yield problem(f"{len(scenario.joint_scenes)} rollouts, expected {ROLLOUTS}", "joint_scenes")
    expected = required.get(name) if required is not None else None
    for number, scene in enumerate(scenario.joint_scenes):
        ids = [trajectory.object_id for trajectory in scene.simulated_trajectories]
        agents = frozenset(ids)
        if expected is None:
            expected = agents
        for message in _agent_problems(ids, expected):
            yield problem(f"rollout {number}: {message}", "object_id")
        for trajectory in scene.simulated_trajectories:
            for what, message in _state_problems(trajectory):
                yield problem(f"rollout {number}, agent {trajectory.object_id}: {message}", what)


def _agent_problems(ids: list[int], expected: frozenset[int]) -> Iterator[str]:
    agents = frozenset(ids)
    if not ids:
        yield "no agents"
    for text, which in (
        (
            "more than once",
            {agent for agent in agents if ids.count(agent) > 1} if len(ids) > len(agents) else (),
        ),
        ("missing", expected - agents),
        ("not to be simulated", agents - expected),
    ):
        if which:
            yield f"{_named(sorted(which))} {text}"


def _named(ids: list[int]) -> str:
    more = f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else ""
    return f"agent{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids[:_NAMED]))}{more}"


def _state_problems(trajectory: pb.SimulatedTrajectory) -> Iterator[tuple[str, str]]:
    if not trajectory.HasField("object_id"):
        yield "object_id", "missing"
    for what in FIELDS.values():
        values = getattr(trajectory, what)
        if len(values) != FUTURE:
            yield what, f"{len(values)} steps, expected {FUTURE}"
        elif not math.isfinite(sum(values)):  # of numbers in single precision no sum overflows
            step = next(step for step, value in enumerate(values) if not math.isfinite(value))
            yield what, f"not finite at future step {step}"
