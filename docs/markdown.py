"""For the reference: docstrings as Markdown. Cross-references become code, stars of shapes such as `[*b, S]` stay."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

ROLE = re.compile(r":(?:class|func|meth|data|mod|attr|exc):`~?([^`]+)`")
STAR = re.compile(r"(`+[^`]+`+)|\[\*")


def as_markdown(text: str) -> str:
    """Roles become code; a star that begins a shape, outside of code, no emphasis."""
    return STAR.sub(lambda found: found[1] or r"[\*", ROLE.sub(r"`\1`", text))


class Markdown(Extension):
    """Rewrites every docstring that is loaded."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """See :func:`as_markdown`."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
