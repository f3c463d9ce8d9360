"""Write what `make fuzz`, `make kills`, `make flat` and `make mutate` have counted into docs/hardening.md.

    python scripts/hardening_page.py --records results/hardening

The folder holds ``fuzz*.json`` and ``kills*.json`` (added up), ``flat.json`` and ``mutate.json`` as those commands
write them to out/.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

PAGE = Path(__file__).resolve().parents[1] / "docs" / "hardening.md"
MIB = 1 << 20


def main(args: list[str] | None = None) -> int:
    """Replace the tables of the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--records", type=Path, default=Path("results/hardening"))
    parser.add_argument("--page", type=Path, default=PAGE)
    given = parser.parse_args(args)
    fuzz = [json.loads(file.read_text()) for file in sorted(given.records.glob("fuzz*.json"))]
    kills = [json.loads(file.read_text()) for file in sorted(given.records.glob("kills*.json"))]
    flat, mutate = (json.loads((given.records / f"{name}.json").read_text()) for name in ("flat", "mutate"))
    text = given.page.read_text(encoding="utf-8")
    tables = {
        "fuzz": of_fuzz(fuzz),
        "kills": of_kills(kills),
        "flat": of_flat(flat),
        "mutate": of_mutate(mutate),
    }
    for name, table in tables.items():
        text, count = re.subn(
            rf"(<!-- counts: {name} -->\n).*?(<!-- end -->)",
            lambda m, t=table: m[1] + t + m[2],
            text,
            flags=re.S,
        )
        if count != 1:
            raise SystemExit(f"{given.page} has no place for {name}")
    given.page.write_text(text, encoding="utf-8")
    return 0


def rows(head: Iterable[str], body: Iterable[Iterable[Any]]) -> str:
    """A table in Markdown."""
    names = list(head)
    lines = [names, ["---"] * len(names), *([str(cell) for cell in row] for row in body)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def of_fuzz(runs: list[dict[str, Any]]) -> str:
    """Inputs by kind; all that is bad as one number."""
    total: dict[str, Counter[str]] = {}
    for run in runs:
        for name, counts in run.items():
            total.setdefault(name, Counter()).update(counts["outcomes"])
    total["all"] = sum(total.values(), Counter())
    shown = ("accepted", "refused")
    body = [
        (name, sum(c.values()), *(c[key] for key in shown), sum(c.values()) - sum(c[key] for key in shown))
        for name, c in total.items()
    ]
    return rows(("kind", "inputs", "read", "refused", "failures"), body)


def of_kills(runs: list[dict[str, Any]]) -> str:
    """Kills, and what they lost; the time is that of the last run."""
    body = []
    for name in dict.fromkeys(name for run in runs for name in run):
        mine = [run[name] for run in runs if name in run]
        kills, finished = (sum(each[key] for each in mine) for key in ("kills", "finished"))
        lost = sum(len(each["failed"]) for each in mine)
        body.append((name, kills, finished, lost, f"{mine[-1]['seconds']:.2f}"))
    head = (
        "work",
        "kills",
        "times it came to its end and was compared",
        "differences",
        "CPU seconds undisturbed",
    )
    return rows(head, body)


def of_mutate(found: dict[str, Any]) -> str:
    """Changes by module, and those that no test noticed."""
    body = [
        (f"`{name}`", each["made"], each["possible"], "; ".join(each["missed"]) or "none")
        for name, each in found.items()
    ]
    return rows(("module", "changes made", "of", "not noticed"), body)


def of_flat(found: dict[str, Any]) -> str:
    """Memory and files at each of the samples."""
    body = []
    for what in ("updates", "segments"):
        body += [(f"{done} {what}", f"{used / MIB:.0f}", files) for done, used, files in found[what]]
    return rows((f"after ({found['method']})", "MiB", "open files"), body)


if __name__ == "__main__":
    raise SystemExit(main())
