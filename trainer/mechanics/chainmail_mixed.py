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

Violations never grow on their way, so what waits is kept in a radix heap (Ahuja, Mehlhorn, Orlin and Tarjan 1990):
bucket b holds the violations whose bits differ from the last one's in bit b − 1 first. A bucket is a chain of blocks,
in which entries lie side by side. Of equal violations the last to come is taken first. An element may wait several
times, once for each neighbour that asked more of it than those before; it is moved when the first of these is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.mechanics.volume import FREE, Bytes, Indices

#: Buckets: none of the 31 bits differs, or one of them is the first to.
BUCKETS = 32
#: Entries of a block.
BLOCK = 64
#: The bits of the largest float32; what is left of them sorts the largest violation first.
LARGEST = 0x7F7FFFFF


@dataclass(frozen=True)
class Waiting:
    """What waits: entries in blocks. What was never used takes no memory."""

    element: Indices  # (p,) who waits
    key: Indices  # (p,) LARGEST - bits of the violation
    via: Bytes  # (p,) the direction from the sponsor
    least: Indices  # (n,) the least key that an element waits with
    asked: Bytes  # (n,) the mark of the move in which it was asked last
    following: Indices  # (p // BLOCK,) the next block of a bucket, or of those that are free; -1 is none
    buckets: Indices  # (BUCKETS, 2) the first block, -1 is none, and how many entries it has; the others are full
    bits: tuple[NDArray[np.float32], Indices]  # (1,) one number, seen as a float and as its bits

    @classmethod
    def room(cls, n: int) -> Waiting:
        """Each of an element's six neighbours can ask once; and each bucket has a block that is not full."""
        blocks = 6 * n // BLOCK + BUCKETS + 1
        one = np.zeros(1, np.float32)
        return cls(
            np.empty(blocks * BLOCK, np.int32),
            np.empty(blocks * BLOCK, np.int32),
            np.empty(blocks * BLOCK, np.uint8),
            np.empty(n, np.int32),
            np.zeros(n, np.uint8),
            np.empty(blocks, np.int32),
            np.full((BUCKETS, 2), -1, np.int32),
            (one, one.view(np.int32)),
        )


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _beyond(apart, low, high):  # type: ignore[no-untyped-def]
    """How far a difference is beyond its limits; negative is within."""
    return max(low - apart, apart - high)


# Entries are put and taken in place here: arrays handed to a function are counted on the way in and out, which in this
# loop took longer than all the rest. Indices are unsigned: a signed one is asked at each use whether it counts from the
# end.
@njit(cache=True, nogil=True, error_model="numpy")
def by_violation(  # type: ignore[no-untyped-def]
    u0, u1, u2, links, labels, material_of, materials, mark, moved, strides, low, high, queue, begin, tail,
    element, key, via, least, asked, following, buckets, one, bits,
):  # fmt: skip
    """Move what ``queue[begin:tail]`` asks to move, and what that asks; returns the queue's end."""
    index = np.uint64
    x, y, z = index(0), index(1), index(2)
    last = np.int64(0)
    free, fresh = np.int64(-1), np.int64(0)  # the first of the blocks that were given back; the first never used
    head, tail = index(begin), index(tail)
    while True:
        while head < tail:  # the neighbours that a moved element asks to move wait
            s = index(queue[head])
            head += y
            rows = index(material_of[labels[s]]) * index(materials)
            for d in range(index(6)):
                e = index(np.int64(s) + strides[d])
                if links[s] & (y << d) == 0 or mark[e] == moved or links[e] & FREE == 0:
                    continue
                row = (rows + index(material_of[labels[e]])) * index(6) + d
                v = max(
                    _beyond(u0[e] - u0[s], low[row, x], high[row, x]), _beyond(u1[e] - u1[s], low[row, y], high[row, y])
                )
                v = max(v, _beyond(u2[e] - u2[s], low[row, z], high[row, z]))
                if v <= np.float32(0.0):
                    continue
                one[0] = v
                k = max(np.int64(LARGEST) - bits[0], last)
                if asked[e] == moved and least[e] <= k:
                    continue
                asked[e], least[e] = moved, k
                b = index(_bucket(k, last))
                block = np.int64(buckets[b, x])
                if block < 0 or buckets[b, y] == BLOCK:
                    new = free if free >= 0 else fresh
                    if free >= 0:
                        free = np.int64(following[index(free)])
                    else:
                        fresh += 1
                    following[index(new)] = block
                    buckets[b, x], buckets[b, y] = new, 0
                    block = new
                at = index(block * BLOCK + buckets[b, y])
                element[at], key[at], via[at] = e, k, d
                buckets[b, y] += 1
        largest = 0
        while largest < BUCKETS and buckets[largest, 0] < 0:
            largest += 1
        if largest == BUCKETS:
            return np.int64(tail)
        block, count = np.int64(buckets[largest, 0]), np.int64(buckets[largest, 1])
        if largest > 0:  # the largest violation that waits: its bucket is sorted anew by how the others differ from it
            last = np.int64(LARGEST)
            old, size = block, count
            while old >= 0:
                for from_ in range(index(old * BLOCK), index(old * BLOCK + size)):
                    last = min(last, np.int64(key[from_]))
                old, size = np.int64(following[index(old)]), np.int64(BLOCK)
            buckets[largest, 0] = -1
            old, size = block, count
            while old >= 0:
                for from_ in range(index(old * BLOCK), index(old * BLOCK + size)):
                    if mark[index(element[from_])] == moved:
                        continue
                    b = index(_bucket(np.int64(key[from_]), last))
                    block = np.int64(buckets[b, x])
                    if block < 0 or buckets[b, y] == BLOCK:
                        new = free if free >= 0 else fresh
                        if free >= 0:
                            free = np.int64(following[index(free)])
                        else:
                            fresh += 1
                        following[index(new)] = block
                        buckets[b, x], buckets[b, y] = new, 0
                        block = new
                    to = index(block * BLOCK + buckets[b, y])
                    element[to], key[to], via[to] = element[from_], key[from_], via[from_]
                    buckets[b, y] += 1
                done, old, size = old, np.int64(following[index(old)]), np.int64(BLOCK)
                following[index(done)] = free
                free = done
            continue
        top = index(block * BLOCK + count - 1)
        buckets[0, 1] = count - 1
        if count == 1:
            buckets[0, 0], buckets[0, 1] = following[index(block)], BLOCK
            following[index(block)] = free
            free = block
        e, side = index(element[top]), index(via[top])
        if mark[e] == moved:
            continue
        s = index(np.int64(e) - strides[side])
        row = (index(material_of[labels[s]]) * index(materials) + index(material_of[labels[e]])) * index(6) + side
        u0[e] = min(max(u0[e], u0[s] + low[row, x]), u0[s] + high[row, x])
        u1[e] = min(max(u1[e], u1[s] + low[row, y]), u1[s] + high[row, y])
        u2[e] = min(max(u2[e], u2[s] + low[row, z]), u2[s] + high[row, z])
        mark[e] = moved
        queue[tail] = e
        tail += y
