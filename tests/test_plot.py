"""Pictures of a beam search and of training curves."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

import symphony.render
from helpers_segments import crossing, straight_road
from symphony.agents import load_agent
from symphony.cli import main
from symphony.cli.plot import run_names
from symphony.collectors import BeamSearchResult, lineage
from symphony.config import AgentConfig, DiscriminatorConfig, EvaluateConfig, SearchConfig, TrainConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError
from symphony.learning.demonstrations import SceneDataset
from symphony.recipes import train
from symphony.render import SearchTree, plot_genealogy, plot_search, plot_tree
from symphony.render.genealogy import rows
from symphony.render.style import AGENT_COLORS, new_figure
from symphony.render.tree import FATES, STROKES, score_colors
from symphony.rollouts.driving import simulated

EVERY, BRANCHES, STEPS = 2, 4, 5
PARENTS = np.array([[0, 1, 0, 1], [2, 0, 2, 3], [3, 3, 2, 2]])
"""Of three periods, the last of one step. Leaves come from slots 3 and 2, before that 3 and 2, then 1 and 0; slot 0
of the second period survives but its one child does not.
"""
SEGMENT = straight_road(4, steps=9)


def reaching(parents: np.ndarray) -> np.ndarray:
    slots = lineage(torch.from_numpy(parents)).numpy()
    return np.stack([np.isin(np.arange(parents.shape[1]), row) for row in slots])


def make_tree(**changes: Any) -> SearchTree:
    """Agents 0 and 2 beside their log, all steps at different places and with different scores."""
    rng = np.random.default_rng(0)
    log = SEGMENT.position[[0, 2], 1 : STEPS + 1, :2].swapaxes(0, 1)
    shape = (BRANCHES, STEPS, 2)
    fields: dict[str, Any] = {
        "position": log + rng.normal(0, 0.3, (*shape, 2)),
        "score": rng.normal(0, 2, shape),
        "parents": PARENTS,
        "reaches_leaf": reaching(PARENTS),
        "prune_every": EVERY,
        "agents": np.array([0, 2]),
        "collision": np.zeros(shape, bool),
        "offroad": np.zeros(shape, bool),
        "routes": [SEGMENT.road.lanes[0][:, :2], None],
    }
    return SearchTree(**{**fields, **changes})


def blank() -> Axes:
    return new_figure().add_subplot()


def by_gid(axes: Axes, gid: str) -> Any:
    (found,) = (artist for artist in axes.get_children() if artist.get_gid() == gid)
    return found


def gids(axes: Axes) -> set[str]:
    return {artist.get_gid() for artist in axes.get_children() if artist.get_gid()}


def steps_drawn(axes: Axes, name: str) -> dict[str, np.ndarray]:
    """[K, 2 ends, 2] of every fate that is drawn."""
    found = gids(axes)
    return {
        fate: np.stack(by_gid(axes, f"{fate}-{name}").get_segments())
        for fate in FATES
        if f"{fate}-{name}" in found
    }


def points(axes: Axes, gid: str) -> set[tuple[float, float]]:
    return {tuple(p) for p in np.round(by_gid(axes, gid).get_offsets(), 4).tolist()}


def as_points(places: np.ndarray) -> set[tuple[float, float]]:
    return {tuple(p) for p in np.round(places.reshape(-1, 2), 4).tolist()}


# The tree on the map


def test_every_step_of_every_branch_is_drawn_once() -> None:
    tree = make_tree()
    axes = plot_tree(SEGMENT, tree, blank())
    for n, agent in enumerate(tree.agents):
        drawn = np.concatenate(list(steps_drawn(axes, str(agent)).values()))
        assert len(drawn) == BRANCHES * STEPS
        assert as_points(drawn[:, 1]) == as_points(tree.position[:, :, n])


def test_steps_go_on_from_where_the_parent_ended() -> None:
    tree = make_tree()
    axes = plot_tree(SEGMENT, tree, blank())
    for n, agent in enumerate(tree.agents):
        drawn = np.concatenate(list(steps_drawn(axes, str(agent)).values()))
        begins = {tuple(np.round(end, 4)): np.round(begin, 4) for begin, end in drawn}
        position = np.round(tree.position[:, :, n], 4)
        for slot in range(BRANCHES):
            for t in range(STEPS):
                parent = PARENTS[t // EVERY - 1, slot] if t and t % EVERY == 0 else slot
                expected = position[parent, t - 1] if t else SEGMENT.position[agent, 0, :2]
                np.testing.assert_allclose(begins[tuple(position[slot, t])], expected, atol=1e-3)


def test_what_survives_is_thicker_and_on_top() -> None:
    axes = plot_tree(SEGMENT, make_tree(), blank())
    leaf, died_out, pruned = (by_gid(axes, f"{fate}-0") for fate in FATES)
    assert leaf.get_zorder() > died_out.get_zorder() > pruned.get_zorder()
    assert leaf.get_linewidth() > died_out.get_linewidth() > pruned.get_linewidth()
    counts = {fate: len(drawn) for fate, drawn in steps_drawn(axes, "0").items()}
    assert counts == {"leaf": 2 * 2 + 2 * 2 + 2, "died-out": 2, "pruned": 2 * 2 + 2 + 2}


@settings(deadline=None, max_examples=50)
@given(arrays(np.int64, (3, 5), elements=st.integers(0, 4)))
def test_fates_are_those_of_the_search(parents: np.ndarray) -> None:
    nothing = torch.zeros(0)
    result = BeamSearchResult(
        trajectories=None,  # type: ignore[arg-type]
        scores=nothing,
        alive=nothing,
        slots=lineage(torch.from_numpy(parents)),
        totals=nothing,
        parents=torch.from_numpy(parents),
        simulated_scores=nothing,
        tree=None,
        prune_every=1,
        simulated_steps=0,
    )
    reaches = result.reaches_leaf.numpy()
    survived = (parents[..., None] == np.arange(5)).any(-2)
    score = np.zeros((5, 3, 1))
    tree = SearchTree(np.zeros((5, 3, 1, 2)), score, parents, reaches, 1, np.array([0]))
    assert ((tree.fate == 0) == reaches).all()
    assert ((tree.fate <= 1) == survived).all()


def test_color_follows_the_score() -> None:
    tree = make_tree()
    axes = plot_tree(SEGMENT, tree, blank())
    shade, norm = score_colors(tree)
    score = {
        tuple(np.round(p, 4)): s
        for p, s in zip(tree.position[:, :, 0].reshape(-1, 2), tree.score[..., 0].flat, strict=True)
    }
    for fate, stroke in zip(FATES, STROKES, strict=True):
        if f"{fate}-0" not in gids(axes):
            continue
        drawn = by_gid(axes, f"{fate}-0")
        for (_, end), color in zip(drawn.get_segments(), drawn.get_colors(), strict=True):
            pure = np.asarray(shade(norm(score[tuple(np.round(end, 4))]))[:3])
            np.testing.assert_allclose(color[:3], stroke.pale + (1 - stroke.pale) * pure, atol=1e-6)
    brightness = shade(np.linspace(0, 1, 9))[:, :3] @ (0.2, 0.7, 0.1)
    assert (np.diff(brightness) > 0).all()


def test_forks_are_marked_where_a_branch_goes_on_in_copies() -> None:
    tree = make_tree()
    axes = plot_tree(SEGMENT, tree, blank())
    # After the first period of slots 0 and 1, after the second of slot 2; after the last nothing goes on.
    expected = np.concatenate([tree.position[[0, 1], 1], tree.position[[2], 3]])
    assert points(axes, "forks") == as_points(expected)


def test_collisions_are_marked_once_per_history() -> None:
    collision = np.zeros((BRANCHES, STEPS, 2), bool)
    # Slot 0 collides from its second step on, and so do slots 0 and 2 that go on from it.
    collision[0, 1:4, 0] = collision[2, 2, 0] = True
    collision[2, 4, 1] = True
    tree = make_tree(collision=collision)
    axes = plot_tree(SEGMENT, tree, blank())
    assert points(axes, "collision-leaf") == as_points(tree.position[[0, 2], [1, 4], [0, 1]])
    assert not {"collision-pruned", "offroad-leaf", "offroad-pruned"} & gids(axes)
    collision[3, 1, 1] = True
    axes = plot_tree(SEGMENT, make_tree(collision=collision), blank())
    assert points(axes, "collision-pruned") == as_points(tree.position[3, 1, 1])


def test_log_routes_boxes_and_colour_bar_are_there() -> None:
    axes = plot_tree(SEGMENT, make_tree(), blank())
    for agent in (0, 2):
        log = np.stack(by_gid(axes, f"log-{agent}").get_data(), -1)
        np.testing.assert_allclose(log, SEGMENT.position[agent, : STEPS + 1, :2])
    band = by_gid(axes, "route-0")
    assert band.get_path().contains_point((30, 0))
    assert not band.get_path().contains_point((30, 2))
    assert min(band.get_facecolor()[:3]) > min(to_rgb(AGENT_COLORS[0]))
    assert "route-2" not in gids(axes)
    assert {"box-0", "box-2", "playback"} <= gids(axes)
    (bar,) = axes.child_axes
    assert "high = looks simulated" in bar.get_ylabel()
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"log", "fork", "branch: pruned", "route it follows"} <= set(labels)


def test_padding_changes_nothing() -> None:
    tree = make_tree()
    far = np.full((BRANCHES, STEPS, 1), 1e6)
    padded = make_tree(
        position=np.concatenate([tree.position, np.stack([far, far], -1)], 2),
        score=np.concatenate([tree.score, far], 2),
        agents=np.array([0, 2, -1]),
        collision=np.ones((BRANCHES, STEPS, 3), bool) & np.array([False, False, True]),
        offroad=None,
        routes=[*tree.routes, None],
    )
    one, other = (plot_tree(SEGMENT, t, blank()) for t in (tree, padded))
    assert gids(one) == gids(other)
    assert one.get_xlim() == other.get_xlim()
    for fate, drawn in steps_drawn(one, "2").items():
        np.testing.assert_array_equal(drawn, steps_drawn(other, "2")[fate])
        colors = [by_gid(axes, f"{fate}-2").get_colors() for axes in (one, other)]
        np.testing.assert_array_equal(*colors)


def test_steps_and_scores_that_are_not_finite_do_no_harm() -> None:
    tree = make_tree()
    position, score = tree.position.copy(), tree.score.copy()
    position[1, 2, 0] = np.nan
    score[0, 0] = np.nan
    axes = plot_tree(SEGMENT, make_tree(position=position, score=score), blank())
    # Both steps that touch the missing place are left out; slot 1 goes on with its own period.
    assert sum(map(len, steps_drawn(axes, "0").values())) == BRANCHES * STEPS - 2
    plot_genealogy(make_tree(score=np.full_like(score, np.nan)), blank(), dt=0.2)


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": np.zeros((4, 5, 3, 2))},
        {"parents": PARENTS[:2]},
        {"parents": PARENTS + 1},
        {"reaches_leaf": np.ones((3, 5), bool)},
        {"prune_every": 0},
        {"agents": np.array([0])},
        {"collision": np.zeros((4, 4, 2), bool)},
        {"routes": [None]},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_shapes_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        make_tree(**wrong)


def test_tree_must_fit_the_segment(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the segment has 4"):
        plot_tree(SEGMENT, make_tree(agents=np.array([0, 4])), blank())
    with pytest.raises(ValueError, match="outside the 9"):
        plot_tree(SEGMENT, make_tree(), blank(), start=4)
    with pytest.raises(ConfigError, match=r"\.png"):
        plot_search(SEGMENT, make_tree(), tmp_path / "tree.docx")


# The branches over time


@settings(deadline=None, max_examples=50)
@given(arrays(np.int64, (4, 6), elements=st.integers(0, 5)))
def test_lines_of_descent_do_not_cross(parents: np.ndarray) -> None:
    tree = SearchTree(
        np.zeros((6, 4, 1, 2)), np.zeros((6, 4, 1)), parents, reaching(parents), 1, np.array([0])
    )
    row = rows(tree)
    assert (np.sort(row, 1) == np.arange(6)).all()
    for period in range(1, 4):
        above = row[period - 1][parents[period - 1]]
        in_order = above[row[period].argsort()]
        assert (np.diff(in_order) >= 0).all()


def test_genealogy_draws_every_step_at_its_time_and_row() -> None:
    tree, dt = make_tree(prune_every=EVERY), 0.2
    axes = plot_genealogy(tree, blank(), dt=dt)
    drawn = np.concatenate(list(steps_drawn(axes, "all").values()))
    assert len(drawn) == BRANCHES * STEPS
    np.testing.assert_allclose(drawn[:, 1, 0] - drawn[:, 0, 0], dt)
    at_pruning = drawn[np.isclose(drawn[:, 1, 0], 4 * dt)]
    assert sorted(at_pruning[:, 1, 1]) == [0, 1, 2, 3]
    # Everything starts in one point, and lines never jump: each step begins where one ended.
    np.testing.assert_allclose(drawn[np.isclose(drawn[:, 0, 0], 0), 0], [(0, 1.5)] * BRANCHES)
    ends = as_points(drawn[:, 1])
    assert as_points(drawn[drawn[:, 0, 0] > 0.1 * dt, 0]) <= ends
    lines = [line for line in axes.lines if line.get_gid() == "pruning"]
    assert [line.get_xdata()[0] for line in lines] == pytest.approx([2 * dt, 4 * dt, 5 * dt])


def test_genealogy_shows_the_agent_that_scores_highest() -> None:
    tree, dt = make_tree(), 0.2
    axes = plot_genealogy(tree, blank(), dt=dt)
    (shade, norm), row = score_colors(tree), rows(tree)
    for fate, stroke in zip(FATES, STROKES, strict=True):
        drawn = by_gid(axes, f"{fate}-all")
        for (_, (x, y)), color in zip(drawn.get_segments(), drawn.get_colors(), strict=True):
            t = round(x / dt) - 1
            slot = row[t // EVERY].tolist().index(round(y))
            pure = np.asarray(shade(norm(tree.score[slot, t].max()))[:3])
            np.testing.assert_allclose(color[:3], stroke.pale + (1 - stroke.pale) * pure, atol=1e-6)


def test_one_picture_of_both(tmp_path: Path) -> None:
    file = tmp_path / "new" / "search.png"
    figure = plot_search(SEGMENT, make_tree(), file)
    assert file.stat().st_size > 20_000
    left, right = figure.axes[:2]
    assert "leaf-0" in gids(left)
    assert "leaf-all" in gids(right)
    assert left.get_legend() is None
    (legend,) = figure.legends
    assert "log" in {text.get_text() for text in legend.get_texts()}


# The command line


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    with StoreWriter(path) as writer:
        writer.append(straight_road(4, steps=8))
        writer.append(crossing(4, seed=1, steps=11))
    return path


def make_run(method: Any, store: Path, out: Path) -> Path:
    config = TrainConfig(
        method=method,
        data=store,
        out=out,
        steps=2,
        agent=AgentConfig(num_points=12, hidden=8),
        segments=2,
        states=16,
        search=SearchConfig(branches=2, prune_every=4, updates=2, states=8),
        discriminator=DiscriminatorConfig(hidden=8),
        checkpoint_every=2,
        log_every=1,
        wandb="disabled",
    )
    return train(config)


@pytest.fixture(scope="module")
def run(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run("bc_ts_h", store, tmp_path_factory.mktemp("runs") / "bc_ts_h")


@pytest.fixture(scope="module")
def run_without_search(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run("bc", store, tmp_path_factory.mktemp("runs") / "bc")


def call(*args: object) -> int:
    return main(["plot", *map(str, args)])


def test_command_line_draws_a_tree(run: Path, store: Path, tmp_path: Path) -> None:
    by_id, by_number, other = (tmp_path / f"{name}.png" for name in ("id", "number", "other"))
    tree = ["tree", run, "--data", store, "--branches", 4]
    assert call(*tree, "--segment", "crossing-1", "--out", by_id) == 0
    assert call(*tree, "--segment", "1", "--out", by_number) == 0
    assert call(*tree, "--segment", "1", "--seed", 1, "--out", other) == 0
    assert by_id.read_bytes() == by_number.read_bytes() != other.read_bytes()
    assert by_id.stat().st_size > 20_000


@pytest.mark.parametrize("rule", ["best", "systematic"])
def test_command_line_shows_the_tree_that_an_evaluation_searches(
    run: Path, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rule: str
) -> None:
    run = Path(shutil.copytree(run, tmp_path / "run"))
    settings = json.loads((run / "agent.json").read_text())
    settings["search"]["rule"] = rule
    (run / "agent.json").write_text(json.dumps(settings))
    drawn: list[SearchTree] = []
    monkeypatch.setattr(symphony.render, "plot_search", lambda segment, tree, path: drawn.append(tree))
    args = [
        "--data",
        store,
        "--segment",
        "crossing-1",
        "--branches",
        4,
        "--seed",
        3,
        "--out",
        tmp_path / "a.png",
    ]
    assert call("tree", run, *args) == 0
    (tree,) = drawn
    assert tree.prune_every == 4
    assert tree.score.shape == (4, 10, 2)
    agent = load_agent(str(run))
    scenes = SceneDataset(SegmentStore(store), 2, agent.dynamics, routes=True).scenes([0, 1])
    config = EvaluateConfig(rollouts=4, search="tree", branches=4, seed=3)
    evaluated = simulated(agent, scenes, config).state[1, :, 1:, :, :2].numpy()
    slots = lineage(torch.from_numpy(tree.parents)).numpy()
    paths = [np.stack([tree.position[slots[t // 4, leaf], t] for t in range(10)]) for leaf in range(4)]
    # The evaluation takes the best leaf first.
    assert sorted(path.tobytes() for path in paths) == sorted(path.tobytes() for path in evaluated)


def test_command_line_draws_curves(run: Path, run_without_search: Path, tmp_path: Path) -> None:
    file = tmp_path / "curves.png"
    assert (
        call(
            "curves",
            run,
            run_without_search,
            "--out",
            file,
            "--metrics",
            "policy_accuracy",
            "discriminator_auc",
        )
        == 0
    )
    assert file.stat().st_size > 5_000


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"--segment": "crossing-9"}, "segment crossing-9: no such segment"),
        ({"--segment": "2"}, "segment 2: the store holds 2 segments"),
        ({"--out": "tree.docx"}, ".png"),
        ({"--data": "nowhere"}, "nowhere"),
        ({"--branches": "-1"}, "branches must not be negative"),
        ({"--prune-every": "-1"}, "prune-every must not be negative"),
    ],
    ids=lambda case: "-".join(case) if isinstance(case, dict) else "",
)
def test_errors_of_the_tree(
    changes: dict[str, str],
    expected: str,
    run: Path,
    store: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = {"--data": str(store), "--segment": "0", "--out": str(tmp_path / "tree.png")}
    args = [part for pair in (options | changes).items() for part in pair]
    assert call("tree", run, *args) in {1, 2}
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "tree.png").exists()


def test_a_tree_needs_a_discriminator(
    run_without_search: Path, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for agent in ("playback", run_without_search):
        args = ["--data", store, "--segment", 0, "--out", tmp_path / "tree.png"]
        assert call("tree", agent, *args) == 1
        assert f"{agent} has no discriminator" in capsys.readouterr().err


def test_errors_of_the_curves(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "fresh").mkdir()
    (tmp_path / "fresh" / "metrics.jsonl").touch()
    for runs, expected in (
        ([], "no runs given"),
        ([tmp_path / "nowhere"], "is no run"),
        ([tmp_path / "fresh"], "no metrics recorded yet"),
        ([run, run], "given twice"),
        ([run, "--metrics", "auk"], "no run has auk"),
        ([run, "--window", "2"], "--window must be from 0 to 1"),
    ):
        assert call("curves", *runs, "--out", tmp_path / "curves.png") in {1, 2}
        assert expected in capsys.readouterr().err


def test_runs_are_named_by_what_tells_them_apart() -> None:
    assert run_names((Path("out/a"), Path("out/b"))) == ["a", "b"]
    assert run_names((Path("out/a/0"), Path("out/b/0"))) == ["a/0", "b/0"]
    with pytest.raises(ConfigError, match="given twice"):
        run_names((Path("out/a"), Path("out/b/../a")))
