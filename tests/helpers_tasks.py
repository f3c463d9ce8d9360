"""Tasks for workers of programs that need nothing else, and so start at once."""

from __future__ import annotations

import os
import time


def sleep_or_return(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()
