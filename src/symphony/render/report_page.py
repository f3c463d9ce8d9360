"""The report of saved rollouts as one page: totals, collisions, and runs with links to their replays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import urlencode

from symphony.render.viewer.pack import filled, script_json, template

TILES = {
    "collision_rate": ("collisions", "% of runs"),
    "collision_rate_at_states": ("collisions, at states only", "% of runs"),
    "at_fault_collision_rate": ("at fault", "% of runs"),
    "offroad_time": ("off the road", "% of time"),
    "red_light_rate": ("red lights run", "% of runs"),
    "wrong_way_time": ("wrong way", "% of time"),
    "blocking_time": ("blocks traffic", "% of time"),
    "low_ttc_time": ("near collision (TTC < 1 s)", "% of time"),
    "progress": ("progress", "m"),
    "progress_ratio": ("progress / log's", ""),
    "log_distance": ("distance to the log", "m"),
    "mean_max_acceleration": ("peak acceleration", "m/s²"),
    "mean_max_braking": ("peak braking", "m/s²"),
    "mean_max_jerk": ("peak jerk", "m/s³"),
    "mean_max_lateral_acceleration": ("peak lateral acceleration", "m/s²"),
}
"""Numbers at the top: their names and units."""
COLUMNS = {
    "segment": "segment",
    "rollout": "rollout",
    "what": "what",
    "collisions": "collisions",
    "red_lights": "red lights",
    "offroad_time": "off road %",
    "wrong_way_time": "wrong way %",
    "blocking_time": "blocks %",
    "min_ttc": "least TTC s",
    "progress": "progress m",
    "progress_ratio": "of the log's",
    "max_braking": "braking m/s²",
    "max_jerk": "jerk m/s³",
    "max_lateral_acceleration": "lateral m/s²",
    "log_distance": "to log m",
}
"""Columns of the table of runs: the name of a number and its heading."""
EVENTS = {
    "red_lights": "red light",
    "offroad_time": "off road",
    "wrong_way_time": "wrong way",
    "blocking_time": "blocks traffic",
}
"""Words for a run in which a number is not 0."""
LEAD = 2.0  # seconds before the first event of a run at which its replay begins


def report_page(found: Mapping[str, Any], viewer: str | None = "view.html") -> str:
    """Return one self-contained page of a report; ``viewer`` is the address of the page that plays rollouts."""
    runs = found["per_run"]
    parts = {
        "/*TITLE*/": escape(f"{found['agent']}: report"),
        "/*STYLE*/": template("report.css"),
        "/*HEAD*/": _head(found),
        "/*TILES*/": "".join(_tile(found, name, *text) for name, text in TILES.items()),
        "/*COLLISIONS*/": _collisions(found["collisions"]),
        "/*RUNS*/": script_json([_run(row, viewer) for row in runs]),
        "/*COLUMNS*/": script_json(COLUMNS),
        "/*SCRIPT*/": template("report.js"),
    }
    return filled(template("report.html"), parts)


def _head(found: Mapping[str, Any]) -> str:
    who = "the ego" if found["evaluated"] == "ego" else "all interactive agents"
    failed = found["failed_runs"]
    lost = f', <b class="bad">{failed} failed</b>' if failed else ""
    return (
        f"<h1>{escape(found['agent'])}</h1><p>{found['runs']} runs of {found['segments']} segments{lost}; "
        f"evaluated: {who}. ± is the standard error over {found['groups']} groups, "
        f"≤ the exact 95 % bound of a zero.</p>{_parts(found.get('parts', {}))}"
    )


def _parts(parts: Mapping[str, Any]) -> str:
    if not parts:
        return ""
    told = [
        f"{name}: {part['collisions'] or 0} collisions, {'–' if part['red_lights'] is None else part['red_lights']} "
        f"red lights in {part['agent_minutes']:.1f} minutes of agents"
        for name, part in zip(("in the log", "past its end"), parts.values(), strict=True)
    ]
    return f"<p>Runs go on past the log; {'; '.join(told)}.</p>"


def _tile(found: Mapping[str, Any], name: str, label: str, unit: str) -> str:
    value, error = found[name], found[f"{name}_se"]
    number = "–" if value is None else f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
    bound, count = found.get(f"{name}_bound"), found[f"{name}_segments"]
    spread = f"≤ {bound:.2g}" if bound is not None else "" if error is None else f"± {error:.2g}"
    if count < found["segments"]:
        spread += f" of {count} segments"
    return f"<div><b>{number}</b><span>{escape(label)}</span><small>{unit} {spread}</small></div>"


def _collisions(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return "<p>none</p>"
    lines = "".join(
        f"<tr><td>{escape(row['kind'])}</td><td>{escape(row['other'])}, "
        f"{'playback' if row['with_playback'] else 'driven'}</td>"
        f"<td>{'<b class=bad>yes</b>' if row['at_fault'] else 'no'}</td><td class=n>{row['collisions']}</td></tr>"
        for row in rows
    )
    head = "<tr><th>kind</th><th>with</th><th>at fault</th><th class=n>collisions</th></tr>"
    return f"<table>{head}{lines}</table>"


def _run(row: Mapping[str, Any], viewer: str | None) -> dict[str, Any]:
    """Return what the table shows of a run."""
    shown: dict[str, Any] = {
        name: round(value, 2) if isinstance(value := row.get(name), float) else value for name in COLUMNS
    }
    what = []
    if row["failed"]:
        what.append(f"failed: {row['failed']}")
    elif row["collision"]:
        what.append("collision, at fault" if row["at_fault_collision"] else "collision, not at fault")
    what += [words for name, words in EVENTS.items() if row.get(name)]
    shown["what"] = ", ".join(what)
    # A run of which nothing was saved has no replay.
    if viewer is not None and row.get("steps") is not None:
        begin = max((row.get("first_event") or 0) - LEAD, 0)
        place = {"segment": row["segment"], "rollout": row["rollout"], "t": round(begin, 2), "follow": "ego"}
        shown["link"] = f"{viewer}#{urlencode(place)}"
    return shown
