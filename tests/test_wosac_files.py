"""`symphony wosac score` and submissions: files in, numbers or archives out, and errors that say where."""

from __future__ import annotations

import gzip
import io
import json
import os
import tarfile
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from helpers_sources import write_records
from helpers_wosac import META, record_rollouts, womd_record
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import WosacSettings
from symphony.errors import DataError, SymphonyError
from symphony.wosac import check_submission, write_submission
from symphony.wosac import submission as submissions
from symphony.wosac import wosac_pb2 as pb
from symphony.wosac.files import read_rollouts, score_files
from symphony.wosac.records import logged_scenario, read_scenarios, simulated_ids
from symphony.wosac.scorer import CHALLENGES, score
from symphony.wosac.scorer.scenario import STATES
from symphony.wosac.simulate import simulated_scenarios
from symphony.wosac.submission import FIELDS, meta_message, required_agents, scenario_message, shard_name

NAMES = ("aaaa", "bbbb", "cccc")


def write(folder, *records):
    path = folder / "made.tfrecord"
    write_records(path, [record.SerializeToString() for record in records])
    return path


def written(folder, *names):
    """A file with scenarios and a folder of their rollouts."""
    (folder / "rollouts").mkdir()
    for seed, name in enumerate(names):
        np.savez(folder / "rollouts" / name, **vars(record_rollouts(womd_record(name), seed=seed % 3)))
    return write(folder, *map(womd_record, names)), folder / "rollouts"


def run(scenario, rollouts, *more):
    return main(["wosac", "score", "--scenario", str(scenario), "--rollouts", str(rollouts), *map(str, more)])


@pytest.fixture
def refused(capsys):
    def check(scenario, rollouts, *texts):
        assert run(scenario, rollouts) == 1
        error = capsys.readouterr().err
        assert all(text in error for text in texts), error

    return check


def test_scores_of_scenarios(tmp_path, monkeypatch, capsys):
    many, out, again, ahead = written(tmp_path, *NAMES, "dddd"), tmp_path / "a.json", tmp_path / "b.json", []
    more = ("--config", "2024", "--per-object")
    assert run(*many, *more) == 1
    assert "--per-object adds to the JSON" in capsys.readouterr().err
    assert run(*many, "--json", out, *more) == 0
    found = json.loads(out.read_text())
    assert (found["config"], found["scenario_count"]) == ("2024", 4)
    assert [part["scenario_id"] for part in found["scenarios"]] == [*NAMES, "dddd"]
    first, *_, last = ({k: v for k, v in one.items() if k != "scenario_id"} for one in found["scenarios"])
    expected = score(logged_scenario(womd_record()), record_rollouts(womd_record()), CHALLENGES["2024"])
    assert {name: first[name] for name in expected} == expected
    for name in expected:
        assert found[name] == pytest.approx(np.mean([part[name] for part in found["scenarios"]]))
    # What a scenario scores does not depend on those before it: the first one comes again.
    assert (first, [part["object_id"] for part in first["objects"]]) == (last, [100, 102])
    # The folder of the scenario file, and a pattern, mean the same; so do two workers.
    for scenario, how in ((tmp_path, ()), (tmp_path / "*.tfrecord", ("--workers", "2"))):
        assert run(scenario, many[1], "--json", again, *more, *how) == 0
        assert again.read_text() == out.read_text()
    # Scenarios are read as they are scored.
    drawn = []
    counted = lambda path: (drawn.append(packed) or packed for packed in read_scenarios(path))  # noqa: E731
    monkeypatch.setattr("symphony.wosac.files.read_scenarios", counted)
    score_files(*many, progress=lambda done, total: ahead.append((len(drawn) - done, total)))
    assert ahead == [(0, 4)] * 4


def without_edges(record):
    for edge in [feature for feature in record.map_features if feature.HasField("road_edge")]:
        record.map_features.remove(edge)


def without_vehicles(record):
    for track in record.tracks:
        track.object_type = 2


def without_future(record):
    for state in (state for track in record.tracks for state in track.states[11:]):
        state.valid = False


@pytest.mark.parametrize(("change", "why"), [
    (without_edges, "no road edge"), (without_vehicles, "time_to_collision"),
    (without_future, "valid at no step that could be scored"),
])  # fmt: skip
def test_a_scenario_that_cannot_be_scored_ends_no_others(change, why, tmp_path, refused, capsys):
    many, records, out = written(tmp_path, *NAMES), list(map(womd_record, NAMES)), tmp_path / "scores.json"
    change(records[1])
    write(tmp_path, *records)
    assert run(*many, "--json", out) == 0
    assert why in capsys.readouterr().err
    found = json.loads(out.read_text())
    assert [part["scenario_id"] for part in found["scenarios"]] == ["aaaa", "cccc"]
    assert [part["segment"] for part in found["left_out"]] == ["bbbb"]
    assert found["min_ade"] == pytest.approx(np.mean([part["min_ade"] for part in found["scenarios"]]))
    assert run(*many, "--strict") == 1
    assert "segment bbbb" in capsys.readouterr().err
    for record in records:
        change(record)
    refused(write(tmp_path, *records), many[1], "segment aaaa", why.partition(" ")[0])


def test_sets_that_do_not_fit(tmp_path, refused):
    scenarios, rollouts = written(tmp_path, *NAMES)
    refused(scenarios, rollouts / "aaaa.npz", "aaaa.npz", "bbbb among them")
    np.savez(rollouts / "dddd.npz", **vars(record_rollouts(womd_record("dddd"))))
    refused(scenarios, rollouts, "not in", "dddd")
    for name in ("bbbb", "dddd"):
        (rollouts / f"{name}.npz").unlink()
    refused(scenarios, rollouts, "no rollouts of scenario bbbb", str(rollouts))
    assert run(scenarios, rollouts, "--partial", "--json", tmp_path / "scores.json") == 0
    found = json.loads((tmp_path / "scores.json").read_text())
    assert [part["scenario_id"] for part in found["scenarios"]] == ["aaaa", "cccc"]
    refused(scenarios, tmp_path / "absent.npz", "absent.npz", "No such file")
    (tmp_path / "empty").mkdir()
    refused(scenarios, tmp_path / "empty", "no .npz files")
    refused(tmp_path / "empty", rollouts, "no scenario files")
    twice = write(tmp_path, womd_record("aaaa"), womd_record("aaaa"))
    refused(twice, rollouts, "more than once", "scenario_id")


@pytest.mark.parametrize(("field", "change", "texts"), [
    ("heading", None, ("field heading: missing",)),
    ("object_id", lambda a: a.astype(float), ("object_id", "whole numbers")),
    ("x", lambda a: a[:31], ("field x", "(31, 3, 80), expected (32, 3, 80)")),
    ("z", lambda a: a.astype(int), ("field z", "floating-point")),
    ("y", lambda a: a.astype(object), ("field y", "damaged: an array of objects")),
])  # fmt: skip
def test_wrong_rollouts(tmp_path, refused, field, change, texts):
    arrays = dict(vars(record_rollouts(womd_record("aaaa"))))
    array = arrays.pop(field)
    np.savez(tmp_path / "wrong.npz", **arrays, **({field: change(array)} if change else {}))
    refused(write(tmp_path, womd_record("aaaa")), tmp_path / "wrong.npz", "wrong.npz", *texts)


def test_damaged_files(tmp_path, refused):
    def flipped(content):
        middle = len(content) // 3
        return content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]

    scenario, folder = written(tmp_path, "aaaa")
    rollouts, wrong = (folder / "aaaa.npz").read_bytes(), tmp_path / "wrong.npz"
    for content in (b"", b"nothing of the kind", rollouts[: len(rollouts) // 2], flipped(rollouts)):
        wrong.write_bytes(content)
        refused(scenario, wrong, "wrong.npz", "damaged")
    scenario.write_bytes(flipped(scenario.read_bytes()))
    refused(scenario, folder, "made.tfrecord", "record 0", "checksum")
    write_records(scenario, [b"\xff\xff"])
    refused(scenario, folder, "made.tfrecord", "not a Scenario message")


def hide_current(record):
    record.tracks[0].states[10].valid = False


def cut_to_history(record):
    del record.timestamps_seconds[11:]
    for track in record.tracks:
        del track.states[11:]


def at_times(record, every, jitter):
    record.timestamps_seconds[:] = [every * k + jitter * (k % 2) for k in range(91)]


@pytest.mark.parametrize(("change", "texts"), [
    (hide_current, ("tracks_to_predict", "agent 100 to be scored, but not valid at step 10")),
    (cut_to_history, ("timestamps_seconds", "11 steps, needs 91")),
    (lambda r: setattr(r, "current_time_index", 9), ("current_time_index", "is 9")),
    (lambda r: setattr(r, "sdc_track_index", 3), ("sdc_track_index", "outside the 3 tracks")),
    (lambda r: r.tracks_to_predict.add(track_index=-1), ("tracks_to_predict", "outside the 3 tracks")),
    (lambda r: setattr(r, "scenario_id", ""), ("record 0, scenario_id", "missing")),
    (lambda r: r.tracks[1].states.pop(), ("tracks.states", "agent 101 has 90 states for 91 steps")),
    (lambda r: r.dynamic_map_states.pop(), ("dynamic_map_states", "90 entries for 91 steps")),
    (lambda r: r.timestamps_seconds.__setitem__(5, 0.7), ("timestamps_seconds", "steps are not of 0.1 s")),
    (lambda r: at_times(r, 0.105, 0), ("timestamps_seconds", "steps are not of 0.1 s")),
    (lambda r: setattr(r.tracks[2], "id", 101), ("object_id", "agent 101 more than once")),
])  # fmt: skip
def test_wrong_scenarios(tmp_path, refused, change, texts):
    record = womd_record("aaaa")
    np.savez(tmp_path / "aaaa.npz", **vars(record_rollouts(record)))
    change(record)
    refused(write(tmp_path, record), tmp_path / "aaaa.npz", "made.tfrecord", *texts)


def test_records_are_taken_as_they_are():
    record = womd_record()
    at_times(record, 0.1, 0.03)  # Recordings jitter.
    record.tracks[0].states[4].heading = 9.0
    found, logged = logged_scenario(record), record.tracks[1].states[20]
    assert found.heading[0, 4] == 9.0
    assert found.position[1, 20].tolist() == [getattr(logged, f"center_{c}") for c in "xyz"]
    assert found.evaluated.tolist() == [100, 102]
    assert (found.signal_lane == 11).all()
    assert found.signal_state.tolist() == [4] * 3 + [6] * 88
    hide_current(record)
    cut_to_history(record)
    assert simulated_ids(record) == [101, 102]
    del record.tracks[1].states[10:]
    with pytest.raises(DataError, match="agent 101 has 10 states"):
        simulated_ids(record)


@pytest.mark.parametrize("kind", ["<f8", ">f4", "<f2", np.longdouble])
def test_numbers_may_be_of_any_width_and_byte_order(tmp_path, kind):
    arrays = dict(vars(record_rollouts(womd_record(), 2)))
    ids = arrays.pop("object_id").astype(">i2")
    # Near the origin, where two bytes are enough.
    near = {name: (array % 8).astype(kind) for name, array in arrays.items()}
    np.savez(tmp_path / "made.npz", object_id=ids, **near)
    found = read_rollouts(tmp_path / "made.npz")
    np.testing.assert_array_equal(found.x, near["x"])
    found.check(logged_scenario(womd_record()).sim_agents, count=2)


ROLLOUTS = {name: record_rollouts(womd_record(name), seed=seed) for seed, name in enumerate(NAMES)}
AGENTS = {name: [100, 101, 102] for name in NAMES}

Shard = pb.SimAgentsChallengeSubmission


def archive(shards):
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:gz", compresslevel=1) as packed:
        for name, content in shards:  # names may come twice
            member = tarfile.TarInfo(name)
            member.size = len(content)
            packed.addfile(member, io.BytesIO(content))
    return file.getvalue()


def found_in(content, required=AGENTS):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "some.tar.gz")
        path.write_bytes(content)
        return [str(problem) for problem in check_submission(path, required).problems]


GOOD = []
for names in (NAMES[::2], NAMES[1::2]):
    shard = meta_message(META)
    shard.scenario_rollouts.extend(scenario_message(name, ROLLOUTS[name]) for name in names)
    GOOD.append(shard.SerializeToString())


def named(shards):
    return [(shard_name(k, len(shards)), shard.SerializeToString()) for k, shard in enumerate(shards)]


@pytest.fixture
def shards():
    return [Shard.FromString(content) for content in GOOD]


@pytest.fixture(scope="module")
def submission(tmp_path_factory):
    """An archive and the scenarios that it is for."""
    folder = tmp_path_factory.mktemp("submission")
    assert write_submission(iter(ROLLOUTS.items()), META, folder / "made.tar.gz", shards=2) == 3
    write_records(folder / "made.tfrecord", [womd_record(name).SerializeToString() for name in NAMES])
    return folder / "made.tar.gz", folder / "made.tfrecord"


def test_what_is_written_can_be_read_and_is_all_well(submission, tmp_path):
    assert required_agents(submission[1]) == AGENTS
    report = check_submission(submission[0], AGENTS)
    assert (report.problems, len(report.shards), report.scenarios) == ([], 2, set(NAMES))
    found = {}
    with tarfile.open(submission[0], "r:gz") as packed:
        assert packed.getnames() == [shard_name(0, 2), shard_name(1, 2)]
        for member in packed:
            shard = Shard.FromString(packed.extractfile(member).read())
            assert (shard.submission_type, shard.account_name) == (1, "somebody@example.org")
            assert (shard.HasField("uses_camera_data"), list(shard.authors)) == (True, ["A", "B"])
            found |= {scenario.scenario_id: scenario for scenario in shard.scenario_rollouts}
    for name, rollouts in ROLLOUTS.items():
        scenes = found[name].joint_scenes
        for state, field in FIELDS.items():
            values = [[getattr(t, field) for t in scene.simulated_trajectories] for scene in scenes]
            np.testing.assert_array_equal(np.array(values, np.float32), getattr(rollouts, state))
        assert [t.object_id for t in scenes[5].simulated_trajectories] == rollouts.object_id.tolist()
    # The same rollouts make the same archive, and nothing else is left behind.
    write_submission(ROLLOUTS.items(), META, tmp_path / "again.tar.gz", shards=2)
    assert (tmp_path / "again.tar.gz").read_bytes() == submission[0].read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.tar.gz"]


def test_drafts_of_killed_processes_go_and_full_disks_are_told(tmp_path, monkeypatch):
    dead, lives = (tmp_path / f".x.tar.gz.{process}.abcd_1234" for process in (2**40, os.getppid()))
    dead.mkdir(), lives.mkdir(), write_submission(ROLLOUTS.items(), META, out := tmp_path / "x.tar.gz", shards=1)
    assert {*tmp_path.iterdir()} == {lives, out}
    monkeypatch.setattr(submissions, "_pack", lambda *_: os.stat("/nowhere"))
    with pytest.raises(DataError, match=r"x\.tar\.gz: can't be written"):
        write_submission(ROLLOUTS.items(), META, out, shards=1)
    with pytest.raises(DataError, match="scenario_id: missing"):
        write_submission([("", next(iter(ROLLOUTS.values())))], META, out, shards=1)
    with pytest.raises(SymphonyError, match="config must be one of"):
        score_files(tmp_path, tmp_path, config="2023")


def test_field_numbers_of_the_public_format():
    # Packed: one length-delimited field, not one tag a number.
    track = pb.SimulatedTrajectory(center_x=[1.0, 2.0], heading=[1.0], object_id=3)
    wire = b"\x12\x08\x00\x00\x80?\x00\x00\x00@\x2a\x04\x00\x00\x80?\x30\x03"
    assert track.SerializeToString() == wire
    scene = pb.JointScene(simulated_trajectories=[track])
    rollouts = pb.ScenarioRollouts(scenario_id="a", joint_scenes=[scene])
    assert rollouts.SerializeToString() == b"\x0a\x01a\x12\x14\x0a\x12" + wire
    assert Shard.DESCRIPTOR.fields_by_name["acknowledge_complies_with_closed_loop_requirement"].number == 14


def test_the_command(submission, shards, tmp_path, capsys):
    path, scenarios = tmp_path / "wrong.tar.gz", ("--scenario", str(submission[1]))
    assert main(["wosac", "validate", str(submission[0]), *scenarios]) == 0
    assert main(["wosac", "validate", str(submission[0])]) == 0
    assert "Not checked" in capsys.readouterr().out
    shards[0].scenario_rollouts[0].joint_scenes[4].simulated_trajectories[1].center_y[7] = np.nan
    path.write_bytes(archive(named(shards)))
    assert main(["wosac", "validate", str(path), *scenarios]) == 1
    error = capsys.readouterr().err
    assert "segment aaaa, field center_y: rollout 4: agent 101, step 18: not finite" in error


def test_an_odd_box_is_in_the_submission_nevertheless(tmp_path):
    record, found = womd_record(), []
    agent = replace(load_agent("constant_velocity"), name="made")
    record.timestamps_seconds[10] += 0.02  # Recordings jitter; the challenge takes every step for 0.1 s.
    for state in record.tracks[0].states[11:]:
        state.center_x += 5000  # What comes later is not known.
    for state in record.tracks[1].states:
        state.length = 0
    for one in (record, womd_record()):
        found += list(simulated_scenarios(agent, write(tmp_path, one), WosacSettings()))
    (_, odd), (_, whole) = found
    order = np.argsort(odd.object_id)
    assert odd.object_id[order].tolist() == whole.object_id.tolist()
    for values in STATES:
        mine = getattr(odd, values)[:, order]
        np.testing.assert_array_equal(mine[:, [0, 2]], getattr(whole, values)[:, [0, 2]])
    # Who is left out goes on at its velocity.
    now, steps = record.tracks[1].states[10], 0.1 * np.arange(1, 81)
    np.testing.assert_allclose(odd.x[0, order[1]], now.center_x + now.velocity_x * steps, atol=1e-3)
    at_times(record, 0.2, 0)
    with pytest.raises(DataError, match=r"timestamps_seconds: steps are not of 0\.1 s"):
        list(simulated_scenarios(agent, write(tmp_path, record), WosacSettings()))


def scene(shards):
    return shards[0].scenario_rollouts[1].joint_scenes[2]


def track(shards):
    return scene(shards).simulated_trajectories[1]


def put(field, value=None):
    """Another value in every shard, or none."""
    return lambda shards: [s.ClearField(field) if value is None else setattr(s, field, value) for s in shards]


@pytest.mark.parametrize(("change", "texts"), [
    (lambda s: s[1].ClearField("scenario_rollouts"), ["segment bbbb, field scenario_id: missing"]),
    (lambda s: s[1].scenario_rollouts.append(s[0].scenario_rollouts[0]), ["segment aaaa, field scenario_id: more"]),
    (lambda s: setattr(s[0].scenario_rollouts[0], "scenario_id", "zzzz"), ["segment zzzz, field", "segment aaaa, "]),
    (lambda s: s[0].scenario_rollouts[0].ClearField("scenario_id"), ["field scenario_id: missing", "segment aaaa"]),
    (lambda s: s[0].scenario_rollouts[1].joint_scenes.pop(), ["segment cccc, field joint_scenes: 31 rollouts"]),
    (lambda s: scene(s).simulated_trajectories.pop(), ["cccc, field object_id: rollout 2: agent 102 missing"]),
    (lambda s: scene(s).ClearField("simulated_trajectories"), ["rollout 2: agents 100, 101, 102 missing"]),
    (lambda s: setattr(track(s), "object_id", 777), ["rollout 2: agent 101 missing"]),
    (lambda s: setattr(track(s), "object_id", 100), ["rollout 2: agent 100 more than once"]),
    (lambda s: scene(s).simulated_trajectories.add(object_id=7), ["agent 7 in the rollouts, but not valid"]),
    (lambda s: track(s).center_x.pop(), ["cccc, field center_x: rollout 2: agent 101: 79 steps"]),
    (lambda s: track(s).center_z.__setitem__(3, np.inf), ["field center_z: rollout 2: agent 101, step 14: not"]),
    (put("submission_type", 2), ["field submission_type: is 2"] * 2),
    (put("account_name"), ["field account_name: "] * 2),
    (put("unique_method_name", " "), ["field unique_method_name: missing"] * 2),
    (put("uses_lidar_data"), ["field uses_lidar_data: missing"] * 2),
    (put("uses_public_model_pretraining", True), ["field public_model_names: missing"] * 2),
    (put("num_model_parameters", "many"), ["field num_model_parameters: 'many'"] * 2),
    (put("acknowledge_complies_with_closed_loop_requirement", False), ["field acknowledge_complies"] * 2),
    (lambda s: setattr(s[1], "affiliation", "Elsewhere"), ["metadata differ"]),
])  # fmt: skip
def test_broken_submissions(shards, change, texts):
    change(shards)
    found = found_in(archive(named(shards)))
    assert len(found) == len(texts)
    assert all(text in one and "some.tar.gz" in one for one, text in zip(found, texts, strict=True))


def test_without_the_scenarios_rollouts_are_compared_with_each_other(shards):
    assert found_in(archive(named(shards)), None) == []
    track(shards).object_id = 777
    assert "agent 101 missing" in found_in(archive(named(shards)), None)[0]


@pytest.mark.parametrize(("rename", "text"), [
    (lambda name: name.replace("00000-of", "00002-of"), ""),  # Counted from 1.
    (lambda name: "part" + name[-14:], "not a shard"),
    (lambda name: name.replace("of-00002", "of-00003"), "shards 0, 1 of 3"),
    (lambda name: name.replace("00001-of", "00000-of"), "shards 0, 0 of 2"),
    (lambda name: name.replace("00001-of-00002", "00001-of-00004"), "2 different numbers of shards"),
])  # fmt: skip
def test_names_of_shards(shards, rename, text):
    found = found_in(archive([(rename(name), content) for name, content in named(shards)]))
    assert any(text in problem for problem in found) if text else found == []
    assert any("no shards found" in problem for problem in found_in(archive([])))


@pytest.mark.parametrize("wrong", [
    *(b"\x0a\xff\xff\xff\x7f", b"\x0a\x02\xff\xff", b"\x0d\x00\x00\x00\x00", b"\x0a", bytes(1 << 20)),
    *(b"\x0a\xff\xff\xff\xff\xff", GOOD[0].replace(b"Nowhere", b"\xffowhere"), GOOD[0].replace(b"aaaa", b"\xffaaa")),
])  # fmt: skip
def test_a_shard_that_is_no_message(wrong):
    found = found_in(archive([(shard_name(0, 2), wrong), (shard_name(1, 2), GOOD[1])]))
    assert any(shard_name(0, 2) in one for one in found)


def unzipped(content):
    try:
        return gzip.decompress(content)
    except (OSError, EOFError, zlib.error):
        return None


@settings(max_examples=10)
@given(st.floats(0, 1), st.integers(1, 255), st.booleans())
def test_damaged_bytes_are_found(submission, place, change, cut):
    good = submission[0].read_bytes()
    # What comes before, time and name, means nothing.
    begin = good.index(b"\0", 10) + 1
    where = begin + int(place * (len(good) - 1 - begin))
    content = good[:where] + (b"" if cut else bytes([good[where] ^ change]) + good[where + 1 :])
    # Among the zeros at the end another distance copies the same.
    assume(unzipped(content) != unzipped(good))
    assert found_in(content)


def test_damaged_archives(shards):
    content = archive(named(shards))
    inside = gzip.decompress(content)
    half = gzip.compress(inside[: len(inside) // 2])
    for wrong in (content[:-4], inside, b"", gzip.compress(b"nothing of the kind" * 100), half):
        assert any("damaged" in problem for problem in found_in(wrong))


@pytest.mark.parametrize(("changes", "how", "text"), [
    ({"x": ROLLOUTS["aaaa"].x[:31]}, {}, "segment aaaa, field x: has shape"),
    ({"y": ROLLOUTS["aaaa"].y.astype(float) * 1e40}, {}, "segment aaaa, field y: .*not finite"),
    ({"object_id": np.array([100, 101, 100])}, {}, "segment aaaa, field object_id: agent 100 more than once"),
    ({"object_id": np.array([100, 101, 2**31])}, {}, "field object_id: agent 2147483648 has no number of 32 bits"),
    ({}, {"times": 2}, "more than once"), ({}, {"shards": 2}, "don't fill 2 shards"),
    ({}, {"shards": 0}, "at least 1"), ({}, {"name": "made.tar"}, "ends in"),
    ({}, {"meta": replace(META, acknowledge_complies_with_closed_loop_requirement=False)}, "not acknowledged"),
])  # fmt: skip
def test_what_cannot_be_submitted_is_not_written(tmp_path, changes, how, text):
    how = {"times": 1, "shards": 1, "meta": META, "name": "made.tar.gz"} | how
    items = [("aaaa", replace(ROLLOUTS["aaaa"], **changes))] * how["times"]
    with pytest.raises(SymphonyError, match=text):
        write_submission(items, how["meta"], tmp_path / how["name"], shards=how["shards"])
    assert list(tmp_path.iterdir()) == []
