"""Behavioural cloning, and a policy gradient against collisions in closed loop: not in the paper.

It is for an agent that drives already (`--warm-start`). The included ones had `--search.branches 8`.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential

from symphony import DistillationLoss, DrivingEnv, SegmentStore, TrainConfig
from symphony.agents import Agent, bicycle, observation_of, policy_network
from symphony.collectors import BeamSearchCollector, KeepAll, with_rows
from symphony.learning import SceneDataset, SearchReplay, with_survivors
from symphony.modules import SeededNoise
from symphony.rollouts.search import branched_streams, collector_settings, realism_score
from symphony.training import Phase, Processes, Trainer, Updates, cosine


def bc_rl(config: TrainConfig, processes: Processes) -> Trainer:
    """Imitate the log, and make what led to collisions and off the road less likely than what did not."""
    torch.manual_seed(config.seed)
    seed, rng, dynamics = processes.seed(config.seed), torch.Generator(), bicycle(config.agent)
    data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=False, **config.scenes)

    # Networks.
    spec = config.spec("bicycle", data.dt)
    policy = policy_network(spec)
    agent = Agent(str(config.out), policy, spec).to(processes.device)

    # Environment and collector: nothing is pruned.
    env = DrivingEnv(data, dynamics, observation_of(spec), generator=rng, device=processes.device)
    rows = config.rows(len(data))
    collector = BeamSearchCollector(
        with_rows(env, [rows]),
        TensorDictSequential(SeededNoise(seed, dynamics.numbers), policy),
        score=realism_score(env, None, score="flags"),
        prepare=branched_streams,
        **collector_settings(config.search, env, seed, data, rows, KeepAll()),
    )
    replay = SearchReplay(collector, env, data, config.search.updates, config.search.states, config.segments)

    # Losses and optimizers.
    policy_loss = processes.wrap_ddp(DistillationLoss(policy))
    optimizers = {name: torch.optim.Adam(network.parameters()) for name, network in agent.modules.items()}

    # The order of updates.
    def update(step: int) -> Updates:
        items, observation = data.draw(config.segments, rng), observation_of(spec)
        yield "search", replay.refresh(step)
        experts = data.sample_states(items, config.states, observation, rng, env.device, config.perturb.at(step))
        rollouts = replay.blamed(config.search.states, rng, observation)
        yield "policy", policy_loss(with_survivors(experts, rollouts))

    phases = [Phase(config.steps, update, cosine(config.rates(optimizers), config.steps))]
    return Trainer(config, agent, data, phases, optimizers, rng, processes, replay)


if __name__ == "__main__":
    from symphony.cli.recipe import main

    main(bc_rl, __doc__)
