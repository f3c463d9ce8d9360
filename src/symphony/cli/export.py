"""Hand saved rollouts to other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from symphony.cli.shared import Names, say


@dataclass(frozen=True)
class Export:
    """Write saved rollouts in a format of other tools, a file for each."""

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SIM")]
    """Folder of saved rollouts."""
    format: Literal["commonroad", "json"] = "commonroad"
    """Format of the files: CommonRoad scenarios (XML 2020a, .xml), or JSON."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the files; by default the folder `export` within SIM."""
    segments: Names = ()
    """Ids of the run segments to export; by default all."""
    rollouts: Annotated[tuple[int, ...], tyro.conf.arg(metavar="K ...")] = ()
    """Numbers of the rollouts to export of each run segment, counted from 0; by default all."""

    def run(self) -> None:
        """Write the files."""
        import json

        from symphony.errors import ConfigError
        from symphony.files import Lock, naming, write_file
        from symphony.saved.export import commonroad, to_dict
        from symphony.saved.folder import file_stem, load_rollouts

        folder, count = load_rollouts(self.folder), 0
        out = self.folder / "export" if self.out is None else self.out
        with naming(out):
            out.mkdir(parents=True, exist_ok=True)
        with Lock(out / "export.lock"):
            for name in self.segments or folder.ids:
                saved = folder.of(name)
                for k in self.rollouts or range(saved.rollouts):
                    if not 0 <= k < saved.rollouts:
                        raise ConfigError(f"{name} has rollouts 0 to {saved.rollouts - 1}, not {k}")
                    if self.format == "json":
                        text = json.dumps(to_dict(saved, k), ensure_ascii=False, allow_nan=False) + "\n"
                    else:
                        text = commonroad(saved, k)
                    suffix = "json" if self.format == "json" else "xml"
                    write_file(out / f"{file_stem(name)}-{k}.{suffix}", text)
                    count += 1
        say(f"written: {count} files in {out}")
