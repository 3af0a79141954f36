"""How much memory a piece of work asks for, told apart from what else goes on in the test's process."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable

import numpy as np

STRETCHES = 9
RUNS = 10


def kept_bytes(work: Callable[[], object]) -> tuple[int, int]:
    """Bytes that ten runs of ``work`` keep, and the most that one run needs above what was there, after a warm-up.

    What ``work`` does, it does every time. Numba fills at some call or other what it keeps for all of them, and the
    collector or another thread may come in between: the first figure is the median of nine stretches of ten runs, the
    second the least of all runs. An array that each run kept would be 1120 bytes at least: ten headers of 112.
    """
    kept, peaks = np.empty(STRETCHES), np.empty((STRETCHES, RUNS))  # before tracing begins: they would be counted
    work()
    gc.collect()
    tracemalloc.start()
    try:
        work()  # what tracing itself keeps of the call
        for stretch in range(STRETCHES):
            start = tracemalloc.get_traced_memory()[0]
            for run in range(RUNS):
                before = tracemalloc.get_traced_memory()[0]
                tracemalloc.reset_peak()
                work()
                peaks[stretch, run] = tracemalloc.get_traced_memory()[1] - before
            kept[stretch] = tracemalloc.get_traced_memory()[0] - start
    finally:
        tracemalloc.stop()
    return int(np.median(kept)), int(peaks.min())
