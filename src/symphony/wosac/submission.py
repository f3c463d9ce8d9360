"""Writing a submission to the Waymo Open Sim Agents Challenge.

A submission is a ``.tar.gz`` of shards, each a ``SimAgentsChallengeSubmission`` message with some of the scenarios
and the same metadata in all of them.
"""

from __future__ import annotations

import contextlib
import gzip
import re
import tarfile
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from symphony.errors import ConfigError, DataError
from symphony.wosac import wosac_pb2 as pb
from symphony.wosac.rollouts import STATES, RolloutArrays
from symphony.wosac.submission_meta import SubmissionMeta

ROLLOUTS, FUTURE = 32, 80
"""Rollouts of a scenario and steps of a rollout that the challenge asks for."""
SIM_AGENTS = 1
"""Type of the submission."""
FIELDS = dict(zip(STATES, ("center_x", "center_y", "center_z", "heading"), strict=True))
"""Field of the message that holds each array."""

_PARAMETERS = re.compile(r"\d+(\.\d+)?[KMBT]?")


def meta_message(meta: SubmissionMeta) -> pb.SimAgentsChallengeSubmission:
    """A submission without scenarios."""
    return pb.SimAgentsChallengeSubmission(submission_type=SIM_AGENTS, **vars(meta))


def meta_problems(message: pb.SimAgentsChallengeSubmission) -> list[tuple[str, str]]:
    """(field, what is wrong with it) of a submission's metadata."""
    found = [(name, "is not UTF-8") for name in _not_text(message)]
    if found:
        return found
    if message.submission_type != SIM_AGENTS:
        found.append(("submission_type", f"is {message.submission_type}, expected {SIM_AGENTS} (sim agents)"))
    if "@" not in message.account_name:
        found.append(("account_name", f"{message.account_name!r} is no e-mail address"))
    if not message.unique_method_name.strip():
        found.append(("unique_method_name", "missing"))
    for field in ("uses_lidar_data", "uses_camera_data", "uses_public_model_pretraining"):
        if not message.HasField(field):
            found.append((field, "missing; must be said, yes or no"))
    if message.uses_public_model_pretraining and not message.public_model_names:
        found.append(("public_model_names", "missing, though public models were used"))
    if not _PARAMETERS.fullmatch(message.num_model_parameters):
        found.append(
            (
                "num_model_parameters",
                f"{message.num_model_parameters!r} is no number with a suffix, such as 200K",
            )
        )
    if not message.acknowledge_complies_with_closed_loop_requirement:
        found.append(("acknowledge_complies_with_closed_loop_requirement", "not acknowledged"))
    return found


def _not_text(message: pb.SimAgentsChallengeSubmission) -> list[str]:
    """Fields of text that the message was given other bytes for, which it keeps as they are."""
    texts = [(field.name, value) for field, value in message.ListFields() if field.type == field.TYPE_STRING]
    several = ((name, [value] if isinstance(value, str | bytes) else value) for name, value in texts)
    return [name for name, values in several if any(isinstance(value, bytes) for value in values)]


def shard_name(shard: int, shards: int) -> str:
    """File name of a shard; the server finds shards by it."""
    return f"submission.binproto-{shard:05d}-of-{shards:05d}"


def write_submission(
    rollouts: Iterable[tuple[str, RolloutArrays]], meta: SubmissionMeta, out: Path, shards: int = 150
) -> int:
    """Write an archive; one scenario at a time is in memory, and ``out`` appears once all are written.

    Args:
        rollouts: scenario ids and their rollouts.
        meta: what the submission says about itself.
        out: file to write, ``.tar.gz``.
        shards: files in the archive; scenarios are dealt out to them in turn.

    Returns:
        How many scenarios were written.

    Raises:
        ConfigError: ``meta``, ``out`` or ``shards`` can't be used.
        DataError: rollouts that the server would refuse; names scenario, field and agent.
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
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        names = [shard_name(shard, shards) for shard in range(shards)]
        with contextlib.ExitStack() as stack:
            files = [stack.enter_context((Path(folder) / name).open("wb")) for name in names]
            for number, (name, arrays) in enumerate(rollouts):
                if name in seen:
                    raise DataError("more than once", segment=name, field="scenario_id")
                seen.add(name)
                # Messages one after the other are one message with the scenarios of all.
                part = pb.SimAgentsChallengeSubmission(scenario_rollouts=[scenario_message(name, arrays)])
                files[number % shards].write(part.SerializeToString())
            if len(seen) < shards:
                raise ConfigError(f"{len(seen)} scenarios don't fill {shards} shards")
            for file in files:
                file.write(message.SerializeToString(deterministic=True))
        packed = Path(folder) / "packed"
        _pack([Path(folder) / name for name in names], packed)
        packed.replace(out)
    return len(seen)


def _pack(files: list[Path], out: Path) -> None:
    """Nothing of the machine or the hour goes in, so that the same shards make the same archive."""
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


def scenario_message(scenario_id: str, rollouts: RolloutArrays) -> pb.ScenarioRollouts:
    """The message of a scenario's rollouts.

    Raises:
        DataError: not 32 rollouts of 80 steps of finite numbers, an agent twice, or an id that the format has no room
            for; names scenario, field and agent.
    """

    def error(message: str, field: str) -> DataError:
        return DataError(message, segment=scenario_id, field=field)

    ids = np.asarray(rollouts.object_id)
    if ids.ndim != 1:
        raise error(f"has shape {ids.shape}, expected (agents,)", "object_id")
    wide = ids[(ids < -(2**31)) | (ids >= 2**31)]
    if len(wide):
        raise error(f"agent {wide[0]} has no number of 32 bits", "object_id")
    values, counts = np.unique(ids, return_counts=True)
    if (counts > 1).any():
        raise error(f"agent {values[counts > 1][0]} more than once", "object_id")
    states = {}
    for name in STATES:
        array = np.asarray(getattr(rollouts, name))
        expected = (ROLLOUTS, len(ids), FUTURE)
        if array.shape != expected:
            raise error(f"has shape {array.shape}, expected {expected} (rollouts, agents, steps)", name)
        with np.errstate(over="ignore"):
            narrow = array.astype(np.float32)
        bad = np.argwhere(~np.isfinite(narrow))
        if len(bad):
            rollout, agent, step = bad[0]
            raise error(f"agent {ids[agent]}, rollout {rollout}, future step {step}: not finite", name)
        states[FIELDS[name]] = narrow
    message = pb.ScenarioRollouts(scenario_id=scenario_id)
    for rollout in range(ROLLOUTS):
        scene = message.joint_scenes.add()
        for agent, object_id in enumerate(ids.tolist()):
            scene.simulated_trajectories.add(
                object_id=object_id,
                **{field: array[rollout, agent].tolist() for field, array in states.items()},
            )
    return message
