"""Rows of a batch, taken and put back."""

from __future__ import annotations

from jaxtyping import Int, Shaped
from tensordict import TensorDict, TensorDictBase
from torch import Tensor


def take(tensordict: TensorDictBase, rows: Int[Tensor, "*c"], dims: int | None = None) -> TensorDictBase:
    """Rows of the flattened batch, or of its first `dims` dimensions, in a batch of the shape of `rows`."""
    dims = tensordict.batch_dims if dims is None else dims
    taken = {
        key: take(value, rows, dims) if isinstance(value, TensorDictBase) else take_values(value, rows, dims)
        for key, value in tensordict.items()
    }
    return TensorDict(taken, [*rows.shape, *tensordict.batch_size[dims:]], device=tensordict.device)


def take_values(values: Shaped[Tensor, "*_"], rows: Int[Tensor, "*c"], dims: int) -> Shaped[Tensor, "*_"]:
    """Rows of the first `dims` dimensions, flattened, in the shape of `rows`."""
    # index_select on whole rows is many times faster than gather or advanced indexing on wide entries.
    taken = values.flatten(0, dims - 1).index_select(0, rows.flatten())
    return taken.reshape(*rows.shape, *values.shape[dims:])
