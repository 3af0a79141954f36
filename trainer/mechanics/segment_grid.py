"""Segments in the cells of a dense grid over their bounding box.

The grid has at most ``MOST_CELLS`` cells, so that it stays in the cache, and none smaller than a typical segment. A
table of sums (Crow 1984, "Summed-area tables for texture mapping", in three dimensions) answers in eight reads whether
any segment is listed in a range of cells. Places outside belong to the outermost cells, and all roundings on the way
to a cell are monotone, so two boxes that meet always share a cell.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.geometry import Array

#: Cells of the grid, all three directions together.
MOST_CELLS = 4096


@njit(cache=True, nogil=True, error_model="numpy")
def cell_of(place, origin, per_mm, cells):  # type: ignore[no-untyped-def]
    """The cell of a coordinate in one direction."""
    at = (place - origin) * per_mm
    if at < 1.0:
        return 0
    if at >= cells:
        return cells - 1
    return int(at)


@njit(cache=True, nogil=True, error_model="numpy")
def _bound(p0, p1, segments, grow, low, high):  # type: ignore[no-untyped-def]
    """The box of each segment on its way from ``p0`` to ``p1``, larger by ``grow``."""
    for s in range(segments.shape[0]):
        i, j = segments[s, 0], segments[s, 1]
        for d in range(3):
            least = min(min(p0[i, d], p0[j, d]), min(p1[i, d], p1[j, d]))
            most = max(max(p0[i, d], p0[j, d]), max(p1[i, d], p1[j, d]))
            low[s, d] = least - grow
            high[s, d] = most + grow


@njit(cache=True, nogil=True, error_model="numpy")
def _divide(low, high, box, per_mm, cells):  # type: ignore[no-untyped-def]
    """Set the grid: the box around all, and cells of one width, which is the mean extent of a segment or more."""
    m = low.shape[0]
    total = 0.0
    for d in range(3):
        box[0, d] = low[0, d]
        box[1, d] = high[0, d]
    for s in range(m):
        for d in range(3):
            box[0, d] = min(box[0, d], low[s, d])
            box[1, d] = max(box[1, d], high[s, d])
            total += high[s, d] - low[s, d]
    longest = max(max(box[1, 0] - box[0, 0], box[1, 1] - box[0, 1]), box[1, 2] - box[0, 2])
    width = max(total / (3.0 * m), longest / MOST_CELLS)
    while True:
        product = 1
        for d in range(3):
            extent = box[1, d] - box[0, d]
            cells[d] = 1
            per_mm[d] = 0.0
            if extent > width:
                cells[d] = int(extent / width)
                per_mm[d] = cells[d] / extent
            product *= cells[d]
        if product <= MOST_CELLS:
            return
        width *= 1.125


@njit(cache=True, nogil=True, error_model="numpy")
def _list(low, high, box, per_mm, cells, begin, listed, sums):  # type: ignore[no-untyped-def]
    """List each segment in the cells of its box; returns the number of entries, listed only if there is room."""
    nx, ny, nz = cells[0], cells[1], cells[2]
    begin[: nx * ny * nz + 1] = 0
    total = 0
    for s in range(low.shape[0]):
        i0, i1 = cell_of(low[s, 0], box[0, 0], per_mm[0], nx), cell_of(high[s, 0], box[0, 0], per_mm[0], nx)
        j0, j1 = cell_of(low[s, 1], box[0, 1], per_mm[1], ny), cell_of(high[s, 1], box[0, 1], per_mm[1], ny)
        k0, k1 = cell_of(low[s, 2], box[0, 2], per_mm[2], nz), cell_of(high[s, 2], box[0, 2], per_mm[2], nz)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    begin[(i * ny + j) * nz + k] += 1
                    total += 1
    if total > listed.shape[0]:
        return total
    # The sums of all cells before (i, j, k) in each direction, from the counts.
    sy, sx = nz + 1, (ny + 1) * (nz + 1)
    sums[: (nx + 1) * sx] = 0
    for i in range(nx):
        for j in range(ny):
            row = 0
            for k in range(nz):
                row += begin[(i * ny + j) * nz + k]
                at = (i + 1) * sx + (j + 1) * sy + k + 1
                sums[at] = row + sums[at - sx] + sums[at - sy] - sums[at - sx - sy]
    # From counts to the end of each cell's list, then, filling backwards, to its beginning.
    running = 0
    for c in range(nx * ny * nz):
        running += begin[c]
        begin[c] = running
    begin[nx * ny * nz] = running
    for back in range(low.shape[0]):
        s = low.shape[0] - 1 - back
        i0, i1 = cell_of(low[s, 0], box[0, 0], per_mm[0], nx), cell_of(high[s, 0], box[0, 0], per_mm[0], nx)
        j0, j1 = cell_of(low[s, 1], box[0, 1], per_mm[1], ny), cell_of(high[s, 1], box[0, 1], per_mm[1], ny)
        k0, k1 = cell_of(low[s, 2], box[0, 2], per_mm[2], nz), cell_of(high[s, 2], box[0, 2], per_mm[2], nz)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    c = (i * ny + j) * nz + k
                    begin[c] -= 1
                    listed[begin[c]] = s
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def any_in(sums, cells, i0, i1, j0, j1, k0, k1):  # type: ignore[no-untyped-def]
    """Whether a segment is listed in the cells i0 … i1, j0 … j1, k0 … k1, both ends included."""
    sy = cells[2] + 1
    sx = (cells[1] + 1) * sy
    a, b = i0 * sx, (i1 + 1) * sx
    c, d = j0 * sy, (j1 + 1) * sy
    e, f = k0, k1 + 1
    upper = sums[b + d + f] - sums[b + d + e] - sums[b + c + f] + sums[b + c + e]
    lower = sums[a + d + f] - sums[a + d + e] - sums[a + c + f] + sums[a + c + e]
    return upper != lower


class SegmentGrid:
    """The cells of ``segments`` (m, 2), m at least 1; arrays are kept from call to call."""

    def __init__(self, segments: np.ndarray) -> None:
        m = len(segments)
        self.segments = segments
        self.low = np.zeros((m, 3))  # (m, 3) mm, the segments' boxes
        self.high = np.zeros((m, 3))
        self.box = np.zeros((2, 3))  # lowest and highest corner of all
        self.per_mm = np.zeros(3)  # cells per mm in each direction
        self.cells = np.ones(3, dtype=np.int64)
        self.begin = np.zeros(MOST_CELLS + 1, dtype=np.int64)  # where a cell's list begins in ``listed``
        self.listed = np.zeros(8 * m, dtype=np.int32)  # segments, cell by cell, ascending in each
        # (nx + 1)(ny + 1)(nz + 1) is largest when all cells lie in one row.
        self.sums = np.zeros(4 * (MOST_CELLS + 1), dtype=np.int64)

    def fill(self, p0: Array, p1: Array, grow_mm: float) -> None:
        """List the segments on their way from ``p0`` to ``p1`` (n, 3) with boxes larger by ``grow_mm``."""
        _bound(p0, p1, self.segments, grow_mm, self.low, self.high)
        _divide(self.low, self.high, self.box, self.per_mm, self.cells)
        total = self._list()
        if total > len(self.listed):
            self.listed = np.zeros(total + total // 2, dtype=np.int32)
            self._list()

    def _list(self) -> int:
        return int(
            _list(
                self.low, self.high, self.box, self.per_mm, self.cells, self.begin, self.listed, self.sums
            )
        )  # fmt: skip
