"""The page that holds them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from symphony.files import finite
from symphony.render.viewer.pack import Event, packed

if TYPE_CHECKING:
    from symphony.saved.rollouts import SavedRollouts

SCRIPTS = ("data.js", "map.js", "scene.js", "search.js", "panels.js", "main.js")


def view_page(
    agent: str,
    found: Iterable[tuple[SavedRollouts, Sequence[Event]]],
    settings: Mapping[str, Any] | None = None,
) -> str:
    """One self-contained page that plays rollouts: canvas and plain JavaScript, nothing is loaded from elsewhere.

    ``#segment=ID&rollout=K&t=SECONDS&agent=ID`` behind its address names what it shows.

    Args:
        agent: name of what is evaluated.
        found: rollouts of each segment, and what is to be marked in them.
        settings: of the simulation.
    """
    ids, blocks = [], []
    for number, (saved, events) in enumerate(found):
        ids.append(saved.segment.segment_id)
        blocks.append(f'<script type="text/plain" id="segment-{number}">{packed(saved, events)}</script>')
    about = {"agent": agent, "segments": ids, "settings": dict(settings or {})}
    parts = {
        "/*TITLE*/": escape(f"{agent}: rollouts"),
        "/*STYLE*/": template("view.css"),
        "/*ABOUT*/": script_json(about),
        "/*SEGMENTS*/": "\n".join(blocks),
        "/*SCRIPT*/": "\n".join(template(name) for name in SCRIPTS),
    }
    return filled(template("view.html"), parts)


def template(name: str) -> str:
    """A file that lies beside this one."""
    return (files(__package__) / name).read_text(encoding="utf-8")


def script_json(value: Any) -> str:
    """JSON that can stand within a script element; numbers that are not finite become null."""
    return json.dumps(finite(value), ensure_ascii=False, allow_nan=False, default=str).replace("<", "\\u003c")


def filled(page: str, parts: Mapping[str, str]) -> str:
    """A page with its markers replaced, each once; what replaces them is not looked at again."""
    for marker in parts:
        before, found, after = page.partition(marker)
        if not found:
            raise ValueError(f"the template has no {marker}")
        page = f"{before}\0{marker}\0{after}"
    pieces = page.split("\0")
    return "".join(parts.get(piece, piece) for piece in pieces)
