"""Learn an agent from a store of run segments."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated

import tyro

from symphony.cli.profiles import WORDS
from symphony.config import Profile, TrainConfig


@dataclass(frozen=True)
class Train:
    """Learn agents from a store of run segments."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    profile: Annotated[Profile, tyro.conf.arg(help=WORDS)] = "default"

    def run(self) -> None:
        """Train them."""
        from rich.console import Console

        from symphony.recipes import train

        folder = train(self.config)
        # Of the processes that torchrun starts, one speaks.
        if os.environ.get("RANK", "0") == "0":
            Console().print(
                f"Trained agent in {folder}; evaluate it: symphony evaluate {folder} --data DIR",
                soft_wrap=True,
            )
