"""Behavioural cloning with tree search and goals: the row "BC+TS+H" of the paper's tables (section III)."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential

from symphony import DiscriminatorLoss, DistillationLoss, DrivingEnv, GoalLoss, SegmentStore, TrainConfig
from symphony.agents import Agent, bicycle, discriminator_network, goal_network, observation_of, policy_network
from symphony.collectors import BeamSearchCollector, with_rows
from symphony.learning import GOALS, SceneDataset, SearchReplay, with_survivors
from symphony.modules import SeededNoise
from symphony.rollouts.search import collector_settings, pruning_rule, realism_score, with_drawn_goals
from symphony.training import Phase, Processes, Trainer, Updates, cosine


def bc_ts_h(config: TrainConfig, processes: Processes) -> Trainer:
    """Learn from the log, and from rollouts of a beam search that the discriminator prunes; both given routes."""
    torch.manual_seed(config.seed)
    seed, rng, dynamics = processes.seed(config.seed), torch.Generator(), bicycle(config.agent)
    data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=True, **config.scenes)

    # Networks.
    spec = config.spec("bicycle", data.dt, goals=True, discriminator=True, searches=True)
    policy, goals, discriminator = policy_network(spec), goal_network(spec), discriminator_network(spec)
    agent = Agent(str(config.out), policy, spec, goals, discriminator).to(processes.device)

    # Environment and collector: the discriminator prunes branches whose routes the goal policy draws.
    env = DrivingEnv(data, dynamics, observation_of(spec), generator=rng, device=processes.device)
    rows, rule = config.rows(len(data)), pruning_rule(config.search)
    collector = BeamSearchCollector(
        with_rows(env, [rows]),
        TensorDictSequential(SeededNoise(seed, dynamics.numbers), policy),
        score=realism_score(env, discriminator),
        prepare=lambda start: with_drawn_goals(env, goals, start, seed, config.search.goals),
        **collector_settings(config.search, env, seed, data, rows, rule),
    )
    replay = SearchReplay(collector, env, data, config.search.updates, config.search.states, config.segments)

    # Losses and optimizers.
    policy_loss, goal_loss = processes.wrap_ddp(DistillationLoss(policy)), processes.wrap_ddp(GoalLoss(goals))
    realism_loss = processes.wrap_ddp(DiscriminatorLoss(discriminator))
    optimizers = {name: torch.optim.Adam(network.parameters()) for name, network in agent.modules.items()}

    # The order of updates.
    def update(step: int) -> Updates:
        items, observation = data.draw(config.segments, rng), observation_of(spec, discriminator=False)
        yield "search", replay.refresh(step)
        yield "discriminator", realism_loss(replay.both_kinds(rng))
        experts = data.sample_states(items, config.states, observation, rng, env.device, config.perturb.at(step))
        rollouts = replay.survivors(config.search.states, rng, observation)
        yield "policy", policy_loss(with_survivors(experts, rollouts))
        yield "goals", goal_loss(data.sample_goals(items, GOALS, observation, rng, env.device))

    rates = cosine(config.rates(optimizers), config.steps, goals=data.goal_updates(config.steps, processes.count))
    phases = [Phase(config.steps, update, rates)]
    return Trainer(config, agent, data, phases, optimizers, rng, processes, replay)


if __name__ == "__main__":
    from symphony.cli.recipe import main

    main(bc_ts_h, __doc__)
