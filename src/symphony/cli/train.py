"""Learn an agent from a store of run segments."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import symphony
from symphony.cli import shared
from symphony.config import TrainConfig
from symphony.config.profiles import WORDS, Profile


class Train(shared.Command):
    """Learn agents from a store of run segments."""

    config: Annotated[TrainConfig, arg(name="")]
    profile: Annotated[Profile, arg(help=WORDS)] = "default"

    def __call__(self) -> None:
        folder = symphony.train(self.config)
        # Of the processes that torchrun starts, one speaks.
        if os.environ.get("RANK", "0") == "0":
            shared.say("\n".join(last_words(folder, self.config)))


def last_words(folder: Path, config: TrainConfig) -> list[str]:
    """Which checkpoint of a run is its agent and how good it is, and what to do next."""
    from symphony.agents.agent import best_of, choose

    best, score = (
        best_of(choose(folder, "last")),
        "the last one; nothing was validated, see --validation.data",
    )
    if best is not None:
        data = f"segments of {config.validation.data} (at most {config.validation.segments})"
        score = f"the best one, with collision rate plus off-road time of {best.infractions:.2f} % on {data}"
    return [
        f"trained agent  {folder}",
        f"checkpoint     {choose(folder).name}: {score}",
        f"curves         symphony plot curves {folder} --out curves.png",
        f"evaluate it    symphony evaluate {folder} --data DIR",
    ]
