"""Training settings that go together, as an option of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from symphony.errors import ConfigError

Profile = Literal["default", "paper", "recommended", "laptop", "tiny", "smoke"]
WORDS = (
    "Settings that go together. default: the values shown; paper: the protocol of the paper (70 000 updates, 1 "
    "000 points, its discriminator, batch 16, S 4 and 16, 200 validation segments); recommended: what gave the "
    "best agents so far (inputs beyond the paper's, displaced states, rule `replace`, branches with goals of their "
    "own; 3 000 updates, 200 points); laptop: meant for two cores and about an hour (3 000 updates, 128 "
    "points, 48 validation segments of 4 rollouts); tiny: half a minute, what `make table` runs; smoke: seconds, "
    "to see that all runs. Options that are given beside it have precedence; the best checkpoint is chosen where "
    "--validation.data is given."
)
PROFILES: dict[Profile, str] = {
    "default": "",
    "paper": """--steps 70000 --batch 16 --checkpoint-every 2000 --agent.num-points 1000
        --discriminator.features paper --search.branches 4 --search.test-branches 16 --search.prune-every 10
        --search.rule best --search.updates 1 --mgail.cost log_d --mgail.regression 0 --mgail.head-start 0
        --mgail.rollouts 64 --mgail.react --mgail.expert-weight 0 --mgail.discriminator-updates 1
        --validation.segments 200 --validation.rollouts 16""",
    "recommended": """--steps 3000 --checkpoint-every 500 --agent.num-points 200 --agent.num-lights 4
        --agent.features gaps --agent.accelerations 21 --perturb.share 0.5 --perturb.begin 1500
        --discriminator.features foresight --search.rule replace --search.goals branch --mgail.regression 3000
        --mgail.learning-rate 5e-4 --mgail.truncate 10 --validation.segments 60 --validation.rollouts 4""",
    # Of all that goes beyond the paper's inputs, foresight and displaced states lower collisions most.
    "laptop": """--steps 3000 --checkpoint-every 1000 --agent.num-points 128 --discriminator.features foresight
        --perturb.share 0.5 --perturb.begin 1500 --validation.segments 48 --validation.rollouts 4""",
    "tiny": """--steps 120 --batch 8 --states 256 --checkpoint-every 60 --agent.num-points 64 --agent.hidden 32
        --search.branches 4 --search.test-branches 4 --search.updates 10 --search.states 64 --mgail.regression 80
        --mgail.head-start 10 --mgail.rollouts 4 --validation.segments 2 --validation.rollouts 2 --wandb disabled""",
    "smoke": """--steps 4 --batch 2 --states 16 --checkpoint-every 2 --agent.num-points 16 --agent.hidden 8
        --search.branches 2 --search.test-branches 2 --search.updates 2 --search.states 8 --mgail.regression 2
        --mgail.head-start 0 --mgail.rollouts 2 --validation.segments 2 --validation.rollouts 2 --wandb disabled""",
}


def expanded(args: Sequence[str]) -> list[str]:
    """Return arguments of a training command with the options of their ``--profile`` that are not among them.

    Raises:
        ConfigError: for an unknown profile.
    """
    name: Any = "default"
    for word, after in zip(args, [*args[1:], ""], strict=True):
        if word == "--profile" and after:
            name = after
        elif word.startswith("--profile="):
            name = word.removeprefix("--profile=")
    if name not in PROFILES:
        raise ConfigError(f"profile is one of {', '.join(PROFILES)}, not '{name}'")
    given = {word.split("=")[0].replace("_", "-") for word in args}
    options = (f"--{option}".split() for option in PROFILES[name].split("--") if option.strip())
    return [*args, *(word for words in options if words[0] not in given for word in words)]
