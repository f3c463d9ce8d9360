"""Pictures of the very rollouts that were evaluated."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from symphony import keys
from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.learning.demonstrations import SceneDataset
from symphony.render import Clip, SearchTree, animate_rollouts, plot_grid, plot_rollout
from symphony.render.style import ANIMATIONS, FORMATS, picture_path
from symphony.rollouts.driving import search_kind, simulate_batch
from symphony.rollouts.unroll import Rollouts
from symphony.saved.folder import RolloutWriter
from symphony.saved.rollouts import SavedRollouts, saved_rollouts

PANELS = 6
"""Run segments in one picture."""
SHOWN = 8
"""Rollouts drawn per run segment."""


class RolloutKeeper:
    """Saves rollouts while they are evaluated (see the evaluator's ``observe``), but for segments that are there."""

    def __init__(self, writer: RolloutWriter) -> None:
        self.writer = writer

    def __call__(self, item: int, saved: SavedRollouts) -> None:
        """Save the rollouts of a run segment."""
        if not self.writer.has(saved.segment.segment_id):
            self.writer.add(saved)


class ClipKeeper:
    """Keeps rollouts of some run segments while they are evaluated; see the evaluator's ``observe``.

    Args:
        items: numbers of the segments in their dataset.
        rollouts: of each, at most.
        title: before the name of the segment.

    Attributes:
        clips: what was kept so far.
    """

    def __init__(self, items: Sequence[int], rollouts: int = SHOWN, title: str = "") -> None:
        self.items, self.rollouts, self.title = set(items), rollouts, title
        self.clips: list[Clip] = []

    def __call__(self, item: int, saved: SavedRollouts) -> None:
        """Keep the rollouts of a run segment if they are wanted."""
        if item in self.items:
            title = f"{self.title}{saved.segment.segment_id}"
            self.clips.append(saved_clip(saved, self.rollouts, title))


def clip_of(
    segment: RunSegment,
    scenes: SceneBatch,
    rollouts: Rollouts,
    row: int = 0,
    count: int | None = None,
    title: str | None = None,
) -> Clip:
    """Rollouts [B, K, ...] of the run segment in row ``row`` of the scenes, see :func:`saved_clip`."""
    return saved_clip(saved_rollouts(segment, scenes, rollouts, row), count, title)


def saved_clip(saved: SavedRollouts, count: int | None = None, title: str | None = None) -> Clip:
    """The first so many of the rollouts of a segment, all by default, to be drawn or animated."""
    # The first state is the log's.
    state, flags = saved.state[:count, 1:].swapaxes(1, 2), (saved.counted, saved.collision, saved.offroad)
    counted, collision, offroad = (part[:count].swapaxes(1, 2) for part in flags)
    return Clip(
        saved.segment,
        state[..., :2],
        state[..., 2],
        saved.agents,
        saved.start + 1,
        counted,
        collision,
        offroad,
        title=title,
    )


def check_picture(path: Path) -> None:
    """Raise ConfigError if a file is no picture or animation by its name."""
    picture_path(path, (*FORMATS, *ANIMATIONS))


def draw_clips(clips: Sequence[Clip], path: Path, columns: int | None = None) -> None:
    """Draw, or animate, rollouts beside the log.

    Args:
        clips: of one segment each.
        path: picture to write, an animation if it ends in .gif.
        columns: of the picture.
    """
    if picture_path(path, (*FORMATS, *ANIMATIONS)).suffix[1:].lower() in ANIMATIONS:
        animate_rollouts(clips, path)
    else:
        more: dict[str, Any] = {} if columns is None else {"columns": columns}
        panels = [lambda axes, clip=clip: plot_rollout(target=axes, **vars(clip)) for clip in clips]
        plot_grid(panels, path, **more)


def search_tree(agent: Agent, dataset: SceneDataset, item: int, config: EvaluateConfig) -> SearchTree:
    """The first tree that the evaluator grows of an item of a dataset, pruned branches included.

    Raises:
        ConfigError: if the agent has no discriminator to search by, or is not to be searched.
    """
    if agent.policy is None or agent.discriminator is None:
        raise ConfigError(f"{agent.name} has no discriminator to search by: it was not trained with one")
    settings = config.pruning(agent.search)
    kind = search_kind(agent, config)
    if kind != "tree":
        raise ConfigError(f"with search '{kind}' there is no tree to draw: ask for one, --search tree")
    most = config.trees * settings.test_branches
    config = dataclasses.replace(config, rollouts=min(config.rollouts, most))
    scene = dataset.scene(item).to(torch.device(config.device))
    found = simulate_batch(agent, scene, config, keep_tree=True)
    result = found.search
    if result is None or result.tree is None or found.drawn is None:
        raise RuntimeError("the search kept no tree")
    state, there, collision, offroad = (
        result.tree.get(("next", *key))[0, 0].cpu().numpy()
        for key in (keys.STATE, keys.VALID, keys.COLLISION, keys.OFFROAD)
    )
    agents = torch.where(scene.interactive_valid, scene.interactive, -1)[0]
    goals = found.drawn[0, 0]
    # No route is drawn of an agent that follows none, or not the same in all branches.
    same = torch.where((goals == goals[:1]).all(0), goals[0], -1).tolist()
    routes = [
        scene.whole_route(0, n, route).cpu().numpy() if route >= 0 else None for n, route in enumerate(same)
    ]
    return SearchTree(
        # In open traffic agents come and go.
        position=np.where(there[..., None], state[..., :2], np.nan),
        score=result.simulated_scores[0, 0].cpu().numpy(),
        parents=result.parents[0, 0].cpu().numpy(),
        reaches_leaf=result.reaches_leaf[0, 0].cpu().numpy(),
        prune_every=settings.prune_every,
        agents=agents.cpu().numpy(),
        collision=collision[..., 0],
        offroad=offroad[..., 0],
        routes=routes if agent.goals is not None else [],
    )
