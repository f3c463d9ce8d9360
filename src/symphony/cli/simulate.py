"""Simulate agents and keep their rollouts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.cli.shared import Names, TrustCode, progress, say, segment_indices
from symphony.config import EvaluateConfig
from symphony.config.evaluation import check_planner_seconds
from symphony.errors import AllFailedError, ConfigError

if TYPE_CHECKING:
    from symphony.saved.folder import RolloutFolder


@dataclass(frozen=True)
class Simulate:
    """Simulate the interactive agents of every run segment and keep the rollouts.

    An interrupted simulation is continued by the same command. See them with `symphony view`, evaluate them with
    `symphony report`, hand them on with `symphony export`.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME`, `playback`, `constant_velocity` or `idm`."""
    data: Path
    """Store of run segments."""
    out: Path
    """Folder of the rollouts."""
    segments: Names = ()
    """Ids of the only run segments to simulate, or their numbers in the store."""
    runs: int = 0
    """Number of runs to simulate (a run is one rollout of one segment) in place of `rollouts`: of as many segments as
    there are, evenly spread, and as few of each as it takes; a few more where the number can't be divided so. 0: all
    segments, `rollouts` of each."""
    planner: str = ""
    """Planner that drives the ego, while the agent drives the other interactive agents: `idm`, `log`, or one of your
    own: a file `my.py:plan`, an import path `my.planner:Planner`, another process `pipe:COMMAND`. With `playback` as
    the agent all others play back the log. Nothing is searched then, unless --search, --branches or --trees say so: a
    search asks the planner once for each branch."""
    planner_seconds: float = 60.0
    """Seconds that a planner has for one answer; a longer one fails the run."""
    goal: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID=PLACE ...")] = ()
    """Goals of agents, by their ids in the source: `7=lane:103` for a route over the lane of that id, `7=12.5,-40`
    for one that comes past a point (metres, in the frame of the segment); all others as the agent draws them."""
    tree: bool = True
    """Leave out the branches that a search pruned."""
    trust_code: TrustCode = False
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def __post_init__(self) -> None:
        if self.runs < 0 or (self.runs and self.segments):
            raise ConfigError("--runs is a number of runs, and goes without --segments")
        if self.runs and self.config.rollouts != EvaluateConfig.rollouts:
            raise ConfigError("--runs says how many rollouts a segment gives: it goes without --rollouts")
        check_planner_seconds(self.planner_seconds)

    def simulated(self) -> RolloutFolder:
        """Simulate and save."""
        from symphony.agents import load_agent
        from symphony.data.store import SegmentStore
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.rollouts.crowd import crowd_dataset
        from symphony.rollouts.driving import beside_planner, spread_runs
        from symphony.saved.saving import save_simulation

        agent = load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, config = SegmentStore(self.data), self.config
        if self.planner:
            config = beside_planner(config)
        # Beside log playback nobody else is simulated.
        others = 1 if self.planner and agent.policy is None else agent.interactive
        chosen = segment_indices(store, self.segments)
        if self.runs:
            count, config = spread_runs(agent, config, self.runs, len(store))
            chosen = evenly_spaced(len(store), count)
        routes = bool(self.planner or self.goal)
        dataset = crowd_dataset(store, agent, config, chosen or None, default=others, routes=routes)
        with progress(f"simulating {agent.name}") as advance:
            return save_simulation(
                self.out,
                agent,
                dataset,
                config,
                keep_tree=self.tree,
                planner=self.planner,
                planner_seconds=self.planner_seconds,
                goals=self.goal,
                progress=advance,
            )

    def run(self) -> None:
        """Simulate, save, and say where."""
        found = self.simulated()
        say(f"{len(found)} run segments in {self.out}: symphony view {self.out}")
        tell_failed(found, say)


def tell_failed(folder: RolloutFolder, tell: Callable[[str], object]) -> None:
    """Tell how many runs failed, and why the first of them did; nothing if all are well.

    Raises:
        AllFailedError: all did.
    """
    why = [f"{saved.segment.segment_id}, {reason}" for saved in folder for reason in saved.failed.values()]
    why += [f"{entry.segment}, {entry.failed}" for entry in folder.failures for _ in range(entry.rollouts)]
    runs = sum(entry.rollouts for entry in [*folder.entries, *folder.failures])
    if why and len(why) == runs:
        raise AllFailedError(f"all {runs} runs failed, the first: {why[0]}")
    if why:
        tell(f"{len(why)} of {runs} runs failed, the first: {why[0]}")
