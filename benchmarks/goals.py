"""Learn the goal policy of an agent alone: its other networks are kept.

    python benchmarks/goals.py AGENT OUT --data DIR --validation DIR [DIR ...]

What the goal policy observes of all vehicles is computed once, so an update costs what the network costs. After every
pass over the data it prints, for each validation store, the loss and how often draws and logs change lanes (routes
with a change of lanes within 30 m). The run ``OUT`` has the weights with the smallest mean loss over these stores.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDict
from torch.nn.functional import pad

from symphony import GoalLoss, SegmentStore, keys
from symphony.agents import dynamics_of, goal_network, load_agent, observation_of
from symphony.agents.agent import Agent
from symphony.agents.checkpoint import save_checkpoint
from symphony.agents.choice import split_name
from symphony.learning import SceneDataset
from symphony.training import cosine

NEAR = 0.5  # of the last feature of a route: a change of lanes within 30 m


def first_states(agent: Agent, folder: Path) -> list[TensorDict]:
    """Return what the goal policy observes of all vehicles of each segment, with the routes that they took."""
    data = SceneDataset(SegmentStore(folder), dynamics=dynamics_of(agent.spec), routes=True, keep=64)
    observation, rng = observation_of(agent.spec), torch.Generator()
    seen, found = set(), []
    for item in range(len(data)):
        part = data.sample_goals([item], None, observation, rng)
        shown = torch.cat([part[keys.OWN], part[keys.ROUTES][:, :, 0]], -1).squeeze(1)
        rows = [(data.segment(item).group, *(100 * row).round().tolist()) for row in shown]
        # Segments of one recording may differ in the ego alone, and have the same vehicles.
        new = torch.tensor([row not in seen for row in rows])
        seen.update(rows)
        if new.any():
            found.append(part[new])
    print(folder, len(found), sum(map(len, found)), flush=True)
    return found


def together(parts: Sequence[TensorDict]) -> TensorDict:
    """Return the vehicles of several segments as one batch, padded to the most routes."""
    most, padded = max(part[keys.ROUTES].shape[2] for part in parts), []
    for each in parts:
        more, part = most - each[keys.ROUTES].shape[2], each.copy()
        part[keys.ROUTES] = pad(each[keys.ROUTES], (0, 0, 0, more))
        for name in (keys.ROUTES_MASK, keys.GOAL_SET):
            part[name] = pad(each[name], (0, more))
        padded.append(part)
    return torch.cat(padded)


@torch.no_grad()
def judged(agent: Agent, parts: Sequence[TensorDict]) -> dict[str, float]:
    """Return the loss, and how often draws and logs change lanes soon, in percent of vehicles that have routes."""
    loss, changes, logged, count = 0.0, 0.0, 0.0, 0
    for begin in range(0, len(parts), 64):
        batch = together(parts[begin : begin + 64])
        batch = batch[batch[keys.GOAL_SET].any(-1).squeeze(-1)]
        found = GoalLoss(agent.goals)(batch)
        share = agent.goals[0](batch.copy())[keys.GOAL_LOGITS].softmax(-1)
        soon = batch[keys.ROUTES][..., -1] >= NEAR
        loss += float(found["loss_goal"]) * len(batch)
        changes += float((share * soon).sum())
        logged += float(soon.take_along_dim(batch[keys.GOAL][..., None], -1).sum())
        count += len(batch)
    return {"loss": loss / count, "draws": 100 * changes / count, "log": 100 * logged / count}


def main() -> None:
    """Learn, print what was found after every pass, and write the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agent")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--validation", type=Path, nargs="+", required=True)
    parser.add_argument("--passes", type=int, default=30)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--decay", type=float, default=1e-4)
    parser.add_argument("--segments", type=int, default=32, help="run segments of an update")
    parser.add_argument("--fresh", action="store_true", help="forget what the agent's goal policy has learned")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.manual_seed(given.seed)
    agent, rng = load_agent(given.agent), torch.Generator().manual_seed(given.seed)
    if given.fresh:
        agent = replace(agent, goals=goal_network(agent.spec))
    agent.goals.requires_grad_(True)
    given.out.mkdir(parents=True)
    parts, shown = first_states(agent, given.data), {str(d): first_states(agent, d) for d in given.validation}
    updates = -(-len(parts) // given.segments)
    optimizer = torch.optim.AdamW(agent.goals.parameters(), weight_decay=given.decay)
    rates, loss = cosine({"goals": given.rate}, given.passes * updates), GoalLoss(agent.goals)
    best, kept, step = float("inf"), {}, 0
    for number in range(given.passes):
        total = 0.0
        for items in torch.randperm(len(parts), generator=rng).split(given.segments):
            optimizer.param_groups[0]["lr"] = rates(step)["goals"]
            found = loss(together([parts[i] for i in items.tolist()]))["loss_goal"]
            optimizer.zero_grad()
            found.backward()
            optimizer.step()
            total, step = total + float(found.detach()) / updates, step + 1
        each = {name: judged(agent, them) for name, them in shown.items()}
        found = {name: {k: round(v, 3) for k, v in e.items()} for name, e in each.items()}
        print(number + 1, f"{total:.4f}", json.dumps(found), flush=True)
        mean = sum(e["loss"] for e in each.values()) / len(each)
        if mean < best:
            best, kept = mean, deepcopy(agent.goals.state_dict())
    agent.goals.load_state_dict(kept)
    for file in ("config.json", "agent.json"):
        shutil.copy(split_name(given.agent)[0] / file, given.out / file)
    print(save_checkpoint(given.out / "checkpoints", step=step, modules=agent.modules))


if __name__ == "__main__":
    main()
