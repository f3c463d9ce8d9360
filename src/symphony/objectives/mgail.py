"""Model-based adversarial imitation: the discriminator's verdict, differentiated through the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.func import functional_call
from torch.nn import functional
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from symphony.objectives.base import MaskedLoss, Reduction
from symphony.programs import compiled, ordered

Cost = Literal["log_d", "non_saturating", "logit"]
COSTS = {"log_d": functional.logsigmoid, "non_saturating": functional.softplus, "logit": lambda score: score}
"""Costs of a state with logit x, D = sigmoid(x) the probability that it is simulated: log D (the paper), whose
gradient vanishes where D is sure of the simulation; -log(1 - D), where D is sure of the log; x, nowhere."""


class MGAILLoss(MaskedLoss):
    """Adversarial loss of an actor: how simulated its states look, with gradient through the dynamics.
    Sources: the paper, III-C; Baram et al. 2017.

    The loss simulates from the states it is given, by the actor's reparameterised draws, and averages a cost of the
    discriminator's logit over all steps and agents. Only the actor receives a gradient. With given random numbers it
    repeats an earlier rollout, such as the survivors of a beam search: the gradient is then that through the search
    with its choices held fixed, at the memory of the survivors alone.

    Args:
        actor_network: the actor, which draws with gradient (`has_rsample`).
        discriminator: module that writes one logit per entry, `[..., N]`, under the `score` key.
        env: differentiable; steps any batch shape. May be replaced between calls.
        horizon: T, steps per rollout; given numbers decide it where there are any.
        cost: cost of a logit, see :data:`COSTS`.
        detach_keys: inputs of the actor through which no gradient flows back to earlier states. Without them
            gradients pass through the actor's reactions too.
        truncate: steps after which the gradient is cut; 0: never.
        until_done: False if ends of episodes are to change nothing at all.
        compile_step: compile actor, environment and score of a step, or how, as :func:`torch.compile` takes it.
        reduction: `"mean"` or `"sum"` over entries that count, or `"none"`, `[..., T, N]`.

    Writes `loss_mgail` and, detached, the mean logit `mgail_score`. Steps after the first `done` do not count.

    Raises:
        KeyError: at the call, if the mask, `done` or the score is missing.
        ValueError: for a bad argument, numbers for no step at all, or a mask of another shape than the score.
    """

    @dataclass
    class _AcceptedKeys:
        """Return keys that can be set by `.set_keys(name=key)`.

        Attributes:
            score (NestedKey): float `[..., N]`, the logit the discriminator writes.
            noise (NestedKey): numbers `[..., N, *]` that the actor draws by.
            plan (NestedKey): the same for all steps, `[..., T, N, *]`, optional in the start states.
            valid (NestedKey): bool `[..., N]`, True where an agent counts.
            done (NestedKey): bool `[..., 1]`, True where the episode has ended; `[..., N, 1]` where agents end apart.
        """

        score: NestedKey = ("agents", "score")
        noise: NestedKey = ("agents", "noise")
        plan: NestedKey = "noise_plan"
        valid: NestedKey = ("agents", "valid")
        done: NestedKey = "done"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    deterministic_sampling_mode = ExplorationType.RANDOM
    out_keys = ["loss_mgail", "mgail_score"]  # noqa: RUF012 - the type LossModule declares

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        discriminator: TensorDictModuleBase,
        env: EnvBase | None = None,
        *,
        horizon: int = 0,
        cost: Cost = "log_d",
        detach_keys: Sequence[NestedKey] = (),
        truncate: int = 0,
        until_done: bool = True,
        compile_step: bool | Mapping[str, Any] = False,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__(reduction)
        if cost not in COSTS:
            raise ValueError(f"unknown cost {cost!r}, expected one of {', '.join(COSTS)}")
        for name, value in (("horizon", horizon), ("truncate", truncate)):
            if value < 0:
                raise ValueError(f"{name} must be at least 0, is {value}")
        self.convert_to_functional(actor_network, "actor_network")
        # Neither is trained here: in a container they are neither saved nor reset with the loss.
        self._held: dict[str, Any] = {"discriminator": discriminator, "env": env}
        self.horizon, self.cost, self.truncate, self.until_done = horizon, cost, truncate, until_done
        self.compile_step = compile_step
        self.detach_keys = [key for key in detach_keys if key in actor_network.in_keys]

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "env":
            # Past torch, which would make a part of the loss of it.
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    @property
    def discriminator(self) -> TensorDictModuleBase:
        """The discriminator, which is not trained here."""
        return self._held["discriminator"]

    @property
    def env(self) -> EnvBase | None:
        """The environment in which the actor is simulated."""
        return self._held["env"]

    @env.setter
    def env(self, value: EnvBase | None) -> None:
        self._held["env"] = value
        # What a state consists of may have changed with it.
        self._in_keys = None

    def _read_keys(self) -> list[NestedKey]:
        state = [] if self.env is None else list(self.env.state_spec.keys(True, True))
        return [*self.actor_network.in_keys, *state, self.tensor_keys.done, self.tensor_keys.plan]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Simulate from start states `[...]`, as the environment resets to them; the input is left as it is."""
        env = self.env
        if env is None:
            raise ValueError("no environment to simulate in; set `env`")
        plan = tensordict.get(self.tensor_keys.plan, default=None)
        done = tensordict.get(self.tensor_keys.done, default=None)
        if done is None:
            raise KeyError(f"no end of the episode under {self.tensor_keys.done!r}")
        # Numbers left behind by an earlier policy would decide every step again.
        now = tensordict.exclude(self.tensor_keys.plan, self.tensor_keys.noise)
        # Called with tensors alone, the batch was guessed from them.
        spec = env.full_done_spec.get(self.tensor_keys.done, None)
        own = 1 if spec is None else len(spec.shape) - len(env.batch_size)  # [1], or [N, 1]
        now.batch_size = done.shape[: done.ndim - own]
        batch, start = now.batch_dims, now
        steps = self.horizon if plan is None else plan.shape[batch]
        if steps < 1:
            raise ValueError("nothing to simulate: give a horizon, or random numbers for at least one step")
        self._mask(start)  # fail now if it is bad
        score, going = self._simulate(env, now, plan, steps)
        valid = self._counted(start, score.select(batch, 0).shape, done.device)
        counted = valid.unsqueeze(batch) & going
        loss, logit = self._reduced(COSTS[self.cost](score), counted), self._reduced(score.detach(), counted, "mean")
        result = TensorDict({"loss_mgail": loss, "mgail_score": logit})
        self._clear_weakrefs(tensordict, result, "actor_network_params")
        return result

    def _simulate(
        self, env: EnvBase, now: TensorDictBase, numbers: Float[Tensor, "*_"] | None, steps: int
    ) -> tuple[Float[Tensor, "*b T N"], Bool[Tensor, "*b T N"]]:
        """Return logits and whether the episode still ran, `[..., steps, N]`."""
        batch, scores, going, start = now.batch_dims, [], [], now
        alive = torch.ones_like(now.get(self.tensor_keys.done))
        frozen = {name: weight.detach() for name, weight in self.discriminator.named_parameters()}
        step = compiled(_step, env, self.compile_step) if self.compile_step else _step
        written = [key for key in env.action_keys if key not in self.actor_network.in_keys]
        # In a loss, networks with memory take a batch for a time axis; here they act step by step.
        acting = set_exploration_type(ExplorationType.RANDOM), set_recurrent_mode(False)
        with self.actor_network_params.to_module(self.actor_network), acting[0], acting[1]:
            for t in range(steps):
                if self.truncate and t % self.truncate == 0:
                    now = now.detach()
                drawn = None if numbers is None else numbers.select(batch, t)
                if self.compile_step:
                    now, drawn = ordered(now.exclude(*written), start), None if drawn is None else drawn.contiguous()
                # An environment may go on after an end, and a later state of it be invalid.
                alive = alive & ~now.get(self.tensor_keys.done) if self.until_done else alive
                now, score = step(self, env, frozen, now, drawn)
                scores.append(score)
                going.append(alive.flatten(batch) if score.ndim > batch else alive.squeeze(-1))
        score = torch.stack(scores, batch)
        return score, torch.stack(going, batch).expand_as(score)


def _step(
    loss: MGAILLoss, env: EnvBase, frozen: dict[str, Tensor], now: TensorDictBase, noise: Float[Tensor, "*_"] | None
) -> tuple[TensorDictBase, Float[Tensor, "*b N"]]:
    """Return the next state and its logits by the frozen weights of the discriminator; one program if compiled."""
    names, acting, drawn = loss.tensor_keys, now.copy(), now.copy()
    for key in loss.detach_keys:
        acting.set(key, acting.get(key).detach())
    if noise is not None:
        acting.set(names.noise, noise)
    acting = loss.actor_network(acting)
    for key in env.action_keys:
        drawn.set(key, acting.get(key))
    if (memory := acting.get("next", None)) is not None:
        drawn.set("next", memory)
    now = env.step_mdp(env.step(drawn))
    score = functional_call(loss.discriminator, frozen, (now.copy(),)).get(names.score, default=None)
    if score is None:
        raise KeyError(f"the discriminator writes no score under {names.score!r}")
    return now, score
