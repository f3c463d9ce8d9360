"""Pictures of simulated rollouts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from symphony.trainers import Agent, Rollouts

PANELS = 6
"""Run segments in one picture."""
SHOWN = 8
"""Rollouts drawn per run segment."""


def draw_rollouts(
    agent: Agent, data: Path, path: Path, interactive: int, *, seed: int = 0, panels: int = PANELS
) -> None:
    """Draw rollouts of some run segments, spread evenly over a store, beside the log.

    Args:
        agent: what drives the interactive agents.
        data: the store.
        path: picture to write.
        interactive: agents per segment that are driven.
        seed: of the rollouts.
        panels: how many segments.
    """
    from symphony.render import plot_grid

    found = _panels(agent, data, interactive, seed, panels)
    path.parent.mkdir(parents=True, exist_ok=True)
    plot_grid(found, path)


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

    rows = [_panels(agent, data, interactive, seed, panels, f"{name}: ") for name, agent in agents.items()]
    path.parent.mkdir(parents=True, exist_ok=True)
    plot_grid([panel for row in rows for panel in row], path, columns=len(rows[0]))


def _panels(
    agent: Agent, data: Path, interactive: int, seed: int, panels: int, label: str = ""
) -> list[Callable[[Any], Any]]:
    """What draws the rollouts of each of some segments."""
    from symphony.config import EvaluateConfig
    from symphony.data.store import SegmentStore
    from symphony.render import plot_rollout
    from symphony.trainers.dataset import SceneDataset
    from symphony.trainers.evaluation import playback, simulated

    store = SegmentStore(data)
    panels = min(panels, len(store))
    chosen = [i * len(store) // panels for i in range(panels)]
    dataset = SceneDataset(store, interactive, agent.dynamics, routes=agent.goals is not None)
    config = EvaluateConfig(rollouts=SHOWN, seed=seed)

    def panel(i: int) -> Callable[[Any], Any]:
        segment, scene = dataset.segment(i), dataset.scene(i)
        runs: Rollouts = playback(scene) if agent.policy is None else simulated(agent, scene, config)
        state = runs.state[0].transpose(1, 2)
        flags = {
            name: getattr(runs, name)[0].transpose(1, 2).numpy()
            for name in ("collision", "offroad", "counted")
        }

        def draw(axes: Any) -> Any:
            return plot_rollout(
                segment,
                state[:, :, 1:, :2].numpy(),
                state[:, :, 1:, 2].numpy(),
                scene.interactive[0].numpy(),
                axes,
                start=1,
                valid=flags["counted"],
                collision=flags["collision"],
                offroad=flags["offroad"],
                title=f"{label}{segment.segment_id}",
            )

        return draw

    return [panel(i) for i in chosen]
