"""Symphony: realistic and diverse traffic agents learned from logged driving."""

from symphony._version import __version__

__all__ = ["__version__"]
