"""Help texts as paragraphs."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

PARAGRAPHS = ConstructorRegistry()
"""For `tyro.cli`, which by itself keeps the line breaks of an attribute's docstring where its lines are indented."""

TrustCode = Annotated[
    bool,
    tyro.conf.arg(
        help="Run the code that the agent's folder names by import paths; without it such a folder is refused."
    ),
]

_under_way: list[object] = []


@PARAGRAPHS.struct_rule
def joined(info: StructTypeInfo) -> StructConstructorSpec | None:
    """What tyro makes of a dataclass, with the lines of every paragraph of its help texts joined."""
    if any(info is one for one in _under_way):
        return None
    _under_way.append(info)
    try:
        found = ConstructorRegistry.get_struct_spec(info)
    finally:
        _under_way.pop()
    if not isinstance(found, StructConstructorSpec):
        return None
    fields = [replace(field, helptext=_paragraphs(field.helptext)) for field in found.fields]
    return replace(found, fields=tuple(fields))


def _paragraphs(told: str | Callable[[], str | None] | None) -> Callable[[], str | None]:
    """What gives the text: docstrings are read only when help is asked for."""

    def text() -> str | None:
        found = told() if callable(told) else told
        return found and re.sub(r"(?<!\n)\n(?!\s*\n) *", " ", found)

    return text
