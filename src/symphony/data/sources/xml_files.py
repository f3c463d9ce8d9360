"""Safe loading of XML, and the numbers in it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any
from xml.parsers import expat

from symphony.data.sources.base import read_whole
from symphony.errors import DataError

MAX_NUMBER = 1e8  # larger magnitudes are no metres, seconds or radians of a road


def load_xml(path: Path, what: str = "CommonRoad") -> ET.Element:
    """Parse a file that declares no document type, which rules out every kind of entity attack.

    ``what`` is the name of the format, for the :class:`DataError` where the file is something else.
    """
    data = read_whole(path)

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
    """Return a finite number of at most :data:`MAX_NUMBER`."""
    try:
        value = float(text or "")
    except ValueError:
        raise DataError(f"{(text or '').strip()[:40]!r} is not a number", field=field) from None
    if not abs(value) <= MAX_NUMBER:
        raise DataError(f"{value:g} is not finite or absurdly large", field=field)
    return value


def integer(text: str | None, field: str) -> int:
    """Return an id or a count of 64 bits."""
    try:
        value = int(text or "")
    except ValueError:
        raise DataError(f"{(text or '').strip()[:40]!r} is not an integer", field=field) from None
    if not -(2**63) <= value < 2**63:
        raise DataError("the integer exceeds 64 bits", field=field)
    return value
