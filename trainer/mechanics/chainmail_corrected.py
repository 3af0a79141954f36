"""ChainMail in several materials, first come, first served and corrected: the least move that satisfies all limits.

Beside :mod:`trainer.mechanics.chainmail_mixed`. The limits are difference constraints, low ≤ u_b − u_a ≤ high, for each
component by itself; pulled one way, the least displacements that satisfy all of them are the lengths of longest ways
from what is held, as the algorithm of Bellman, Ford and Moore finds them: an element that has moved asks its
neighbours, and one that has moved already is asked again when another way asks more of it, and then asks its own
neighbours anew.
So the result does not depend on the order, and components do not share one. In one material everything is right at
once and each element moves once, as in the paper; only where stiff tissue overtakes soft an element moves again.

Each component moves one way, that of the pull: the elements held must not be pulled opposite ways along an axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from trainer.mechanics.volume import FREE, Bytes, Indices

#: What is left over, in the largest displacement: below it an element is not asked again. Rounding of float32 sums
#: along different ways would otherwise be passed around.
ROUNDING = 1e-6
#: In ``waits``: the element is in the ring, or it is held and moves no further.
NEXT, HELD = 1, 2


@dataclass(frozen=True)
class Ring:
    """Who waits, once each. What was never used takes no memory."""

    ring: Indices  # (n,)
    waits: Bytes  # (n,) NEXT, HELD or 0

    @classmethod
    def room(cls, n: int) -> Ring:
        return cls(np.empty(n, np.int32), np.zeros(n, np.uint8))


# Indices are unsigned: a signed one is asked at each use whether it counts from the end, a third of the time.
@njit(cache=True, nogil=True, error_model="numpy")
def by_correction(  # type: ignore[no-untyped-def]
    u0, u1, u2, links, labels, material_of, materials, mark, moved, strides, bound, way, slack, queue, begin, tail,
    ring, waits,
):  # fmt: skip
    """Move what ``queue[begin:tail]`` asks to move, and what that asks; returns the end of the queue of all moved.

    ``way`` (3,) float32 is 1, -1 or 0 for each component, and ``bound`` (r, 3) the limit that it can meet on that way.
    """
    index, one = np.uint64, np.uint64(1)
    n, tail = index(len(ring)), index(tail)
    first, waiting = index(0), index(0)
    for head in range(index(begin), tail):
        ring[waiting] = queue[head]
        waiting += one
    wx, wy, wz = way[0], way[1], way[2]
    while waiting > index(0):
        s = index(ring[first])
        first = first + one if first + one < n else index(0)
        waiting -= one
        if waits[s] != HELD:
            waits[s] = 0
        rows = index(material_of[labels[s]]) * index(materials)
        sx, sy, sz = u0[s], u1[s], u2[s]
        bits = links[s]
        for d in range(index(6)):
            if bits & (one << d) == 0:
                continue
            e = index(np.int64(s) + strides[d])
            if links[e] & FREE == 0 or waits[e] == HELD:
                continue
            row = (rows + index(material_of[labels[e]])) * index(6) + d
            tx, ty, tz = sx + bound[row, index(0)], sy + bound[row, one], sz + bound[row, index(2)]
            go_x, go_y, go_z = (tx - u0[e]) * wx > slack, (ty - u1[e]) * wy > slack, (tz - u2[e]) * wz > slack
            if not (go_x | go_y | go_z):
                continue
            if go_x:
                u0[e] = tx
            if go_y:
                u1[e] = ty
            if go_z:
                u2[e] = tz
            if mark[e] != moved:
                mark[e] = moved
                queue[tail] = e
                tail += one
            if waits[e] == 0:
                waits[e] = NEXT
                last = first + waiting
                ring[last if last < n else last - n] = e
                waiting += one
    return np.int64(tail)
