"""Training curves as pictures."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from symphony.cli import main
from symphony.evaluation import records as records_module
from symphony.render import plot_curves
from symphony.render.curves import read_curves, smoothed
from symphony.render.style import AGENT_COLORS


def records(count: int = 30, **metrics: float) -> list[dict[str, float]]:
    return [
        {"step": 20 * (k + 1), **{name: value * k for name, value in metrics.items()}} for k in range(count)
    ]


def test_every_metric_has_a_panel_and_every_run_two_lines(tmp_path: Path) -> None:
    runs = {
        "one": records(discriminator_auc=0.1, policy_accuracy=1.0, mine=3.0),
        "two": records(5, discriminator_auc=0.2, search_collision_all=1.0, search_collision_kept=0.5),
    }
    figure = plot_curves(runs, tmp_path / "curves.png")
    drawn = {axes.get_title(loc="left"): axes.lines for axes in figure.axes}
    assert list(drawn) == ["discriminator auc", "policy accuracy", "mine", "search: share in collision"]
    twice = [f"{raw}discriminator_auc-{run}" for run in runs for raw in ("raw-", "")]
    assert [line.get_gid() for line in drawn["discriminator auc"]] == twice
    assert len(drawn["search: share in collision"]) == 4
    raw, strong = drawn["policy accuracy"]
    assert [raw.get_gid(), strong.get_gid()] == ["raw-policy_accuracy-one", "policy_accuracy-one"]
    np.testing.assert_array_equal(raw.get_xydata(), [(20 * (k + 1), k) for k in range(30)])
    assert raw.get_alpha() < 0.5
    assert raw.get_linewidth() < strong.get_linewidth()
    assert raw.get_color() == strong.get_color() == AGENT_COLORS[0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two"]
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def test_missing_and_odd_values_are_tolerated(tmp_path: Path) -> None:
    nan = math.nan
    odd: list[dict[str, Any]] = [
        {"step": 1, "auc": nan, "note": "text"},
        {"step": 2, "auc": None, "flag": True},
    ]
    odd.append({"step": 3, "auc": 0.5, "late": nan})
    curves = read_curves(odd)
    assert list(curves) == ["auc", "late"]
    np.testing.assert_array_equal(curves["auc"], [[1, 2, 3], [nan, nan, 0.5]])
    assert plot_curves({"odd": odd}, tmp_path / "odd.svg").axes[0].lines[1].get_marker() == "o"


@settings(deadline=None, max_examples=50)
@given(
    arrays(np.float64, st.integers(1, 40), elements=st.floats(-1e3, 1e3) | st.just(math.nan)), st.floats(0, 1)
)
def test_smoothing_stays_within_the_values_around(values: np.ndarray, window: float) -> None:
    found, reach = smoothed(values, window), round(window * len(values) / 2)
    for k, average in enumerate(found):
        near = values[max(0, k - reach) : k + reach + 1]
        near = near[np.isfinite(near)]
        expected = near.mean() if len(near) else math.nan
        assert average == pytest.approx(expected, abs=1e-6, nan_ok=True)


def test_the_command_draws_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "curves.png")
    for name, metrics in (("one", {"auc": 0.1}), ("two", {"auc": 0.2, "accuracy": 1.0}), ("fresh", {})):
        lines = [json.dumps(line) + "\n" for line in records(3 if metrics else 0, **metrics)]
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_text("".join(lines))
    one, two, fresh = (str(tmp_path / name) for name in ("one", "two", "fresh"))
    assert main(["plot", "curves", one, two, "--out", out, "--metrics", "auc", "accuracy"]) == 0
    assert Path(out).stat().st_size > 5_000
    for words, expected in (
        ([one, fresh], f"{fresh}: is no run"), ([str(tmp_path)], f"{tmp_path}: is no run"),
        ([one, "--metrics", "auk"], "no run has auk"), ([one, "--out", "a.txt"], ".png"),
    ):  # fmt: skip
        assert main(["plot", "curves", "--out", out, *words]) == 1
        assert expected in capsys.readouterr().err
    for command in ("curves", "curvature"):
        assert main(["plot", command, one, two, f"{one}/", "--out", out]) == 2
        assert f"RUN ...: {one} is given twice" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [
    {"policy": None}, {"log": [1, 2]}, {"log": [1.5, 2.0, 3.0]}, {"policy": [-1, 2, 3]}, {"policy": [1 << 70, 2, 3]},
])  # fmt: skip
def test_a_damaged_evaluation_is_named(tmp_path: Path, damage: Any, capsys: Any) -> None:
    record = {"format": 2, "run": {"updates": 1, "checkpoint": 1, "named": False}, "playback": {}}
    record |= {"data": {"name": "a", "checksum": "b"}, "cost": {"simulation": 1}, "constant_velocity": {}}
    parts = records_module._PARTS["config"]
    record |= {"config": dict.fromkeys(parts, 0), "curvature": {"policy": [1, 2, 3], "log": [3, 2, 1]}}
    folder = tmp_path / "run"
    (folder / "evaluations").mkdir(parents=True)
    (folder / "config.json").write_text('{"method": "bc"}')
    command = ["plot", "curvature", str(folder), "--out", str(tmp_path / "a.png")]
    for status, held in ((0, record), (1, {**record, "curvature": {**record["curvature"], **damage}})):
        (folder / "evaluations" / "one.json").write_text(json.dumps(held))
        assert main(command) == status, capsys.readouterr().err
    assert f"file {folder}, field curvature: an evaluation holds no counts" in capsys.readouterr().err
