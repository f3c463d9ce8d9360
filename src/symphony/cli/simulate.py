"""Simulate agents and keep their rollouts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from symphony.cli import shared
from symphony.config import EvaluateConfig
from symphony.errors import ConfigError

if TYPE_CHECKING:
    pass


class Simulate(shared.Simulation):
    """Simulate the interactive agents of every run segment and keep the rollouts.

    An interrupted simulation is continued by the same command. See them with `symphony view`, evaluate them with
    `symphony report`, hand them on with `symphony export`.
    """

    out: Path  # Folder of the rollouts.
    #: Number of runs to simulate (a run is one rollout of one segment) in place of `rollouts`: of as many segments as
    #: there are, evenly spread, and as few of each as it takes; a few more where the number can't be divided so. 0:
    #: all segments, `rollouts` of each.
    runs: int = 0
    #: Goals of agents, by their ids in the source: `7=lane:103` for a route over the lane of that id, `7=12.5,-40`
    #: for one that comes past a point (metres, in the frame of the segment); all others as the agent draws them.
    goal: Annotated[tuple[str, ...], arg(metavar="ID=PLACE ...")] = ()
    tree: bool = True  # Leave out the branches that a search pruned.

    def __post_init__(self) -> None:
        if self.runs < 0 or (self.runs and self.segments):
            raise ConfigError("--runs is a number of runs, and goes without --segments")
        if self.runs and self.config.rollouts != EvaluateConfig.rollouts:
            raise ConfigError("--runs says how many rollouts a segment gives: it goes without --rollouts")

    def __call__(self) -> None:
        found = self.simulated(self.out, runs=self.runs, goals=self.goal, tree=self.tree)
        shared.say(f"{len(found)} run segments in {self.out}: symphony view {self.out}")
        shared.tell_failed(found)
