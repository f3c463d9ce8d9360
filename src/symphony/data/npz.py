"""Arrays in ``.npz`` archives that anyone may have written."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from symphony.errors import DataError

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
MOST = 1 << 29  # bytes of the arrays of an archive, unless more are allowed


def read_npz(path: Path, names: Collection[str] = (), *, most: int = MOST) -> dict[str, NDArray[Any]]:
    """Return the arrays of an archive by their names; nothing is unpickled.

    Before memory is asked for, their headers must claim what the archive holds, and at most ``most`` bytes in all, or
    a :class:`DataError` names file and field. With ``names``, only these are read.
    """
    found: dict[str, NDArray[Any]] = {}
    left, name = most, None
    with path.open("rb") as raw:
        try:
            with zipfile.ZipFile(raw) as archive:
                for entry in archive.infolist():
                    name = entry.filename.removesuffix(".npy")
                    if names and name not in names:
                        continue
                    left -= entry.file_size
                    if left < 0:
                        raise DataError(f"more than {most} bytes of arrays", file=path, field=name)
                    with archive.open(entry) as part:
                        found[name] = _read(part, entry.file_size)
        except DataError:
            raise
        except Exception as error:  # each way of packing has its own
            message = f"expected an .npz archive of arrays; it is something else or damaged: {error}"
            raise DataError(message, file=path, field=name) from None
    return found


def _read(part: IO[bytes], size: int) -> NDArray[Any]:
    version = npy.read_magic(part)
    if version not in _HEADERS:
        raise ValueError(f"an array of version {version}")
    shape, transposed, dtype = _HEADERS[version](part)
    if dtype.hasobject:
        raise ValueError("an array of objects")
    claimed, held = math.prod(shape) * dtype.itemsize, size - part.tell()
    if claimed != held:
        raise ValueError(f"an array of {claimed} bytes by its header, of {held} in the archive")
    data, at = bytearray(held), 0
    while piece := part.read(1 << 20):  # to the end, where the checksum is compared
        data[at : at + len(piece)] = piece
        at += len(piece)
    return np.ndarray(shape, dtype, data, order="F" if transposed else "C")
