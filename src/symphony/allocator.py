"""Keep freed memory for the next step instead of giving it back to the system each time (Linux with glibc).

A step of a simulation frees tens of megabytes and asks for as much again. By default the kernel takes large blocks
back and must clear their pages again: half of a step's time at 1 000 points an agent. glibc's own variables, such as
``MALLOC_TOP_PAD_``, take precedence; ``SYMPHONY_MALLOPT=0`` leaves all as it is.
"""

from __future__ import annotations

import ctypes
import os
import platform
from typing import Any


def tune() -> bool:
    """Set the allocator of this process, before its first large tensor; return whether it was set."""
    library, trim, pad, mapping = _ours(), -1, -2, -3  # M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD
    # Older versions take no mapping threshold above 32 MiB.
    kept = library and (library.mallopt(mapping, 1 << 30) or library.mallopt(mapping, 1 << 25))
    return bool(kept and library.mallopt(trim, (1 << 31) - 1) and library.mallopt(pad, 1 << 26))


def release() -> bool:
    """Give free pages from anywhere in the heap back to the system; return whether any were. Call it once in many
    steps: otherwise a long training's heap grows without end, as lasting blocks settle where large ones were freed.
    """
    return bool((library := _ours()) and library.malloc_trim(0))


def _ours() -> Any:
    """Return the C library if it is glibc and the user has not configured its memory."""
    names = {f"MALLOC_{name}_" for name in ("TRIM_THRESHOLD", "TOP_PAD", "MMAP_THRESHOLD")}
    said = bool(names & os.environ.keys()) or os.environ.get("SYMPHONY_MALLOPT", "1") in {"", "0"}
    glibc = platform.system() == "Linux" and platform.libc_ver()[0] == "glibc"
    return ctypes.CDLL(None) if glibc and not said else None
