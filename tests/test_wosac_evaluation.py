"""The WOSAC score beside the paper's metrics, its tables, goals of the log, and who goes first."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_agents import small
from helpers_segments import crossing, hide, straight_road
from helpers_store import fill
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import EvaluateConfig, WosacSettings
from symphony.data.resample import resample
from symphony.data.segment import AgentType
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation.formats import FORMATS
from symphony.evaluation.table import WOSAC, Entry, compare
from symphony.roadgraph import LaneGraph
from symphony.wosac.evaluate import THINNED, _thinned, evaluate_wosac, simulated_how
from symphony.wosac.passing import order_of, passing_gaps, passing_pairs
from symphony.wosac.rollouts import STATES, RolloutArrays
from symphony.wosac.segments import log_playback, wosac_window
from symphony.wosac.simulate import _driven, constant_velocity, future_log, history_only, wosac_rollouts
from symphony.wosac.table import COLUMNS, how_in_words, read_wosac, wosac_grid
from test_context import CASES, scene

AGENT = "pretrained:bc_ts_h"
RANDOM = "random"
PLAIN = WosacSettings(search="none")


def same(a: RolloutArrays, b: RolloutArrays) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("object_id", *STATES))


# --- agents ---


def test_random_actions_know_nothing_and_are_their_own() -> None:
    agent, segment = load_agent(RANDOM), wosac_window(crossing())
    found = wosac_rollouts(agent, segment, PLAIN)
    assert len(np.unique(found.x[:, :, -1], axis=0)) == 32
    assert not same(found, wosac_rollouts(agent, segment, replace(PLAIN, seed=1)))
    # Nobody's speed changes by more than the strongest action.
    speed = np.hypot(np.diff(found.x, axis=-1), np.diff(found.y, axis=-1)) / 0.1
    assert np.abs(np.diff(speed, axis=-1)).max() < 4.0 * 0.1 + 0.1


def test_goals_of_the_log_are_those_that_were_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    segment = wosac_window(crossing(num_agents=3))
    start, log = history_only(segment, 0.2), future_log(segment)
    assert np.array_equal(start.position[:, 0], log.position[:, 0])
    assert np.array_equal(start.agent_id, log.agent_id)
    seen: list[Any] = []

    def stop(agent: Any, scenes: Any, config: Any) -> Any:
        seen.append((scenes, config))
        raise DataError("enough")

    monkeypatch.setattr("symphony.wosac.simulate.simulation", stop)
    agent = load_agent(AGENT)
    for one in (None, log):
        with pytest.raises(DataError, match="enough"):
            _driven(agent, start, np.arange(3), replace(PLAIN, logged_goals=one is not None), one)
    (sampled, before), (logged, config) = seen
    assert config.logged_goals
    assert not before.logged_goals
    assert np.array_equal(sampled.route_point, logged.route_point)
    graph = LaneGraph(start.road)
    for k in range(3):
        # The logged route passes near every logged position; so did the vehicle.
        route = logged.whole_route(0, k, int(logged.route_logged[0, k])).numpy()
        away = np.linalg.norm(log.position[k, ::10, None, :2] - route[None], axis=-1).min(1)
        assert away.max() < 3, (k, graph)


def test_goals_of_the_log_change_rollouts_and_are_not_submitted(capsys: pytest.CaptureFixture[str]) -> None:
    segment, agent = wosac_window(crossing(num_agents=3, seed=2)), small()
    logged = wosac_rollouts(agent, segment, replace(PLAIN, logged_goals=True))
    assert not same(logged, wosac_rollouts(agent, segment, PLAIN))
    meta = ("--account-name", "a@example.org", "--unique-method-name", "m", "--num-model-parameters", "1")
    told = ("lidar-data", "camera-data", "public-model-pretraining")
    flags = [word for name in told for word in (f"--uses-{name}", "False")]
    flags += ["--acknowledge-complies-with-closed-loop-requirement", "True"]
    command = ["wosac", "submit", AGENT, "--data", "x", "--out", "y.tar.gz", *meta, *flags, "--logged-goals"]
    assert main(command) != 0
    assert "must not know the routes of the log" in capsys.readouterr().err


def test_settings_are_those_of_the_evaluation() -> None:
    config = EvaluateConfig(search="tree", branches=3, rule="replace", threshold=1.0, goals="branch", seed=4)
    settings = WosacSettings.of(config)
    made = settings.config(32, 9)
    assert (made.rollouts, made.trees, made.seed) == (32, 32, 9)
    assert (made.branches, made.rule, made.threshold, made.goals) == (3, "replace", 1.0, "branch")
    # What is left open is the agent's own, and the record says what that is.
    agent = load_agent(AGENT)
    assert (agent.search.rule, agent.search.goals) == ("replace", "branch")
    how = simulated_how(agent, WosacSettings.of(EvaluateConfig(search="tree", action_temperature=0.5)))
    assert {"rule": "replace", "goals": "branch", "action_temperature": 0.5}.items() <= how.items()
    with pytest.raises(ConfigError, match="score is one of"):
        WosacSettings.of(EvaluateConfig(score="flags"))


# --- the log at the agent's rate ---


def test_thinned_playback_is_the_log_at_its_own_steps() -> None:
    segment = hide(resample(crossing(seed=1), 0.1), 1, slice(30, 47))
    window = wosac_window(segment)
    log, thinned = log_playback(window), log_playback(window, 2)
    whole, place = np.arange(1, 80, 2), np.stack([log.x, log.y], -1)
    np.testing.assert_allclose(thinned.x[..., whole], log.x[..., whole], atol=1e-9)
    known = window.valid[:, 11:]
    between = np.stack([thinned.x, thinned.y], -1)
    for agent, step in ((0, 40), (2, 62)):
        np.testing.assert_allclose(
            between[0, agent, step], (place[0, agent, step - 1] + place[0, agent, step + 1]) / 2, atol=1e-6
        )
    assert np.array_equal(thinned.x[0][~known], log.x[0][~known])


def test_there_is_a_thinned_playback_where_the_store_is_finer_than_the_agent(tmp_path: Path) -> None:
    segment = straight_road(num_agents=2)
    fill(tmp_path / "fine", [resample(segment, 0.1)])
    fill(tmp_path / "coarse", [segment])
    fine, coarse = (SegmentStore(tmp_path / name) for name in ("fine", "coarse"))
    agent = small()
    assert (_thinned(agent, fine, [0]), _thinned(agent, coarse, [0])) == (2, 1)
    assert _thinned(load_agent(RANDOM), fine, [0]) == 1
    found = evaluate_wosac(agent, fine, [0], PLAIN)
    assert list(found.results) == ["playback", THINNED, "constant_velocity", "random", "tiny"]


# --- who goes first ---


def test_pairs_are_those_that_merge_or_cross_after_the_current_step() -> None:
    segment = scene(CASES["crosses"][1])
    window = wosac_window(segment)
    assert [0, 1] in passing_pairs(window).tolist()
    # Not with a pedestrian.
    walking = np.array([AgentType.VEHICLE, AgentType.PEDESTRIAN, *segment.agent_type[2:]], np.uint8)
    assert [0, 1] not in passing_pairs(window.replace(agent_type=walking)).tolist()


@pytest.mark.parametrize("case", ["turns in before", "crosses"])
def test_order_is_kept_by_the_log_and_reversed_by_who_is_held_up(case: str) -> None:
    window = wosac_window(scene(CASES[case][1]))
    pairs = passing_pairs(window)[:1]
    log = log_playback(window)
    found = passing_gaps(window, pairs, log)
    whole = order_of([found])
    assert (whole.pairs, whole.kept) == (1, 1)
    assert whole.gap_error < 0.3
    # Whoever went first comes 5 s later, or never.
    gap = float(found.log[0])
    late = int(pairs[0][0 if gap > 0 else 1])
    states = {name: getattr(log, name).copy() for name in STATES}
    for values in states.values():
        values[:, late, 50:] = values[:, late, :30]
        values[:, late, :50] = values[:, late, :1]
    held = order_of([passing_gaps(window, pairs, RolloutArrays(log.object_id, **states))])
    assert held.kept == 0
    assert held.reversed + held.apart == pytest.approx(1)


def test_without_pairs_there_is_no_order() -> None:
    window = wosac_window(straight_road())
    found = passing_gaps(window, passing_pairs(window), constant_velocity(window))
    assert order_of([found]).pairs == 0


# --- records and tables ---


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Of `symphony evaluate --metrics wosac`."""
    folder = tmp_path_factory.mktemp("evaluated")
    fill(folder / "store", [straight_road(2, seed=k, group=f"recording {k}") for k in range(2)])
    out = folder / "record.json"
    assert (
        main([
            *("evaluate", RANDOM, "--data", str(folder / "store"), "--json", str(out)),
            *("--rollouts", "2", "--metrics", "wosac"),
        ]) == 0
    )  # fmt: skip
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def test_logs_too_short_for_the_score_are_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(tmp_path / "store", [straight_road(2, steps=12), straight_road(2, seed=1, steps=12)])
    assert main(["evaluate", "playback", "--data", str(tmp_path / "store"), "--metrics", "wosac"]) == 1
    said = capsys.readouterr()
    assert "the score needs 8" in said.err
    assert said.out == ""


def test_the_record_has_the_score(record: dict[str, Any]) -> None:
    whole = record["wosac"]["agents"]
    assert record["wosac_metametric"] == whole[RANDOM]["metametric"]
    assert record["wosac_metametric_se"] == whole[RANDOM]["metametric_se"]
    for name in ("playback", "constant_velocity"):
        assert record[name]["wosac_min_ade"] == whole[name]["min_ade"]
        assert "collision_rate" in record[name]
    assert 0 < record["wosac_metametric"] < record["playback"]["wosac_metametric"] < 1


def test_columns_of_the_table(record: dict[str, Any]) -> None:
    kept = record | {"run": {"updates": 0, "named": False, "checkpoint": 0}}
    other = {key: value for key, value in kept.items() if not key.startswith("wosac")}
    entries = [Entry(Path(m), {"method": m, "seed": 0}, m, kept) for m in ("bc", "bc_h")]
    table = compare(entries, "main")
    assert set(WOSAC) <= set(table.columns)
    assert f"{record['wosac_metametric']:.3f}" in FORMATS["markdown"](table)
    for row in table.rows:
        assert 0 < row.cells["wosac_metametric"].mean < 1
    mixed = compare([entries[0], replace(entries[1], record=other)], "main")
    assert not set(WOSAC) & set(mixed.columns)
    year = kept | {"wosac": kept["wosac"] | {"config": "2024"}}
    with pytest.raises(ConfigError, match="WOSAC scores of 2024, 2025"):
        compare([entries[0], replace(entries[1], record=year)], "main")


def test_oracles_have_no_score(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fill(tmp_path / "store", [straight_road()])
    command = [
        "evaluate",
        AGENT,
        "--data",
        str(tmp_path / "store"),
        "--score",
        "flags",
        "--metrics",
        "wosac",
    ]
    assert main(command) != 0
    assert "score is one of agent, discriminator, rule" in capsys.readouterr().err


def test_the_table_of_scores(
    record: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    one.write_text(json.dumps(record["wosac"]))
    alone = record["wosac"] | {"agents": {RANDOM: record["wosac"]["agents"][RANDOM]}}
    two.write_text(json.dumps(alone))
    assert main(["wosac", "table", str(two), str(one), "--names", "two", "one"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line.split("|")[1].strip() for line in lines if line.startswith("| ")]
    assert names == ["", "---", "log playback", "constant velocity", "random", "two", "one"]
    assert "2 run segments of 2 recordings" in lines[-1]
    grid = wosac_grid([read_wosac(one)])
    assert grid[-1][0] == f"{RANDOM}, no search"
    numbers = record["wosac"]["agents"][RANDOM]
    for column, cell in zip(COLUMNS, grid[-1][1:], strict=False):
        assert float(cell.split(" ± ")[0]) == pytest.approx(
            column.scale * numbers[column.key], abs=0.51 * 10**-column.digits
        )
    with pytest.raises(ConfigError, match="different run segments, years or horizons"):
        wosac_grid([alone, alone | {"config": "2024"}])
    with pytest.raises(ConfigError, match="1 names for 2 records"):
        wosac_grid([alone, alone], ["x"])
    two.write_text("{}")
    with pytest.raises(DataError, match=r"two\.json, field config: is missing"):
        read_wosac(two)
    for part, name, damaged in (
        ("agents", f"{RANDOM}.segments", {RANDOM: {}}),
        ("agents", f"{RANDOM}.order.kept", {RANDOM: numbers | {"order": None}}),
        ("how", "search", {}),
        ("data", "checksum", {"name": "made"}),
    ):
        two.write_text(json.dumps(alone | {part: damaged}))
        with pytest.raises(DataError, match=rf"two\.json, field {part}\.{name}: is missing"):
            read_wosac(two)


def test_words() -> None:
    tree = {"search": "tree", "branches": 4, "rule": "best", "prune_every": 10, "logged_goals": True}
    assert how_in_words(tree) == "32 trees of 4, best every 10, logged goals"
    assert how_in_words({"search": "best", "branches": 8}) == "the best of 8"


@pytest.mark.parametrize("workers", [1, 2])
def test_a_segment_that_cannot_be_scored_ends_no_others(workers: int, tmp_path: Path) -> None:
    whole = [crossing(num_agents=2, seed=k) for k in range(2)]
    bare = whole[0].replace(
        segment_id="bare", road=replace(whole[0].road, boundary=whole[0].road.boundary.of([]))
    )
    walkers = whole[0].replace(
        segment_id="walkers", agent_type=np.full_like(whole[0].agent_type, AgentType.PEDESTRIAN)
    )
    short = straight_road(2, steps=12)
    fill(tmp_path / "store", [bare, whole[0], walkers, short, whole[1]])
    agent, store = load_agent("constant_velocity"), SegmentStore(tmp_path / "store")
    settings = replace(PLAIN, workers=workers)
    found = evaluate_wosac(agent, store, range(5), settings, baselines=False)
    assert found.segments == [whole[0].segment_id, whole[1].segment_id]
    assert [skip.segment for skip in found.left_out] == ["bare", "walkers", short.segment_id]
    alone = evaluate_wosac(agent, store, [1, 4], settings, baselines=False)
    assert found.numbers("constant_velocity") == alone.numbers("constant_velocity")
    assert [entry["segment"] for entry in found.record()["left_out"]] == ["bare", "walkers", short.segment_id]
    with pytest.raises(DataError, match="no road edge"):
        evaluate_wosac(agent, store, range(5), settings, baselines=False, strict=True)
    with pytest.raises(DataError, match="time_to_collision"):
        evaluate_wosac(agent, store, [2, 0], settings, baselines=False)


def test_processes_change_nothing(tmp_path: Path) -> None:
    fill(tmp_path / "store", [crossing(num_agents=2, seed=k) for k in range(2)])
    agent, store = load_agent(RANDOM), SegmentStore(tmp_path / "store")
    done: list[tuple[int, int]] = []
    found = [
        evaluate_wosac(
            agent,
            store,
            [0, 1],
            replace(PLAIN, workers=workers),
            progress=lambda *at: done.append(at),
            baselines=False,
        ).record()["agents"][RANDOM]["segments"]
        for workers in (1, 2)
    ]
    assert found[0] == found[1]
    assert done == [(1, 2), (2, 2)] * 2
