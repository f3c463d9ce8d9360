"""Pictures of simulated rollouts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.render import Clip

PANELS = 6
"""Run segments in one picture."""
SHOWN = 8
"""Rollouts drawn per run segment."""


def draw_rollouts(
    agent: Agent,
    data: Path,
    path: Path,
    interactive: int,
    *,
    seed: int = 0,
    panels: int = PANELS,
    segments: Sequence[int] = (),
    rollouts: int = SHOWN,
    device: str = "cpu",
) -> None:
    """Draw, or animate, rollouts of some run segments beside the log.

    Args:
        agent: what drives the interactive agents.
        data: the store.
        path: picture to write, an animation if it ends in .gif.
        interactive: agents per segment that are driven.
        seed: of the rollouts.
        panels: how many segments, spread evenly over the store.
        segments: their numbers in the store, if these are to be drawn.
        rollouts: of each.
        device: where the agent is.
    """
    from symphony.render import animate_rollouts, plot_grid
    from symphony.render.style import ANIMATIONS, FORMATS, picture_path

    animated = picture_path(path, (*FORMATS, *ANIMATIONS)).suffix[1:].lower() in ANIMATIONS
    chosen = segments or _spread(data, panels)
    clips = _clips(agent, data, interactive, seed, chosen, rollouts=rollouts, device=device)
    if animated:
        animate_rollouts(clips, path)
    else:
        plot_grid([_panel(clip) for clip in clips], path)


def draw_compared(
    agents: Mapping[str, Agent], data: Path, path: Path, interactive: int, *, seed: int = 0, panels: int = 3
) -> None:
    """The same for several agents on the same segments: a row for each, which its panels name.

    Args:
        agents: by the names they get in the picture.
        data: the store.
        path: picture to write.
        interactive: agents per segment that are driven.
        seed: of the rollouts.
        panels: how many segments.
    """
    from symphony.render import plot_grid

    chosen = _spread(data, panels)
    rows = [_clips(agent, data, interactive, seed, chosen, f"{name}: ") for name, agent in agents.items()]
    plot_grid([_panel(clip) for row in rows for clip in row], path, columns=len(rows[0]))


def _spread(data: Path, count: int) -> list[int]:
    from symphony.data.store import SegmentStore
    from symphony.simulation.demonstrations import spread

    return spread(len(SegmentStore(data)), count)


def _clips(
    agent: Agent,
    data: Path,
    interactive: int,
    seed: int,
    chosen: Sequence[int],
    label: str = "",
    rollouts: int = SHOWN,
    device: str = "cpu",
) -> list[Clip]:
    """The rollouts of each of some segments."""
    import torch

    from symphony.config import EvaluateConfig
    from symphony.data.store import SegmentStore
    from symphony.evaluation.evaluator import driven_by
    from symphony.simulation.demonstrations import SceneDataset
    from symphony.training.previews import clip_of

    store = SegmentStore(data)
    dataset = SceneDataset(store, interactive, agent.dynamics, chosen, routes=agent.goals is not None)
    config = EvaluateConfig(rollouts=rollouts, seed=seed, device=device)

    def clip(i: int) -> Clip:
        segment, scene = dataset.segment(i), dataset.scene(i)
        runs = driven_by(agent, scene.to(torch.device(device)), config).cpu()
        return clip_of(segment, scene, runs, title=f"{label}{segment.segment_id}")

    return [clip(i) for i in range(len(dataset))]


def _panel(clip: Clip) -> Callable[[Any], Any]:
    """What draws rollouts on axes."""
    from symphony.render import plot_rollout

    return lambda axes: plot_rollout(target=axes, **vars(clip))
