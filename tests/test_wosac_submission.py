"""Submissions to the WOSAC challenge: written, and refused before a server would."""

from __future__ import annotations

import gzip
import io
import tarfile
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from helpers_wosac import record_rollouts, womd_record
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import WosacSettings
from symphony.data.sources.tfrecord import write_records
from symphony.errors import ConfigError, DataError
from symphony.wosac import wosac_pb2 as pb
from symphony.wosac.files import read_rollouts
from symphony.wosac.meta import SubmissionMeta
from symphony.wosac.scorer import SimulatedRollouts
from symphony.wosac.scorer.scenario import STATES
from symphony.wosac.simulate import simulated_scenarios
from symphony.wosac.submission import (
    FIELDS,
    check_submission,
    meta_message,
    required_agents,
    scenario_message,
    shard_name,
    write_submission,
)

META = SubmissionMeta(
    account_name="somebody@example.org",
    unique_method_name="made",
    uses_lidar_data=False,
    uses_camera_data=False,
    uses_public_model_pretraining=False,
    num_model_parameters="200K",
    acknowledge_complies_with_closed_loop_requirement=True,
    authors=("A", "B"),
    affiliation="Nowhere",
)
NAMES = ("aaaa", "bbbb", "cccc")
ROLLOUTS = {name: record_rollouts(womd_record(name), seed=seed) for seed, name in enumerate(NAMES)}
AGENTS = {name: [100, 101, 102] for name in NAMES}

Shard = pb.SimAgentsChallengeSubmission
Change = Callable[[list[Shard]], Any]


def pack(path: Path, shards: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in shards.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return path


def made_shards() -> list[Shard]:
    shards = [meta_message(META), meta_message(META)]
    for k, name in enumerate(NAMES):
        shards[k % 2].scenario_rollouts.append(scenario_message(name, ROLLOUTS[name]))
    return shards


GOOD = [shard.SerializeToString() for shard in made_shards()]


def good_shards() -> list[Shard]:
    return [Shard.FromString(content) for content in GOOD]


def named(shards: list[Shard]) -> dict[str, bytes]:
    return {shard_name(k, len(shards)): shard.SerializeToString() for k, shard in enumerate(shards)}


def problems(shards: dict[str, bytes], required: dict[str, list[int]] | None = AGENTS) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        report = check_submission(pack(Path(folder) / "some.tar.gz", shards), required)
    return [str(problem) for problem in report.problems]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("submission") / "made.tar.gz"
    assert write_submission(iter(ROLLOUTS.items()), META, path, shards=2) == 3
    return path


@pytest.fixture(scope="module")
def scenarios(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenarios") / "made.tfrecord"
    write_records(path, [womd_record(name).SerializeToString() for name in NAMES])
    return path


def test_what_is_written_can_be_read_and_is_all_well(written: Path, scenarios: Path, tmp_path: Path) -> None:
    assert required_agents(scenarios) == AGENTS
    report = check_submission(written, AGENTS)
    assert (report.problems, len(report.shards), report.scenarios) == ([], 2, set(NAMES))
    found: dict[str, Any] = {}
    with tarfile.open(written, "r:gz") as archive:
        assert archive.getnames() == [shard_name(0, 2), shard_name(1, 2)]
        for member in archive:
            shard = Shard.FromString(archive.extractfile(member).read())  # type: ignore[union-attr]
            assert (shard.submission_type, shard.account_name) == (1, "somebody@example.org")
            assert shard.HasField("uses_camera_data")
            assert list(shard.authors) == ["A", "B"]
            found |= {scenario.scenario_id: scenario for scenario in shard.scenario_rollouts}
    for name, rollouts in ROLLOUTS.items():
        scenes = found[name].joint_scenes
        for state, field in FIELDS.items():
            values = [[getattr(t, field) for t in scene.simulated_trajectories] for scene in scenes]
            np.testing.assert_array_equal(np.array(values, np.float32), getattr(rollouts, state))
        assert [t.object_id for t in scenes[5].simulated_trajectories] == rollouts.object_id.tolist()
    # The same rollouts make the same archive, and nothing else is left behind.
    write_submission(ROLLOUTS.items(), META, tmp_path / "again.tar.gz", shards=2)
    assert (tmp_path / "again.tar.gz").read_bytes() == written.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.tar.gz"]


def test_field_numbers_of_the_public_format() -> None:
    def numbers(message: Any) -> dict[str, int]:
        return {field.name: field.number for field in message.DESCRIPTOR.fields}

    assert numbers(pb.JointScene) == {"simulated_trajectories": 1}
    assert numbers(pb.ScenarioRollouts) == {"scenario_id": 1, "joint_scenes": 2}
    assert numbers(Shard)["acknowledge_complies_with_closed_loop_requirement"] == 14
    # Packed: one length-delimited field, not one tag a number.
    wire = pb.SimulatedTrajectory(center_x=[1.0, 2.0], heading=[1.0], object_id=3).SerializeToString()
    assert wire == b"\x12\x08\x00\x00\x80?\x00\x00\x00@\x2a\x04\x00\x00\x80?\x30\x03"


def test_the_command(
    written: Path, scenarios: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["wosac", "validate", str(written), "--scenario", str(scenarios)]) == 0
    assert "3 scenarios in 2 shards, all well" in capsys.readouterr().out
    assert main(["wosac", "validate", str(written)]) == 0
    assert "Not checked" in capsys.readouterr().out
    shards = good_shards()
    shards[0].scenario_rollouts[0].joint_scenes[4].simulated_trajectories[1].center_y[7] = np.nan
    path = pack(tmp_path / "wrong.tar.gz", named(shards))
    assert main(["wosac", "validate", str(path), "--scenario", str(scenarios)]) == 1
    error = capsys.readouterr().err
    assert "segment aaaa, field center_y: rollout 4: agent 101, step 18: not finite" in error
    assert "1 problem" in error
    assert main(["wosac", "validate", str(tmp_path / "absent.tar.gz")]) == 1
    assert "absent.tar.gz" in capsys.readouterr().err


def test_an_odd_box_is_in_the_submission_nevertheless(tmp_path: Path) -> None:
    record = womd_record()
    for state in record.tracks[1].states:
        state.length = 0
    agent, found = load_agent("constant_velocity"), []
    for name, one in (("a", record), ("b", womd_record())):
        write_records(tmp_path / name, [one.SerializeToString()])
        found += list(simulated_scenarios(agent, tmp_path / name, WosacSettings()))
    (name, odd), (_, whole) = found
    assert name == record.scenario_id
    order = np.argsort(odd.object_id)
    assert odd.object_id[order].tolist() == whole.object_id.tolist()
    for values in STATES:
        mine = getattr(odd, values)[:, order]
        np.testing.assert_array_equal(mine[:, [0, 2]], getattr(whole, values)[:, [0, 2]])
    # Who is left out goes on at its velocity.
    now, steps = record.tracks[1].states[10], 0.1 * np.arange(1, 81)
    np.testing.assert_allclose(odd.x[0, order[1]], now.center_x + now.velocity_x * steps, atol=1e-3)


def scene(shards: list[Shard]) -> Any:
    return shards[0].scenario_rollouts[1].joint_scenes[2]


def trajectory(shards: list[Shard]) -> Any:
    return scene(shards).simulated_trajectories[1]


def drop(field: str) -> Change:
    return lambda shards: [shard.ClearField(field) for shard in shards]  # type: ignore[arg-type]


def put(field: str, value: Any) -> Change:
    return lambda shards: [setattr(shard, field, value) for shard in shards]


@pytest.mark.parametrize(("change", "texts"), [
    (lambda s: s[1].ClearField("scenario_rollouts"), ["segment bbbb, field scenario_id: missing"]),
    (lambda s: s[1].scenario_rollouts.append(s[0].scenario_rollouts[0]),
     ["segment aaaa, field scenario_id: more than once"]),
    (lambda s: setattr(s[0].scenario_rollouts[0], "scenario_id", "zzzz"),
     ["segment zzzz, field scenario_id: none of the scenarios", "segment aaaa, field scenario_id: missing"]),
    (lambda s: s[0].scenario_rollouts[0].ClearField("scenario_id"),
     ["field scenario_id: missing", "segment aaaa, field scenario_id: missing"]),
    (lambda s: s[0].scenario_rollouts[1].joint_scenes.pop(), ["segment cccc, field joint_scenes: 31 rollouts"]),
    (lambda s: scene(s).simulated_trajectories.pop(),
     ["segment cccc, field object_id: rollout 2: agent 102 missing"]),
    (lambda s: scene(s).ClearField("simulated_trajectories"), ["rollout 2: agents 100, 101, 102 missing"]),
    (lambda s: setattr(trajectory(s), "object_id", 777), ["rollout 2: agent 101 missing"]),
    (lambda s: setattr(trajectory(s), "object_id", 100), ["rollout 2: agent 100 more than once"]),
    (lambda s: scene(s).simulated_trajectories.add(object_id=7), ["agent 7 in the rollouts, but not valid"]),
    (lambda s: trajectory(s).center_x.pop(),
     ["segment cccc, field center_x: rollout 2: agent 101: 79 steps, expected 80"]),
    (lambda s: trajectory(s).center_z.__setitem__(3, np.inf), ["field center_z: rollout 2: agent 101, step 14: not"]),
    (put("submission_type", 2), ["field submission_type: is 2, expected 1"] * 2),
    (drop("account_name"), ["field account_name: '' is no e-mail address"] * 2),
    (put("unique_method_name", " "), ["field unique_method_name: missing"] * 2),
    (drop("uses_lidar_data"), ["field uses_lidar_data: missing"] * 2),
    (put("uses_public_model_pretraining", True), ["field public_model_names: missing"] * 2),
    (put("num_model_parameters", "many"), ["field num_model_parameters: 'many'"] * 2),
    (put("acknowledge_complies_with_closed_loop_requirement", False),
     ["field acknowledge_complies_with_closed_loop_requirement: not acknowledged"] * 2),
    (lambda s: setattr(s[1], "affiliation", "Elsewhere"), ["metadata differ"]),
])  # fmt: skip
def test_broken_submissions(change: Change, texts: list[str]) -> None:
    shards = good_shards()
    change(shards)
    found = problems(named(shards))
    assert len(found) == len(texts)
    for problem, text in zip(found, texts, strict=True):
        assert text in problem
        assert "some.tar.gz" in problem


def test_without_the_scenarios_rollouts_are_compared_with_each_other() -> None:
    shards = good_shards()
    assert problems(named(shards), None) == []
    trajectory(shards).object_id = 777
    (found,) = problems(named(shards), None)
    assert "agent 101 missing" in found


@pytest.mark.parametrize(("rename", "text"), [
    (lambda name: name.replace("00000-of", "00002-of"), ""),  # Counted from 1.
    (lambda name: "part" + name[-14:], "not a shard"),
    (lambda name: name.replace("of-00002", "of-00003"), "shards 0, 1 of 3"),
    (lambda name: name.replace("00001-of", "00000-of"), "shards 0, 0 of 2"),
    (lambda name: name.replace("00001-of-00002", "00001-of-00004"), "2 different numbers of shards"),
])  # fmt: skip
def test_names_of_shards(rename: Callable[[str], str], text: str) -> None:
    shards = named(good_shards())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.tar.gz"
        with tarfile.open(path, "w:gz") as archive:  # names may come twice
            for name, content in shards.items():
                member = tarfile.TarInfo(rename(name))
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
        found = [str(problem) for problem in check_submission(path, AGENTS).problems]
    assert any(text in problem for problem in found) if text else found == []
    assert any("no shards found" in problem for problem in problems({}))


@pytest.mark.parametrize("wrong", [
    *(b"\x0a\xff\xff\xff\x7f", b"\x0a\x02\xff\xff", b"\x0d\x00\x00\x00\x00", b"\x0a", bytes(1 << 20)),
    *(b"\x0a\xff\xff\xff\xff\xff", GOOD[0].replace(b"Nowhere", b"\xffowhere"), GOOD[0].replace(b"aaaa", b"\xffaaa")),
])  # fmt: skip
def test_a_shard_that_is_no_message(wrong: bytes) -> None:
    found = problems({**named(good_shards()), shard_name(0, 2): wrong})
    assert any(shard_name(0, 2) in one for one in found)


def unzipped(content: bytes) -> bytes | None:
    """What is in a file that gzip finds no fault with."""
    try:
        return gzip.decompress(content)
    except (OSError, EOFError, zlib.error):
        return None


@settings(max_examples=10)
@given(st.floats(0, 1), st.integers(1, 255), st.booleans())
def test_damaged_bytes_are_found(written: Path, place: float, change: int, cut: bool) -> None:
    good = written.read_bytes()
    # What comes before, time and name, means nothing.
    begin = good.index(b"\0", 10) + 1
    where = begin + int(place * (len(good) - 1 - begin))
    content = good[:where] + (b"" if cut else bytes([good[where] ^ change]) + good[where + 1 :])
    # Among the zeros at the end another distance copies the same.
    assume(unzipped(content) != unzipped(good))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wrong.tar.gz"
        path.write_bytes(content)
        assert check_submission(path, AGENTS).problems


def test_damaged_archives(written: Path, tmp_path: Path) -> None:
    content = written.read_bytes()
    inside = gzip.decompress(content)
    nothing, half = (
        gzip.compress(part) for part in (b"nothing of the kind" * 100, inside[: len(inside) // 2])
    )
    for wrong in (content[:-4], inside, b"", nothing, half):
        (tmp_path / "wrong.tar.gz").write_bytes(wrong)
        report = check_submission(tmp_path / "wrong.tar.gz", AGENTS)
        assert any("damaged" in str(problem) for problem in report.problems)


def arrays(**changes: Any) -> SimulatedRollouts:
    return replace(ROLLOUTS["aaaa"], **changes)


@pytest.mark.parametrize(("rollouts", "field", "text"), [
    (arrays(x=ROLLOUTS["aaaa"].x[:31]), "x", "has shape"),
    (arrays(y=ROLLOUTS["aaaa"].y.astype(float) * 1e40), "y", "not finite"),
    (arrays(object_id=np.array([100, 101, 100])), "object_id", "agent 100 more than once"),
    (arrays(object_id=np.array([100, 101, 2**31])), "object_id", "agent 2147483648 has no number of 32 bits"),
])  # fmt: skip
def test_rollouts_that_are_not_written(
    tmp_path: Path, rollouts: SimulatedRollouts, field: str, text: str
) -> None:
    with pytest.raises(DataError, match=text) as caught:
        write_submission([("aaaa", rollouts)], META, tmp_path / "made.tar.gz", shards=1)
    assert (caught.value.segment, caught.value.field) == ("aaaa", field)
    assert list(tmp_path.iterdir()) == []


def test_submissions_that_are_not_written(tmp_path: Path) -> None:
    out, silent = (
        tmp_path / "made.tar.gz",
        replace(META, acknowledge_complies_with_closed_loop_requirement=False),
    )
    with pytest.raises(DataError, match="more than once"):
        write_submission([("aaaa", arrays()), ("aaaa", arrays())], META, out, shards=1)
    for meta, path, shards, text in (
        (META, out, 2, "don't fill 2 shards"),
        (META, out, 0, "at least 1"),
        (META, tmp_path / "made.tar", 1, "ends in"),
        (silent, out, 1, "not acknowledged"),
    ):
        with pytest.raises(ConfigError, match=text):
            write_submission([("aaaa", arrays())], meta, path, shards=shards)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.samples
def test_rollouts_of_a_real_scenario(samples: Path, tmp_path: Path) -> None:
    file = samples.parent / "wosac" / "case_637f20cafde22ff8_a_official_submission.npz"
    if not file.is_file():
        pytest.skip(f"no rollouts at {file}")
    out = tmp_path / "made.tar.gz"
    assert write_submission([("637f20cafde22ff8", read_rollouts(file))], META, out, shards=1) == 1
    assert main(["wosac", "validate", str(out), "--scenario", str(samples / "womd")]) == 0
