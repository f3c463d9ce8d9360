"""The demo, with fewer updates and rollouts than a newcomer gets."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import get_args

import pytest

from helpers_segments import crossing, straight_road
from symphony.cli import main
from symphony.config import Method
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter


def test_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """With three of the test segments, over what an earlier demo has left."""
    store = SegmentStore(builtin_store("test"))
    with StoreWriter(tmp_path / "test") as writer:
        for i in range(3):
            writer.append(store[i])
    folders = {"train": builtin_store("train"), "test": tmp_path / "test"}
    monkeypatch.setattr("symphony.data.builtin.builtin_store", folders.__getitem__)
    earlier = tmp_path / "demo" / "bc_h" / "config.json"
    earlier.parent.mkdir(parents=True)
    earlier.write_text("{}")
    (earlier.parent / "left").touch()
    assert main(["demo", "--out", str(tmp_path / "demo"), "--steps", "2", "--rollouts", "1"]) == 0
    assert not (earlier.parent / "left").exists()
    rows = json.loads((tmp_path / "demo" / "metrics.json").read_text())["rows"]
    assert [row["agent"] for row in rows] == [
        "log playback",
        "constant velocity",
        "included BC+TS+H",
        "your BC+H",
    ]
    assert all(row["segments"] == 3 for row in rows)
    assert rows[0]["ade"] == rows[0]["collision_rate"] == 0
    assert rows[1]["ade"] > 1
    # Whatever two updates make of BC+H, an agent that has learned to drive stays on the road.
    assert rows[2]["search"] == "backtrack"
    assert rows[2]["offroad_time"] < rows[1]["offroad_time"]
    sizes = [(tmp_path / "demo" / name).stat().st_size for name in ("included.png", "rollouts.png")]
    assert 50_000 < sizes[0] < sizes[1]
    told = capsys.readouterr().out
    assert f"{rows[1]['ade']:.2f}" in told
    first, _, second = told.partition("Now one of your own")
    assert "included BC+TS+H" in first
    assert "your BC+H" not in first
    assert "your BC+H" in second
    assert len(told.splitlines()) <= 30  # a screen


def test_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The table of all eight methods, on a store of two segments."""
    for split, seed in (("train", 0), ("test", 1)):
        with StoreWriter(tmp_path / split) as writer:
            writer.append(straight_road(4, seed=seed, steps=6))
            writer.append(crossing(4, seed=seed, steps=6))
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "make_table.py"
    script = runpy.run_path(str(path))
    monkeypatch.setitem(script["main"].__globals__, "builtin_store", lambda split: tmp_path / split)
    sizes = "--steps 2 --states 8 --agent.hidden 8 --agent.num-points 8 --search.updates 2 "
    sizes += "--checkpoint-every 2 --batch 1 --search.branches=2 --rollouts 2"
    out = tmp_path / "out"
    status = script["main"](["--out", str(out), *sizes.split()])
    shown = capsys.readouterr()
    assert status == 0, shown.err
    lines = (out / "table.md").read_text().splitlines()
    for method in get_args(Method):
        name = method.upper().replace("_", "+")
        assert sum(line.strip("| *").startswith(f"{name} ") for line in lines) == 1, name
        config = json.loads((out / method / "config.json").read_text())
        assert (config["method"], config["steps"], config["search"]["branches"]) == (method, 2, 2)
    assert "MGAIL+TS+H" in shown.out
