"""Counter-based random numbers and draws by inverse CDF."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from symphony.modules import inverse_cdf
from symphony.streams import Stream, fold_in, stream_of, uniform

MASK = 2**64 - 1
int64 = st.integers(-(2**63), 2**63 - 1)
STREAM = -8660814866712981800
"""Of the name ``a segment``, in every process."""


def splitmix(state: int) -> int:
    """The finaliser of SplitMix64 on Python's unbounded integers."""
    state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & MASK
    return state ^ (state >> 31)


def folded(stream: int, index: int) -> int:
    return splitmix((stream + (index + 1) * 0x9E3779B97F4A7C15) & MASK)


def test_the_hash_is_splitmix64():
    # First output of the reference generator for state 0.
    assert folded(0, 0) == 0xE220A8397B1DCDAF
    assert int(fold_in(torch.tensor(0), 0)) & MASK == 0xE220A8397B1DCDAF


@given(seed=int64, stream=int64, step=st.integers(0, 2**40))
def test_tensor_arithmetic_equals_unbounded_integers(seed, stream, step):
    bits = folded(folded(splitmix(seed & MASK), stream), step)
    tensor = torch.tensor([stream])
    assert uniform(seed, tensor, step).item() == (2 * (bits >> 41) + 1) * 2.0**-24


def test_numbers_lie_strictly_between_zero_and_one():
    values = uniform(3, torch.arange(2_000_000), 0)
    assert values.dtype == torch.float32
    assert 0 < values.min() < 1e-5
    assert 1 - 1e-5 < values.max() < 1


def test_a_number_is_the_same_in_any_batch():
    streams, steps = torch.randint(-(2**62), 2**62, (5, 7)), torch.arange(11)
    whole = uniform(1, streams[..., None], steps)
    assert whole.shape == (5, 7, 11)
    for i, j, k in ((0, 0, 0), (4, 6, 10), (2, 3, 5)):
        assert uniform(1, streams[i, j], k) == whole[i, j, k]
    assert torch.equal(uniform(1, streams.T, 4), whole[..., 4].T)
    assert not torch.equal(uniform(2, streams, 4), whole[..., 4])


def chi_square(counts: torch.Tensor) -> float:
    """Standardised: about N(0, 1) for uniform counts."""
    expected = counts.sum().item() / counts.numel()
    freedom = counts.numel() - 1
    statistic = ((counts.double() - expected) ** 2).sum().item() / expected
    return (statistic - freedom) / math.sqrt(2 * freedom)


def test_streams_keep_the_numbers_that_rollouts_were_made_with():
    first = 1 << 40
    assert {stream.name: stream - first for stream in Stream} == {
        "GOALS": 0,
        "PRUNING": 1,
        "PLANNERS": 3,
        "PERSONAS": 4,
        "WALKS": 5,
        "BACKTRACKING": first,
    }


@pytest.mark.parametrize("axis", ["stream", "step", "seed", "folded"])
def test_neighbouring_counters_give_uniform_uncorrelated_numbers(axis):
    n = 200_000
    index = torch.arange(n)
    if axis == "stream":
        x = uniform(0, index, 0)
    elif axis == "step":
        x = uniform(0, torch.tensor(0), index)
    elif axis == "folded":
        x = uniform(0, fold_in(torch.tensor(5), index), 0)
    else:
        x = torch.cat([uniform(seed, torch.arange(100), 0) for seed in range(n // 100)])
    assert abs(chi_square(torch.histc(x, 256, 0, 1))) < 5
    ordered = x.double().sort().values
    distance = (ordered - (torch.arange(n) + 0.5) / n).abs().max().item()
    assert distance * math.sqrt(n) < 2.0  # Kolmogorov-Smirnov: exceeded with probability 0.0007
    for lag in (1, 2, 21, 64):
        pairs = (x[:-lag] * 16).long() * 16 + (x[lag:] * 16).long()
        assert abs(chi_square(torch.bincount(pairs, minlength=256))) < 5
    lowest = (x * 2**23).long() & 1
    assert abs(lowest.double().mean() - 0.5) * 2 * math.sqrt(n) < 5


def test_streams_are_independent_of_each_other():
    x = uniform(0, torch.arange(300)[:, None], torch.arange(2000)).double()
    correlation = torch.corrcoef(x).fill_diagonal_(0)
    assert correlation.abs().max() * math.sqrt(2000) < 6
    steps = torch.corrcoef(x[:, :300].T).fill_diagonal_(0)
    assert steps.abs().max() * math.sqrt(300) < 6


def test_derived_streams_do_not_collide():
    streams = fold_in(
        fold_in(torch.tensor(stream_of("scene")), torch.arange(1000)[:, None]), torch.arange(1000)
    )
    assert streams.flatten().unique().numel() == 1_000_000


def test_a_name_has_the_same_stream_in_every_process():
    """A number from another one; Python's own hash of a text is another in each."""
    assert stream_of("a segment") == STREAM != stream_of("a segment ")
    assert -(2**63) <= STREAM < 2**63


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="int64"):
        uniform(0, torch.zeros(2), 0)


def test_draws_follow_the_distribution():
    torch.manual_seed(0)
    logits = torch.randn(147) * 2
    n = 100_000
    drawn = inverse_cdf(logits.expand(n, -1), uniform(0, torch.arange(n), 0))
    expected = logits.double().softmax(-1) * n
    common = expected > 10
    counts = torch.bincount(drawn, minlength=147).double()
    statistic = ((counts - expected) ** 2 / expected)[common].sum()
    freedom = int(common.sum()) - 1
    assert abs(statistic - freedom) / math.sqrt(2 * freedom) < 5


def test_a_draw_inverts_the_cumulative_distribution():
    logits = torch.randn(50, 9, dtype=torch.float64)
    upper = logits.softmax(-1).cumsum(-1)
    lower = upper - logits.softmax(-1)
    for share in (0.01, 0.5, 0.99):
        noise = lower + share * (upper - lower)
        drawn = inverse_cdf(logits[:, None].expand(50, 9, 9), noise)
        assert torch.equal(drawn, torch.arange(9).expand(50, 9))


@pytest.mark.parametrize("noise", [0.0, 2.0**-24, 0.5, 1 - 2.0**-24, 1.0])
def test_impossible_categories_are_never_drawn(noise):
    torch.manual_seed(0)
    logits = torch.randn(2000, 12)
    allowed = torch.rand(2000, 12) < 0.4
    allowed[:, 5] = True
    drawn = inverse_cdf(logits.masked_fill(~allowed, -torch.inf), torch.full((2000,), noise))
    assert allowed.gather(1, drawn[:, None]).all()


def test_a_draw_from_what_is_no_number_still_names_a_category():
    logits = torch.full((3, 5), torch.nan)
    drawn = inverse_cdf(logits, torch.tensor([0.0, 0.5, 1.0]))
    assert ((drawn >= 0) & (drawn < 5)).all()


def test_of_no_categories_none_is_drawn():
    assert torch.equal(
        inverse_cdf(torch.zeros(3, 0), torch.full((3,), 0.5)), torch.zeros(3, dtype=torch.int64)
    )


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_gives_the_same_bits():
    streams = torch.randint(-(2**62), 2**62, (1000,))
    assert torch.equal(uniform(7, streams.cuda(), 3).cpu(), uniform(7, streams, 3))
