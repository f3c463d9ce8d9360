"""A suite's result for machines that build software (JUnit XML) and for people (one page that opens offline)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any
from urllib.parse import urlencode
from xml.etree import ElementTree as ET

from symphony.bench.measures import MEASURES
from symphony.bench.run import EVENTS, Pair, Result, Verdict
from symphony.errors import printable

WORST = 20
"""Bad runs of a pair that are named, at most."""
LEAD = 2.0
"""Seconds before the first event of a run at which its replay begins."""
SHOWN = (
    "score",
    "pdm_score",
    "at_fault_collision_rate",
    "collision_rate",
    "red_light_rate",
    "offroad_rate",
    "progress_ratio",
    "max_braking",
    "failed_rate",
)
"""Measures in the table of the page."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem; color: #1d2129 }
table { border-collapse: collapse; margin: .5rem 0 2rem; width: 100% }
th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid #ddd }
.n { text-align: right; font-variant-numeric: tabular-nums }
.passes { color: #146c2e; font-weight: 600 } .fails, .undecided { color: #b3261e; font-weight: 600 }
"""


def junit(result: Result) -> str:
    """JUnit XML: a test suite for each planner and crowd, a test case for each threshold."""
    root = ET.Element("testsuites", name=_safe(result.suite.name), time=f"{result.seconds:.1f}")
    for pair in result.pairs:
        mine = of_pair(result, pair)
        failing = sum(one.status != "passes" for one in mine)
        name = f"{pair.planner.name} among {pair.crowd.name}"
        suite = ET.SubElement(
            root,
            "testsuite",
            name=_safe(name),
            tests=str(len(mine)),
            failures=str(failing),
            errors="0",
            skipped="0",
            time=f"{pair.seconds:.1f}",
        )
        for one in mine:
            case = ET.SubElement(suite, "testcase", classname=_safe(name), name=_safe(str(one.threshold)))
            if one.status != "passes":
                failure = ET.SubElement(case, "failure", type=one.status, message=_safe(sentence(one)))
                failure.text = _safe("\n".join(_lines(pair)))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def of_pair(result: Result, pair: Pair) -> list[Verdict]:
    """The verdicts of one pair."""
    return [
        one for one in result.verdicts if (one.planner, one.crowd) == (pair.planner.name, pair.crowd.name)
    ]


def sentence(one: Verdict) -> str:
    """What was found, in words."""
    if one.found.mean is None or one.bound is None:
        return f"{one.threshold}: not defined in {one.found.runs} runs of {one.found.groups} groups"
    mean = f"{one.found.mean:.3g}"
    bound = ""
    if one.threshold.confidence is not None:
        bound = f", {one.threshold.side.replace('_', ' ')} {one.bound:.3g}"
        bound += f" with {100 * one.threshold.confidence:g} % confidence"
    return f"{one.threshold}: {mean}{bound}, from {one.found.runs} runs of {one.found.groups} groups"


def bad_runs(pair: Pair) -> list[dict[str, Any]]:
    """The runs in which something happened, worst first."""
    return [run for run in pair.report.worst() if _what(run)]


def _what(run: dict[str, Any]) -> str:
    if run["failed"]:
        return f"fails: {run['failed']}"
    return ", ".join(text for name, text in EVENTS.items() if run[name])


def _lines(pair: Pair) -> Iterable[str]:
    found = bad_runs(pair)
    for run in found[:WORST]:
        yield f"segment {run['segment']}, rollout {run['rollout']}, seed {pair.crowd.config.seed}: {_what(run)}"
    if len(found) > WORST:
        yield f"and {len(found) - WORST} more"


def page(result: Result, *, view: bool = True) -> str:
    """One page: verdicts, numbers, regressions and the bad runs, each a click away from its replay."""
    suite = result.suite
    word = "passes" if result.passed else "fails"
    stopped = [pair for pair in result.pairs if pair.stopped]
    parts = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(suite.name)}</title>',
        f"<style>{_STYLE}</style><h1>{escape(suite.name)} <span class={word}>{word}</span></h1>",
        f"<p>{len(suite.items)} run segments of {escape(str(suite.store.path))}, "
        f"{suite.crowds[0].config.rollouts} rollouts of each, seed {suite.crowds[0].config.seed}, "
        f"{result.seconds:.0f} s. Bounds are one-sided, over groups of segments.</p>",
        "<h2>Thresholds</h2>",
        _table(
            ("", "planner", "crowd", "threshold and what was found"),
            [
                (
                    f"<span class={one.status}>{one.status}</span>",
                    *map(_cell, (one.planner, one.crowd, sentence(one))),
                )
                for one in sorted(result.verdicts, key=lambda one: one.status == "passes")
            ],
        ),
        "<h2>Numbers</h2>",
        _table(
            ("planner", "crowd", "runs", *(f"{MEASURES[name].text} {MEASURES[name].unit}" for name in SHOWN)),
            [_numbers(pair) for pair in result.pairs],
        ),
    ]
    if stopped:
        names = ", ".join(f"{one.planner.name} among {one.crowd.name}" for one in stopped)
        parts.append(
            "<p>Stopped early, since no outcome of the remaining runs could keep a threshold: "
            f"{escape(names)}.</p>"
        )
    if result.regressions:
        parts.append("<h2>Worse than the baseline</h2>")
        rows = [
            tuple(map(_cell, (one["planner"], one["crowd"], one["segment"], one["rollout"], one["what"])))
            for one in result.regressions
        ]
        parts.append(_table(("planner", "crowd", "segment", "rollout", "what"), rows))
    for pair in result.pairs:
        if found := bad_runs(pair):
            parts.append(f"<h2>{escape(pair.report.agent)}: bad runs</h2>")
            rows = [_bad(pair, run, view=view) for run in found[:WORST]]
            parts.append(_table(("segment", "rollout", "what", ""), rows))
    return "".join(parts) + "</html>\n"


def _numbers(pair: Pair) -> tuple[str, ...]:
    cells = []
    numbers = {name: [MEASURES[name].of(run) for run in pair.runs] for name in SHOWN}
    for values in numbers.values():
        known = [value for value in values if value is not None]
        cells.append(f"<td class=n>{sum(known) / len(known):.3g}" if known else "<td class=n>–")
    return (_cell(pair.planner.name), _cell(pair.crowd.name), f"<td class=n>{len(pair.runs)}", *cells)


def _bad(pair: Pair, run: dict[str, Any], *, view: bool) -> tuple[str, ...]:
    link = ""
    if view and run.get("steps") is not None:
        begin = max((run.get("first_event") or 0) - LEAD, 0)
        place = {"segment": run["segment"], "rollout": run["rollout"], "t": round(begin, 2), "follow": "ego"}
        link = f'<a href="{pair.planner.name}/{pair.crowd.name}/view.html#{urlencode(place)}">replay</a>'
    return (_cell(run["segment"]), _cell(run["rollout"]), _cell(_what(run)), link)


def _cell(value: object) -> str:
    return escape(printable(str(value)))


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(text)}" for text in heads)
    lines = "".join(
        "<tr>" + "".join(cell if cell.startswith("<td") else f"<td>{cell}" for cell in row) for row in rows
    )
    return f"<table><tr>{head}{lines}</table>"


def _safe(text: str) -> str:
    """Text that XML can hold."""
    return printable(text, keep="\n")
