"""Batches that losses learn from after a search: its survivors, simulated and logged states, rollouts to repeat.

Legend: B scenes, S branches, T steps, N agents, K states drawn.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives.value.functional import reward2go

from symphony import keys
from symphony.collectors import BeamSearchCollector
from symphony.envs.driving import DrivingEnv
from symphony.envs.observation import ObservationConfig
from symphony.errors import ConfigError
from symphony.learning.demonstrations import Fitted, SceneDataset
from symphony.learning.experts import FOLLOWS, logged
from symphony.objectives import auc

_MASKS = (keys.OBJECTS_MASK, keys.POINTS_MASK, keys.LIGHTS_MASK, keys.VALID)
_LEARNED = (*keys.SEEN, *_MASKS, keys.STATE, keys.ACTION, keys.ROLLOUT, keys.WEIGHT)
COLLIDED, OFF_ROAD, MEMORY = 1.0, 0.5, 2.0
"""Costs of a collision and of a second off the road; seconds over which an action is to blame for it (1 / e)."""
PRICE = 60.0
"""Weight of the policy gradient beside cloning."""


class SearchReplay:
    """The last search and the batches that are drawn from it until the next.

    If the collector has the rows of K searches, these are made together, at every multiple of K x `every` updates, by
    the networks of that update. Updates then learn from one search after the other: the states of search k (from 0)
    are k x `every` to (k + 1) x `every` - 1 updates old. With K = 1 every search is made when it is needed.

    Not one of TorchRL's replay buffers: a state names a row of the scenes that its search drew, so it ends with them,
    and what networks observe is made only for the states drawn.

    Args:
        collector: keeps the whole tree.
        env: the environment it searches in.
        data: the data that the environment draws its scenes from.
        every: updates made from one search.
        states: K, simulated and logged ones each, drawn for the discriminator.
        segments: run segments of one search, at most.

    Attributes:
        period: updates from one draw of scenes to the next, K x `every`.
    """

    def __init__(
        self,
        collector: BeamSearchCollector,
        env: DrivingEnv,
        data: SceneDataset,
        every: int,
        states: int,
        segments: int,
    ) -> None:
        self.collector, self.env, self.data, self.every, self.states = collector, env, data, every, states
        self.rows = min(segments, len(data))
        self.period = every * (collector.env.batch_size[0] // self.rows)
        self._found: TensorDictBase | None = None
        self._leaves: TensorDictBase | None = None
        self._fitted: Fitted | None = None

    def refresh(self, step: int) -> TensorDict:
        """Search if a search is due at an update, or was never made; return its :func:`search_statistics`."""
        if self._found is None or step % self.period == 0:
            try:
                self._found = self.collector.rollout()
            except ValueError as error:  # of a rule of the user
                raise ConfigError(str(error)) from error
            self._leaves = None
        if self._leaves is None or step % self.every == 0:
            first = step % self.period // self.every * self.rows
            self._leaves = self._found[first : first + self.rows]
            self._statistics = search_statistics(self.env, self._leaves)
            self._searched = self._leaves[:, 0, 0].get(keys.SCENE).squeeze(-1)
            self._scenes, self._fitted = self.env.scenes[self._searched], None
        return self._statistics

    @property
    def leaves(self) -> TensorDictBase:
        """The leaves [B, S, T] of the last search, with the tree in their entry ``tree``."""
        if self._leaves is None:
            raise RuntimeError("no search was made yet")
        return self._leaves

    def survivors(self, count: int, rng: torch.Generator, observation: ObservationConfig) -> TensorDict:
        """Return K states of surviving rollouts, drawn uniformly from all before the scenes' ends, as the policy
        observes them, and their actions: a TensorDict [K, N] of the observation, ``ACTION``, ``ROLLOUT`` (True).
        """
        return self.learned(_drawn(self.env, self.leaves, count, rng), observation)

    def learned(self, chosen: TensorDictBase, observation: ObservationConfig) -> TensorDict:
        """Return steps [K] as a policy observes them, with their actions."""
        batch = DrivingEnv(self.env.scenes, self.env.dynamics, observation).at(chosen)
        batch.set(keys.ACTION, chosen.get(keys.ACTION))
        return batch.set(keys.ROLLOUT, torch.ones_like(batch.get(keys.VALID)))

    def blamed(self, count: int, rng: torch.Generator, observation: ObservationConfig) -> TensorDict:
        """Return K states of rollouts of a search that keeps all branches, drawn as often as they matter: a batch
        as of :meth:`survivors`, with the ``WEIGHT`` [K, N] of the actions in a policy gradient (:func:`advantages`).
        """
        found = advantages(self.env, self.leaves)
        share = found.abs().amax(-1).flatten().clamp_min(1e-9)
        pick = torch.multinomial(share.cpu(), count, replacement=True, generator=rng).to(share.device)
        # Divided by how likely each was drawn: the mean is that over all states before the scenes' ends.
        going = self.leaves.get(keys.STEP) < self.env.scenes.last_step[self.leaves.get(keys.SCENE)]
        weight = found.flatten(0, -2)[pick] * (share.sum() / going.sum() / share[pick])[:, None]
        return self.learned(self.leaves.flatten()[pick], observation).set(keys.WEIGHT, PRICE * weight)

    def both_kinds(self, rng: torch.Generator) -> TensorDict:
        """Return K simulated states, pruned ones included, and K logged ones of the same scenes, drawn by ``rng``: a
        TensorDict [2 K, N] of the observation and ``SIMULATED``.

        The log is fitted to the action space, lest its noise give it away; its agents follow the routes they took.
        """
        fake = _after(_drawn(self.env, self.leaves.get("tree"), self.states, rng))
        real = self._logged(self.states, rng)
        batch = self.env.at(torch.cat([fake.select(*real.keys(True, True)), real]))
        simulated = torch.zeros_like(batch.get(keys.VALID))
        simulated[: self.states] = True
        return batch.set(keys.SIMULATED, simulated)

    def repeatable(self, count: int, rng: torch.Generator) -> TensorDictBase:
        """Return first states [K] of survivors, with the random numbers of their histories (``noise_plan``)."""
        first = self.leaves[..., 0].flatten()
        pick = torch.randperm(len(first), generator=rng)[:count]
        return self.env.at(first[pick]).set(keys.NOISE_PLAN, self.leaves.get(keys.NOISE).flatten(0, 1)[pick])

    def _logged(self, count: int, rng: torch.Generator) -> TensorDict:
        scenes = self._scenes
        self._fitted = self._fitted or self.data.fitted(scenes.segment.tolist(), scenes)
        state, there, progress, *_ = self._fitted
        # Where the fit of an agent leaves the log, it would teach what nobody does.
        away = (state[..., :2] - logged(scenes)[0][..., :2]).norm(dim=-1) > FOLLOWS
        rows = (there.any(-1) & ~(there & away).any(-1))[:, 1:].nonzero()
        pick = self.data.pick(len(rows), count, scenes.segment.tolist(), rng)
        scene, step = rows[pick.to(rows.device)].unbind(-1)
        step = step + 1
        valid = there[scene, step]
        # Agents that see no routes follow none.
        route = scenes.route_logged if self.env.observation.route else torch.full_like(scenes.interactive, -1)
        return TensorDict(
            {
                keys.SCENE: self._searched[scene][:, None],
                keys.STEP: step[:, None],
                keys.STREAM: torch.zeros_like(scene)[:, None],
                keys.VALID: valid,
                keys.STATE: state[scene, step],
                keys.GOAL: route[scene],
                keys.PROGRESS: progress[scene, step],
            },
            batch_size=[count],
        )


def with_survivors(experts: TensorDict, rollouts: TensorDict) -> TensorDict:
    """Return one batch [M, 1] of expert states [K, 1] and rollout states [L, N], told apart by ``ROLLOUT``."""
    valid = experts.get(keys.VALID)
    experts.set(keys.ROLLOUT, torch.zeros_like(valid)).set(keys.WEIGHT, torch.ones_like(valid).float())
    present = [key for key in _LEARNED if key in experts.keys(True) and key in rollouts.keys(True)]
    flat = TensorDict(
        {key: rollouts.get(key).flatten(0, 1)[:, None] for key in present},
        batch_size=[rollouts.get(keys.VALID).numel()],
    )
    return torch.cat([experts.select(*present), flat])


def advantages(env: DrivingEnv, rollouts: TensorDictBase) -> Float[Tensor, "B S T N"]:
    """Return how much better each action turned out than those of other branches: minus a first collision and time
    off the road, discounted; 0 after the collision and for absent agents. One branch is a :class:`ConfigError`.
    """
    if rollouts.shape[1] < 2:
        raise ConfigError("search.branches must be at least 2: an action is compared with those of other branches")
    scene, step = rollouts.get(keys.SCENE).squeeze(-1), rollouts.get(keys.STEP).squeeze(-1)
    there = rollouts.get(keys.VALID) & (step < env.scenes.last_step[scene])[..., None]
    hit, off = (rollouts.get(("next", *key)).squeeze(-1) & there for key in (keys.COLLISION, keys.OFFROAD))
    reward = -(COLLIDED * hit + OFF_ROAD * env.dt * off)
    to_go = reward2go(reward, hit, math.exp(-env.dt / MEMORY))
    there = there & (hit.cumsum(2) - hit.long() == 0)
    total, others = (to_go * there).sum(1, keepdim=True), there.sum(1, keepdim=True) - 1
    mean = (total - to_go) / others.clamp_min(1)
    return (to_go - mean) * (there & (others > 0))


def search_statistics(env: DrivingEnv, leaves: TensorDictBase) -> TensorDict:
    """Return numbers that matter to a search: whether scores rank colliding and off-road states last (AUC; NaN
    without any), and the share of agent-steps that collide or are off the road before and after pruning.
    """
    tree, record = leaves.get("tree"), {}
    going = leaves.get(keys.STEP) < env.scenes.last_step[leaves.get(keys.SCENE)]
    valid = leaves.get(keys.VALID) & going
    for name, key in (("collision", keys.COLLISION), ("offroad", keys.OFFROAD)):
        bad = tree.get(("next", *key)).squeeze(-1) & valid
        left = leaves.get(("next", *key)).squeeze(-1) & valid
        record[f"search_auc_{name}"] = auc(tree.get(("collector", "beam_score")), bad, valid)
        record[f"search_{name}_all"] = bad.sum() / valid.sum()
        record[f"search_{name}_kept"] = left.sum() / valid.sum()
    return TensorDict(record)


def _after(steps: TensorDictBase) -> TensorDictBase:
    after = {keys.STEP: steps.get(keys.STEP) + 1}
    after |= {key: steps.get(("next", *key)) for key in (keys.STATE, keys.PROGRESS)}
    kept = steps.select(keys.SCENE, keys.STREAM, keys.VALID, keys.GOAL)
    return kept.update(TensorDict(after, batch_size=kept.batch_size))


def _drawn(env: DrivingEnv, steps: TensorDictBase, count: int, rng: torch.Generator) -> TensorDictBase:
    """Return some [K] of the steps [*b] before their scenes' last, drawn uniformly with replacement."""
    counted = (steps.get(keys.STEP) < env.scenes.last_step[steps.get(keys.SCENE)]).squeeze(-1)
    rows = counted.nonzero()
    pick = rows[torch.randint(len(rows), (count,), generator=rng).to(rows.device)]
    return steps[tuple(pick.unbind(-1))]
