"""Scenes with known truth in which one road lies above another."""

from __future__ import annotations

from dataclasses import replace

from made import NORTH, OWN, RIGHT, Case, Track
from scenes import car, ego, hit, stops


def bridges() -> list[Case]:
    """A road over another one: who meets whom is only who would without the other road."""
    below = ego(8.0, x=165 - 0.9 - 2.25 - 48)
    above = car(165, OWN - 6 * 6, 6.0, NORTH, z=6.0)
    on_it = Track(165, OWN - 0.9 - 2.25 - 40, 10.0, NORTH, z=6.0)
    nothing = {"ttc": None, "low_ttc": False, "offroad": 0.0, "ratio": 1.0}
    met = hit("crossing", True, 6.0, low_ttc=True)
    stands, waits = stops(ego(x=145), 0.0, 5.0), car(165, OWN, 0.0, NORTH)
    return [
        Case("under one on a bridge", "it drives 6 m higher", below, (above,), nothing, bridge=6.0),
        Case("the same without the bridge", "the nose meets a flank", below, (replace(above, z=0.0),), met),
        Case(
            "the same beneath the bridge",
            "both are on the ground",
            below,
            (replace(above, z=0.0),),
            met,
            bridge=6.0,
        ),
        Case(
            "the same where the road across is 2.4 m higher",
            "no car fits in between: heights that differ by less than 2.5 m are of one level",
            below,
            (replace(above, z=2.4),),
            met,
            bridge=2.4,
        ),
        Case(
            "behind its log under one on a bridge",
            "it is as high as its log is where it is",
            below,
            (above,),
            {"ttc": None, "offroad": 0.0},
            log=replace(below, speed=12.0),
            bridge=6.0,
        ),
        Case(
            "on a bridge over one that stands",
            "it stands 6 m lower",
            on_it,
            (car(165, OWN, 0.0),),
            nothing,
            bridge=6.0,
        ),
        Case(
            "into one that stands on the bridge",
            "both are on it",
            on_it,
            (car(165, OWN, 0.0, z=6.0),),
            hit("crossing", True, 4.0),
            bridge=6.0,
        ),
        Case(
            "stands where one waits across",
            "somebody is ahead",
            stands,
            (waits,),
            {"blocking": False},
            log=ego(x=145, y=RIGHT),
        ),
        Case(
            "stands where one waits on a bridge",
            "who is above is not ahead",
            stands,
            (replace(waits, z=6.0),),
            {"blocking": True},
            log=ego(x=145, y=RIGHT),
            bridge=6.0,
        ),
    ]
