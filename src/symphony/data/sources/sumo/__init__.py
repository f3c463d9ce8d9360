"""Simulated driving from SUMO: random networks and traffic, cut into run segments.

SUMO's programs come with the optional extra ``symphony-traffic[sumo]`` and run as subprocesses in a temporary folder.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from symphony.data.segment import RunSegment
from symphony.data.sources.sumo.demand import write_demand
from symphony.data.sources.sumo.extract import DT, STATES, CropRule, crop_rule, cut_segments
from symphony.data.sources.sumo.networks import NETWORKS, RAMP_RADIUS, freeway, is_own, kind_name, own_network
from symphony.data.sources.sumo.process import scratch, sumo_home, sumo_version
from symphony.data.sources.sumo.roads import read_network
from symphony.data.sources.sumo.simulate import simulate_traffic
from symphony.errors import ConfigError

__all__ = [
    "DT",
    "KINDS",
    "STATES",
    "CropRule",
    "Generated",
    "crop_rule",
    "generate_run",
    "is_own",
    "kind_name",
    "sumo_home",
    "sumo_version",
]

KINDS = tuple(NETWORKS)
"""Kinds of network that :func:`generate_run` knows."""
WARM_UP = 30.0
"""Simulated seconds before the first segment starts, at least."""
_OWN = 4
"""Number of roads of one's own among the kinds; 3 was one that is gone."""
_OWN_FILLS = 3
"""Times as long a warm-up for roads of one's own, which may be larger."""
SUBLANE_SHARE = 1 / 3
_SLOW = 10.0
"""m/s at which a longer freeway fills during a longer warm-up."""


@dataclass(frozen=True)
class Generated:
    """One simulation's segments.

    Attributes:
        segments: those accepted.
        reasons: how many windows gave none, and why.
    """

    segments: list[RunSegment]
    reasons: Counter[str] = field(default_factory=Counter)


def generate_run(
    kind: str,
    seed: int,
    duration: float = 150.0,
    *,
    rule: CropRule | None = None,
    straight: float = 1.0,
) -> Generated:
    """Make one network, simulate its traffic once and cut run segments at 5 Hz out of it.

    The light of a movement is attached to the connector lane inside the junction, which only that movement
    takes; its stop point is the end of the lane before. Equal arguments give equal segments. Segments of one focus
    share one map object.

    Args:
        kind: one of :data:`KINDS`, or a file of roads of one's own (:data:`.networks.OWN_ROADS`).
        seed: of every random choice; another seed is another network.
        duration: recorded seconds, after a warm-up.
        rule: how maps and egos are chosen, and how long segments are (:func:`crop_rule`); the kind's own for
            10 s where not given.
        straight: how many times likelier a route goes straight on at a junction than it takes one of the turns.

    Raises:
        ConfigError: unknown kind, a bad duration or seed.
        DataError: SUMO is not installed or failed (with its message).
    """
    own = is_own(kind)
    if kind not in NETWORKS and not own:
        raise ConfigError(f"unknown kind of network {kind!r} (known: {', '.join(KINDS)})")
    rule = rule or crop_rule(kind)
    if not duration >= rule.steps * DT:
        raise ConfigError(f"duration must be at least {rule.steps * DT:.1f} s, is {duration}")
    if seed < 0:
        raise ConfigError(f"seed must not be negative, is {seed}")
    roads_rng, demand_rng, drive_rng, cut_rng = (
        np.random.default_rng(s)
        for s in np.random.SeedSequence([seed, _OWN if own else KINDS.index(kind)]).spawn(4)
    )
    with scratch() as folder:
        # A freeway must be longer than the map: what its ends do to traffic is not for a segment to show.
        longer = max(0.0, rule.radius - RAMP_RADIUS) if kind == "ramp" else 0.0
        if own:
            file = own_network(Path(kind), folder)
        else:
            file = freeway(roads_rng, folder, longer) if kind == "ramp" else NETWORKS[kind](roads_rng, folder)
        network = read_network(file)
        # Where streets end at the edge of the map, traffic comes from there; else it circulates.
        through = kind == "ramp" or (own and bool(network.sources()))
        sublane = bool(drive_rng.random() < SUBLANE_SHARE)
        warm_up = WARM_UP * (_OWN_FILLS if own else 1) + longer / _SLOW
        end = warm_up + duration
        routes, size = write_demand(
            network, demand_rng, folder, end, through=through, sublane=sublane, straight=straight
        )
        traffic = simulate_traffic(file, network, routes, size, drive_rng, end, warm_up, sublane=sublane)
    segments, reasons = cut_segments(f"sumo-{kind_name(kind)}-{seed:06d}", network, traffic, cut_rng, rule)
    return Generated(segments, reasons)
