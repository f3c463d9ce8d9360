"""Safe XML loading and the value types of CommonRoad files."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from symphony.data.sources.base import read_whole
from symphony.errors import DataError

Doubles = NDArray[np.float64]

MAX_REFERENCES = 200
"""References of one kind in a lanelet; junctions have a handful."""
MAX_NUMBER = 1e8
"""Larger magnitudes are no metres, seconds or radians of a road."""


def load_xml(path: Path, what: str = "CommonRoad") -> ET.Element:
    """Parse a file that declares no document type, which rules out every kind of entity attack.

    Args:
        path: the file.
        what: name of the format, for the error.

    Raises:
        DataError: the file is empty, too large, is not well-formed XML, or declares a document type.
        OSError: the file can't be read.
    """
    data = read_whole(path)
    if not data.strip():
        raise DataError("the file is empty", file=path)

    def refuse(*declaration: Any) -> None:
        raise DataError(f"declares a document type, which {what} files never do", file=path, field="DOCTYPE")

    # ElementTree's fast parser has no hook for document types; a pass without any other handler costs little.
    guard = expat.ParserCreate()
    guard.StartDoctypeDeclHandler = refuse
    try:
        guard.Parse(data, True)
        return ET.fromstring(data)  # noqa: S314 - no document type, hence no entities
    except (expat.ExpatError, ET.ParseError, ValueError, LookupError) as error:
        raise DataError(f"not well-formed XML: {error}", file=path) from error


def number(text: str | None, field: str) -> float:
    """A finite number of at most :data:`MAX_NUMBER`."""
    try:
        value = float(text or "")
    except ValueError:
        raise DataError(f"{(text or '').strip()[:40]!r} is not a number", field=field) from None
    if not abs(value) <= MAX_NUMBER:
        raise DataError(f"{value:g} is not finite or absurdly large", field=field)
    return value


def integer(text: str | None, field: str) -> int:
    """An id or a count."""
    try:
        value = int(text or "")
    except ValueError:
        raise DataError(f"{(text or '').strip()[:40]!r} is not an integer", field=field) from None
    if not -(2**63) <= value < 2**63:
        raise DataError("the integer exceeds 64 bits", field=field)
    return value


def midpoint(node: ET.Element, field: str) -> float:
    """The exact value of a state variable, or the middle of its interval."""
    exact = node.find("exact")
    if exact is not None:
        return number(exact.text, field)
    low = number(node.findtext("intervalStart"), field)
    return (low + number(node.findtext("intervalEnd"), field)) / 2


def point(node: ET.Element, field: str) -> tuple[float, float]:
    """The x and y children of an element."""
    return number(node.findtext("x"), field), number(node.findtext("y"), field)


def points(node: ET.Element | None, field: str) -> Doubles:
    """[P, 2] the ``point`` children of an element, none if it is missing."""
    children = [] if node is None else node.findall("point")
    return np.array([point(child, field) for child in children], np.float64).reshape(-1, 2)


def center(node: ET.Element, field: str) -> tuple[float, float]:
    """A position: a point, or the centre of the region (rectangle, circle, polygon) it is known to lie in."""
    exact = node.find("point")
    if exact is not None:
        return point(exact, field)
    corners = points(node.find("polygon"), field)
    if len(corners):
        low, high = corners.min(axis=0), corners.max(axis=0)
        return float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2
    for shape in ("rectangle", "circle"):
        middle = node.find(f"{shape}/center")
        if middle is not None:
            return point(middle, field)
    raise DataError("neither a point nor a rectangle, circle or polygon with a centre", field=field)


def references(node: ET.Element, tag: str, field: str) -> list[int]:
    """The ``ref`` attributes of all children of that tag, at most :data:`MAX_REFERENCES`."""
    children = node.findall(tag)
    if len(children) > MAX_REFERENCES:
        raise DataError(f"{len(children)} references, at most {MAX_REFERENCES}", field=field)
    return [integer(child.get("ref"), field) for child in children]


def rotate(vectors: Doubles, angle: Doubles | float) -> Doubles:
    """Turn vectors [..., 2] by angles [...] counter-clockwise."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def is_true(text: str | None, default: bool) -> bool:
    """An XML boolean."""
    return default if text is None else text.strip() in {"true", "1"}
