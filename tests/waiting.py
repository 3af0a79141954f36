"""Waiting for what other threads and processes do, for as long as a machine with everything else to do may need."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 60.0  # nothing waits so long on an idle machine


def wait_for(true: Callable[[], bool]) -> bool:
    """Whether ``true()`` comes to hold."""
    ends = time.monotonic() + PATIENCE_S
    while time.monotonic() < ends:
        if true():
            return True
        time.sleep(0.005)
    return False
