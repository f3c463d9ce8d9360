"""Settings that go together, as functions from a configuration to another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from symphony.config.training import TrainConfig

Profile = Literal["default", "paper", "recommended", "laptop", "tiny", "smoke"]


def paper(config: TrainConfig) -> TrainConfig:
    """Section V-A: 70 000 updates of 16 segments, S 4 and 16, a checkpoint every 2 000 chosen on 200 segments."""
    return replace(
        config,
        steps=70_000,
        segments=16,
        checkpoint_every=2000,
        agent=replace(config.agent, num_points=1000),
        discriminator=replace(config.discriminator, features="paper"),
        search=replace(
            config.search,
            branches=4,
            test_branches=16,
            prune_every=10,
            rule="best",
            updates=1,
        ),
        mgail=replace(
            config.mgail,
            cost="log_d",
            regression=0,
            head_start=0,
            rollouts=64,
            react=True,
            expert_weight=0.0,
            discriminator_updates=1,
        ),
        validation=replace(config.validation, segments=200, rollouts=16),
    )


def recommended(config: TrainConfig) -> TrainConfig:
    """What gave the best agents so far: inputs beyond the paper's, displaced states once the policy drives, a search
    that replaces only bad branches; of MGAIL the regression that its adversarial updates start from.
    """
    return replace(
        config,
        steps=3000,
        checkpoint_every=500,
        agent=replace(config.agent, num_points=200, num_lights=4, features="gaps", accelerations=21),
        perturb=replace(config.perturb, share=0.5, begin=1500),
        discriminator=replace(config.discriminator, features="foresight"),
        search=replace(config.search, rule="replace", goals="branch"),
        mgail=replace(config.mgail, regression=3000, learning_rate=5e-4, truncate=10),
        validation=replace(config.validation, segments=60, rollouts=4),
    )


def laptop(config: TrainConfig) -> TrainConfig:
    """Meant for two cores and about an hour."""
    return replace(
        config,
        steps=3000,
        checkpoint_every=1000,
        agent=replace(config.agent, num_points=128),
        discriminator=replace(config.discriminator, features="foresight"),
        # Of all that goes beyond the paper's inputs, what lowers collisions most.
        perturb=replace(config.perturb, share=0.5, begin=1500),
        validation=replace(config.validation, segments=48, rollouts=4),
    )


def tiny(config: TrainConfig) -> TrainConfig:
    """About half a minute for a method: what `make table` runs."""
    return replace(
        smoke(config),
        steps=120,
        segments=8,
        states=256,
        checkpoint_every=60,
        agent=replace(config.agent, num_points=64, hidden=32),
        search=replace(config.search, branches=4, test_branches=4, updates=10, states=64),
        mgail=replace(config.mgail, regression=80, head_start=10, rollouts=4),
    )


def smoke(config: TrainConfig) -> TrainConfig:
    """Seconds, to see that all runs."""
    return replace(
        config,
        steps=4,
        segments=2,
        states=16,
        checkpoint_every=2,
        agent=replace(config.agent, num_points=16, hidden=8),
        search=replace(config.search, branches=2, test_branches=2, updates=2, states=8),
        mgail=replace(config.mgail, regression=2, head_start=0, rollouts=2),
        validation=replace(config.validation, segments=2, rollouts=2),
        wandb="disabled",
    )


def demo(config: TrainConfig) -> TrainConfig:
    """What `symphony demo` runs, minutes on a laptop.

    Half the states and fewer points than by default: more, cheaper updates suit the few segments of the package. So
    do inputs beyond the paper's, and displaced states once it drives.
    """
    return replace(
        config,
        agent=replace(config.agent, num_points=128, num_lights=4, features="gaps", accelerations=21),
        perturb=replace(config.perturb, share=0.5, begin=config.steps // 3),
        states=512,
        wandb="disabled",
    )


PROFILES: dict[Profile, Callable[[TrainConfig], TrainConfig]] = {
    "default": lambda config: config,
    "paper": paper,
    "recommended": recommended,
    "laptop": laptop,
    "tiny": tiny,
    "smoke": smoke,
}
