"""Simulate agents and keep their rollouts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from symphony.config import EvaluateConfig


@dataclass(frozen=True)
class Simulate:
    """Simulate the interactive agents of every run segment and keep the rollouts.

    An interrupted simulation is continued by the same command. See them with `symphony view`, judge them with
    `symphony report`, hand them on with `symphony export`.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME`, `playback` or `constant_velocity`."""
    data: Path
    """Store of run segments."""
    out: Path
    """Folder of the rollouts."""
    segments: tuple[str, ...] = ()
    """Ids of the run segments, or their numbers in the store; by default all."""
    tree: bool = True
    """Leave out the branches that a search pruned."""
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def run(self) -> None:
        """Simulate and save."""
        from rich.console import Console

        from symphony.agents import load_agent
        from symphony.cli.evaluate import segments_bar
        from symphony.cli.plot import segment_index
        from symphony.data.store import SegmentStore
        from symphony.simulation.demonstrations import SceneDataset
        from symphony.simulation.saving import save_simulation

        agent, store, config = (
            load_agent(self.agent, self.config.device),
            SegmentStore(self.data),
            self.config,
        )
        chosen = [segment_index(store, name) for name in self.segments]
        dataset = SceneDataset(
            store,
            config.interactive or agent.interactive,
            agent.dynamics,
            chosen or None,
            routes=agent.goals is not None,
            duration=config.duration or agent.duration,
            keep=config.batch,
        )
        with segments_bar(f"simulating {agent.name}") as advance:
            found = save_simulation(self.out, agent, dataset, config, keep_tree=self.tree, progress=advance)
        Console().print(f"{len(found)} run segments in {self.out}: symphony view {self.out}", soft_wrap=True)
