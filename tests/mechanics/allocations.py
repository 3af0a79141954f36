"""How much memory a piece of work asks for, told apart from what else goes on in the test's process."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable

import numpy as np

WARM_UPS = 100
STRETCHES = 9
RUNS = 10
#: What the smallest array takes besides its numbers; a run that keeps less keeps none.
ARRAY_HEADER = 112


def kept_bytes(work: Callable[[], object]) -> tuple[float, int]:
    """Bytes that each run of ``work`` keeps, and the most that one run needs above what was there, after a warm-up.

    What ``work`` does, it does every time. Python and numba fill at some call or other what they keep for all of them
    (strings of 53 bytes, about a hundred, at one line of a search), and the collector or another thread may come in
    between: the first figure is that of the stretch of ten runs that kept least, the second the least of all runs.
    """
    kept, peaks = np.empty(STRETCHES), np.empty((STRETCHES, RUNS))  # before tracing begins: they would be counted
    work()  # kernels are compiled; under tracing that takes minutes
    gc.collect()
    tracemalloc.start()
    try:
        for _ in range(WARM_UPS):  # traced, for tracing itself keeps something of a call
            work()
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
    return float(kept.min()) / RUNS, int(peaks.min())
