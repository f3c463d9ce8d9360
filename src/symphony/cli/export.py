"""Hand saved rollouts to other tools."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from symphony.cli import shared
from symphony.errors import ConfigError
from symphony.files import write_file


class Export(shared.Command):
    """Write saved rollouts in a format of other tools, a file for each."""

    folder: shared.Saved
    #: Format of the files: CommonRoad scenarios (XML 2020a, .xml), or JSON.
    format: Literal["commonroad", "json"] = "commonroad"
    #: Folder of the files; by default the folder `export` within SIM.
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    segments: shared.Segments = ()
    #: Numbers of the rollouts to export of each run segment, counted from 0; by default all.
    rollouts: Annotated[tuple[int, ...], arg(metavar="K ...")] = ()

    def __call__(self) -> None:
        from symphony.saved.export import commonroad, to_dict
        from symphony.saved.folder import file_stem, load_rollouts

        folder, count, suffix = load_rollouts(self.folder), 0, "json" if self.format == "json" else "xml"
        out = self.folder / "export" if self.out is None else self.out
        with shared.locked_folder(out, "export.lock"):
            for name in self.segments or folder.ids:
                saved = folder.of(name)
                for k in self.rollouts or range(saved.rollouts):
                    if not 0 <= k < saved.rollouts:
                        raise ConfigError(f"{name} has rollouts 0 to {saved.rollouts - 1}, not {k}")
                    if self.format == "json":
                        text = json.dumps(to_dict(saved, k), ensure_ascii=False, allow_nan=False) + "\n"
                    else:
                        text = commonroad(saved, k)
                    write_file(out / f"{file_stem(name)}-{k}.{suffix}", text)
                    count += 1
        shared.say(f"written: {count} files in {out}")
