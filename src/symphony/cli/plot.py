"""Draw what a run learned from and what it does: its rollouts, the tree of a search, the curves of its training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.errors import ConfigError, DataError

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.data.store import SegmentStore
    from symphony.render import SearchTree
    from symphony.simulation.demonstrations import SceneDataset

app = tyro.extras.SubcommandApp()


@app.command(name="tree")
@dataclass(frozen=True)
class Tree:
    """Draw the beam search of one run segment: every branch on the map and over time, coloured by what the
    discriminator says of it; what was pruned is pale.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run that was trained with search (see `symphony train`), or `pretrained:NAME`."""
    data: Path
    """Store of run segments."""
    segment: str
    """The segment's id, or its number in the store."""
    out: Path
    """Picture to write (.png, .pdf or .svg)."""
    branches: int = 16
    """Branches of the tree."""
    prune_every: int = 0
    """Steps between prunings; 0 takes those of the run."""
    logged_goals: bool = False
    """Give agents the routes of the log instead of sampled ones."""
    seed: int = 0
    """Of everything drawn at random: with the seed of an evaluation it is a tree that was judged there."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        if self.branches < 1:
            raise ConfigError(f"--branches must be at least 1, is {self.branches}")
        if self.prune_every < 0:
            raise ConfigError(f"--prune-every must not be negative, is {self.prune_every}")

    def run(self) -> None:
        """Search and draw."""
        from symphony.agents import load_agent
        from symphony.data.store import SegmentStore
        from symphony.render import plot_search
        from symphony.render.style import picture_path
        from symphony.simulation.demonstrations import SceneDataset

        picture_path(self.out)
        agent = load_agent(self.agent, self.device)
        if agent.discriminator is None:
            raise ConfigError(
                f"{agent.name} has no discriminator to search by: it was not trained with tree search "
                f"(methods bc_ts and bc_ts_h)"
            )
        store = SegmentStore(self.data)
        chosen = [segment_index(store, self.segment)]
        routes = agent.goals is not None
        dataset = SceneDataset(store, agent.interactive, agent.dynamics, chosen, routes=routes)
        plot_search(dataset.segment(0), self._tree(agent, dataset), self.out)

    def _tree(self, agent: Agent, dataset: SceneDataset) -> SearchTree:
        """Search as the evaluator does in its first tree of a segment."""
        import torch

        from symphony import keys
        from symphony.envs.driving import DrivingEnv
        from symphony.render import SearchTree
        from symphony.simulation.rollouts import plant, pruning_rule, search

        scene = dataset.scene(0).to(torch.device(self.device))
        env = DrivingEnv(scene, agent.dynamics, agent.observation)
        start = plant(
            env,
            agent.goals,
            trees=1,
            branches=self.branches,
            seed=self.seed,
            logged_goals=self.logged_goals,
        )[:, 0]
        routes = []
        if agent.goals is not None:
            routes = [
                scene.route[0, n, route, : scene.route_count[0, n, route]].cpu().numpy()
                if route >= 0
                else None
                for n, route in enumerate(start.get(keys.GOAL)[0, 0].tolist())
            ]
        every = self.prune_every or agent.search.prune_every
        with torch.no_grad():
            result = search(
                env,
                agent.policy,
                agent.discriminator,
                start,
                seed=self.seed,
                rule=pruning_rule(agent.search),
                prune_every=every,
                keep_tree=True,
            )
        assert result.tree is not None  # noqa: S101 - asked for just above
        state, collision, offroad = (
            result.tree.get(("next", *key))[0].cpu().numpy()
            for key in (keys.STATE, keys.COLLISION, keys.OFFROAD)
        )
        agents = torch.where(scene.interactive_valid, scene.interactive, -1)[0]
        return SearchTree(
            position=state[..., :2],
            score=result.simulated_scores[0].cpu().numpy(),
            parents=result.parents[0].cpu().numpy(),
            reaches_leaf=result.reaches_leaf[0].cpu().numpy(),
            prune_every=every,
            agents=agents.cpu().numpy(),
            collision=collision[..., 0],
            offroad=offroad[..., 0],
            routes=routes,
        )


@app.command(name="rollouts")
@dataclass(frozen=True)
class Rollouts:
    """Draw what an agent does beside the log, or animate it."""

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME`, `playback` or `constant_velocity`."""
    data: Path
    """Store of run segments."""
    out: Path
    """Picture to write (.png, .pdf or .svg), or animation (.gif)."""
    segments: tuple[str, ...] = ()
    """Their ids, or their numbers in the store; by default some, spread evenly over the store."""
    panels: int = 3
    """How many, if none are named."""
    rollouts: int = 1
    """Of each segment."""
    interactive: int = 0
    """Interactive agents per run segment; 0 takes what the agent was trained with (2 for the baselines)."""
    seed: int = 0
    """Of everything drawn at random."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        for name in ("panels", "rollouts"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name} must be at least 1, is {getattr(self, name)}")
        if self.interactive < 0:
            raise ConfigError(f"--interactive must not be negative, is {self.interactive}")

    def run(self) -> None:
        """Simulate and draw."""
        from symphony.agents import load_agent
        from symphony.cli.pictures import draw_rollouts
        from symphony.data.store import SegmentStore

        agent, store = load_agent(self.agent, self.device), SegmentStore(self.data)
        if len(store) == 0:
            raise DataError("the store holds no run segments", file=store.path)
        draw_rollouts(
            agent,
            self.data,
            self.out,
            self.interactive or agent.interactive,
            seed=self.seed,
            panels=self.panels,
            segments=[segment_index(store, name) for name in self.segments],
            rollouts=self.rollouts,
            device=self.device,
        )


@app.command(name="curves")
@dataclass(frozen=True)
class Curves:
    """Draw the training curves of one or several runs, a panel for each metric."""

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="RUN ...", help_behavior_hint="(required)"),
    ]
    """Folders of runs, still training or done."""
    out: Path
    """Picture to write (.png, .pdf or .svg)."""
    metrics: tuple[str, ...] = ()
    """Draw these metrics only; by default all there are."""
    window: float = 0.1
    """Share of a run's records that a point of the smoothed line is averaged over; 0 for not smoothing."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("no runs given")
        if not 0 <= self.window <= 1:
            raise ConfigError(f"--window must be from 0 to 1, is {self.window}")

    def run(self) -> None:
        """Draw them."""
        from symphony.render import plot_curves
        from symphony.training.logging import read_metrics

        found = {}
        for folder, name in zip(self.runs, run_names(self.runs), strict=True):
            if not (folder / "metrics.jsonl").is_file():
                raise ConfigError(f"{folder} is no run: it has no metrics.jsonl")
            found[name] = read_metrics(folder)
            if not found[name]:
                raise DataError("no metrics recorded yet", file=folder / "metrics.jsonl")
        try:
            plot_curves(found, self.out, metrics=self.metrics, window=self.window)
        except ValueError as error:
            raise ConfigError(str(error)) from error


def segment_index(store: SegmentStore, name: str) -> int:
    """Place in a store of a segment named by its id or its number.

    Raises:
        DataError: there is no such segment.
    """
    if name not in store.ids and name.isdecimal():
        if int(name) >= len(store):
            held = f"the store holds {len(store)} segments, the first is number 0"
            raise DataError(held, file=store.path, segment=name)
        return int(name)
    return store.index_of(name)


def run_names(folders: tuple[Path, ...]) -> list[str]:
    """The folders' names, with as much of their paths as tells them apart.

    Raises:
        ConfigError: a folder given twice.
    """
    parts = [folder.resolve().parts for folder in folders]
    if len(set(parts)) < len(parts):
        raise ConfigError(f"a run is given twice among {', '.join(map(str, folders))}")
    length = 1
    while len({part[-length:] for part in parts}) < len(parts):
        length += 1
    return ["/".join(part[-length:]).replace("//", "/") for part in parts]
