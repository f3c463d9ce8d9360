"""Closed-loop simulation, keeping only what is read afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from symphony import keys
from symphony.envs.driving import DrivingEnv
from symphony.envs.objects import rollout_heights
from symphony.envs.scene import SceneBatch
from symphony.metrics import collisions
from symphony.modules import drawn_goals
from symphony.streams import Stream, fold_in, uniform

_WORLD = 1 << 22
"""Agents times states of scenes that are looked at together."""


class Rollouts(NamedTuple):
    """Rollouts of the interactive agents over T simulated steps, after the first state.

    Attributes:
        state: [..., T + 1, N, 4] x, y, heading, speed, the first state included.
        collision: [..., T, N]; see :func:`between_states` for what is found between states.
        offroad: [..., T, N].
        counted: [..., T, N] steps that are evaluated: of real agents while they are there, up to the segment's last
            logged step.
    """

    state: Float[Tensor, "*b T+1 N 4"]
    collision: Bool[Tensor, "*b T N"]
    offroad: Bool[Tensor, "*b T N"]
    counted: Bool[Tensor, "*b T N"]

    def cpu(self) -> Rollouts:
        """The rollouts on the CPU."""
        return Rollouts(*(part.cpu() for part in self))


@torch.no_grad()
def simulate(
    env: DrivingEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    start: TensorDictBase,
    steps: int | None = None,
) -> Rollouts:
    """Roll a policy out from a start state.

    Only states and flags are kept: the observations of sixteen rollouts would take gigabytes.

    Args:
        env: the environment.
        policy: writes the action into the TensorDict it is given.
        start: as returned by :meth:`DrivingEnv.start`, any batch shape.
        steps: decisions; by default up to the last logged step of the longest scene.
    """
    steps = env.decisions if steps is None else steps
    now, states, collisions, offroads, there = start, [start.get(keys.STATE)], [], [], []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(steps):
            now = step_mdp(env.step(policy(now)), exclude_reward=True)
            states.append(now.get(keys.STATE))
            collisions.append(now.get(keys.COLLISION).squeeze(-1))
            offroads.append(now.get(keys.OFFROAD).squeeze(-1))
            there.append(now.get(keys.VALID))
    return Rollouts(
        torch.stack(states, -3),
        torch.stack(collisions, -2),
        torch.stack(offroads, -2),
        counted_steps(env, start, torch.stack(there, -2)),
    )


@torch.no_grad()
def draw_goals(
    env: DrivingEnv,
    goals: TensorDictModuleBase,
    start: TensorDictBase,
    seed: int,
    tree: Int[Tensor, "*b"],
) -> Int[Tensor, "*b N"]:
    """The route [..., N] each agent follows from a start state, -1 for none.

    In open traffic, agents that enter later draw as if all of them were there already.

    Args:
        env: the environment.
        goals: the goal policy.
        start: [...], one entry per draw.
        seed: of the draw.
        tree: [...] number of the draw within its scene, so that it is the same whatever the batch.
    """
    stream = fold_in(fold_in(env.scenes.stream[start.get(keys.SCENE)], Stream.GOALS), tree[..., None])
    noise = uniform(seed, fold_in(stream, torch.arange(env.num_agents, device=start.device)), 0)

    def drawn(state: TensorDictBase) -> Tensor:
        seen = env.choices(state).set(keys.GOAL_NOISE, noise)
        with set_exploration_type(ExplorationType.RANDOM):
            seen = goals(seen)
        return drawn_goals(seen.get(keys.GOAL), seen.get(keys.ROUTES_MASK))

    found, waiting = drawn(start), start.get(keys.WAITING, None)
    if waiting is None:
        return found
    everyone = env.at(start.copy().set(keys.VALID, start.get(keys.VALID) | waiting))
    return torch.where(waiting, drawn(everyone), found)


def draw_personas(
    env: DrivingEnv,
    personas: Float[Tensor, "M 2"],
    scene: Int[Tensor, "*b"],
    seed: int,
    number: Int[Tensor, "*b"],
) -> Float[Tensor, "*b N 2"]:
    """The style in which each agent drives from a start state on.

    Args:
        env: the environment.
        personas: to draw from, equally likely.
        scene: rows of the scene batch, one per draw.
        seed: of the draw.
        number: [...] of the draw within its scene.
    """
    stream = fold_in(fold_in(env.scenes.stream[scene], Stream.PERSONAS), number)[..., None]
    share = uniform(seed, fold_in(stream, torch.arange(env.num_agents, device=scene.device)), 0)
    return personas[(share * len(personas)).long()]


def start_states(
    env: DrivingEnv,
    goals: TensorDictModuleBase | None,
    *,
    trees: int,
    branches: int,
    seed: int,
    logged_goals: bool = False,
    goals_per: Literal["tree", "branch"] = "tree",
    personas: Float[Tensor, "M 2"] | None = None,
    fix: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> TensorDictBase:
    """First states [B, trees, branches] of all scenes, observed once they have their goals and personas.

    Args:
        env: the environment.
        goals: the goal policy; None for agents that follow none.
        trees: per scene.
        branches: per tree.
        seed: of the goals.
        logged_goals: take the routes nearest to the log instead.
        goals_per: who draws goals, and personas, together: all branches of a tree (paper, section IV-B), or each
            branch alone.
        personas: that agents drive in, to draw from; None for agents without.
        fix: from rows of the scenes [*b] and goals [*b, N] to the goals that agents follow.
    """
    device, shape = env.scenes.device, (len(env.scenes), trees, branches)
    scene = torch.arange(len(env.scenes), device=device)[:, None, None].expand(shape)
    number = torch.arange(trees * branches, device=device).reshape(trees, branches).expand(shape)
    goal, persona = torch.full((*shape, env.num_agents), -1, device=device), None
    if personas is not None:
        first = number if goals_per == "branch" else number[..., :1].expand(shape)
        persona = draw_personas(env, personas, scene, seed, first)
    if goals is not None and logged_goals:
        goal = env.scenes.route_logged[scene]
    elif goals is not None and goals_per == "branch":
        goal = draw_goals(env, goals, env.start(scene, number, persona=persona), seed, number)
    elif goals is not None:
        # Chosen once, by what the first branch of each tree observes.
        styles = None if persona is None else persona[:, :, 0]
        tree = torch.arange(trees, device=device).expand(shape[:2])
        drawn = draw_goals(env, goals, env.start(scene[..., 0], number[..., 0], persona=styles), seed, tree)
        goal = drawn[:, :, None].expand(*shape, -1)
    if fix is not None:
        goal = fix(scene, goal)
    return env.start(scene, number, goal, persona)


def rollouts_of(env: DrivingEnv, start: TensorDictBase, trajectories: TensorDictBase) -> Rollouts:
    """The rollouts that the evaluator reads, from leaves [..., L, T] of a search from ``start`` [..., S], S >= L."""
    start = start[..., : trajectories.shape[-2]]
    state = torch.cat([start.get(keys.STATE)[..., None, :, :], trajectories.get(("next", *keys.STATE))], -3)
    collision, offroad = (
        trajectories.get(("next", *key)).squeeze(-1) for key in (keys.COLLISION, keys.OFFROAD)
    )
    there = trajectories.get(("next", *keys.VALID))
    return Rollouts(state, collision, offroad, counted_steps(env, start, there))


def counted_steps(
    env: DrivingEnv, start: TensorDictBase, there: Bool[Tensor, "*b T N"]
) -> Bool[Tensor, "*b T N"]:
    """The steps after which agents are there and their segment still has logged steps."""
    step = start.get(keys.STEP) + torch.arange(1, there.shape[-2] + 1, device=start.device)
    return (step <= env.scenes.last_step[start.get(keys.SCENE)])[..., None] & there


def existing(scenes: SceneBatch, rollouts: Rollouts) -> Bool[Tensor, "B K T+1 N"]:
    """Which driven agents of rollouts [B, K, ...] are there at each state."""
    first = (scenes.interactive_valid & (scenes.enter == 0))[:, None, None]
    return torch.cat([first.expand(-1, rollouts.counted.shape[1], 1, -1), rollouts.counted], -2)


def between_states(
    scenes: SceneBatch, state: Float[Tensor, "B K T+1 N 4"], there: Bool[Tensor, "B K T+1 N"]
) -> Bool[Tensor, "B K T N"]:
    """Whether the box of each driven agent overlaps another's on its level at some time of each step (see
    :func:`symphony.metrics.collisions`), among all others of its scene as they were driven or logged.

    Args:
        scenes: B scenes.
        state: of the driven agents.
        there: where they are.
    """
    steps, count = state.shape[2], scenes.log_state.shape[2]
    subject = torch.where(scenes.interactive_valid, scenes.interactive, -1)
    # Padding goes to a row more, which is dropped.
    column = torch.where(scenes.interactive_valid, scenes.interactive, count)
    each = max(1, _WORLD // max(1, state.shape[1] * steps * count))
    found = []
    for part in torch.arange(len(scenes), device=state.device).split(each):
        rollouts = (len(part), state.shape[1])
        moved, logged = state[part, ..., :3], scenes.log_state[part, :steps, :, :3]
        level = rollout_heights(scenes, state[part], part)
        if level is not None:
            moved = torch.cat([moved, level], -1)
            logged = torch.cat([logged, scenes.agent_height[part, :steps]], -1)
        pose = pad(logged[:, None].expand(*rollouts, -1, -1, -1), (0, 0, 0, 1))
        seen = pad(scenes.log_valid[part, None, :steps].expand(*rollouts, -1, -1), (0, 1))
        index = column[part, None, None].expand(*rollouts, steps, -1)
        pose = pose.scatter(-2, index[..., None].expand_as(moved), moved.to(pose.dtype))
        seen = seen.scatter(-1, index, there[part])
        pose, seen = pose[..., :count, :].transpose(2, 3), seen[..., :count].transpose(2, 3)
        size = scenes.box_size[part, None]
        at = None if level is None else pose[..., 3:]
        found.append(collisions(pose[..., :2], pose[..., 2], size, seen, subject[part, None], at))
    return torch.cat(found).transpose(2, 3) & there[:, :, 1:]
