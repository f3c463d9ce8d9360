"""Count the operators that a step of a search and an update start on a device, each a launch by the host.

    python benchmarks/launches.py

Counted on the CPU along the code that devices run, where nothing looks at numbers; views are not launches. A compiled
program counts as one.
"""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from symphony.agents import build_agent
from symphony.collectors import KeepBest
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv
from symphony.learning.demonstrations import SceneDataset
from symphony.rollouts.search import search
from workloads import update

BEAM_SEARCH = importlib.import_module("symphony.collectors.beam_search")

METHODS = ("bc", "bc_h", "mgail_h")


class Launches(TorchDispatchMode):
    """Counts operators that compute something, by the running part of the program."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.part = "the rest"

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.counts[self.part] += not func.is_view
        return func(*args, **(kwargs or {}))

    def program(self, step: Callable[..., Any]) -> Callable[..., Any]:
        """Return a compiled function that counts one each time it runs."""

        def run(*args: Any) -> Any:
            self.counts["compiled step"] += 1
            with _disable_current_modes():
                return step(*args)

        return run

    def of(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose operators count for a part."""

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            before, self.part = self.part, part
            try:
                return function(*args, **kwargs)
            finally:
                self.part = before

        return call


def _elsewhere(_tensor: Any) -> bool:
    return False


@contextmanager
def as_on_a_device() -> Iterator[None]:
    """Keep the package from looking at numbers inside."""
    patches = [
        mock.patch.object(module, "on_host", _elsewhere)
        for name, module in list(sys.modules.items())
        if name.startswith("symphony.") and hasattr(module, "on_host")
    ]
    for patch in patches:
        patch.start()
    try:
        yield
    finally:
        for patch in patches:
            patch.stop()


@torch.no_grad()
def of_a_search_step(scenes: int = 2, branches: int = 2, *, compiled: bool = False) -> Counter[str]:
    """Count the operators by part, rounded up, for an agent with goals, foresight and a discriminator."""
    spec = AgentSpec(
        action_space="bicycle",
        dt=0.2,
        goals=True,
        agent=AgentConfig(num_points=20),
        discriminator=DiscriminatorConfig(features="foresight"),
    )
    agent, launches = build_agent("counted", spec), Launches()
    dataset = SceneDataset(SegmentStore(builtin_store("train")), 2, routes=True)
    env = DrivingEnv(dataset.scenes(range(scenes)), Bicycle(), agent.observation)
    scene = torch.arange(scenes)[:, None].expand(-1, branches)
    goal = env.scenes.route_logged[scene]
    start = env.start(scene, torch.arange(branches).expand(scene.shape), goal)
    assert agent.discriminator is not None
    if not compiled:
        env._step = launches.of("environment", env._step)  # type: ignore[method-assign]
        for name, network in (("policy", agent.policy), ("discriminator", agent.discriminator)):
            network.forward = launches.of(name, network.forward)  # type: ignore[method-assign]
    how: dict[str, Any] = {"seed": 0, "rule": KeepBest(0.5), "prune_every": 10}
    how["compile_step"] = {"backend": "eager"} if compiled else False
    made = BEAM_SEARCH._compiled
    one = mock.patch.object(BEAM_SEARCH, "_compiled", lambda *how: launches.program(made(*how)))

    with as_on_a_device(), one:
        if compiled:  # compiled before anything is counted
            search(env, agent.policy, agent.discriminator, start, **how)
            launches.counts.clear()
        with launches:
            search(env, agent.policy, agent.discriminator, start, **how)
    return Counter({part: -(-count // env.decisions) for part, count in launches.counts.items()})


def of_an_update(method: str) -> int:
    """Count the operators of an update without a search: drawing states and changing weights."""
    once, _ = update(method, states=16, points=20)
    with as_on_a_device(), Launches() as launches:
        once()
    return launches.counts.total()


def main() -> None:
    """Print the counts."""
    step = of_a_search_step()
    parts = ", ".join(f"{part} {count}" for part, count in step.most_common())
    compiled = of_a_search_step(compiled=True).total()
    print(f"a step of a search: {step.total()} ({parts}); {compiled} with the step compiled")
    for method in METHODS:
        print(f"an update of {method}: {of_an_update(method)}")


if __name__ == "__main__":
    main()
