"""Profiles of training settings."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest
import tyro
from tensordict.nn import TensorDictModule

from symphony.agents import Agent, discriminator_network, goal_network, policy_network
from symphony.cli import main
from symphony.cli.recipe import Arguments
from symphony.config import METHODS, AgentSpec, TrainConfig
from symphony.config.profiles import PROFILES, expanded
from symphony.errors import ConfigError

NEEDED = ["--data", "a", "--out", "b", "--test", "c"]


def settings(method: str, *args: str) -> TrainConfig:
    return tyro.cli(Arguments, args=expanded([method, *NEEDED, *args])).config


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_is_a_valid_configuration_of_every_method(method: str, profile: str) -> None:
    config = settings(method, "--profile", profile)
    assert config.method == method
    assert (config == settings(method)) == (profile == "default")


@pytest.mark.parametrize("actions", ["bicycle", "displacement"])
@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_fits_both_action_spaces(
    actions: Literal["bicycle", "displacement"], profile: str
) -> None:
    spec = settings("bc", "--profile", profile).spec(
        actions, 0.2, goals=True, discriminator=True, searches=True
    )
    assert set(Agent("built", *networks(spec)).modules) == {"policy", "goals", "discriminator"}


def networks(spec: AgentSpec) -> tuple[TensorDictModule, AgentSpec, TensorDictModule, TensorDictModule]:
    return policy_network(spec), spec, goal_network(spec), discriminator_network(spec)


def test_the_paper_is_followed() -> None:
    config = settings("mgail_ts_h", "--profile=paper")
    search = config.search
    assert (config.steps, config.segments, config.checkpoint_every) == (70_000, 16, 2_000)
    assert (search.branches, search.test_branches, search.prune_every, search.rule) == (4, 16, 10, "best")
    assert (config.agent.num_points, config.validation.segments) == (1_000, 200)
    assert (config.mgail.regression, config.mgail.react, config.mgail.cost) == (0, True, "log_d")
    assert config.discriminator.features == "paper"


def test_the_settings_of_the_paper_s_tables_are_options_of_every_recipe() -> None:
    config = settings("bc", "--duration", "20", "--interactive", "8")
    assert (config.duration, config.agent.interactive) == (20, 8)
    assert config == settings("bc", "--duration", "20", "--agent.interactive", "8")


@pytest.mark.parametrize("given", [["--steps", "7"], ["--steps=7"]])
@pytest.mark.parametrize("first", [True, False])
def test_what_is_given_has_precedence(given: list[str], first: bool) -> None:
    args = [*given, "--profile", "smoke"] if first else ["--profile", "smoke", *given]
    config = settings("bc", *args)
    assert config.steps == 7
    assert config.states == 16


def test_unknown_profiles_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match=r"one of default, .*not 'labtop'"):
        expanded(["bc", "--profile", "labtop"])
    assert main(["train", "bc", "--data", str(tmp_path), "--out", str(tmp_path), "--profile=fast"]) == 2
    assert "profile is one of default, paper, recommended, laptop, tiny, smoke" in capsys.readouterr().err


def test_without_a_profile_nothing_changes() -> None:
    args = ["bc", "--steps", "3", "--profile", "default"]
    assert expanded(args) == args
