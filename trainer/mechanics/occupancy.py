"""The occupancy map: elements of which bodies are in the same cell of a grid (Gibson 1995; Gibson et al. 1998, 3.3).

Space is a regular grid of cells. Each element is entered in the cell that it is in; if somebody else is there already,
they touch. Rigid and deformable bodies, and a body with itself, are treated alike: of the same
body only elements further apart in its own grid than APART are taken to touch, since neighbours may share a cell when
tissue is compressed.

The map is kept from tick to tick, and only what went from one cell to another is entered anew. Surface elements are
enough where bodies cannot pass through each other's surface between two ticks; a cell should be about as large as an
element. Who is in a cell is a list through the elements, so that an element is in one cell, or outside the map in none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.volume import LINKS, PRESENT, Indices, Triple, VolumeState

#: Elements of one body touch if an index differs by more than this: closer ones are held apart by their links' limits.
APART = 2
#: Cells that a map may have: 4 bytes each.
MOST_CELLS = 2**28


def surface_elements(state: VolumeState) -> Indices:
    """The elements (k,) that are there and lack a link: outer surfaces and what cuts have laid open."""
    lacks = ((state.links & PRESENT) != 0) & ((state.links & LINKS) != LINKS)
    return np.flatnonzero(lacks).astype(np.int32)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(points, first, low, per_mm, cells, head, cell, after, before):  # type: ignore[no-untyped-def]
    """Take each of ``points`` (k, 3), numbered from ``first``, to the cell that it is in now; returns how many went."""
    nx, ny, nz = cells[0], cells[1], cells[2]
    went = 0
    for p in range(np.uint64(len(points))):
        x = (points[p, 0] - low[0]) * per_mm
        y = (points[p, 1] - low[1]) * per_mm
        z = (points[p, 2] - low[2]) * per_mm
        # Also false for NaN: such a point is nowhere.
        inside = 0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz
        to = (int(x) * ny + int(y)) * nz + int(z) if inside else -1
        s = np.uint64(first + p)
        old = cell[s]
        if to == old:
            continue
        went += 1
        if old >= 0:
            if before[s] < 0:
                head[old] = after[s]
            else:
                after[before[s]] = after[s]
            if after[s] >= 0:
                before[after[s]] = before[s]
        cell[s], after[s] = to, -1
        if to >= 0:
            first_there = head[to]
            after[s], before[s] = first_there, -1
            if first_there >= 0:
                before[first_there] = s
            head[to] = s
    return went


@njit(cache=True, nogil=True, error_model="numpy")
def _touching(body, index, after, pairs):  # type: ignore[no-untyped-def]
    """Pairs of entries in the same cell, as far as there is room; returns how many. Each meets those after it in its
    cell's list, so that the cells themselves are not looked at: they are many, and not in the cache."""
    count = 0
    for s in range(len(after)):
        t = after[s]
        while t >= 0:
            apart = body[s] != body[t]
            if not apart:
                for d in range(3):
                    apart |= abs(index[s, d] - index[t, d]) > APART
            if apart:
                if count < len(pairs):
                    pairs[count, 0], pairs[count, 1] = min(s, t), max(s, t)
                count += 1
            t = after[t]
    return count


class OccupancyMap:
    """A grid over ``low`` to ``high`` mm with cells of ``cell_mm``, and ``bodies``: the grid indices (k, 3) of each.

    Entries are numbered through all bodies, in their order. Nothing is entered before the first :meth:`update`. Raises
    ValueError for a box or a cell that is no size, or more than MOST_CELLS cells.
    """

    def __init__(self, low: Triple, high: Triple, cell_mm: float, bodies: Sequence[np.ndarray]) -> None:
        sides = [b - a for a, b in zip(low, high, strict=True)]
        if not (0.0 < cell_mm < math.inf and all(0.0 < side < math.inf for side in sides)):
            raise ValueError(f"an occupancy map from {low} to {high} mm with cells of {cell_mm} mm has no size")
        cells = [math.ceil(side / cell_mm) for side in sides]
        if math.prod(cells) > MOST_CELLS:
            raise ValueError(
                f"an occupancy map of {cells[0]} x {cells[1]} x {cells[2]} cells is too large; take larger cells"
            )
        self.cell_mm = cell_mm
        self._low, self._cells = np.array(low, dtype=np.float64), np.array(cells, dtype=np.int64)
        self.begin = np.concatenate([[0], np.cumsum([len(b) for b in bodies])]).astype(np.int64)
        self.body = np.repeat(np.arange(len(bodies)), np.diff(self.begin)).astype(np.int32)  # (s,) of each entry
        self._index = np.concatenate([np.asarray(b, dtype=np.int32).reshape(-1, 3) for b in bodies])
        n = len(self.body)
        self._head = np.full(math.prod(cells), -1, dtype=np.int32)
        self._cell, self._after, self._before = (np.full(n, -1, dtype=np.int32) for _ in range(3))
        self._pairs = np.zeros((256, 2), dtype=np.int32)

    def update(self, body: int, points: Array) -> int:
        """Tell where the elements of ``body`` are now, (k, 3) mm; returns how many went to another cell.

        Raises ValueError for another number of points than the body has.
        """
        first, end = int(self.begin[body]), int(self.begin[body + 1])
        if points.shape != (end - first, 3):
            raise ValueError(f"body {body} has {end - first} elements in the map; found {points.shape} points")
        return int(
            _enter(
                points,
                first,
                self._low,
                1.0 / self.cell_mm,
                self._cells,
                self._head,
                self._cell,
                self._after,
                self._before,
            )
        )

    def touching(self) -> np.ndarray:
        """Pairs (k, 2) int32 of entries in the same cell, smaller first; sorted. The next call overwrites them."""
        while True:
            count = _touching(self.body, self._index, self._after, self._pairs)
            if count <= len(self._pairs):
                break
            self._pairs = np.zeros((2 * count, 2), dtype=np.int32)
        pairs = self._pairs[:count]
        return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]

    def cell_of(self, entry: int) -> int:
        """The cell that an entry is in; -1 is outside the map."""
        return int(self._cell[entry])
