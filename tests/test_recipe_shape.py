"""What a recipe looks like, and that nothing below the recipes knows which methods there are."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import pytest

import symphony
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
