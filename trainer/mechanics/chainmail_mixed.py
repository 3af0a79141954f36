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
taken last come, first served.
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

    first: Indices  # (BUCKETS,) first element of each bucket's list; -1 is none
    after: Indices  # (n,) the next in the list; -1 is none
    before: Indices  # (n,) the previous in the list; -1 - b is the head of bucket b
    key: Indices  # (n,) LARGEST - bits of the violation
    via: Bytes  # (n,) the direction from the sponsor; NOWHERE if the element does not wait
    bits: tuple[NDArray[np.float32], Indices]  # (1,) one number, seen as a float and as its bits

    @classmethod
    def room(cls, n: int) -> Waiting:
        one = np.zeros(1, np.float32)
        return cls(
            np.full(BUCKETS, -1, np.int32),
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
def _put(e, b, first, after, before):  # type: ignore[no-untyped-def]
    """Into bucket ``b``, in front."""
    head = first[b]
    after[e], before[e] = head, -1 - b
    if head >= 0:
        before[head] = e
    first[b] = e


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _take(e, first, after, before):  # type: ignore[no-untyped-def]
    """Out of its bucket."""
    nearer, further = before[e], after[e]
    if nearer < 0:
        first[-1 - nearer] = further
    else:
        after[nearer] = further
    if further >= 0:
        before[further] = nearer


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _violation(u, e, s, low, high):  # type: ignore[no-untyped-def]
    """How far one component of ``e`` is beyond what its neighbour ``s`` allows; negative is within."""
    apart = u[e] - u[s]
    return max(low - apart, apart - high)


@njit(cache=True, nogil=True, error_model="numpy")
def _ask(u0, u1, u2, links, labels, material_of, mark, moved, strides, low, high, s, last, first, after, before, key, via, one, bits):  # type: ignore[no-untyped-def]
    """Let the neighbours that the moved element ``s`` asks to move wait, or wait further ahead."""
    a = material_of[labels[s]]
    for d in range(6):
        if links[s] & (1 << d) == 0:
            continue
        e = s + strides[d]
        if mark[e] == moved or links[e] & FREE == 0:
            continue
        b = material_of[labels[e]]
        l, h = low[a, b, d], high[a, b, d]
        v = max(_violation(u0, e, s, l[0], h[0]), _violation(u1, e, s, l[1], h[1]))
        v = max(v, _violation(u2, e, s, l[2], h[2]))
        if v <= np.float32(0.0):
            continue
        one[0] = v
        asked = max(np.int64(LARGEST) - bits[0], last)
        if via[e] != NOWHERE:
            if key[e] <= asked:
                continue
            _take(e, first, after, before)
        key[e] = asked
        via[e] = d
        _put(e, _bucket(asked, last), first, after, before)


@njit(cache=True, nogil=True, error_model="numpy")
def by_violation(
    u0, u1, u2, links, labels, material_of, mark, moved, strides, low, high, queue, begin, tail,
    first, after, before, key, via, one, bits,
):  # type: ignore[no-untyped-def] # fmt: skip
    """Move what ``queue[begin:tail]`` asks to move; returns the queue's end."""
    last = np.int64(0)
    for head in range(begin, tail):
        _ask(u0, u1, u2, links, labels, material_of, mark, moved, strides, low, high, queue[head], last,
             first, after, before, key, via, one, bits)  # fmt: skip
    while True:
        b = 0
        while b < BUCKETS and first[b] < 0:
            b += 1
        if b == BUCKETS:
            return tail
        if b > 0:
            e = first[b]
            last = np.int64(LARGEST)
            while e >= 0:
                last = min(last, np.int64(key[e]))
                e = after[e]
            e = first[b]
            first[b] = -1
            while e >= 0:
                further = after[e]
                _put(e, _bucket(np.int64(key[e]), last), first, after, before)
                e = further
        e = first[0]
        _take(e, first, after, before)
        d = via[e]
        via[e] = NOWHERE
        s = e - strides[d]
        a, c = material_of[labels[s]], material_of[labels[e]]
        if consider(u0, u1, u2, links, mark, moved, e, s, low[a, c, d], high[a, c, d]):
            queue[tail] = e
            tail += 1
            _ask(u0, u1, u2, links, labels, material_of, mark, moved, strides, low, high, e, last,
                 first, after, before, key, via, one, bits)  # fmt: skip
