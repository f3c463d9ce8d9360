"""The reasons of skipped tests, by kind; `tests/skips.txt` says how many of each may be skipped, the others none."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

LIMITS = Path(__file__).parent / "skips.txt"
KINDS = {
    "a card": "no CUDA device", "no card": "one kind of accelerator",
    "real samples": r"sample|no summary at|no real WOMD", "a browser": "no Chromium",
    "a package": "could not import|not installed|needs the extra", "a user other than root": "to root",
    "another system": "not glibc|needs SIGKILL|needs /proc|/dev/full|Linux|file system|library of threads|/proc for",
}  # fmt: skip


def by_kind(reasons: Iterable[str]) -> Counter[str]:
    """How many tests were skipped for want of what; a reason of no kind stands for itself."""
    found = ([kind for kind, words in KINDS.items() if re.search(words, why)] or [why] for why in reasons)
    return Counter(kinds[0] for kinds in found)


def grown(counts: Counter[str], limits: str) -> list[str]:
    """Kinds of which more were skipped than is written."""
    allowed = {kind.strip(): int(most) for most, kind in (line.split(" ", 1) for line in limits.splitlines())}
    return [
        f"{count} tests skipped for want of {kind}, at most {allowed.get(kind, 0)} may be ({LIMITS.name})"
        for kind, count in counts.items()
        if count > allowed.get(kind, 0)
    ]
