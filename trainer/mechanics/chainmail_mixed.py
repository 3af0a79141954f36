"""ChainMail in a volume of several materials: the largest violation first.

Schill, Gibson, Bender and Männer 1998, "Biomechanical simulation of the vitreous humor in the eye using an enhanced
ChainMail algorithm". Where stiff tissue borders on soft, the order of the plain lists is wrong: an element would follow
a soft sponsor a little, although the stiff way around asks it to go further, and is not considered again. So of all
elements that have a moved neighbour the one that must move furthest is moved next, by the neighbour that asks most of
it. Each element still moves once.

For a move along one axis from a volume within its limits this is Dijkstra's algorithm on the difference constraints
low ≤ u_b − u_a ≤ high, an element's distance being what is left of the pull when it comes there: the result is the
least move that satisfies all of them. For a move along several axes at once one order has to serve three systems of
constraints, the largest component deciding; what that leaves over is stated in the tests.

Violations never grow on their way, so the waiting elements are kept in a radix heap (Ahuja, Mehlhorn, Orlin and Tarjan
1990): bucket b holds the violations whose bits differ from the last one's in bit b − 1 first. Equal violations are
taken first come, first served.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.mechanics.chainmail import consider
from trainer.mechanics.volume import FREE, Bytes, Indices

#: Buckets: none of the 31 bits differs, or one of them is the first to.
BUCKETS = 32
#: The bits of the largest float32; what is left of them sorts the largest violation first.
LARGEST = 0x7F7FFFFF
#: In ``via``: the element does not wait.
NOWHERE = 255


@dataclass(frozen=True)
class Waiting:
    """The elements that wait, in lists through arrays by element. What was never used takes no memory."""

    ends: Indices  # (BUCKETS, 2) first and last element of each bucket's list; a first below 0 is none
    after: Indices  # (n,) the next in the list; -1 - b after the last of bucket b
    before: Indices  # (n,) the previous in the list; -1 - b before the first of bucket b
    key: Indices  # (n,) LARGEST - bits of the violation
    via: Bytes  # (n,) the direction from the sponsor; NOWHERE if the element does not wait
    bits: tuple[NDArray[np.float32], Indices]  # (1,) one number, seen as a float and as its bits

    @classmethod
    def room(cls, n: int) -> Waiting:
        one = np.zeros(1, np.float32)
        return cls(
            np.full((BUCKETS, 2), -1, np.int32),
            np.empty(n, np.int32),
            np.empty(n, np.int32),
            np.empty(n, np.int32),
            np.full(n, NOWHERE, np.uint8),
            (one, one.view(np.int32)),
        )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _bucket(key, last):  # type: ignore[no-untyped-def]
    """How many bits are left from the first in which two keys differ."""
    x = key ^ last
    b = 0
    if x >= 1 << 16:
        b += 16
        x >>= 16
    if x >= 1 << 8:
        b += 8
        x >>= 8
    if x >= 1 << 4:
        b += 4
        x >>= 4
    if x >= 1 << 2:
        b += 2
        x >>= 2
    return b + x if x < 2 else b + 2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _put(e, b, ends, after, before):  # type: ignore[no-untyped-def]
    """Into bucket ``b``, as its last."""
    end = ends[b, 1]
    after[e] = -1 - b
    if ends[b, 0] < 0:
        ends[b, 0] = e
        before[e] = -1 - b
    else:
        after[end] = e
        before[e] = end
    ends[b, 1] = e


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _take(e, ends, after, before):  # type: ignore[no-untyped-def]
    """Out of its bucket."""
    nearer, further = before[e], after[e]
    if nearer < 0:
        ends[-1 - nearer, 0] = further
    else:
        after[nearer] = further
    if further < 0:
        ends[-1 - further, 1] = nearer
    else:
        before[further] = nearer


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _violation(u, e, s, low, high, row, c):  # type: ignore[no-untyped-def]
    """How far one component of ``e`` is beyond what its neighbour ``s`` allows; negative is within."""
    apart = u[e] - u[s]
    return max(low[row, c] - apart, apart - high[row, c])


@njit(cache=True, nogil=True, error_model="numpy")
def by_violation(  # type: ignore[no-untyped-def]
    u0, u1, u2, links, labels, material_of, materials, mark, moved, strides, low, high, queue, begin, tail,
    ends, after, before, key, via, one, bits,
):  # fmt: skip
    """Move what ``queue[begin:tail]`` asks to move, and what that asks; returns the queue's end."""
    last = np.int64(0)
    head = begin
    while True:
        while head < tail:  # the neighbours that a moved element asks to move wait, or wait further ahead
            s = queue[head]
            head += 1
            a = np.int64(material_of[labels[s]])
            for d in range(6):
                if links[s] & (1 << d) == 0:
                    continue
                e = s + strides[d]
                if mark[e] == moved or links[e] & FREE == 0:
                    continue
                row = (a * materials + material_of[labels[e]]) * 6 + d
                v = max(_violation(u0, e, s, low, high, row, 0), _violation(u1, e, s, low, high, row, 1))
                v = max(v, _violation(u2, e, s, low, high, row, 2))
                if v <= np.float32(0.0):
                    continue
                one[0] = v
                asked = max(np.int64(LARGEST) - bits[0], last)
                if via[e] != NOWHERE:
                    if key[e] <= asked:
                        continue
                    _take(e, ends, after, before)
                key[e] = asked
                via[e] = d
                _put(e, _bucket(asked, last), ends, after, before)
        b = 0
        while b < BUCKETS and ends[b, 0] < 0:
            b += 1
        if b == BUCKETS:
            return tail
        if b > 0:
            e = ends[b, 0]
            last = np.int64(LARGEST)
            while e >= 0:
                last = min(last, np.int64(key[e]))
                e = after[e]
            e = ends[b, 0]
            ends[b, 0] = -1
            while e >= 0:
                further = after[e]
                _put(e, _bucket(np.int64(key[e]), last), ends, after, before)
                e = further
        e = ends[0, 0]
        _take(e, ends, after, before)
        d = via[e]
        via[e] = NOWHERE
        s = e - strides[d]
        row = (np.int64(material_of[labels[s]]) * materials + material_of[labels[e]]) * 6 + d
        if consider(u0, u1, u2, mark, moved, e, s, low, high, row):
            queue[tail] = e
            tail += 1
