"""Hand saved rollouts to other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Export:
    """Write saved rollouts in a format of other tools, a file for each."""

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SIM")]
    """Folder of saved rollouts."""
    format: Literal["commonroad", "json"] = "commonroad"
    """CommonRoad scenarios (XML 2020a, .xml), or JSON."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where the files go; by default the folder `export` within SIM."""
    segments: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...")] = ()
    """Only these run segments, by their ids."""
    rollouts: Annotated[tuple[int, ...], tyro.conf.arg(metavar="K ...")] = ()
    """Only these of each, counted from 0."""

    def run(self) -> None:
        """Write the files."""
        import json

        from rich.console import Console

        from symphony.errors import ConfigError
        from symphony.files import Lock, naming, write_file
        from symphony.saved.export import commonroad, to_dict
        from symphony.saved.folder import file_stem, load_rollouts

        folder = load_rollouts(self.folder)
        out = self.folder / "export" if self.out is None else self.out
        with naming(out):
            out.mkdir(parents=True, exist_ok=True)
        with Lock(out / "export.lock"):
            count = 0
            for name in self.segments or folder.ids:
                saved = folder.of(name)
                for k in self.rollouts or range(saved.rollouts):
                    if not 0 <= k < saved.rollouts:
                        raise ConfigError(f"{name} has rollouts 0 to {saved.rollouts - 1}, not {k}")
                    stem = out / f"{file_stem(name)}-{k}"
                    if self.format == "json":
                        text = json.dumps(to_dict(saved, k), ensure_ascii=False, allow_nan=False)
                        write_file(stem.with_name(f"{stem.name}.json"), text + "\n")
                    else:
                        write_file(stem.with_name(f"{stem.name}.xml"), commonroad(saved, k))
                    count += 1
        Console().print(f"written: {count} files in {out}", soft_wrap=True, markup=False)
