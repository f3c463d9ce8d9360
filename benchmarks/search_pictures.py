"""Draw what a search does to one run segment: ``python benchmarks/search_pictures.py --out docs/search.png``.

Above are 16 branches of a tree that a rule prunes, below 16 lines that go back. Discarded simulations are orange.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from symphony import SegmentStore, builtin_store, keys, load_agent
from symphony.agents import Agent
from symphony.collectors import Backtrack, ReplaceBad, beam_search, max_then_sum
from symphony.data.segment import RunSegment
from symphony.data.selection import interactive_agents
from symphony.envs.driving import DrivingEnv
from symphony.envs.scene import collate, scene
from symphony.modules import SeededNoise
from symphony.render.roads import draw_roads
from symphony.render.style import frame, save, view_around
from symphony.roadgraph import LaneGraph
from symphony.rollouts.search import going_back, pruning_noise, rule_score, with_drawn_goals
from symphony.rollouts.unroll import start_states

KEPT, LOST, BRANCHES, EVERY = "#0072B2", "#D55E00", 16, 2
Steps = list[tuple[int, int, int, bool, NDArray[np.float32]]]
"""Steps that were simulated: line, try, number, whether it is part of what came out, where [2, 2] the agents were."""
Copies = list[tuple[int, int, int]]
"""After which step a branch was copied over another, that one, and the other."""


def simulated(agent: Agent, segment: RunSegment, seed: int, *, back: bool) -> tuple[Steps, Copies]:
    """Return all steps of a search of one run segment, a tree or lines that go back, and the copied branches."""
    scenes = collate([scene(segment, interactive_agents(segment, 2).tolist(), LaneGraph(segment.road))])
    env = DrivingEnv(scenes, agent.dynamics, agent.observation)
    trees, branches = (BRANCHES, 1) if back else (1, BRANCHES)
    start = start_states(env, agent.goals, seed=seed, goals_per="branch", trees=trees, branches=branches)
    first = start.get(keys.STREAM).flatten().tolist()
    # A line that goes back gets random numbers of a stream of its own: line and try by stream.
    of = {stream: (line, 0) for line, stream in enumerate(first)}
    seen: list[tuple[Tensor, Tensor, Tensor]] = []

    def score(state: TensorDictBase) -> Tensor:
        seen.append(tuple(state.get(key).flatten(0, state.ndim - 1) for key in (keys.STREAM, keys.STEP, keys.STATE)))
        return rule_score(env, state)

    rule: Backtrack | ReplaceBad = ReplaceBad(0.0)
    if back:
        plain = going_back(
            env, 0.0, start, lambda state, _: with_drawn_goals(env, agent.goals, state, seed, "branch")
        )

        def renew(state: TensorDictBase, attempt: Int[Tensor, " R"]) -> TensorDictBase:
            before = state.get(keys.STREAM).flatten().tolist()
            after = state if plain.renew is None else plain.renew(state, attempt)
            for old, new, number in zip(
                before, after.get(keys.STREAM).flatten().tolist(), attempt.tolist(), strict=True
            ):
                of[new] = of[old][0], number
            return after

        rule = replace(plain, renew=renew)
    found = beam_search(
        env,
        TensorDictSequential(SeededNoise(seed, env.dynamics.numbers), agent.policy),
        score,
        start,
        steps=env.decisions,
        prune_every=EVERY,
        rule=rule,
        aggregate=max_then_sum,
        slot_keys=(keys.STREAM,),
        group_key=None if back else keys.GOAL,
        noise=pruning_noise(seed)(start, -(-env.decisions // EVERY)),
    )
    ends = found.trajectories
    if back:
        kept = set(zip(ends.get(keys.STREAM).flatten().tolist(), ends.get(keys.STEP).flatten().tolist(), strict=True))
    else:
        kept = {
            (first[slot], period * EVERY + step)
            for period, slots in enumerate(found.slots.flatten(0, -3)[0].tolist())
            for slot in slots
            for step in range(EVERY)
        }
    steps: Steps = []
    for streams, numbers, states in seen:
        for stream, number, place in zip(streams.flatten().tolist(), numbers.flatten().tolist(), states, strict=True):
            line, attempt = of[stream]
            steps.append((line, attempt, number, (stream, number - 1) in kept, place[:, :2].numpy()))
    if back:
        return steps, []
    parents = enumerate(found.parents.flatten(0, -3)[0].tolist(), 1)
    return steps, [(n * EVERY, old, new) for n, row in parents for new, old in enumerate(row) if old != new]


def draw_over_time(axes: Axes, steps: Steps, copies: Copies, dt: float, title: str) -> None:
    """Draw a row for each line; what it tried before it went back lies below it."""
    high = max(attempt for _, attempt, *_ in steps) + 1
    for color, width, wanted in ((LOST, 1.0, False), (KEPT, 2.2, True)):
        rows = [(line + 0.7 * attempt / high, number) for line, attempt, number, good, _ in steps if good is wanted]
        bars = [[((number - 1) * dt, row), (number * dt, row)] for row, number in rows]
        axes.add_collection(LineCollection(bars, colors=color, linewidths=width, capstyle="butt"))
    for number, old, new in copies:
        axes.annotate("", (number * dt, new), (number * dt, old), arrowprops={"arrowstyle": "->", "color": "#6F6A62"})
    axes.set(xlim=(0, max(number for _, _, number, *_ in steps) * dt), ylim=(BRANCHES, -0.5), xlabel="s", yticks=[])
    axes.set_title(title, loc="left", fontsize=10)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def draw_on_map(axes: Axes, steps: Steps, segment: RunSegment) -> None:
    """Draw where both agents were in every step."""
    view = view_around(np.concatenate([place for *_, place in steps]), margin=8.0, least=40.0)
    draw_roads(axes, segment.road, view)
    for color, size, wanted in ((KEPT, 1.2, True), (LOST, 1.6, False)):
        dots = np.concatenate(
            [place for *_, good, place in steps if good is wanted] or [np.zeros((0, 2), np.float32)]
        )
        axes.scatter(dots[:, 0], dots[:, 1], s=size, color=color, zorder=9 if wanted else 10)
    frame(axes, view, "", "")


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    parser.add_argument("--agent", default="pretrained:bc_ts_h", help="agent that drives")
    parser.add_argument("--data", type=Path, default=builtin_store("test"), help="store of run segments")
    parser.add_argument("--segment", type=int, default=0, help="number of the run segment in the store")
    parser.add_argument("--seed", type=int, default=0, help="of the simulation")
    given = parser.parse_args()
    agent, segment = load_agent(given.agent), SegmentStore(given.data)[given.segment]
    figure = Figure((9, 7), layout="constrained")
    for axes, back in zip(figure.subplots(2, 2, width_ratios=(1.2, 1)), (False, True), strict=True):
        with torch.no_grad():
            steps, copies = simulated(agent, segment, given.seed, back=back)
        draw_on_map(axes[0], steps, segment)
        lost = sum(not good for *_, good, _ in steps) / len(steps)
        name = "16 lines that go back" if back else "16 branches of a tree"
        draw_over_time(axes[1], steps, copies, segment.dt, f"{name}: {100 * lost:.0f} % of the steps given up")
    save(figure, given.out)


if __name__ == "__main__":
    main()
