"""Curves of a run: always a plain JSON-lines file, and Weights & Biases beside it."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any, Literal


class Tracker:
    """Writes the metrics of a run.

    Args:
        folder: of the run; ``metrics.jsonl`` is written there.
        settings: shown by Weights & Biases beside the curves.
        wandb: ``offline``, ``online`` or ``disabled``. The environment variable ``WANDB_MODE`` overrides it, as
            it does everywhere else.
        after: keep only records up to this step of an earlier, interrupted run.
    """

    def __init__(
        self,
        folder: Path,
        settings: dict[str, Any],
        wandb: Literal["offline", "online", "disabled"] = "offline",
        after: int = 0,
    ) -> None:
        self.path = folder / "metrics.jsonl"
        kept = [r for r in read_metrics(folder) if r["step"] <= after] if after else []
        self._file = self.path.open("w", encoding="utf-8")
        for record in kept:
            self._write(record)
        self._run = None
        mode: Any = os.environ.get("WANDB_MODE", wandb)
        if mode != "disabled":
            import wandb as tracking  # noqa: PLC0415 - seconds to import, and often not wanted

            self._run = tracking.init(
                project="symphony",
                name=folder.name,
                dir=str(folder),
                config=settings,
                mode=mode,
                settings=tracking.Settings(silent=True, console="off"),
            )

    def log(self, step: int, values: dict[str, float]) -> None:
        """Record numbers at an update."""
        self._write({"step": step, **values})
        if self._run is not None:
            self._run.log(values, step=step)

    def _write(self, record: dict[str, Any]) -> None:
        # JSON knows no NaN, which stands for statistics of nothing.
        known = {
            name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in record.items()
        }
        self._file.write(json.dumps(known) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Finish the files."""
        self._file.close()
        if self._run is not None:
            self._run.finish()


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """The records of a run so far; a last line cut short by a kill is left out."""
    path = folder / "metrics.jsonl"
    if not path.is_file():
        return []
    records = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return records
