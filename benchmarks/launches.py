"""Count the operators that a step of a search and an update start on a device, each a launch by the host.

    python benchmarks/launches.py

Counted on the CPU along the code that devices run, where nothing looks at numbers; views are not launches. A compiled
program counts as one.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch._dynamo.backends.common import aot_autograd
from torch._functorch.aot_autograd import make_boxed_func
from torch._functorch.compilers import nop
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from symphony.agents import build_agent
from symphony.collectors import KeepBest
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig, MGAILConfig, TrainConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv
from symphony.learning.demonstrations import SceneDataset
from symphony.programs import compiled
from symphony.recipes import recipe_of
from symphony.rollouts.search import COMPILER, search
from symphony.training import Processes

BEAM_SEARCH, MGAIL = map(importlib.import_module, ("symphony.collectors.beam_search", "symphony.objectives.mgail"))

METHODS = ("bc", "bc_ts_h", "bc_rl_h", "mgail_ts_h")


class Launches(TorchDispatchMode):
    """Counts operators that compute something, by the running part of the program."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.part = "the rest"

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.counts[self.part] += not func.is_view
        return func(*args, **(kwargs or {}))

    def compiled(self, *how: Any) -> Callable[..., Any]:
        """Return a compiled step that counts one each time it runs."""
        step = compiled(*how)

        def run(*args: Any) -> Any:
            self.counts[f"{self.part}, compiled"] += 1
            with _disable_current_modes():
                return step(*args)

        return run

    def program(self, graph: Any, _inputs: Any) -> Callable[..., Any]:
        """Return the graph of a backward pass that counts one each time it runs."""

        def run(*args: Any) -> Any:
            self.counts[f"{self.part}, compiled"] += 1
            with _disable_current_modes():
                return graph(*args)

        return make_boxed_func(run)

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
    """Keep the package from looking at numbers inside, and have optimizers take all weights together."""
    patches = [
        mock.patch("torch.optim.adam._default_to_fused_or_foreach", return_value=(False, True)),
        mock.patch("torch.nn.utils.clip_grad._has_foreach_support", return_value=True),
    ]
    patches += [
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
def of_a_search_step(scenes: int = 2, branches: int = 2, *, compile_step: bool = False) -> Counter[str]:
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
    if not compile_step:
        env._step = launches.of("environment", env._step)  # type: ignore[method-assign]
        for name, network in (("policy", agent.policy), ("discriminator", agent.discriminator)):
            network.forward = launches.of(name, network.forward)  # type: ignore[method-assign]
    how: dict[str, Any] = {"seed": 0, "rule": KeepBest(0.5), "prune_every": 10}
    how["compile_step"] = {"backend": "eager"} if compile_step else False
    one = mock.patch.object(BEAM_SEARCH, "compiled", launches.compiled)

    with as_on_a_device(), one:
        if compile_step:  # compiled before anything is counted
            search(env, agent.policy, agent.discriminator, start, **how)
            launches.counts.clear()
        with launches:
            search(env, agent.policy, agent.discriminator, start, **how)
    return Counter({part: -(-count // env.decisions) for part, count in launches.counts.items()})


def of_an_update(method: str, *, compile_step: bool = False) -> Counter[str]:
    """Count the operators of an update on prepared segments, of MGAIL in its last phase, by losses: forward, with the
    states that they are of, and backward, with the change of weights. A ``search`` is made once for several updates.
    """
    on: Any = {"mgail": MGAILConfig(regression=1, head_start=0), "compile": "yes" if compile_step else "no"}
    on |= {"data": builtin_store("train"), "out": Path("not written"), "states": 16, "wandb": "disabled"}
    config = TrainConfig(method=method, agent=AgentConfig(num_points=20), **on)  # type: ignore[arg-type]
    trainer, launches = recipe_of(method)(config, Processes(torch.device("cpu"))), Launches()  # type: ignore[arg-type]
    items = list(range(min(config.segments, len(trainer.data))))
    trainer.data.draw = lambda count, rng: items[:count]  # type: ignore[method-assign]
    trainer.data.experts.many(items)

    def run(step: int) -> None:
        launches.part = "forward"
        for name, losses in trainer.phases[-1].update(step):
            launches.counts[name] += launches.counts.pop("forward", 0)
            launches.part = f"{name} backward"
            trainer._descend(name, losses)
            launches.part = "forward"

    how = mock.patch.dict(COMPILER, backend=aot_autograd(fw_compiler=nop, bw_compiler=launches.program))
    one, other = (mock.patch.object(module, "compiled", launches.compiled) for module in (BEAM_SEARCH, MGAIL))
    with as_on_a_device(), how, one, other, torch.enable_grad():
        for step in range(1, 1 + 2 * compile_step):  # all is compiled before anything is counted
            run(step)
        launches.counts.clear()
        with launches:
            run(config.search.updates)
    return +launches.counts


def main() -> None:
    """Print the counts."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for compile_step in (False, True):
        step, how = of_a_search_step(compile_step=compile_step), " (compiled)" * compile_step
        print(f"a step of a search{how}: {told(step)}", flush=True)
        for method in METHODS:
            print(f"an update of {method}{how}: {told(of_an_update(method, compile_step=compile_step))}", flush=True)


def told(counts: Counter[str]) -> str:
    """Return the total of counts, and the parts."""
    return f"{counts.total()} ({', '.join(f'{part} {count}' for part, count in counts.most_common())})"


if __name__ == "__main__":
    main()
