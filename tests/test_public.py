"""The names of ``import symphony``, and how much of the package a training needs."""

from __future__ import annotations

import importlib
import inspect
import sys
from pathlib import Path

import symphony
from helpers_processes import forget, output_of
from helpers_segments import crossing, straight_road
from helpers_store import fill

MOST = 60
"""Modules of the package that plain behavioural cloning reaches, at most."""
UNUSED = "cli collectors envs.driving evaluation metrics render planners.interface rollouts.unroll rollouts.search"
ROOMS = "agents config envs modules learning objectives roadgraph rollouts training wosac"


def test_public_names_are_there_and_documented() -> None:
    names = {name for name in symphony.__all__ if not name.startswith("_")}
    for name in names:
        found = getattr(symphony, name)
        assert inspect.getdoc(found), name
        assert found.__name__ == name
    assert names <= set(dir(symphony))


def test_names_of_packages_are_theirs() -> None:
    """Each is imported when it is asked for, from where the package says."""
    for room in ROOMS.split():
        package = importlib.import_module(f"symphony.{room}")
        for name in package.__all__:
            assert not inspect.ismodule(getattr(package, name)), f"{package.__name__}.{name}"


def cloned(data: Path, out: Path) -> None:
    """Clone, and tell what that has imported."""
    forget("symphony", "matplotlib", "wandb")
    clone = importlib.import_module("symphony")
    how = {"steps": 1, "states": 8, "segments": 2, "wandb": "disabled"}
    clone.train(clone.TrainConfig(method="bc", data=data, out=out, **how))
    sys.stdout.write("\n".join(["modules:", *sys.modules]))


def test_cloning_loads_nothing_that_it_does_not_use(tmp_path: Path) -> None:
    fill(tmp_path / "data", [straight_road(3, steps=8), crossing(4, steps=8)])
    said = output_of(cloned, tmp_path / "data", tmp_path / "run", said=tmp_path / "said")
    reached = set(said.partition("modules:")[2].split())
    assert "symphony.recipes.bc" in reached
    unused = {"matplotlib.pyplot", "wandb", *(f"symphony.{name}" for name in UNUSED.split())}
    assert not unused & reached
    own = sorted(name for name in reached if name.startswith("symphony."))
    assert len(own) <= MOST, own
