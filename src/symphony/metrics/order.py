"""The passing order of agents whose paths merge or cross (see :func:`symphony.data.selection.relations`).

Metres and seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REACH = 1.5  # metres within which two paths are at the same place, about half a lane
_FINER = 4  # parts of a step at which paths are compared: in a whole one a vehicle may jump over the place


def passing_gap(
    first: Float[Tensor, "*batch T 2"],
    second: Float[Tensor, "*batch T 2"],
    first_valid: Bool[Tensor, "*batch T"],
    second_valid: Bool[Tensor, "*batch T"],
    dt: float,
    reach: float = REACH,
) -> Float[Tensor, "*batch"]:
    """Return the seconds by which the first of two agents is ahead of the second where their paths first meet.

    Negative where the second passes first; NaN where the paths don't come within ``reach`` of each other. Of all
    pairs of times at which the two are that close, the earliest counts, by the sum of the two.
    """
    (a, a_valid), (b, b_valid) = _finer(first, first_valid), _finer(second, second_valid)
    near = (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1) <= reach**2
    near &= a_valid[..., :, None] & b_valid[..., None, :]
    step = torch.arange(near.shape[-1], device=near.device)
    ahead = step - step[:, None]
    # One number for both: the sum of the times first, then how far they are apart.
    key = (step[:, None] + step) * len(step) + ahead.abs()
    never = torch.iinfo(key.dtype).max
    key = torch.where(near, key, never)
    least = key.amin((-2, -1))
    # Either may have been there first by as much: then neither was.
    tied = near & (key == least[..., None, None])
    gap = (tied * ahead).sum((-2, -1)) / tied.sum((-2, -1)) * (dt / _FINER)
    return torch.where(least < never, gap.to(first.dtype), torch.nan)


def _finer(
    path: Float[Tensor, "*b T F"], valid: Bool[Tensor, "*b T"]
) -> tuple[Float[Tensor, "*b fine F"], Bool[Tensor, "*b fine"]]:
    """Return the path at parts of a step, straight in between, and where both neighbours are valid."""
    steps = path.shape[-2]
    where = torch.arange((steps - 1) * _FINER + 1, device=path.device)
    before = torch.div(where, _FINER, rounding_mode="floor")
    after = torch.div(where + _FINER - 1, _FINER, rounding_mode="floor")
    share = (where % _FINER / _FINER).to(path.dtype)[:, None]
    both = valid[..., before] & valid[..., after]
    # Padding may hold anything.
    clean = torch.where(valid[..., None], path, 0.0)
    return clean[..., before, :] + share * (clean[..., after, :] - clean[..., before, :]), both


@dataclass(frozen=True)
class OrderStatistics:
    """The order in which K pairs of agents pass in rollouts, NaN where there is nothing to count."""

    pairs: int  # that meet in the log, one after the other
    kept: float  # share of their rollouts in which the same one goes first
    reversed: float  # share in which the other one does
    apart: float  # share in which the paths don't meet, or both are there at once
    #: mean absolute difference of the seconds between the two from the log's, where they meet
    gap_error: float


def order_statistics(simulated: Float[Tensor, "R K"], log: Float[Tensor, " K"]) -> OrderStatistics:
    """Compare who goes first, by :func:`passing_gap` of each rollout and pair, and of each pair in the log."""
    known = ~log.isnan() & (log != 0)
    simulated, log = simulated[:, known], log[known]
    same = (simulated.sign() == log.sign()).float().mean().item()
    other = (simulated.sign() == -log.sign()).float().mean().item()
    return OrderStatistics(
        pairs=int(known.sum()),
        kept=same,
        reversed=other,
        apart=1 - same - other,
        gap_error=(simulated - log).abs().nanmean().item(),
    )
