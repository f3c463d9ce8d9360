"""Every recipe on disk runs end to end, tiny."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import pytest

from helpers_segments import crossing, straight_road
from symphony.cli import recipe as recipes
from symphony.data.store_writer import StoreWriter
from symphony.recipes import recipe_of

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
TINY = [
    "--steps",
    "3",
    "--states",
    "16",
    "--agent.hidden",
    "8",
    "--agent.num-points",
    "10",
]
COMMON = [*TINY, "--wandb", "disabled", "--rollouts", "2"]
SEARCH = [
    "--search.branches",
    "2",
    "--search.prune-every",
    "3",
    "--search.test-branches",
    "2",
    "--search.updates",
    "2",
    "--checkpoint-every",
    "2",
    "--search.states",
    "8",
]
ADVERSARIAL = [
    *SEARCH,
    "--mgail.regression",
    "1",
    "--mgail.head-start",
    "1",
    "--mgail.rollouts",
    "2",
]
ARGUMENTS = {
    "bc.py": COMMON,
    "bc_h.py": COMMON,
    "bc_ts.py": [*COMMON, *SEARCH],
    "bc_ts_h.py": [*COMMON, *SEARCH],
    "mgail.py": [*COMMON, *ADVERSARIAL],
    "mgail_h.py": [*COMMON, *ADVERSARIAL],
    "mgail_ts.py": [*COMMON, *ADVERSARIAL],
    "mgail_ts_h.py": [*COMMON, *ADVERSARIAL],
}


@pytest.mark.parametrize(
    "recipe", sorted(path.name for path in RECIPES.glob("*.py") if path.stem != "__init__")
)
def test_recipe(
    recipe: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for split, seed in (("train", 0), ("test", 1)):
        with StoreWriter(tmp_path / split) as writer:
            writer.append(straight_road(4, seed=seed, steps=8))
            writer.append(crossing(4, seed=seed, steps=8))
    data = [
        "--data",
        str(tmp_path / "train"),
        "--test",
        str(tmp_path / "test"),
        "--out",
        str(tmp_path / "run"),
    ]
    monkeypatch.setattr(recipes, "settle", lambda: None)
    monkeypatch.setattr(sys, "argv", [recipe, *data, *ARGUMENTS[recipe]])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(RECIPES / recipe), run_name="__main__")
    assert ended.value.code == 0
    (file,) = (tmp_path / "run" / "evaluations").iterdir()
    found = json.loads(file.read_text())
    assert found["run"]["method"] == Path(recipe).stem
    assert found["playback"]["ade"] == 0
    assert found["ade"] > 0
    assert len(found["per_segment"]) == 2
    assert f"{found['ade']:.2f}" in capsys.readouterr().out


def test_a_changed_copy_elsewhere_is_what_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with StoreWriter(tmp_path / "data") as writer:
        writer.append(crossing(4, steps=8))
    source, update = (RECIPES / "bc.py").read_text(encoding="utf-8"), 'yield "policy", policy_loss(experts)'
    assert update in source
    changed = tmp_path / "mine.py"
    changed.write_text(source.replace(update, f'{update}; print("mine")'), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recipes, "settle", lambda: None)
    monkeypatch.setattr(sys, "argv", ["mine.py", "--data", "data", "--test", "data", "--out", "run", *COMMON])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(changed), run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out.count("mine\n") == 3  # updates


def test_mistakes_are_told_in_a_line_before_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with StoreWriter(tmp_path / "train") as writer:
        writer.append(straight_road(4, steps=8))
    words = [
        "--data",
        str(tmp_path / "train"),
        "--test",
        str(tmp_path / "none"),
        "--out",
        str(tmp_path / "run"),
    ]
    monkeypatch.setattr(sys, "argv", ["bc.py", *words, *COMMON])
    monkeypatch.setattr(recipes, "settle", lambda: None)
    with pytest.raises(SystemExit) as ended:
        recipes.main(recipe_of("bc"), None)
    assert ended.value.code == 1
    assert "none: no such directory" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
