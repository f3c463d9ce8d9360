"""Measure how much of what a policy does not explain of logged drivers lasts: the setting `--pace`.

    python benchmarks/pace.py pretrained:bc_ts_h --data town-small/validation

Where a logged acceleration lies in the policy's distribution is a number between 0 and 1, uniform if the policy is
right. As a normal score its variance has a part between drivers, the share that is printed, and one within them.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from symphony import SegmentStore, keys, load_agent
from symphony.agents import Agent
from symphony.envs.routes import RouteWindow
from symphony.learning import SceneDataset
from symphony.learning.demonstrations import DISPLACED
from symphony.learning.experts import expert_batch, logged_routes

LEAST, MOVING = 20, 1.0
"""Steps at which a driver moves (m/s) from which on it counts."""


def scores(agent: Agent, data: SceneDataset, item: int, rng: torch.Generator) -> list[Tensor]:
    """Return the normal scores [T] of the logged accelerations of each driver of a run segment while it moves."""
    (expert,), scenes = data.experts.many([item]), data.scenes([item])
    row, step = expert.valid.nonzero(as_tuple=True)
    state, action = expert.states[row, step], expert.actions[row, step].long()
    taken, come = logged_routes(list(expert.routes), row), expert.progress[row, step][:, None]
    seen = taken.window(taken.progress(state[:, None, :2], come, torch.full_like(come, DISPLACED)))
    at = torch.zeros_like(row), step, expert.agent[row], state
    batch = expert_batch(scenes, *at, agent.observation, action=action, routes=RouteWindow(*seen))
    batch.set(keys.NOISE, torch.full((len(row), 1), 0.5))
    with torch.no_grad():
        joint = agent.policy(batch).get(keys.LOGITS)[:, 0].softmax(-1)
    # Actions are sorted by acceleration, and each has as many angles.
    angles = agent.dynamics.num_steering
    mass, which = joint.unflatten(-1, (-1, angles)).sum(-1), (action // angles)[:, None]
    above = mass.cumsum(-1).gather(1, which) - mass.gather(1, which) * torch.rand(len(row), 1, generator=rng)
    score = torch.special.ndtri(above[:, 0].clamp(1e-4, 1 - 1e-4))
    drivers = [score[(row == k) & (state[:, 3] > MOVING)] for k in row.unique().tolist()]
    return [one for one in drivers if len(one) >= LEAST]


def lasting(drivers: list[Tensor]) -> float:
    """Return the share of the variance that is between drivers (the intraclass correlation, one-way, moments)."""
    count = torch.tensor([len(one) for one in drivers], dtype=torch.float64)
    mean = torch.stack([one.double().mean() for one in drivers])
    within = sum(float((one.double() - one.double().mean()).square().sum()) for one in drivers)
    within /= float(count.sum() - len(drivers))
    each = (count.sum() - count.square().sum() / count.sum()) / (len(drivers) - 1)
    spread = (count * (mean - (count * mean).sum() / count.sum()).square()).sum() / (len(drivers) - 1)
    between = float((spread - within) / each)
    return between / (between + within)


def main() -> None:
    """Print the share, and by how many steps apart scores are correlated."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agent")
    parser.add_argument("--data", required=True)
    parser.add_argument("--segments", type=int, default=60)
    given = parser.parse_args()
    agent, rng = load_agent(given.agent), torch.Generator().manual_seed(0)
    data = SceneDataset(SegmentStore(given.data), 2, agent.dynamics, routes=True)
    stride = max(1, len(data) // given.segments)
    drivers = [one for item in range(0, len(data), stride) for one in scores(agent, data, item, rng)]
    variance = torch.cat(drivers).var()
    print(f"{len(drivers)} drivers: {lasting(drivers):.2f} of the variance lasts")
    for lag in (1, 2, 5, 10, 15):
        products = torch.cat([one[:-lag] * one[lag:] for one in drivers])
        print(f"  {lag * data.dt:.1f} s apart: correlation {float(products.mean() / variance):.2f}")


if __name__ == "__main__":
    main()
