"""Pictures of the very rollouts that were evaluated."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from symphony import keys
from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.evaluation.evaluator import EvaluatedBatch
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
    """Saves rollouts while they are evaluated; see the evaluator's ``observe``.

    Args:
        writer: of the folder.
        driver: name of the agent.
        others: what drives background agents.
    """

    def __init__(self, writer: RolloutWriter, driver: str, others: str = "log") -> None:
        self.writer, self.driver, self.others = writer, driver, others

    def __call__(self, batch: EvaluatedBatch) -> None:
        """Save a batch, but for segments that are there already."""
        for row, segment in enumerate(batch.segments):
            if not self.writer.has(segment.segment_id):
                self.writer.add(
                    saved_rollouts(
                        segment,
                        batch.scenes,
                        batch.rollouts,
                        row,
                        goal=batch.goal,
                        driver=self.driver,
                        others=self.others,
                    )
                )


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

    def __call__(self, batch: EvaluatedBatch) -> None:
        """Keep what is wanted of a batch."""
        for row, (item, segment) in enumerate(zip(batch.items, batch.segments, strict=True)):
            if item in self.items:
                title = f"{self.title}{segment.segment_id}"
                clip = clip_of(segment, batch.scenes, batch.rollouts, row, self.rollouts, title)
                self.clips.append(clip)


def clip_of(
    segment: RunSegment,
    scenes: SceneBatch,
    rollouts: Rollouts,
    row: int = 0,
    count: int | None = None,
    title: str | None = None,
) -> Clip:
    """Rollouts of one run segment, to be drawn or animated.

    Args:
        segment: in row ``row`` of the scenes.
        scenes: that were simulated, on the CPU.
        rollouts: [B, K, ...] of them, on the CPU.
        row: of the batch.
        count: how many of the K; all by default.
        title: of the picture; by default the segment's id.
    """
    # Past the segment's end there is only the padding of its batch.
    steps = segment.num_steps - 1
    state = rollouts.state[row, :count, 1 : steps + 1].transpose(1, 2).numpy()
    counted, collision, offroad = (
        part[row, :count, :steps].transpose(1, 2).numpy()
        for part in (rollouts.counted, rollouts.collision, rollouts.offroad)
    )
    agents = torch.where(scenes.interactive_valid[row], scenes.interactive[row], -1).numpy()
    return Clip(segment, state[..., :2], state[..., 2], agents, 1, counted, collision, offroad, title=title)


def saved_clip(saved: SavedRollouts, count: int | None = None, title: str | None = None) -> Clip:
    """The first so many of the saved rollouts of a segment, all by default, to be drawn or animated."""
    # The first state is the log's.
    state = saved.state[:count, 1:].swapaxes(1, 2)
    counted, collision, offroad = (
        part[:count].swapaxes(1, 2) for part in (saved.counted, saved.collision, saved.offroad)
    )
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
        more: Mapping[str, Any] = {} if columns is None else {"columns": columns}
        plot_grid([_panel(clip) for clip in clips], path, **more)


def _panel(clip: Clip) -> Callable[[Any], Any]:
    """What draws rollouts on axes."""
    return lambda axes: plot_rollout(target=axes, **vars(clip))


def search_tree(agent: Agent, dataset: SceneDataset, item: int, config: EvaluateConfig) -> SearchTree:
    """The first tree that the evaluator grows of a run segment, pruned branches included.

    Args:
        agent: with a discriminator.
        dataset: of the segment.
        item: its number there.
        config: how it is simulated.

    Raises:
        ConfigError: if the agent has no discriminator to search by, or is not to be searched.
    """
    if agent.policy is None or agent.discriminator is None:
        raise ConfigError(f"{agent.name} has no discriminator to search by: it was not trained with one")
    settings = config.pruning(agent.search)
    if search_kind(agent, config) != "tree":
        raise ConfigError(
            f"with search '{search_kind(agent, config)}' there is no tree to draw: ask for one, --search tree"
        )
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
        routes=_routes(scene, found.drawn[0, 0]) if agent.goals is not None else [],
    )


def _routes(scene: SceneBatch, goals: Int[Tensor, "S N"]) -> list[Any]:
    """Points of the route of each agent; None where it follows none, or not the same in all branches."""
    same = torch.where((goals == goals[:1]).all(0), goals[0], -1)
    return [
        scene.whole_route(0, n, route).cpu().numpy() if route >= 0 else None
        for n, route in enumerate(same.tolist())
    ]
