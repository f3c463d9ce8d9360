"""What a recipe looks like, and that nothing below the recipes knows which methods there are."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Container, Iterator
from pathlib import Path

import pytest

import symphony
from symphony.config import METHODS
from symphony.recipes import recipe_of

SOURCE = Path(symphony.__file__).parent
SCRIPTS = Path(__file__).parents[1] / "recipes"
MAY_NAME_METHODS = ("recipes", "cli", "config")
OTHER_WORDS = {"data/sources/scenarionet.py": {"ts"}}
"""Fields of formats that only look like a part of such a name."""
ROWS_OF_TABLES = ("formats.py", "paper.py", "relations.py", "table.py")
"""Of ``evaluation``: methods are rows there."""
NAMES = re.compile(rf"(?<!\w)(?:{'|'.join(METHODS)})(?!\w)")
PARTS = re.compile(r"_?(bc|mgail|ts|ts_h)_?|_h|h_")
"""What a method's name is taken apart by."""


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
    assert not list(steered(tree))
    # As a script it runs itself.
    assert ast.unparse(tree.body[-1]).split("\n")[1:] == [
        "    from symphony.cli.recipe import main",
        f"    main({path.stem}, __doc__)",
    ]


def literals(tree: ast.AST) -> Iterator[ast.Constant]:
    """Strings that are no docstrings."""
    told = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in told:
            yield node


def named(tree: ast.AST, words: Container[str] = ()) -> Iterator[int]:
    """Lines that name a method, or a part of such a name, but for some words."""
    for node in literals(tree):
        if node.value not in words and (NAMES.search(node.value) or PARTS.fullmatch(node.value)):
            yield node.lineno


def steered(tree: ast.AST) -> Iterator[int]:
    """Lines that look which method it is."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr == "method":
            yield node.lineno


def below_the_recipes() -> list[Path]:
    return sorted(
        path
        for path in SOURCE.rglob("*.py")
        if path.relative_to(SOURCE).parts[0] not in MAY_NAME_METHODS
        and not (path.parent.name == "evaluation" and path.name in ROWS_OF_TABLES)
    )


def test_nothing_below_the_recipes_names_a_method() -> None:
    assert len(below_the_recipes()) > 100
    found = []
    for path in below_the_recipes():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        name = path.relative_to(SOURCE).as_posix()
        found += [f"{name}:{line}" for line in (*named(tree, OTHER_WORDS.get(name, ())), *steered(tree))]
    assert found == []


FOUND = [
    *('method.startswith("mgail")', 'adversarial = "mgail" in method', 'searches = "_ts" in method'),
    *('method.endswith("_h")', 'method in ("bc_ts", "bc_ts_h")', 'f"the methods bc_h and {other}"'),
    *('"ts" in method.split("_")', "if config.method == best: pass"),
]
FREE = [
    '"""As bc_ts does."""',
    'losses["loss_bc"]',
    '"policy_mgail_score"',
    'kind = "MGAIL"',
    "loss.method_of()",
]


@pytest.mark.parametrize("text", [*FOUND, *FREE])
def test_it_would_be_found(text: str) -> None:
    tree = ast.parse(text)
    assert {*named(tree), *steered(tree)} == ({1} if text in FOUND else set())
