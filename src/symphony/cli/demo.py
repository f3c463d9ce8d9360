"""The whole way on the data that comes with the package."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from symphony.cli.evaluate import evaluate_with_bar
from symphony.cli.tables import print_metrics
from symphony.config import EvaluateConfig, TrainConfig
from symphony.config.profiles import demo
from symphony.files import Lock, write_json


@dataclass(frozen=True)
class Demo:
    """Learn from the built-in data, evaluate, and draw what came out: some minutes on a laptop.

    An agent that comes with the package is evaluated beside it.
    """

    out: Path = Path("out/demo")
    """Folder for the trained agent, the picture and the numbers; an earlier demo there is replaced."""
    steps: int = 1500
    """Updates."""
    rollouts: int = 16
    """Simulations per run segment."""
    seed: int = 0
    """Of everything drawn at random."""

    def run(self) -> None:
        """Run it."""
        self.out.mkdir(parents=True, exist_ok=True)
        with Lock(self.out / "demo.lock"):
            self._run()

    def _run(self) -> None:
        import shutil

        from rich.console import Console

        from symphony.data.builtin import builtin_store
        from symphony.data.store import SegmentStore
        from symphony.evaluation.pictures import ClipKeeper, draw_clips
        from symphony.recipes import train
        from symphony.simulation.demonstrations import evenly_spaced

        console = Console()
        began = time.perf_counter()
        run, picture, numbers = self.out / "bc_h", self.out / "rollouts.png", self.out / "metrics.json"
        if (run / "config.json").is_file():
            shutil.rmtree(run)
        learn, test = builtin_store("train"), builtin_store("test")
        console.print(
            f"Learning to drive from {learn} (behavioural cloning with goals, {self.steps} updates)"
        )
        config = TrainConfig(method="bc_h", data=learn, out=run, steps=self.steps, seed=self.seed)
        train(demo(config))
        console.print(f"Simulating {test}, which it has not seen")
        settings = EvaluateConfig(rollouts=self.rollouts, seed=self.seed)
        agents = ["playback", "constant_velocity", str(run), PRETRAINED]
        items = evenly_spaced(len(SegmentStore(test)), PANELS)
        drawn = {
            name: ClipKeeper(items, title=f"{title}: ") for name, title in zip(agents, NAMES, strict=True)
        }
        results = [evaluate_with_bar(name, test, settings, observe=drawn[name]) for name in agents]
        rows = [{**result.numbers(), "agent": name} for result, name in zip(results, NAMES, strict=True)]
        print_metrics(rows, title="Built-in test segments")
        console.print(
            f"{NAMES[-1]} is {PRETRAINED}, which learned from far more data of another set and is simulated with its "
            "tree search.",
            style="dim",
        )
        seconds = time.perf_counter() - began
        write_json(numbers, {"rows": rows, "steps": self.steps, "seconds": round(seconds, 1)})
        draw_clips([clip for name in agents[2:] for clip in drawn[name].clips], picture, columns=len(items))
        console.print(f"Done in {seconds:.0f} s.")
        for what, where in (("picture of rollouts", picture), ("numbers", numbers), ("trained agent", run)):
            console.print(f"{what + ':':21}{where}", soft_wrap=True, markup=False)


PANELS = 3
"""Run segments in the picture."""
PRETRAINED = "pretrained:bc_ts_h"
NAMES = ("log playback", "constant velocity", "BC+H", "included BC+TS+H")
