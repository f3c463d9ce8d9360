"""Learn an agent from a store of run segments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from symphony.config import BCConfig

app = tyro.extras.SubcommandApp()


@app.command(name="bc")
@dataclass(frozen=True)
class BC:
    """Train an agent by behavioural cloning."""

    config: Annotated[BCConfig, tyro.conf.arg(name="")]

    def run(self) -> None:
        """Train it."""
        from rich.console import Console

        from symphony.trainers import train

        folder = train(self.config)
        Console().print(
            f"Trained agent in {folder}; judge it: symphony evaluate {folder} --data DIR", soft_wrap=True
        )
