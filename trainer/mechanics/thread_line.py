"""The thread as one row after another: nodes and constraints in the order of their arcs, as contact sees it.

Rows that a constraint holds stay where they are, and so do those in a channel through a wall. All others are free.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.thread_follow import SNAP

Ints = NDArray[np.int32]
#: Of the distance along the thread to a hole: as near may it come to the wall that the hole is in.
SLOPE = 0.5


class Line(NamedTuple):
    """Room for m rows; ``lay_rows`` says how many are used."""

    x: Array  # (m, 3) mm
    start: Array  # (m, 3) mm, when the movement began
    arc: Array  # (m,) mm
    length: Array  # (m,) mm to the next row; -1 where a piece of thread ends
    free: NDArray[np.bool_]  # (m,)
    away: Array  # (m,) mm along the thread to the nearest hole; inf without one
    skin: Array  # (m,) mm, the distance that it keeps from walls
    node: Ints  # (m,) of the thread; -1 for a constraint
    held: Ints  # (m,) constraint; -1 for a node
    base: Ints  # (m,) the node at or before it
    wall: Ints  # (m,) the vessel whose wall the row may lie in; -1 for none
    inside: Ints  # (m,) the vessel whose wall the way to the next row may lie in; -1 for none


def no_line(rows: int) -> Line:
    """Room for ``rows`` rows."""
    ints = [np.zeros(rows, dtype=np.int32) for _ in range(5)]
    places, numbers = np.zeros((2, rows, 3)), np.zeros((4, rows))
    return Line(
        places[0], places[1], numbers[0], numbers[1], np.zeros(rows, dtype=np.bool_), numbers[2], numbers[3], *ints
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _row(line, m, x, start, i, arc, base, held):  # type: ignore[no-untyped-def]
    for d in range(3):
        line.x[m, d] = x[i, d]
        line.start[m, d] = start[i, d]
    line.arc[m], line.base[m], line.held[m] = arc, base, held
    line.node[m] = -1 if held >= 0 else i
    line.free[m] = held < 0
    line.away[m] = math.inf
    line.wall[m] = line.inside[m] = -1


@njit(cache=True, nogil=True, error_model="numpy")
def lay_rows(  # type: ignore[no-untyped-def]
    line, nodes, before, origin, link, pieces, arcs, points, points_before, holes, channel, through, radius
):
    """Write the rows of all pieces; returns their number.

    ``nodes`` and ``before`` (n, 3) mm: now, and when the movement began; likewise the constraints' ``points`` (c, 3) at
    ``arcs`` (c,). ``holes`` (c,) bool. ``channel`` (c,): the vessel in whose wall the thread runs from a constraint to
    the next one, or -1. ``through`` (n,): the vessel that the thread already goes through between a node and the next.
    ``radius`` mm is the thread's.
    """
    m = 0
    for p in range(pieces.shape[0]):
        i0 = round((pieces[p, 0] - origin) / link)
        i1 = round((pieces[p, 1] - origin) / link)
        first = m
        k = 0
        while k < len(arcs) and (arcs[k] - origin) / link < i0 - SNAP:
            k += 1
        for i in range(i0, i1 + 1):
            at_node = False
            while k < len(arcs) and (arcs[k] - origin) / link <= i + SNAP:
                t = (arcs[k] - origin) / link
                at_node = t >= i - SNAP
                _row(line, m, points, points_before, k, arcs[k], min(int(t + SNAP), i1), k)
                if holes[k]:
                    line.away[m] = 0.0
                m += 1
                k += 1
            if not at_node:
                _row(line, m, nodes, before, i, origin + i * link, i, -1)
                m += 1
        previous = -1
        for r in range(first, m):
            line.length[r] = line.arc[r + 1] - line.arc[r] if r + 1 < m else -1.0
            if r > first:
                line.away[r] = min(line.away[r], line.away[r - 1] + line.length[r - 1])
            if line.held[r] >= 0:
                if previous >= 0:
                    within = channel[line.held[previous]]
                    for q in range(previous, r):
                        line.inside[q] = within
                        if q > previous:
                            line.wall[q] = within
                            line.free[q] = within < 0
                previous = r
        for r in range(m - 2, first - 1, -1):
            line.away[r] = min(line.away[r], line.away[r + 1] + line.length[r])
    for r in range(m):
        line.skin[r] = min(radius, SLOPE * line.away[r])
        vessel = through[line.base[r]]
        if vessel >= 0 and line.length[r] >= 0.0:
            line.inside[r] = line.wall[r] = line.wall[r + 1] = vessel
    return m
