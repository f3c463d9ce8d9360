"""The report of a conversion: what it did, and what it left out for which reason."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from symphony.data.overlaps import MANY
from symphony.data.selection import EXCLUSIONS
from symphony.errors import DataError


@dataclass(frozen=True)
class Skip:
    """A record or file that was left out: the reason, and its place where known. ``exclusion`` is the one of
    :data:`symphony.data.selection.EXCLUSIONS` it fell under; empty for unusable data.
    """

    message: str
    file: str = ""
    segment: str = ""
    field: str = ""
    exclusion: str = ""

    @property
    def reason(self) -> str:
        """The message with numbers blanked, so that similar cases are counted together."""
        text = re.sub(r"-?\d+(\.\d+)?", "#", self.message)
        return f"{self.field}: {text}" if self.field else text

    @classmethod
    def of(cls, error: DataError, path: object = "", segment: str = "", exclusion: str = "") -> Skip:
        """Return the report's entry for an error."""
        texts = (error.message, str(path), error.segment or segment, error.field or "", exclusion)
        # Half a character, as damaged text may hold, could not be written, and would end the conversion.
        return cls(*(text.encode(errors="backslashreplace").decode() for text in texts))

    def to_json(self) -> dict[str, str]:
        """Return the entry as kept in a report: without ``exclusion`` where there is none."""
        return {name: text for name, text in asdict(self).items() if text or name != "exclusion"}

    @property
    def error(self) -> DataError:
        """The error behind this entry."""
        where = {"file": self.file or None, "segment": self.segment or None, "field": self.field or None}
        return DataError(self.message, **where)


@dataclass
class Report:
    """The report of a conversion."""

    converted: int = 0  # segments added
    files: int = 0  # files read
    skipped: list[Skip] = field(default_factory=list)  # what was left out, the paper's exclusions included
    settings: dict[str, Any] = field(default_factory=dict)  # arguments of the conversion
    odd: dict[str, int] = field(default_factory=dict)  # what is unusual or was left out, of how many segments
    overlaps: int = 0  # segments added in whose log a moving vehicle's box overlaps another
    joined_gaps: int = 0  # links between lanes that were added, summed over the segments
    odd_examples: dict[str, str] = field(default_factory=dict)  # the first of each kind of odd

    def note(self, odd: Mapping[str, str], segment: str) -> None:
        """Count the oddities of a segment: kind -> example."""
        for kind, example in odd.items():
            self.odd[kind] = self.odd.get(kind, 0) + 1
            self.odd_examples.setdefault(kind, f"{segment}: {example}" if example else segment)

    @property
    def warning(self) -> str:
        """A warning for the user; empty if there is none."""
        if self.overlaps <= MANY * self.converted:
            return ""
        return (
            f"in the logs of {self.overlaps} of {self.converted} segments "
            f"({100 * self.overlaps / self.converted:.1f} %) a moving vehicle's box overlaps another: collisions "
            "there count errors of the tracking, too; --exclude-overlaps leaves them out"
        )

    @property
    def reasons(self) -> dict[str, int]:
        """The number of skips for each reason, most frequent first."""
        return dict(Counter(skip.reason for skip in self.skipped).most_common())

    @property
    def problems(self) -> dict[str, int]:
        """The number of skips for each reason but the paper's exclusions."""
        return dict(Counter(skip.reason for skip in self.skipped if not skip.exclusion).most_common())

    @property
    def exclusions(self) -> dict[str, int]:
        """The number of sound segments left out under each of the exclusions, all of which are listed."""
        found = Counter(skip.exclusion for skip in self.skipped)
        return {name: found[name] for name in EXCLUSIONS}

    def to_json(self) -> dict[str, Any]:
        """Return the report as kept with the store."""
        skipped = [skip.to_json() for skip in self.skipped]
        return {**vars(self), "skipped": skipped, "exclusions": self.exclusions, "reasons": self.reasons}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Report:
        """Reverse :meth:`to_json`, or raise a :class:`DataError`; an empty mapping gives an empty report."""
        known = {item.name: value[item.name] for item in fields(cls) if item.name in value}
        for key, found in known.items():
            if not isinstance(found, type(getattr(cls(), key))):
                raise DataError(f"not a conversion report: {str(found)[:40]!r}", field=key)
        try:
            skipped = [Skip(**{k: str(v) for k, v in skip.items()}) for skip in known.pop("skipped", ())]
        except (TypeError, AttributeError) as error:
            raise DataError(f"not a conversion report: {error}", field="skipped") from error
        return cls(**known, skipped=skipped)

    def after(self, earlier: Report) -> Report:
        """Join this report to the one of an earlier conversion into the same store."""
        return Report(
            converted=earlier.converted + self.converted,
            files=earlier.files + self.files,
            skipped=list(dict.fromkeys([*earlier.skipped, *self.skipped])),
            settings=self.settings,
            odd=dict(Counter(earlier.odd) + Counter(self.odd)),
            overlaps=earlier.overlaps + self.overlaps,
            joined_gaps=earlier.joined_gaps + self.joined_gaps,
            odd_examples={**self.odd_examples, **earlier.odd_examples},
        )


def left_out(skipped: Iterable[Skip]) -> list[str]:
    """Return a line for each reason: how often, why, and the first segment."""
    first: dict[str, Skip] = {}
    counts = Counter[str]()
    for skip in skipped:
        counts[skip.reason] += 1
        first.setdefault(skip.reason, skip)
    return [f"{count} x {reason} (first: {first[reason].segment})" for reason, count in counts.most_common()]
