"""Limits on what a stranger's folder may ask for: no code, and no memory that its files don't fill (SECURITY.md)."""

from __future__ import annotations

import gzip
import io
import json
import os
import shutil
import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_sources import little_memory
from symphony.agents import load_agent
from symphony.agents.choice import pretrained_folder
from symphony.cli import main
from symphony.data.builtin import builtin_store
from symphony.data.npz import read_npz
from symphony.errors import ConfigError, DataError, DataWarning, SymphonyError
from symphony.wosac.files import read_rollouts
from symphony.wosac.submission import check_submission

NOTES = """
from pathlib import Path
Path(r"{}").write_text("code ran")
from symphony.modules import SceneEncoder as Encoder
"""


@pytest.fixture(name="stranger")
def _stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """The folder of an agent with other settings, in a current folder that Python doesn't search by itself."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", os.getcwd())])

    def make(**settings: Any) -> Path:
        folder = tmp_path / "stranger"
        shutil.copytree(pretrained_folder("bc_ts_h"), folder)
        values = json.loads((folder / "agent.json").read_text())
        for name, value in settings.items():
            part, _, setting = name.partition("__")
            (values[part] if setting else values)[setting or part] = value
        (folder / "agent.json").write_text(json.dumps(values))
        (folder / "notes.py").write_text(NOTES.format(tmp_path / "ran"))
        shutil.copy(folder / "notes.py", tmp_path)
        return folder

    return make


SHORT = ("--segments", "0", "--rollouts", "1", "--duration", "1", "--search", "none")
SETTINGS = ("agent__encoder", "agent__policy", "discriminator__network", "search__rule")


@pytest.mark.parametrize("place", ["stranger/notes.py", "notes"])
@pytest.mark.parametrize("setting", SETTINGS)
def test_a_folder_runs_no_code(stranger: Callable[..., Path], setting: str, place: str, capsys: Any) -> None:
    folder = stranger(**{setting: f"{place}:Encoder"})
    data = str(builtin_store("test"))
    command = ["simulate", str(folder), "--data", data, "--segments", "0", "--out", "sim"]
    assert main(command) == 1
    assert f"{setting.replace('__', '.')} names code, '{place}:Encoder'" in capsys.readouterr().err
    assert not Path("ran").exists()
    assert not Path("sim").exists()


@pytest.mark.filterwarnings("always::symphony.errors.DataWarning")
def test_trusted_code_is_named_and_runs(stranger: Callable[..., Path], capsys: Any) -> None:
    folder = stranger(agent__encoder="stranger/notes.py:Encoder")
    with pytest.warns(DataWarning, match=r"agent\.json: agent\.encoder runs code, 'stranger/notes\.py:Encoder'"):
        assert load_agent(str(folder), trust_code=True).policy is not None
    assert Path("ran").exists()
    data = ("--data", str(builtin_store("test")))
    for words, more in (("simulate", [*SHORT, "--out", "sim"]), ("evaluate", SHORT), ("wosac evaluate", ())):
        command = [*words.split(), str(folder), *data, *more]
        assert main(command) == 1, command
        assert "names code" in capsys.readouterr().err, command
        if more:
            assert main([*command, "--trust-code"]) == 0
            assert "runs code, 'stranger/notes.py:Encoder'" in capsys.readouterr().err


def test_the_current_folder_is_not_searched_for_it(stranger: Callable[..., Path]) -> None:
    before = list(sys.path)
    with (
        pytest.warns(DataWarning, match="runs code"),
        pytest.raises(ConfigError, match="current folder is not searched"),
    ):
        load_agent(str(stranger(agent__encoder="notes:Encoder")), trust_code=True)
    assert not Path("ran").exists()
    assert sys.path == before


LARGE: list[dict[str, Any]] = [
    *({"agent__hidden": n} for n in (60_000, 60_000_000, 2**62)), {"agent__accelerations": 10**9 + 1},
    {"action_space": "displacement", "agent__cells": 10**9 + 1}, {"discriminator__hidden": 10**9},
    *({name: 10**9} for name in ("agent__num_points", "agent__num_lights", "search__test_branches")),
]  # fmt: skip


@pytest.mark.parametrize("settings", LARGE)
def test_networks_are_no_larger_than_their_weights(stranger: Callable[..., Path], settings: Any) -> None:
    with pytest.raises(SymphonyError, match=r"asks for a network|at most|no networks of these sizes"):
        load_agent(str(stranger(**settings)))


def npz(path: Path, members: dict[str, tuple[tuple[int, ...], int]]) -> None:
    """An archive of float32 arrays whose headers claim shapes, with some bytes of zeros each."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, (shape, size) in members.items():
            header = io.BytesIO()
            described = {"descr": "<f4", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(header, described)
            with archive.open(f"{name}.npy", "w") as part:
                part.write(header.getvalue())
                for begin in range(0, size, 1 << 24):
                    part.write(bytes(min(1 << 24, size - begin)))


def shard(path: Path, size: int, tag: bytes = b"\x0a", kind: bytes = tarfile.REGTYPE) -> None:
    """A submission with one member: a message of some bytes of zeros, or a header of the archive's own."""
    length = bytes((size >> 7 * k & 0x7F) | (0x80 if size >> 7 * (k + 1) else 0) for k in range(5) if size >> 7 * k)
    head = tag + length if kind == tarfile.REGTYPE else b""
    member = tarfile.TarInfo("a.binproto-00000-of-00001")
    member.size, member.type = len(head) + size, kind
    path.write_bytes(gzip.compress(member.tobuf(tarfile.GNU_FORMAT) + head + bytes(size + 10_240), 1))


def headers(path: Path, kind: bytes, text: bytes, times: int) -> None:
    member = tarfile.TarInfo("x")
    member.size, member.type = len(text), kind
    header = member.tobuf(tarfile.GNU_FORMAT) + text.ljust(512, b"\0")
    path.write_bytes(gzip.compress(times * header + tarfile.TarInfo("a").tobuf() + bytes(1024)))


def check(path: Path) -> None:
    raise check_submission(path).problems[0]


def read_some(path: Path) -> object:
    return read_npz(path, most=30 * MIB)


SPARSE = b"22 GNU.sparse.major=1\n22 GNU.sparse.minor=0\n"
MIB, LONG, HEADER = 1 << 20, tarfile.GNUTYPE_LONGNAME, tarfile.XHDTYPE
BOMBS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object], str]] = {
    "its header": (lambda to: npz(to, {"x": ((10**13,), 16)}), read_rollouts, "field x.* by its header"),
    "an array": (lambda to: npz(to, {"x": ((10 * MIB,), 40 * MIB)}), read_some, "field x"),
    "several arrays": (lambda to: npz(to, dict.fromkeys("ab", ((5 * MIB,), 20 * MIB))), read_some, "field b"),
    "a scenario": (lambda to: shard(to, 130 * MIB), check, "a scenario of 136314880 bytes"),
    "another message": (lambda to: shard(to, 50 * MIB, b"\x12"), check, "more than 65536 bytes"),
    "a long name": (lambda to: shard(to, 50 * MIB, kind=LONG), check, "52428800 bytes of a header"),
    "headers of headers": (lambda to: headers(to, LONG, b"x", 3000), check, "damaged header: .*recursion"),
    "a map of a header": (lambda to: headers(to, HEADER, b"24 GNU.sparse.map=a,b\n", 1), check, "damaged"),
    "sparse": (lambda to: headers(to, HEADER, SPARSE, 1), check, "a sparse file"),
    "a header": (lambda to: shard(to, 50 * MIB, kind=HEADER), check, "52428800 bytes of a header"),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_sizes_come_before_memory(kind: str, tmp_path: Path) -> None:
    make, read, why = BOMBS[kind]
    make(path := tmp_path / "bomb")
    with little_memory(32 * MIB), pytest.raises(DataError, match=why):
        read(path)
