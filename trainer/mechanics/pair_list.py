"""Pairs that a contact search finds: room that grows outside the kernels, one order, and nodes refused at the door."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.closest_points import LARGEST_MM

#: Room for so many pairs at first.
FIRST_ROOM = 4096
#: Bits of a key that are sorted at once; 2048 counters stay in the first cache.
DIGIT_BITS = 11
# All bits of a float64 but its sign.
MAGNITUDE = 0x7FFFFFFFFFFFFFFF


@njit(cache=True, nogil=True, error_model="numpy")
def _largest_bits(bits):  # type: ignore[no-untyped-def]
    """The bits of the largest magnitude: those of floats without their sign are ordered as the floats, NaN last."""
    largest = np.int64(0)
    for k in range(bits.shape[0]):
        magnitude = bits[k] & MAGNITUDE
        largest = magnitude if magnitude > largest else largest
    return largest


def largest_magnitude(x: Array, name: str) -> float:
    """The largest |coordinate| of the nodes ``x`` (n, 3) mm.

    Raises ValueError, naming ``name``, when ``x`` is no C-ordered float64 array (n, 3), or a coordinate is NaN,
    infinite or beyond ``LARGEST_MM``.
    """
    if x.ndim != 2 or x.shape[1] != 3 or x.dtype != np.float64 or not x.flags.c_contiguous:
        raise ValueError(f"{name}: expected a C-ordered float64 array (n, 3), found {x.dtype} {x.shape}")
    largest = float(np.int64(_largest_bits(x.ravel().view(np.int64))).view(np.float64))
    if not largest <= LARGEST_MM:
        node = int(np.flatnonzero(~(np.abs(x) <= LARGEST_MM).all(axis=1))[0])
        raise ValueError(f"{name}: node {node} is at {x[node].tolist()}; places must be finite and below 1e9 mm")
    return largest


def checked_margin(margin_mm: float) -> float:
    """``margin_mm`` itself. Raises ValueError when it is negative, NaN or beyond ``LARGEST_MM``."""
    if not 0.0 <= margin_mm <= LARGEST_MM:
        raise ValueError(f"margin_mm must lie between 0 and 1e9, found {margin_mm}")
    return float(margin_mm)


def checked_elements(elements: np.ndarray, corners: int, name: str) -> np.ndarray:
    """A C-ordered int32 copy (m, ``corners``) of segments or triangles. Raises ValueError for another shape."""
    out = np.array(elements, dtype=np.int32, order="C")
    if out.size == 0:
        return np.empty((0, corners), dtype=np.int32)
    if out.ndim != 2 or out.shape[1] != corners or out.min() < 0:
        raise ValueError(f"{name}: expected node indices of shape (m, {corners}), found shape {out.shape}")
    return out


def rounding_mm(scale_mm: float) -> float:
    """By how much two boxes are brought closer, so that rounding hides no pair among coordinates up to ``scale_mm``.

    The longest chain of roundings between a coordinate and a compared distance has less than 64 steps.
    """
    return 64.0 * float(np.finfo(np.float64).eps) * scale_mm


@njit(cache=True, nogil=True, error_model="numpy")
def _sort(keys, scratch, counts, count, most):  # type: ignore[no-untyped-def]
    """Sort ``keys[:count]``, none above ``most``, digit by digit from the lowest; the result is in ``keys``."""
    digits = counts.shape[0]
    shift = 0
    while most >> shift > 0:
        counts[:] = 0
        for k in range(count):
            counts[(keys[k] >> shift) & (digits - 1)] += 1
        total = 0
        for d in range(digits):
            here = counts[d]
            counts[d] = total
            total += here
        for k in range(count):
            d = (keys[k] >> shift) & (digits - 1)
            scratch[counts[d]] = keys[k]
            counts[d] += 1
        for k in range(count):
            keys[k] = scratch[k]
        shift += DIGIT_BITS


@njit(cache=True, nogil=True, error_model="numpy")
def _unpack(keys, count, second, pairs):  # type: ignore[no-untyped-def]
    for k in range(count):
        pairs[k, 0] = keys[k] // second
        pairs[k, 1] = keys[k] % second


class PairList:
    """Pairs (first, second) with indices below two sizes, kept as keys ``first * sizes[1] + second``.

    A kernel writes keys while there is room and returns how many there are; when they are more than the room, the room
    grows here and the kernel runs again. After that nothing is allocated until they are more than ever before.
    """

    def __init__(self, sizes: tuple[int, int]) -> None:
        self._sizes = sizes
        self._counts = np.zeros(1 << DIGIT_BITS, dtype=np.int64)
        self._make_room(FIRST_ROOM)

    def _make_room(self, room: int) -> None:
        self._keys = np.zeros(room, dtype=np.int64)
        self._scratch = np.zeros(room, dtype=np.int64)
        self._pairs = np.zeros((room, 2), dtype=np.int32)

    def collect(self, search: Callable[[np.ndarray], int]) -> np.ndarray:
        """The pairs (k, 2) int32 that ``search`` writes as keys, sorted; they are overwritten by the next call."""
        count = search(self._keys)
        if count > len(self._keys):
            self._make_room(count + count // 2)
            count = search(self._keys)
        first, second = self._sizes
        _sort(self._keys, self._scratch, self._counts, count, first * second)
        _unpack(self._keys, count, second, self._pairs)
        return self._pairs[:count]
