"""A core of its own for the thread that ticks.

Where more threads are busy than cores, a system lets them take turns, and a turn is long: Linux keeps a tick's thread
waiting for 4 ms while the recorder's or the rerun library's has its core (measured; a nicer thread takes the same
turn, less often). So in real time all other threads of the process keep off one core. Only Linux lets a process say
so; elsewhere, and where there is a single core, nothing is done.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def own_core() -> Iterator[None]:
    """The calling thread has a core to itself, as far as this process goes; threads that exist keep off it.

    A thread that the caller starts meanwhile begins on the same core. In the end all may run everywhere again.
    """
    if sys.platform != "linux":
        yield
        return
    here = threading.get_native_id()
    cores = os.sched_getaffinity(here)
    if len(cores) < 2:
        yield
        return
    # The first ones have most of a system's own work to do.
    own = max(cores)
    _run_on(cores - {own}, but=here)
    os.sched_setaffinity(here, {own})
    try:
        yield
    finally:
        os.sched_setaffinity(here, cores)
        _run_on(cores, but=here)


def _run_on(cores: set[int], but: int) -> None:
    """All threads of this process run on ``cores``, except for one."""
    for thread in map(int, os.listdir("/proc/self/task")):
        if thread != but:
            with suppress(ProcessLookupError):  # it has just ended
                os.sched_setaffinity(thread, cores)
