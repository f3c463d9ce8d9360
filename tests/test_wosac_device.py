"""The WOSAC score on a device other than the host: the same numbers, and tensors of two devices never meet."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from helpers_device_numbers import host, numbered
from helpers_wosac import made_rollouts, made_scenario
from symphony.wosac.scorer import CHALLENGES, compute_features, score


def test_the_device_refuses_what_a_card_refuses() -> None:
    one, two = torch.arange(3.0), torch.ones(3)
    with numbered() as device:
        there = one.to(device)
        assert there.device.type == device.type
        assert host(there + 1.0 + torch.tensor(2.0)).tolist() == [3.0, 4.0, 5.0]
        with pytest.raises(RuntimeError, match="two devices"):
            there + two
        assert (there[there > 0].cpu() + two[:2]).tolist() == [2.0, 3.0]


@pytest.mark.parametrize("agents", [2, 5])
def test_features_and_scores_are_those_of_the_host(agents: int) -> None:
    scenario = made_scenario(agents, seed=agents)
    rollouts = made_rollouts(scenario, 3)
    expected = compute_features(scenario, rollouts)
    with numbered() as device:
        there, simulated = scenario.to(device), rollouts.to(device)
        found = compute_features(there, simulated)
        for field in fields(expected):
            value, right = getattr(found, field.name), getattr(expected, field.name)
            if isinstance(right, torch.Tensor):
                assert value.device.type == device.type, field.name
                assert torch.equal(host(value), right) or torch.equal(host(value).isnan(), right.isnan()), (
                    field.name
                )
        scores = {year: score(there, simulated, config) for year, config in CHALLENGES.items()}
    for year, config in CHALLENGES.items():
        right = score(scenario, rollouts, config)
        assert float(scores[year].metametric) == float(right.metametric)
