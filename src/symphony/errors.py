"""Errors a user can meet, each naming where it happened."""

from __future__ import annotations

import copy
from typing import Self


class SymphonyError(Exception):
    """Base of every error this package raises on bad input; the command line prints it without a traceback."""


class AllFailedError(SymphonyError):
    """Every run failed: there are results, but they only say why."""


class CouldNotRunError(SymphonyError):
    """A suite could not run at all."""


class ConfigError(SymphonyError):
    """An argument or a saved configuration that can't be used."""


class DataWarning(UserWarning):
    """Data that can be used, but may not be what was meant; the command line prints it in one line."""


class DataError(SymphonyError):
    """Bad or unusable data: what is wrong, in which file, run segment and field of the schema or the format."""

    def __init__(
        self, message: str, *, file: object = None, segment: str | None = None, field: str | None = None
    ) -> None:
        self.message, self.file, self.segment, self.field = message, file, segment, field
        super().__init__(message)

    def __str__(self) -> str:
        places = (("file", self.file), ("segment", self.segment), ("field", self.field))
        where = ", ".join(f"{name} {printable(str(value))}" for name, value in places if value is not None)
        message = printable(self.message, keep="\n")
        return f"{where}: {message}" if where else message

    def at(self, *, file: object = None, segment: str | None = None) -> Self:
        """Return the same error with the places that were still unknown filled in."""
        error = copy.copy(self)
        error.file, error.segment = self.file or file, self.segment or segment
        return error


def printable(text: str, keep: str = "") -> str:
    """Escape everything in a text but ``keep`` that can't be shown, or on which a terminal would act."""
    return "".join(c if c.isprintable() or c in keep else ascii(c)[1:-1] for c in text)
