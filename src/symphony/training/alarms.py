"""Signs that training goes wrong: gradients that are not finite, a discriminator that has won or learns nothing."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from symphony.agents.checkpoint import CheckpointError
from symphony.errors import SymphonyError

NORM = "gradient_norm_"
PATIENCE = 20
"""Updates in a row that may be skipped."""
WINDOW = 10
"""Records that an alarm looks back on."""
ALARMS = {
    "discriminator_too_strong": (
        "the discriminator tells simulated from logged states almost without fail (AUC above 0.98 in the last 10 "
        "records): its scores rank little; consider a lower rate, a gradient penalty or noise for it"
    ),
    "discriminator_blind": (
        "the discriminator can't tell simulated from logged states (AUC below 0.52 in the last 10 records): its "
        "scores are chance; consider a higher rate, or more features or states for it"
    ),
}
"""What `alarm` in the metrics may be, and what it means."""


class TrainingError(SymphonyError):
    """Training that can't go on."""


def loss_of(network: str) -> str:
    """The name of the loss that a network descends."""
    return f"loss_{network}"


def _value(found: Any, name: str) -> Any:
    return found.get(name) if isinstance(found, dict) else None


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


@dataclass
class Skips:
    """Steps of optimizers that were left out because the gradient was not finite.

    Attributes:
        total: of all networks, since the run began.
        in_row: of each network, up to now.
    """

    total: int = 0
    in_row: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, extra: Mapping[str, Any]) -> Skips:
        """What the extra values of a checkpoint tell.

        Raises:
            CheckpointError: they tell something else.
        """
        found = extra.get("skips") or {"total": 0, "in_row": {}}
        total, in_row = _value(found, "total"), _value(found, "in_row")
        if not isinstance(in_row, dict) or not all(map(_is_count, (total, *in_row.values()))):
            raise CheckpointError("no counts of updates", field="extra.skips")
        return cls(total, in_row)

    def count(self, values: Mapping[str, Tensor]) -> list[str]:
        """Count those of one update, from its norms of the gradient; returns the networks concerned.

        Raises:
            TrainingError: if a network had to skip too many in a row.
        """
        norms = {name.removeprefix(NORM): value for name, value in values.items() if name.startswith(NORM)}
        if not norms:
            return []
        # One transfer from the device for all.
        finite = torch.stack([norm.detach() for norm in norms.values()]).isfinite().tolist()
        bad = [name for name, good in zip(norms, finite, strict=True) if not good]
        for name in norms:
            self.in_row[name] = self.in_row.get(name, 0) + 1 if name in bad else 0
        self.total += len(bad)
        for name in bad:
            if self.in_row[name] >= PATIENCE:
                loss = loss_of(name)
                told = f" ({loss} is {values[loss].item():g})" if loss in values else ""
                raise TrainingError(
                    f"the gradient of the {name} network{told} was not finite in {PATIENCE} updates in a row; "
                    "the last checkpoint is intact: lower the learning rate, or check the data"
                )
        return bad


class Alarms:
    """Watches the records of a run.

    Args:
        records: earlier ones of a run that goes on.
    """

    def __init__(self, records: Iterable[Mapping[str, Any]] = ()) -> None:
        self._recent: deque[float] = deque(maxlen=WINDOW)
        for record in records:
            self.check(record)

    def check(self, record: Mapping[str, Any]) -> str | None:
        """The alarm (see :data:`ALARMS`) that is on after this record, if any."""
        value = record.get("discriminator_auc")
        if value is None or math.isnan(value):
            return None
        self._recent.append(value)
        if len(self._recent) < WINDOW:
            return None
        if min(self._recent) > 0.98:
            return "discriminator_too_strong"
        return "discriminator_blind" if max(self._recent) < 0.52 else None
