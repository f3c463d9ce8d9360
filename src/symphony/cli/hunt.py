"""Estimate how often a planner fails where that is rare."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import symphony
from symphony.cli import shared
from symphony.config import EvaluateConfig
from symphony.config.checks import Bounds, Natural
from symphony.errors import ConfigError

Several = Annotated[int, Bounds(2)]


class Hunt(shared.Command):
    """Hunt for rare failures of a planner among learned agents, and estimate how often they happen.

    Traffic in which the ego comes near to a collision is simulated more often, and weighs less in turn, so that the
    estimate has no bias. It is for these run segments; its error is one standard error over trees. Some runs that
    show the failure are kept: see them with `symphony view`.
    """

    #: Learned agent that drives the others: folder of a run (see `symphony train`), or `pretrained:NAME`.
    agent: Annotated[Positional[str], arg(metavar="RUN")]
    #: Planner that drives the ego, one that can be copied, as for `symphony simulate`.
    planner: str
    data: Path  # Store of run segments.
    out: Path  # New folder of the runs that are kept.
    #: Rate to estimate, of those that a suite of `symphony test` can hold.
    metric: str = "at_fault_collision_rate"
    segments: shared.Segments = ()
    trees: Several = 8  # Independent trees of each run segment.
    branches: Several = 32  # Branches of each tree.
    #: Agents that are driven, the ego included; 0: as many as the agent was trained with.
    interactive: Natural = 0
    duration: Natural = 0  # Seconds that are simulated; 0: as many as the agent was trained with.
    seed: int = 0  # Seed of everything that is drawn at random.
    workers: shared.Workers = 1
    engine: shared.EngineName = "local"
    device: str = "cpu"  # Device that simulates: `cpu`, `cuda` or `cuda:N`.
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.bench.measures import MEASURES
        from symphony.bench.rare import Hunt, hunt
        from symphony.rollouts.crowd import crowd_dataset

        rates = [name for name, measure in MEASURES.items() if measure.kind == "rate"]
        if self.metric not in rates:
            raise ConfigError(f"metric is one of {', '.join(rates)}, not '{self.metric}'")
        names = ("trees", "branches", "interactive", "duration", "seed", "workers", "engine", "device")
        config = EvaluateConfig(**{name: getattr(self, name) for name in names}, rollouts=self.trees)
        agent, store = symphony.load_agent(self.agent, self.device), symphony.SegmentStore(self.data)
        chosen = shared.segment_indices(store, self.segments) or None
        dataset = crowd_dataset(store, agent, config, chosen, routes=True)
        with shared.progress("hunting") as advance:
            found = hunt(self.out, Hunt(agent, dataset, config, self.planner, self.metric), advance)
        if shared.write_numbers(self.json, [asdict(one) for one in found]):
            rows = [["segment", f"{MEASURES[self.metric].text} %", "±", "runs kept"]]
            for one in found:
                numbers = (f"{100 * one.rate:.3g}", f"{100 * one.error:.2g}", str(one.shown))
                rows.append([one.segment or f"all {len(found) - 1}", *numbers])
            shared.print_table(rows, heads=1)
            shared.say(f"runs that show it: symphony view {self.out}")
