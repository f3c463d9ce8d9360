"""Submissions to the WOSAC challenge: written, and refused before a server would."""

from __future__ import annotations

import gzip
import io
import tarfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_wosac import record_rollouts, womd_record
from symphony.agents import load_agent
from symphony.cli import main
from symphony.cli.wosac_submit import simulated_scenarios
from symphony.config import WosacSettings
from symphony.data.sources.tfrecord import write_records
from symphony.errors import ConfigError, DataError
from symphony.wosac import wosac_pb2 as pb
from symphony.wosac.rollouts import RolloutArrays, read_rollouts
from symphony.wosac.submission import meta_message, scenario_message, shard_name, write_submission
from symphony.wosac.submission_check import check_submission, required_agents
from symphony.wosac.submission_meta import SubmissionMeta

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
AGENTS = {name: frozenset({100, 101, 102}) for name in NAMES}

Shard = pb.SimAgentsChallengeSubmission


def pack(path: Path, shards: dict[str, bytes], mode: str = "w:gz") -> Path:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for name, content in shards.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return path


def good_shards() -> list[Shard]:
    shards = [meta_message(META), meta_message(META)]
    for k, name in enumerate(NAMES):
        shards[k % 2].scenario_rollouts.append(scenario_message(name, ROLLOUTS[name]))
    return shards


def named(shards: list[Shard]) -> dict[str, bytes]:
    return {shard_name(k, len(shards)): shard.SerializeToString() for k, shard in enumerate(shards)}


def problems(path: Path, required: dict[str, frozenset[int]] | None = AGENTS) -> list[str]:
    report = check_submission(path, required)
    assert report.count == len(report.problems)
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


def test_what_is_written_is_all_well(written: Path, scenarios: Path) -> None:
    assert required_agents(scenarios) == AGENTS
    report = check_submission(written, AGENTS)
    assert (report.problems, report.count, report.shards) == ([], 0, 2)
    assert report.scenarios == set(NAMES)


def test_what_is_written_can_be_read(written: Path) -> None:
    found: dict[str, Any] = {}
    with tarfile.open(written, "r:gz") as archive:
        assert archive.getnames() == [shard_name(0, 2), shard_name(1, 2)]
        for member in archive:
            shard = Shard.FromString(archive.extractfile(member).read())  # type: ignore[union-attr]
            assert (shard.submission_type, shard.account_name) == (1, "somebody@example.org")
            assert shard.HasField("uses_camera_data")
            assert list(shard.authors) == ["A", "B"]
            found |= {scenario.scenario_id: scenario for scenario in shard.scenario_rollouts}
    assert set(found) == set(NAMES)
    for name, rollouts in ROLLOUTS.items():
        scenes = found[name].joint_scenes
        for field, array in (("center_x", rollouts.x), ("center_y", rollouts.y), ("center_z", rollouts.z),
                             ("heading", rollouts.heading)):  # fmt: skip
            values = [[getattr(t, field) for t in scene.simulated_trajectories] for scene in scenes]
            np.testing.assert_array_equal(np.array(values, np.float32), array)
        assert [t.object_id for t in scenes[5].simulated_trajectories] == rollouts.object_id.tolist()


def test_the_same_rollouts_make_the_same_archive(written: Path, tmp_path: Path) -> None:
    write_submission(ROLLOUTS.items(), META, tmp_path / "again.tar.gz", shards=2)
    assert (tmp_path / "again.tar.gz").read_bytes() == written.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.tar.gz"]


def test_field_numbers_of_the_public_format() -> None:
    def numbers(message: Any) -> dict[str, int]:
        return {field.name: field.number for field in message.DESCRIPTOR.fields}

    assert numbers(pb.SimulatedTrajectory) == {
        "center_x": 2, "center_y": 3, "center_z": 4, "heading": 5, "object_id": 6,
    }  # fmt: skip
    assert numbers(pb.JointScene) == {"simulated_trajectories": 1}
    assert numbers(pb.ScenarioRollouts) == {"scenario_id": 1, "joint_scenes": 2}
    assert numbers(Shard)["acknowledge_complies_with_closed_loop_requirement"] == 14
    # Packed: one length-delimited field, not one tag a number.
    wire = pb.SimulatedTrajectory(center_x=[1.0, 2.0], object_id=3).SerializeToString()
    assert wire == b"\x12\x08\x00\x00\x80?\x00\x00\x00@\x30\x03"


def test_the_command(written: Path, scenarios: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["wosac", "validate", str(written), "--scenario", str(scenarios)]) == 0
    assert "3 scenarios in 2 shards, all well" in capsys.readouterr().out
    assert main(["wosac", "validate", str(written)]) == 0
    assert "Not checked" in capsys.readouterr().out


def test_an_odd_box_is_in_the_submission_nevertheless(tmp_path: Path) -> None:
    record = womd_record()
    for state in record.tracks[1].states:
        state.length = 0
    write_records(tmp_path / "a", [record.SerializeToString()])
    agent = load_agent("constant_velocity")
    ((name, found),) = simulated_scenarios(agent, tmp_path / "a", WosacSettings())
    write_records(tmp_path / "b", [womd_record().SerializeToString()])
    ((_, whole),) = simulated_scenarios(agent, tmp_path / "b", WosacSettings())
    assert name == record.scenario_id
    order = np.argsort(found.object_id)
    assert found.object_id[order].tolist() == whole.object_id.tolist()
    driven = [0, 2]
    for values in ("x", "y", "z", "heading"):
        mine = getattr(found, values)[:, order]
        np.testing.assert_array_equal(mine[:, driven], getattr(whole, values)[:, driven])
    # Who is left out goes on at its velocity.
    now = record.tracks[1].states[10]
    steps = 0.1 * np.arange(1, 81)
    np.testing.assert_allclose(found.x[0, order[1]], now.center_x + now.velocity_x * steps, atol=1e-3)
    np.testing.assert_allclose(found.y[0, order[1]], now.center_y + now.velocity_y * steps, atol=1e-3)


def test_the_command_refuses(scenarios: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shards = good_shards()
    shards[0].scenario_rollouts[0].joint_scenes[4].simulated_trajectories[1].center_y[7] = np.nan
    path = pack(tmp_path / "wrong.tar.gz", named(shards))
    assert main(["wosac", "validate", str(path), "--scenario", str(scenarios)]) == 1
    error = capsys.readouterr().err
    assert "segment aaaa, field center_y: rollout 4, agent 101: not finite at future step 7" in error
    assert "1 problem" in error
    assert main(["wosac", "validate", str(tmp_path / "absent.tar.gz")]) == 1
    assert "absent.tar.gz" in capsys.readouterr().err


def scene(shards: list[Shard], number: int = 2) -> Any:
    return shards[0].scenario_rollouts[1].joint_scenes[number]


def trajectory(shards: list[Shard]) -> Any:
    return scene(shards).simulated_trajectories[1]


def drop(field: str) -> Callable[[list[Shard]], None]:
    def change(shards: list[Shard]) -> None:
        for shard in shards:
            shard.ClearField(field)  # type: ignore[arg-type]

    return change


def put(field: str, value: Any) -> Callable[[list[Shard]], None]:
    def change(shards: list[Shard]) -> None:
        for shard in shards:
            setattr(shard, field, value)

    return change


def twice(shards: list[Shard]) -> None:
    shards[1].scenario_rollouts.append(shards[0].scenario_rollouts[0])


def swap_agent(shards: list[Shard]) -> None:
    trajectory(shards).object_id = 777


def repeat_agent(shards: list[Shard]) -> None:
    trajectory(shards).object_id = 100


@pytest.mark.parametrize(("change", "texts"), [
    (lambda s: s[1].ClearField("scenario_rollouts"), ["segment bbbb, field scenario_id: missing"]),
    (twice, ["segment aaaa, field scenario_id: more than once"]),
    (lambda s: setattr(s[0].scenario_rollouts[0], "scenario_id", "zzzz"),
     ["segment zzzz, field scenario_id: none of the scenarios", "segment aaaa, field scenario_id: missing"]),
    (lambda s: s[0].scenario_rollouts[0].ClearField("scenario_id"),
     ["field scenario_id: missing", "segment aaaa, field scenario_id: missing"]),
    (lambda s: s[0].scenario_rollouts[1].joint_scenes.pop(), ["segment cccc, field joint_scenes: 31 rollouts"]),
    (lambda s: s[0].scenario_rollouts[1].joint_scenes.append(scene(s)),
     ["segment cccc, field joint_scenes: 33 rollouts"]),
    (lambda s: scene(s).simulated_trajectories.pop(),
     ["segment cccc, field object_id: rollout 2: agent 102 missing"]),
    (lambda s: scene(s).ClearField("simulated_trajectories"),
     ["rollout 2: no agents", "rollout 2: agents 100, 101, 102 missing"]),
    (swap_agent, ["rollout 2: agent 101 missing", "rollout 2: agent 777 not to be simulated"]),
    (repeat_agent, ["rollout 2: agent 100 more than once", "rollout 2: agent 101 missing"]),
    (lambda s: trajectory(s).ClearField("object_id"),
     ["agent 101 missing", "agent 0 not to be simulated", "agent 0: missing"]),
    (lambda s: trajectory(s).center_x.pop(),
     ["segment cccc, field center_x: rollout 2, agent 101: 79 steps, expected 80"]),
    (lambda s: trajectory(s).heading.append(0.0), ["field heading: rollout 2, agent 101: 81 steps"]),
    (lambda s: trajectory(s).center_z.__setitem__(3, np.inf), ["field center_z: rollout 2, agent 101: not finite"]),
    (drop("submission_type"), ["field submission_type: is 0, expected 1"] * 2),
    (put("submission_type", 2), ["field submission_type: is 2, expected 1"] * 2),
    (drop("account_name"), ["field account_name: '' is no e-mail address"] * 2),
    (put("unique_method_name", " "), ["field unique_method_name: missing"] * 2),
    (drop("uses_lidar_data"), ["field uses_lidar_data: missing"] * 2),
    (drop("uses_camera_data"), ["field uses_camera_data: missing"] * 2),
    (drop("uses_public_model_pretraining"), ["field uses_public_model_pretraining: missing"] * 2),
    (put("uses_public_model_pretraining", True), ["field public_model_names: missing"] * 2),
    (drop("num_model_parameters"), ["field num_model_parameters: ''"] * 2),
    (put("num_model_parameters", "many"), ["field num_model_parameters: 'many'"] * 2),
    (put("acknowledge_complies_with_closed_loop_requirement", False),
     ["field acknowledge_complies_with_closed_loop_requirement: not acknowledged"] * 2),
    (lambda s: setattr(s[1], "affiliation", "Elsewhere"), ["metadata differ from those of"]),
])  # fmt: skip
def test_broken_submissions(tmp_path: Path, change: Callable[[list[Shard]], None], texts: list[str]) -> None:
    shards = good_shards()
    change(shards)
    found = problems(pack(tmp_path / "wrong.tar.gz", named(shards)))
    assert len(found) == len(texts)
    for problem, text in zip(found, texts, strict=True):
        assert text in problem
        assert "wrong.tar.gz" in problem


@pytest.mark.parametrize(
    ("text", "field"),
    [
        (META.account_name, "account_name"),
        (META.num_model_parameters, "num_model_parameters"),
        (META.affiliation, "affiliation"),
        ("cccc", "scenario_id"),
    ],
)
def test_text_that_is_not_utf8_is_named(text: str, field: str, tmp_path: Path) -> None:
    bad = b"\xff" + text.encode()[1:]
    shards = {name: data.replace(text.encode(), bad) for name, data in named(good_shards()).items()}
    found = problems(pack(tmp_path / "wrong.tar.gz", shards))
    assert any(f"field {field}: " in problem and "is not UTF-8" in problem for problem in found), found


def test_without_the_scenarios_rollouts_are_compared_with_each_other(tmp_path: Path) -> None:
    shards = good_shards()
    assert problems(pack(tmp_path / "good.tar.gz", named(shards)), None) == []
    swap_agent(shards)
    found = problems(pack(tmp_path / "wrong.tar.gz", named(shards)), None)
    assert [text.rpartition(": ")[2] for text in found] == [
        "agent 101 missing",
        "agent 777 not to be simulated",
    ]


@pytest.mark.parametrize(("rename", "text"), [
    (lambda name: "part" + name[-14:], "not a shard"),
    (lambda name: name.replace("of-00002", "of-00003"), "shard 2 of 3 missing"),
    (lambda name: name.replace("00001-of", "00005-of"), "shard 1 of 2 missing"),
    (lambda name: name.replace("00001-of-00002", "00001-of-00004"), "different numbers of shards: 2, 4"),
])  # fmt: skip
def test_names_of_shards(tmp_path: Path, rename: Callable[[str], str], text: str) -> None:
    shards = {rename(name): content for name, content in named(good_shards()).items()}
    assert any(text in problem for problem in problems(pack(tmp_path / "wrong.tar.gz", shards)))


@pytest.mark.parametrize(("content", "text"), [
    (bytes(1 << 20), "no field has the number 0"),
    (b"\x10\x00" * (1 << 20), "beside the scenarios"),
])  # fmt: skip
def test_a_shard_of_padding_is_refused_soon(tmp_path: Path, content: bytes, text: str) -> None:
    """However large it is; read to the end, gigabytes of zeros took minutes."""
    shards = named(good_shards()) | {shard_name(1, 2): content}
    found = problems(pack(tmp_path / "wrong.tar.gz", shards))
    assert any(text in problem for problem in found)


def test_shards_may_be_counted_from_one(tmp_path: Path) -> None:
    names = (shard_name(1, 2), shard_name(2, 2))
    shards = dict(zip(names, named(good_shards()).values(), strict=True))
    assert problems(pack(tmp_path / "good.tar.gz", shards)) == []


def test_damaged_archives(written: Path, tmp_path: Path) -> None:
    content = written.read_bytes()
    unzipped = gzip.decompress(content)
    flipped = bytearray(content)
    flipped[-6] ^= 0xFF  # The checksum.
    middle = bytearray(content)
    middle[len(middle) // 2] ^= 0xFF
    for name, wrong in (
        ("cut", content[: len(content) // 2]),
        ("short", content[:-4]),
        ("flipped", bytes(flipped)),
        ("middle", bytes(middle)),
        ("plain", unzipped),
        ("empty", b""),
        ("text", gzip.compress(b"nothing of the kind" * 100)),
        ("cut inside", gzip.compress(unzipped[: len(unzipped) // 2])),
    ):
        path = tmp_path / f"{name}.tar.gz"
        path.write_bytes(wrong)
        found = problems(path)
        assert any("damaged" in problem for problem in found), name


def test_archives_without_shards(tmp_path: Path) -> None:
    assert any("no shards found" in problem for problem in problems(pack(tmp_path / "none.tar.gz", {})))


@pytest.mark.parametrize(
    "wrong", [b"\x0a\xff\xff\xff\x7f", b"\x0a\x02\xff\xff", b"\x0d\x00\x00\x00\x00", b"\x0a"]
)
def test_a_shard_that_is_no_message(tmp_path: Path, wrong: bytes) -> None:
    shards = named(good_shards())
    shards[shard_name(0, 2)] = wrong
    found = problems(pack(tmp_path / "wrong.tar.gz", shards))
    assert any("damaged" in problem and shard_name(0, 2) in problem for problem in found)


def test_problems_are_counted_beyond_those_kept(tmp_path: Path) -> None:
    shards = good_shards()
    for scenario in (*shards[0].scenario_rollouts, *shards[1].scenario_rollouts):
        for joint in scenario.joint_scenes:
            for each in joint.simulated_trajectories:
                for field in ("center_x", "center_y", "center_z", "heading"):
                    getattr(each, field).pop()
    report = check_submission(pack(tmp_path / "wrong.tar.gz", named(shards)), AGENTS)
    assert (report.count, len(report.problems)) == (3 * 32 * 3 * 4, 1000)


def arrays(**changes: Any) -> RolloutArrays:
    return replace(ROLLOUTS["aaaa"], **changes)


def with_nan(values: Any) -> Any:
    values = values.copy()
    values[1, 2, 3] = np.nan
    return values


@pytest.mark.parametrize(("rollouts", "field", "text"), [
    (arrays(x=ROLLOUTS["aaaa"].x[:31]), "x", "has shape"),
    (arrays(heading=ROLLOUTS["aaaa"].heading[..., :79]), "heading", "has shape"),
    (arrays(z=with_nan(ROLLOUTS["aaaa"].z)), "z", "agent 102, rollout 1, future step 3: not finite"),
    (arrays(y=ROLLOUTS["aaaa"].y.astype(float) * 1e40), "y", "not finite"),
    (arrays(object_id=np.array([100, 101, 100])), "object_id", "agent 100 more than once"),
    (arrays(object_id=np.array([100, 101, 2**31])), "object_id", "agent 2147483648 has no number of 32 bits"),
    (arrays(object_id=np.array([[100], [101], [102]])), "object_id", "has shape"),
])  # fmt: skip
def test_rollouts_that_are_not_written(
    tmp_path: Path, rollouts: RolloutArrays, field: str, text: str
) -> None:
    with pytest.raises(DataError, match=text) as caught:
        write_submission([("aaaa", rollouts)], META, tmp_path / "made.tar.gz", shards=1)
    assert (caught.value.segment, caught.value.field) == ("aaaa", field)
    assert list(tmp_path.iterdir()) == []


def test_submissions_that_are_not_written(tmp_path: Path) -> None:
    out = tmp_path / "made.tar.gz"
    with pytest.raises(DataError, match="more than once"):
        write_submission([("aaaa", arrays()), ("aaaa", arrays())], META, out, shards=1)
    with pytest.raises(ConfigError, match="don't fill 2 shards"):
        write_submission([("aaaa", arrays())], META, out, shards=2)
    with pytest.raises(ConfigError, match="at least 1"):
        write_submission([], META, out, shards=0)
    with pytest.raises(ConfigError, match="ends in"):
        write_submission([("aaaa", arrays())], META, tmp_path / "made.tar", shards=1)
    silent = replace(META, acknowledge_complies_with_closed_loop_requirement=False)
    with pytest.raises(ConfigError, match="not acknowledged"):
        write_submission([("aaaa", arrays())], silent, out, shards=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.samples
def test_rollouts_of_a_real_scenario(samples: Path, tmp_path: Path) -> None:
    file = samples.parent / "wosac" / "case_637f20cafde22ff8_a_official_submission.npz"
    if not file.is_file():
        pytest.skip(f"no rollouts at {file}")
    out = tmp_path / "made.tar.gz"
    assert write_submission([("637f20cafde22ff8", read_rollouts(file))], META, out, shards=1) == 1
    assert main(["wosac", "validate", str(out), "--scenario", str(samples / "womd")]) == 0
