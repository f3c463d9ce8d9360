"""Settings that go together: the paper's protocol, and smaller ones that say what they reduce."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Literal, get_args

from symphony.config import Method
from symphony.errors import ConfigError

Profile = Literal["default", "paper", "laptop", "smoke"]
Flags = dict[str, str]

_EVERY: dict[str, Flags] = {
    # Section V-A: 70 000 updates of 16 segments, S 4 and 16, a checkpoint every 2 000 judged on 200 segments.
    "paper": {
        "--steps": "70000",
        "--segments": "16",
        "--checkpoint-every": "2000",
        "--agent.num-objects": "16",
        "--agent.num-points": "1000",
        "--search.branches": "4",
        "--search.test-branches": "16",
        "--search.prune-every": "10",
        "--search.rule": "best",
        "--search.segments": "16",
        "--search.updates": "1",
        "--validation.segments": "200",
        "--validation.rollouts": "16",
    },
    "laptop": {
        "--steps": "3000",
        "--checkpoint-every": "500",
        "--agent.num-points": "128",
        "--discriminator.features": "foresight",
        "--search.survivors": "best",
        "--validation.every": "1000",
        "--validation.segments": "48",
        "--validation.rollouts": "4",
    },
    "smoke": {
        "--steps": "4",
        "--segments": "2",
        "--states": "16",
        "--checkpoint-every": "2",
        "--agent.num-points": "16",
        "--agent.hidden": "8",
        "--agent.head": "8",
        "--search.segments": "2",
        "--search.branches": "2",
        "--search.test-branches": "2",
        "--search.updates": "2",
        "--search.states": "8",
        "--discriminator.states": "8",
        "--validation.segments": "2",
        "--validation.rollouts": "2",
        "--wandb": "disabled",
    },
}
_MGAIL: dict[str, Flags] = {
    "paper": {
        "--mgail.cost": "log_d",
        "--mgail.regression": "0",
        "--mgail.head-start": "0",
        "--mgail.rollouts": "64",
    },
    "laptop": {
        "--steps": "3000",
        "--search.segments": "8",
        "--search.updates": "2",
    },
    "smoke": {"--mgail.regression": "2", "--mgail.head-start": "0", "--mgail.rollouts": "2"},
}
WORDS = (
    "default: the values shown; paper: the protocol of the paper (70 000 updates, 1 000 points, batch 16, S 4 and "
    "16, 200 validation segments); laptop: meant for two cores and about an hour (3 000 updates, 128 points, 48 "
    "validation segments of 4 rollouts); smoke: seconds, to see that all runs. What is given beside it has "
    "precedence; the best checkpoint is chosen where --validation.data is given."
)


def expanded(args: Sequence[str]) -> list[str]:
    """Arguments of a training command with the flags of their ``--profile`` that are not among them.

    Raises:
        ConfigError: for an unknown profile.
    """
    given = list(args)
    name = "default"
    for place, word in enumerate(given):
        if word == "--profile" and place + 1 < len(given):
            name = given[place + 1]
        elif word.startswith("--profile="):
            name = word.removeprefix("--profile=")
    if name not in get_args(Profile):
        close = difflib.get_close_matches(name, get_args(Profile), 1)
        hint = f", did you mean '{close[0]}'?" if close else ""
        raise ConfigError(f"profile is one of {', '.join(get_args(Profile))}, not '{name}'{hint}")
    if name == "default":
        return given
    method = next((word for word in given if word in get_args(Method)), "")
    flags = {**_EVERY[name], **(_MGAIL[name] if method.startswith("mgail") else {})}
    written = {word.split("=")[0].replace("_", "-") for word in given}
    return [*given, *(word for flag, value in flags.items() if flag not in written for word in (flag, value))]
