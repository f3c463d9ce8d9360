"""Behavioural cloning with goals: the row "BC+H" of the paper's tables (section III-B)."""

from __future__ import annotations

import torch

from symphony import BCLoss, GoalLoss, SegmentStore, TrainConfig
from symphony.agents import Agent, bicycle, goal_network, observation_of, policy_network
from symphony.learning import GOALS, SceneDataset
from symphony.training import Phase, Processes, Trainer, Updates, cosine


def bc_h(config: TrainConfig, processes: Processes) -> Trainer:
    """Imitate the logged actions given the route that was taken, and learn which routes are taken."""
    torch.manual_seed(config.seed)
    rng, device, dynamics = torch.Generator(), processes.device, bicycle(config.agent)
    data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=True, **config.scenes)

    # Networks.
    spec = config.spec("bicycle", data.dt, goals=True)
    policy, goals = policy_network(spec), goal_network(spec)
    agent = Agent(str(config.out), policy, spec, goals).to(device)

    # Losses and optimizers.
    policy_loss, goal_loss = processes.wrap_ddp(BCLoss(policy)), processes.wrap_ddp(GoalLoss(goals))
    optimizers = {name: torch.optim.Adam(network.parameters()) for name, network in agent.modules.items()}

    # The order of updates.
    def update(step: int) -> Updates:
        items, observation = data.draw(config.segments, rng), observation_of(spec)
        experts = data.sample_states(items, config.states, observation, rng, device, config.perturb.at(step))
        yield "policy", policy_loss(experts)
        yield "goals", goal_loss(data.sample_goals(items, GOALS, observation, rng, device))

    rates = cosine(config.rates(optimizers), config.steps, goals=data.goal_updates(config.steps, processes.count))
    phases = [Phase(config.steps, update, rates)]
    return Trainer(config, agent, data, phases, optimizers, rng, processes)


if __name__ == "__main__":
    from symphony.cli.recipe import main

    main(bc_h, __doc__)
