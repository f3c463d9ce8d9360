"""A planner in another process, in any language: JSON over its standard input and output, a line each.

A process is started for every rollout. The first line it reads is ``{"reset": SCENE}``, every further one ``{"plan":
NOW}``. It answers each with one line: ``reset`` with ``{}``, ``plan`` with ``{"step": STEP, "plan": PLAN}``: the step
it was asked about, and ``[acceleration, steering]``, ``[x, y, heading, speed]``, or a list of such states.
``{"error": "why"}`` ends the run, and so does anything else it writes to its standard output: a line more than it was
asked for, one of another step, or one of more than :data:`LONGEST` bytes. Its input ends when the rollout does; then,
after :data:`GRACE` seconds, what is left of its process group is killed. Its standard error is shown.

Of the environment it gets ``PATH``, ``HOME``, ``LANG``, names that begin with ``PYTHON``, and those that
``SYMPHONY_PLANNER_ENV`` names, separated by commas.

SCENE has ``segment_id``, ``dt``, ``steps``, ``seed``, ``ego``, ``goal`` [2], ``route`` [[x, y], ...], ``lanes``,
``crosswalks`` and ``lights`` (``x``, ``y``, ``lane``). NOW has ``time``, ``step``, ``ego``, ``agents``, ``history``,
``route`` (what lies ahead) and ``lights`` (their states). Units and words are those of
:class:`symphony.planners.view.Observation`; what is not known is null.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import shlex
import signal
import subprocess
import time
import weakref
from typing import Any

import numpy as np

from symphony.planners.interface import Scenario, Traffic
from symphony.planners.view import Ego, crosswalks_of, lanes_of, observation_of

LONGEST = 1 << 20
"""Bytes of an answer."""
GRACE = 0.2
"""Seconds that a process has to end by itself."""
NAMES = "SYMPHONY_PLANNER_ENV"
"""Names the variables that planners get beside the usual ones."""


class ProcessPlanner:
    """A planner that asks a process of its own.

    Args:
        command: the command that starts it, as in a shell without its special characters.
    """

    def __init__(self, command: str) -> None:
        self.command = command

    def reset(self, scenario: Scenario) -> None:
        """Start the process and tell it the scene."""
        self.scenario = scenario
        self._process = subprocess.Popen(  # noqa: S603 - the user's own command
            shlex.split(self.command),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env=environment(),
            start_new_session=True,  # a group of its own, which can be ended with it
        )
        self._ended = weakref.finalize(self, _end, self._process)
        x, y = scenario.signal_point.T.tolist()
        told = {name: getattr(scenario, name) for name in ("segment_id", "dt", "steps", "seed")}
        told |= {
            "ego": Ego(*scenario.state.tolist(), *scenario.size.tolist())._asdict(),
            "goal": scenario.goal.tolist(),
            "route": scenario.route.tolist(),
            "lanes": [_plain(lane) for lane in lanes_of(scenario)],
            "crosswalks": _plain(crosswalks_of(scenario)),
            "lights": {"x": x, "y": y, "lane": scenario.road.lane_id[scenario.signal_lane].tolist()},
        }
        given = self._ask("reset", told)
        if not isinstance(given, dict):
            self._ended()
            raise ValueError(f"answered reset with {str(given)[:80]}, not with {{}}")

    def plan(self, traffic: Traffic) -> Any:
        """Return the plan that the process answers."""
        seen = observation_of(self.scenario, traffic)
        now = {
            "time": seen.time,
            "step": seen.step,
            "ego": _plain(seen.ego),
            "agents": _plain(seen.agents),
            "history": [_plain(one) for one in seen.history],
            "route": seen.route.tolist(),
            "lights": seen.lights.state.tolist(),
        }
        given = self._ask("plan", now)
        if not isinstance(given, dict) or "plan" not in given or given.get("step") != seen.step:
            self._ended()
            raise ValueError(
                f'answered {json.dumps(given)[:80]}, not {{"step": {seen.step}, "plan": ...}}: a line too many, '
                "or the answer to another step"
            )
        return given["plan"]

    def _ask(self, what: str, told: dict[str, Any]) -> Any:
        try:
            return self._answer(what, json.dumps({what: told}, allow_nan=False).encode())
        except BaseException:
            self._ended()
            raise

    def _answer(self, what: str, told: bytes) -> Any:
        pipe, waiting = self._process.stdout, select.poll()
        assert pipe is not None and self._process.stdin is not None  # noqa: S101, PT018 - as asked for
        waiting.register(pipe, select.POLLIN)
        line = os.read(pipe.fileno(), 80) if waiting.poll(0) else b""
        if line:
            raise ValueError(f"wrote more than one line for an answer: {line.decode(errors='replace')!r}")
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(told + b"\n")
        while b"\n" not in line:
            part = os.read(pipe.fileno(), 1 << 16)
            if not part:
                how = f"ended (status {self._ended()}) without an answer to {what}"
                raise RuntimeError(f"the planner's process {how}")
            line += part
            if len(line) > LONGEST:
                raise ValueError(f"an answer of more than {LONGEST} bytes")
        line, _, more = line.partition(b"\n")
        if more:
            raise ValueError(f"wrote more than one line for an answer: {more[:80].decode(errors='replace')!r}")
        given = json.loads(line.decode())
        if isinstance(given, dict) and "error" in given:
            raise RuntimeError(str(given["error"]))
        return given

    def __deepcopy__(self, memo: dict[int, Any]) -> ProcessPlanner:
        raise TypeError("a process can't be copied")


def _plain(value: Any) -> Any:
    """Return a record, an array or a number as JSON has it: null where it is not known."""
    if hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    array = np.asarray(value)
    return None if array.dtype.kind == "f" and np.isnan(array).any() else array.tolist()


def environment() -> dict[str, str]:
    """Return the part of our environment that a planner's process gets: it must not see secrets in the rest."""
    named = {"PATH", "HOME", "LANG", *os.environ.get(NAMES, "").replace(" ", "").split(",")}
    return {name: value for name, value in os.environ.items() if name in named or name.startswith("PYTHON")}


def _end(process: subprocess.Popen[bytes]) -> int:
    """Tell the process that nothing more comes, kill it and all it started where it goes on; return its status."""
    with contextlib.suppress(BrokenPipeError):
        if process.stdin is not None:
            process.stdin.close()
    late = time.monotonic() + GRACE
    # Left unreaped until its group is killed: until then no other process gets its number.
    asked = os.WEXITED | os.WNOWAIT | os.WNOHANG
    with contextlib.suppress(ChildProcessError):
        while os.waitid(os.P_PID, process.pid, asked) is None and time.monotonic() < late:
            time.sleep(0.002)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    if process.stdout is not None:
        process.stdout.close()
    return process.wait()
