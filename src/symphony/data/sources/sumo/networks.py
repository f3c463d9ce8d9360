"""Random road networks, written as plain XML and compiled by ``netconvert`` or made by ``netgenerate``.

All networks are for driving on the right. Every random choice comes from the generator that is passed in.
"""

from __future__ import annotations

import re
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from shapely import LineString

from symphony.data.sources.base import Doubles, load_xml, located, number, refuse
from symphony.data.sources.sumo.process import run_program
from symphony.data.sources.sumo.roads import densify, for_cars, shape
from symphony.errors import DataError

COMMON = (
    "--no-turnarounds true --junctions.corner-detail 8 --junctions.internal-link-detail 20 "
    "--junctions.limit-turn-speed 3.5 --default.connection.cont-pos 0 --tls.yellow.time 3 --tls.allred.time 2 "
    "--no-warnings true --no-internal-links false"
)
"""Options of every network; all have lanes inside junctions, which traffic would else jump across."""
SHARPEST_ANGLE = 1.05  # radians between two streets at a junction, at least where one of them is bent
LATERAL_ACCELERATION = 3.0
"""m/s² that the speed limits of curved streets allow for; drivers exceed limits by up to 30 %."""
BEND = 2.0  # metres between the points of a lane at which it may bend
RAMP_RADIUS = 190.0
"""Radius in metres of the largest map that fits between the ends of a freeway and of its ramps."""
SIDEWALKS = (
    " --sidewalks.guess true --sidewalks.guess.min-speed 0 --sidewalks.guess.max-speed 20"
    " --crossings.guess true --crossings.guess.speed-threshold 20"
)
"""Options of networks where people walk: sidewalks beside all streets, crosswalks at all junctions."""
VERGE = 1.9  # metres between the lanes and the sidewalk, where cars are parked
KERB = 2  # SUMO's number of the lane at the kerb, after sidewalk and verge
OWN_ROADS = {".xodr": "--opendrive-files", ".osm": "--osm-files", ".net.xml": "--sumo-net-file"}
"""Suffixes of users' own road networks (OpenDRIVE, OpenStreetMap, SUMO), and ``netconvert``'s options for them."""

Random = np.random.Generator
Pairs = list[tuple[int, int]]
Road = tuple[int, float, float]  # lanes, speed limit, width of a lane


@dataclass
class PlainNetwork:
    """Nodes, edges and explicit connections, as lines of SUMO's plain XML; points are [2] metres."""

    nodes: list[str] = field(default_factory=list)
    edges: list[str] = field(default_factory=list)
    connections: list[str] = field(default_factory=list)
    walked: bool = False  # with sidewalks, beyond a :data:`VERGE` that is lane 0 until netconvert puts them there

    def node(self, name: str, point: Doubles, control: str, radius: float | None = None) -> None:
        """Add a junction."""
        size = "" if radius is None else f' radius="{radius:.2f}"'
        self.nodes.append(f'<node id="{name}" x="{point[0]:.2f}" y="{point[1]:.2f}" type="{control}"{size}/>')

    def edge(self, ends: tuple[str, str], line: Doubles, road: Road, rank: int, spread: str = "right") -> str:
        """Add a one-way edge and return its id."""
        name = "_".join(ends)
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in line)
        lanes, speed, width = road
        self.edges.append(
            f'<edge id="{name}" from="{ends[0]}" to="{ends[1]}" numLanes="{lanes + self.walked}" speed="{speed:.2f}" '
            f'width="{width:.2f}" priority="{rank}" spreadType="{spread}" shape="{points}"'
            + (f'><lane index="0" disallow="all" width="{VERGE}"/></edge>' if self.walked else "/>")
        )
        return name

    def connect(self, start: str, end: str, pairs: Pairs) -> None:
        """Allow exactly these lane-to-lane connections between two edges."""
        both = f'<connection from="{start}" to="{end}"'
        self.connections += [f'{both} fromLane="{i}" toLane="{j}"/>' for i, j in pairs]

    def compile(self, folder: Path, options: str) -> Path:
        """Write the XML, run ``netconvert`` and return the network file."""
        arguments = f"--output-file net.net.xml {COMMON} {options}{SIDEWALKS * self.walked}"
        for kind, lines in (("node", self.nodes), ("edge", self.edges), ("connection", self.connections)):
            if lines:
                text = "\n".join([f"<{kind}s>", *lines, f"</{kind}s>"])
                (folder / f"net.{kind[:3]}.xml").write_text(text)
                arguments += f" --{kind}-files net.{kind[:3]}.xml"
        run_program("netconvert", arguments, folder)
        return folder / "net.net.xml"


def _signal_layout(rng: Random) -> str:
    # "opposites" makes left turns wait for gaps; with it alone, dense junctions lock up.
    return "opposites" if rng.random() < 0.25 else "incoming"


@dataclass(frozen=True)
class _Link:
    """A two-way street between nodes a and b; its centre line runs from a to b."""

    a: int
    b: int
    line: Doubles
    arterial: bool
    lanes: int
    speed: float


def _town_links(rng: Random, columns: int, rows: int) -> Pairs:
    """Return neighbours in the grid, some pairs dropped while every node keeps two streets and all connect."""
    index = np.arange(columns * rows).reshape(rows, columns)
    across = zip(index[:, :-1].ravel(), index[:, 1:].ravel(), strict=True)
    down = zip(index[:-1].ravel(), index[1:].ravel(), strict=True)
    every = [(int(a), int(b)) for a, b in [*across, *down]]
    pairs, to_drop = list(every), round(0.18 * len(every))
    for k in rng.permutation(len(every)):
        trial = [p for p in pairs if p != every[k]]
        enough = np.bincount(np.ravel(trial), minlength=index.size).min() >= 2
        if to_drop > 0 and enough and _connected(trial, index.size):
            pairs, to_drop = trial, to_drop - 1
    return pairs


def _connected(pairs: Pairs, count: int) -> bool:
    label = list(range(count))
    for _ in range(count):
        for a, b in pairs:
            label[a] = label[b] = min(label[a], label[b])
    return not any(label)


def _bezier(start: Doubles, end: Doubles, bend: Doubles, count: int = 12) -> Doubles:
    """Return a cubic curve [count, 2] whose two control points are moved sideways by ``bend``."""
    along = end - start
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    first, second = start + along / 3 + normal * bend[0], start + 2 * along / 3 + normal * bend[1]
    t = np.linspace(0, 1, count)[:, None]
    return (1 - t) ** 3 * start + 3 * t * (1 - t) ** 2 * first + 3 * t**2 * (1 - t) * second + t**3 * end


def _street(rng: Random, nodes: Doubles, links: list[_Link], a: int, b: int) -> Doubles:
    """Return a centre line from node a to b: bent, unless it would meet a street there is at a sharp angle."""
    straight = _bezier(nodes[a], nodes[b], np.zeros(2))
    if rng.random() > 0.7:
        return straight
    for _ in range(4):
        line = _bezier(nodes[a], nodes[b], rng.normal(0, 9, 2).clip(-16, 16))
        angles = [
            abs(np.angle(np.exp(1j * (_departure(line if end == a else line[::-1]) - other))))
            for end in (a, b)
            for other in _departures(links, end)
        ]
        if min(angles, default=np.pi) > SHARPEST_ANGLE:
            return line
    return straight


def _departures(links: list[_Link], node: int) -> list[float]:
    """Return the directions in which the streets at a node leave it."""
    here = (link for link in links if node in (link.a, link.b))
    return [_departure(link.line if link.a == node else link.line[::-1]) for link in here]


def _departure(line: Doubles) -> float:
    """Return the direction of a line over its first third."""
    towards = line[len(line) // 3] - line[0]
    return float(np.arctan2(towards[1], towards[0]))


def _comfortable_speed(line: Doubles) -> float:
    """Return the speed at which the tightest bend of a street asks for :data:`LATERAL_ACCELERATION`."""
    along = np.diff(line, axis=0)
    turn = np.diff(np.unwrap(np.arctan2(along[:, 1], along[:, 0])))
    step = np.linalg.norm(along, axis=-1)
    curvature = np.abs(turn) / ((step[:-1] + step[1:]) / 2)
    return float(np.sqrt(LATERAL_ACCELERATION / curvature.max(initial=1e-3)))


def _rotation(angle: float) -> Doubles:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def town(rng: Random, folder: Path, *, walked: bool = False) -> Path:
    """Make a jittered and rotated grid of curved streets with T-junctions, mixed control and roundabouts; if
    ``walked`` with verges, sidewalks and crosswalks.
    """
    columns, rows = int(rng.integers(3, 6)), int(rng.integers(3, 5))
    step = rng.uniform(75, 115, 2)
    gx, gy = np.meshgrid(np.arange(columns), np.arange(rows))
    flat = np.stack([gx.ravel() * step[0], gy.ravel() * step[1]], -1)
    flat += rng.normal(0, 9, flat.shape).clip(-18, 18)
    nodes = flat @ _rotation(rng.uniform(0, 2 * np.pi)).T
    main_rows = set(rng.choice(rows, 1 + (rows > 3), replace=False).tolist())
    main_columns = set(rng.choice(columns, 1, replace=False).tolist())
    width = rng.uniform(3.2, 3.7)
    arterial = (int(rng.choice([2, 2, 3])), float(rng.choice([13.89, 15.65, 16.67])))
    collector = (int(rng.choice([1, 1, 2])), float(rng.choice([8.94, 11.18, 13.41])))
    links: list[_Link] = []
    for a, b in _town_links(rng, columns, rows):
        line = _street(rng, nodes, links, a, b)
        main = a // columns in main_rows if a // columns == b // columns else a % columns in main_columns
        lanes, speed = arterial if main else collector
        links.append(_Link(a, b, line, main, lanes, min(speed, _comfortable_speed(line))))
    net = PlainNetwork(walked=walked)
    rings = _add_nodes(net, rng, nodes, links)
    for link in links:
        line, start, end = link.line, f"n{link.a}", f"n{link.b}"
        if link.a in rings:
            start, line = rings[link.a].enter(start, line)
        if link.b in rings:
            end, line = rings[link.b].enter(end, line[::-1])
            line = line[::-1]
        for ends, points in (((start, end), line), ((end, start), line[::-1])):
            net.edge(ends, points, (link.lanes, link.speed, width), 5 if link.arterial else 3)
    for ring in rings.values():
        ring.write(net, width + 0.8)
    layout = _signal_layout(rng)
    return net.compile(folder, f"--tls.layout {layout} --default.junctions.radius {rng.uniform(5, 10):.2f}")


@dataclass
class _Ring:
    """A roundabout around a point; streets are cut where they meet it."""

    center: Doubles
    radius: float
    arms: list[tuple[float, str]] = field(default_factory=list)

    def enter(self, name: str, line: Doubles) -> tuple[str, Doubles]:
        """Cut a line that starts at the centre where it leaves the ring; return the ring's node and the rest."""
        outside = np.linalg.norm(line - self.center, axis=-1) > self.radius + 6
        rest = line[int(np.argmax(outside)) :]
        towards = rest[0] - self.center
        angle = float(np.arctan2(towards[1], towards[0]))
        self.arms.append((angle, f"{name}r{len(self.arms)}"))
        return self.arms[-1][1], np.concatenate([[self._at(angle)], rest])

    def _at(self, angle: float | Doubles) -> Doubles:
        return self.center + self.radius * np.stack([np.cos(angle), np.sin(angle)], -1)

    def write(self, net: PlainNetwork, width: float) -> None:
        """Add the ring's junctions and its one-way edges, counter-clockwise."""
        arms = sorted(self.arms)
        names = []
        for (angle, node), (following, end) in zip(arms, [*arms[1:], arms[0]], strict=True):
            net.node(node, self._at(angle), "priority", radius=6.0)
            sweep = (following - angle) % (2 * np.pi)
            arc = self._at(angle + np.linspace(0, sweep, max(4, int(sweep * 8))))
            names.append(net.edge((node, end), arc, (1, 7.5, width), 9, spread="center"))
        nodes = " ".join(node for _, node in arms)
        net.edges.append(f'<roundabout nodes="{nodes}" edges="{" ".join(names)}"/>')


def _add_nodes(net: PlainNetwork, rng: Random, nodes: Doubles, links: list[_Link]) -> dict[int, _Ring]:
    """Add a junction per node, except where a roundabout takes its place; return the roundabouts."""
    rings: dict[int, _Ring] = {}
    wanted = int(rng.integers(0, 4))
    for k in rng.permutation(len(nodes)):
        meeting = [link for link in links if k in (link.a, link.b)]
        big = sum(link.arterial for link in meeting)
        angles = np.sort(_departures(links, int(k)))
        gaps = np.diff([*angles, angles[0] + 2 * np.pi])
        # Wide streets close together would pave over the island.
        roomy = gaps.min() > 1.2 and max(link.lanes for link in meeting) <= 2
        if len(rings) < wanted and len(meeting) >= 3 and roomy:
            rings[int(k)] = _Ring(nodes[k], float(rng.uniform(15, 21)))
            continue
        if len(meeting) == 2 or big >= 3:
            control = "priority" if len(meeting) == 2 else "traffic_light"
        elif big:
            control = str(rng.choice(["traffic_light", "priority", "priority_stop"], p=[0.7, 0.2, 0.1]))
        else:
            minor = ["priority", "allway_stop", "right_before_left", "traffic_light"]
            control = str(rng.choice(minor, p=[0.25, 0.35, 0.2, 0.2]))
        net.node(f"n{k}", nodes[k], control)
    return rings


def grid(rng: Random, folder: Path) -> Path:
    """Make a perturbed rectangular grid with left-turn pockets; one kind of control for all junctions."""
    controls = ["traffic_light", "priority", "allway_stop", "right_before_left"]
    control = str(rng.choice(controls, p=[0.4, 0.2, 0.2, 0.2]))
    length, spread = rng.uniform(100, 140), rng.uniform(4, 12)
    x, y = rng.integers(3, 5), rng.integers(3, 5)
    arguments = (
        f"--grid --grid.x-number {x} --grid.y-number {y} --grid.x-length {length:.2f} "
        f"--grid.y-length {length * rng.uniform(0.85, 1.2):.2f} "
        f"--turn-lanes 1 --turn-lanes.length {rng.uniform(30, 45):.1f} "
        f"--perturb-x norm(0,{spread:.2f}) --perturb-y norm(0,{spread:.2f}) "
        f"--default-junction-type {control} --default.lanenumber {rng.integers(1, 3)} "
        f"--default.lanewidth {rng.uniform(3.2, 3.7):.2f} --default.speed {rng.choice([11.18, 13.89]):.2f} "
        f"--default.junctions.radius {rng.uniform(5, 10):.2f} --tls.layout {_signal_layout(rng)} "
        f"--seed {rng.integers(1, 2**30)} --output-file net.net.xml {COMMON}"
    )
    run_program("netgenerate", arguments, folder)
    return folder / "net.net.xml"


def freeway(rng: Random, folder: Path, longer: float = 0.0) -> Path:
    """Make two carriageways, each with an on-ramp and an off-ramp: apart or joined by a weaving lane. All ends, those
    of the ramps too, are ``longer`` metres farther out than :data:`RAMP_RADIUS` asks for.
    """
    net = PlainNetwork()
    width = rng.uniform(3.5, 3.75)
    speed = float(rng.choice([24.6, 26.8, 29.1]))
    direction = rng.uniform(0, 2 * np.pi)
    # A longer road turns as much, not more.
    curvature = rng.uniform(-1, 1) / 1500 * (600 / (600 + longer))
    between = rng.uniform((180, 120, 130), (260, 200, 180), (2, 3))
    between[rng.random(2) < 0.4, 1:] = 0  # joined by a weaving lane
    # Both sides are as long, so that neither ends beside a ramp of the other.
    outer = 300 + longer + (between.sum(1).max() - between.sum(1)) / 2
    stations = np.cumsum([np.zeros(2), outer, *between.T, outer], axis=0)
    for side in range(2):
        road, bend = (int(rng.integers(2, 4)), speed, width), curvature * (1 - 2 * side)
        _carriageway(net, rng, f"c{side}", road, (direction + side * np.pi, bend), stations[:, side])
    return net.compile(folder, "--default.junctions.radius 4 --junctions.scurve-stretch 1.5")


def _carriageway(
    net: PlainNetwork, rng: Random, name: str, road: Road, course: tuple[float, float], stations: Doubles
) -> None:
    """Add one direction of a freeway: base, stretch beside the on-ramp, gap, stretch beside the off-ramp, end."""
    (lanes, speed, width), (direction, curvature), weaving = road, course, stations[2] == stations[3]
    shift, median, spin = stations[-1] / 2, 5.0, _rotation(direction)

    def along(s: Doubles, right: float | Doubles) -> Doubles:
        """Return points at stations s, this far to the right of the edge of the median."""
        u = s - shift
        normal = np.stack([curvature * u, -np.ones_like(u)], -1)
        out = np.stack([u, curvature * u**2 / 2], -1) + normal * (median + np.asarray(right))[..., None]
        return out @ spin.T

    marks = stations[[0, 1, 2, 5] if weaving else [0, 1, 2, 3, 4, 5]].tolist()
    extra = [0, 1, 0] if weaving else [0, 1, 0, 1, 0]
    names = [f"{name}m{k}" for k in range(len(marks))]
    for node, mark in zip(names, marks, strict=True):
        net.node(node, along(np.array([mark]), 0.0)[0], "priority")
    ids = []
    for k, more in enumerate(extra):
        # The line given to SUMO is the left edge of the carriageway (spread to the right).
        line = along(np.linspace(marks[k], marks[k + 1], 12), 0.0)
        ids.append(net.edge((names[k], names[k + 1]), line, (lanes + more, speed, width), 9))
    for k in range(len(extra) - 1):
        net.connect(ids[k], ids[k + 1], [(i + extra[k], i + extra[k + 1]) for i in range(lanes)])
    ramp_speed, edge = rng.uniform(15.5, 20), lanes * width
    on, off = 1, len(extra) - 1
    # Ramps are longer than a crop's radius, so that their ends are never on a map.
    reach = np.linspace(1.7, 0, 20)
    far = stations[1] - 150
    gap = (3 * reach + 30 * reach**2) * (far / 150)
    start = along(marks[on] - far * reach, edge + gap)
    end = along(marks[off] + far * reach[::-1], edge + gap[::-1])
    net.node(f"{name}on", start[0], "priority")
    net.node(f"{name}off", end[-1], "priority")
    ramp = (1, ramp_speed, width)
    net.connect(net.edge((f"{name}on", names[on]), start, ramp, 4), ids[on], [(0, 0)])
    net.connect(ids[off - 1], net.edge((names[off], f"{name}off"), end, ramp, 4), [(0, 0)])


def is_own(kind: str) -> bool:
    """Return whether a kind of network is a file of the user's."""
    return kind.endswith(tuple(OWN_ROADS))


def kind_name(kind: str) -> str:
    """Return a kind as part of a segment's name: of a file its own name, without folder and ending."""
    for ending in OWN_ROADS:
        if kind.endswith(ending):
            return re.sub(r"[^A-Za-z0-9_]+", "_", Path(kind).name.removesuffix(ending))
    return kind


def own_network(file: Path, folder: Path) -> Path:
    """Return roads of the user's as a SUMO network, with the lanes for cars; a :class:`DataError` names the file."""
    with located(file=file):
        if not file.is_file():
            raise DataError("no such file")
        ending, option = next(entry for entry in OWN_ROADS.items() if file.name.endswith(entry[0]))
        own = folder / f"own{ending}"
        arguments = f"{option} {own.name} --output-file net.net.xml {COMMON} --keep-edges.by-vclass passenger"
        if ending == ".osm":
            arguments += " --geometry.remove true --junctions.join true --tls.guess-signals true"
        if ending == ".xodr":
            # In the map's own coordinates, its turns as it has them.
            arguments += " --offset.disable-normalization true --opendrive.internal-shapes true"
            arguments += " --opendrive.curve-resolution 1 --tls.discard-simple true"
            _limited(load_xml(file, "OpenDRIVE")).write(own)
        else:
            shutil.copyfile(file, own)
        run_program("netconvert", arguments, folder)
        return folder / "net.net.xml"


def _limited(root: ET.Element) -> ET.ElementTree[ET.Element]:
    """Return an OpenDRIVE map whose lanes have the limits of their road as their own, as SUMO reads no others."""
    for node in root.iter():
        node.tag = node.tag.rpartition("}")[2]
    refuse(root.find("road[@rule='LHT']") is not None, "drives on the left, which is not supported", "rule")
    units = {each.get("unit", "m/s") for each in root.iter("speed") if each.get("max", "")[:1].isdigit()}
    refuse(units - {"m/s", "km/h", "mph"}, f"unknown unit among {', '.join(sorted(units))}", "speed")
    for road in root.iterfind("road"):
        limits = [(number(kind.get("s"), "type"), _limit(kind.find("speed"))) for kind in road.iterfind("type")]
        limits = [each for k, each in enumerate(limits) if each[1] != (limits[k - 1][1] if k else {})]
        sections = road.findall("lanes/laneSection")
        begins = [number(section.get("s"), "laneSection") for section in sections]
        for section, begin, end in zip(sections, begins, [*begins[1:], np.inf], strict=True):
            first = max((at for at, _ in limits if at <= begin), default=begin)
            for lane in section.iterfind("*/lane"):
                own = lane.find("speed")
                until = end if own is None else begin + number(own.get("sOffset", "0"), "speed")
                place = len(lane) if own is None else list(lane).index(own)
                lane[place:place] = [
                    ET.Element("speed", limit or {"max": "13.89"}, sOffset=f"{max(at - begin, 0.0):.9g}")
                    for at, limit in limits
                    if at >= first and max(at, begin) < until and (limit or at > begin)
                ]
    return ET.ElementTree(root)


def _limit(speed: ET.Element | None) -> dict[str, str]:
    """Return the attributes of a limit, with a number; none where SUMO takes its own, by the type of the lane."""
    if speed is None or not (limit := speed.get("max", ""))[:1].isdigit():
        return {"max": "36.1"} if speed is not None and limit == "no limit" else {}  # 130 km/h
    return speed.attrib


def drive_as_drawn(file: Path, *, own: bool) -> None:
    """Let SUMO take lanes as long as drawn, or all seem to brake; ``own`` ones only if for cars, slow in bends."""
    tree = ET.parse(file)  # noqa: S314 - written by netconvert
    for edge in (each for each in tree.iterfind("edge") if each.get("function") != "walkingarea"):  # drawn as areas
        lines = {lane: LineString(shape(lane.attrib["shape"])) for lane in edge.iterfind("lane")}
        cars = [lane for lane in lines if for_cars(lane)]
        # Those of cars are as long as each other, or a change of lane would be a jump.
        mean = sum(lines[lane].length for lane in cars) / max(len(cars), 1)
        for lane, line in lines.items():
            lane.set("length", f"{max(mean if lane in cars else line.length, 0.1):.2f}")
            if own:
                # Buses keep off their own lanes, too: the map has none.
                lane.set("allow", "all" if lane in cars else "pedestrian")
                lane.attrib.pop("disallow", None)
            if own and lane in cars:
                speed = _comfortable_speed(densify(np.array(line.coords), BEND))
                lane.set("speed", f"{min(float(lane.attrib['speed']), speed):.2f}")
    tree.write(file)


NETWORKS: dict[str, Callable[[Random, Path], Path]] = {
    "town": town,
    "grid": grid,
    "ramp": freeway,
    "street": partial(town, walked=True),
}
"""Kinds of network; each function writes files into a folder and returns the path of the network."""
