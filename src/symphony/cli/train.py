"""Learn an agent from a store of run segments."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from symphony.cli.shared import say
from symphony.config import Profile, TrainConfig
from symphony.config.profiles import WORDS


@dataclass(frozen=True)
class Train:
    """Learn agents from a store of run segments."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    profile: Annotated[Profile, tyro.conf.arg(help=WORDS)] = "default"

    def run(self) -> None:
        """Train them."""
        from symphony.recipes import train

        folder = train(self.config)
        # Of the processes that torchrun starts, one speaks.
        if os.environ.get("RANK", "0") == "0":
            say("\n".join(last_words(folder, self.config)))


def last_words(folder: Path, config: TrainConfig) -> list[str]:
    """Which checkpoint of a run is its agent and how good it is, where its pictures are, and what to do next."""
    from symphony.agents.choice import best_of, choose

    best = best_of(choose(folder, "last"))
    if best is None:
        score = "the last one; nothing was validated, see --validation.data"
    else:
        score = (
            f"the best one, with collision rate plus off-road time of {best.infractions:.2f} % on segments of "
            f"{config.validation.data} (at most {config.validation.segments})"
        )
    pictures = sorted((folder / "media").glob("rollout-*.gif"))
    shown = f"{pictures[-1]}, the newest of {len(pictures)}" if pictures else "none, see --preview.every"
    return [
        f"trained agent  {folder}",
        f"checkpoint     {choose(folder).name}: {score}",
        f"pictures       {shown}",
        f"curves         symphony plot curves {folder} --out curves.png",
        f"evaluate it    symphony evaluate {folder} --data DIR",
    ]
