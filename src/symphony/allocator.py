"""Keep freed memory for the next step instead of giving it back to the system each time (Linux with glibc).

A step of a simulation frees tens of megabytes and asks for as much again. By default glibc returns large blocks to
the kernel, which must clear every page before it hands it out again: half of a step's time at 1 000 points an agent.
The ``symphony`` command calls :func:`tune`; programs of your own can do the same before their first large tensor.
glibc's own variables, such as ``MALLOC_TOP_PAD_``, take precedence; ``SYMPHONY_MALLOPT=0`` leaves all as it is.
"""

from __future__ import annotations

import ctypes
import os
import platform


def tune() -> bool:
    """Set the allocator of this process; return whether it was set."""
    library = _ours()
    if library is None:
        return False
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    # Older versions take no mapping threshold above 32 MiB.
    mapped = library.mallopt(mmap_threshold, 1 << 30) or library.mallopt(mmap_threshold, 1 << 25)
    rest = library.mallopt(trim_threshold, (1 << 31) - 1) and library.mallopt(top_pad, 1 << 26)
    return bool(mapped and rest)


def release() -> bool:
    """Give pages that are free, wherever in the heap, back to the system; return whether any were.

    What stays, such as a segment that is kept, settles where a large block was freed, and the next no longer fits
    there: the heap of a long training would grow without end. Once in many steps is enough.
    """
    library = _ours()
    return library is not None and bool(library.malloc_trim(0))


def _ours() -> ctypes.CDLL | None:
    """The C library, if it is glibc and nobody has said how it shall keep memory."""
    variables = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_TOP_PAD_", "MALLOC_MMAP_THRESHOLD_")
    said = [name for name in variables if name in os.environ]
    said += ["off"] if os.environ.get("SYMPHONY_MALLOPT", "1") in {"", "0"} else []
    glibc = platform.system() == "Linux" and platform.libc_ver()[0] == "glibc"
    return ctypes.CDLL(None) if glibc and not said else None
