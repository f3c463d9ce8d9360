"""Behavioural cloning with tree search: the row "BC+TS" of the paper's tables (section III-A)."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential

from symphony import DiscriminatorLoss, DistillationLoss, DrivingEnv, SegmentStore, TrainConfig
from symphony.agents import Agent, bicycle, discriminator_network, observation_of, policy_network
from symphony.collectors import BeamSearchCollector, with_rows
from symphony.learning import SceneDataset, SearchReplay, with_survivors
from symphony.modules import SeededNoise
from symphony.rollouts.search import branched_streams, collector_settings, pruning_rule, realism_score
from symphony.training import Phase, Processes, Trainer, Updates, cosine


def bc_ts(config: TrainConfig, processes: Processes) -> Trainer:
    """Learn from the log, and from rollouts of a beam search that the discriminator prunes."""
    torch.manual_seed(config.seed)
    seed, rng, dynamics = processes.seed(config.seed), torch.Generator(), bicycle(config.agent)
    data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=False, **config.scenes)

    # Networks.
    spec = config.spec("bicycle", data.dt, discriminator=True, searches=True)
    policy, discriminator = policy_network(spec), discriminator_network(spec)
    agent = Agent(str(config.out), policy, spec, discriminator=discriminator).to(processes.device)

    # Environment and collector: the discriminator prunes branches of every segment.
    env = DrivingEnv(data, dynamics, observation_of(spec), generator=rng, device=processes.device)
    rows, rule = config.rows(len(data)), pruning_rule(config.search)
    collector = BeamSearchCollector(
        with_rows(env, [rows]),
        TensorDictSequential(SeededNoise(seed, dynamics.numbers), policy),
        score=realism_score(env, discriminator),
        prepare=branched_streams,
        **collector_settings(config.search, env, seed, data, rows, rule),
    )
    replay = SearchReplay(collector, env, data, config.search.updates, config.search.states, config.segments)

    # Losses and optimizers.
    policy_loss = processes.wrap_ddp(DistillationLoss(policy))
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

    phases = [Phase(config.steps, update, cosine(config.rates(optimizers), config.steps))]
    return Trainer(config, agent, data, phases, optimizers, rng, processes, replay)


if __name__ == "__main__":
    from symphony.cli.recipe import main

    main(bc_ts, __doc__)
