"""Likelihood of what was logged under what was simulated."""

from __future__ import annotations

import math
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.wosac.scorer.config import Bernoulli, Histogram


def bin_edges(estimator: Histogram, device: torch.device | str = "cpu") -> Float[Tensor, " K"]:
    """The bins' edges in float32, as the official scorer rounds them."""
    return _edges(estimator.low, estimator.high, estimator.bins).to(device)


@cache
def _edges(low: float, high: float, bins: int) -> Tensor:
    ends = torch.tensor([low, high], dtype=torch.float32)
    edges = ends[0] + torch.arange(bins + 1, dtype=torch.float32) * ((ends[1] - ends[0]) / bins)
    edges[-1] = ends[1]
    return edges


def bin_of(values: Float[Tensor, "*shape"], estimator: Histogram) -> Int[Tensor, "*shape"]:
    """Index of each value's bin: outside counts as the nearest bin, not a number as the last one."""
    edges = bin_edges(estimator, values.device)
    inner = edges[1:-1].contiguous()
    index = torch.bucketize(values.contiguous(), inner, right=True)
    return torch.where(values.isnan(), estimator.bins - 1, index)


def histogram_log_likelihood(
    log: Float[Tensor, "E T"], simulated: Float[Tensor, "R E T"], estimator: Histogram
) -> Float[Tensor, "E T"]:
    """ln of the share of simulated values, smoothed, in the bin of the logged value.

    Every simulated value counts, also at steps at which the log is not valid.
    """
    objects, steps = log.shape
    # Group of each object and step: those with one group share a histogram.
    who = torch.arange(objects, device=log.device)[:, None]
    when = torch.arange(steps, device=log.device)
    who = who * (not estimator.aggregate_objects)
    when = when * (not estimator.independent_timesteps)
    group = (who * steps + when).expand(objects, steps)
    counts = torch.zeros(objects * steps, estimator.bins, dtype=torch.float32, device=log.device)
    flat = (group * estimator.bins + bin_of(simulated, estimator)).flatten()
    counts.view(-1).scatter_add_(0, flat, torch.ones_like(flat, dtype=torch.float32))
    counts = counts[group] + estimator.pseudocount
    share = counts.gather(-1, bin_of(log, estimator)[..., None])[..., 0] / counts.sum(-1)
    return share.log()


def bernoulli_log_likelihood(
    log: Bool[Tensor, " E"], simulated: Bool[Tensor, "R E"], estimator: Bernoulli
) -> Float[Tensor, " E"]:
    """ln of the share of rollouts, smoothed, that agree with the log."""
    agree = (simulated == log).float()
    if estimator.aggregate_objects:
        yes = simulated.float().sum()
        count = torch.where(log, yes, simulated.numel() - yes)
        total = simulated.numel()
    else:
        count, total = agree.sum(0), len(simulated)
    return ((count + estimator.pseudocount) / (total + 2 * estimator.pseudocount)).log()


def kernel_log_likelihood(
    log: Float[Tensor, "E T"],
    simulated: Float[Tensor, "R E T"],
    bandwidth: float,
    *,
    independent_timesteps: bool = True,
) -> Float[Tensor, "E T"]:
    """ln of a Gaussian kernel density, relative to the height of one kernel; in no challenge's configuration."""
    samples = simulated.permute(1, 2, 0)
    if independent_timesteps:
        samples = samples.flatten(1)[:, None]
    scaled = (log[..., None] - samples) / bandwidth
    return torch.logsumexp(-0.5 * scaled.square(), dim=-1) - math.log(samples.shape[-1])
