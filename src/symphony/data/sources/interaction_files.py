"""Which files a recording of the INTERACTION format is made of."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symphony.data.sources.commonroad_xml import number
from symphony.data.sources.lines import Doubles
from symphony.errors import DataError

_NUMBERED = re.compile(r"vehicle_tracks_(\w+)\.csv")
_SPLIT = re.compile(r"(\w.*)_(train|val)\.csv")


@dataclass(frozen=True)
class Files:
    """A file of tracks and what it is read with."""

    tracks: Path
    part: str
    map: Path
    walkers: Path | None = None
    meta: Path | None = None
    phases: Path | None = None
    topology: Path | None = None

    @property
    def scene(self) -> str:
        """Name of the place."""
        return self.map.stem


def find_files(path: Path) -> Files:
    """The files a file of tracks is read together with.

    Raises:
        DataError: it has another name than the format's, or there is no map.
    """
    numbered, split = _NUMBERED.fullmatch(path.name), _SPLIT.fullmatch(path.name)
    if numbered is None:
        if split is None:
            raise DataError("expected a name like vehicle_tracks_000.csv or SCENE_train.csv", file=path)
        # Its name says which map it needs: another place's would fit nowhere, and nobody would be told.
        return Files(path, split[2], _map(path, split[1], alone=False))
    folder, number_ = path.parent, numbered[1]

    def beside(name: str) -> Path | None:
        return folder / name if (folder / name).is_file() else None

    topology = sorted(folder.glob("*_map.kml"))
    return Files(
        path,
        number_,
        _map(path, folder.resolve().name),
        beside(f"pedestrian_tracks_{number_}.csv"),
        beside("meta_data.csv"),
        beside(f"signal_phases_{number_}.csv"),
        topology[0] if len(topology) == 1 else None,
    )


def _map(path: Path, scene: str, *, alone: bool = True) -> Path:
    """The map of a place; if ``alone``, a single map beside the tracks does, whatever its name."""
    folders = (path.parent, path.parent.parent / "maps", path.parent.parent.parent / "maps")
    for folder in folders:
        for suffix in ("osm_xy", "osm"):
            if (folder / f"{scene}.{suffix}").is_file():
                return folder / f"{scene}.{suffix}"
    if not alone:
        raise DataError(f"the map is missing: no maps/{scene}.osm_xy or .osm", file=path)
    maps = sorted(path.parent.glob("*.osm")) + sorted(path.parent.glob("*.osm_xy"))
    if len(maps) != 1:
        raise DataError(
            f"the map is missing: no maps/{scene}.osm, and not one map beside the tracks", file=path
        )
    return maps[0]


def read_meta(path: Path, part: str) -> tuple[Doubles, bool]:
    """(latitude and longitude of the origin [2], whether there are signal phases) of a recording.

    Raises:
        DataError: the file can't be read, or says nothing, or two things, about the recording.
    """
    try:
        data = path.read_bytes()
        if not data.endswith(b"\n") or len(data) > 1 << 20:
            raise DataError("empty, cut short, or larger than 1 MiB")
        table = csv.DictReader(io.StringIO(data.decode("ascii", errors="replace")))
        found = [row for row in table if row.get("id") == part]
        if len(found) != 1:
            raise DataError(f"{len(found)} rows for recording {part}, expected one", field="id")
        origin = np.array([number(found[0].get(name), name) for name in ("originLat", "originLon")])
        # Both spellings occur.
        spat = found[0].get("spatAvailable") or found[0].get("spatAvailible") or "no"
        if spat not in {"yes", "no"}:
            raise DataError(f"{spat[:20]!r} is neither yes nor no", field="spatAvailable")
        return origin, spat == "yes"
    except csv.Error as error:
        raise DataError(f"not a CSV file: {error}", file=path) from error
    except DataError as error:
        raise error.at(file=path) from error
