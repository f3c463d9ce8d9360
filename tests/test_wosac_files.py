"""`symphony wosac score`: files in, numbers out, and errors that say where."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_wosac import record_rollouts, womd_record, write_rollouts
from symphony.cli import main
from symphony.data.sources import womd_pb2 as pb
from symphony.data.sources.tfrecord import write_records
from symphony.errors import DataError
from symphony.wosac.files import read_rollouts, score_files
from symphony.wosac.records import logged_scenario, read_scenarios, simulated_ids
from symphony.wosac.scorer import CHALLENGES, score

NAMES = ("aaaa", "bbbb", "cccc")
Change = Callable[[pb.Scenario], Any]
Refused = Callable[..., None]


def write(folder: Path, *records: pb.Scenario) -> Path:
    path = folder / "made.tfrecord"
    write_records(path, [record.SerializeToString() for record in records])
    return path


def written(folder: Path, *names: str) -> tuple[Path, Path]:
    """A file with scenarios and a folder of their rollouts."""
    (folder / "rollouts").mkdir()
    for seed, name in enumerate(names):
        write_rollouts(folder / "rollouts" / f"{name}.npz", record_rollouts(womd_record(name), seed=seed % 3))
    return write(folder, *map(womd_record, names)), folder / "rollouts"


@pytest.fixture
def one(tmp_path: Path) -> tuple[Path, Path]:
    scenario, folder = written(tmp_path, "aaaa")
    return scenario, folder / "aaaa.npz"


@pytest.fixture
def many(tmp_path: Path) -> tuple[Path, Path]:
    return written(tmp_path, *NAMES)


def run(scenario: Path, rollouts: Path, *more: str) -> int:
    return main(["wosac", "score", "--scenario", str(scenario), "--rollouts", str(rollouts), *more])


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    def check(scenario: Path, rollouts: Path, *texts: str) -> None:
        assert run(scenario, rollouts) == 1
        error = capsys.readouterr().err
        for text in texts:
            assert text in error

    return check


def test_one_scenario(one: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, features = tmp_path / "out" / "scores.json", tmp_path / "features"
    assert run(*one, "--config", "2024", "--json", str(out), "--per-object", "--features", str(features)) == 0
    assert "metametric" in capsys.readouterr().out
    found = json.loads(out.read_text())
    expected = score(logged_scenario(womd_record()), record_rollouts(womd_record()), CHALLENGES["2024"])
    assert {name: found[name] for name in expected} == expected
    assert (found["config"], found["scenario_count"]) == ("2024", 1)
    (only,) = found["scenarios"]
    assert only["scenario_id"] == "aaaa"
    assert [part["object_id"] for part in only["objects"]] == [100, 102]
    with np.load(features / "aaaa.npz") as arrays:
        assert arrays["eval_object_id"].tolist() == [100, 102]
        assert arrays["log_valid"].all()
        assert arrays["sim_linear_speed"].shape == (32, 2, 80)
        np.testing.assert_allclose(arrays["log_linear_speed"][:, 5:70], [[10.0] * 65, [12.0] * 65], atol=0.05)


def test_many_scenarios(many: tuple[Path, Path], tmp_path: Path) -> None:
    out, again = tmp_path / "scores.json", tmp_path / "again.json"
    assert run(*many, "--json", str(out)) == 0
    found = json.loads(out.read_text())
    assert [part["scenario_id"] for part in found["scenarios"]] == list(NAMES)
    for name in ("metametric", "linear_speed_likelihood", "min_ade", "simulated_collision_rate"):
        assert found[name] == pytest.approx(np.mean([part[name] for part in found["scenarios"]]))
    # The folder of the scenario file, and a pattern, mean the same; so do two workers.
    for scenario, more in ((tmp_path, ()), (tmp_path / "*.tfrecord", ("--workers", "2"))):
        assert run(scenario, many[1], "--json", str(again), *more) == 0
        assert again.read_text() == out.read_text()


def test_scenarios_are_read_as_they_are_scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenarios, rollouts = written(tmp_path, *(f"scenario{k}" for k in range(4)))
    drawn, ahead = [], []

    def counted(path: Path) -> Any:
        for packed in read_scenarios(path):
            drawn.append(packed)
            yield packed

    def progress(done: int, total: int | None) -> None:
        ahead.append((len(drawn) - done, total))

    monkeypatch.setattr("symphony.wosac.files.read_scenarios", counted)
    found, _ = score_files(scenarios, rollouts, progress=progress)
    assert ahead == [(0, 4)] * 4
    first, *_, last = ({k: v for k, v in one.items() if k != "scenario_id"} for one in found["scenarios"])
    # What a scenario scores does not depend on those before it: the first one comes again.
    assert first == last


def without_edges(record: pb.Scenario) -> None:
    kept = [feature for feature in record.map_features if feature.WhichOneof("feature_data") != "road_edge"]
    del record.map_features[:]
    record.map_features.extend(kept)


def without_vehicles(record: pb.Scenario) -> None:
    for track in record.tracks:
        track.object_type = 2


def without_future(record: pb.Scenario) -> None:
    for track in record.tracks:
        for state in track.states[11:]:
            state.valid = False


@pytest.mark.parametrize(("change", "why"), [
    (without_edges, "no road edge"),
    (without_vehicles, "time_to_collision"),
    (without_future, "valid at no step that could be scored"),
])  # fmt: skip
def test_a_scenario_that_cannot_be_scored_ends_no_others(
    change: Change, why: str, many: tuple[Path, Path], tmp_path: Path, refused: Refused, capsys: Any
) -> None:
    records, out = list(map(womd_record, NAMES)), tmp_path / "scores.json"
    change(records[1])
    write(tmp_path, *records)
    assert run(*many, "--json", str(out)) == 0
    assert "left out: 1 x " in (said := capsys.readouterr().err)
    assert why in said
    found = json.loads(out.read_text())
    assert [part["scenario_id"] for part in found["scenarios"]] == ["aaaa", "cccc"]
    assert [part["segment"] for part in found["left_out"]] == ["bbbb"]
    assert found["min_ade"] == pytest.approx(np.mean([part["min_ade"] for part in found["scenarios"]]))
    assert run(*many, "--strict") == 1
    assert "segment bbbb" in capsys.readouterr().err
    for record in records:
        change(record)
    refused(write(tmp_path, *records), many[1], "segment aaaa", why.partition(" ")[0])


def test_sets_that_do_not_fit(many: tuple[Path, Path], tmp_path: Path, refused: Refused) -> None:
    refused(many[0], many[1] / "aaaa.npz", "aaaa.npz", "bbbb among them")
    write_rollouts(many[1] / "dddd.npz", record_rollouts(womd_record("dddd")))
    refused(*many, "not in", "dddd")
    for name in ("bbbb", "dddd"):
        (many[1] / f"{name}.npz").unlink()
    refused(*many, "no rollouts of scenario bbbb", str(many[1]))
    assert run(*many, "--partial", "--json", str(tmp_path / "scores.json")) == 0
    found = json.loads((tmp_path / "scores.json").read_text())
    assert [part["scenario_id"] for part in found["scenarios"]] == ["aaaa", "cccc"]
    twice = write(tmp_path, womd_record("aaaa"), womd_record("aaaa"))
    (tmp_path / "empty").mkdir()
    for scenario, rollouts, *texts in (
        (twice, many[1], "more than once", "scenario_id"),
        (twice, tmp_path / "absent.npz", "absent.npz", "No such file"),
        (tmp_path / "empty", many[1], "no scenario files"),
        (tmp_path / "absent.tfrecord", many[1], "no scenario files"),
        (many[0], tmp_path / "empty", "no .npz files"),
    ):
        refused(Path(scenario), Path(rollouts), *map(str, texts))


def put(**changes: Any) -> Any:
    def change(arrays: dict[str, Any]) -> None:
        arrays.update({name: value(arrays[name]) for name, value in changes.items()})

    return change


@pytest.mark.parametrize(("change", "texts"), [
    (lambda arrays: arrays.pop("heading"), ("field heading: missing",)),
    (put(object_id=lambda a: a + 1), ("object_id", "agent 100 missing from the rollouts")),
    (put(object_id=lambda a: a.astype(float)), ("object_id", "whole numbers")),
    (put(x=lambda a: a[:31]), ("field x", "(31, 3, 80), expected (32, 3, 80)")),
    (put(z=lambda a: a.astype(int)), ("field z", "floating-point")),
    (put(y=lambda a: a.astype(object)), ("field y", "damaged: an array of objects")),
])  # fmt: skip
def test_wrong_rollouts(
    one: tuple[Path, Path], tmp_path: Path, refused: Refused, change: Any, texts: tuple[str, ...]
) -> None:
    arrays = dict(vars(read_rollouts(one[1])))
    change(arrays)
    np.savez(tmp_path / "wrong.npz", **arrays)
    refused(one[0], tmp_path / "wrong.npz", "wrong.npz", *texts)


def test_damaged_files(one: tuple[Path, Path], tmp_path: Path, refused: Refused) -> None:
    def flipped(content: bytes) -> bytes:
        middle = len(content) // 3
        return content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]

    scenario, rollouts = (path.read_bytes() for path in one)
    wrong = tmp_path / "wrong.npz"
    for content in (b"", b"nothing of the kind", rollouts[: len(rollouts) // 2], flipped(rollouts)):
        wrong.write_bytes(content)
        refused(one[0], wrong, "wrong.npz", "damaged")
    (tmp_path / "flipped.tfrecord").write_bytes(flipped(scenario))
    refused(tmp_path / "flipped.tfrecord", one[1], "flipped.tfrecord", "record 0", "checksum")
    write_records(tmp_path / "other.tfrecord", [b"\xff\xff"])
    refused(tmp_path / "other.tfrecord", one[1], "other.tfrecord", "not a Scenario message")


def hide_current(record: pb.Scenario) -> None:
    record.tracks[0].states[10].valid = False


def cut_to_history(record: pb.Scenario) -> None:
    del record.timestamps_seconds[11:]
    for track in record.tracks:
        del track.states[11:]


def at_times(record: pb.Scenario, every: float, jitter: float) -> None:
    record.timestamps_seconds[:] = [every * k + jitter * (k % 2) for k in range(91)]


@pytest.mark.parametrize(("change", "texts"), [
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
    (lambda r: setattr(r.tracks[2], "id", 101), ("object_id", "agent 101 more than once")),
])  # fmt: skip
def test_wrong_scenarios(
    one: tuple[Path, Path], tmp_path: Path, refused: Refused, change: Change, texts: tuple[str, ...]
) -> None:
    record = womd_record("aaaa")
    change(record)
    refused(write(tmp_path, record), one[1], "made.tfrecord", *texts)


def test_records_are_taken_as_they_are() -> None:
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
def test_numbers_may_be_of_any_width_and_byte_order(tmp_path: Path, kind: Any) -> None:
    arrays = dict(vars(record_rollouts(womd_record(), 2)))
    ids = arrays.pop("object_id").astype(">i2")
    # Near the origin, where two bytes are enough.
    near = {name: (array % 8).astype(kind) for name, array in arrays.items()}
    np.savez(tmp_path / "made.npz", object_id=ids, **near)
    found = read_rollouts(tmp_path / "made.npz")
    np.testing.assert_array_equal(found.x, near["x"])
    found.check(logged_scenario(womd_record()).sim_agents, count=2)
