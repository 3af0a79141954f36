"""Nested dissection of a link mesh: an order of elimination whose factor stays sparse.

George 1973, SIAM J. Numer. Anal. 10:345. The nodes are parted by a plane, and those on one side that have a link to the
other are eliminated last: no fill then joins the two parts. Each part is treated alike until it is small. Of the three
planes across the principal axes of the mesh that one is taken which leaves the smallest separator. Every separator, and
every part at the end, is a *front*: its nodes (pivots) are eliminated together from a dense matrix of themselves and of
the later nodes that they touch (rows).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.links import LinkMesh

#: A part of so many nodes is not parted again.
LEAF = 16
#: Neither side of a cut may have less than this share of the nodes.
LEAST_SHARE = 0.2


class Fronts(NamedTuple):
    """The f unknown nodes in order of elimination, in fronts that come after all their children."""

    order: np.ndarray  # (f,) int32, the node at each position of the order
    first: np.ndarray  # (fronts + 1,) int64, front s eliminates the positions first[s] … first[s + 1] - 1
    parent: np.ndarray  # (fronts,) int64, the front that takes up what remains; -1 for a last one
    row_start: np.ndarray  # (fronts + 1,) int64, front s has the rows row_start[s] … row_start[s + 1] - 1
    row: np.ndarray  # (rows,) int32, their positions, ascending within a front
    link_start: np.ndarray  # (fronts + 1,) int64, front s gathers these of the next
    link: np.ndarray  # (links,) int32, each link with a node of its own in ``order``
    place: np.ndarray  # (n,) int32, a node's position in ``order``, or -1


def dissect(mesh: LinkMesh, leaf: int = LEAF) -> Fronts:
    """The fronts of all nodes of ``mesh`` that are not fixed; ``leaf``: nodes in a part that is not parted again."""
    free = np.flatnonzero(~mesh.fixed).astype(np.int32)
    centred = mesh.rest - mesh.rest.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    order, first, last, parent = _part(free, centred @ axes, mesh.start, mesh.neighbour, leaf)
    by_place = np.argsort(first, kind="stable")
    rank = np.full(len(first) + 1, -1, dtype=np.int64)  # its last entry is the rank of "none"
    rank[by_place] = np.arange(len(first))
    parent = rank[parent[by_place]]
    starts = np.concatenate([first[by_place], last[by_place][-1:]])
    place = np.full(len(mesh.rest), -1, dtype=np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    row_start, row = _rows(order, starts, parent, place, mesh.start, mesh.neighbour)
    i, j = place[mesh.links[:, 0]], place[mesh.links[:, 1]]
    earliest = np.where(np.minimum(i, j) >= 0, np.minimum(i, j), np.maximum(i, j))
    front = np.searchsorted(starts, earliest, side="right") - 1
    link = np.argsort(front, kind="stable").astype(np.int32)
    link_start = np.searchsorted(front[link], np.arange(len(starts)))
    return Fronts(order, starts, parent, row_start, row, link_start.astype(np.int64), link, place)


@njit(cache=True, nogil=True, error_model="numpy")
def _part(
    free: np.ndarray, coordinates: Array, start: np.ndarray, neighbour: np.ndarray, leaf: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(order, first, last, parent) of the fronts of ``free`` (f,), in no order; ``coordinates`` (n, 3)."""
    n, f = len(coordinates), len(free)
    order = free.copy()
    scratch = np.empty_like(order)
    part = np.full(n, -1, dtype=np.int32)  # the part to which a node belongs, -1 once it is in a front
    side = np.zeros(n, dtype=np.int8)
    for i in free:
        part[i] = 0
    value = np.zeros(f)
    first, last, parent = np.zeros(f, dtype=np.int64), np.zeros(f, dtype=np.int64), np.zeros(f, dtype=np.int64)
    fronts, parts = 0, 1
    todo = np.zeros((f + 2, 4), dtype=np.int64)  # from, to, part, parent front
    todo[0, 1], todo[0, 3] = f, -1
    waiting = 1 if f else 0
    while waiting:
        waiting -= 1
        lo, hi, own, above = todo[waiting]
        best_axis, best_cost, best_middle = -1, np.inf, 0.0
        if hi - lo > leaf:
            for axis in range(3):
                for k in range(lo, hi):
                    value[k - lo] = coordinates[order[k], axis]
                middle = np.partition(value[: hi - lo], (hi - lo) // 2)[(hi - lo) // 2]
                below, cut = 0, 0
                for k in range(lo, hi):
                    i = order[k]
                    if coordinates[i, axis] < middle:
                        below += 1
                    else:
                        for e in range(start[i], start[i + 1]):
                            j = neighbour[e]
                            if part[j] == own and coordinates[j, axis] < middle:
                                cut += 1
                                break
                fewest = min(below, hi - lo - below - cut)
                if fewest >= LEAST_SHARE * (hi - lo) and cut < best_cost:
                    best_axis, best_cost, best_middle = axis, cut, middle
        if best_axis < 0:
            first[fronts], last[fronts], parent[fronts] = lo, hi, above
            fronts += 1
            for k in range(lo, hi):
                part[order[k]] = -1
            continue
        below, above_count = 0, 0
        for k in range(lo, hi):
            i = order[k]
            side[i] = 0
            if coordinates[i, best_axis] < best_middle:
                below += 1
                continue
            side[i] = 1
            for e in range(start[i], start[i + 1]):
                j = neighbour[e]
                if part[j] == own and coordinates[j, best_axis] < best_middle:
                    side[i] = 2
                    break
            if side[i] == 1:
                above_count += 1
        at0, at1, at2 = lo, lo + below, lo + below + above_count
        cut_first = at2
        for k in range(lo, hi):
            scratch[k] = order[k]
        for k in range(lo, hi):
            i = scratch[k]
            if side[i] == 0:
                order[at0] = i
                at0 += 1
                part[i] = parts
            elif side[i] == 1:
                order[at1] = i
                at1 += 1
                part[i] = parts + 1
            else:
                order[at2] = i
                at2 += 1
                part[i] = -1
        if cut_first < hi:
            first[fronts], last[fronts], parent[fronts] = cut_first, hi, above
            above = fronts
            fronts += 1
        todo[waiting, 0], todo[waiting, 1], todo[waiting, 2], todo[waiting, 3] = lo, lo + below, parts, above
        waiting += 1
        todo[waiting, 0], todo[waiting, 1], todo[waiting, 2], todo[waiting, 3] = lo + below, cut_first, parts + 1, above
        waiting += 1
        parts += 2
    return order, first[:fronts].copy(), last[:fronts].copy(), parent[:fronts].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _rows(
    order: np.ndarray,
    first: np.ndarray,
    parent: np.ndarray,
    place: np.ndarray,
    start: np.ndarray,
    neighbour: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(row_start, row): the later nodes that each front touches by links, or its children left it."""
    fronts = len(parent)
    row_start = np.zeros(fronts + 1, dtype=np.int64)
    row = np.zeros(16, dtype=np.int32)
    seen = np.full(len(order), -1, dtype=np.int64)
    child = np.full(fronts, -1, dtype=np.int64)  # the last child of a front, and the one before each child
    before = np.full(fronts, -1, dtype=np.int64)
    for s in range(fronts):
        last = first[s + 1]
        count = row_start[s]
        for p in range(first[s], last):
            i = order[p]
            for e in range(start[i], start[i + 1]):
                q = place[neighbour[e]]
                if q >= last and seen[q] != s:
                    seen[q] = s
                    row = _room(row, count)
                    row[count] = q
                    count += 1
        c = child[s]
        while c >= 0:
            for k in range(row_start[c], row_start[c + 1]):
                q = row[k]
                if q >= last and seen[q] != s:
                    seen[q] = s
                    row = _room(row, count)
                    row[count] = q
                    count += 1
            c = before[c]
        row_start[s + 1] = count
        row[row_start[s] : count] = np.sort(row[row_start[s] : count])
        if parent[s] >= 0:
            before[s] = child[parent[s]]
            child[parent[s]] = s
    return row_start, row[: row_start[fronts]].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _room(values: np.ndarray, count: int) -> np.ndarray:
    """``values``, or a copy of twice the length where ``count`` fills them."""
    if count < len(values):
        return values
    grown = np.zeros(2 * len(values), dtype=values.dtype)
    grown[: len(values)] = values
    return grown
