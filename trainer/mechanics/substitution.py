"""Forward and backward substitution with a multifrontal factor.

Every solve reads the whole factor twice and computes two operations for each number of it: what it costs is the memory
it reads. So the factor lies in the order in which it is read, as one stream: front by front, node by node, and of each
node the rows below it with its three columns side by side. Forwards it is read upwards throughout and backwards
downwards throughout, the innermost loop too: streams as short as a front are not foreseen by the processor, and take
two and a half times as long (measured at 20 000 nodes).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.nested_dissection import Fronts


class MultifrontalFactor(NamedTuple):
    """L and D of K = L D Lᵀ, front by front; the unknown 3 p + c is component c of the node at position p."""

    fronts: Fronts
    panel: np.ndarray  # float32; for each pivot node of a front (its own row and those below, 3) of L
    inverse: Array  # (3 f,) 1 / D


@njit(cache=True, nogil=True, error_model="numpy")
def _forwards(factor: MultifrontalFactor, v: np.ndarray, w: np.ndarray) -> None:
    """Overwrites ``v`` (3 f,) float32 with D⁻¹ L⁻¹ v; ``w`` is scratch as long as the largest front."""
    fronts = factor.fronts
    at = 0
    for s in range(len(fronts.parent)):
        first, last = 3 * fronts.first[s], 3 * fronts.first[s + 1]
        rows = fronts.row[fronts.row_start[s] : fronts.row_start[s + 1]]
        pivots = last - first
        size = pivots + 3 * len(rows)
        w[:pivots] = v[first:last]
        w[pivots:size] = np.float32(0.0)
        for k in range(0, pivots, 3):
            own, below = factor.panel[at : at + 9], factor.panel[at + 9 : at + 3 * (size - k)]
            a = w[k]
            b = w[k + 1] - own[3] * a
            c = w[k + 2] - own[6] * a - own[7] * b
            w[k + 1], w[k + 2] = b, c
            target = w[k + 3 : size]
            for j in range(size - k - 3):
                target[j] -= below[3 * j] * a + below[3 * j + 1] * b + below[3 * j + 2] * c
            at += 3 * (size - k)
        v[first:last] = w[:pivots]
        for k in range(len(rows)):
            for i in range(3):
                v[3 * rows[k] + i] += w[pivots + 3 * k + i]
    for j in range(len(v)):
        v[j] *= factor.inverse[j]


# The sums may be reordered by the compiler, as in banded.substitute_backwards: they do not vectorise otherwise.
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc"})
def _backwards(factor: MultifrontalFactor, v: np.ndarray, w: np.ndarray) -> None:
    """Overwrites ``v`` (3 f,) float32 with L⁻ᵀ v; ``w`` as in :func:`_forwards`."""
    fronts = factor.fronts
    at = len(factor.panel)
    for s in range(len(fronts.parent) - 1, -1, -1):
        first, last = 3 * fronts.first[s], 3 * fronts.first[s + 1]
        rows = fronts.row[fronts.row_start[s] : fronts.row_start[s + 1]]
        pivots = last - first
        size = pivots + 3 * len(rows)
        w[:pivots] = v[first:last]
        for k in range(len(rows)):
            for i in range(3):
                w[pivots + 3 * k + i] = v[3 * rows[k] + i]
        for k in range(pivots - 3, -1, -3):
            at -= 3 * (size - k)
            own, below = factor.panel[at : at + 9], factor.panel[at + 9 : at + 3 * (size - k)]
            known = w[k + 3 : size]
            a = b = c = np.float32(0.0)
            for j in range(size - k - 4, -1, -1):
                a += below[3 * j] * known[j]
                b += below[3 * j + 1] * known[j]
                c += below[3 * j + 2] * known[j]
            w[k + 2] -= c
            w[k + 1] -= b + own[7] * w[k + 2]
            w[k] -= a + own[3] * w[k + 1] + own[6] * w[k + 2]
        v[first:last] = w[:pivots]


@njit(cache=True, nogil=True, error_model="numpy")
def solve(factor: MultifrontalFactor, values: Array, v: np.ndarray, w: np.ndarray, out: Array) -> None:
    """K⁻¹ of the forces ``values`` (n, 3) mN on the factor's nodes into the same rows of ``out`` (n, 3) mm.

    Overwrites ``v`` (3 f,) float32 and ``w`` (largest front,) float32.
    """
    order = factor.fronts.order
    for p in range(len(order)):
        for c in range(3):
            v[3 * p + c] = values[order[p], c]
    _forwards(factor, v, w)
    _backwards(factor, v, w)
    for p in range(len(order)):
        for c in range(3):
            out[order[p], c] = v[3 * p + c]
