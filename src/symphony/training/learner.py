"""What one update is: batches, losses and optimizers of all networks (paper, sections IV-A to IV-C)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from symphony import keys
from symphony.agents.networks import Networks, observation_config
from symphony.collectors import BeamSearchResult, KeepAll, branch, with_rows
from symphony.config import TrainConfig
from symphony.envs.driving import DrivingEnv
from symphony.objectives import BCLoss, DiscriminatorLoss, DistillationLoss, GoalLoss, MGAILLoss, auc
from symphony.simulation.demonstrations import SceneDataset
from symphony.simulation.rollouts import branched_streams, pruning_rule, search

_SEED_STRIDE = 1_000_003
_SEEN = (keys.OWN, keys.OBJECTS, keys.POINTS, keys.ROUTE)
"""What an agent observes and could react to."""
_POLICY_KEYS = (
    keys.OWN,
    keys.OBJECTS,
    keys.OBJECTS_MASK,
    keys.POINTS,
    keys.POINTS_MASK,
    keys.VALID,
    keys.ACTION,
    keys.ROUTE,
    keys.ROLLOUT,
    keys.RANK,
)


@dataclass(frozen=True)
class SearchData:
    """What one search leaves for the updates that follow it.

    Attributes:
        env: the environment of the searched scenes.
        start: [B, S] the states it began with.
        survivors: [B, S, T] state, action, step and random numbers along the histories of the leaves.
        rank: [B, S] place of each leaf in its tree.
        simulated: [B, S, T] states after each step, pruned branches included.
        logged: [B, T, N, 4] states of the log, fitted to the action space.
        logged_valid: [B, T, N].
        record: how well the scores told bad states from good ones, and what the pruning made of it.
    """

    env: DrivingEnv
    start: TensorDictBase
    survivors: TensorDictBase
    rank: Tensor
    simulated: TensorDictBase
    logged: Tensor
    logged_valid: Tensor
    record: dict[str, Tensor]


class Learner:
    """Networks, their losses and optimizers.

    All that is random in an update derives from the configuration's seed and the number of the update.

    Args:
        config: of the run.
        networks: what learns.
        dataset: what it learns from.
        device: where.
    """

    def __init__(
        self, config: TrainConfig, networks: Networks, dataset: SceneDataset, device: torch.device
    ) -> None:
        self.config, self.networks, self.dataset, self.device = config, networks, dataset, device
        self.sees = observation_config(config)
        # Clearances are costly, and only the discriminator looks at them.
        self.policy_sees = replace(self.sees, clearance=False, foresight=())
        judge, search_config = config.discriminator, config.search
        self.policy_loss = (
            DistillationLoss(
                networks.policy, rollout_weight=search_config.weight, survivors=search_config.survivors
            )
            if config.searches and not config.adversarial
            else BCLoss(networks.policy)
        )
        self.mgail_loss = None
        self.goal_loss = self.judge_loss = None
        if networks.goals is not None:
            self.goal_loss = GoalLoss(networks.goals)
            self.goal_loss.set_keys(label=keys.GOAL)
        if networks.discriminator is not None:
            self.judge_loss = DiscriminatorLoss(
                networks.discriminator,
                gradient_penalty=judge.gradient_penalty,
                instance_noise=judge.instance_noise,
                noise_keys=[keys.OWN, keys.OBJECTS] if judge.instance_noise else (),
            )
        if config.adversarial and networks.discriminator is not None:
            settings = config.mgail
            self.mgail_loss = MGAILLoss(
                networks.policy,
                networks.discriminator,
                cost=settings.cost,
                detach_keys=() if settings.react else [k for k in networks.policy.in_keys if k in _SEEN],
                truncate=settings.truncate,
                checkpoint=settings.checkpoint,
            )
        rates = {"discriminator": judge.learning_rate}
        self.rates = {name: rates.get(name, config.learning_rate) for name in networks.present()}
        self.optimizers = {
            name: torch.optim.Adam(module.parameters(), lr=self.rates[name])
            for name, module in networks.present().items()
        }
        self._found: SearchData | None = None

    def update(self, step: int) -> dict[str, Tensor]:
        """One update of every network; returns what is worth a record, as tensors without gradient."""
        config, rng = self.config, torch.Generator().manual_seed(self.config.seed * _SEED_STRIDE + step)
        items = self.dataset.draw(config.segments, rng)
        self._set_rates(step)
        record: dict[str, Tensor] = {}
        found = self._searched(step, rng)
        if found is not None and self.judge_loss is not None:
            record |= found.record
            for _ in range(config.mgail.discriminator_updates if config.adversarial else 1):
                losses = self.judge_loss(self._both_kinds(found, rng))
                record |= self._descend("discriminator", losses, "loss_discriminator")
        record |= self._improve_policy(step, items, found, rng)
        if self.goal_loss is not None:
            goals = self.dataset.sample_goals(items, config.goals, self.policy_sees, rng, self.device)
            losses = self.goal_loss(goals)
            values = self._descend("goals", losses, "loss_goal")
            record |= {name if "goal" in name else f"goal_{name}": value for name, value in values.items()}
        return record

    @torch.no_grad()
    def scores(self, step: int) -> dict[str, Tensor]:
        """The discriminator's logits [K] of ``simulated`` and ``data`` states of the last search (K = 0 before the
        first); empty without a discriminator. Which states, the number of the update says.
        """
        judge, found = self.networks.discriminator, self._found
        if judge is None:
            return {}
        if found is None:
            return dict.fromkeys(("simulated", "data"), torch.zeros(0, device=self.device))
        batch = judge(self._both_kinds(found, torch.Generator().manual_seed(step)))
        score, valid, simulated = (batch.get(key) for key in (keys.SCORE, keys.VALID, keys.SIMULATED))
        return {"simulated": score[valid & simulated], "data": score[valid & ~simulated]}

    def _searched(self, step: int, rng: torch.Generator) -> SearchData | None:
        """The last search, or a new one if it is due; None where there is nothing to judge (yet)."""
        config = self.config
        if self.judge_loss is None or (config.adversarial and step < config.mgail.regression):
            return None
        if self._found is None or step % config.search.updates == 0:
            self._found = self._search(step, rng)
        return self._found

    def _improve_policy(
        self, step: int, items: list[int], found: SearchData | None, rng: torch.Generator
    ) -> dict[str, Tensor]:
        """Towards the log, and the survivors or the discriminator's gradient where there are any."""
        config, settings = self.config, self.config.mgail
        if self.mgail_loss is None or found is None:
            batch = self.dataset.sample_states(items, config.states, self.policy_sees, rng, self.device)
            if found is not None:
                batch = _joined(batch, self._surviving(found, rng))
            return self._descend("policy", self.policy_loss(batch), self.policy_loss.out_keys[0])
        if step < settings.regression + settings.head_start:
            return {}
        self.mgail_loss.env = found.env
        losses = self.mgail_loss(self._replayed(found, rng))
        total = losses["loss_mgail"]
        if settings.expert_weight:
            batch = self.dataset.sample_states(items, config.states, self.policy_sees, rng, self.device)
            losses.update(self.policy_loss(batch))
            total = total + settings.expert_weight * losses["loss_bc"]
        return self._descend("policy", losses.set("loss_policy", total), "loss_policy")

    def _replayed(self, found: SearchData, rng: torch.Generator) -> TensorDictBase:
        """First states [rollouts] of survivors, with the random numbers that lead along their histories."""
        scenes, branches = found.start.shape
        pick = torch.randperm(scenes * branches, generator=rng)[: self.config.mgail.rollouts]
        start = found.start.flatten(0, 1)[pick]
        return start.set("noise_plan", found.survivors.get(keys.NOISE).flatten(0, 1)[pick])

    def _descend(self, name: str, losses: TensorDictBase, key: str) -> dict[str, Tensor]:
        optimizer, module = self.optimizers[name], self.networks.present()[name]
        optimizer.zero_grad(set_to_none=True)
        losses[key].backward()
        norm = nn.utils.clip_grad_norm_(module.parameters(), self.config.clip)
        if bool(norm.isfinite()):  # else the update is skipped; the training loop counts them
            optimizer.step()
        return {**{k: v.detach() for k, v in losses.items()}, f"gradient_norm_{name}": norm}

    def _set_rates(self, step: int) -> None:
        """Cosines from the configured rates to a tenth of them: one for all updates, or for MGAIL two."""
        config, begin, end, rates = self.config, 0, self.config.steps, self.rates
        if config.adversarial and config.mgail.regression:
            regressing = step < config.mgail.regression
            begin, end = (
                (0, config.mgail.regression) if regressing else (config.mgail.regression, config.steps)
            )
        if config.adversarial and step >= config.mgail.regression:
            rates = {**rates, "policy": config.mgail.learning_rate}
        share = 0.5 * (1 + math.cos(math.pi * (step - begin) / (end - begin)))
        for name, optimizer in self.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = rates[name] * (0.1 + 0.9 * share)

    @torch.no_grad()
    def _search(self, step: int, rng: torch.Generator) -> SearchData:
        """Search from the first states of fresh scenes with the networks as they are."""
        settings = self.config.search
        rows = [min(settings.segments, len(self.dataset))]
        driving = DrivingEnv(
            self.dataset, self.dataset.dynamics, self.sees, generator=rng, device=self.device
        )
        # A reset gives each row a stream of its own, so that each search draws anew.
        start = branched_streams(branch(with_rows(driving, rows).reset(), settings.branches))
        env, scenes = driving, driving.scenes
        items = scenes.segment.tolist()
        if self.networks.goals is not None:
            start = env.with_goals(start)
        result = search(
            env,
            self.networks.policy,
            self.networks.discriminator,
            start,
            seed=self.config.seed,
            rule=pruning_rule(settings) if self.config.searches else KeepAll(),
            prune_every=settings.prune_every,
            keep_tree=True,
        )
        assert result.tree is not None  # noqa: S101 - asked for just above
        carried = start.select(keys.SCENE, keys.STREAM, keys.VALID, keys.GOAL)
        steps = result.tree.batch_size[-1]
        carried = carried.unsqueeze(-1).expand(*carried.batch_size, steps)
        order = result.leaf_totals[..., -1, :].argsort(dim=-1, stable=True)
        rank = order.argsort(dim=-1, stable=True)
        survivors = result.trajectories.select(keys.STATE, keys.ACTION, keys.STEP, keys.NOISE)
        simulated = result.tree.select(("next", *keys.STATE), keys.STEP)
        simulated = TensorDict(
            {keys.STEP: simulated[keys.STEP] + 1, keys.STATE: simulated[("next", *keys.STATE)]},
            batch_size=simulated.batch_size,
        )
        log, log_valid = self.dataset.fitted(items, scenes)
        return SearchData(
            env,
            start,
            survivors.update(carried),
            rank,
            simulated.update(carried),
            log,
            log_valid,
            _quality(
                result,
                carried.get(keys.VALID)
                & (simulated.get(keys.STEP) <= env.scenes.last_step[carried.get(keys.SCENE)]),
            ),
        )

    def _surviving(self, found: SearchData, rng: torch.Generator) -> TensorDict:
        """Observations and actions along surviving rollouts, [states, N]."""
        last = found.env.scenes.last_step[found.survivors.get(keys.SCENE)]
        rows = (found.survivors.get(keys.STEP) < last).squeeze(-1).nonzero()
        pick = rows[torch.randint(len(rows), (self.config.search.states,), generator=rng)]
        chosen = found.survivors[tuple(pick.unbind(-1))]
        batch = DrivingEnv(found.env.scenes, self.dataset.dynamics, self.policy_sees).at(chosen)
        batch.set(keys.ACTION, chosen.get(keys.ACTION))
        rank = found.rank[pick[:, 0], pick[:, 1]]
        batch.set(keys.RANK, rank[:, None].expand(batch.get(keys.VALID).shape))
        batch.set(keys.ROLLOUT, torch.ones_like(batch.get(keys.VALID)))
        return batch

    def _both_kinds(self, found: SearchData, rng: torch.Generator) -> TensorDict:
        """Simulated and logged states of the same scenes, [2 x states, N]."""
        amount, env = self.config.discriminator.states, found.env
        last = env.scenes.last_step[found.simulated.get(keys.SCENE)]
        rows = (found.simulated.get(keys.STEP) <= last).squeeze(-1).nonzero()
        pick = rows[torch.randint(len(rows), (amount,), generator=rng)]
        fake = found.simulated[tuple(pick.unbind(-1))]
        rows = found.logged_valid[:, 1:].any(-1).nonzero()
        scene, step = rows[torch.randint(len(rows), (amount,), generator=rng)].unbind(-1)
        step = step + 1
        valid = found.logged_valid[scene, step]
        real = TensorDict(
            {
                keys.SCENE: scene[:, None],
                keys.STEP: step[:, None],
                keys.STREAM: torch.zeros_like(scene)[:, None],
                keys.VALID: valid,
                keys.STATE: found.logged[scene, step],
                keys.GOAL: env.scenes.route_logged[scene]
                if self.networks.goals is not None
                else torch.full_like(valid, -1, dtype=torch.int64),
            },
            batch_size=[amount],
        )
        batch = env.at(torch.cat([fake.select(*real.keys(True, True)), real]))
        simulated = torch.zeros_like(batch.get(keys.VALID))
        simulated[:amount] = True
        return batch.set(keys.SIMULATED, simulated)


def _quality(result: BeamSearchResult, valid: Tensor) -> dict[str, Tensor]:
    """What matters to the search: whether scores rank colliding and off-road states last (AUC; NaN without any),
    and the share of agent-steps that collide or are off the road before and after pruning.
    """
    assert result.tree is not None  # noqa: S101 - the search keeps it
    record = {}
    for name, key in (("collision", keys.COLLISION), ("offroad", keys.OFFROAD)):
        bad = result.tree.get(("next", *key)).squeeze(-1) & valid
        left = result.trajectories.get(("next", *key)).squeeze(-1) & valid
        record[f"search_auc_{name}"] = auc(result.simulated_scores, bad, valid)
        record[f"search_{name}_all"] = bad.sum() / valid.sum()
        record[f"search_{name}_kept"] = left.sum() / valid.sum()
    return record


def _joined(experts: TensorDict, rollouts: TensorDict) -> TensorDict:
    """One batch [M, 1] of expert states [K, 1] and rollout states [L, N]."""
    valid = experts.get(keys.VALID)
    experts.set(keys.ROLLOUT, torch.zeros_like(valid))
    experts.set(keys.RANK, torch.zeros_like(valid, dtype=torch.int64))
    present = [key for key in _POLICY_KEYS if experts.get(key, None) is not None]
    flat = TensorDict(
        {key: rollouts.get(key).flatten(0, 1)[:, None] for key in present},
        batch_size=[rollouts.get(keys.VALID).numel()],
    )
    return torch.cat([experts.select(*present), flat])
