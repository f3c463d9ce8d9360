"""A planner of one's own as the ego, an included agent around it: python examples/planner.py

The same by the command line, from this folder:
symphony simulate pretrained:bc_ts_h --planner planner:Careful --data STORE --out sim
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.evaluation.report import report
from symphony.simulation.demonstrations import SceneDataset
from symphony.simulation.planner import Pose, Scenario, Traffic
from symphony.simulation.saving import save_simulation


class Careful:
    """Moves along its route as on a rail, and brakes for whoever is within three seconds ahead."""

    top_speed, braking, acceleration = 10.0, 3.0, 1.0

    def reset(self, scenario: Scenario) -> None:
        """Measure the route."""
        if len(scenario.route) < 2:
            raise ValueError("the ego is on no lane")
        self.dt, self.route = scenario.dt, scenario.route
        steps = np.linalg.norm(np.diff(self.route, axis=0), axis=-1)
        self.arc = np.concatenate([[0.0], np.cumsum(steps)])
        self.along, self.speed = 0.0, float(scenario.state[3])

    def plan(self, traffic: Traffic) -> Pose:
        """The next place on the route, slower where someone is near it."""
        others = traffic.valid.copy()
        others[traffic.ego] = False
        ahead = np.linspace(4.0, max(8.0, 3.0 * self.speed), 12) + self.along
        places = np.stack([self.place(s) for s in ahead])
        away = np.linalg.norm(places[:, None] - traffic.position[others], axis=-1)
        blocked = bool((away < 2.0).any())
        change = -self.braking if blocked else self.acceleration
        self.speed = min(max(self.speed + change * self.dt, 0.0), self.top_speed)
        self.along += self.speed * self.dt
        here, there = self.place(self.along), self.place(self.along + 1.0)
        heading = np.arctan2(*(there - here)[::-1])
        return Pose(*here, heading, self.speed)

    def place(self, along: float) -> np.ndarray:
        """The point of the route so many metres from its start, straight on past its end."""
        over = max(along - self.arc[-1], 0.0)
        last = (self.route[-1] - self.route[-2]) / (self.arc[-1] - self.arc[-2])
        return np.array([np.interp(along, self.arc, axis) for axis in self.route.T]) + over * last


def main(segments: int = 8, rollouts: int = 4, out: str = "") -> dict[str, float]:
    """Simulate segments of the included data, print what happened and return it."""
    agent, store = load_agent("pretrained:bc_ts_h"), SegmentStore(builtin_store("test"))
    dataset = SceneDataset(store, 2, agent.dynamics, range(segments), routes=True, duration=10)
    sys.path.append(str(Path(__file__).parent))
    path = out or mkdtemp()
    folder = save_simulation(
        path, agent, dataset, EvaluateConfig(rollouts=rollouts), planner="planner:Careful"
    )
    totals = report(folder, "ego").totals()
    for name in ("runs", "failed_runs", "collision_rate", "red_light_rate", "progress_ratio"):
        print(f"{name:24} {totals[name]:.2f}")
    print(f"symphony view {path}")
    return totals


if __name__ == "__main__":
    main()
