"""Simulate agents and keep their rollouts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

import symphony
from symphony.cli import shared
from symphony.config import EvaluateConfig
from symphony.config.evaluation import check_planner_seconds
from symphony.errors import ConfigError


class Simulate(shared.Simulation):
    """Simulate the interactive agents of every run segment and keep the rollouts.

    An interrupted simulation is continued by the same command. See them with `symphony view`, evaluate them with
    `symphony report`, hand them on with `symphony export`.
    """

    out: Path  # Folder of the rollouts.
    #: Planner that drives the ego, while the agent drives the other interactive agents: `idm`, `log`, or one of your
    #: own: a file `my.py:plan`, an import path `my.planner:Planner`, another process `pipe:COMMAND`. With `playback`
    #: as the agent all others play back the log. Nothing is searched then, unless --search, --branches or --trees say
    #: so: a search asks the planner once for each branch.
    planner: str = ""
    planner_seconds: float = 60.0  # Seconds that a planner has for one answer; a longer one fails the run.
    #: Number of runs to simulate (a run is one rollout of one segment) in place of `rollouts`: evenly spread over the
    #: segments, a few more where the number can't be divided so. 0: all segments, `rollouts` of each.
    runs: int = 0
    #: Goals of agents, by their ids in the source: `7=lane:103` for a route over the lane of that id, `7=12.5,-40`
    #: for one that comes past a point (metres, in the frame of the segment); all others as the agent draws them.
    goal: Annotated[tuple[str, ...], arg(metavar="ID=PLACE ...")] = ()
    tree: bool = True  # Leave out the branches that a search pruned.

    def __post_init__(self) -> None:
        check_planner_seconds(self.planner_seconds)
        if self.runs < 0 or (self.runs and self.segments):
            raise ConfigError("--runs is a number of runs, and goes without --segments")
        if self.runs and self.config.rollouts != EvaluateConfig.rollouts:
            raise ConfigError("--runs says how many rollouts a segment gives: it goes without --rollouts")

    def __call__(self) -> None:
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.rollouts.crowd import crowd_dataset
        from symphony.rollouts.driving import beside_planner, spread_runs
        from symphony.saved.saving import save_simulation

        agent = symphony.load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, planner, goals = symphony.SegmentStore(self.data), self.planner, self.goal
        config = beside_planner(self.config) if planner else self.config
        chosen = shared.segment_indices(store, self.segments)
        if self.runs:
            count, config = spread_runs(agent, config, self.runs, len(store))
            chosen = evenly_spaced(len(store), count)
        # Beside log playback nobody else is simulated.
        crowd = {"default": 1 if planner and agent.policy is None else agent.interactive}
        dataset = crowd_dataset(store, agent, config, chosen or None, routes=bool(planner or goals), **crowd)
        beside: dict[str, Any] = {"planner": planner, "planner_seconds": self.planner_seconds, "goals": goals}
        with shared.progress(f"simulating {agent.name}") as advance:
            beside |= {"keep_tree": self.tree, "progress": advance}
            found = save_simulation(self.out, agent, dataset, config, **beside)
        shared.say(f"{len(found)} run segments in {self.out}: symphony view {self.out}")
        shared.tell_failed(found)
