"""The whole way on the data that comes with the package."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symphony.cli.shared import print_metrics, progress, say
from symphony.config import AgentConfig, EvaluateConfig, PerturbConfig, TrainConfig
from symphony.files import Lock, write_json

if TYPE_CHECKING:
    from symphony.render import Clip

PANELS = 3
"""Run segments in the picture."""
PRETRAINED, INCLUDED = "pretrained:bc_ts_h", "included BC+TS+H"
BASELINES = {"log playback": "playback", "constant velocity": "constant_velocity"}
"""Agents by their titles, which are not drawn."""


@dataclass(frozen=True)
class Demo:
    """Evaluate and draw an agent that comes with the package, on the built-in data: half a minute on a laptop.

    Then learn another from the built-in data, some minutes, and show it beside the first.
    """

    out: Path = Path("out/demo")
    """Folder for the trained agent, the pictures and the numbers; an earlier demo there is replaced."""
    steps: int = 1500
    """Updates of the agent that is learned."""
    rollouts: int = 16
    """Rollouts per run segment in the evaluation."""
    seed: int = 0
    """Seed of the training and of the rollouts."""

    def run(self) -> None:
        """Run it."""
        self.out.mkdir(parents=True, exist_ok=True)
        with Lock(self.out / "demo.lock"):
            self._run()

    def _run(self) -> None:
        import shutil

        from symphony.data.builtin import builtin_store
        from symphony.data.store import SegmentStore
        from symphony.evaluation import evaluate
        from symphony.evaluation.pictures import ClipKeeper
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.recipes import train
        from symphony.render.video import draw_clips

        began = time.perf_counter()
        run, numbers = self.out / "bc_h", self.out / "metrics.json"
        learn, test = builtin_store("train"), builtin_store("test")
        settings = EvaluateConfig(rollouts=self.rollouts, seed=self.seed)
        items = evenly_spaced(len(SegmentStore(test)), PANELS)
        rows: list[dict[str, Any]] = []
        clips: list[Clip] = []

        def show(agents: dict[str, str], picture: Path) -> None:
            """Evaluate agents by their titles, and show them beside those before."""
            for title, agent in agents.items():
                keeper = ClipKeeper(items, title=f"{title}: ")
                with progress(f"evaluating {title}") as advance:
                    found = evaluate(agent, test, settings, advance, observe=keeper)
                rows.append({**found.numbers(), "agent": title})
                clips.extend([] if title in BASELINES else keeper.clips)
            print_metrics(rows, title="Built-in test segments")
            write_json(numbers, {"rows": rows, "seconds": round(time.perf_counter() - began, 1)})
            draw_clips(clips, picture, columns=len(items))
            say(f"picture: {picture}")

        say("An included agent, on segments that it has not seen, with its search:")
        show({**BASELINES, INCLUDED: PRETRAINED}, self.out / "included.png")
        say(
            f"\nNow one of your own: behavioural cloning with goals (BC+H), {self.steps} updates on far fewer "
            "segments. This takes some minutes."
        )
        if (run / "config.json").is_file():
            shutil.rmtree(run)
        train(
            TrainConfig(
                method="bc_h",
                data=learn,
                out=run,
                steps=self.steps,
                seed=self.seed,
                # Cheaper updates than by default suit the few segments of the package; so do inputs beyond the
                # paper's, and displaced states once the policy drives.
                states=512,
                agent=AgentConfig(num_points=128, num_lights=4, features="gaps", accelerations=21),
                perturb=PerturbConfig(share=0.5, begin=self.steps // 3),
                wandb="disabled",
            )
        )
        show({"your BC+H": str(run)}, self.out / "rollouts.png")
        say(f"numbers: {numbers}\nagent:   {run}")
        say("next:    symphony test examples/suite.toml holds a planner among such agents to thresholds")
