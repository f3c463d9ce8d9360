"""The flags of a profile, for commands that train."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_type_hints

from symphony.config import PROFILES, TrainConfig
from symphony.config.checks import option
from symphony.errors import ConfigError

WORDS = (
    "default: the values shown; paper: the protocol of the paper (70 000 updates, 1 000 points, its discriminator, "
    "batch 16, S 4 and 16, 200 validation segments); recommended: what gave the best agents so far (inputs beyond "
    "the paper's, displaced states, only bad branches replaced, goals of each; 3 000 updates, 200 points); laptop: "
    "meant for two cores and about an hour (3 000 updates, 128 points, 48 validation segments of 4 rollouts); tiny: "
    "half a minute, what `make table` runs; smoke: seconds, to see that all runs. What is given beside it has "
    "precedence; the best checkpoint is chosen where --validation.data is given."
)


def expanded(args: Sequence[str]) -> list[str]:
    """Arguments of a training command with the flags of their ``--profile`` that are not among them.

    Raises:
        ConfigError: for an unknown profile.
    """
    given = list(args)
    name = "default"
    for place, word in enumerate(given):
        if word == "--profile" and place + 1 < len(given):
            name = given[place + 1]
        elif word.startswith("--profile="):
            name = word.removeprefix("--profile=")
    if name not in PROFILES:
        close = difflib.get_close_matches(name, PROFILES, 1)
        hint = f", did you mean '{close[0]}'?" if close else ""
        raise ConfigError(f"profile is one of {', '.join(PROFILES)}, not '{name}'{hint}")
    plain = TrainConfig(method="bc", data=Path(), out=Path())
    written = {word.split("=")[0].replace("_", "-") for word in given}
    return [
        *given,
        *(w for flag, words in _changes(plain, PROFILES[name](plain)) if flag not in written for w in words),
    ]


def _changes(before: Any, after: Any, prefix: str = "--") -> Iterator[tuple[str, list[str]]]:
    """Flags and the words that set them, for what differs between two configurations."""
    hints = get_type_hints(type(before), include_extras=True)
    for field in dataclasses.fields(before):
        old, new = getattr(before, field.name), getattr(after, field.name)
        # Some are called otherwise on the command line.
        extras = getattr(hints[field.name], "__metadata__", ())
        names = [extra.name for extra in extras if hasattr(extra, "aliases") and extra.name]
        flag = prefix + (names[0] if names else option(field.name))
        if dataclasses.is_dataclass(old):
            yield from _changes(old, new, f"{flag}.")
        elif new is True and old is False:
            yield flag, [flag]
        elif old != new:
            yield flag, [flag, str(new)]
