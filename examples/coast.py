"""The shortest possible planner, and one to compare others with: it keeps its speed and never turns.

symphony simulate pretrained:bc_ts_h --planner examples/coast.py:plan --data STORE --out sim
"""

from symphony.planners.view import Observation


def plan(observation: Observation) -> tuple[float, float]:
    """Return no acceleration and no steering."""
    return 0.0, 0.0
