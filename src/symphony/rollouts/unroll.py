"""Closed-loop simulation, keeping only what is read afterwards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.envs import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from symphony import keys
from symphony.envs.driving import NO_ROUTES, DrivingEnv
from symphony.envs.objects import rollout_heights
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError, SymphonyError
from symphony.geometry.nearest import on_host
from symphony.metrics import collisions
from symphony.modules import drawn_goals, inverse_cdf
from symphony.streams import Stream, fold_in, uniform

_WORLD = 1 << 22
"""Agents times states of scenes that are processed together."""
_NEVER = 1 << 30


class Rollouts(NamedTuple):
    """Rollouts of the interactive agents: states x, y, heading, speed, the first one included; flags, after each of T
    steps, of collisions (see :func:`between_states` for those between states) and of being off the road; and which
    steps are evaluated: those of real agents while they are present, up to the segment's last logged step.
    """

    state: Float[Tensor, "*b T+1 N 4"]
    collision: Bool[Tensor, "*b T N"]
    offroad: Bool[Tensor, "*b T N"]
    counted: Bool[Tensor, "*b T N"]

    def cpu(self) -> Rollouts:
        """Return the rollouts on the CPU."""
        return Rollouts(*(part.cpu() for part in self))


@torch.no_grad()
def simulate(
    env: DrivingEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    start: TensorDictBase,
    steps: int | None = None,
) -> Rollouts:
    """Simulate a policy, which writes the actions, from a start state, and return states and flags.

    The start is made by :meth:`DrivingEnv.start`, in any batch shape. At least one step is simulated, by default all
    of the longest scene's log. Observations are not kept, as those of sixteen rollouts would take gigabytes.
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
    counted = _counted(env, start, torch.stack(there, -2))
    return Rollouts(torch.stack(states, -3), torch.stack(collisions, -2), torch.stack(offroads, -2), counted)


@torch.no_grad()
def draw_goals(
    env: DrivingEnv,
    goals: TensorDictModuleBase,
    start: TensorDictBase,
    seed: int,
    tree: Int[Tensor, "*b"],
    temperature: Float[Tensor, "*b"] | None = None,
) -> Int[Tensor, "*b N"]:
    """Return the route [..., N] that the goal policy draws for each agent from a start state, -1 for none; ``tree``
    is the number of the draw within its scene, and a ``temperature`` above 1 makes unlikely routes more likely.

    In open traffic, later agents draw as if all were there already; past the log, where that is unknown, as if alone.
    """
    noise = _drawn(env, start.get(keys.SCENE), seed, Stream.GOALS, tree)

    def drawn(state: TensorDictBase) -> Tensor:
        seen = env.choices(state).set(keys.GOAL_NOISE, noise)
        with set_exploration_type(ExplorationType.RANDOM):
            seen = goals(seen)
        goal, mask = seen.get(keys.GOAL), seen.get(keys.ROUTES_MASK)
        if temperature is not None:
            logits = seen.get(keys.GOAL_LOGITS)
            goal = inverse_cdf(torch.where(mask, logits / temperature[..., None, None], logits), noise)
        return drawn_goals(goal, mask)

    found, waiting = drawn(start), start.get(keys.WAITING, None)
    if waiting is None:
        return found
    late = (env.scenes.enter > env.scenes.log_end[:, None])[start.get(keys.SCENE).squeeze(-1)]
    for which in (waiting & ~late, late)[: 1 + env.past_log]:
        there = env.at(start.copy().set(keys.VALID, start.get(keys.VALID) | which))
        if which is late and keys.OBJECTS_MASK in there.keys(True):
            there.set(keys.OBJECTS_MASK, torch.zeros_like(there.get(keys.OBJECTS_MASK)))
        found = torch.where(which, drawn(there), found)
    return found


class RouteGoals(Transform):
    """Gives agents the routes that they follow at every reset of a :class:`DrivingEnv`: the first of its transforms.

    Agents that follow one already, as in a state that was reset to, keep it.

    Args:
        goals: a goal policy, such as an agent's ``goals``, or another module that reads ``ROUTES`` and
            ``ROUTES_MASK`` and writes ``GOAL``; by default agents follow the routes nearest to the log.
        seed: the seed of the draws, beside the rollout's identity.

    Raises:
        ConfigError: on reset, if the scenes come without routes.
    """

    def __init__(self, goals: TensorDictModuleBase | None = None, *, seed: int = 0) -> None:
        super().__init__()
        self.goals, self.seed = goals, seed

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        env, found = self.parent, tensordict_reset
        if not getattr(env.source, "routes", env.scenes.route_first.shape[-1]):
            raise ConfigError(NO_ROUTES)
        tree = found.get(keys.STREAM).squeeze(-1)
        goal = None if self.goals is None else draw_goals(env, self.goals, found, self.seed, tree)
        given = env.with_goals(found, goal)
        new = (found.get(keys.STEP).squeeze(-1) == 0) & (found.get(keys.GOAL) < 0).all(-1)
        return found.update(torch.where(new, given, found.select(*given.keys(True, True))))


def _drawn(
    env: DrivingEnv, scene: Int[Tensor, "*b 1"], seed: int, use: Stream, number: Int[Tensor, "*b"]
) -> Float[Tensor, "*b N"]:
    """Return a number for each agent, of a use and a draw within the scene."""
    stream = fold_in(fold_in(env.scenes.stream[scene], use), number[..., None])
    return uniform(seed, fold_in(stream, torch.arange(env.num_agents, device=scene.device)), 0)


def start_states(
    env: DrivingEnv,
    goals: TensorDictModuleBase | None,
    *,
    trees: int,
    branches: int,
    seed: int,
    logged_goals: bool = False,
    goals_per: Literal["tree", "branch"] = "tree",
    fix: Callable[[Tensor, Tensor], Tensor] = lambda scene, goal: goal,
) -> TensorDictBase:
    """Return first states [B, trees, branches] of all scenes, observed once they have their goals.

    Goals are drawn by the goal policy, if there is one, or nearest to the log: once for a tree (paper, III-B),
    or for each branch. ``fix`` gives those that agents follow, from rows [*b] of the scenes and these goals [*b, N].
    """
    device, shape = env.scenes.device, (len(env.scenes), trees, branches)
    scene = torch.arange(shape[0], device=device)[:, None, None].expand(shape)
    number = torch.arange(trees * branches, device=device).reshape(trees, branches).expand(shape)
    goal = torch.full((*shape, env.num_agents), -1, device=device)
    if goals is not None and logged_goals:
        goal = env.scenes.route_logged[scene]
    elif goals is not None and goals_per == "branch":
        goal = draw_goals(env, goals, env.start(scene, number), seed, number)
    elif goals is not None:
        # Chosen once, by what the first branch of each tree observes.
        tree = torch.arange(trees, device=device).expand(shape[:2])
        drawn = draw_goals(env, goals, env.start(scene[..., 0], number[..., 0]), seed, tree)
        goal = drawn[:, :, None].expand(*shape, -1)
    return env.start(scene, number, fix(scene, goal))


def rollouts_of(env: DrivingEnv, start: TensorDictBase, trajectories: TensorDictBase) -> Rollouts:
    """Return the rollouts that the evaluator reads, from leaves [..., L, T] of a search from ``start`` [..., S]."""
    start, after = start[..., : trajectories.shape[-2]], trajectories.get("next")
    state = torch.cat([start.get(keys.STATE)[..., None, :, :], after.get(keys.STATE)], -3)
    collision, offroad = (after.get(key).squeeze(-1) for key in (keys.COLLISION, keys.OFFROAD))
    return Rollouts(state, collision, offroad, _counted(env, start, after.get(keys.VALID)))


def _counted(env: DrivingEnv, start: TensorDictBase, there: Tensor) -> Bool[Tensor, "*b T N"]:
    """Return the steps after which agents are present [..., T, N] and their scene still has steps."""
    step = start.get(keys.STEP) + torch.arange(1, there.shape[-2] + 1, device=start.device)
    return (step <= env.scenes.last_step[start.get(keys.SCENE)])[..., None] & there


def existing(scenes: SceneBatch, rollouts: Rollouts) -> Bool[Tensor, "B K T+1 N"]:
    """Return which driven agents of rollouts [B, K, ...] are present at each state."""
    first = (scenes.interactive_valid & (scenes.enter == 0))[:, None, None]
    return torch.cat([first.expand(-1, rollouts.counted.shape[1], 1, -1), rollouts.counted], -2)


def between_states(
    scenes: SceneBatch, state: Float[Tensor, "B K T+1 N 4"], there: Bool[Tensor, "B K T+1 N"]
) -> Bool[Tensor, "B K T N"]:
    """Return whether the box of each driven agent, where it is present, overlaps another's at some time of each step
    (see :func:`symphony.metrics.collisions`), among all others of its scene as they were driven or logged.
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
        size, at = scenes.box_size[part, None], None if level is None else pose[..., 3:]
        found.append(collisions(pose[..., :2], pose[..., 2], size, seen, subject[part, None], at))
    return torch.cat(found).transpose(2, 3) & there[:, :, 1:]


class NotFiniteError(SymphonyError):
    """A network returned a number that is not finite, which would silently decide comparisons. The error names the
    row of the scenes, the step and the agent (the ego is 0) where that happened first.
    """

    def __init__(self, what: str, row: int, step: int, agent: int, name: str = "") -> None:
        super().__init__(what, row, step, agent, name)
        self.row = row

    def __str__(self) -> str:
        what, _, step, agent, name = self.args
        where = f"segment {name}: " if name else ""
        return f"{where}the {what} put out a number that is not finite for agent {agent} at step {step}"

    def named(self, segment: str) -> NotFiniteError:
        """Return the same error, with the segment's name."""
        what, row, step, agent, _ = self.args
        return NotFiniteError(what, row, step, agent, segment)


class NaNGuard(TensorDictModuleBase):
    """Wraps a module and remembers for each scene when a guarded entry [*b, N, ...] that it wrote was first not
    finite for a valid agent. :meth:`check` reads that once, at the end, so that no step waits for the device. With
    ``scores`` the last state of a scene counts, too; past a scene's end there is only padding.
    """

    def __init__(
        self, env: DrivingEnv, module: TensorDictModuleBase, guarded: Sequence[keys.Key], what: str,
        *, scores: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        self.env, self.module, self.guarded, self.what, self.scores = env, module, guarded, what, scores
        self.in_keys, self.out_keys = module.in_keys, module.out_keys
        # Of each scene the first step and the first agent of it, as one number.
        self._first = torch.full((len(env.scenes),), _NEVER, device=env.scenes.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Call the module."""
        out = self.module(tensordict)
        for key in self.guarded:
            value = out.get(key, None)
            if value is not None and value.is_floating_point():
                self._see(out, value)
        return out

    def _see(self, tensordict: TensorDictBase, value: Tensor) -> None:
        if on_host(value) and bool(value.sum().isfinite()):
            return  # a sum of numbers one of which is not finite isn't either
        valid = tensordict.get(keys.VALID)
        wrong = valid & ~value.isfinite().reshape(*valid.shape, -1).all(-1)
        scene, step = tensordict.get(keys.SCENE).squeeze(-1), tensordict.get(keys.STEP).squeeze(-1)
        bad = wrong.any(-1) & (step < self.env.scenes.last_step[scene] + self.scores)
        step = torch.where(bad, step * self.env.num_agents + wrong.int().argmax(-1), _NEVER)
        self._first = self._first.scatter_reduce(0, scene.flatten(), step.flatten(), "amin")

    def check(self) -> None:
        """Raise NotFiniteError for the first scene in which something was not finite."""
        for row in (self._first < _NEVER).nonzero()[:1].flatten().tolist():
            raise NotFiniteError(self.what, row, *divmod(int(self._first[row]), self.env.num_agents))
