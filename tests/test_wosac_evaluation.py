"""The WOSAC score of agents on a store, its tables, beside the paper's metrics, and who goes first."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import EvaluateConfig, WosacSettings
from symphony.data.segment import AgentType
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError, SymphonyError
from symphony.evaluation.table import WOSAC, Entry, compare, table_text
from symphony.wosac.evaluate import evaluate_wosac, simulated_how
from symphony.wosac.passing import order_of, passing_gaps, passing_pairs
from symphony.wosac.scorer import SimulatedRollouts, score
from symphony.wosac.scorer.scenario import STATES
from symphony.wosac.segments import log_playback, wosac_scenario, wosac_window
from symphony.wosac.simulate import constant_velocity
from symphony.wosac.table import COLUMNS, how_in_words, read_wosac, wosac_table
from test_selection import CASES, scene

AGENT = "pretrained:bc_ts_h"
RANDOM = "random"
PLAIN = WosacSettings(search="none")


def test_settings_are_those_of_the_evaluation() -> None:
    config = EvaluateConfig(search="tree", branches=3, rule="replace", threshold=1.0, goals="branch", seed=4)
    made = WosacSettings.of(config).config(32, 9)
    assert (made.rollouts, made.trees, made.seed) == (32, 32, 9)
    assert (made.branches, made.rule, made.threshold, made.goals) == (3, "replace", 1.0, "branch")
    # What is left open is the agent's own, and the record says what that is.
    settings = WosacSettings.of(EvaluateConfig(search="tree", action_temperature=0.5))
    how = simulated_how(load_agent(AGENT), settings)
    assert {"rule": "replace", "goals": "branch", "action_temperature": 0.5}.items() <= how.items()
    with pytest.raises(ConfigError, match="score is one of"):
        WosacSettings.of(EvaluateConfig(score="flags"))
    for wrong in (0.5, 8.1, 2.55, math.nan):
        with pytest.raises(ConfigError, match="horizon is 1 to 8 s"):
            WosacSettings(horizon=wrong)


# --- who goes first ---


def test_pairs_are_those_that_merge_or_cross_after_the_current_step() -> None:
    segment = scene(CASES["crosses"][1])
    window = wosac_window(segment)
    assert [0, 1] in passing_pairs(window).tolist()
    # Not with a pedestrian.
    walking = np.array([AgentType.VEHICLE, AgentType.PEDESTRIAN, *segment.agent_type[2:]], np.uint8)
    assert [0, 1] not in passing_pairs(window.replace(agent_type=walking)).tolist()
    window = wosac_window(straight_road())
    assert order_of([passing_gaps(window, passing_pairs(window), constant_velocity(window))]).pairs == 0


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
    late = int(pairs[0][0 if float(found.log[0]) > 0 else 1])
    states = {name: getattr(log, name).copy() for name in STATES}
    for values in states.values():
        values[:, late, 50:] = values[:, late, :30]
        values[:, late, :50] = values[:, late, :1]
    held = order_of([passing_gaps(window, pairs, SimulatedRollouts(log.object_id, **states))])
    assert held.kept == 0
    assert held.reversed + held.apart == pytest.approx(1)


# --- `symphony wosac evaluate` ---


def test_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [straight_road(2, seed=k, group=f"recording {k // 2}") for k in range(3)]
    store, out = tmp_path / "store", tmp_path / "scores.json"
    fill(store, logs)
    command = ["wosac", "evaluate", AGENT, "--data", str(store), "--search", "none", "--json", str(out)]
    assert main([*command, "--horizon", "2"]) == 0
    assert "3 run segments of 2 recordings with 6 scored objects in store" in capsys.readouterr().out
    record = json.loads(out.read_text())
    assert (record["objects"], record["hertz"]) == (6, [5.0])
    assert list(record["agents"]) == ["playback", "constant_velocity", "idm", "random", AGENT]
    assert record["how"] == {"search": "none", "seed": 0, "logged_goals": False, "horizon": 2.0}
    for numbers in record["agents"].values():
        each = [one["metametric"] for one in numbers["segments"].values()]
        assert numbers["metametric"] == pytest.approx(np.mean(each))
        assert numbers["metametric_se"] >= 0
    window = wosac_window(logs[1], 20)
    steady = record["agents"]["constant_velocity"]["segments"][logs[1].segment_id]
    assert steady == pytest.approx(score(wosac_scenario(window), constant_velocity(window, future=20)))
    # One recording has no error; a part of the store can be named; baselines search for nothing.
    tree = ("--search", "tree", "--branches", "2", "--horizon", "1", "--segments", "2", "--config", "2024")
    assert main([*command[:5], *tree, "--json", str(out)]) == 0
    record = json.loads(out.read_text())
    assert (record["config"], record["how"]["search"]) == ("2024", "tree")
    assert list(record["agents"][AGENT]["segments"]) == [logs[2].segment_id]
    assert record["agents"][AGENT]["metametric_se"] is None


def test_a_segment_that_cannot_be_scored_ends_no_others_whatever_the_workers(tmp_path: Path) -> None:
    whole = [crossing(num_agents=2, seed=k) for k in range(2)]
    road, walking = whole[0].road, np.full_like(whole[0].agent_type, AgentType.PEDESTRIAN)
    bare = whole[0].replace(segment_id="bare", road=replace(road, boundary=road.boundary.of([])))
    walkers, short = whole[0].replace(segment_id="walkers", agent_type=walking), straight_road(2, steps=12)
    fill(tmp_path / "store", [bare, whole[0], walkers, short, whole[1]])
    agent, store, done = load_agent(RANDOM), SegmentStore(tmp_path / "store"), []

    def evaluated(items: Any, seed: int = 0, workers: int = 1, **changes: Any) -> Any:
        settings = replace(PLAIN, workers=workers, seed=seed)
        changes |= {"baselines": False, "progress": lambda *at: done.append(at)}
        return evaluate_wosac(agent, store, items, settings, **changes)

    found = evaluated(range(5))
    assert found.segments == [whole[0].segment_id, whole[1].segment_id]
    assert [skip.segment for skip in found.left_out] == ["bare", "walkers", short.segment_id]
    assert [entry["segment"] for entry in found.record()["left_out"]] == ["bare", "walkers", short.segment_id]
    assert done == [(k, 5) for k in range(1, 6)]
    others = [evaluated([1, 4], workers=2), evaluated([1, 4], seed=1)]
    assert [found.numbers(RANDOM) == other.numbers(RANDOM) for other in others] == [True, False]
    for items, strict, config, text in (
        (range(5), True, "2025", "no road edge"),
        ([2, 0], False, "2025", "time_to_collision"),
        ([], False, "2025", "no run segments"),
        ([0], False, "2023", "config must be one of"),
    ):
        with pytest.raises(SymphonyError, match=text):
            evaluated(items, strict=strict, config=config)


# --- `symphony evaluate --metrics wosac` and tables ---


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Of `symphony evaluate --metrics wosac`."""
    folder = tmp_path_factory.mktemp("evaluated")
    fill(folder / "store", [straight_road(2, seed=k, group=f"recording {k}") for k in range(2)])
    out = folder / "record.json"
    command = ["evaluate", RANDOM, "--data", str(folder / "store"), "--json", str(out), "--rollouts", "2"]
    assert main([*command, "--metrics", "wosac"]) == 0
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def test_what_cannot_be_scored_is_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(tmp_path / "store", [straight_road(2, steps=12), straight_road(2, seed=1, steps=12)])
    data = ["--data", str(tmp_path / "store"), "--metrics", "wosac"]
    assert main(["evaluate", "playback", *data]) == 1
    said = capsys.readouterr()
    assert "the score needs 8" in said.err
    assert said.out == ""
    # Whoever simulates must not know what is scored.
    assert main(["evaluate", AGENT, *data, "--score", "flags"]) != 0
    assert "score is one of agent, discriminator, rule" in capsys.readouterr().err


def test_the_record_has_the_score_and_tables_have_its_columns(record: dict[str, Any]) -> None:
    whole = record["wosac"]["agents"]
    assert record["wosac_metametric"] == whole[RANDOM]["metametric"]
    assert record["wosac_metametric_se"] == whole[RANDOM]["metametric_se"]
    for name in ("playback", "constant_velocity"):
        assert record[name]["wosac_min_ade"] == whole[name]["min_ade"]
        assert "collision_rate" in record[name]
    assert 0 < record["wosac_metametric"] < record["playback"]["wosac_metametric"] < 1
    kept = record | {"run": {"updates": 0, "named": False, "checkpoint": 0}}
    entries = [Entry(Path(m), {"method": m, "seed": 0}, m, kept) for m in ("bc", "bc_h")]
    table, keys = compare(entries, "main"), set(WOSAC)
    assert keys <= set(table["columns"])
    assert f"{record['wosac_metametric']:.3f}" in table_text(table)
    other = {key: value for key, value in kept.items() if not key.startswith("wosac")}
    assert not keys & set(compare([entries[0], replace(entries[1], record=other)], "main")["columns"])
    year = kept | {"wosac": kept["wosac"] | {"config": "2024"}}
    with pytest.raises(ConfigError, match="WOSAC scores of 2024, 2025"):
        compare([entries[0], replace(entries[1], record=year)], "main")


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
    drivers = ["log playback", "constant velocity", "intelligent driver model", "random"]
    assert names == ["", "---", *drivers, "two", "one"]
    assert "2 run segments of 2 recordings with 4 scored objects" in lines[-1]
    assert "at 5 Hz" in lines[-1]
    row = wosac_table([read_wosac(one)]).splitlines()[6].split("|")
    assert row[1].strip() == f"{RANDOM}, no search"
    numbers = record["wosac"]["agents"][RANDOM]
    for column, cell in zip(COLUMNS, row[2:], strict=False):
        assert float(cell.split(" ± ")[0]) == pytest.approx(
            column.scale * numbers[column.key], abs=0.51 * 10**-column.digits
        )
    short = alone | {"how": alone["how"] | {"horizon": 5.0}}
    assert "WOSAC 2025 over 5 s (the challenge has 8): 2 run segments" in wosac_table([short])
    for other in (short, alone | {"config": "2024"}):
        with pytest.raises(ConfigError, match="different run segments, years or horizons"):
            wosac_table([alone, other])
    with pytest.raises(ConfigError, match="1 names for 2 records"):
        wosac_table([alone, alone], ["x"])
    tree = {"search": "tree", "branches": 4, "rule": "best", "prune_every": 10, "logged_goals": True}
    assert how_in_words(tree) == "32 trees of 4, best every 10, logged goals"
    for text in ("{}", "[]", "nothing", json.dumps({"agent": "a", "agents": {"b": {}}})):
        two.write_text(text)
        with pytest.raises(DataError, match=r"two\.json: not a record of symphony wosac evaluate"):
            read_wosac(two)
