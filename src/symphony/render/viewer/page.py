"""The page that holds them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

from symphony.data.segment import content_hash
from symphony.errors import DataError
from symphony.files import finite
from symphony.render.viewer.pack import Replay, packed, packed_log

SCRIPTS = ("data.js", "map.js", "scene.js", "search.js", "panels.js", "main.js")


def view_page(names: Sequence[str], found: Iterable[Sequence[Replay | None]]) -> str:
    """One self-contained page that plays rollouts: canvas and plain JavaScript, nothing is loaded from elsewhere.

    ``#segment=ID&rollout=K&t=SECONDS&agent=ID`` behind its address names what it shows.

    Args:
        names: of those who are shown side by side.
        found: for each segment what each of them made of it, None for nothing.

    Raises:
        DataError: they were simulated on different logs or steps, or a number is too large for the page.
    """
    segments: list[dict[str, Any]] = []
    blocks: list[str] = []
    for number, replays in enumerate(found):
        first = next(replay.saved for replay in replays if replay is not None)
        log, name = (content_hash(first.segment), first.start, first.steps), first.segment.segment_id
        try:
            texts = {f"segment-{number}": packed_log(first)}
            for place, one in enumerate(replays):
                if one is None:
                    continue
                if (content_hash(one.saved.segment), one.saved.start, one.saved.steps) != log:
                    raise DataError(f"{names[place]} was simulated on another log, or for other steps")
                texts[f"segment-{number}-{place}"] = packed(one)
        except DataError as error:
            raise error.at(segment=name) from None
        blocks += [f'<script type="text/plain" id="{id}">{text}</script>' for id, text in texts.items()]
        segments.append({"id": name, "kinds": [None if one is None else _kinds(one) for one in replays]})
    parts = {
        "/*TITLE*/": escape(f"{', '.join(names)}: rollouts"),
        "/*STYLE*/": template("view.css"),
        "/*ABOUT*/": script_json({"names": list(names), "segments": segments}),
        "/*SEGMENTS*/": "\n".join(blocks),
        "/*SCRIPT*/": "\n".join(template(name) for name in SCRIPTS),
    }
    return filled(template("view.html"), parts)


def _kinds(replay: Replay) -> list[list[str]]:
    """The kinds of events of each rollout, to choose rollouts by."""
    found = [{"failed"} if k in replay.saved.failed else set[str]() for k in range(replay.saved.rollouts)]
    for event in replay.events:
        found[event.rollout] |= {event.kind} | ({"fault"} if event.fault else set())
    return [sorted(kinds) for kinds in found]


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
