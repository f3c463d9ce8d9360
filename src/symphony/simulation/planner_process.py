"""A planner in another process, in any language: JSON over its standard input and output, a line each.

A process is started for every rollout. The first line it reads is ``{"reset": SCENE}``, every further one
``{"plan": NOW}``. It answers each with one line: ``reset`` with anything, such as ``{}``, ``plan`` with a plan:
``[acceleration, steering]``, ``[x, y, heading, speed]``, or a list of such states. ``{"error": "why"}`` ends the run.
Its input ends when the rollout does. What it writes to its standard error is shown.

SCENE has ``segment_id``, ``dt``, ``steps``, ``seed``, ``ego``, ``goal`` [2], ``route`` [[x, y], ...], ``lanes`` (each
with ``id``, ``points``, ``speed_limit`` or null, ``successors``) and ``lights`` (``x``, ``y``, ``lane``). NOW has
``time``, ``step``, ``ego`` (``x``, ``y``, ``heading``, ``speed``, ``length``, ``width``), ``agents`` (lists ``x``,
``y``, ``heading``, ``vx``, ``vy``, ``length``, ``width``, ``type``, ``id``), ``route`` (what lies ahead) and
``lights`` (their states). Units and words are those of :class:`symphony.simulation.planner_view.Observation`.
"""

from __future__ import annotations

import contextlib
import json
import shlex
import subprocess
import weakref
from typing import Any

from symphony.simulation.planner import Scenario, Traffic
from symphony.simulation.planner_view import Ego, lanes_of, observation_of


class ProcessPlanner:
    """Asks a process of its own.

    Args:
        command: that starts it, as in a shell without its special characters.
    """

    def __init__(self, command: str) -> None:
        self.command = command
        self._process: subprocess.Popen[str] | None = None

    def reset(self, scenario: Scenario) -> None:
        """Start the process and tell it the scene."""
        self.scenario = scenario
        self._process = subprocess.Popen(  # noqa: S603 - the user's own command
            shlex.split(self.command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8"
        )
        weakref.finalize(self, _end, self._process)
        lanes = [
            {
                "id": lane.id,
                "points": lane.points.tolist(),
                "speed_limit": None if lane.speed_limit != lane.speed_limit else lane.speed_limit,
                "successors": list(lane.successors),
            }
            for lane in lanes_of(scenario)
        ]
        x, y = scenario.signal_point.T.tolist()
        lane = scenario.road.lane_id[scenario.signal_lane].tolist()
        self._ask(
            "reset",
            {
                "segment_id": scenario.segment_id,
                "dt": scenario.dt,
                "steps": scenario.steps,
                "seed": scenario.seed,
                "ego": Ego(*scenario.state.tolist(), *scenario.size.tolist())._asdict(),
                "goal": scenario.goal.tolist(),
                "route": scenario.route.tolist(),
                "lanes": lanes,
                "lights": {"x": x, "y": y, "lane": lane},
            },
        )

    def plan(self, traffic: Traffic) -> Any:
        """What it answers."""
        seen = observation_of(self.scenario, traffic, ())
        now = {
            "time": seen.time,
            "step": seen.step,
            "ego": seen.ego._asdict(),
            "agents": {name: value.tolist() for name, value in seen.agents._asdict().items()},
            "route": seen.route.tolist(),
            "lights": seen.lights.state.tolist(),
        }
        return self._ask("plan", now)

    def _ask(self, what: str, told: dict[str, Any]) -> Any:
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            raise RuntimeError("the planner's process was not started")
        try:
            process.stdin.write(json.dumps({what: told}, allow_nan=False) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line.endswith("\n"):
            raise RuntimeError(
                f"the planner's process ended (status {process.wait()}) without an answer to {what}"
            )
        given = json.loads(line)
        if isinstance(given, dict) and "error" in given:
            raise RuntimeError(str(given["error"]))
        return given

    def __deepcopy__(self, memo: dict[int, Any]) -> ProcessPlanner:
        raise TypeError("a process can't be copied")


def _end(process: subprocess.Popen[str]) -> None:
    """The process is told that nothing more comes, and ended where it goes on."""
    with contextlib.suppress(BrokenPipeError):
        if process.stdin is not None:
            process.stdin.close()
    try:
        process.wait(0.2)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()
