"""Errors a user can meet, each naming where it happened."""

from __future__ import annotations


class SymphonyError(Exception):
    """Base of every error this package raises on bad input; the command line prints it without a traceback."""


def printable(text: str, keep: str = "") -> str:
    """Text with everything escaped that a terminal would act on, or that can't be shown, but for what is to be kept.

    What files hold may be meant to move the cursor, to clear the screen or to turn the direction of writing around.
    """
    return "".join(
        letter
        if letter.isprintable() or letter in keep
        else letter.encode("unicode_escape", "surrogatepass").decode("ascii")
        for letter in text
    )


class AllFailedError(SymphonyError):
    """Every run failed: there are results, but they only say why. The command line ends with a status of its own."""


class ThresholdError(SymphonyError):
    """A planner does not keep the thresholds of a suite."""


class CouldNotRunError(SymphonyError):
    """A suite could not run at all. The command line ends with the status of wrong usage."""


class DataError(SymphonyError):
    """Bad or unusable data.

    Args:
        message: what is wrong.
        file: the file it was read from.
        segment: the id of the run segment.
        field: the field of the segment, as written in the schema or the format.
    """

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

    def at(self, *, file: object = None, segment: str | None = None) -> DataError:
        """The same error (same class) with the places that were still unknown filled in."""
        error = type(self).__new__(type(self))
        DataError.__init__(
            error,
            self.message,
            file=self.file if self.file is not None else file,
            segment=self.segment if self.segment is not None else segment,
            field=self.field,
        )
        return error


class DataWarning(UserWarning):
    """Data that can be used, but may not be what was meant; the command line prints it in one line."""


class ConfigError(SymphonyError):
    """An argument or a saved configuration that can't be used."""
