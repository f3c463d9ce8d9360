"""The beam search as a planner: the next action, from the best of several simulated futures."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import MPCPlannerBase

from symphony.collectors.beam_search import Policy, beam_search, places
from symphony.collectors.branching import branch, branched_env, check_branching, parts_of, take
from symphony.collectors.rules import Aggregate, KeepBest, KeyScore, PruningRule


class BeamSearchPlanner(MPCPlannerBase):
    """Plans as :class:`torchrl.modules.CEMPlanner` does, by a beam search for a high return.

    Branches are pruned by the rewards since the root and, where there is a value network, the value of the state that
    they have reached. The action is the first of the best branch. Beside it the planner writes targets for a policy,
    as mctx gives them: ``("planner", "action")`` [*b, S, ...], the first actions of all branches; ``("planner",
    "weight")`` [*b, S], the share of the final branches that descend from each, by ``softmax(return / temperature)``;
    ``("planner", "value")`` [*b, 1], the return of the best branch.

    Args:
        env: as for :func:`beam_search`, with the rows of the states that are planned from.
        planning_horizon: T, steps of the simulated futures.
        branches: S.
        policy: proposes actions; uniform ones of the action spec by default.
        value_network: writes ``"state_value"`` [..., 1], the return that is to be expected from a state.
        prune_every: steps per period.
        rule: which branches go on.
        temperature: temperature of the weights of branches, in the units of the return.
        reward_key: key of the reward below ``"next"``.
        action_key: key of the action.
        noise: numbers for rules that draw, from the planned states and the number of periods.
    """

    def __init__(
        self,
        env: EnvBase,
        planning_horizon: int,
        branches: int,
        *,
        policy: Policy | None = None,
        value_network: Callable[[TensorDictBase], TensorDictBase] | None = None,
        prune_every: int = 10,
        rule: PruningRule = KeepBest(0.5),  # noqa: B008  (frozen)
        temperature: float = 1.0,
        reward_key: NestedKey = "reward",
        action_key: NestedKey = "action",
        noise: Callable[[TensorDictBase, int], Tensor] | None = None,
    ) -> None:
        check_branching(env)
        super().__init__(parts_of(env)[0], action_key)
        # What is searched has rows and transforms, which TorchRL's planners know nothing of.
        self.env, self.action_spec = env, env.full_action_spec[action_key]
        self.planning_horizon, self.branches, self.prune_every = planning_horizon, branches, prune_every
        self.policy, self.value_network, self.rule, self.noise = policy, value_network, rule, noise
        self.temperature, self.reward_key, self.action_key = temperature, reward_key, action_key

    @torch.no_grad()
    def planning(self, tensordict: TensorDictBase) -> Tensor:
        """Return the first action of the best branch from states [*b]; the targets are written into them."""
        root = tensordict.exclude("planner", "next", *self.env.action_keys)
        start, periods = branch(root, self.branches), -(-self.planning_horizon // self.prune_every)
        given, made = (getattr(self.policy, name, ()) for name in ("in_keys", "out_keys"))
        memory = [key for key in made if key[0] == "next" or key in given]
        found = beam_search(
            self.env,
            self.policy or branched_env(self.env, start.shape).rand_action,
            KeyScore(self.reward_key, negate=True),
            start,
            steps=self.planning_horizon,
            prune_every=self.prune_every,
            rule=self.rule,
            aggregate=Aggregate("sum"),
            value=None if self.value_network is None else self._cost,
            accumulate=True,
            noise=None if self.noise is None else self.noise(tensordict, periods),
            prune_last=False,
            keep=[self.action_key, *memory],
            keep_tree=True,
            leaves=self.branches,
        )
        assert found.tree is not None and found.leaf_costs is not None  # noqa: S101, PT018  (as asked for)
        first, roots = found.tree.get(self.action_key).select(root.ndim + 1, 0), found.slots[..., 0, :]
        share = torch.softmax(-found.leaf_costs / self.temperature, -1)
        weight = torch.zeros_like(share).scatter_add(-1, roots, share)
        targets = {"action": first, "weight": weight, "value": -found.leaf_costs[..., :1]}
        tensordict.set("planner", TensorDict(targets, root.shape))
        best = take(found.tree[..., 0], places(roots[..., :1], start))[..., 0]
        tensordict.update(best.select(*memory))  # what the policy remembers of the step that is made
        return best.get(self.action_key)

    def _cost(self, state: TensorDictBase) -> Tensor:
        assert self.value_network is not None  # noqa: S101  (not asked for otherwise)
        return -self.value_network(state.copy()).get("state_value").squeeze(-1)
