"""Sliding of the thread through soft constraints: the kernels behind ``thread.slide``.

Source of the rule: Brown et al. 2001, section 4 ("the suture will slide through a soft constraint to
decrease the stretch"). Its least form: with D_k the straight distance from constraint k to k+1 and
y_k = s_k - (D_0 + ... + D_{k-1}), every span has enough thread exactly when y does not decrease. So the
arcs that need the least total sliding, sum |ds_k|, are the isotonic regression of y in the sum of
absolute differences, found by pooling adjacent violators to their median (Robertson, Waltman 1968, "On
estimating monotone parameters", Ann. Math. Stat. 39). A hard constraint is a bound on y, and with a bound
the regression is simply clipped. Where medians are not unique (an even number of pooled holes) the middle
of the lowest and the highest one is taken, so that the rule does not know which end of the thread is which.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array


@njit(cache=True, nogil=True, error_model="numpy")
def pool(y: Array, begin: int, end: int, upper: int, values: Array, first: Array, out: Array, weight: float) -> None:
    """Add ``weight`` times the isotonic median regression of y[begin:end] to out[begin:end].

    ``upper`` 0 takes the lower median of an even number, 1 the upper. ``values`` and ``first`` are working
    space: the values of each pooled block in order, and where each block begins.
    """
    blocks = 0
    for k in range(begin, end):
        values[k] = y[k]
        first[blocks] = k
        blocks += 1
        while blocks > 1:
            left, right = int(first[blocks - 2]), int(first[blocks - 1])
            if values[(left + right - 1 + upper) // 2] <= values[(right + k + upper) // 2]:
                break
            for i in range(right, k + 1):
                v = values[i]
                j = i
                while j > left and values[j - 1] > v:
                    values[j] = values[j - 1]
                    j -= 1
                values[j] = v
            blocks -= 1
    for b in range(blocks):
        left = int(first[b])
        right = int(first[b + 1]) if b + 1 < blocks else end
        middle = values[(left + right - 1 + upper) // 2]
        for k in range(left, right):
            out[k] += weight * middle


@njit(cache=True, nogil=True, error_model="numpy")
def slide_piece(
    arcs: Array,
    points: Array,
    hard: NDArray[np.bool_],
    begin: int,
    end: int,
    tolerance: float,
    detour: Array,
    shortage: Array,
    work: Array,
) -> None:
    """Slide the soft ones of constraints ``begin`` .. ``end - 1``, which lie on one piece, in place."""
    travelled, y, out, values, first = work[0], work[1], work[2], work[3], work[4]
    for k in range(begin, end):
        travelled[k] = 0.0
        if k > begin:
            dx, dy, dz = (
                points[k, 0] - points[k - 1, 0],
                points[k, 1] - points[k - 1, 1],
                points[k, 2] - points[k - 1, 2],
            )
            travelled[k] = travelled[k - 1] + math.sqrt(dx * dx + dy * dy + dz * dz) + detour[k - 1]
        y[k] = arcs[k] - travelled[k]
    k = begin
    while k < end:
        if hard[k]:
            k += 1
            continue
        stop = k
        while stop < end and not hard[stop]:
            stop += 1
        low = y[k - 1] if k > begin else -math.inf
        high = y[stop] if stop < end else math.inf
        if low <= high:
            for i in range(k, stop):
                out[i] = 0.0
            pool(y, k, stop, 0, values, first, out, 0.5)
            pool(y, k, stop, 1, values, first, out, 0.5)
            for i in range(k, stop):
                new = min(max(out[i], low), high)
                if new != y[i]:
                    arcs[i] = travelled[i] + new
        else:
            stretch = (arcs[stop] - arcs[k - 1]) / (travelled[stop] - travelled[k - 1])
            for i in range(k, stop):
                arcs[i] = arcs[k - 1] + stretch * (travelled[i] - travelled[k - 1])
        k = stop
    previous = -1
    for k in range(begin, end):
        if hard[k]:
            if previous >= 0 and y[previous] - y[k] > tolerance:
                shortage[previous] = y[previous] - y[k]
            previous = k


@njit(cache=True, nogil=True, error_model="numpy")
def slide_kernel(
    arcs: Array,
    points: Array,
    hard: NDArray[np.bool_],
    pieces: Array,
    tolerance: float,
    detour: Array,
    old: Array,
    shortage: Array,
    pulled_out: NDArray[np.bool_],
    work: Array,
) -> None:
    """``thread.slide`` on plain arrays; ``arcs`` is changed in place, ``old`` holds its first values.

    A hole that the thread's end has passed lets go, the outermost first, and the rest is slid anew.
    """
    shortage[:] = 0.0
    pulled_out[:] = False
    for p in range(pieces.shape[0]):
        s0, s1 = pieces[p, 0], pieces[p, 1]
        begin = 0
        while begin < len(arcs) and old[begin] < s0 - tolerance:
            begin += 1
        end = begin
        while end < len(arcs) and old[end] <= s1 + tolerance:
            end += 1
        while begin < end:
            for k in range(begin, end):
                arcs[k] = old[k]
                shortage[k] = 0.0
            slide_piece(arcs, points, hard, begin, end, tolerance, detour, shortage, work)
            before = s0 - arcs[begin]
            beyond = arcs[end - 1] - s1
            if max(before, beyond) <= tolerance:
                for k in range(begin, end):
                    arcs[k] = min(max(arcs[k], s0), s1)
                break
            if beyond >= before:
                end -= 1
                arcs[end] = s1
                pulled_out[end] = True
            else:
                arcs[begin] = s0
                pulled_out[begin] = True
                begin += 1
