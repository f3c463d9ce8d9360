"""Submissions and rollouts, broken at random: refused, with scenario, agent and field named."""

from __future__ import annotations

import gzip
import math
import re
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from helpers_wosac import made_rollouts, made_scenario
from symphony.errors import DataError
from symphony.wosac.scorer import SimulatedRollouts, score
from symphony.wosac.submission import FIELDS
from symphony.wosac.submission_check import check_submission
from test_wosac_submission import AGENTS, NAMES, Shard, good_shards, named, pack, problems

ROLLOUT, AGENT, STATE = st.integers(0, 31), st.integers(0, 2), st.sampled_from(sorted(FIELDS.values()))
NAUGHT = st.sampled_from([math.nan, math.inf, -math.inf])


GOOD = [shard.SerializeToString() for shard in good_shards()]


def fresh() -> list[Shard]:
    return [Shard.FromString(content) for content in GOOD]


def scenario_of(shards: list[Shard], name: str) -> Any:
    return next(one for shard in shards for one in shard.scenario_rollouts if one.scenario_id == name)


def trajectories(shards: list[Shard], name: str, rollout: int) -> Any:
    return scenario_of(shards, name).joint_scenes[rollout].simulated_trajectories


def check(shards: list[Shard]) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        return problems(pack(Path(folder) / "wrong.tar.gz", named(shards), "w:gz"))


@pytest.mark.parametrize("how", "ncld")
@settings(max_examples=3)
@given(st.sampled_from(NAMES), ROLLOUT, AGENT, STATE, st.integers(0, 79), NAUGHT)
def test_broken_states(
    how: str, name: str, rollout: int, agent: int, state: str, step: int, value: float
) -> None:
    shards = fresh()
    values = getattr(trajectories(shards, name, rollout)[agent], state)
    change: dict[str, Callable[[], Any]] = {
        "n": lambda: values.__setitem__(step, value),
        "c": lambda: values.__delitem__(slice(None)),
        "l": lambda: values.append(0.0),
        "d": lambda: values.__delitem__(step),
    }
    change[how]()
    (found,) = check(shards)
    assert f"segment {name}, field {state}: rollout {rollout}, agent {100 + agent}: " in found
    if how == "n":
        assert found.endswith(f"not finite at future step {step}")


@pytest.mark.parametrize("how", "mrsz")
@settings(max_examples=3)
@given(st.sampled_from(NAMES), ROLLOUT, AGENT, st.integers(-5, 5000))
def test_broken_agents(how: str, name: str, rollout: int, agent: int, number: int) -> None:
    shards = fresh()
    there = trajectories(shards, name, rollout)
    if how == "m":
        there.pop(agent)
    elif how == "r":
        there.append(there[agent])
    elif how == "s":
        there[agent].object_id = number
    else:
        there[agent].ClearField("object_id")
    if how == "s" and number == 100 + agent:
        assert check(shards) == []
        return
    found = check(shards)
    assert found
    for text in found:
        assert f"segment {name}, field object_id: rollout {rollout}" in text
        assert re.search(r"agents? \d+|agent -\d+", text)
    assert any(f"agent {100 + agent} " in text for text in found)


@pytest.mark.parametrize("how", "ladeu")
@settings(max_examples=2)
@given(st.sampled_from(NAMES), ROLLOUT)
def test_broken_scenarios(how: str, name: str, rollout: int) -> None:
    shards = fresh()
    scenario = scenario_of(shards, name)
    if how == "l":
        scenario.joint_scenes.pop(rollout)
    elif how == "a":
        scenario.joint_scenes.append(scenario.joint_scenes[rollout])
    elif how == "d":
        shards[rollout % 2].scenario_rollouts.append(scenario)
    elif how == "e":
        scenario.joint_scenes[rollout].ClearField("simulated_trajectories")
    else:
        scenario.scenario_id = f"{rollout}"
    found = check(shards)
    assert any(f"segment {name}, field " in text for text in found)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pack(tmp_path_factory.mktemp("good") / "good.tar.gz", named(fresh()))


def unzipped(content: bytes) -> bytes | None:
    """What is in a file that gzip finds no fault with."""
    try:
        return gzip.decompress(content)
    except (OSError, EOFError, zlib.error):
        return None


@settings(max_examples=10)
@given(st.floats(0, 1), st.integers(1, 255), st.booleans())
def test_damaged_bytes_are_found(good: Path, place: float, change: int, cut: bool) -> None:
    content = bytearray(good.read_bytes())
    # What comes before, time and name, means nothing.
    begin = content.index(b"\0", 10) + 1
    where = begin + int(place * (len(content) - 1 - begin))
    if cut:
        del content[where:]
    else:
        content[where] ^= change
    # Among the zeros at the end another distance copies the same.
    assume(unzipped(bytes(content)) != unzipped(good.read_bytes()))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "wrong.tar.gz"
        path.write_bytes(content)
        assert check_submission(path, AGENTS).count > 0


@pytest.mark.parametrize("how", ["value", "agent", "rollout", "step", "type", "twice", "foreign"])
@settings(max_examples=4)
@given(
    st.sampled_from(["x", "y", "z", "heading", "object_id"]),
    st.integers(0, 2),
    AGENT,
    st.integers(0, 79),
    NAUGHT,
)
def test_broken_rollouts(how: str, field: str, rollout: int, agent: int, step: int, value: float) -> None:
    scenario = made_scenario()
    arrays = {name: array.numpy().copy() for name, array in vars(made_rollouts(scenario)).items()}
    ids, states = arrays["object_id"], arrays[field]
    texts = [field]
    if how == "twice":
        ids[agent], texts = ids[agent + 1], [f"agent {ids[agent + 1]} more than once", "object_id"]
    elif how == "foreign":
        texts = [f"agent {ids[agent]} missing", "object_id"]
        ids[agent] = 999
    elif how == "agent" or field == "object_id":
        texts = [f"agent {ids[agent]} missing", "object_id"]
        arrays = {name: np.delete(array, agent, min(1, array.ndim - 1)) for name, array in arrays.items()}
    elif how == "value":
        states[rollout, agent, step] = value
        texts = [f"agent {ids[agent]}, rollout {rollout}, step {11 + step}: not finite", field]
    elif how == "type":
        arrays[field] = states.astype(np.int64)
    else:
        arrays[field] = np.delete(states, 0, {"rollout": 0, "step": 2}[how])
    with pytest.raises(DataError) as refused:
        score(scenario, SimulatedRollouts.of(**arrays))
    message = str(refused.value)
    assert "segment made" in message
    # Where only one array has fewer rollouts, the others are the ones that don't fit it.
    assert all(text in message for text in texts) or (how == "rollout" and "has shape" in message)
