"""Every recipe on disk runs end to end, tiny."""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.cli import recipe as recipes
from symphony.config import METHODS

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
COMMON = "--steps 3 --states 16 --agent.hidden 8 --agent.num-points 10 --wandb disabled --rollouts 2"
SEARCH = (
    "--search.branches 2 --search.prune-every 3 --search.test-branches 2 --search.updates 2 --search.states 8"
)
ADVERSARIAL = "--mgail.regression 1 --mgail.head-start 1 --mgail.rollouts 2"
ARGUMENTS = {"bc": COMMON, "bc_h": COMMON}
ARGUMENTS |= dict.fromkeys(("bc_ts", "bc_ts_h"), f"{COMMON} {SEARCH} --checkpoint-every 2")
ARGUMENTS |= dict.fromkeys(
    ("mgail", "mgail_h", "mgail_ts", "mgail_ts_h"), f"{ARGUMENTS['bc_ts']} {ADVERSARIAL}"
)


@pytest.fixture
def run_script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[Path, str], Any]:
    """Run a file as a script in an empty folder; returns its status."""

    def run(file: Path, words: str) -> Any:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(recipes, "settle", lambda: None)
        monkeypatch.setattr(sys, "argv", [file.name, *words.split()])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(file), run_name="__main__")
        return ended.value.code

    return run


@pytest.mark.parametrize("method", METHODS)
def test_recipe(run_script: Any, tmp_path: Path, method: str, capsys: pytest.CaptureFixture[str]) -> None:
    for split, seed in (("train", 0), ("test", 1)):
        fill(tmp_path / split, [straight_road(4, seed=seed, steps=8), crossing(4, seed=seed, steps=8)])
    words = f"--data train --test test --out run {ARGUMENTS[method]}"
    assert run_script(RECIPES / f"{method}.py", words) == 0
    (file,) = (tmp_path / "run" / "evaluations").iterdir()
    found = json.loads(file.read_text())
    assert found["run"]["method"] == method
    assert found["playback"]["ade"] == 0
    assert found["ade"] > 0
    assert len(found["per_segment"]) == 2
    assert f"{found['ade']:.2f}" in capsys.readouterr().out


def test_a_changed_copy_elsewhere_is_what_runs(run_script, tmp_path, capsys):
    fill(tmp_path / "data", [crossing(4, steps=8)])
    source, update = (RECIPES / "bc.py").read_text(encoding="utf-8"), 'yield "policy", policy_loss(experts)'
    assert update in source
    changed = tmp_path / "mine.py"
    changed.write_text(source.replace(update, f'{update}; print("mine")'), encoding="utf-8")
    # Mistakes are told in a line before the training.
    assert run_script(changed, f"--data data --test none --out run {COMMON}") == 1
    assert "none: no such directory" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert run_script(changed, f"--data data --test data --out run {COMMON}") == 0
    assert capsys.readouterr().out.count("mine\n") == 3  # updates
