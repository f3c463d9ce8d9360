"""What becomes of single agents: by hand, and that batches add up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from symphony.metrics import AgentSteps, CollisionKind, CollisionKinds
from symphony.metrics.agents import AgentResult, agent_rates, agent_results, speed_distance


def steps_of(
    there: Any, logged: Any, kind: Any, speed: Any, speed_log: Any, playback: Any, offroad: Any
) -> AgentSteps:
    kind = torch.as_tensor(kind)
    none = torch.full_like(kind, -1)
    kinds = CollisionKinds(kind, none, none, torch.as_tensor(playback))
    there = torch.as_tensor(there)
    return AgentSteps(
        there,
        torch.as_tensor(logged),
        torch.as_tensor(offroad),
        kinds,
        torch.as_tensor(speed, dtype=torch.float32),
        torch.as_tensor(speed_log, dtype=torch.float32),
        torch.ones(len(there), dtype=torch.bool),
    )


def made(seed: int, batch: int, agents: int = 3, steps: int = 5) -> AgentSteps:
    rng = np.random.default_rng(seed)
    shape = (batch, 2, agents, steps)
    return steps_of(
        rng.random(shape) < 0.7,
        rng.random((batch, agents, steps)) < 0.7,
        rng.integers(-1, len(CollisionKind), shape[:3]),
        rng.uniform(0, 30, shape),
        rng.uniform(0, 30, (batch, agents, steps)),
        rng.random(shape[:3]) < 0.5,
        rng.random(shape) < 0.2,
    )


def totals(found: list[AgentResult]) -> dict[str, float]:
    return {name: float(total.sum() / weight.sum()) for name, (total, weight) in agent_rates(found).items()}


def test_by_hand() -> None:
    # One rollout: the first agent runs into its leader, the second, hit from behind by playback, is logged twice and
    # stands, the third is never driven while its log exists.
    there = [[[[True, True, True], [True, True, True], [False, False, True]]]]
    logged = [[[True, True, True], [True, True, False], [True, True, False]]]
    kind = [[[int(CollisionKind.INTO_LEADER), int(CollisionKind.REAR_ENDED), -1]]]
    speed = [[[[4.0, 4.0, 4.0], [0.1, 0.3, 9.0], [9.0, 9.0, 9.0]]]]
    log = [[[5.0, 5.0, 5.0], [0.1, 0.3, 0.0], [7.0, 7.0, 0.0]]]
    off = [[[[False, True, True], [False, False, True], [True, True, True]]]]
    steps = steps_of(there, logged, kind, speed, log, [[[False, True, False]]], off)
    found = totals(agent_results(steps))
    assert found["agent_collision_rate"] == 100
    assert found["agent_collision_into_leader"] == found["agent_collision_rear_ended"] == 50
    assert found["agent_collision_with_playback"] == 50
    assert found["agent_offroad_time"] == 40  # two of five steps that both have
    assert found["agent_progress"] == pytest.approx(100 * 12.4 / 15.4)
    assert found["agent_standing"] == found["agent_standing_log"] == 40
    assert found["agent_speed_log"] == pytest.approx(15.4 / 5)


def test_speeds_are_as_far_apart_as_they_are_shifted() -> None:
    there = np.ones((1, 1, 1, 4), bool)
    speed = np.array([1.2, 5.2, 9.2, 20.2])
    for shift in (0.0, 1.0, 7.5):
        found = agent_results(
            steps_of(
                there,
                there[0],
                [[[-1]]],
                speed[None, None, None] + shift,
                speed[None, None],
                [[[False]]],
                ~there,
            )
        )
        assert speed_distance(found) == pytest.approx(shift)


@given(st.integers(0, 1000), st.integers(1, 3), st.integers(1, 3))
def test_segments_add_up_whatever_the_batch(seed: int, first: int, second: int) -> None:
    whole = made(seed, first + second)
    cut = [
        AgentSteps(*(_part(value, rows) for value in whole)) for rows in (slice(first), slice(first, None))
    ]
    apart = [result for part in cut for result in agent_results(part)]
    together = agent_results(whole)
    assert totals(apart) == totals(together)
    alone = [agent_rates([result]) for result in together]  # errors are over segments, or groups of them
    for name, (total, weight) in agent_rates(together).items():
        assert total.tolist() == [float(rates[name][0].item()) for rates in alone]
        assert weight.tolist() == [float(rates[name][1].item()) for rates in alone]
    assert speed_distance(apart) == speed_distance(together)


def _part(value: Any, rows: slice) -> Any:
    return CollisionKinds(*(each[rows] for each in value)) if isinstance(value, tuple) else value[rows]
