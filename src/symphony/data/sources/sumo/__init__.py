"""Simulated driving from SUMO: random networks and traffic, cut into run segments.

SUMO's programs come with the optional extra ``symphony-traffic[sumo]`` and run as subprocesses in a temporary folder.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from symphony.data.segment import RunSegment
from symphony.data.sources.base import located
from symphony.data.sources.sumo.extract import DT, CropRule, crop_rule, cut_segments
from symphony.data.sources.sumo.networks import (
    NETWORKS,
    RAMP_RADIUS,
    drive_as_drawn,
    freeway,
    is_own,
    kind_name,
    own_network,
)
from symphony.data.sources.sumo.process import scratch, sumo_version
from symphony.data.sources.sumo.roads import read_network
from symphony.data.sources.sumo.traffic import simulate_traffic, write_demand
from symphony.errors import ConfigError, DataError

__all__ = ["KINDS", "CropRule", "crop_rule", "generate_run", "is_own", "kind_name", "sumo_version"]

KINDS = tuple(NETWORKS)  # kinds of network that generate_run knows
WARM_UP = 30.0  # simulated seconds before the first segment starts, at least
_OWN = 4  # number of the user's own roads among the kinds
_OWN_FILLS = 3  # times as long a warm-up for the user's own roads, which may be larger
SUBLANE_SHARE = 1 / 3
_SLOW = 10.0  # m/s at which a longer freeway fills during a longer warm-up


def generate_run(
    kind: str, seed: int, duration: float = 150.0, *, rule: CropRule | None = None, straight: float = 1.0
) -> tuple[list[RunSegment], Counter[str]]:
    """Make one network, simulate its traffic once and cut run segments at 5 Hz out of it.

    Gives the segments, and how many windows gave none for which reason. The light of a movement is attached to the
    connector lane inside the junction, which only that takes; its stop point is the end of the lane before. Equal
    arguments give equal segments. Segments of one focus share one map object.

    A kind is one of :data:`KINDS`, or a file of your own roads (:data:`.networks.OWN_ROADS`); another seed is
    another network. ``duration`` is what is recorded, in seconds, after a warm-up. ``rule`` says how maps and egos
    are chosen, and how long segments are; by default the kind's own for 10 s. At a junction a route is ``straight``
    times as likely to go straight on as to take any one turn. A :class:`ConfigError` says what is wrong with an
    argument, a :class:`DataError` if SUMO is not installed or failed, with its message.
    """
    own, ramp, street = is_own(kind), kind == "ramp", kind == "street"
    if kind not in NETWORKS and not own:
        raise ConfigError(f"unknown kind of network {kind!r} (known: {', '.join(KINDS)})")
    rule = rule or crop_rule(kind)
    if not duration >= rule.steps * DT or seed < 0:
        least = f"a duration of at least {rule.steps * DT:.1f} s"
        raise ConfigError(f"needs a seed from 0, is {seed}, and {least}, is {duration}")
    seeds = np.random.SeedSequence([seed, _OWN if own else KINDS.index(kind)]).spawn(4)
    roads_rng, demand_rng, drive_rng, cut_rng = (np.random.default_rng(each) for each in seeds)
    with scratch() as folder:
        # A freeway must be longer than the map: a segment must not show what its ends do to traffic.
        longer = max(0.0, rule.radius - RAMP_RADIUS) if ramp else 0.0
        if own:
            file = own_network(Path(kind), folder)
        else:
            file = freeway(roads_rng, folder, longer) if ramp else NETWORKS[kind](roads_rng, folder)
        network = read_network(file)
        if not network.lanes:
            raise DataError("has no roads for cars", file=Path(kind))
        if own or street:
            with located(field="lanes"):
                drive_as_drawn(file, own=own)
        # On the user's own roads traffic comes from where streets begin at the edge of the map, and circulates.
        through = ramp or (own and bool(network.sources()))
        sublane = bool(drive_rng.random() < SUBLANE_SHARE) or street
        warm_up = WARM_UP * (_OWN_FILLS if own else 1) + longer / _SLOW
        end = warm_up + duration
        how = {"through": through, "around": not ramp, "sublane": sublane, "street": street}
        demand = write_demand(network, demand_rng, folder, end, **how, straight=straight)
        traffic = simulate_traffic(file, network, demand, drive_rng, end, warm_up, sublane=sublane)
    found, reasons = cut_segments(f"sumo-{kind_name(kind)}-{seed:06d}", network, traffic, cut_rng, rule)
    return [segment.replace(file=Path(kind).name) if own else segment for segment in found], reasons
