"""Scenes with known truth in which one road lies above another."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from made import NORTH, OWN, RED, RIGHT, Case, Track
from scenes import car, ego, hit, stops


# One scene in few lines, so that they can be compared.
# fmt: off
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
        Case("the same beneath the bridge", "both are on the ground", below, (replace(above, z=0.0),), met,
            bridge=6.0),
        Case("the same where the road across is 2.4 m higher",
            "no car fits in between: heights that differ by less than 2.5 m are of one level", below,
            (replace(above, z=2.4),), met, bridge=2.4),
        Case("behind its log under one on a bridge", "it is as high as its log is where it is", below, (above,),
            {"ttc": None, "offroad": 0.0}, log=replace(below, speed=12.0), bridge=6.0),
        Case("on a bridge over one that stands", "it stands 6 m lower", on_it, (car(165, OWN, 0.0),), nothing,
            bridge=6.0),
        Case("into one that stands on the bridge", "both are on it", on_it, (car(165, OWN, 0.0, z=6.0),),
            hit("crossing", True, 4.0), bridge=6.0),
        Case("stands where one waits across", "somebody is ahead", stands, (waits,), {"blocking": False},
            log=ego(x=145, y=RIGHT)),
        Case("stands where one waits on a bridge", "who is above is not ahead", stands,
            (replace(waits, z=6.0),), {"blocking": True}, log=ego(x=145, y=RIGHT), bridge=6.0),
        *rules(),
    ]


def rules() -> list[Case]:
    """Lanes and lights are those of the level that an agent is on: a road to the west, 6 m above the eastern lane."""
    red = ((0.0, RED),)
    deck: dict[str, Any] = {"deck": 6.0}
    west = Track(250, OWN, 10.0, math.pi)
    waits = replace(stops(west, 0.0, 5.0), x=165.0)
    street = Track(165, -100.0, 10.0, NORTH)
    stands = replace(stops(street, 0.0, 5.0), y=-60.0)
    return [
        Case("a red light below a deck", "its light", ego(x=100), (), {"red": 1}, light=red, **deck),
        Case("over a red light on the deck", "the light is below; the deck leads the other way",
            ego(x=100, z=6.0), (), {"red": 0, "wrong": True}, light=red, **deck),
        Case("westward on the deck", "its way", replace(west, z=6.0), (), {"wrong": False}, **deck),
        Case("westward below the deck", "the lane above is another", west, (), {"wrong": True}, **deck),
        Case("eastward below the deck", "its lane", ego(), (), {"wrong": False}, **deck),
        Case("an oncoming one in the ego's lane below the deck",
            "the other is where it must not be: the lane above is not its own", ego(),
            (car(120, OWN, 10.0, math.pi),), hit("oncoming", False, (80 - 4.5) / 20), **deck),
        Case("stands on the deck over a red light", "no light is on its road", replace(waits, z=6.0), (),
            {"blocking": True, "red": 0}, log=replace(west, z=6.0), light=red, **deck),
        Case("stands on the ground beneath a bridge", "the lane is above", stands, (), {"blocking": False},
            log=street, bridge=6.0),
        Case("stands on the bridge", "it blocks it", replace(stands, z=6.0), (), {"blocking": True},
            log=replace(street, z=6.0), bridge=6.0),
    ]
