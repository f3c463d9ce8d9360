"""`symphony wosac score`: files in, numbers out, and errors that say where."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_wosac import record_rollouts, womd_record
from symphony.cli import main
from symphony.data.sources import womd_pb2 as pb
from symphony.data.sources.tfrecord import write_records
from symphony.errors import DataError
from symphony.wosac.files import score_files
from symphony.wosac.records import read_scenario_payloads, scenario_arrays, simulated_ids
from symphony.wosac.rollouts import RolloutArrays, read_rollouts, write_rollouts
from symphony.wosac.scorer import CHALLENGE_2024, SimulatedRollouts, WosacScenario, score

NAMES = ("aaaa", "bbbb", "cccc")


def write(folder: Path, *records: pb.Scenario) -> Path:
    path = folder / "made.tfrecord"
    write_records(path, [record.SerializeToString() for record in records])
    return path


@pytest.fixture
def one(tmp_path: Path) -> tuple[Path, Path]:
    """A scenario file and a file of its rollouts."""
    record = womd_record()
    write_rollouts(tmp_path / "rollouts.npz", record_rollouts(record))
    return write(tmp_path, record), tmp_path / "rollouts.npz"


@pytest.fixture
def many(tmp_path: Path) -> tuple[Path, Path]:
    """A file with three scenarios and a folder of their rollouts."""
    folder = tmp_path / "rollouts"
    folder.mkdir()
    for seed, name in enumerate(NAMES):
        write_rollouts(folder / f"{name}.npz", record_rollouts(womd_record(name), seed=seed))
    return write(tmp_path, *map(womd_record, NAMES)), folder


def run(scenario: Path, rollouts: Path, *more: str) -> int:
    return main(["wosac", "score", "--scenario", str(scenario), "--rollouts", str(rollouts), *more])


def refused(capsys: pytest.CaptureFixture[str], scenario: Path, rollouts: Path, *texts: str) -> None:
    assert run(scenario, rollouts) == 1
    error = capsys.readouterr().err
    for text in texts:
        assert text in error


def test_one_scenario(one: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out" / "scores.json"
    assert run(*one, "--config", "2024", "--json", str(out), "--per-object") == 0
    found = json.loads(out.read_text())
    scenario = WosacScenario.of(**scenario_arrays(womd_record()))
    expected = score(scenario, SimulatedRollouts.of(**vars(record_rollouts(womd_record()))), CHALLENGE_2024)
    assert {name: found[name] for name in expected.to_dict()} == expected.to_dict()
    assert (found["config"], found["scenario_count"]) == ("2024", 1)
    (only,) = found["scenarios"]
    assert only["scenario_id"] == "0123456789abcdef"
    assert [part["object_id"] for part in only["objects"]] == [100, 102]
    assert "metametric" in capsys.readouterr().out


def test_features(one: tuple[Path, Path], tmp_path: Path) -> None:
    assert run(*one, "--features", str(tmp_path / "features")) == 0
    with np.load(tmp_path / "features" / "0123456789abcdef.npz") as found:
        assert found["eval_object_id"].tolist() == [100, 102]
        assert found["log_valid"].all()
        assert found["sim_linear_speed"].shape == (32, 2, 80)
        np.testing.assert_allclose(found["log_linear_speed"][:, 5:70], [[10.0] * 65, [12.0] * 65], atol=0.05)


def test_many_scenarios(many: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "scores.json"
    assert run(*many, "--json", str(out)) == 0
    found = json.loads(out.read_text())
    assert [part["scenario_id"] for part in found["scenarios"]] == list(NAMES)
    for name in ("metametric", "linear_speed_likelihood", "min_ade", "simulated_collision_rate"):
        assert found[name] == pytest.approx(np.mean([part[name] for part in found["scenarios"]]))
    # The folder of the scenario file, and a pattern, mean the same; so do two workers.
    for scenario, more in ((tmp_path, ()), (tmp_path / "*.tfrecord", ("--workers", "2"))):
        again = tmp_path / "again.json"
        assert run(scenario, many[1], "--json", str(again), *more) == 0
        assert again.read_text() == out.read_text()


def _without_edges(record: pb.Scenario) -> None:
    kept = [feature for feature in record.map_features if feature.WhichOneof("feature_data") != "road_edge"]
    del record.map_features[:]
    record.map_features.extend(kept)


def _without_vehicles(record: pb.Scenario) -> None:
    for each in record.tracks:
        if each.id in {100, 102}:  # those that are scored
            each.object_type = 2


def _without_future(record: pb.Scenario) -> None:
    for each in record.tracks:
        for state in each.states[11:]:
            state.valid = False


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (_without_edges, "no road edge"),
        (_without_vehicles, "time_to_collision"),
        (_without_future, "valid at no step that could be scored"),
    ],
)
def test_a_scenario_that_cannot_be_scored_ends_no_others(
    change: Any, why: str, many: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records = list(map(womd_record, NAMES))
    change(records[1])
    write(tmp_path, *records)
    out = tmp_path / "scores.json"
    assert run(*many, "--json", str(out)) == 0
    assert "left out: 1 x " in (said := capsys.readouterr().err)
    assert why in said
    assert "(first: bbbb)" in said
    found = json.loads(out.read_text())
    assert [part["scenario_id"] for part in found["scenarios"]] == ["aaaa", "cccc"]
    assert found["scenario_count"] == 2
    assert [part["segment"] for part in found["left_out"]] == ["bbbb"]
    assert found["min_ade"] == pytest.approx(np.mean([part["min_ade"] for part in found["scenarios"]]))
    assert run(*many, "--strict") == 1
    assert "segment bbbb" in capsys.readouterr().err
    for record in records:
        change(record)
    refused(capsys, write(tmp_path, *records), many[1], "segment aaaa", why.partition(" ")[0])


def test_scenarios_are_read_as_they_are_scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"scenario{k:02d}" for k in range(12)]
    write_records(tmp_path / "all.tfrecord", [womd_record(n, tracks=2).SerializeToString() for n in names])
    (tmp_path / "rollouts").mkdir()
    for seed, name in enumerate(names):
        made = record_rollouts(womd_record(name, tracks=2), seed=seed % 3)
        write_rollouts(tmp_path / "rollouts" / f"{name}.npz", made)
    drawn = 0

    def counted(files: list[Path]) -> Iterator[tuple[Path, int, bytes]]:
        nonlocal drawn
        for packed in read_scenario_payloads(files):
            drawn += 1
            yield packed

    monkeypatch.setattr("symphony.wosac.files.read_scenario_payloads", counted)
    ahead = []
    found, left_out = score_files(
        tmp_path / "all.tfrecord",
        tmp_path / "rollouts",
        progress=lambda done, total: ahead.append((drawn - done, total)),
    )
    assert ahead == [(0, 12)] * 12
    assert [one.scenario_id for one in found] == names
    assert not left_out
    # What a scenario scores does not depend on those before it: the first three come again and again.
    assert [one.scores for one in found] == [found[k % 3].scores for k in range(12)]


def test_a_part_of_the_scenarios(
    many: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (many[1] / "bbbb.npz").unlink()
    refused(capsys, *many, "no rollouts of scenario bbbb", str(many[1]))
    out = tmp_path / "scores.json"
    assert run(*many, "--partial", "--json", str(out)) == 0
    assert [part["scenario_id"] for part in json.loads(out.read_text())["scenarios"]] == ["aaaa", "cccc"]


def test_rollouts_of_other_scenarios(many: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    write_rollouts(many[1] / "dddd.npz", record_rollouts(womd_record("dddd")))
    refused(capsys, *many, "not in", "dddd")


def test_one_file_of_rollouts_for_many_scenarios(
    many: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    refused(capsys, many[0], many[1] / "aaaa.npz", "aaaa.npz", "bbbb among them")


def test_the_same_scenario_twice(
    one: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(capsys, write(tmp_path, womd_record(), womd_record()), one[1], "more than once", "scenario_id")


def test_folders_without_anything(
    one: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(capsys, empty, one[1], "no scenario files")
    refused(capsys, one[0], empty, "no .npz files")
    refused(capsys, tmp_path / "absent.tfrecord", one[1], "no scenario files")
    refused(capsys, one[0], tmp_path / "absent.npz", "absent.npz", "No such file")


def without(name: str) -> Any:
    def change(arrays: dict[str, Any]) -> None:
        del arrays[name]

    return change


def put(**changes: Any) -> Any:
    def change(arrays: dict[str, Any]) -> None:
        arrays.update({name: value(arrays[name]) for name, value in changes.items()})

    return change


def with_nan(array: Any) -> Any:
    array = array.copy()
    array[3, 1, 7] = np.nan
    return array


@pytest.mark.parametrize(("change", "texts"), [
    (without("heading"), ("field heading: missing",)),
    (without("object_id"), ("field object_id: missing",)),
    (put(object_id=lambda a: a + 1), ("object_id", "agent 100 missing from the rollouts")),
    (put(object_id=lambda a: a.astype(float)), ("object_id", "whole numbers")),
    (put(object_id=lambda a: a[[0, 1, 1]]), ("object_id", "agent 101 more than once")),
    (put(object_id=lambda a: a[:2]), ("object_id", "agent 102 missing")),
    (put(object_id=lambda a: np.append(a, 999)), ("object_id", "agent 999 in the rollouts, but not valid")),
    (put(x=lambda a: a[:31]), ("field x", "(31, 3, 80), expected (32, 3, 80)")),
    (put(y=lambda a: a[:, :, :79]), ("field y", "(32, 3, 79), expected (32, 3, 80)")),
    (put(z=lambda a: a[0]), ("field z", "(3, 80), expected (32, 3, 80)")),
    (put(z=lambda a: a.astype(int)), ("field z", "floating-point")),
    (put(x=with_nan), ("field x", "agent 101, rollout 3, step 18: not finite")),
    (put(y=lambda a: a.astype(object)), ("field y", "damaged: an array of objects")),
])  # fmt: skip
def test_wrong_rollouts(
    one: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Any,
    texts: tuple[str, ...],
) -> None:
    arrays = dict(vars(read_rollouts(one[1])))
    change(arrays)
    np.savez(tmp_path / "wrong.npz", **arrays)
    refused(capsys, one[0], tmp_path / "wrong.npz", "wrong.npz", *texts)


@pytest.mark.parametrize("content", [b"", b"nothing of the kind", b"PK\x03\x04 and nothing more"])
def test_a_file_that_is_no_archive(
    one: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes
) -> None:
    (tmp_path / "wrong.npz").write_bytes(content)
    refused(capsys, one[0], tmp_path / "wrong.npz", "wrong.npz", "damaged")


def test_damaged_archives(one: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = bytearray(one[1].read_bytes())
    cut = tmp_path / "cut.npz"
    cut.write_bytes(content[: len(content) // 2])
    refused(capsys, one[0], cut, "cut.npz", "damaged")
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "flipped.npz").write_bytes(content)
    refused(capsys, one[0], tmp_path / "flipped.npz", "flipped.npz", "damaged")
    np.save(tmp_path / "array.npy", np.zeros(3))
    refused(capsys, one[0], tmp_path / "array.npy", "array.npy", "expected an .npz archive")


def drop_edges(record: pb.Scenario) -> None:
    kept = [feature for feature in record.map_features if feature.WhichOneof("feature_data") != "road_edge"]
    del record.map_features[:]
    record.map_features.extend(kept)


def hide_current(record: pb.Scenario) -> None:
    record.tracks[0].states[10].valid = False


def cut_to_history(record: pb.Scenario) -> None:
    del record.timestamps_seconds[11:]
    for track in record.tracks:
        del track.states[11:]


def at_times(record: pb.Scenario, every: float, jitter: float) -> None:
    record.timestamps_seconds[:] = [every * k + jitter * (k % 2) for k in range(91)]


@pytest.mark.parametrize(("change", "texts"), [
    (drop_edges, ("road_edge", "no road edge")),
    (hide_current, ("tracks_to_predict", "agent 100 to be scored, but not valid at step 10")),
    (cut_to_history, ("timestamps_seconds", "11 steps, needs 91; the test set's future is not public")),
    (lambda r: setattr(r, "current_time_index", 9), ("current_time_index", "is 9")),
    (lambda r: setattr(r, "sdc_track_index", 3), ("sdc_track_index", "outside the 3 tracks")),
    (lambda r: r.tracks_to_predict.add(track_index=-1), ("tracks_to_predict", "outside the 3 tracks")),
    (lambda r: setattr(r, "scenario_id", ""), ("record 0, scenario_id", "missing")),
    (lambda r: r.tracks[1].states.pop(), ("tracks.states", "agent 101 has 90 states for 91 steps")),
    (lambda r: r.dynamic_map_states.pop(), ("dynamic_map_states", "90 entries for 91 steps")),
    (lambda r: r.timestamps_seconds.__setitem__(5, 0.7), ("timestamps_seconds", "steps are not of 0.1 s")),
    (lambda r: at_times(r, 0.105, 0), ("timestamps_seconds", "steps are not of 0.1 s")),
    (lambda r: at_times(r, 0.1, 0.06), ("timestamps_seconds", "steps are not of 0.1 s")),
    (lambda r: setattr(r.tracks[2], "id", 101), ("object_id", "agent 101 more than once")),
])  # fmt: skip
def test_wrong_scenarios(
    one: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Any,
    texts: tuple[str, ...],
) -> None:
    record = womd_record()
    change(record)
    refused(capsys, write(tmp_path, record), one[1], "made.tfrecord", *texts)


def test_damaged_scenario_files(
    one: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bytearray(one[0].read_bytes())
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "flipped.tfrecord").write_bytes(content)
    refused(capsys, tmp_path / "flipped.tfrecord", one[1], "flipped.tfrecord", "record 0", "checksum")
    write_records(tmp_path / "other.tfrecord", [b"\xff\xff"])
    refused(capsys, tmp_path / "other.tfrecord", one[1], "other.tfrecord", "not a Scenario message")


def test_recordings_jitter() -> None:
    record = womd_record()
    at_times(record, 0.1, 0.03)
    assert len(scenario_arrays(record)["position"]) == 3


def test_headings_and_positions_are_taken_as_they_are() -> None:
    record = womd_record()
    record.tracks[0].states[4].heading = 9.0
    found = scenario_arrays(record)
    assert found["heading"][0, 4] == 9.0
    assert found["position"][1, 20].tolist() == [
        getattr(record.tracks[1].states[20], f"center_{c}") for c in "xyz"
    ]
    assert found["evaluated"].tolist() == [100, 102]
    assert (found["signal_lane"] == 11).all()
    assert found["signal_state"].tolist() == [4] * 3 + [6] * 88


def test_agents_to_simulate() -> None:
    record = womd_record()
    hide_current(record)
    assert simulated_ids(record) == [101, 102]
    cut_to_history(record)
    assert simulated_ids(record) == [101, 102]
    del record.tracks[1].states[10:]
    with pytest.raises(DataError, match="agent 101 has 10 states"):
        simulated_ids(record)


def test_rollouts_survive_a_file(tmp_path: Path) -> None:
    written = record_rollouts(womd_record(), 2)
    write_rollouts(tmp_path / "rollouts.npz", written)
    found = read_rollouts(tmp_path / "rollouts.npz")
    for name in RolloutArrays.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))


@pytest.mark.parametrize("kind", ["<f8", ">f4", "<f2", np.longdouble])
def test_numbers_may_be_of_any_width_and_byte_order(tmp_path: Path, kind: Any) -> None:
    record = womd_record()
    arrays = vars(record_rollouts(record, 2))
    ids = arrays.pop("object_id").astype(">i2")
    # Near the origin, where two bytes are enough.
    near = {name: (array % 8).astype(kind) for name, array in arrays.items()}
    np.savez(tmp_path / "made.npz", object_id=ids, **near)
    found = read_rollouts(tmp_path / "made.npz")
    assert found.object_id.tolist() == [100, 101, 102]
    np.testing.assert_array_equal(found.x, near["x"])
    SimulatedRollouts.of(**vars(found)).check(WosacScenario.of(**scenario_arrays(record)), 2)
