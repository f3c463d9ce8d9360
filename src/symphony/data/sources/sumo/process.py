"""Finding SUMO's programs and running them as subprocesses."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import os
import shutil
import stat
import subprocess
import tempfile
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from symphony.data import store_format
from symphony.errors import DataError, SymphonyError

TIMEOUT_SECONDS = 600.0
SCRATCH = "symphony-sumo-"
SETTLED = 60.0  # seconds after which a folder without an owner is not one that is just being made


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Make a temporary folder; those that killed processes left behind are removed first."""
    for folder in Path(tempfile.gettempdir()).glob(f"{SCRATCH}*"):
        _remove_left(folder)
    with tempfile.TemporaryDirectory(prefix=SCRATCH) as name, store_format.lock(Path(name)):
        yield Path(name)


def _remove_left(folder: Path) -> None:
    """Remove a folder whose lock nobody holds: its owner is dead, on whichever machine or in which container."""
    with contextlib.suppress(OSError, DataError):
        state = folder.lstat()
        mine = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid()
        if mine and time.time() - state.st_mtime > SETTLED:
            with store_format.lock(folder):
                shutil.rmtree(folder, ignore_errors=True)


@cache
def sumo_home() -> Path:
    """Return the folder of the installed SUMO; a :class:`DataError` where it is not installed."""
    spec = importlib.util.find_spec("sumo")
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        if (Path(folder) / "bin").is_dir():
            return Path(folder)
    raise DataError("SUMO is not installed; it comes with the extra: pip install 'symphony-traffic[sumo]'")


@cache
def sumo_version() -> str:
    """Return the version of the installed SUMO, such as "1.28.0"."""
    sumo_home()
    return importlib.metadata.version("eclipse-sumo")


def run_program(name: str, arguments: str, folder: Path) -> None:
    """Run one of SUMO's programs in a folder; a :class:`DataError` ends with what it said where it failed. What the
    machine lacked is an OSError, or a :class:`SymphonyError` if the program was stopped.
    """
    home = sumo_home()
    command = [str(home / "bin" / name), *arguments.split(), "--xml-validation", "never"]
    env = {**os.environ, "SUMO_HOME": str(home)}
    try:
        done = subprocess.run(  # noqa: S603 - the program comes from the installed wheel and the arguments are ours
            command, cwd=folder, env=env, check=False, capture_output=True, errors="replace", timeout=TIMEOUT_SECONDS
        )
    except subprocess.TimeoutExpired as error:
        raise SymphonyError(f"{name} took more than {TIMEOUT_SECONDS:g} s") from error
    if done.returncode < 0:
        raise SymphonyError(f"{name} {arguments}: killed by signal {-done.returncode} (out of memory? a bad file?)")
    if done.returncode != 0:
        raise DataError(f"{name} failed with exit status {done.returncode}:\n{done.stderr[-4000:].strip()}")
    # On a full disk they end as if all were well, with files that are cut off.
    (folder / "room").write_bytes(bytes(1 << 16))
    (folder / "room").unlink()
