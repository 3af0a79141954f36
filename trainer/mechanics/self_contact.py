"""A thread against itself: pairs of its segments that are near, but not neighbours along it.

The segments are listed in the cells of a small grid and compared within cells: spatial hashing (Teschner et al. 2003,
"Optimized spatial hashing for collision detection of deformable objects") without a hash, since the grid is dense.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.closest_points import segment_segment
from trainer.mechanics.pair_list import PairList, checked_elements, checked_margin, largest_magnitude, rounding_mm
from trainer.mechanics.segment_grid import SegmentGrid, cell_of


@njit(cache=True, nogil=True, error_model="numpy")
def _search(  # type: ignore[no-untyped-def]
    p, exact, margin, segments, along, neighbours, low, high, box, per_mm, cells, begin, listed, stamp, keys
):
    count = 0
    m = segments.shape[0]
    ny, nz = cells[1], cells[2]
    stamp[:] = -1
    for s in range(m):
        lx, ly, lz = low[s, 0], low[s, 1], low[s, 2]
        ux, uy, uz = high[s, 0], high[s, 1], high[s, 2]
        i0, i1 = cell_of(lx, box[0, 0], per_mm[0], cells[0]), cell_of(ux, box[0, 0], per_mm[0], cells[0])
        j0, j1 = cell_of(ly, box[0, 1], per_mm[1], ny), cell_of(uy, box[0, 1], per_mm[1], ny)
        k0, k1 = cell_of(lz, box[0, 2], per_mm[2], nz), cell_of(uz, box[0, 2], per_mm[2], nz)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for c in range(begin[(i * ny + j) * nz + k0], begin[(i * ny + j) * nz + k1 + 1]):
                    o = listed[c]
                    if (
                        o <= s or along[o] - along[s] <= neighbours or stamp[o] == s
                        or lx > high[o, 0] or ux < low[o, 0] or ly > high[o, 1] or uy < low[o, 1]
                        or lz > high[o, 2] or uz < low[o, 2]
                    ):  # fmt: skip
                        continue
                    stamp[o] = s
                    if exact:
                        d, _, _ = segment_segment(p, segments[s, 0], segments[s, 1], p, segments[o, 0], segments[o, 1])
                        if d > margin * margin:
                            continue
                    if count < keys.shape[0]:
                        keys[count] = np.int64(s) * m + o
                    count += 1
    return count


class SelfContact:
    """Search for near pairs of ``segments`` (m, 2), which follow one another along one or more threads.

    Segments up to ``neighbours`` places apart along a thread are no pair: 1 leaves out those that share a node. A
    segment that does not begin where the one before ended begins a new thread. Raises ValueError for wrong shapes, and
    each search does for places that are NaN, infinite or beyond 1e9 mm.
    """

    def __init__(self, segments: np.ndarray, neighbours: int = 1) -> None:
        self._segments = checked_elements(segments, 2, "segments")
        if neighbours < 0:
            raise ValueError(f"neighbours must be 0 or more, found {neighbours}")
        m = len(self._segments)
        self._last = int(self._segments.max(initial=-1))
        self._neighbours = neighbours
        # Places along the threads; where a new one begins there is a gap wider than any neighbourhood.
        begins = self._segments[1:, 0] != self._segments[:-1, 1]
        self._along = np.concatenate([[0], np.cumsum(1 + (neighbours + 1) * begins)])[:m].astype(np.int64)
        if m:
            self._grid = SegmentGrid(self._segments)
        self._stamp = np.zeros(m, dtype=np.int64)
        self._pairs = PairList((m, m))

    def near(self, x: Array, margin_mm: float) -> np.ndarray:
        """The pairs (k, 2) int32 of segments, the lower first, at most ``margin_mm`` apart; ``x`` (n, 3) mm.

        Sorted; the array is overwritten by the next search.
        """
        return self._collect(x, x, True, margin_mm)

    def on_the_way(self, x0: Array, x1: Array, margin_mm: float) -> np.ndarray:
        """The pairs (k, 2) int32 whose boxes over the way from ``x0`` to ``x1`` are at most ``margin_mm`` apart.

        Apart in each of x, y and z: no pair that meets on the way is missing. Sorted; overwritten by the next search.
        """
        return self._collect(x0, x1, False, margin_mm)

    def _collect(self, x0: Array, x1: Array, exact: bool, margin_mm: float) -> np.ndarray:
        margin = checked_margin(margin_mm)
        scale = largest_magnitude(x0, "thread")
        if not exact:
            scale = max(scale, largest_magnitude(x1, "thread"))
        if self._last >= min(len(x0), len(x1)):
            raise ValueError(f"thread: segments name node {self._last}, found {min(len(x0), len(x1))} nodes")
        if not len(self._segments):
            return self._pairs.collect(lambda keys: 0)
        # Both boxes of a pair grow, each by half.
        grid = self._grid
        grid.fill(x0, x1, 0.5 * margin + rounding_mm(scale + margin))
        return self._pairs.collect(
            lambda keys: int(
                _search(
                    x0, exact, margin, self._segments, self._along, self._neighbours, grid.low, grid.high, grid.box,
                    grid.per_mm, grid.cells, grid.begin, grid.listed, self._stamp, keys,
                )
            )
        )  # fmt: skip
