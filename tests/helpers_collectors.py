"""A small environment without cars, and a policy whose random numbers are a function of what the state says."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

STREAM, X, ACTION, LOG_PROB = "stream", ("agents", "x"), ("agents", "action"), ("agents", "log_prob")


class Walk(EnvBase):
    """N walkers x' = x + action + 0.1 sin x. The episode ends after `last` steps, though it can go on."""

    batch_locked = False

    def __init__(self, agents: int = 2, last: int = 1000) -> None:
        super().__init__(batch_size=[])
        self.agents, self.last = agents, last
        x = Composite({"x": Unbounded((agents, 1))}, shape=(agents,))
        number = Unbounded((1,), dtype=torch.int64)
        self.observation_spec = Composite({"agents": x, "step": number, STREAM: number.clone()})
        self.state_spec = self.observation_spec.clone()
        for name in ("action", "reward"):
            one = Composite({name: Unbounded((agents, 1))}, shape=(agents,))
            setattr(self, f"{name}_spec", Composite({"agents": one}))
        flags = ("done", "truncated", "terminated")
        self.done_spec = Composite({name: Binary(shape=(1,), dtype=torch.bool) for name in flags})
        self.rng = torch.Generator()
        self.set_seed(0)

    def _set_seed(self, seed: int | None) -> None:
        self.rng.manual_seed(0 if seed is None else seed)

    def _state(self, x: Tensor, step: Tensor, stream: Tensor) -> TensorDict:
        shape = x.shape[:-2]
        done = step >= self.last
        agents = TensorDict({"x": x}, [*shape, self.agents])
        flags = {"done": done, "truncated": done.clone(), "terminated": torch.zeros_like(done)}
        return TensorDict({"agents": agents, "step": step, STREAM: stream, **flags}, shape)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        shape = () if tensordict is None else tuple(tensordict.shape)
        x = torch.randn(*shape, self.agents, 1, generator=self.rng)
        stream = torch.randint(1000, (*shape, 1), generator=self.rng)
        return self._state(x, torch.zeros_like(stream), stream)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        x, step = tensordict.get(X), tensordict.get("step")
        after = x + tensordict.get(ACTION) + 0.1 * x.sin()
        out = self._state(after, step + 1, tensordict.get(STREAM).clone())
        out.set(("agents", "reward"), -after.abs())
        return out


def noise(tensordict: TensorDictBase, agents: int) -> Tensor:
    """[..., N, 1] in (-1, 1), a hash of stream, step and agent."""
    key = 12.9898 * tensordict.get(STREAM) + 78.233 * tensordict.get("step") + 37.719 * torch.arange(agents)
    return 2 * ((key.double().sin() * 43758.5453) % 1).float()[..., None] - 1


class Policy(TensorDictModuleBase):
    """action = gain x + noise, with a log-probability that depends on both."""

    in_keys = [X, "step", STREAM]  # noqa: RUF012
    out_keys = [ACTION, LOG_PROB]  # noqa: RUF012

    def __init__(self, agents: int = 2) -> None:
        super().__init__()
        self.agents = agents
        self.gain = nn.Parameter(torch.tensor(-0.2))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict.set(ACTION, self.gain * tensordict.get(X) + noise(tensordict, self.agents))
        tensordict.set(LOG_PROB, self.log_prob(tensordict))
        return tensordict

    def log_prob(self, tensordict: TensorDictBase) -> Tensor:
        return -((tensordict.get(ACTION) - self.gain * tensordict.get(X)) ** 2)


def distance(tensordict: TensorDictBase) -> Tensor:
    """[..., N]: far from the origin is bad."""
    return tensordict.get(X).squeeze(-1).abs()


def give_streams(tensordict: TensorDictBase) -> TensorDictBase:
    """A stream of its own for each branch."""
    return tensordict.set(STREAM, 100 * tensordict.get(STREAM) + torch.arange(tensordict.shape[-1])[:, None])


def starts(env: Walk, *rows: int, branches: int, seed: int = 0) -> TensorDictBase:
    """[*rows, S] copies of random starts, each branch with a stream of its own."""
    env.set_seed(seed)
    start = env.reset(TensorDict({}, rows)).unsqueeze(-1).expand(*rows, branches).clone()
    return give_streams(start)


def assert_same(first: TensorDictBase, second: TensorDictBase) -> None:
    """Check for the same entries with the same values, to the last bit."""
    assert set(first.keys(True, True)) == set(second.keys(True, True))
    for key in first.keys(True, True):
        one, other = first.get(key), second.get(key)
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True, msg=str(key))


def hashed(td: TensorDictBase) -> TensorDictBase:
    """Actions of each branch, a function of its slot alone."""
    slots = torch.arange(td.shape[-1]).float()[:, None]
    return td.set("action", (slots * 12.9898 + td["place"].sum(-1, keepdim=True) * 0).sin())


class Mass(EnvBase):
    """Points x' = x + 0.5 (v + action) that end beyond a limit, or come back if not sticky; agents end separately."""

    batch_locked = False

    def __init__(self, batch_size: Any = (), agents: int | None = None, *, sticky=False, limit=1.5) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        self.sticky, self.limit = sticky, limit
        self.group = None if agents is None else "agents"
        each = (*self.batch_size, *(() if agents is None else (agents,)))

        def spec(**entries: Any) -> Composite:
            found = Composite(**entries, shape=each)
            return found if agents is None else Composite(agents=found, shape=self.batch_size)

        self.observation_spec = spec(**{name: Unbounded((*each, 2)) for name in ("place", "observation")})
        self.state_spec = spec(place=Unbounded((*each, 2)))
        self.action_spec = spec(action=Bounded(-1, 1, (*each, 1)))
        self.reward_spec = spec(reward=Unbounded((*each, 1)))
        flag = Binary(1, shape=(*each, 1), dtype=torch.bool)
        self.done_spec = spec(done=flag, terminated=flag.clone())
        self.shape_of_one = each[len(self.batch_size) :]
        self.rng = torch.Generator()
        self.set_seed(0)

    def _set_seed(self, seed: int | None) -> None:
        self.rng.manual_seed(0 if seed is None else seed)

    def _made(self, seen: Tensor, over: Tensor, **more: Tensor) -> TensorDict:
        more |= {"place": seen, "observation": seen.clone(), "done": over, "terminated": over.clone()}
        shape = seen.shape[: -1 - len(self.shape_of_one)]
        found = TensorDict(more, seen.shape[:-1])
        return found if self.group is None else TensorDict({self.group: found}, shape)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # Many environments take an empty TensorDict for none.
        shape = self.batch_size if tensordict is None or tensordict.is_empty() else tensordict.shape
        seen = torch.randn(*shape, *self.shape_of_one, 2, generator=self.rng) * 0.5
        return self._made(seen, torch.zeros_like(seen[..., :1], dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        now = tensordict if self.group is None else tensordict.get(self.group)
        x, v = now.get("place").unbind(-1)
        v = v + 0.5 * now.get("action").squeeze(-1)
        x = x + 0.5 * v
        seen = torch.stack([x, v], -1)
        over = (x.abs() > self.limit)[..., None]
        over = over | now.get("done") if self.sticky else over
        return self._made(seen, over, reward=1.0 - seen[..., :1].abs())
