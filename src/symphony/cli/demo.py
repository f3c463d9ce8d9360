"""The whole way on the data that comes with the package."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symphony.cli.evaluate import evaluate_with_bar
from symphony.cli.tables import print_metrics
from symphony.config import EvaluateConfig, TrainConfig
from symphony.config.profiles import demo
from symphony.files import Lock, write_json

if TYPE_CHECKING:
    from symphony.render import Clip


@dataclass(frozen=True)
class Demo:
    """Evaluate and draw an agent that comes with the package, on the built-in data: half a minute on a laptop.

    Then learn another from the built-in data, some minutes, and show it beside the first.
    """

    out: Path = Path("out/demo")
    """Folder for the trained agent, the pictures and the numbers; an earlier demo there is replaced."""
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
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.recipes import train

        console, began = Console(), time.perf_counter()
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
                found = evaluate_with_bar(agent, test, settings, observe=keeper)
                rows.append({**found.numbers(), "agent": title})
                clips.extend([] if title in BASELINES else keeper.clips)
            print_metrics(rows, title="Built-in test segments")
            write_json(numbers, {"rows": rows, "seconds": round(time.perf_counter() - began, 1)})
            draw_clips(clips, picture, columns=len(items))
            console.print(f"picture: {picture}", soft_wrap=True, markup=False)

        console.print("An included agent, on segments that it has not seen, with its tree search:")
        show({**BASELINES, INCLUDED: PRETRAINED}, self.out / "included.png")
        console.print(
            f"\nNow one of your own: behavioural cloning with goals (BC+H), {self.steps} updates on far fewer "
            "segments. This takes some minutes."
        )
        if (run / "config.json").is_file():
            shutil.rmtree(run)
        train(demo(TrainConfig(method="bc_h", data=learn, out=run, steps=self.steps, seed=self.seed)))
        show({"your BC+H": str(run)}, self.out / "rollouts.png")
        console.print(f"numbers: {numbers}\nagent:   {run}", soft_wrap=True, markup=False)


PANELS = 3
"""Run segments in the picture."""
PRETRAINED = "pretrained:bc_ts_h"
INCLUDED = "included BC+TS+H"
BASELINES = {"log playback": "playback", "constant velocity": "constant_velocity"}
"""Agents by their titles, which are not drawn."""
