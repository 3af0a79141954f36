"""How long the machine's memory takes for so many bytes: the limit of whatever reads them all."""

from __future__ import annotations

from time import perf_counter

import numpy as np
from numba import njit

from trainer.geometry import Array

#: Rounds at least; the median counts.
ROUNDS = 5


@njit(cache=True, nogil=True, error_model="numpy")
def scale(values: Array, by: float) -> None:
    """Multiplies ``values`` (n,) in place: the least that a processor can do with what it reads."""
    for i in range(len(values)):
        values[i] *= by


def stream_ms(moved_bytes: float, held_bytes: float) -> float:
    """The time, ms, in which one core scales ``moved_bytes`` in place, now: an array of ``held_bytes``, over and over.

    So what fits into the caches stays there, as it does for a method that holds so many bytes.
    """
    size = max(int(held_bytes) // 8, 1)
    values = np.full(size, 1.0)
    scale(values, 1.0)
    took = []
    for _ in range(ROUNDS):
        begun = perf_counter()
        scale(values, 1.0)
        took.append(perf_counter() - begun)
    return float(np.median(took)) * 1e3 * moved_bytes / (8.0 * size)
