"""Change single operators, numbers and names in functions, and tell which changes no test notices. POSIX only.

Each change is made in a process of its own, forked from one that has imported everything, and the tests of that
module are run there until the first that fails. Changes outside of functions (constants, decorators) are not made.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import io
import json
import os
import random
import re
import resource
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]

PACKAGE = ROOT / "src" / "symphony"
ROOMS = ["geometry", "roadgraph", "envs", "modules", "collectors", "objectives", "learning"]
ROOMS += ["rollouts", "metrics", "evaluation"]
"""Where changes are made unless others are asked for: rooms that compute."""
SECONDS = 300  # CPU time that the tests may take with a change: one that goes on for ever is noticed, too
OPERATORS: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
NAMES = {"amax": "amin", "max": "min", "any": "all", "sin": "cos", "maximum": "minimum", "sum": "mean"}
NAMES |= {other: name for name, other in NAMES.items()}


def changes(tree: ast.Module) -> Iterator[tuple[str, int, Any]]:
    """Every possible change inside functions: what, in which line, and a function that makes it."""
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        for node in (inner for statement in function.body for inner in ast.walk(statement)):
            line, new = getattr(node, "lineno", function.lineno), None
            if isinstance(node, ast.Compare) and type(node.ops[0]) in OPERATORS:
                new = "ops", [OPERATORS[type(node.ops[0])](), *node.ops[1:]]
            elif isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in OPERATORS:
                new = "op", OPERATORS[type(node.op)]()
            elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                new = "value", node.value + 1
            elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
                new = "op", ast.UAdd()
            elif isinstance(node, ast.Attribute) and node.attr in NAMES:
                new = "attr", NAMES[node.attr]
            if new is not None:
                name, value = new
                shown = value[0] if isinstance(value, list) else value
                shown = type(shown).__name__ if isinstance(shown, ast.AST) else shown
                yield f"{ast.unparse(node)[:60]}: {name} becomes {shown}", line, partial(setattr, node, *new)


def replace_code(module: ModuleType, source: ast.Module) -> None:
    """Give the functions of a module the code of those of a changed one, wherever they are known by now."""
    other = ModuleType(module.__name__)
    other.__file__, other.__package__ = module.__file__, module.__package__
    sys.modules["mutated"] = other
    exec(compile(ast.fix_missing_locations(source), str(module.__file__), "exec"), other.__dict__)  # noqa: S102
    places = [(module.__dict__, other.__dict__)]
    places += [
        (kind.__dict__, other.__dict__[name].__dict__)
        for name, kind in module.__dict__.items()
        if inspect.isclass(kind) and kind.__module__ == module.__name__
    ]
    for mine, new in places:
        for name in list(mine):
            if hasattr(mine[name], "cache_clear"):  # of what the tests have asked for before
                mine[name].cache_clear()
            plain, fresh = (_function(each.get(name)) for each in (mine, new))
            if plain is not None and fresh is not None and plain.__module__ == module.__name__:
                plain.__code__ = fresh.__code__


def _function(value: Any) -> FunctionType | None:
    value = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
    value = inspect.unwrap(value) if callable(value) else value
    return value if isinstance(value, FunctionType) else None


def noticed(module: ModuleType, number: int | None, files: Sequence[str]) -> bool:
    """Whether the tests fail with a change, or as it is; not here, where they could leave threads that forks lack."""
    child = os.fork()
    if child == 0:
        status = 1
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        try:
            if number is not None:
                tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
                list(changes(tree))[number][2]()
                replace_code(module, tree)
            status = tests(files)
        finally:
            os._exit(int(status != 0))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0


def modules(names: Sequence[str]) -> list[str]:
    """The modules of rooms, such as ``envs``, and those that are named themselves, such as ``envs.flags``."""
    places = [PACKAGE / name.replace(".", "/") for name in names]
    files = [f for p in places for f in (sorted(p.rglob("*.py")) if p.is_dir() else [p.with_suffix(".py")])]
    return [".".join(f.relative_to(PACKAGE).with_suffix("").parts) for f in files if f.stem != "__init__"]


def tests_of(module: str) -> list[str]:
    """The files of tests that name the module or, where none does, its room; first those that have its name."""
    texts = {str(file): file.read_text() for file in sorted((ROOT / "tests").rglob("test_*.py"))}
    for name in (module, module.partition(".")[0]):
        found = [file for file, text in texts.items() if re.search(rf"\bsymphony\.{re.escape(name)}\b", text)]
        if found:
            return sorted(found, key=lambda file: module.rpartition(".")[2] not in file)
    return []


def tests(files: Sequence[str]) -> int:
    """Run files of tests quietly."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        quiet = ("-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning")
        return int(pytest.main([*files, "-x", "-q", *quiet]))


def main(args: list[str] | None = None) -> int:
    """Make changes in turns over the modules; status 1 if one was not noticed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--changes", type=int, default=10, help="of each module")
    parser.add_argument("--modules", nargs="+", default=ROOMS, help="such as envs, or envs.flags")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/mutate.json"), help="where the counts are kept")
    given = parser.parse_args(args)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, Any]] = {}
    for name in modules(given.modules):
        module, files = importlib.import_module(f"symphony.{name}"), tests_of(name)
        if noticed(module, None, files):
            raise SystemExit(f"{' '.join(files)}: fails as it is")
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        possible = [f"line {line}: {what}" for what, line, _ in changes(tree)]
        number = min(given.changes, len(possible))
        chosen = random.Random(given.seed).sample(range(len(possible)), number)
        missed = [possible[k] for k in sorted(chosen) if not noticed(module, k, files)]
        for text in missed:
            print(f"not noticed: {name}, {text}", flush=True)
        print(f"{name}: {len(chosen)} of {len(possible)} changes made", flush=True)
        found[name] = {"possible": len(possible), "made": number, "missed": missed}
        given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    made = sum(each["made"] for each in found.values())
    lost = sum(len(each["missed"]) for each in found.values())
    print(f"{made} changes, {made - lost} noticed")
    return int(lost > 0)


if __name__ == "__main__":
    raise SystemExit(main())
