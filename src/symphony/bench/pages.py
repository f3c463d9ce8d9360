"""A suite's result for machines that build software (JUnit XML) and for people (one page that opens offline)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any
from urllib.parse import urlencode
from xml.etree import ElementTree as ET

from symphony.bench.measures import MEASURES, measured
from symphony.bench.run import EVENTS, Pair, Result, Verdict
from symphony.errors import printable

WORST = 20
"""Bad runs of a pair that are named, at most."""
LEAD = 2.0
"""Seconds before the first event of a run at which its replay begins."""
SHOWN = ["score", "pdm_score", "at_fault_collision_rate", "collision_rate", "red_light_rate", "offroad_rate"]
SHOWN += ["progress_ratio", "max_braking", "failed_rate"]
"""Measures in the table of the page."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem; color: #1d2129 }
table { border-collapse: collapse; margin: .5rem 0 2rem; width: 100% }
th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid #ddd }
.passes { color: #146c2e; font-weight: 600 } .fails, .undecided { color: #b3261e; font-weight: 600 }
"""


def junit(result: Result) -> str:
    """Return JUnit XML: a test suite for each planner and crowd, a test case for each threshold."""
    root = ET.Element("testsuites", name=_safe(result.suite.name), time=f"{result.seconds:.1f}")
    for pair in result.pairs:
        mine = [one for one in result.verdicts if f"{one.planner} among {one.crowd}" == pair.name]
        failing = str(sum(one.status != "passes" for one in mine))
        counts = {"tests": str(len(mine)), "failures": failing, "errors": "0", "skipped": "0"}
        about = {"name": _safe(pair.name), **counts, "time": f"{pair.seconds:.1f}"}
        suite = ET.SubElement(root, "testsuite", about)
        for one in mine:
            about = {"classname": _safe(pair.name), "name": _safe(str(one.threshold))}
            case = ET.SubElement(suite, "testcase", about)
            if one.status != "passes":
                failure = ET.SubElement(case, "failure", type=one.status, message=_safe(sentence(one)))
                failure.text = _safe("\n".join(_lines(pair)))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def sentence(one: Verdict) -> str:
    """Describe a verdict in words."""
    if one.found.mean is None:
        return f"{one.threshold}: not defined in any run"
    bound = ", without a bound" if one.bound is None else ""
    if one.bound is not None and one.threshold.confidence is not None:
        bound = f", {one.threshold.side.replace('_', ' ')} {one.bound:.6g}"
        bound += f" with {100 * one.threshold.confidence:g} % confidence"
    return f"{one.threshold}: {one.found.mean:.6g}{bound}, from {one.found.runs} runs of {one.found.groups} groups"


def _what(run: dict[str, Any]) -> str:
    """Describe in words what went wrong in a run."""
    if run["failed"]:
        return f"fails: {run['failed']}"
    return ", ".join(text for name, text in EVENTS.items() if run[name])


def _lines(pair: Pair) -> Iterable[str]:
    found = [run for run in pair.report.worst() if _what(run)]
    for run in found[:WORST]:
        yield f"segment {run['segment']}, rollout {run['rollout']}, seed {pair.crowd.config.seed}: {_what(run)}"
    if len(found) > WORST:
        yield f"and {len(found) - WORST} more"


def page(result: Result, *, view: bool = True) -> str:
    """Return one page: verdicts, numbers, regressions and the bad runs, each a click away from its replay."""
    suite, word = result.suite, "passes" if result.passed else "fails"
    config = suite.crowds[0].config
    parts = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(suite.name)}</title>',
        f"<style>{_STYLE}</style><h1>{escape(suite.name)} <span class={word}>{word}</span></h1>",
        f"<p>{len(suite.items)} run segments of {escape(str(suite.store.path))}, {config.rollouts} rollouts of each, "
        f"seed {config.seed}, {result.seconds:.0f} s. Bounds are one-sided, over groups of segments.</p>",
    ]
    verdicts = sorted(result.verdicts, key=lambda one: one.status == "passes")
    rows = [(one.planner, one.crowd, sentence(one)) for one in verdicts]
    marks = [f"<span class={one.status}>{one.status}</span>" for one in verdicts]
    parts.append(_table("Thresholds", ("planner", "crowd", "threshold and what was found"), rows, marks))
    heads = ("planner", "crowd", "runs", *(f"{MEASURES[name].text} {MEASURES[name].unit}" for name in SHOWN))
    parts.append(_table("Numbers", heads, [_numbers(pair) for pair in result.pairs]))
    if stopped := ", ".join(pair.name for pair in result.pairs if pair.stopped):
        why = "no outcome of the remaining runs could keep a threshold"
        parts.append(f"<p>Stopped early, since {why}: {escape(stopped)}.</p>")
    if result.regressions:
        heads = ("planner", "crowd", "segment", "rollout", "what")
        rows = [tuple(one[name] for name in heads) for one in result.regressions]
        parts.append(_table("Worse than the baseline", heads, rows))
    for pair in result.pairs:
        if found := [run for run in pair.report.worst() if _what(run)][:WORST]:
            rows = [(run["segment"], run["rollout"], _what(run)) for run in found]
            links = [_link(pair, run) if view else "" for run in found]
            parts.append(_table(f"{pair.name}: bad runs", ("segment", "rollout", "what"), rows, links))
    return "".join(parts) + "</html>\n"


def _numbers(pair: Pair) -> tuple[Any, ...]:
    means = [measured(pair.runs, MEASURES[name]).mean for name in SHOWN]
    cells = ["–" if mean is None else f"{mean:.3g}" for mean in means]
    return (pair.planner.name, pair.crowd.name, len(pair.runs), *cells)


def _link(pair: Pair, run: dict[str, Any]) -> str:
    if run.get("steps") is None:
        return ""
    begin = max((run.get("first_event") or 0) - LEAD, 0)
    place = {"segment": run["segment"], "rollout": run["rollout"], "t": round(begin, 2), "follow": "ego"}
    return f'<a href="{pair.planner.name}/{pair.crowd.name}/view.html#{urlencode(place)}">replay</a>'


def _table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[Any]], marks: Sequence[str] | None = None
) -> str:
    """Return a table of text under a title, with our own marks, which are HTML, before its lines."""
    lines = [[escape(printable(str(cell))) for cell in row] for row in rows]
    if marks is not None:
        heads, lines = ("", *heads), [[mark, *line] for mark, line in zip(marks, lines, strict=True)]
    found = [f"<h2>{escape(title)}</h2><table><tr>", *(f"<th>{escape(text)}" for text in heads)]
    found += ["".join(["<tr>", *(f"<td>{cell}" for cell in line)]) for line in lines]
    return "".join(found) + "</table>"


def _safe(text: str) -> str:
    """Return a text without the characters that XML cannot hold."""
    return printable(text, keep="\n")
