"""Simulation of an agent on a batch of scenes, as it was trained or as a configuration says."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from symphony import keys
from symphony.agents import Agent
from symphony.agents.agent import SearchPlan
from symphony.collectors import Backtrack, BeamSearchResult, KeepAll, PruningRule
from symphony.config import EvaluateConfig
from symphony.config.evaluation import Compile, Search, SimulateConfig
from symphony.envs.dynamics import Bicycle, ConstantVelocity
from symphony.envs.flags import offroad_flags
from symphony.envs.scene import SceneBatch, with_few_steps
from symphony.errors import ConfigError
from symphony.learning.experts import logged, logged_heights
from symphony.metrics import collisions
from symphony.modules import SeededNoise
from symphony.planners.driver import EgoPlanners, EgoPolicy, PlannedEnv
from symphony.rollouts.background import CarFollower, constant_speed
from symphony.rollouts.search import COMPILER, going_back, no_value, pruning_rule, search
from symphony.rollouts.unroll import (
    NaNGuard,
    Rollouts,
    between_states,
    draw_goals,
    existing,
    rollouts_of,
    simulate,
    start_states,
)

RULES: dict[str, Any] = {"constant_velocity": constant_speed, "idm": CarFollower}
"""Rules that can drive background agents in place of the agent, or all agents (an agent's ``rule``)."""
FEW = 4  # branches of a tree beside a planner, at least
FIRST_TRIES = 3  # times that a line goes back less far than to its first state: see Backtrack


class Simulation(NamedTuple):
    """The result of a simulation.

    Attributes:
        rollouts: [B, K, ...].
        goal: [B, K, N] number of the route that each agent followed, -1 for none.
        search: the trees of which the rollouts are the leaves, [B, trees]; None without any.
        at_states: [B, K, T, N] collisions at states only, as the paper and WOSAC count them.
        steps: simulated for them, each of a rollout or branch.
        failed: per scene, why the planner of a rollout failed, by its number; its later steps don't count.
        meant: per scene, trajectories [K, P, T, H, 2] that its planners returned; None for none.
    """

    rollouts: Rollouts
    goal: Int[Tensor, "B K N"]
    search: BeamSearchResult | None
    at_states: Bool[Tensor, "B K T N"]
    steps: int = 0
    failed: tuple[dict[int, str], ...] = ()
    meant: tuple[Any, ...] = ()


def simulation(
    agent: Agent,
    scenes: SceneBatch,
    config: EvaluateConfig,
    *,
    keep_tree: bool = False,
    egos: Sequence[EgoPlanners] = (),
    given: Int[Tensor, "B N"] | None = None,
    toward: Callable[[PlannedEnv, TensorDictBase], Any] | None = None,
) -> Simulation:
    """Return K rollouts of every scene, and how they were made: of a search with the pruned branches, if asked for.

    ``egos`` plan the first agents of every scene, which no search scores; the agent drives the others. ``given`` are
    the numbers of the routes that agents are to follow, -1 where that is left open. ``toward`` makes, with the
    environment and the first states, a module of the policy whose ``value`` of states a search lowers, not a score.

    Raises:
        ConfigError: if the search needs a discriminator and the agent has none, the agent learned another time
            step or has no goals or discrete actions that could be changed, a planner can't be copied for a search, or
            another rule drives the others than the agent.
        NotFiniteError: if one of its networks puts out a number that is not finite.
    """
    _check_given(agent, config, given)
    given = None if given is None else given.to(scenes.route_logged.device)
    scenes, config = _ruled(agent, scenes, config, given) if agent.rule else (scenes, config)
    # Beside log playback there are only planners: any policy will do, as its actions are not used.
    policy = ConstantVelocity(Bicycle()) if agent.policy is None else agent.policy
    if agent.policy is None and int((scenes.interactive_valid & ~scenes.background).sum(1).amax()) > len(egos):
        raise ConfigError("beside log playback, every interactive agent must have a planner")
    agent.check_step(float(scenes.dt[0]))
    compiled, plan = config.compile == "yes", agent.plan(config)
    if egos and (plan.kind == "backtrack" or compiled):
        what = "so it can't go back: --search none or tree, and is not compiled: --compile no"
        raise ConfigError(f"a planner remembers what it saw, {what}")
    after = config.after_collision if isinstance(config, SimulateConfig) else "go-on"
    env = PlannedEnv(
        with_few_steps(scenes) if compiled else scenes, agent.dynamics, agent.observation, after_collision=after
    )
    searches = plan.kind not in ("none", "log")
    guard = NaNGuard(env, policy, [keys.LOGITS, keys.ACTION], "policy")
    network = None if agent.goals is None else NaNGuard(env, agent.goals, [keys.GOAL_LOGITS], "goal policy")
    asked = agent.discriminator if searches else None
    scorer = None if asked is None else NaNGuard(env, asked, [keys.SCORE], "discriminator", scores=True)
    goals = _Goals(env, network, scenes, config, given, len(egos))
    start = goals.start(plan)
    planned = EgoPolicy(env, egos, start, config.seed, CarFollower, forked=searches) if egos else None
    lure = None if toward is None else toward(env, start)
    actor = TensorDictSequential(guard, RULES[config.others](env)) if config.others in RULES else guard
    for module in (planned, lure):
        actor = actor if module is None else TensorDictSequential(actor, module)
    order = torch.arange(plan.taken, device=env.device).expand(len(scenes), plan.trees, -1)
    if searches or compiled:
        how: dict[str, Any] = {
            "planned": len(egos),
            "also": () if planned is None else (keys.PLANNER,),
            "keep_tree": keep_tree and plan.kind == "tree",
            "value": no_value if plan.kind == "none" else lure and lure.value,
            "compile_step": COMPILER if compiled else False,
        }
        made = _searched(env, actor, scorer, start, config, plan, goals, order, how)
    else:
        noise = SeededNoise(config.seed, env.dynamics.numbers, config.pace)
        found = simulate(env, TensorDictSequential(noise, actor), start)
        made = _Made(found, start, start.get(keys.GOAL), order, start.numel() * env.decisions)
    for module in (network, guard, scorer):
        if module is not None:
            module.check()
    rollouts = Rollouts(*(_branches(part, made.order).flatten(1, 2) for part in made.rollouts))
    goal = _branches(made.goal, made.order).flatten(1, 2)
    whole = Simulation(rollouts, goal, made.tree, rollouts.collision, made.steps)
    if planned is None:
        return whole
    return _without_failed(whole, planned, _branches(made.ends.get(keys.PLANNER), made.order).flatten(1, 2))


class _Goals(NamedTuple):
    """The goals of agents: drawn from a network, but for those that are given."""

    env: PlannedEnv
    network: NaNGuard | None
    scenes: SceneBatch
    config: EvaluateConfig
    given: Int[Tensor, "B N"] | None
    planned: int  # number of first agents that have a planner

    def start(self, plan: SearchPlan) -> TensorDictBase:
        """Return the first states [B, trees, S]."""
        return start_states(
            self.env,
            self.network,
            trees=plan.trees,
            branches=plan.branches,
            seed=self.config.seed,
            logged_goals=self.config.logged_goals,
            goals_per=plan.search.goals,
            fix=self.fixed,
        )

    def fixed(self, row: Int[Tensor, "*b"], goal: Int[Tensor, "*b N"]) -> Int[Tensor, "*b N"]:
        """Return drawn goals of some rows of the scenes, with those replaced that are fixed: agents with a planner,
        and background agents that the IDM drives, follow the routes of the log, others the goals given for them.
        """
        followed = self.scenes.route_logged[row]
        if self.given is not None:
            goal = torch.where(self.given[row] >= 0, self.given[row], goal)
        if self.config.others == "idm":
            goal = torch.where(self.scenes.background[row], followed, goal)
        # Scenes without routes have no number of one either.
        along = self.planned * bool(self.scenes.route_point.shape[1])
        return torch.cat([followed[..., :along], goal[..., along:]], -1)

    def renewed(self, state: TensorDictBase, attempt: Int[Tensor, " R"]) -> TensorDictBase:
        """Return first states of lines that went back, with other goals, unlikely ones where others failed."""
        if self.network is None or self.config.logged_goals:
            return state
        heat = (attempt - FIRST_TRIES).clamp_min(1)[:, None].float()
        stream = state.get(keys.STREAM).squeeze(-1)
        goal = draw_goals(self.env, self.network, state, self.config.seed, stream, heat)
        return self.env.with_goals(state, self.fixed(state.get(keys.SCENE).squeeze(-1), goal))


class _Made(NamedTuple):
    """All that was simulated [B, trees, S]: rollouts, their last states and goals; which of them count, in order
    [B, trees, K]; and the search, if they are leaves of trees.
    """

    rollouts: Rollouts
    ends: TensorDictBase
    goal: Int[Tensor, "B trees S N"]
    order: Int[Tensor, "B trees K"]
    steps: int
    tree: BeamSearchResult | None = None


def _searched(
    env: PlannedEnv,
    actor: TensorDictModuleBase,
    scorer: NaNGuard | None,
    start: TensorDictBase,
    config: EvaluateConfig,
    plan: SearchPlan,
    goals: _Goals,
    order: Int[Tensor, "B trees K"],
    how: dict[str, Any],
) -> _Made:
    """Simulate by a search, or by one that prunes nothing, for a step that is compiled."""
    rule: PruningRule | Backtrack = KeepAll() if plan.kind == "none" else pruning_rule(plan.search)
    if plan.kind == "backtrack":
        rule = going_back(env, plan.search.threshold, start, goals.renewed)
    about: dict[str, Any] = {"prune_every": plan.search.prune_every, "score": plan.search.score, "leaves": plan.taken}
    with torch.no_grad():
        result = search(env, actor, scorer, start, seed=config.seed, pace=config.pace, rule=rule, **about, **how)
    ends = result.trajectories[..., -1]  # a copy of a branch follows the goals of its parent
    found, goal = rollouts_of(env, start, result.trajectories), ends.get(keys.GOAL)
    if plan.kind == "backtrack":
        # So far each line is a tree of one branch. As branches of one tree, good lines can replace bad ones.
        begun = result.alive.squeeze(-2)[..., :: result.prune_every]
        # What follows an end is never bad.
        totals = torch.where(begun, result.totals.squeeze(-1), -torch.inf)
        order = filled_lines(totals, plan.search.threshold)[:, None]
        found, goal = Rollouts(*(part.transpose(1, 2) for part in found)), goal.transpose(1, 2)
    return _Made(found, ends, goal, order, result.simulated_steps, result if plan.kind == "tree" else None)


def simulate_batch(agent: Agent, scenes: SceneBatch, config: EvaluateConfig, **how: Any) -> Simulation:
    """Return a :func:`playback` or :func:`simulation`, whose arguments these are, with collisions between states."""
    if agent.policy is not None or how.get("egos"):
        found = simulation(agent, scenes, config, **how)
        between = between_states(scenes, found.rollouts.state, existing(scenes, found.rollouts))
        return found._replace(rollouts=found.rollouts._replace(collision=between))
    _check_given(agent, config, how.get("given"))
    log = playback(scenes)
    at_states = _logged_collisions(scenes, at_states=True)[:, None, 1:]
    return Simulation(log, torch.full_like(log.state[:, :, 0, :, 0], -1, dtype=torch.int64), None, at_states)


def _ruled(
    agent: Agent, scenes: SceneBatch, config: EvaluateConfig, given: Int[Tensor, "B N"] | None
) -> tuple[SceneBatch, EvaluateConfig]:
    """Return scenes and settings in which the agent's rule drives all, along the routes of the log unless given."""
    if config.others not in ("log", "learned", agent.rule):
        raise ConfigError(f"{agent.name} can't be simulated among others that '{config.others}' drives")
    ruled = scenes.clone(recurse=False)
    ruled.background = scenes.interactive_valid
    if given is not None:
        ruled.route_logged = torch.where(given >= 0, given, scenes.route_logged)
    return ruled, dataclasses.replace(config, others=agent.rule or config.others)


def _check_given(agent: Agent, config: EvaluateConfig, given: Int[Tensor, "B N"] | None) -> None:
    if config.pace and agent.spec is None:
        raise ConfigError(f"{agent.name} is no learned agent, so a pace has no effect")
    if given is not None and agent.goals is None and not agent.rule and bool((given >= 0).any()):
        raise ConfigError(f"{agent.name} follows no goals, so a given one has no effect")


def _without_failed(found: Simulation, planned: EgoPolicy, number: Tensor) -> Simulation:
    """Return a simulation without the steps after a planner failed, given the numbers [B, K, P] of the planners."""
    each, steps = [planned.failures(row) for row in number], found.rollouts.counted.shape[-2]
    until = [[steps if one is None else one.step for one in row] for row in each]
    going = torch.arange(steps, device=number.device) < torch.tensor(until, device=number.device)[..., None]
    failed = tuple({k: one.reason for k, one in enumerate(row) if one is not None} for row in each)
    kept = found.rollouts._replace(counted=found.rollouts.counted & going[..., None])
    meant = tuple(planned.meant(row, steps) for row in number)
    return found._replace(rollouts=kept, failed=failed, meant=meant)


def beside_planner(config: EvaluateConfig) -> EvaluateConfig:
    """Return the configuration for a simulation with a planner of the ego. There is no search unless asked for,
    as every branch calls the planner; if so, trees have few branches, all of which count, given enough rollouts.
    """
    kind: Search = "tree" if config.branches or config.trees > 1 else "none"
    compiled: Compile = "no" if config.compile == "auto" else config.compile
    asked, trees, branches = kind if config.search == "agent" else config.search, config.trees, config.branches
    if asked == "tree" and not branches:
        most = max(config.rollouts // FEW, 1) if trees == 1 else trees
        trees = next(count for count in range(most, 0, -1) if config.rollouts % count == 0)
        branches = max(config.rollouts // trees, FEW)
    return dataclasses.replace(config, search=asked, compile=compiled, trees=trees, branches=branches)


def spread_runs(
    agent: Agent, config: EvaluateConfig, runs: int, segments: int, *, planned: bool = False
) -> tuple[int, EvaluateConfig]:
    """Return how many run segments give ``runs`` runs together (a few more if they can't be divided), and the
    configuration with the rollouts of each: as few as possible, since segments are the independent samples. Where
    branches call a planner, there are only as many trees, and so segments, as the runs need as leaves.
    """
    plan = agent.plan(dataclasses.replace(config, rollouts=config.trees))
    whole_trees = planned and plan.kind == "tree"
    if whole_trees:
        leaves = plan.branches * max(config.trees, -(-runs // (plan.branches * segments)))
        segments = -(-runs // leaves)
    least = -(-runs // segments)

    def whole(each: int) -> tuple[int, int]:
        """Return at least ``each`` rollouts, as many of each tree, and how many trees that takes."""
        trees = max(config.trees, -(-each // plan.branches)) if plan.kind == "tree" else 1
        return -(-each // trees) * trees, trees

    most = leaves + 1 if whole_trees else min(runs + 1, 2 * least)
    exact = (each for each in range(least, most) if runs % each == 0)
    each, trees = whole(next((each for each in exact if whole(each)[0] == each), least))
    return min(segments, -(-runs // each)), dataclasses.replace(config, rollouts=each, trees=trees)


def filled_lines(totals: Float[Tensor, "B K P"], threshold: float) -> Int[Tensor, "B K"]:
    """Return which line fills each place after backtracking. A line stayed bad if the total of some period is above
    the threshold; good lines of its scene take its place, in turn. Without a good one all lines stay in their places.
    """
    good = (totals <= threshold).all(-1)
    count, place = good.sum(-1, keepdim=True), torch.arange(good.shape[-1], device=good.device)
    good_first = (~good).to(torch.int8).argsort(dim=-1, stable=True)
    turn = ((~good).cumsum(-1) - 1) % count.clamp_min(1)
    return torch.where(good | (count == 0), place, good_first.gather(-1, turn.clamp_min(0)))


def _branches(part: Tensor, order: Tensor) -> Tensor:
    return part.take_along_dim(order.reshape(*order.shape, *(1,) * (part.ndim - 3)), 2)


def playback(scenes: SceneBatch) -> Rollouts:
    """Return the log itself as one rollout per scene [B, 1, ...], counted where it is valid."""
    log, valid = logged(scenes)
    row, height = torch.arange(len(scenes), device=log.device), logged_heights(scenes)
    height = None if height is None else height.flatten(1, 2)
    off = offroad_flags(scenes, row, log[..., :2].flatten(1, 2), height=height).view(valid.shape) & valid
    return Rollouts(log[:, None], _logged_collisions(scenes)[:, None], off[:, None, 1:], valid[:, None, 1:])


def _logged_collisions(scenes: SceneBatch, *, at_states: bool = False) -> Bool[Tensor, "B T N"]:
    """Return :func:`symphony.metrics.collisions` of the log; what an absent agent does is no collision."""
    moves, valid = scenes.log_state.transpose(1, 2), scenes.log_valid.transpose(1, 2)
    subject = torch.where(scenes.interactive_valid, scenes.interactive, -1)
    height = scenes.agent_height.transpose(1, 2) if scenes.agent_height.shape[1] else None
    where, size = (moves[..., :2], moves[..., 2]), scenes.box_size
    return collisions(*where, size, valid, subject, height, at_states=at_states).transpose(1, 2)
