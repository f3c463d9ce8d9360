"""Adversarial imitation through the model with tree search and goals: the row "MGAIL+TS+H" of the paper's tables."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential

from symphony import BCLoss, DiscriminatorLoss, GoalLoss, MGAILLoss, SegmentStore, TrainConfig
from symphony.agents import Agent, discriminator_network, goal_network, observation_of, policy_network
from symphony.collectors import BeamSearchCollector, with_rows
from symphony.envs import Displacement, DrivingEnv
from symphony.learning import GOALS, SceneDataset, SearchReplay
from symphony.modules import SeededNoise
from symphony.rollouts.search import collector_settings, compiled, pruning_rule, realism_score, with_drawn_goals
from symphony.training import Phase, Processes, Trainer, Updates, cosine


def mgail_ts_h(config: TrainConfig, processes: Processes) -> Trainer:
    """Regress to the log, then follow the discriminator's gradient through survivors of a search; given routes."""
    torch.manual_seed(config.seed)
    seed, rng, dynamics = processes.seed(config.seed), torch.Generator(), Displacement()
    data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=True, **config.scenes)

    # Networks.
    spec = config.spec("displacement", data.dt, goals=True, discriminator=True, searches=True)
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
    regression_loss, goal_loss = processes.wrap_ddp(BCLoss(policy)), processes.wrap_ddp(GoalLoss(goals))
    mgail_loss = processes.wrap_ddp(MGAILLoss(policy, discriminator, env, **config.mgail.gradient, **compiled(data)))
    realism_loss = processes.wrap_ddp(DiscriminatorLoss(discriminator))
    optimizers = {name: torch.optim.Adam(network.parameters()) for name, network in agent.modules.items()}
    rates, last = config.rates(optimizers), data.goal_updates(config.steps, processes.count)
    seen, begin, device = observation_of(spec, discriminator=False), config.mgail.regression, processes.device

    # The order of updates, in three phases; goals are learned in all.
    def regression(step: int) -> Updates:
        items = data.draw(config.segments, rng)
        experts = data.sample_states(items, config.states, seen, rng, device, config.perturb.at(step))
        yield "policy", regression_loss(experts)
        yield "goals", goal_loss(data.sample_goals(items, GOALS, seen, rng, device))

    def head_start(step: int) -> Updates:
        yield "search", replay.refresh(step)
        for _ in range(config.mgail.discriminator_updates):
            yield "discriminator", realism_loss(replay.both_kinds(rng))
        items = data.draw(config.segments, rng)
        yield "goals", goal_loss(data.sample_goals(items, GOALS, seen, rng, device))

    def adversarial(step: int) -> Updates:
        yield from head_start(step)
        losses = mgail_loss(replay.repeatable(config.mgail.rollouts, rng))
        if config.mgail.expert_weight:
            losses["loss_regression"] = config.mgail.expert_weight * next(regression(step))[1]["loss_bc"]
        yield "policy", losses

    slower = cosine(rates | {"policy": config.mgail.learning_rate}, config.steps, begin, goals=last)
    first = Phase(begin, regression, cosine(rates, begin, goals=last))
    ready = Phase(begin + config.mgail.head_start, head_start, slower)
    phases = [first, ready, Phase(config.steps, adversarial, slower)]
    return Trainer(config, agent, data, phases, optimizers, rng, processes, replay)


if __name__ == "__main__":
    from symphony.cli.recipe import main

    main(mgail_ts_h, __doc__)
