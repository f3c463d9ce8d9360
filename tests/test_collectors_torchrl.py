"""What the collector needs of TorchRL: each failure names the member that is missing or has changed."""

from __future__ import annotations

import ast
import inspect
import pickle
import sys
from pathlib import Path

import torch
from torchrl.collectors import Collector

import symphony.collectors
from helpers_collectors import ACTION, Policy, Walk, distance
from symphony.collectors import BeamSearchCollector

ROOM = Path(symphony.collectors.__file__).parents[1]


def read_of_self(name: str) -> set[str]:
    """Attributes of `self` that a class of the collector's module reads and does not make itself."""
    tree = ast.parse(Path(inspect.getfile(BeamSearchCollector)).read_text())
    (found,) = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == name]
    own = {node.name for node in found.body if isinstance(node, ast.FunctionDef)}
    attributes = [node for node in ast.walk(found) if isinstance(node, ast.Attribute)]
    used = [node for node in attributes if isinstance(node.value, ast.Name) and node.value.id == "self"]
    own |= {node.attr for node in used if isinstance(node.ctx, ast.Store)}
    return {node.attr for node in used} - own


def test_members_that_the_collector_reads_are_there_and_do_what_is_asked_of_them():
    how = {"frames_per_batch": 8, "total_frames": 16, "auto_register_policy_transforms": False}
    plain = Collector(Walk(), Policy(), **how)
    read = read_of_self("BeamSearchCollector")
    assert {"env", "policy_device", "postproc", "storing_device", "set_truncated"} <= read
    assert {name for name in read if name.startswith("_")} == {"_wrapped_policy", "_traj_pool"}
    missing = sorted(name for name in read if not hasattr(plain, name))
    assert not missing, f"TorchRL's Collector no longer has {missing}"
    assert plain._wrapped_policy(plain.env.reset()).get(ACTION).shape == (2, 1)
    first, second = (plain._traj_pool.get_traj_and_increment(3, device=torch.device("cpu")) for _ in range(2))
    assert first.dtype == torch.int64
    assert len(torch.cat([first, second]).unique()) == 6


def test_what_the_base_class_calls_is_still_called_so():
    """Methods that the search replaces: an override that nothing calls any more would be silent."""
    replaced = {"rollout", "fake_tensordict", "set_seed", "state_dict", "load_state_dict", "stats"}
    assert replaced <= set(vars(BeamSearchCollector))
    gone = sorted(name for name in replaced if not callable(getattr(Collector, name, None)))
    assert not gone, f"TorchRL's Collector no longer has {gone}"
    calls = ast.walk(ast.parse(inspect.getsource(inspect.getmodule(Collector))))
    assert "rollout" in {node.attr for node in calls if isinstance(node, ast.Attribute)}
    # Trajectories of a batch never go on in the next one, by the public option.
    search = BeamSearchCollector(Walk(), Policy(), score=distance, branches=2, frames_per_batch=8)
    assert search.reset_at_each_iter


def test_bound_classes_are_classes_that_can_be_pickled():
    bound = BeamSearchCollector.bind(score=distance, branches=4, prune_every=2)
    again = pickle.loads(pickle.dumps(bound))  # noqa: S301
    for kind in (bound, again):
        assert issubclass(kind, BeamSearchCollector)
        collector = kind(Walk(), Policy(), frames_per_batch=8, total_frames=8)
        assert (collector.branches, collector.prune_every) == (4, 2)
        assert next(iter(collector)).shape == (8,)
    assert bound(Walk(), Policy(), frames_per_batch=8, branches=3).branches == 3
    more = pickle.loads(pickle.dumps(bound.bind(leaves=2)))  # noqa: S301
    assert more(Walk(), Policy(), frames_per_batch=8).leaves == 2
    # The settings of one subclass do not reach another.
    assert not hasattr(BeamSearchCollector, "settings")


def test_collectors_and_objectives_stand_alone():
    """They import TorchRL, nothing private of it, jaxtyping and each their own, and nothing else of this package."""
    allowed = {"torch", "tensordict", "torchrl", "jaxtyping", *sys.stdlib_module_names}
    for package in ("collectors", "objectives"):
        for source in (ROOM / package).glob("*.py"):
            nodes = list(ast.walk(ast.parse(source.read_text())))
            names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
            froms = [
                (node.module or "", a.name)
                for node in nodes
                if isinstance(node, ast.ImportFrom)
                for a in node.names
            ]
            for name in [*names, *(".".join(parts) for parts in froms)]:
                first, *rest = name.split(".")
                assert name.startswith(f"symphony.{package}") or first in allowed, (source.name, name)
                assert first != "torchrl" or not any(part.startswith("_") for part in rest), (
                    source.name,
                    name,
                )
