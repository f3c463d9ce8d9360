"""SUMO's plain XML of road networks: nodes, edges, connections."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from symphony.data.sources.sumo.process import run_program

Point = NDArray[np.float64]
"""Points [..., 2] in metres."""
COMMON = [
    "--no-turnarounds",
    "true",
    "--junctions.corner-detail",
    "8",
    "--junctions.internal-link-detail",
    "20",
    "--junctions.limit-turn-speed",
    "3.5",
    "--default.connection.cont-pos",
    "0",
    "--tls.yellow.time",
    "3",
    "--tls.allred.time",
    "2",
    "--no-warnings",
    "true",
]
"""Options of every network."""


@dataclass
class PlainNetwork:
    """Nodes, edges and explicit connections, as lines of SUMO's plain XML."""

    nodes: list[str] = field(default_factory=list)
    edges: list[str] = field(default_factory=list)
    connections: list[str] = field(default_factory=list)

    def node(self, name: str, point: Point, control: str, radius: float | None = None) -> None:
        """Add a junction."""
        size = "" if radius is None else f' radius="{radius:.2f}"'
        self.nodes.append(f'<node id="{name}" x="{point[0]:.2f}" y="{point[1]:.2f}" type="{control}"{size}/>')

    def edge(
        self,
        start: str,
        end: str,
        *,
        lanes: int,
        speed: float,
        width: float,
        priority: int,
        shape: Point | None = None,
        spread: str = "right",
    ) -> str:
        """Add a one-way edge and return its id."""
        name = f"{start}_{end}"
        points = "" if shape is None else " ".join(f"{x:.2f},{y:.2f}" for x, y in shape)
        line = f' shape="{points}"' if points else ""
        self.edges.append(
            f'<edge id="{name}" from="{start}" to="{end}" numLanes="{lanes}" speed="{speed:.2f}" '
            f'width="{width:.2f}" priority="{priority}" spreadType="{spread}"{line}/>'
        )
        return name

    def connect(self, start: str, end: str, pairs: list[tuple[int, int]]) -> None:
        """Allow exactly these lane-to-lane connections between two edges."""
        self.connections += [
            f'<connection from="{start}" to="{end}" fromLane="{i}" toLane="{j}"/>' for i, j in pairs
        ]

    def compile(self, folder: Path, options: list[str]) -> Path:
        """Write the XML and run ``netconvert``; returns the network file."""
        arguments = ["--output-file", "net.net.xml", *COMMON, *options]
        parts = (
            ("node", "nodes", self.nodes),
            ("edge", "edges", self.edges),
            ("connection", "connections", self.connections),
        )
        for kind, root, lines in parts:
            if lines:
                (folder / f"net.{kind[:3]}.xml").write_text("\n".join([f"<{root}>", *lines, f"</{root}>"]))
                arguments += [f"--{kind}-files", f"net.{kind[:3]}.xml"]
        run_program("netconvert", arguments, folder)
        return folder / "net.net.xml"
