"""The whole way on the data that comes with the package."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import symphony
from symphony.cli import shared
from symphony.config import AgentConfig, EvaluateConfig, PerturbConfig, TrainConfig
from symphony.files import write_json

if TYPE_CHECKING:
    from symphony.render import Clip
    from symphony.saved.rollouts import SavedRollouts

PANELS, SHOWN = 3, 8
"""Run segments in the picture, and rollouts that are drawn of each."""
BASELINES = {"log playback": "playback", "constant velocity": "constant_velocity"}
"""Agents by their titles, of which only the numbers are shown."""


class Demo(shared.Command):
    """Evaluate and draw an agent that comes with the package, on the built-in data: half a minute on a laptop.

    Then learn another from the built-in data, some minutes, and show it beside the first.
    """

    #: Folder for the trained agent, the pictures and the numbers; an earlier demo there is replaced.
    out: Path = Path("out/demo")
    steps: int = 1500  # Updates of the agent that is learned.
    rollouts: int = 16  # Rollouts per run segment in the evaluation.
    seed: int = 0  # Seed of the training and of the rollouts.

    def __call__(self) -> None:
        with shared.locked_folder(self.out, "demo.lock"):
            self._show_all()

    def _show_all(self) -> None:
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.render import draw_clips, saved_clip

        began, run, numbers = time.perf_counter(), self.out / "bc_h", self.out / "metrics.json"
        test = symphony.builtin_store("test")
        settings = EvaluateConfig(rollouts=self.rollouts, seed=self.seed)
        items = evenly_spaced(len(symphony.SegmentStore(test)), PANELS)
        rows: list[dict[str, Any]] = []
        clips: list[Clip] = []

        def show(agents: dict[str, str], picture: Path) -> None:
            """Evaluate agents by their titles, and show them beside those before."""
            for title, agent in agents.items():
                kept: dict[int, SavedRollouts] = {}
                with shared.progress(f"evaluating {title}") as advance:
                    found = symphony.evaluate(agent, test, settings, advance, observe=kept.__setitem__)
                rows.append({**found.numbers(), "agent": title})
                for saved in [] if title in BASELINES else map(kept.__getitem__, items):
                    clips.append(saved_clip(saved, SHOWN, f"{title}: {saved.segment.segment_id}"))
            shared.print_metrics(rows, "Built-in test segments")
            write_json(numbers, {"rows": rows, "seconds": round(time.perf_counter() - began, 1)})
            draw_clips(clips, picture, columns=len(items))
            shared.say(f"picture: {picture}")

        shared.say("An included agent, on segments that it has not seen, with its search:")
        show({**BASELINES, "included BC+TS+H": "pretrained:bc_ts_h"}, self.out / "included.png")
        shared.say(f"\nNow one of your own: BC with goals (BC+H), {self.steps} updates, some minutes.")
        if (run / "config.json").is_file():
            shutil.rmtree(run)
        # Cheaper updates than by default suit the few segments of the package; so do inputs beyond the paper's, and
        # displaced states once the policy drives.
        agent = AgentConfig(num_points=128, num_lights=4, features="gaps", accelerations=21)
        perturb = PerturbConfig(share=0.5, begin=self.steps // 3)
        more: dict[str, Any] = {"states": 512, "agent": agent, "perturb": perturb, "wandb": "disabled"}
        more |= {"data": symphony.builtin_store("train"), "out": run, "steps": self.steps, "seed": self.seed}
        symphony.train(TrainConfig(method="bc_h", **more))
        show({"your BC+H": str(run)}, self.out / "rollouts.png")
        shared.say(
            f"numbers: {numbers}\nagent:   {run}\nnext:    symphony test examples/suite.toml tests a planner"
        )
