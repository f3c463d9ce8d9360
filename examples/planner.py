"""Your own planner as the ego, with an included agent around it: python examples/planner.py

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
from symphony.data.segment import SignalState
from symphony.data.store import SegmentStore
from symphony.evaluation.report import report
from symphony.learning.demonstrations import SceneDataset
from symphony.planners.interface import Pose, Scenario, Traffic
from symphony.saved.saving import save_simulation

STOP = (SignalState.STOP, SignalState.ARROW_STOP)


class Careful:
    """Goes along its route, slower in bends, and brakes for red lights and for any agent in its way."""

    top_speed, braking, acceleration, sideways = 10.0, 3.0, 1.0, 2.0  # m/s and m/s^2

    def reset(self, scenario: Scenario) -> None:
        """Measure the route: how fast each metre of it may be taken, and where its lights stand."""
        if len(scenario.route) < 2:
            raise ValueError("the ego is on no lane")
        self.dt, self.route = scenario.dt, scenario.route
        steps = np.linalg.norm(np.diff(self.route, axis=0), axis=-1)
        self.arc = np.concatenate([[0.0], np.cumsum(steps)])
        self.along, self.speed = 0.0, float(scenario.state[3])
        self.aside = scenario.state[:2] - self.route[0]
        metres = np.arange(0.0, self.arc[-1] + 60.0)
        points = self.place(metres)
        x, y = (points[4:] - points[:-4]).T
        turn = np.abs(np.diff(np.unwrap(np.arctan2(y, x)), prepend=0, append=0))
        turn[[0, -1]] = 0.0
        bend = np.pad(turn, 2)[: len(metres)]
        self.limit = np.minimum(self.top_speed, np.sqrt(self.sideways / np.maximum(bend, 1e-3)))
        away = np.linalg.norm(scenario.signal_point[:, None] - points, axis=-1)
        self.light_at = np.where(away.min(1, initial=9.0) < 1.5, away.argmin(1) if away.size else 0, -1)

    def plan(self, traffic: Traffic) -> Pose:
        """Return the next place on the route, at a speed from which it can still brake for all that lies ahead."""
        others = traffic.valid.copy()
        others[traffic.ego] = False
        ahead = np.linspace(4.0, max(8.0, 3.0 * self.speed), 12)
        away = self.place(self.along + ahead)[:, None] - traffic.position[others]
        blocked = bool((np.linalg.norm(away, axis=-1) < 2.0).any())
        red = np.isin(traffic.lights, STOP)
        lines = [at - self.along - 3.0 for at in self.light_at[red] if at >= self.along + 3.0]
        metres = np.arange(50)
        allowed = np.interp(self.along + metres, np.arange(len(self.limit)), self.limit)
        allowed = np.sqrt(allowed**2 + 1.4 * self.braking * metres).min()
        for line in lines:
            allowed = min(allowed, np.sqrt(1.4 * self.braking * line))
        slowest, fastest = self.speed - self.braking * self.dt, self.speed + self.acceleration * self.dt
        self.speed = max(0.0, slowest if blocked else min(max(allowed, slowest), fastest))
        self.along += self.speed * self.dt
        here, there = self.place(np.array([self.along, self.along + 1.0]))
        heading = np.arctan2(*(there - here)[::-1])
        return Pose(*here, heading, self.speed)

    def place(self, along: np.ndarray) -> np.ndarray:
        """Return points [N, 2] at ``along`` metres [N] from the start of the route, straight on past its end."""
        last = (self.route[-1] - self.route[-2]) / (self.arc[-1] - self.arc[-2])
        points = np.stack([np.interp(along, self.arc, axis) for axis in self.route.T], -1)
        points = points + np.maximum(along - self.arc[-1], 0.0)[:, None] * last
        # From beside the route, where it stood, it comes onto it within some 20 m.
        return points + self.aside * np.exp(-((along[:, None] / 10.0) ** 2))


def main(segments: int = 8, rollouts: int = 4, out: str = "") -> dict[str, float]:
    """Simulate segments of the included data, print what happened and return it."""
    agent, store = load_agent("pretrained:bc_ts_h"), SegmentStore(builtin_store("test"))
    dataset = SceneDataset(store, 2, agent.dynamics, range(segments), routes=True, duration=10)
    sys.path.append(str(Path(__file__).parent))
    path = out or mkdtemp()
    folder = save_simulation(path, agent, dataset, EvaluateConfig(rollouts=rollouts), planner="planner:Careful")
    totals = report(folder, "ego").totals()
    for name in ("runs", "failed_runs", "collision_rate", "red_light_rate", "progress_ratio"):
        print(f"{name:24} {totals[name]:.2f}")
    print(f"symphony view {path}")
    return totals


if __name__ == "__main__":
    main()
