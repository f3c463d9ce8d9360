"""What a recipe looks like, that nothing below knows which there are, and that each runs end to end."""

from __future__ import annotations

import ast
import inspect
import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import symphony
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.cli import recipe as recipes
from symphony.config import METHODS
from symphony.recipes import recipe_of

SOURCE = Path(symphony.__file__).parent
SCRIPTS = Path(__file__).parents[1] / "recipes"
MAY_NAME_METHODS = ("recipes", "cli", "config")
ROWS_OF_TABLES = ("formats.py", "paper.py", "relations.py", "table.py")
"""Of ``evaluation``: methods are rows there."""


def modules() -> list[Path]:
    return sorted(path for path in (SOURCE / "recipes").glob("*.py") if path.stem != "__init__")


def test_there_is_a_recipe_for_every_method_and_the_file_that_one_opens_is_the_one_that_runs() -> None:
    assert {path.stem for path in modules()} == set(METHODS)
    for name in METHODS:
        recipe = recipe_of(name)
        assert (recipe.__module__, recipe.__name__) == (f"symphony.recipes.{name}", name)
    assert SCRIPTS.is_dir()
    assert not SCRIPTS.is_symlink()  # sites that show repositories follow no links of folders
    assert (SOURCE / "recipes").samefile(SCRIPTS)


@pytest.mark.parametrize("path", modules(), ids=lambda path: path.stem)
def test_a_recipe_is_one_function_that_can_be_read_at_once(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    assert [node.name for node in functions] == [path.stem]
    assert list(inspect.signature(recipe_of(path.stem)).parameters) == ["config", "processes"]
    # Recipes repeat one another, and don't lean on one another.
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not {name for name in imported if name is not None and name.startswith("symphony.recipes")}
    assert not re.search(r"\.method\b", path.read_text(encoding="utf-8"))
    # As a script it runs itself.
    assert ast.unparse(tree.body[-1]).split("\n")[1:] == [
        "    from symphony.cli.recipe import main",
        f"    main({path.stem}, __doc__)",
    ]


def test_nothing_below_the_recipes_names_a_method() -> None:
    """Nor looks which it is."""
    word = re.compile(rf"""config\.method\b|["'](?:{"|".join(METHODS)})["']|endswith\("_h"\)""")
    found, looked = [], 0
    for path in sorted(SOURCE.rglob("*.py")):
        where = path.relative_to(SOURCE)
        if where.parts[0] in MAY_NAME_METHODS or (
            where.parts[0] == "evaluation" and path.name in ROWS_OF_TABLES
        ):
            continue
        lines = enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        found += [f"{where}:{k}" for k, line in lines if word.search(line) and "``" not in line]
        looked += 1
    assert looked > 100
    assert found == []


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
    assert run_script(SCRIPTS / f"{method}.py", words) == 0
    (file,) = (tmp_path / "run" / "evaluations").iterdir()
    found = json.loads(file.read_text())
    assert found["run"]["method"] == method
    assert found["playback"]["ade"] == 0
    assert found["ade"] > 0
    assert len(found["per_segment"]) == 2
    assert f"{found['ade']:.2f}" in capsys.readouterr().out


def test_a_changed_copy_elsewhere_is_what_runs(run_script, tmp_path, capsys):
    fill(tmp_path / "data", [crossing(4, steps=8)])
    source, update = (SCRIPTS / "bc.py").read_text(encoding="utf-8"), 'yield "policy", policy_loss(experts)'
    assert update in source
    changed = tmp_path / "mine.py"
    changed.write_text(source.replace(update, f'{update}; print("mine")'), encoding="utf-8")
    # Mistakes are told in a line before the training.
    assert run_script(changed, f"--data data --test none --out run {COMMON}") == 1
    assert "none: no such directory" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert run_script(changed, f"--data data --test data --out run {COMMON}") == 0
    assert capsys.readouterr().out.count("mine\n") == 3  # updates
