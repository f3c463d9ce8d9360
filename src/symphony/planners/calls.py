"""Calls of planners, whatever they do: exceptions are caught, and each answer has a time limit."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from symphony.planners.interface import Planner, Traffic

SECONDS = 60.0
"""Seconds of wall time that a planner has for one answer by default."""


class _Overdue(BaseException):
    """The error raised in the planner's own code; no ``except Exception`` there stops it."""


def plans_of(planners: Sequence[Planner], seen: Sequence[Traffic], seconds: float = SECONDS) -> list[Any]:
    """Ask planners, each for what it sees; return plans in their order, or the exceptions that ended the calls.

    Those of one class that has ``plan_batch`` are asked together, and fail together. Each call may take ``seconds``;
    in threads other than the first there is no limit.
    """
    found: list[Any] = [None] * len(planners)
    together: dict[type, list[int]] = {}
    for m, planner in enumerate(planners):
        if callable(getattr(type(planner), "plan_batch", None)):
            together.setdefault(type(planner), []).append(m)
        else:
            found[m] = answer(planner.plan, seen[m], seconds=seconds)
    for kind, members in together.items():
        given = answer(_batch, kind, [planners[m] for m in members], [seen[m] for m in members], seconds=seconds)
        for k, m in enumerate(members):
            found[m] = given if isinstance(given, Exception) else given[k]
    return found


def _batch(kind: Any, planners: list[Planner], seen: list[Traffic]) -> list[Any]:
    plans = list(kind.plan_batch(planners, seen))
    if len(plans) != len(planners):
        raise ValueError(f"plan_batch gave {len(plans)} plans for {len(planners)} planners")
    return plans


def answer(call: Any, *args: Any, seconds: float = SECONDS) -> Any:
    """Call a planner; return what it returns, or the exception that ended it: a TimeoutError if it took too long."""
    stopped: list[BaseException] = []
    try:
        with _at_most(seconds) as stopped:
            return call(*args)
    except _Overdue as late:
        return TimeoutError(f"took more than {seconds:g} s{late}")
    except BaseException as error:  # whatever a user's planner raises: a cancelled task is no Exception
        if isinstance(error, KeyboardInterrupt) or error in stopped:
            raise
        return error if isinstance(error, Exception) else RuntimeError(f"raised {error!r}")


@contextlib.contextmanager
def _at_most(seconds: float) -> Iterator[list[BaseException]]:
    """Raise ``_Overdue`` inside after this many seconds, where signals are available; give what signals raised."""
    if threading.current_thread() is not threading.main_thread():
        yield []
        return

    raised = list[BaseException]()  # and again at the end: a planner that catches everything must not keep them
    usual = {k: handler for k in (signal.SIGINT, signal.SIGTERM) if callable(handler := signal.getsignal(k))}

    def ring(number: int, frame: FrameType | None) -> None:
        where = "" if frame is None else f" ({Path(frame.f_code.co_filename).name}:{frame.f_lineno})"
        raised.append(_Overdue(where))
        raise raised[-1]

    def stop(number: int, frame: FrameType | None) -> None:
        try:
            usual[signal.Signals(number)](number, frame)
        except BaseException as error:
            raised.insert(0, error)
            raise

    handlers = {signal.SIGALRM: ring, **dict.fromkeys(usual, stop)}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield raised
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            if number == signal.SIGALRM or signal.getsignal(number) == handlers[number]:  # else it was turned off
                signal.signal(number, handler)
        if raised:
            raise raised[0]
