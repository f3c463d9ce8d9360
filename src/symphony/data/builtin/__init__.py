"""The run segments that come with the package (made with SUMO by ``benchmarks/make_builtin.py``)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal


def builtin_store(split: Literal["train", "test"]) -> Path:
    """Return the folder of a built-in store; the two splits share no road network."""
    return Path(__file__).parent / split
