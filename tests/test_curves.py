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
from matplotlib.axes import Axes

from symphony.cli import main
from symphony.errors import ConfigError
from symphony.render import plot_curves
from symphony.render.curves import DASHES, PANELS, panels_of, read_curves, run_colors, smoothed
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
    titles = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert list(titles) == ["discriminator auc", "policy accuracy", "mine", "search: share in collision"]
    assert gids_of_lines(titles["discriminator auc"]) == [
        "raw-discriminator_auc-one",
        "discriminator_auc-one",
        "raw-discriminator_auc-two",
        "discriminator_auc-two",
    ]
    assert gids_of_lines(titles["policy accuracy"]) == ["raw-policy_accuracy-one", "policy_accuracy-one"]
    assert len(titles["search: share in collision"].lines) == 4
    raw, strong = titles["policy accuracy"].lines
    assert raw.get_xdata().tolist() == [20 * k for k in range(1, 31)]
    assert raw.get_ydata().tolist() == list(range(30))
    assert raw.get_alpha() < 0.5
    assert raw.get_linewidth() < strong.get_linewidth()
    assert raw.get_color() == strong.get_color() == AGENT_COLORS[0]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["one", "two"]
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def gids_of_lines(axes: Axes) -> list[str]:
    return [line.get_gid() for line in axes.lines]


def test_missing_and_odd_values_are_tolerated(tmp_path: Path) -> None:
    nan = math.nan
    odd: list[dict[str, Any]] = [
        {"step": 1, "auc": nan, "note": "text"},
        {"step": 2, "auc": None, "flag": True},
        {"step": 3, "auc": 0.5, "late": nan},
    ]
    curves = read_curves(odd)
    assert list(curves) == ["auc", "late"]
    np.testing.assert_array_equal(curves["auc"], [[1, 2, 3], [nan, nan, 0.5]])
    figure = plot_curves({"odd": odd}, tmp_path / "odd.svg")
    assert figure.axes[0].lines[1].get_marker() == "o"


@settings(deadline=None, max_examples=50)
@given(
    arrays(np.float64, st.integers(1, 40), elements=st.floats(-1e3, 1e3) | st.just(math.nan)),
    st.floats(0, 1),
)
def test_smoothing_stays_within_the_values_around(values: np.ndarray, window: float) -> None:
    found, reach = smoothed(values, window), round(window * len(values) / 2)
    for k, average in enumerate(found):
        near = values[max(0, k - reach) : k + reach + 1]
        near = near[np.isfinite(near)]
        if len(near) == 0:
            assert math.isnan(average)
        else:
            assert average == pytest.approx(near.mean(), abs=1e-6)


def test_curves_of_choice_and_errors(tmp_path: Path) -> None:
    runs = {"one": records(auc=0.1, loss_bc=1.0)}
    figure = plot_curves(runs, tmp_path / "auc.png", metrics=["auc"], window=0)
    (axes,) = figure.axes
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), axes.lines[1].get_ydata())
    with pytest.raises(ConfigError, match="no run has auk; there are auc, loss_bc"):
        plot_curves(runs, tmp_path / "auk.png", metrics=["auk"])
    with pytest.raises(ConfigError, match="no metrics"):
        plot_curves({"one": []}, tmp_path / "none.png")
    with pytest.raises(ConfigError, match=r"\.png"):
        plot_curves(runs, tmp_path / "curves.txt")


def test_panels_hold_each_metric_once_and_how_it_ran_comes_last() -> None:
    grouped = [name for names in PANELS.values() for name in names]
    quantiles = [f"preview_speed_p{q}" for q in (90, 50, 10)]
    present = ["skipped_updates", "updates_per_second", *grouped, *quantiles, "mine", "learning_rate"]
    panels = panels_of(present)
    assert sorted(name for names in panels.values() for name in names) == sorted(present)
    assert panels["preview speed"] == quantiles
    assert panels["policy loss"] == ["loss_policy", "loss_mgail", "loss_regression"]
    assert list(panels)[-4:] == ["mine", "updates per second", "learning rate", "skipped updates"]
    # More lines could not be told apart.
    assert max(len(names) for names in panels.values()) <= len(DASHES)
    assert all(len(set(run_colors(count))) == count for count in (1, 6, 7, 30))


# The command line


def record(folder: Path, **metrics: float) -> str:
    folder.mkdir()
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in records(3, **metrics)))
    return str(folder)


def test_the_command_draws_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = record(tmp_path / "one", auc=0.1), record(tmp_path / "two", auc=0.2, accuracy=1.0)
    fresh, out = tmp_path / "fresh", str(tmp_path / "curves.png")
    fresh.mkdir()
    (fresh / "metrics.jsonl").touch()
    assert main(["plot", "curves", one, two, "--out", out, "--metrics", "auc", "accuracy"]) == 0
    assert Path(out).stat().st_size > 5_000
    for words, expected in (
        ([str(fresh)], "no metrics to draw"),
        ([one, "--metrics", "auk"], "no run has auk"),
        ([one, "--window", "2"], "from 0 to 1"),
    ):
        assert main(["plot", "curves", *words, "--out", out]) == 1
        assert expected in capsys.readouterr().err
