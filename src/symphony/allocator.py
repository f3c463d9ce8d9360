"""Keep freed memory for the next step instead of giving it back to the system each time.

A step of a simulation frees tens of megabytes and asks for as much again. By default glibc returns large blocks to
the kernel, which must clear every page before it hands it out again: half of a step's time at 1 000 points an agent.
The ``symphony`` command calls :func:`tune`; programs of your own can do the same before their first large tensor.
glibc's own variables, such as ``MALLOC_TOP_PAD_``, take precedence; ``SYMPHONY_MALLOPT=0`` leaves all as it is.

What stays, such as a segment that is kept for later updates, settles where a large block was freed, and the next
large block no longer fits there: with kept memory the heap of a long training grows without end. So training gives
free pages back every now and then (:func:`release`).
"""

from __future__ import annotations

import ctypes
import os
import platform

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_TOP_PAD_", "MALLOC_MMAP_THRESHOLD_")
KEPT, MAPPED, PAD = (1 << 31) - 1, 1 << 30, 1 << 26
"""Bytes: free ones at the end of the heap from which on they are given back; of a block from which on it is a mapping
of its own; by which the heap grows beyond what is asked for."""


def tune() -> bool:
    """Set the allocator of this process (Linux with glibc; elsewhere nothing happens); returns whether it was set."""
    library = _ours()
    if library is None:
        return False
    # Older versions take no mapping threshold above 32 MiB.
    mapped = library.mallopt(_MMAP_THRESHOLD, MAPPED) or library.mallopt(_MMAP_THRESHOLD, 1 << 25)
    return bool(mapped and library.mallopt(_TRIM_THRESHOLD, KEPT) and library.mallopt(_TOP_PAD, PAD))


def release() -> bool:
    """Give pages that are free, wherever in the heap, back to the system (where :func:`tune` would set anything).

    The next step asks for its part of them again, so once in many steps is enough. Returns whether any were.
    """
    library = _ours()
    return library is not None and bool(library.malloc_trim(0))


def _ours() -> ctypes.CDLL | None:
    """The C library, if it is glibc and nobody has said how it shall keep memory."""
    if os.environ.get("SYMPHONY_MALLOPT", "1") in {"", "0"} or any(name in os.environ for name in _VARIABLES):
        return None
    if platform.system() != "Linux" or platform.libc_ver()[0] != "glibc":
        return None
    return ctypes.CDLL(None)
