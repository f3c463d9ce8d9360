"""Extreme but legal scenes stay finite, whatever learns; numbers that do not end a simulation and say where."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from helpers_agents import make_agent
from helpers_runs import build, tiny
from helpers_segments import crossing, hide, make_road, make_segment, straight_road
from helpers_store import fill, stored
from symphony import keys
from symphony.agents import Agent
from symphony.config import AgentConfig, EvaluateConfig, MGAILConfig, ValidationConfig
from symphony.data import segment as schema
from symphony.data.store import SegmentStore
from symphony.errors import SymphonyError
from symphony.evaluation import evaluate
from symphony.rollouts.unroll import NotFiniteError

STEPS = 4


def road(**changes: Any) -> schema.RunSegment:
    """Three cars on three lanes."""
    return straight_road(**{"num_agents": 3, "steps": STEPS, **changes})


def line(*points: Any) -> Any:
    return np.asarray(points, float)


def with_road(segment: schema.RunSegment, **changes: Any) -> schema.RunSegment:
    return segment.replace(road=dataclasses.replace(segment.road, **changes))


def only(segment: schema.RunSegment, seen: Any) -> schema.RunSegment:
    """With agents seen at some steps [A, T] only."""
    return hide(segment, *np.nonzero(~np.broadcast_to(seen, segment.valid.shape)))


def moving(speed, *, dt=0.2, agents=2, steps=STEPS, heading=0.0):
    """Agents that keep a speed, 30 m beside each other, from behind the origin on."""
    reach = speed * dt * (steps - 1)
    x = np.linspace(-reach / 2, reach / 2, steps) + np.zeros((agents, 1))
    y = np.broadcast_to(30.0 * np.arange(agents)[:, None], x.shape)
    lanes = [line((-reach - 50, k), (0, k), (reach + 50, k)) for k in y[:, 0]]
    velocity = np.stack([np.full_like(x, speed), np.zeros_like(x)], -1)
    return make_segment(make_road(lanes), np.stack([x, y], -1), np.full_like(x, heading), velocity, dt)


def placed(position: Any, segment: schema.RunSegment) -> schema.RunSegment:
    """Agents of a segment at [A, 2] throughout, at rest."""
    where = segment.position.copy()
    where[..., :2] = np.asarray(position, np.float32)[:, None]
    return segment.replace(position=where, velocity=np.zeros_like(segment.velocity))


def far_away() -> schema.RunSegment:
    base = road()
    shift = np.array([schema.MAX_COORDINATE - 400, -schema.MAX_COORDINATE + 400, schema.MAX_HEIGHT - 1], np.float32)
    moved = {
        name: dataclasses.replace(getattr(base.road, name), points=getattr(base.road, name).points + shift)
        for name in ("lanes", "boundary", "marks")
    }
    return with_road(base.replace(position=base.position + shift), **moved)


def jumping() -> schema.RunSegment:
    base = moving(10.0)
    places = base.position.copy()
    places[:, 1::2, 0] += schema.MAX_JUMP - 50
    return base.replace(position=places)


def zigzag() -> schema.RunSegment:
    """A lane that turns back at every point, and follows itself."""
    xs = np.arange(60) % 2 * 3.0
    lanes = [np.stack([xs, np.zeros(60)], -1), line((5, 5), (5, 5), (5, 5))]
    return road().replace(road=make_road(lanes, successors=[(0, 0), (0, 1), (1, 0)], left=[(0, 0)], right=[(0, 1)]))


def tangle() -> schema.RunSegment:
    """Every lane leads to every other one."""
    pairs = [(a, b) for a in range(6) for b in range(6)]
    lanes = [line((0, k), (30, k), (60, k)) for k in range(6)]
    return road().replace(road=make_road(lanes, successors=pairs, left=pairs, right=pairs))


def with_lights(count: int, state: schema.SignalState) -> schema.RunSegment:
    shown, place = np.full((count, STEPS), state, np.uint8), np.zeros((count, 3), np.float32)
    return road().replace(signal_lane=np.zeros(count, np.int32), signal_point=place, signal_state=shown)


SCENES: dict[str, Callable[[], schema.RunSegment]] = {
    "one agent": lambda: road(num_agents=1),
    "40 in one spot": lambda: placed(np.tile([[40.0, 0.0]], (40, 1)), road(num_agents=40, num_lanes=2)),
    "10 km apart": lambda: placed([(0, 0), (7000, 7000), (-7000, -7000)], road()),
    "a map of two points": lambda: road().replace(road=make_road([line((0, 0), (1, 0))])),
    "a lane of one point": lambda: road().replace(road=make_road([line((30, 0))])),
    "a lane of one place": lambda: road().replace(road=make_road([line(*[(30, 0)] * 5)])),
    "a lane of 30 km": lambda: road().replace(road=make_road([line((-15_000, 0), (15_000, 0))])),
    "a lane that turns back and follows itself": zigzag,
    "a tangle of lanes": tangle,
    "one lane": lambda: road(num_lanes=1),
    "seen at the first two steps only": lambda: only(road(), np.arange(STEPS) < 2),
    "seen now and then": lambda: only(road(), (np.arange(STEPS) + np.arange(3)[:, None]) % 3 < 2),
    "all but two vanish": lambda: only(road(num_agents=6), (np.arange(6)[:, None] < 2) | (np.arange(STEPS) < 1)),
    "the shortest log": lambda: road(steps=2),
    "all standing": lambda: placed([(20, 0), (40, 0), (60, 3.5)], road()),
    "all in reverse": lambda: moving(-10.0),
    "logged twice": lambda: road(num_agents=2).replace(
        **{name: getattr(road(num_agents=1), name)[[0, 0]] for name in ("position", "heading", "velocity", "size")}
    ),
    "the highest speed": lambda: moving(schema.MAX_SPEED - 1, dt=0.05),
    "the largest jumps": jumping,
    "the shortest time step": lambda: moving(10.0, dt=schema.MIN_DT),
    "the longest time step": lambda: moving(10.0, dt=schema.MAX_DT),
    "the smallest boxes": lambda: road().replace(size=np.full((3, 3), schema.MIN_SIZE, "f4")),
    "the largest boxes": lambda: road().replace(size=np.full((3, 3), schema.MAX_SIZE - 0.5, "f4")),
    "headings turned often": lambda: road().replace(heading=road().heading + np.float32(schema.MAX_HEADING - 10)),
    "at the edge of the world": far_away,
    "pedestrians only": lambda: road().replace(agent_type=np.full(3, schema.AgentType.PEDESTRIAN, np.uint8)),
    "unknown kinds of agents": lambda: road().replace(agent_type=np.full(3, schema.AgentType.UNSET, np.uint8)),
    "widths and limits unknown": lambda: with_road(
        road(), lane_width=np.full(3, np.nan, "f4"), speed_limit=np.full(3, np.nan, "f4")
    ),
    "200 lights in one place": lambda: with_lights(200, schema.SignalState.STOP),
    "lights of unknown state": lambda: with_lights(2, schema.SignalState.UNKNOWN),
    "lights, and all leave": lambda: crossing(4, steps=STEPS, seed=3),
}


SETTINGS = ("bc", "bc_ts_h", "mgail_ts_h")
"""One without search, and those that have every part, with either action space; others are simulated like them."""


def learned(segments: Sequence[schema.RunSegment], method: Any, out: Path) -> Agent:
    """Train three updates, one of every kind there is, on all segments at once."""
    fill(out / "store", list(segments))
    agent = AgentConfig(interactive=1, num_points=12, hidden=8)
    mgail = MGAILConfig(regression=1, head_start=1, rollouts=len(segments), expert_weight=0.5)
    how = {"steps": 3, "segments": 2 * len(segments), "agent": agent, "mgail": mgail}
    config = tiny(method, out / "store", out / "run", **how)
    trainer = build(config)
    for step in range(3):
        values = trainer._update(step)
        counted = {k: v for k, v in values.items() if k.startswith(("loss", "gradient_norm"))}
        assert {name for name, value in counted.items() if not torch.isfinite(value).all()} == set()
        # AUCs are undefined where there is no collision, say.
        assert not any(torch.isinf(value).any() for value in values.values())
    assert all(torch.isfinite(p).all() for m in trainer.agent.modules.values() for p in m.parameters())
    return trainer.agent


def assert_metrics_finite(agent: Agent, store: Path) -> None:
    search = "none" if agent.discriminator is None else "tree"
    found = evaluate(agent, store, EvaluateConfig(rollouts=2, branches=2, search=search, batch=40))
    numbers = {k: v for k, v in found.numbers().items() if isinstance(v, float) and not k.endswith("_se")}
    # There are no others; where nobody passes a junction, its branches are taken by nobody; where there is no
    # boundary, nobody is off the road; and bounds are of what is zero.
    undefined = ("others_", "curvature_jsd")
    if not any(len(segment.road.boundary) for segment in SegmentStore(store)):
        undefined += ("offroad_time", "agent_offroad_time")
    numbers = {name: value for name, value in numbers.items() if not name.endswith("_bound")}
    bad = {k for k, v in numbers.items() if not math.isfinite(v) and not k.startswith(undefined)}
    assert bad == set()
    assert len(numbers) > 10


@pytest.fixture(scope="module")
def scenes() -> list[schema.RunSegment]:
    return [schema.validate(make().replace(segment_id=name)) for name, make in SCENES.items()]


@pytest.mark.parametrize("method", SETTINGS)
def test_every_part_of_the_methods(scenes, method, tmp_path):
    agent = learned([each for each in scenes if each.dt == 0.2], method, tmp_path)
    assert_metrics_finite(agent, tmp_path / "store")


@pytest.mark.parametrize("dt", sorted({make().dt for make in SCENES.values()} - {0.2}))
def test_other_time_steps(scenes, dt, tmp_path):
    agent = learned([each for each in scenes if each.dt == dt], "mgail_ts_h", tmp_path)
    assert_metrics_finite(agent, tmp_path / "store")


LENGTHS = (5, 3, 5)
"""Steps of the segments ``straight-0``, ``crossing-1`` and ``crossing-2``."""
SEARCHES = (("none", "best"), ("tree", "systematic"), ("backtrack", "best"))
CROSSINGS = [crossing(4, seed=k, steps=LENGTHS[k]) for k in (1, 2)]
store = stored(lambda: [straight_road(4, steps=LENGTHS[0]), *CROSSINGS], opened=True)


class Spoiled(TensorDictModuleBase):
    """A network that, in one scene from one step on, puts out a bad number for one branch's first agent."""

    def __init__(self, inner: Any, key: keys.Key, scene: int, step: int, value: float = math.nan) -> None:
        super().__init__()
        self.inner, self.key, self.scene, self.step, self.value = inner, key, scene, step, value
        self.in_keys, self.out_keys = inner.in_keys, inner.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = self.inner(tensordict)
        now = (out.get(keys.SCENE) == self.scene) & (out.get(keys.STEP) >= self.step)
        value = out.get(self.key).clone()
        place = torch.zeros(value.shape, dtype=torch.bool)
        place[..., 0, :] = True
        now = now.reshape(*now.shape[:-1], *(1,) * (value.ndim - now.ndim + 1))
        return out.set(self.key, value.masked_fill(place & now, self.value))


@cache
def drives(store: SegmentStore, space: str, cells: int, config: EvaluateConfig) -> None:
    """Check that nothing is wrong with an agent whose networks are intact."""
    evaluate(make_agent(space, cells), store, config)


@pytest.mark.parametrize(("space", "cells", "search", "rule"), [
    *(("bicycle", 0, *how) for how in SEARCHES), *(("displacement", cells, "tree", "systematic") for cells in (0, 5)),
])  # fmt: skip
@pytest.mark.parametrize("network", ["policy", "goals", "discriminator"])
def test_weights_that_are_not_finite_are_found_at_once(store, network, space, cells, search, rule):
    config = EvaluateConfig(rollouts=2, search=search, rule=rule)
    drives(store, space, cells, config)
    broken = make_agent(space, cells)
    with torch.no_grad():
        for parameter in broken.modules[network].parameters():
            parameter.fill_(math.nan)
    if network == "discriminator" and search == "none":
        evaluate(broken, store, config)  # which does not ask it
        return
    name = {"goals": "goal policy"}.get(network, network)
    step = 1 if network == "discriminator" else 0
    expected = f"segment straight-0: the {name} put out a number that is not finite for agent 0 at step {step}"
    with pytest.raises(NotFiniteError, match=expected) as caught:
        evaluate(broken, store, config)
    assert isinstance(caught.value, SymphonyError)


@pytest.mark.parametrize(("search", "rule", "value", "batch"), [
    *((*how, math.nan, 3) for how in SEARCHES), ("tree", "best", math.inf, 3), ("none", "best", math.nan, 1),
])  # fmt: skip
def test_segment_and_step_are_those_where_it_began(store, search, rule, value, batch):
    good = make_agent()
    config = EvaluateConfig(rollouts=2, search=search, rule=rule, batch=batch)
    # Items of a batch of one are all its scene 0: the first segment is the bad one there.
    scene, segment = (0, "straight-0") if batch == 1 else (2, "crossing-2")
    broken = replace(good, policy=Spoiled(good.policy, keys.LOGITS, scene, 3, value))
    with pytest.raises(NotFiniteError, match=f"segment {segment}: the policy .* at step 3$"):
        evaluate(broken, store, config)
    if search != "none":
        broken = replace(good, discriminator=Spoiled(good.discriminator, keys.SCORE, scene, 3, value))
        with pytest.raises(NotFiniteError, match=f"segment {segment}: the discriminator .* at step 3$"):
            evaluate(broken, store, config)


def test_what_comes_after_the_end_of_a_segment_is_none_of_its_business(store: SegmentStore) -> None:
    """Else a short segment could be refused beside a longer one, and be fine alone."""
    good, config = make_agent(), EvaluateConfig(rollouts=2, search="tree")
    usual, last = evaluate(good, store, config).metrics.rows(), LENGTHS[1] - 1
    broken = replace(
        good,
        policy=Spoiled(good.policy, keys.LOGITS, 1, last),
        discriminator=Spoiled(good.discriminator, keys.SCORE, 1, last + 1),
    )
    assert evaluate(broken, store, config).metrics.rows() == usual
    for early in (
        replace(good, policy=Spoiled(good.policy, keys.LOGITS, 1, last - 1)),
        replace(good, discriminator=Spoiled(good.discriminator, keys.SCORE, 1, last)),
    ):
        with pytest.raises(NotFiniteError, match="crossing-1"):
            evaluate(early, store, config)


def test_a_run_that_breaks_while_it_trains_is_not_validated_in_silence(store, tmp_path):
    validation = ValidationConfig(data=store.path, rollouts=1)
    trainer = build(tiny("bc", store.path, tmp_path / "run", validation=validation))
    with torch.no_grad():
        for parameter in trainer.agent.modules["policy"].parameters():
            parameter.fill_(math.inf)
    with pytest.raises(NotFiniteError, match="segment straight-0: the policy"):
        trainer.validator(2)
