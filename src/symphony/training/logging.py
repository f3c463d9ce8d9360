"""The curves of a run: always a plain JSON-lines file, and Weights & Biases beside it."""

from __future__ import annotations

import json
import math
import os
import re
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from symphony.errors import ConfigError
from symphony.files import naming, write_file

RECORDS = "metrics.jsonl"
ID = "wandb-id"
"""The file beside the metrics with the run's name at Weights & Biases."""


class Tracker:
    """Writes the metrics of a run; DataError if the disk refuses, ConfigError if Weights & Biases does.

    Args:
        folder: the run's folder; ``metrics.jsonl`` is written there.
        settings: shown by Weights & Biases beside the curves.
        wandb: ``offline``, ``online`` or ``disabled``; the environment variable ``WANDB_MODE`` overrides it.
        after: keep only records up to this step of an earlier, interrupted run, which this one continues.

    Attributes:
        kept: records of that earlier run.
    """

    def __init__(
        self,
        folder: Path,
        settings: dict[str, Any],
        wandb: Literal["offline", "online", "disabled"] = "offline",
        *,
        after: int = 0,
    ) -> None:
        self.path = folder / RECORDS
        self.kept = [r for r in read_metrics(folder) if r["step"] <= after] if after else []
        # Put in place as a whole, so that a kill meanwhile cannot lose what is kept.
        write_file(self.path, "".join(json.dumps(record) + "\n" for record in self.kept))
        self._run = None
        mode = os.environ.get("WANDB_MODE") or wandb
        if mode != "disabled":
            import wandb as tracking  # noqa: PLC0415 - seconds to import, and often not wanted

            how: Any = {"project": os.environ.get("WANDB_PROJECT", "symphony"), "name": folder.name, "mode": mode}
            how |= {"config": settings, "id": _run_id(folder, again=after > 0), "dir": str(folder)}
            how |= {"resume": "allow" if after else None}
            try:
                self._run = tracking.init(**how, settings=tracking.Settings(silent=True, console="off"))
            except (tracking.errors.Error, ValueError) as error:  # the latter of a variable such as WANDB_MODE
                told, hint = " ".join(str(error).split()), "Or keep the curves here: WANDB_MODE=offline"
                raise ConfigError(f"Weights & Biases: {told} {hint}") from error
        with naming(self.path):
            self._file = self.path.open("a", encoding="utf-8")

    def log(self, step: int, values: Mapping[str, float | str]) -> None:
        """Record numbers, and words, at an update. Raises DataError if the disk refuses."""
        # JSON knows no NaN, which stands for statistics of nothing, and no infinity.
        odd = {name: None for name, x in values.items() if isinstance(x, float) and not math.isfinite(x)}
        with naming(self.path):
            self._file.write(json.dumps({"step": step, **values, **odd}) + "\n")
            self._file.flush()
        if self._run is not None:
            self._run.log(dict(values), step=step)

    def preview(self, step: int, video: Path) -> None:
        """Give Weights & Biases, where it is used, an animation (gif)."""
        if self._run is None:
            return
        import wandb as tracking  # noqa: PLC0415 - is there by now

        self._run.log({"preview/rollout": tracking.Video(str(video), format="gif")}, step=step)

    def sync(self) -> None:
        """Put all records on the disk: a checkpoint must not survive a power cut that they don't."""
        with naming(self.path):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Finish the files."""
        try:
            with naming(self.path):
                self._file.close()
        finally:
            if self._run is not None:
                self._run.finish()


def _run_id(folder: Path, *, again: bool) -> str:
    """Return the id of a run at Weights & Biases: the same when it goes on, so that its parts become one there."""
    path = folder / ID
    known = path.read_text(encoding="utf-8", errors="replace").strip() if again and path.is_file() else ""
    if not re.fullmatch(r"[0-9a-z]{4,32}", known):
        known = uuid.uuid4().hex[:8]
        write_file(path, known + "\n")
    return known


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Return the records of a run so far; an invalid line, such as a last one cut short by a kill, is left out."""
    path = folder / RECORDS
    if not path.is_file():
        return []
    records = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with suppress(ValueError, RecursionError):
            record = json.loads(line)
            if isinstance(record, dict) and type(record.get("step")) is int:
                records.append(record)
    return records
