"""How varied proposals are: what the script says of rollouts that are known."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from symphony.data.builtin import builtin_store

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


@pytest.fixture(name="proposals")
def _proposals(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("proposals")


def test_spread_is_the_distance_to_the_mean(proposals: Any) -> None:
    # Three rollouts of two agents: the first stays, or drives 3 m to either side; the second is gone.
    state = torch.zeros(1, 3, 3, 2, 4)
    state[0, 0, 2, 0, 1], state[0, 1, 2, 0, 1] = 3.0, -3.0
    counted = torch.ones(1, 3, 2, 2, dtype=torch.bool)
    counted[0, 1, 1, 1] = False
    assert proposals.spread(state, counted, 1) == [0.0, 0.0]
    assert proposals.spread(state, counted, 2) == pytest.approx([6.0**0.5])
    assert proposals.spread(state + 100.0, counted, 2) == pytest.approx([6.0**0.5])


def test_it_measures_an_agent(
    proposals: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "found.json"
    given = ["pretrained:bc_ts_h", str(builtin_store("test")), "--segments", "2", "--rollouts", "3"]
    monkeypatch.setattr(sys, "argv", ["proposals.py", *given, "--json", str(out)])
    searches: list[str] = []
    simulated = proposals.simulated
    monkeypatch.setattr(
        proposals, "simulated", lambda a, s, config: searches.append(config.search) or simulated(a, s, config)
    )
    proposals.main()
    record = json.loads(out.read_text())
    assert (record["segments"], record["rollouts"]) == (2, 3)
    assert 0 < record["entropy"] < 10
    spreads = [record["spread"][seconds] for seconds in sorted(record["spread"], key=float)]
    assert spreads == sorted(spreads)
    assert 0 < spreads[0] < 5
    assert searches == ["none"]
    assert "entropy" in capsys.readouterr().out
