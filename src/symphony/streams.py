"""Random numbers as hashes of what they are for, so that a rollout is the same in any batch, process or device."""

from __future__ import annotations

import hashlib
from enum import IntEnum, unique

import torch
from jaxtyping import Float, Int
from torch import Tensor


@unique
class Stream(IntEnum):
    """Uses of random numbers with a stream of their own, derived from that of a scene or a rollout. Rollouts,
    branches and agents, which fold into the same streams, count from 0. A use keeps its number for good.
    """

    GOALS = 1 << 40  # routes of the agents of a scene
    PRUNING = (1 << 40) + 1  # which branches go on
    PLANNERS = (1 << 40) + 3  # seeds of the planners of egos
    ENTRIES = (1 << 40) + 6  # vehicles that enter past the log
    WALKS = (1 << 40) + 5  # walks of people that are not driven
    PACE = (1 << 40) + 7  # how fast an agent is in a whole rollout
    BACKTRACKING = 1 << 41  # tries of a line that goes back: this number plus how often it went back so far


# SplitMix64: Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.
_GAMMA = 0x9E3779B97F4A7C15


def _signed(value: int) -> int:
    """Return the int64 with the low 64 bits of `value`."""
    return (value + (1 << 63)) % (1 << 64) - (1 << 63)


def _mix(x: Int[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """Apply SplitMix64's finaliser, a bijection of int64 in which each input bit sways each output bit."""
    for bits, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        # int64 shifts copy the sign; the mask makes the shift logical.
        x = (x ^ ((x >> bits) & ((1 << (64 - bits)) - 1))) * _signed(factor)
    return x ^ ((x >> 31) & ((1 << 33) - 1))


def fold_in(stream: Int[Tensor, "*#b"], index: Int[Tensor, "*#b"] | int) -> Int[Tensor, "*b"]:
    """Derive int64 streams from streams: `stream` and `index` broadcast; distinct pairs give unrelated streams."""
    if isinstance(index, int):
        return _mix(stream + _signed((index + 1) * _GAMMA))
    return _mix(stream + (index.to(torch.int64) + 1) * _signed(_GAMMA))


def stream_of(text: str) -> int:
    """Return the int64 stream of a name such as a segment's id, the same in every process."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big", signed=True)


def uniform(seed: int, stream: Int[Tensor, "*#b"], step: Int[Tensor, "*#b"] | int) -> Float[Tensor, "*b"]:
    """Draw uniform float32 numbers in the open interval (0, 1), with the same bits on every device.

    Takes the seed of the whole run, int64 streams, one for each independent sequence (made by :func:`fold_in` from
    segment, branch, agent), and counters within a sequence, which are broadcast against the streams.
    """
    if stream.dtype != torch.int64:
        raise ValueError(f"streams are int64, got {stream.dtype}")
    start = torch.full((), _signed(seed), dtype=torch.int64, device=stream.device)
    top = (fold_in(fold_in(_mix(start), stream), step) >> 41) & ((1 << 23) - 1)
    # The middle of one of 2^23 equal cells: exact in this dtype, and never 0 or 1.
    return (2 * top + 1).to(torch.float32) * 2.0**-24
