"""Behavioural cloning: the row "BC" of the paper's tables (section II-B)."""

from __future__ import annotations

import torch

from symphony import BCLoss, SegmentStore, TrainConfig
from symphony.agents import Agent, bicycle, observation_of, policy_network
from symphony.learning import SceneDataset
from symphony.training import Phase, Processes, Trainer, Updates, cosine


def bc(config: TrainConfig, processes: Processes) -> Trainer:
    """Imitate the logged actions of every vehicle that moves or waits."""
    torch.manual_seed(config.seed)
    rng, device, dynamics = torch.Generator(), processes.device, bicycle(config.agent)
    data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=False, **config.scenes)

    # Networks.
    spec = config.spec("bicycle", data.dt)
    policy = policy_network(spec)
    agent = Agent(str(config.out), policy, spec).to(device)

    # Losses and optimizers.
    policy_loss = processes.wrap_ddp(BCLoss(policy))
    optimizers = {name: torch.optim.Adam(network.parameters()) for name, network in agent.modules.items()}

    # The order of updates.
    def update(step: int) -> Updates:
        items, observation = data.draw(config.segments, rng), observation_of(spec)
        experts = data.sample_states(items, config.states, observation, rng, device, config.perturb.at(step))
        yield "policy", policy_loss(experts)

    phases = [Phase(config.steps, update, cosine(config.rates(optimizers), config.steps))]
    return Trainer(config, agent, data, phases, optimizers, rng, processes)


if __name__ == "__main__":
    from symphony.cli.recipe import main

    main(bc, __doc__)
