"""What a stranger's folder may ask for: no code, and no memory that its files don't fill (SECURITY.md)."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from symphony.agents import load_agent
from symphony.agents.included import pretrained_folder
from symphony.cli import main
from symphony.data.builtin import builtin_store
from symphony.errors import ConfigError, DataWarning, SymphonyError

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
            if setting:
                values[part][setting] = value
            else:
                values[part] = value
        (folder / "agent.json").write_text(json.dumps(values))
        (folder / "notes.py").write_text(NOTES.format(tmp_path / "ran"))
        shutil.copy(folder / "notes.py", tmp_path)
        return folder

    return make


SHORT = ("--rollouts", "1", "--duration", "1", "--search", "none")
SETTINGS = ("agent__encoder", "agent__policy", "discriminator__network", "search__rule", "search__aggregate")


@pytest.mark.parametrize("place", ["stranger/notes.py", "notes"])
@pytest.mark.parametrize("setting", SETTINGS)
def test_a_folder_runs_no_code(stranger: Callable[..., Path], setting: str, place: str, capsys: Any) -> None:
    folder = stranger(**{setting: f"{place}:Encoder"})
    command = [
        "simulate",
        str(folder),
        "--data",
        str(builtin_store("test")),
        "--segments",
        "0",
        "--out",
        "sim",
    ]
    assert main(command) == 1
    assert f"{setting.replace('__', '.')} names code, '{place}:Encoder'" in capsys.readouterr().err
    assert not Path("ran").exists()
    assert not Path("sim").exists()


@pytest.mark.filterwarnings("always::symphony.errors.DataWarning")
def test_trusted_code_is_named_and_runs(stranger: Callable[..., Path], capsys: Any) -> None:
    folder = stranger(agent__encoder="stranger/notes.py:Encoder")
    with pytest.warns(
        DataWarning, match=r"agent\.json: agent\.encoder runs code, 'stranger/notes\.py:Encoder'"
    ):
        assert load_agent(str(folder), trust_code=True).policy is not None
    assert Path("ran").exists()
    data = ["--data", str(builtin_store("test"))]
    for command in (
        ["simulate", str(folder), *data, "--out", "sim", "--segments", "0", *SHORT],
        ["evaluate", str(folder), *data, "--segments", "0", *SHORT],
        ["plot", "rollouts", str(folder), *data, "--out", "a.png", "--segments", "0", *SHORT],
        ["plot", "tree", str(folder), *data, "--out", "b.png", "--segment", "0", "--duration", "1"],
        ["plot", "curvature", str(folder), *data, "--out", "c.png", *SHORT],
        ["wosac", "evaluate", str(folder), *data],
    ):
        assert main(command) == 1, command
        assert "names code" in capsys.readouterr().err, command
        if command[0] in ("simulate", "evaluate"):
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


@pytest.mark.parametrize(
    "settings",
    [
        {"agent__hidden": 60_000},
        {"agent__hidden": 60_000_000},
        {"agent__hidden": 2**62},
        {"agent__head": 10**9},
        {"agent__accelerations": 10**9 + 1},
        {"action_space": "displacement", "agent__cells": 10**9 + 1},
        {"discriminator__hidden": 10**9},
        {"agent__num_points": 10**9},
        {"agent__num_objects": 10**9},
        {"agent__num_lights": 10**9},
        {"search__test_branches": 10**9},
    ],
)
def test_networks_are_no_larger_than_their_weights(stranger: Callable[..., Path], settings: Any) -> None:
    with pytest.raises(SymphonyError, match=r"asks for a network|at most|no networks of these sizes"):
        load_agent(str(stranger(**settings)))
