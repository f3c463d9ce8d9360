"""Distributions over the displacements that a vehicle can drive within a step: one Gaussian, or a histogram."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution, Normal, constraints

from symphony.geometry.frames import constant

Pairs = Float[Tensor, "*b 2"]
Reals = Float[Tensor, "*b"]

SMOOTH = 0.02  # metres within which a displacement bends smoothly towards zero instead of turning negative
INSIDE = 0.95
"""Share of the bounds beyond which an action counts as lying there, so that its likelihood stays finite."""
LEAST = 1e-3  # metres below which a histogram takes all displacements for standing still
EDGE = 1e-6  # how near to an end of its cell a draw may come, as a share of the cell


def inverse_cdf(logits: Float[Tensor, "*b C"], noise: Reals) -> Int[Tensor, "*b"]:
    """Draw categories `[...]` int64 from logits `[..., C]` by uniform numbers `[...]` in [0, 1].

    The category is the one whose interval of the cumulative distribution holds the number; a category of
    probability zero is never drawn. Where there is no category at all it is 0.
    """
    if logits.shape[-1] == 0:
        return torch.zeros_like(noise, dtype=torch.int64)
    cumulative = torch.softmax(logits.detach(), -1).cumsum(-1)
    total = cumulative[..., -1:].contiguous()
    # It never falls, so a place in it is the number of elements at most, or less than, a value.
    drawn = torch.searchsorted(cumulative, noise[..., None] * total, right=True)
    # Rounding may carry the product up to the total, past the last category that is possible at all. Where logits are
    # not numbers no place is right, but one must be named.
    last = torch.searchsorted(cumulative, total).clamp_max(logits.shape[-1] - 1)
    return torch.minimum(drawn, last).squeeze(-1)


def squash(x: Reals) -> Reals:
    """Return `x / sqrt(1 + x^2)`, in (-1, 1)."""
    return x / (1.0 + x.square()).sqrt()


def positive(x: Reals, smooth: float = SMOOTH) -> Reals:
    """Return a smooth `max(x, 0)`: `(x + sqrt(x^2 + smooth^2)) / 2`, above it by at most `smooth / 2`."""
    return 0.5 * (x + (x.square() + smooth**2).sqrt())


def displaced(share: Pairs, pace: Reals, slope: Reals, reach: float) -> Pairs:
    """Return displacements [..., 2] (metres; forward, left) for shares [..., 2] in (-1, 1) of what can be reached.

    forward = positive(pace + reach share1), so the speed changes by at most reach / dt and never becomes negative;
    left = forward * slope * share2, so nothing slides sideways or turns at standstill.
    """
    forward = positive(pace + reach * share[..., 0])
    return torch.stack([forward, forward * slope * share[..., 1]], -1)


def shares(displacement: Pairs, pace: Reals, slope: Reals, reach: float, least: float = 1e-4) -> Pairs:
    """Invert :func:`displaced`; shares beyond 1 can't be reached. Less than `least` metres forward count as that."""
    forward = displacement[..., 0].clamp_min(least)
    first = (forward - SMOOTH**2 / (4.0 * forward) - pace) / reach
    return torch.stack([first, displacement[..., 1] / (forward * slope)], -1)


def log_area(share: Pairs, pace: Reals, slope: Reals, reach: float) -> Reals:
    """Return the logarithm [...] of the square metres of displacements per area of shares."""
    x = pace + reach * share[..., 0]
    bend = 0.5 * (1.0 + x / (x.square() + SMOOTH**2).sqrt())
    return (reach * bend * positive(x) * slope).log()


class _Reachable(Distribution):
    """A distribution over displacements, as torch and TorchRL want one."""

    arg_constraints = {}  # noqa: RUF012 - the type torch declares
    support = constraints.real_vector
    has_rsample = True

    @property
    def deterministic_sample(self) -> Pairs:
        """The sample that TorchRL takes without exploration."""
        return self.mode


class BoundedDisplacement(_Reachable):
    """Displacements [..., 2] (metres; forward, left) reachable within a step, see :func:`displaced`.

    Their shares of what can be reached are Gaussian numbers u, squashed; differentiable in u, parameters and bounds.

    ``loc`` and ``scale`` are mean and standard deviation of u; the others are as :func:`displaced` has them.
    """

    def __init__(
        self, loc: Pairs, scale: Pairs, pace: Reals, slope: Reals, reach: float, validate_args: bool | None = None
    ) -> None:
        self.loc, self.scale, self.pace, self.slope, self.reach = loc, scale, pace, slope, reach
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=validate_args)

    def displacement(self, u: Pairs) -> Pairs:
        """Return the displacement that Gaussian numbers [..., 2] stand for."""
        return displaced(squash(u), self.pace, self.slope, self.reach)

    def latent(self, displacement: Pairs) -> Pairs:
        """Invert :meth:`displacement`; what lies outside the bounds or next to them is moved to INSIDE them."""
        share = shares(displacement, self.pace, self.slope, self.reach)
        share = share.clamp(-INSIDE, INSIDE)
        return share / (1.0 - share.square()).sqrt()

    def rsample(
        self,
        sample_shape: torch.Size | Sequence[int] = torch.Size(),  # noqa: B008
    ) -> Pairs:
        """Return a draw with gradient to the parameters."""
        shape = self._extended_shape(torch.Size(sample_shape))
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return self.displacement(self.loc + self.scale * noise)

    def icdf(self, value: Pairs) -> Pairs:
        """Return the draw of independent uniform numbers [..., 2] in (0, 1), with gradient to the parameters."""
        return self.displacement(self.loc + self.scale * torch.special.ndtri(value))

    @property
    def mode(self) -> Pairs:
        """The displacement of the mean of u (the median of either component)."""
        return self.displacement(self.loc)

    def log_prob(self, value: Pairs) -> Reals:
        """Return the log-density [...]; that of the nearest displacement INSIDE the bounds for others: no entropy."""
        u = self.latent(value)
        # Both squashings have the derivative (1 + u^2)^(-3/2).
        volume = log_area(squash(u), self.pace, self.slope, self.reach)
        volume = volume - 1.5 * (1.0 + u.square()).log().sum(-1)
        return Normal(self.loc, self.scale, validate_args=False).log_prob(u).sum(-1) - volume


@cache
def _edges(cells: int) -> tuple[float, ...]:
    """Return the shares at which one of ``cells`` ends and the next begins, from -1 to 1, dense in the middle."""
    unit = [2.0 * i / cells - 1.0 for i in range(cells + 1)]
    return tuple(x * (0.2 + 0.8 * abs(x)) for x in unit)


class DisplacementHistogram(_Reachable):
    """Displacements [..., 2] (metres; forward, left) reachable within a step, see :func:`displaced`: anywhere in one
    of F x L cells.

    Unlike one Gaussian it can brake or go on, turn left or right, and not do what lies between. A draw has the
    gradient of the mean over all cells (straight through). Logits [..., F * L] are of the cells, those of the hardest
    braking first; ``forward`` is F, between the hardest braking and the largest acceleration.
    """

    def __init__(
        self,
        logits: Float[Tensor, "*b C"],
        pace: Reals,
        slope: Reals,
        reach: float,
        forward: int,
        validate_args: bool | None = None,
    ) -> None:
        self.logits, self.pace, self.slope, self.reach = logits, pace, slope, reach
        self.cells = forward, logits.shape[-1] // forward
        super().__init__(logits.shape[:-1], torch.Size([2]), validate_args=validate_args)

    def expand(
        self, batch_shape: torch.Size | Sequence[int], _instance: Distribution | None = None
    ) -> DisplacementHistogram:
        """Return the same distribution expanded to a larger batch."""
        shape = torch.Size(batch_shape)
        return DisplacementHistogram(
            self.logits.expand(*shape, self.logits.shape[-1]),
            self.pace.expand(shape),
            self.slope.expand(shape),
            self.reach,
            self.cells[0],
            validate_args=False,
        )

    @property
    def edges(self) -> tuple[Float[Tensor, " F1"], Float[Tensor, " L1"]]:
        """Shares [F + 1] and [L + 1] between which the cells lie."""
        forward, left = (constant(_edges(cells), self.logits.dtype, self.logits.device) for cells in self.cells)
        return forward, left

    @property
    def mean_share(self) -> Pairs:
        """Return mean [..., 2] of the shares drawn, with gradient to the logits."""
        probability = self.logits.softmax(-1).unflatten(-1, self.cells)
        middle = [(edges[1:] + edges[:-1]) / 2 for edges in self.edges]
        return torch.stack([(probability.sum(-1 - k) * middle[k]).sum(-1) for k in range(2)], -1)

    def within(self, cell: Int[Tensor, "*b"], place: Pairs) -> Pairs:
        """Return shares [..., 2] at places [..., 2] in (0, 1) of cells by number."""
        # Cells of one acceleration lie side by side.
        number = torch.stack([cell // self.cells[1], cell % self.cells[1]], -1)
        low, high = (
            torch.stack([edges[number[..., k] + more] for k, edges in enumerate(self.edges)], -1) for more in (0, 1)
        )
        return low + (high - low) * place

    def icdf(self, value: Pairs) -> Pairs:
        """Return the draw that independent uniform numbers [..., 2] in (0, 1) stand for.

        The first decides the cell and, by where it lies in that cell's share of (0, 1), the place along it; the
        second the place across it.
        """
        dist = self.expand(torch.broadcast_shapes(value.shape[:-1], self.batch_shape))
        first, second = (part.expand(dist.batch_shape) for part in value.unbind(-1))
        weights = dist.logits.detach().softmax(-1)
        cell = inverse_cdf(dist.logits, first)
        above = weights.cumsum(-1).gather(-1, cell[..., None]).squeeze(-1)
        weight = weights.gather(-1, cell[..., None]).squeeze(-1)
        along = ((first - (above - weight)) / weight).clamp(EDGE, 1.0 - EDGE)
        share = dist.within(cell, torch.stack([along, second], -1))
        if torch.is_grad_enabled() and dist.logits.requires_grad:
            mean = dist.mean_share
            share = share + (mean - mean.detach())
        return displaced(share, dist.pace, dist.slope, dist.reach)

    def rsample(
        self,
        sample_shape: torch.Size | Sequence[int] = torch.Size(),  # noqa: B008
    ) -> Pairs:
        """Return a draw with gradient to the logits and the bounds."""
        shape = self._extended_shape(torch.Size(sample_shape))
        return self.icdf(torch.rand(shape, dtype=self.logits.dtype, device=self.logits.device))

    @property
    def mode(self) -> Pairs:
        """The middle of the likeliest cell."""
        share = self.within(self.logits.argmax(-1), self.logits.new_full((*self.batch_shape, 2), 0.5))
        return displaced(share, self.pace, self.slope, self.reach)

    def log_prob(self, value: Pairs) -> Reals:
        """Return the log-density [...], that of the nearest displacement in reach where `value` is not in reach."""
        share = shares(value, self.pace, self.slope, self.reach, LEAST).clamp(-1.0, 1.0)
        area = log_area(share, self.pace, self.slope, self.reach)
        cell = torch.zeros_like(share[..., 0], dtype=torch.int64)
        for k, edges in enumerate(self.edges):
            number = torch.bucketize(share[..., k].contiguous(), edges[1:-1].contiguous(), right=True)
            # Those of one acceleration lie side by side.
            cell, area = cell * self.cells[k] + number, area + edges.diff()[number].log()
        logits = self.logits.log_softmax(-1).expand(*cell.shape, self.logits.shape[-1])
        return logits.gather(-1, cell[..., None]).squeeze(-1) - area
