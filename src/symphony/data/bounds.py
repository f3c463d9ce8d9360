"""Limits of the schema.

The sizes keep one record of a log, whatever it claims to hold, within some hundred megabytes of memory; readers look
at them before they allocate anything.
"""

from __future__ import annotations

from symphony.errors import DataError

MAX_COORDINATE = 20_000.0  # metres from the origin, beyond which float32 no longer resolves a millimetre
MAX_HEIGHT = 10_000.0  # metres above or below the origin
MAX_ORIGIN = 1e8  # metres; map projections count in the millions
MIN_DT, MAX_DT = 0.005, 5.0  # seconds per step
MAX_SPEED = 350.0  # m/s; nothing on wheels was ever faster
MAX_JUMP = 1000.0  # metres from one step to the next
MIN_SIZE, MAX_SIZE = 0.05, 100.0  # metres of a box's side
MAX_HEADING = 1000.0  # radians: headings need not be wrapped, but nobody turns that often
MAX_WIDTH = 1000.0  # metres of a lane
MAX_NAME = 200  # characters of a segment's id, its source, its group and the name of its file

MAX_STEPS = 10_000  # a quarter of an hour at 10 Hz
MAX_AGENTS = 5_000
MAX_STATES = 2_000_000  # agents times steps
MAX_POINTS = 1_000_000  # of a map
MAX_LENGTH = 5e6  # metres of all lines of a map
MAX_FILE = 64 << 20  # bytes of a file that is read as a whole (CommonRoad, Argoverse 2)


def check_counts(agents: int, steps: int, field: str) -> None:
    """Refuse more agents or steps than a segment may have before room is made for them; the error names ``field``."""
    for count, most, what in (
        (steps, MAX_STEPS, "steps"),
        (agents, MAX_AGENTS, "agents"),
        (agents * steps, MAX_STATES, "states (agents times steps)"),
    ):
        if count > most:
            raise DataError(f"{count} {what}, at most {most} are read: cut the log", field=field)


def check_signals(lights: int, steps: int, field: str) -> None:
    """Refuse more states of traffic lights than can be read; the error names ``field``."""
    if lights * steps > 10 * MAX_STATES:
        raise DataError(f"{lights} lights at {steps} steps, too many to read", field=field)
