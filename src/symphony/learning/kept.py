"""What is made once for a store and kept in its folder: demonstrations by segment."""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import symphony
from symphony.data.npz import read_npz
from symphony.envs.routes import RouteTable
from symphony.errors import DataError
from symphony.files import replacing
from symphony.learning.experts import Experts

VERSION = 3
"""Of the fit: raised when it gives something else for the same segment, or other routes (a test says when)."""
PACKAGE = Path(symphony.__file__).parent


class KeptFiles:
    """Files of arrays in a folder of a store's, named after all that they depend on.

    They are a cache: a file that is missing or damaged is made anew, and where the folder can't be written or belongs
    to the package, nothing is kept. Arrays only, nothing pickled.

    Args:
        store: the store's folder.
        name: of the folder in it.
        version: of what makes the arrays.
        settings: what the arrays depend on beside the content they belong to.
    """

    def __init__(self, store: Path, name: str, version: int, settings: str) -> None:
        self.version, self.settings = version, settings
        self.folder: Path | None = None if PACKAGE in store.resolve().parents else store / name
        try:
            if self.folder is not None:
                self.folder.mkdir(exist_ok=True)
        except OSError:
            self.folder = None

    def _path(self, content: str) -> Path | None:
        key = hashlib.sha256(f"{self.version} {content} {self.settings}".encode()).hexdigest()
        return None if self.folder is None else self.folder / f"{key[:32]}.npz"

    def _load(self, content: str) -> dict[str, NDArray[Any]] | None:
        path = self._path(content)
        if path is None or not path.is_file():
            return None
        try:
            return read_npz(path)
        except (DataError, OSError):
            return None

    def _save(self, content: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        path = self._path(content)
        if path is None or not os.access(path.parent, os.W_OK):
            return
        try:
            with replacing(path) as draft, zipfile.ZipFile(draft, "w") as file:
                for name, array in arrays.items():
                    part = io.BytesIO()
                    np.save(part, array)
                    # Of no date, so that equal arrays are equal files.
                    entry = zipfile.ZipInfo(f"{name}.npy")
                    file.writestr(entry, part.getvalue())
        except OSError:
            self.folder = None


class KeptExperts(KeptFiles):
    """Demonstrations kept with their store, so that a segment is fitted once and not once a run.

    Args:
        store: the store's folder.
        settings: what the fit depends on beside the segment's content.
    """

    def __init__(self, store: Path, settings: str) -> None:
        super().__init__(store, "experts", VERSION, settings)

    def load(self, content: str) -> Experts | None:
        """Those of the segment with this hash; None where there are none that can be read."""
        arrays = self._load(content)
        try:
            return None if arrays is None else _from_arrays(arrays)
        except (ValueError, KeyError, IndexError):
            return None

    def save(self, content: str, experts: Experts) -> None:
        """Keep those of a segment, if the folder can be written and the disk has room."""
        self._save(content, _to_arrays(experts))


def _to_arrays(experts: Experts) -> dict[str, Any]:
    routes = experts.routes
    arrays = {
        name: getattr(experts, name).numpy()
        for name in ("agent", "states", "actions", "valid", "error", "progress")
    }
    return arrays | {
        "route_number": np.array([len(table.count) for table in routes], np.int64),
        "route_points": np.concatenate([np.zeros((0, 2), np.float32), *(table.points for table in routes)]),
        "route_count": np.concatenate([np.zeros(0, np.int64), *(table.count for table in routes)]),
        "route_right": np.concatenate([np.zeros(0, np.bool_), *(table.right for table in routes)]),
        "route_logged": np.array([table.logged for table in routes], np.int64),
    }


def _from_arrays(arrays: dict[str, NDArray[Any]]) -> Experts:
    """The inverse; ValueError where the arrays don't fit together."""
    agents, steps = len(arrays["agent"]), arrays["states"].shape[1]
    ends = arrays["route_number"].cumsum()
    total = int(ends[-1]) if len(ends) else 0
    # Points of the routes of each agent end where those of its last route do.
    point_ends = np.append(0, arrays["route_count"].cumsum())[np.append(0, ends)]
    expected = {
        "states": (agents, steps, 4),
        "valid": (agents, steps - 1),
        "error": (agents,),
        "progress": (agents, steps if len(ends) else 0),
        "route_points": (int(arrays["route_count"].sum()), 2),
        "route_count": (total,),
        "route_right": (total,),
        "route_logged": (len(ends),),
    }
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} has shape {arrays[name].shape}, expected {shape}")
    if arrays["actions"].shape[:2] != (agents, steps - 1) or len(ends) not in (0, agents):
        raise ValueError("actions or routes of another number of agents")
    tables = tuple(
        RouteTable(
            arrays["route_points"][first:last],
            arrays["route_count"][end - count : end],
            arrays["route_right"][end - count : end],
            int(logged),
        )
        for end, count, logged, first, last in zip(
            ends, arrays["route_number"], arrays["route_logged"], point_ends[:-1], point_ends[1:], strict=True
        )
    )

    def tensor(name: str) -> Tensor:
        return torch.from_numpy(arrays[name])

    return Experts(
        agent=tensor("agent"),
        states=tensor("states"),
        actions=tensor("actions"),
        valid=tensor("valid"),
        error=tensor("error"),
        progress=tensor("progress"),
        routes=tables,
    )
