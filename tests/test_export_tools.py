"""Rollouts for other tools: what OpenSCENARIO holds is what was simulated."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict

import numpy as np

from helpers_saved import played, searched
from helpers_segments import crossing, hide, straight_road, turned
from symphony.data.resample import mirrored
from symphony.saved.openscenario import openscenario
from symphony.saved.rollouts import world_of


def cases():
    seen = hide(hide(crossing(4, steps=31), 2, slice(5, 9)), 3, slice(0, 30))
    seen = seen.replace(agent_type=np.array([1, 2, 3, 4], np.uint8), origin=np.array([5e5, -20.0, 0]))
    return [played(seen, [0, 1]), *searched()[1]]


def poses(text):
    """The document, and of each entity the middle of its box and its heading [3] by step, as its events have them."""
    root, found = ET.fromstring(text), defaultdict(dict)  # noqa: S314
    bodies = {one.get("name"): float(one.find(".//Center").get("x")) for one in root.iter("ScenarioObject")}
    for group in root.iter("ManeuverGroup"):
        name = group.find("Actors/EntityRef").get("entityRef")
        for event in group.iter("Event"):
            start = float(event.find(".//SimulationTimeCondition").get("value"))
            nodes = [*event.iter("Vertex"), *event.iter("TeleportAction")]
            assert not nodes or float(nodes[0].get("time", start)) == start
            for node in nodes:
                x, y, turn = (float(node.find(".//WorldPosition").get(key)) for key in "xyh")
                middle = x + 1j * y + bodies[name] * np.exp(1j * turn)
                found[name][round(float(node.get("time", start)) / 0.2)] = middle.real, middle.imag, turn
    return root, found


def test_openscenario_has_every_agent_where_it_was():
    """Within a millimetre, at the steps at which it was there; turning the world turns it."""
    for saved in cases():
        world, segment = world_of(saved, 0), saved.segment
        root, found = poses(openscenario(saved, 0))
        names = {"Ego" if k == segment.ego else str(n): k for k, n in enumerate(segment.agent_id)}
        assert found.keys() == {name for name, k in names.items() if world.valid[k].any()}
        for name, states in found.items():
            row, steps = names[name], sorted(states)
            assert steps == np.flatnonzero(world.valid[row]).tolist()
            shown = root.find(f".//Private[@entityRef='{name}']//VisibilityAction").get("traffic")
            assert (shown == "true") == world.valid[row, 0]
            leaves = root.findall(f".//ManeuverGroup[@name='{name}']/Maneuver/Event")
            gone = [float(one.get("name")[6:]) / 0.2 for one in leaves if one.get("name").startswith("leave ")]
            np.testing.assert_allclose(gone, 1 + np.flatnonzero(np.diff(world.valid[row] + 0) < 0), atol=0.1)
            mine = np.array([states[step] for step in steps]) - [*segment.origin[:2], 0]
            logged = np.column_stack([world.position[row, steps], world.heading[row, steps]])
            np.testing.assert_allclose(mine, logged, atol=1e-3)
        assert root.find("RoadNetwork/LogicFile") is None
        assert "no OpenDRIVE" in root.find("FileHeader").get("description")
    segment = straight_road(3).replace(file="roads.xodr")
    assert "no OpenDRIVE" in openscenario(played(mirrored(segment)), 0)  # the file has the roads as they were
    (root, before), (_, after) = (poses(openscenario(played(turned(segment, a)), 0)) for a in (0.0, 1.0))
    assert root.find("RoadNetwork/LogicFile").get("filepath") == "roads.xodr"
    for name, states in before.items():
        x, y, heading = np.array(list(states.values())).T
        place = (x + 1j * y) * np.exp(1j)
        turn = np.stack([place.real, place.imag, heading + 1.0], -1)
        np.testing.assert_allclose(list(after[name].values()), turn, atol=1e-3)
