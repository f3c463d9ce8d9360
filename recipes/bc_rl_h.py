"""Behavioural cloning with goals, and a policy gradient against collisions in closed loop: not in the paper.

It is for an agent that drives already (`--warm-start`). The included one had 8 branches with goals of their own.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential

from symphony import DistillationLoss, DrivingEnv, GoalLoss, SegmentStore, TrainConfig
from symphony.agents import Agent, bicycle, goal_network, observation_of, policy_network
from symphony.collectors import BeamSearchCollector, KeepAll, with_rows
from symphony.learning import GOALS, SceneDataset, SearchReplay, with_survivors
from symphony.modules import SeededNoise
from symphony.rollouts.search import collector_settings, realism_score, with_drawn_goals
from symphony.training import Phase, Processes, Trainer, Updates, cosine


def bc_rl_h(config: TrainConfig, processes: Processes) -> Trainer:
    """Imitate the log, and make what led to collisions and off the road less likely than what did not."""
    torch.manual_seed(config.seed)
    seed, rng, dynamics = processes.seed(config.seed), torch.Generator(), bicycle(config.agent)
    data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=True, **config.scenes)

    # Networks.
    spec = config.spec("bicycle", data.dt, goals=True)
    policy, goals = policy_network(spec), goal_network(spec)
    agent = Agent(str(config.out), policy, spec, goals).to(processes.device)

    # Environment and collector: nothing is pruned.
    env = DrivingEnv(data, dynamics, observation_of(spec), generator=rng, device=processes.device)
    rows = config.rows(len(data))
    collector = BeamSearchCollector(
        with_rows(env, [rows]),
        TensorDictSequential(SeededNoise(seed, dynamics.numbers), policy),
        score=realism_score(env, None, score="flags"),
        prepare=lambda start: with_drawn_goals(env, goals, start, seed, config.search.goals),
        **collector_settings(config.search, env, seed, data, rows, KeepAll()),
    )
    replay = SearchReplay(collector, env, data, config.search.updates, config.search.states, config.segments)

    # Losses and optimizers.
    policy_loss, goal_loss = processes.wrap_ddp(DistillationLoss(policy)), processes.wrap_ddp(GoalLoss(goals))
    optimizers = {name: torch.optim.Adam(network.parameters()) for name, network in agent.modules.items()}

    # The order of updates.
    def update(step: int) -> Updates:
        items, observation = data.draw(config.segments, rng), observation_of(spec)
        yield "search", replay.refresh(step)
        experts = data.sample_states(items, config.states, observation, rng, env.device, config.perturb.at(step))
        rollouts = replay.blamed(config.search.states, rng, observation)
        yield "policy", policy_loss(with_survivors(experts, rollouts))
        yield "goals", goal_loss(data.sample_goals(items, GOALS, observation, rng, env.device))

    rates = cosine(config.rates(optimizers), config.steps, goals=data.goal_updates(config.steps, processes.count))
    phases = [Phase(config.steps, update, rates)]
    return Trainer(config, agent, data, phases, optimizers, rng, processes, replay)


if __name__ == "__main__":
    from symphony.cli.recipe import main

    main(bc_rl_h, __doc__)
