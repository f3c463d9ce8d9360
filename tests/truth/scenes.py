"""Scenes whose right values are known: who drives how, what a report must say of it, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from made import GREEN, NORTH, OWN, RED, RIGHT, WALKER, WEST, Case, Track

from symphony.data.segment import AgentType, SignalState


def ego(speed: float = 10.0, x: float = 40.0, y: float = OWN, **more: Any) -> Track:
    """The ego in its lane."""
    return Track(x, y, speed, **more)


def car(x: float, y: float = OWN, speed: float = 10.0, heading: float = 0.0, **more: Any) -> Track:
    """Another one."""
    return Track(x, y, speed, heading, **more)


def walker(x: float, y: float, speed: float = 1.2, heading: float = NORTH, **more: Any) -> Track:
    """Somebody on foot."""
    return Track(x, y, speed, heading, size=WALKER, kind=AgentType.PEDESTRIAN, **more)


def stops(track: Track, at: float, braking: float) -> Track:
    """Return the same drive, braking to a stand from some second on."""
    return replace(track, change=(at, at + track.speed / braking, -braking))


def hit(kind: str, fault: bool, at: float | None = None, **more: Any) -> dict[str, Any]:
    """Values of a collision of this kind, at a second where that is plain."""
    return {"kind": kind, "fault": fault, "at": at, **more}


# One scene in few lines, so that they can be compared.
# fmt: off
def collisions() -> list[Case]:
    """Who drives into whom."""
    found = []
    for v in (5.0, 10.0, 20.0, 35.0):
        # The front is 2.25 m ahead; somebody on foot stands 0.3 m deep, 20 m ahead of it.
        found.append(Case(f"into a pedestrian who stands, at {v:g}",
                "the nose meets them after 20 m: what an agent drives into is its fault", ego(v),
                (walker(40 + 2.25 + 20 + 0.3, OWN, 0.0),), hit("crossing", True, 20 / v)))
        reach = 20 / v
        found.append(Case(f"into a pedestrian who crosses, at {v:g}",
                "they are in the middle of the lane when the nose comes", ego(v),
                (walker(40 + 2.25 + 20 + 0.3, OWN - 1.2 * reach),), hit("crossing", True, reach)))
    for v in (5.0, 15.0, 32.0):
        far = 8.0 * v / 2  # both drive for a fourth of the time
        gap = far - 4.5
        found.append(Case(f"the ego invades the oncoming lane, at {v:g}",
                "it drives in the lane of the other one, who keeps it", ego(v, y=WEST),
                (car(40 + far, WEST, v, math.pi),), hit("oncoming", True, gap / (2 * v), wrong=True)))
        found.append(Case(f"an oncoming one invades the ego's lane, at {v:g}",
                "the ego keeps its lane, the other is where it must not be", ego(v),
                (car(40 + far, OWN, v, math.pi),), hit("oncoming", False, gap / (2 * v))))
    for v, (where, x, fault) in product((-8.0, 8.0, 16.0), (("flank", 165, False), ("corner", 162.25, True))):
        found.append(Case(f"hit in the {where} by one that crosses, at {v:g}",
                "in the ego's lane: the other's nose meets the middle of its side, or the last 0.4 m",
                ego(v, x=x - 2 * v), (car(165, OWN - 27.15, 12.0, NORTH),), hit("crossing", fault, 2.0)))
    for v in (8.0, 16.0):
        # The ego's front is at the crosser's flank, x = 165 - 0.9, when the crosser's centre is in the lane.
        time = 48 / v
        found.append(Case(f"into the flank of one that crosses, at {v:g}", "the nose meets a flank",
                ego(v, x=165 - 0.9 - 2.25 - 48), (car(165, OWN - 6 * time, 6.0, NORTH),),
                hit("crossing", True, time)))
        found.append(Case(f"hit in the flank after a red light, at {v:g}",
                "the same, but it ran the light: who crosses may count on it", ego(v, x=165 - 4 * v),
                (car(165, OWN - 0.9 - 2.25 - 12 * 4, 12.0, NORTH),), hit("crossing", True, 4.0, red=1),
                light=((0.0, RED),)))
    for v in (12.0, 25.0, 35.0):
        found.append(Case(f"into a slower leader, at {v:g}", "who is behind keeps the distance", ego(v),
                (car(40 + 4.5 + 2 * (v - 5), OWN, 5.0),), hit("into leader", True, 2.0)))
        found.append(Case(f"hit from behind, at {v:g}", "the same, seen by the one ahead", ego(5.0, x=80),
                (car(80 - 4.5 - 2 * (v - 5), OWN, v),), hit("rear ended", False, 2.0)))
    return found


def manoeuvres() -> list[Case]:
    """Scenes whose last metres do not tell whose fault it is."""
    return [
        Case("into one that stands", "it still moved when it came there, 3 cm before its own stand",
            stops(ego(), 0.0, 5.0), (car(40 + 10 - 0.03 + 4.5, OWN, 0.0),), hit("into leader", True)),
        Case("into one that brakes hard", "a safe distance is for that, though it was not seen at once", ego(),
            (stops(car(60, there=(1.0, 99.0)), 0.0, 5.0),), hit("into leader", True)),
        Case("brakes hard and is hit", "who is behind keeps the distance, whatever the reason for braking is",
            stops(ego(), 1.0, 8.0), (car(28),), hit("rear ended", False), log=ego()),
        Case("hit while it stands", "an agent that has stopped hits nobody", stops(ego(), 0.0, 5.0),
            (car(25, OWN, 8.0),), hit("rear ended", False, (40 + 10 - 25 - 4.5) / 8), log=stops(ego(), 0.0, 5.0)),
        Case("hit head-on while it stands in the wrong lane",
            "an agent that has stopped hits nobody, as nuPlan has it", ego(0.0, y=WEST),
            (car(80, WEST, 10.0, math.pi),), hit("oncoming", False, 3.55)),
        Case("the ego cuts in closely before a faster one",
            "16 m ahead of one that closes in with 8 m/s: by RSS 10 m/s before 18 m/s need 71 m",
            ego(aside=(0.4, 1.4, -3.5)), (car(12, RIGHT, 18.0),), hit("rear ended", True, (28 - 4.5) / 8)),
        Case("the ego cuts in far enough before one that speeds up",
            "29 m ahead, and by RSS 28.3 m are enough for two at 10 m/s", ego(x=73.5, aside=(0.0, 1.0, -3.5)),
            (car(40, RIGHT, 10.0, change=(0.75, 9.0, 5.0)),), hit("rear ended", False, 0.75 + math.sqrt(29 / 2.5))),
        Case("the ego cut in long before",
            "more than four seconds ago: since then the one behind had time to fall back",
            ego(aside=(0.0, 0.5, -3.5)), (car(21, RIGHT, 12.0),), hit("rear ended", False, (19 - 4.5) / 2)),
        Case("hit from behind on its way out of the lane", "its tail never left the other's path",
            ego(6.0, x=60, aside=(2.0, 4.0, -3.5)), (car(60 - 4.5 - 8 * 3.2, OWN, 14.0),), hit("rear ended", False)),
        Case("another cuts in closely and brakes",
            "6 m ahead and slower: there is nothing that the ego could do", ego(12.0),
            (car(52, RIGHT, 8.0, aside=(0.0, 1.0, 3.5), change=(1.0, 2.0, -4.0)),), hit("into leader", False)),
        Case("another cuts in too closely and stands", "35 m ahead, where RSS wants 40 m", ego(12.0),
            (car(81.5, RIGHT, 8.0, aside=(0.0, 1.0, 3.5), change=(0.5, 1.3, -10.0), turned=False),),
            hit("into leader", False)),
        Case("another cuts in far ahead and stands", "42 m ahead, and by RSS 40 m are enough for 12 m/s behind 8 m/s",
            ego(12.0, x=20), (car(68.5, RIGHT, 8.0, aside=(0.0, 1.0, 3.5), change=(0.6, 1.4, -10.0)),),
            hit("into leader", True, (68.5 + 8 * 0.6 + 3.2 - 4.5 - 20) / 12)),
        Case("the ego changes lane into a tail", "it comes from behind: the other stayed where it was",
            ego(14.0, aside=(0.0, 1.0, -3.5)), (car(60, RIGHT, 6.0),), hit("into leader", True, (20 - 4.5) / 8)),
        Case("the ego changes lane close behind a tail", "the other keeps its lane and its speed",
            ego(14.0, aside=(1.0, 2.0, -3.5)), (car(56.5, RIGHT, 6.0),), hit("into leader", True)),
        Case("another changes lane close behind the ego", "the same, seen by the one ahead", ego(6.0, x=100),
            (car(83.5, RIGHT, 14.0, aside=(1.0, 2.0, 3.5)),), hit("rear ended", False)),
        *(Case(f"an oncoming one {y:g} m off in the own lane", "only it left its lane", ego(y=OWN + 0.7),
            (car(120, OWN + y, 10.0, math.pi),), hit("oncoming", False)) for y in (0.3, 0.55, 0.65)),
        Case("head-on into one", "is in no lane", ego(), (walker(100, OWN, 1.2, math.pi),), hit("oncoming", True)),
        Case("the ego swerves into one beside it", "flanks touch in the other's lane",
            ego(aside=(1.0, 4.5, -3.5)), (car(40, RIGHT),), hit("sideswipe", True)),
        Case("another swerves into the ego", "flanks touch in the ego's lane", ego(),
            (car(40, RIGHT, aside=(1.0, 4.5, 3.5)),), hit("sideswipe", False)),
        Case("another swerves into the ego's front corner",
            "its flank comes before the ego's corner, in the ego's lane", ego(),
            (car(43.5, RIGHT, aside=(1.0, 4.5, 3.5)),), hit("sideswipe", False)),
        Case("the ego evades an oncoming one to the right", "it leaves its lane, but on the other side",
            ego(10.0, aside=(1.0, 2.0, -1.6), turned=False), (car(120, OWN, 10.0, math.pi),),
            hit("oncoming", False, (80 - 4.5) / 20)),
        Case("into the flank of one that ran a red light",
            "the ego comes from the south, and who crosses its way should have waited",
            Track(165, OWN - 0.9 - 2.25 - 32, 8.0, NORTH), (car(165 - 4 * 16, OWN, 16.0),),
            hit("crossing", False, 4.0, red=0), light=((0.0, RED),)),
        Case("into the flank of one that had green", "the same, but for the light",
            Track(165, OWN - 0.9 - 2.25 - 32, 8.0, NORTH), (car(165 - 4 * 16, OWN, 16.0),),
            hit("crossing", True, 4.0, red=0), light=((0.0, GREEN),)),
        Case("hit from behind after a red light", "the light was for those who cross", ego(x=130),
            (car(100, OWN, 17.0),), hit("rear ended", False, (30 - 4.5) / 7, red=1), light=((0.0, RED),)),
        Case("the ego backs into one behind", "backing", ego(-3.0), (car(28, OWN, 0.0),), hit("other", True, 2.5)),
        Case("the ego backs into somebody on foot", "backing", ego(-2.0),
            (walker(40 - 2.25 - 4 - 0.3, OWN, 0.0),), hit("crossing", True, 2.0)),
        Case("somebody on foot walks into the ego's side", "the nose is past; the light is run only later",
            ego(5.0, x=130), (walker(140, OWN - 0.9 - 0.3 - 2 * 1.2),), hit("crossing", False, 2.0, red=1),
            light=((0.0, RED),)),
        Case("a cyclist runs into the ego's tail", "hit from behind", ego(4.0),
            (Track(20, OWN, 8.0, size=(1.8, 0.6), kind=AgentType.CYCLIST),),
            hit("rear ended", False, (20 - 2.25 - 0.9) / 4)),
        Case("into a cyclist ahead", "who is behind keeps the distance", ego(),
            (Track(70, OWN, 5.0, size=(1.8, 0.6), kind=AgentType.CYCLIST),),
            hit("into leader", True, (30 - 2.25 - 0.9) / 5)),
        Case("over a narrow one within a step", "28 m/s and 0.4 m: states show nothing, but it happens",
            ego(28.0, size=(1.0, 0.8)), (Track(90.0, OWN, 0.0, size=(0.4, 0.4), kind=AgentType.PEDESTRIAN),),
            hit("into leader", True, (50 - 0.5 - 0.2) / 28)),
        Case("through one another head-on within a step",
            "64 m/s together are 12.8 m in a fifth of a second, and two boxes are 9 m long", ego(32.0, y=WEST, x=5.0),
            (car(205, WEST, 32.0, math.pi),), hit("oncoming", True, (200 - 4.5) / 64, wrong=True)),
        Case("flanks pass each other at 5 cm", "nobody touches anybody", ego(20.0, y=OWN),
            (car(140, OWN + 1.85, 20.0, math.pi),), {}),
        Case("one appears on the spot where another passed", "who is not seen is met by nobody", ego(),
            (car(60, OWN, 0.0, there=(5.0, 99.0)),), {}),
        Case("one appears in the ego's flank", "what comes before is not known", ego(30.0, x=5.0),
            (car(5.0, OWN - 1.73, 30.0, there=(2.0, 99.0)),), hit("sideswipe", False)),
        Case("somebody on foot comes into the way of the ego", "pedestrians change no lanes", ego(),
            (walker(69.55, OWN - 3, 1.0, 0.0, aside=(1.0, 2.5, 3.0), turned=False),), hit("into leader", True, 3.0)),
        Case("hits two at once", "a pair each; one at fault is enough", ego(),
            (walker(70, OWN - 0.5, 0.0), walker(70, OWN + 0.5, 0.0)),
            hit("crossing", True, (30 - 2.25 - 0.3) / 10, collisions=2)),
        Case("without a map a head-on hit is everybody's fault", "nobody is in a lane", ego(),
            (car(120, OWN, 10.0, math.pi),),
            hit("oncoming", True, (80 - 4.5) / 20, wrong=None, blocking=None, offroad=None), lanes=False,
            boundary=False),
    ]


def rules() -> list[Case]:
    """Lights, lanes, edges, standing, and what is not defined."""
    green = ((0.0, GREEN),)
    red = ((0.0, RED),)
    beside = (car(2, RIGHT),)
    waits = stops(ego(x=100), 2.0, 5.0)  # 2 s, then 10 m: the front is at 132.25
    return [
        Case("runs a red light", "the front passes x = 150", ego(x=100), beside, {"red": 1}, light=red),
        Case("runs a red light at once", "the front passes x = 150", ego(x=146), beside, {"red": 1}, light=red),
        Case("leaves its lane past a red light", "at x = 150 the front is 1.6 m beside the middle",
            ego(x=100, y=RIGHT, aside=(4.2417, 5.2417, -3.0), turned=False), (), {"red": 1}, light=red),
        Case("green", "no light is red", ego(x=100), beside, {"red": 0}, light=green),
        Case("red turns green before", "the front is there after 4.8 s", ego(x=100), beside, {"red": 0},
            light=((0.0, RED), (3.0, GREEN))),
        Case("green turns red before", "the front is there after 4.8 s", ego(x=100), beside, {"red": 1},
            light=((0.0, GREEN), (2.0, SignalState.CAUTION), (3.0, RED))),
        Case("creeps over a red light and stops", "the front ends at 152.25", stops(ego(x=130), 1.0, 5.0),
            beside, {"red": 1, "blocking": False}, light=red),
        Case("waits at a red light", "17.75 m before it, which is red", stops(ego(x=108), 2.0, 5.0), beside,
            {"red": 0, "blocking": False}, light=red, log=ego(x=108)),
        Case("stands before a green light", "free road", stops(ego(x=108), 2.0, 5.0), beside,
            {"red": 0, "blocking": True}, light=green, log=ego(x=108)),
        Case("stands on a free road", "it blocks who comes behind, and is no good run", waits, beside,
            {"blocking": True, "ratio": 30 / 80}, log=ego(x=100)),
        Case("stands as its log does", "the log knows why", waits, beside, {"blocking": False, "ratio": 1.0}),
        Case("stands behind another", "it can't go on", waits, (car(140, OWN, 0.0),), {"blocking": False},
            log=ego(x=100, speed=4.0)),
        Case("stands while somebody crosses on foot", "it gives way", waits, (walker(136, -6.0, 0.5),),
            {"blocking": False}, log=ego(x=100)),
        Case("parks off its lane", "nobody needs the verge", stops(ego(x=100, y=-120.0), 2.0, 5.0), (),
            {"blocking": False, "offroad": 100.0}, log=ego(x=100)),
        Case("stands across", "nobody passes", Track(100, OWN, 0.0, NORTH), (), {"blocking": True}, log=ego()),
        Case("pulls over", "off", stops(ego(y=RIGHT - 2.7), 1.0, 5.0), (), {"blocking": False}, log=ego(y=RIGHT)),
        Case("stops for two seconds", "which anybody may", stops(ego(x=100), 4.2, 5.0), (), {"blocking": False},
            log=ego(x=100)),
        Case("leaves the road", "the centre is below y = -7 after 1 s of 2 m/s and for the last 3.4 s or so",
            ego(aside=(1.0, 8.9, -15.8), turned=False), (), {"offroad": 100 * (8 - 3.625) / 8}),
        Case("keeps to the road", "all the time", ego(y=-0.1), (), {"offroad": 0.0, "wrong": False}),
        Case("drives in the oncoming lane", "a lane that leads the other way, and none that leads its way",
            ego(y=WEST), (), {"wrong": True}),
        Case("stands in the oncoming lane", "standing is driving no way", ego(0.0, y=WEST), (), {"wrong": False}),
        Case("no boundary", "there is nothing to be off", ego(), (), {"offroad": None}, boundary=False),
        Case("no lights", "there is nothing to run", ego(), (), {"red": None}),
        Case("lights nobody saw", "the same", ego(), (), {"red": None}, light=((0.0, SignalState.UNKNOWN),)),
        Case("no lanes", "there is no wrong way", ego(), (), {"wrong": None, "blocking": None}, lanes=False),
        Case("the log stands", "there is no progress to make", ego(0.0), (), {"ratio": None, "progress": 0.0}),
        Case("half of the log's way", "5 m/s for its 10", ego(5.0), (),
            {"ratio": 0.5, "progress": 40.0, "distance": 20.0}, log=ego()),
        Case("as the log", "it is the log", ego(), (), {"ratio": 1.0, "progress": 80.0, "distance": 0.0}),
        Case("brakes", "it does", ego(12.0, change=(1.0, 3.0, -4.0)), (), {"braking": 4.0, "acceleration": 0.0}),
        Case("speeds up", "it does", ego(change=(1.0, 4.0, 2.0)), (), {"braking": 0.0, "acceleration": 2.0}),
        Case("keeps its speed", "nothing changes", ego(), (),
            {"braking": 0.0, "acceleration": 0.0, "jerk": 0.0, "lateral": 0.0}),
        Case("closes in and never meets",
            "a gap of 35.5 m closes with 5 m/s until 8 s: 35.5 / 5 = 7.1 s to begin with, less than 1 s at the end",
            ego(), (car(80.0, OWN, 6.0),), {"ttc": (40 - 4.5 - 4 * 8) / 4, "low_ttc": True}),
        Case("follows at the same speed", "no time to a collision", ego(), (car(60.0),),
            {"ttc": None, "low_ttc": False}),
        Case("passes one in the other lane", "they never would meet", ego(14.0), (car(80, RIGHT, 6.0),),
            {"ttc": None}),
    ]
# fmt: on


def cases() -> Sequence[Case]:
    """All but those of roads above each other, see ``bridges``."""
    return [*collisions(), *manoeuvres(), *rules()]
