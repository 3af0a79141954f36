"""Sparse Cholesky factor of a stiffness matrix by fronts (multifrontal method, Duff and Reid 1983, ACM TOMS 9:302).

Each front of a nested dissection gathers its links and what its children left, eliminates its pivots from one dense
matrix, and leaves the rest (the update matrix) to its parent, on a stack. A surface of f nodes costs about f^1.5
multiplications to factor and f log f to solve, where a band costs f² and f^1.5.

As in ``banded``: computed in double precision, kept and solved with in single, because a solve is bound by the memory
that it reads. A solve is right to about 1e-6 of its answer: a base for iterations that measure their own residual.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.nested_dissection import Fronts
from trainer.mechanics.substitution import MultifrontalFactor, solve

#: A pivot below this share of the diagonal is lost in rounding: the matrix is singular, or not positive definite.
SINGULAR = 1e-9
#: Pivots that are subtracted from four rows in one pass; pivots of a panel, after which the rest of the front follows;
#: columns of the tile of a panel that stays in the cache meanwhile.
GROUP, PANEL, TILE = 8, 64, 256


class Work(NamedTuple):
    """What a factorisation overwrites."""

    front: Array  # (largest front²,)
    stack: Array  # (most numbers that lie on it at once,)
    waiting: np.ndarray  # (fronts,) int64, the fronts whose update matrices lie on the stack
    local: np.ndarray  # (f,) int64, the place of a node in the front at hand
    packed: Array  # (PANEL TILE,) a tile of a panel
    multiples: Array  # (4 GROUP,)


@njit(cache=True, nogil=True, error_model="numpy")
def eliminate(
    a: Array, size: int, pivots: int, inverse: Array, diagonal: Array, least: float, packed: Array, m: Array
) -> int:
    """Eliminates the first ``pivots`` of the unknowns of a front from ``a``, by rows (size, size), upper half.

    Its rows become D Lᵀ and the rest what remains. A pivot below the share ``least`` of ``diagonal`` is replaced by
    it; returns how often that was done. ``packed`` (PANEL TILE,) and ``m`` (4 GROUP,) are scratch.
    """
    replaced = 0
    for low in range(0, pivots, PANEL):
        high = min(low + PANEL, pivots)
        for first in range(low, high, GROUP):
            last = min(first + GROUP, high)
            for k in range(first, last):
                pivot = a[k * size + k]
                if not pivot > least * diagonal[k]:
                    pivot = diagonal[k]
                    replaced += 1
                inverse[k] = 1.0 / pivot
                for i in range(k + 1, last):
                    _subtract_one(a, size, k, i, i, size, inverse)
            _subtract_rows(a, size, first, last, last, high, inverse, packed, m)
        _subtract_rows(a, size, low, high, high, size, inverse, packed, m)
    return replaced


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_one(a: Array, size: int, k: int, i: int, left: int, right: int, inverse: Array) -> None:
    """What pivot k leaves of row i in the columns ``left`` … ``right`` - 1."""
    m = a[k * size + i] * inverse[k]
    source, target = a[k * size + left : k * size + right], a[i * size + left : i * size + right]
    for j in range(right - left):
        target[j] -= m * source[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_rows(
    a: Array, size: int, low: int, high: int, top: int, bottom: int, inverse: Array, packed: Array, m: Array
) -> None:
    """What the pivots ``low`` … ``high`` - 1 leave of the rows ``top`` … ``bottom`` - 1, tile by tile.

    Four rows at a time from their first one's diagonal on: what that spoils lies in the lower half, which nobody reads.
    ``packed`` (PANEL TILE,) and ``m`` (4 GROUP,) are scratch.
    """
    for left in range(top, size, TILE):
        width = min(TILE, size - left)
        for k in range(low, high):
            packed[(k - low) * TILE : (k - low) * TILE + width] = a[k * size + left : k * size + left + width]
        end = min(bottom, left + width)
        for first in range(low, high, GROUP):
            for k in range(high, first + GROUP):  # the last group is filled up with nothing
                packed[(k - low) * TILE : (k - low + 1) * TILE] = 0.0
        whole = end - (end - top) % 4
        for i in range(top, whole, 4):
            start = max(i - left, 0)
            b, n = i * size + left + start, width - start
            t0, t1 = a[b : b + n], a[b + size : b + size + n]
            t2, t3 = a[b + 2 * size : b + 2 * size + n], a[b + 3 * size : b + 3 * size + n]
            for first in range(low, high, GROUP):
                for k in range(GROUP):
                    d = inverse[first + k] if first + k < high else 0.0
                    at = min(first + k, high - 1) * size + i
                    m[k], m[GROUP + k] = a[at] * d, a[at + 1] * d
                    m[2 * GROUP + k], m[3 * GROUP + k] = a[at + 2] * d, a[at + 3] * d
                _subtract_four(t0, t1, t2, t3, packed[(first - low) * TILE + start :], m)
        for i in range(whole, end):
            for k in range(low, high):
                _subtract_one(a, size, k, i, max(left, i), left + width, inverse)


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_four(t0: Array, t1: Array, t2: Array, t3: Array, s: Array, m: Array) -> None:
    """Multiples ``m`` (4 GROUP,) of the rows ``s``, TILE apart, off four rows; for a GROUP of eight."""
    a0, a1, a2, a3, a4, a5, a6, a7 = m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7]
    b0, b1, b2, b3, b4, b5, b6, b7 = m[8], m[9], m[10], m[11], m[12], m[13], m[14], m[15]
    c0, c1, c2, c3, c4, c5, c6, c7 = m[16], m[17], m[18], m[19], m[20], m[21], m[22], m[23]
    d0, d1, d2, d3, d4, d5, d6, d7 = m[24], m[25], m[26], m[27], m[28], m[29], m[30], m[31]
    for k in range(len(t0)):
        s0, s1, s2, s3 = s[k], s[TILE + k], s[2 * TILE + k], s[3 * TILE + k]
        s4, s5, s6, s7 = s[4 * TILE + k], s[5 * TILE + k], s[6 * TILE + k], s[7 * TILE + k]
        t0[k] -= (a0 * s0 + a1 * s1 + a2 * s2 + a3 * s3) + (a4 * s4 + a5 * s5 + a6 * s6 + a7 * s7)
        t1[k] -= (b0 * s0 + b1 * s1 + b2 * s2 + b3 * s3) + (b4 * s4 + b5 * s5 + b6 * s6 + b7 * s7)
        t2[k] -= (c0 * s0 + c1 * s1 + c2 * s2 + c3 * s3) + (c4 * s4 + c5 * s5 + c6 * s6 + c7 * s7)
        t3[k] -= (d0 * s0 + d1 * s1 + d2 * s2 + d3 * s3) + (d4 * s4 + d5 * s5 + d6 * s6 + d7 * s7)


@njit(cache=True, nogil=True, error_model="numpy")
def _factor(
    blocks: Array,
    links: np.ndarray,
    fronts: Fronts,
    panel: np.ndarray,
    inverse: Array,
    diagonal: Array,
    least: float,
    work: Work,
) -> int:
    """All fronts in turn. Returns how many pivots were too small."""
    stack, waiting, local = work.stack, work.waiting, work.local
    replaced = top = depth = out = 0
    for s in range(len(fronts.parent)):
        first, last = fronts.first[s], fronts.first[s + 1]
        rows = fronts.row[fronts.row_start[s] : fronts.row_start[s + 1]]
        pivots, size = 3 * (last - first), 3 * (last - first + len(rows))
        a = work.front[: size * size]
        a[:] = 0.0
        for p in range(first, last):
            local[p] = 3 * (p - first)
        for k in range(len(rows)):
            local[rows[k]] = pivots + 3 * k
        for at in range(fronts.link_start[s], fronts.link_start[s + 1]):
            e = fronts.link[at]
            p, q = fronts.place[links[e, 0]], fronts.place[links[e, 1]]
            lp, lq = (local[p] if p >= 0 else -1), (local[q] if q >= 0 else -1)
            low, high = min(lp, lq), max(lp, lq)
            for r in range(3):
                for c in range(3):
                    if c >= r:
                        if lp >= 0:
                            a[(lp + r) * size + lp + c] += blocks[e, r, c]
                        if lq >= 0:
                            a[(lq + r) * size + lq + c] += blocks[e, r, c]
                    if low >= 0:
                        a[(low + r) * size + high + c] -= blocks[e, r, c]
        # The diagonal of the links alone, summed over all fronts: what a pivot is compared with.
        while depth and fronts.parent[waiting[depth - 1]] == s:
            depth -= 1
            child = waiting[depth]
            inherited = fronts.row[fronts.row_start[child] : fronts.row_start[child + 1]]
            width = 3 * len(inherited)
            top -= width * width
            for i in range(len(inherited)):
                for r in range(3):
                    source = top + (3 * i + r) * width
                    target = (local[inherited[i]] + r) * size
                    for c in range(r, 3):
                        a[target + local[inherited[i]] + c] += stack[source + 3 * i + c]
                    for j in range(i + 1, len(inherited)):
                        to, of = target + local[inherited[j]], source + 3 * j
                        a[to] += stack[of]
                        a[to + 1] += stack[of + 1]
                        a[to + 2] += stack[of + 2]
        replaced += eliminate(
            a, size, pivots, inverse[3 * first : 3 * last], diagonal[3 * first : 3 * last], least, work.packed,
            work.multiples,
        )  # fmt: skip
        for k in range(0, pivots, 3):
            for i in range(3):
                d = inverse[3 * first + k + i]
                for j in range(k + i + 1, size):
                    panel[out + 3 * (j - k) + i] = a[(k + i) * size + j] * d
            out += 3 * (size - k)
        width = size - pivots
        for i in range(width):
            stack[top + i * width + i : top + (i + 1) * width] = a[
                (pivots + i) * size + pivots + i : (pivots + i + 1) * size
            ]
        top += width * width
        waiting[depth] = s
        depth += 1
    return replaced


@njit(cache=True, nogil=True, error_model="numpy")
def _stack_size(fronts: Fronts) -> int:
    """The most numbers that lie on the stack at once."""
    top = most = depth = 0
    waiting = np.zeros(len(fronts.parent), dtype=np.int64)
    for s in range(len(fronts.parent)):
        while depth and fronts.parent[waiting[depth - 1]] == s:
            depth -= 1
            width = 3 * (fronts.row_start[waiting[depth] + 1] - fronts.row_start[waiting[depth]])
            top -= width * width
        width = 3 * (fronts.row_start[s + 1] - fronts.row_start[s])
        top += width * width
        most = max(most, top)
        waiting[depth] = s
        depth += 1
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_diagonal(blocks: Array, links: np.ndarray, place: np.ndarray, out: Array) -> None:
    """The diagonal (3 f,) of the whole matrix."""
    out[:] = 0.0
    for e in range(len(links)):
        for k in range(2):
            p = place[links[e, k]]
            if p >= 0:
                for c in range(3):
                    out[3 * p + c] += blocks[e, c, c]


class Multifrontal:
    """A factor that is computed again and again for one topology: its memory is kept."""

    def __init__(self, links: np.ndarray, fronts: Fronts) -> None:
        """Of a stiffness that the ``links`` (m, 2) add up to on the nodes of ``fronts``."""
        pivots = np.diff(fronts.first)
        sizes = 3 * (pivots + np.diff(fronts.row_start))
        numbers = int(np.sum(3 * pivots * sizes - 9 * pivots * (pivots - 1) // 2))
        longest = int(np.max(sizes, initial=0))
        # Σ (size - k)² over the pivots k of each front.
        rest = sizes - 3 * pivots
        self.operations = float(np.sum((sizes.astype(float) ** 3 - rest.astype(float) ** 3) / 3.0))
        f = 3 * len(fronts.order)
        self._links = links
        self.factor = MultifrontalFactor(fronts, np.zeros(numbers, dtype=np.float32), np.zeros(f))
        self._diagonal = np.zeros(f)
        self._work = Work(
            np.zeros(longest * longest), np.zeros(_stack_size(fronts)), np.zeros(len(fronts.parent), dtype=np.int64),
            np.zeros(len(fronts.order), dtype=np.int64), np.zeros(PANEL * TILE), np.zeros(4 * GROUP),
        )  # fmt: skip
        self.scratch = (np.zeros(f, dtype=np.float32), np.zeros(longest, dtype=np.float32))  # v, w of solve

    def compute(self, blocks: Array) -> bool:
        """The factor of the link blocks (m, 3, 3); False when their sum is not positive definite."""
        f = self.factor
        _sum_diagonal(blocks, self._links, f.fronts.place, self._diagonal)
        replaced = _factor(
            blocks, self._links, f.fronts, f.panel, f.inverse, self._diagonal, SINGULAR, self._work,
        )  # fmt: skip
        return replaced == 0

    def solve(self, values: Array, out: Array) -> None:
        """K⁻¹ ``values`` (n, 3) into the rows of ``out`` (n, 3) that are unknowns."""
        solve(self.factor, values, *self.scratch, out)
