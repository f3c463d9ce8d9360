"""Where a run begins: at its last checkpoint, at another run's networks, or anew."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from symphony.agents.agent import Agent, read_spec
from symphony.agents.checkpoint import CheckpointError, latest, load_checkpoint, parts_of
from symphony.agents.choice import choose, split_name
from symphony.config import AgentSpec, RunConfig, read_json
from symphony.errors import ConfigError
from symphony.training.logging import RECORDS

FREE = (
    "out",
    "data",
    "steps",
    "resume",
    "device",
    "wandb",
    "preview",
    "checkpoint_every",
    "log_every",
)
"""Settings that may be others when a run goes on."""


def checkpoint_to_resume(config: RunConfig) -> Path | None:
    """The checkpoint to go on from; None for a new run.

    Raises:
        ConfigError: if the folder holds a run that is not to be gone on with, or another one.
    """
    path, records = config.out / "config.json", config.out / RECORDS
    found = latest(config.out / "checkpoints")
    if path.exists():
        # One that failed at its first update, say for a wrong setting, has nothing to lose.
        if not config.resume and found is None and not (records.exists() and records.stat().st_size):
            return None
        if not config.resume:
            raise ConfigError(f"{config.out} holds a run already; choose another folder or --resume")
        before = read_json(type(config), path)
        # More updates, another machine or fewer records do not make it another run.
        free = {name: getattr(config, name) for name in FREE}
        # Scores on other segments could not be compared with those so far.
        free["validation"] = config.validation
        if before.validation.data is not None:
            free["validation"] = dataclasses.replace(before.validation, data=config.validation.data)
        before = dataclasses.replace(before, **free)
        changed = _changed(before, config)
        if changed:
            raise ConfigError(f"{config.out}: can't resume with another {', '.join(changed)}")
    if found is not None and not path.exists():
        raise ConfigError(
            f"{config.out} holds checkpoints of a run whose config.json is gone; choose another folder"
        )
    return found


def _changed(before: Any, after: Any, where: str = "") -> list[str]:
    """Settings that differ, those within others by their full names, with what they were."""
    found = []
    for name in (field.name for field in dataclasses.fields(after)):
        one, other = getattr(before, name), getattr(after, name)
        if dataclasses.is_dataclass(one) and type(one) is type(other):
            found += _changed(one, other, f"{where}{name}.")
        elif one != other:
            found.append(f"{where}{name} (was {one})")
    return found


def warm_start(agent: Agent, run: Path) -> None:
    """Take over the networks that another run has too; personas that they had not change nothing at first.

    Raises:
        ConfigError: if there is no such run, or it learned another time step.
        CheckpointError: if its networks have other shapes; names the settings of the agent that differ.
    """
    folder, which = split_name(str(run))
    source = choose(folder, which)
    there = parts_of(source)
    shared = {name: module for name, module in agent.modules.items() if name in there}
    before = read_spec(folder)
    if agent.spec is not None:
        dataclasses.replace(agent, name=str(run), spec=before).check_step(agent.spec.dt)
    widen = agent.spec is not None and _only_personas(before, agent.spec)
    try:
        load_checkpoint(source, modules=shared, partial=True, restore_rng=False, widen=widen)
    except CheckpointError as error:
        changed = [] if agent.spec is None else _changed(before.agent, agent.spec.agent, "agent.")
        if changed:
            error.message += f"; its agent has another {', '.join(changed)}"
        raise


def _only_personas(before: AgentSpec, after: AgentSpec) -> bool:
    """Whether personas are all that is new to the networks, and come after all that they knew.

    Any other input would stand before inputs that are learned already, whose weights it would get.
    """
    told = dataclasses.replace(before.agent, persona=True, interactive=after.agent.interactive)
    alike = told == after.agent and before.goals == after.goals and before.action_space == after.action_space
    return alike and not before.agent.persona and after.agent.features != "road"
