"""Adversarial imitation with a beam search in an environment of TorchRL's own: python examples/gail_pendulum.py

A pendulum learns to swing up from an expert's states, without its actions and without a reward: a discriminator
learns to tell the two apart, a search drops the branches that it sees through, the policy learns what survived.
Measured once: in 60 searches the policy's cost per step falls from 6.3 to 2.0, the expert's is 1.5.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import PendulumEnv
from torchrl.modules import MLP, ProbabilisticActor

from symphony.collectors import BeamSearchCollector, KeyScore, Systematic, mean_then_sum, with_rows
from symphony.objectives import BCLoss, DiscriminatorLoss

STATE, STEPS = ["th", "thdot"], 100


class Net(nn.Sequential):
    """Layers on angle and speed [*b]."""

    def forward(self, angle: Tensor, speed: Tensor) -> Tensor:
        """Return the outputs [*b, K]."""
        return super().forward(torch.stack([angle.cos(), angle.sin(), speed / 8], -1))


def torques(loc: Tensor, scale: Tensor) -> Independent:
    """Return a normal distribution around torques of at most 2, the largest possible."""
    return Independent(Normal(2 * loc.tanh(), scale), 1)


def expert(td: TensorDictBase) -> TensorDictBase:
    """Swing up by pumping energy, and balance near the top."""
    angle, speed = td["th"], td["thdot"]
    energy = speed**2 / 6 + 5 * (angle.cos() - 1)
    torque = torch.where(angle.abs() < 0.4, -10 * angle - 3 * speed, -3 * energy * speed.sign())
    return td.set("action", torque.clamp(-2, 2)[..., None])


@torch.no_grad()
def drive(policy) -> TensorDictBase:
    """Return rollouts [64, T] of a policy."""
    return with_rows(PendulumEnv(), [64]).rollout(STEPS, policy, break_when_any_done=False)


def main(iterations: int = 60, rows: int = 16, branches: int = 16, updates: int = 16) -> list[float]:
    """Print and return costs per step without search: the expert's, the policy's before and while it learns."""
    torch.manual_seed(0)
    heads = TensorDictModule(Net(MLP(3, 2, num_cells=[64, 64]), NormalParamExtractor()), STATE, ["loc", "scale"])
    actor = ProbabilisticActor(heads, ["loc", "scale"], distribution_class=torques)
    discriminator = TensorDictModule(Net(MLP(3, 1, num_cells=[64, 64]), nn.Flatten(-2)), STATE, ["score"])
    collector = BeamSearchCollector(
        with_rows(PendulumEnv(), [rows]),
        actor,
        score=KeyScore("score", discriminator),
        branches=branches,
        leaves=branches,
        keep_tree=True,  # the discriminator also learns from what was dropped
        prune_every=5,
        rule=Systematic(0.2),
        aggregate=mean_then_sum,
        frames_per_batch=rows * branches * STEPS,
        total_frames=iterations * rows * branches * STEPS,
    )
    policy_loss, discriminator_loss = BCLoss(actor), DiscriminatorLoss(discriminator, gradient_penalty=0.1)
    policy_loss.set_keys(action="action")
    discriminator_loss.set_keys(score="score", simulated="simulated")
    optimizer = torch.optim.Adam([*actor.parameters(), *discriminator.parameters()], lr=5e-3)
    logged, simulated, survivors = (
        TensorDictReplayBuffer(storage=LazyTensorStorage(256_000), batch_size=512) for _ in range(3)
    )
    logged.extend(drive(expert).select(*STATE).flatten())
    costs = [-float(drive(policy)["next", "reward"].mean()) for policy in (expert, actor)]
    print(f"cost per step: expert {costs[0]:.2f}, at first {costs[1]:.2f}")
    for iteration, batch in enumerate(collector, 1):
        simulated.extend(batch["tree"].select(*STATE).flatten())
        survivors.extend(batch.select(*STATE, "action").flatten())
        for _ in range(updates):
            both = torch.cat([simulated.sample(), logged.sample()])
            both["simulated"] = torch.arange(len(both)) < len(both) // 2
            losses = discriminator_loss(both).update(policy_loss(survivors.sample()))
            optimizer.zero_grad()
            (losses["loss_discriminator"] + losses["loss_bc"]).backward()
            optimizer.step()
        if iteration % max(1, iterations // 6) == 0:
            costs.append(-float(drive(actor)["next", "reward"].mean()))
            print(f"after {iteration} searches {costs[-1]:.2f}; AUC of the discriminator {losses['auc']:.2f}")
    return costs


if __name__ == "__main__":
    main()
