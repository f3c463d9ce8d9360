"""What is drawn more often: run segments that went badly, or of small sources; states of some vehicles."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from symphony.errors import ConfigError, DataError

if TYPE_CHECKING:
    from symphony.config import SamplingConfig
    from symphony.data.store import SegmentStore

STANDING = 0.5
"""m/s below which a vehicle counts as standing."""


def infractions(record: Path, store: SegmentStore, indices: Sequence[int]) -> Float[Tensor, " S"]:
    """How badly each run segment went in an evaluation: collision rate plus off-road time, in percent.

    Args:
        record: as `symphony evaluate RUN --data STORE --json FILE` writes it; segments it has not count 0.
        store: of the segments.
        indices: their rows.

    Raises:
        ConfigError: if it is of another store, or nothing went badly.
        DataError: if it can't be read, or is no such record.
    """
    try:
        found = json.loads(record.read_text(encoding="utf-8"))
        checksum = found["data"]["checksum"]
        rows = [(row["segment"], row["collision_rate"] + row["offroad_time"]) for row in found["per_segment"]]
        known = {str(segment): float(value) for segment, value in rows}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(
            f"no record of an evaluation ({type(error).__name__}: {error})", file=record
        ) from error
    if checksum != store.checksum():
        raise ConfigError(f"{record}: was evaluated on another store than {store.path}")
    weights = torch.tensor([known.get(store.ids[row], 0.0) for row in indices], dtype=torch.float64)
    if not bool(weights.isfinite().all()) or bool((weights < 0).any()):
        raise DataError("rates are negative or not finite", file=record, field="per_segment")
    if not bool(weights.any()):
        raise ConfigError(f"{record}: nothing went badly in these run segments")
    return weights


def segment_weights(
    config: SamplingConfig, store: SegmentStore, indices: Sequence[int]
) -> Float[Tensor, " S"] | None:
    """How often run segments are drawn, relative to others; None where all are drawn alike.

    Raises:
        ConfigError, DataError: as :func:`infractions`.
    """
    found = None if config.hard is None else infractions(config.hard, store, indices)
    if not config.even_sources:
        return found
    _, which, counts = np.unique(store.sources[list(indices)], return_inverse=True, return_counts=True)
    even = torch.from_numpy(1 / counts[which])
    return even if found is None else found * even


def some_of(weights: Float[Tensor, " S"], count: int, share: float, rng: torch.Generator) -> list[int]:
    """Different items: a share of them drawn in proportion to their weights, the others evenly from the rest."""
    heavy = min(round(count * share), int((weights > 0).sum()))
    first = torch.multinomial(weights, heavy, generator=rng).tolist() if heavy else []
    taken, order = set(first), torch.randperm(len(weights), generator=rng).tolist()
    return [*first, *(item for item in order if item not in taken)][:count]


def state_weights(
    interactive: Bool[Tensor, " M"], speed: Float[Tensor, " M"], config: SamplingConfig
) -> Float[Tensor, " M"]:
    """How often expert states are drawn, relative to those of a moving vehicle that is no interactive agent."""
    one = torch.ones(len(speed), dtype=torch.float64)
    return torch.where(interactive, config.interactive * one, one) * torch.where(
        speed.abs() < STANDING, config.standing * one, one
    )
