"""Triangles of a deforming surface streamed past the cells of a thread's segments.

No tree is kept over what deforms. The few segments go into a small grid; then the surface is read once, in blocks of
triangles that lie together. A block whose box shares no cell with a segment is left without looking at its triangles;
the others are compared triangle by triangle: cells, then boxes, then the exact distance. So a frame costs one read of
the nodes, and work only where surface and thread are near.

Spatial hashing of the one side and streaming of the other: Teschner et al. 2003, "Optimized spatial hashing for
collision detection of deformable objects". Blocks in Morton's order: Morton 1966.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.closest_points import segment_near_triangle
from trainer.mechanics.pair_list import PairList, checked_elements, checked_margin, largest_magnitude, rounding_mm
from trainer.mechanics.segment_grid import SegmentGrid, any_in, cell_of

#: Triangles in a block: of 8, 16, 32, 64 and 128 the fastest or nearly so at 2 000, 20 000 and 200 000 triangles.
BLOCK = 32


@njit(cache=True, nogil=True, error_model="numpy")
def _search(  # type: ignore[no-untyped-def]
    p0, x0, x1, swept, margin, segments, low, high, box, per_mm, cells, begin, listed, sums,
    triangles, order, node_begin, nodes, stamp, close, keys,
):  # fmt: skip
    count = 0
    n = triangles.shape[0]
    nx, ny, nz = cells[0], cells[1], cells[2]
    gx, gy, gz = box[0, 0], box[0, 1], box[0, 2]
    hx, hy, hz = box[1, 0], box[1, 1], box[1, 2]
    stamp[:] = -1
    for b in range(node_begin.shape[0] - 1):
        v = nodes[node_begin[b]]
        lx, ly, lz = x0[v, 0], x0[v, 1], x0[v, 2]
        ux, uy, uz = lx, ly, lz
        for e in range(node_begin[b], node_begin[b + 1]):
            v = nodes[e]
            ax, ay, az = x0[v, 0], x0[v, 1], x0[v, 2]
            lx = ax if ax < lx else lx
            ly = ay if ay < ly else ly
            lz = az if az < lz else lz
            ux = ax if ax > ux else ux
            uy = ay if ay > uy else uy
            uz = az if az > uz else uz
        if swept:
            for e in range(node_begin[b], node_begin[b + 1]):
                v = nodes[e]
                ax, ay, az = x1[v, 0], x1[v, 1], x1[v, 2]
                lx = ax if ax < lx else lx
                ly = ay if ay < ly else ly
                lz = az if az < lz else lz
                ux = ax if ax > ux else ux
                uy = ay if ay > uy else uy
                uz = az if az > uz else uz
        if lx > hx or ly > hy or lz > hz or ux < gx or uy < gy or uz < gz:
            continue
        i0, i1 = cell_of(lx, gx, per_mm[0], nx), cell_of(ux, gx, per_mm[0], nx)
        j0, j1 = cell_of(ly, gy, per_mm[1], ny), cell_of(uy, gy, per_mm[1], ny)
        k0, k1 = cell_of(lz, gz, per_mm[2], nz), cell_of(uz, gz, per_mm[2], nz)
        if not any_in(sums, cells, i0, i1, j0, j1, k0, k1):
            continue
        # The segments whose boxes meet the block's, and the box around those.
        found = 0
        wx, wy, wz = np.inf, np.inf, np.inf
        tx, ty, tz = -np.inf, -np.inf, -np.inf
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for c in range(begin[(i * ny + j) * nz + k0], begin[(i * ny + j) * nz + k1 + 1]):
                    s = listed[c]
                    if (
                        stamp[s] == b or lx > high[s, 0] or ux < low[s, 0] or ly > high[s, 1] or uy < low[s, 1]
                        or lz > high[s, 2] or uz < low[s, 2]
                    ):  # fmt: skip
                        continue
                    stamp[s] = b
                    close[found] = s
                    found += 1
                    wx, wy, wz = min(wx, low[s, 0]), min(wy, low[s, 1]), min(wz, low[s, 2])
                    tx, ty, tz = max(tx, high[s, 0]), max(ty, high[s, 1]), max(tz, high[s, 2])
        if found == 0:
            continue
        for at in range(b * BLOCK, min((b + 1) * BLOCK, n)):
            f = order[at]
            v0, v1, v2 = triangles[f, 0], triangles[f, 1], triangles[f, 2]
            lx = min(min(x0[v0, 0], x0[v1, 0]), x0[v2, 0])
            ly = min(min(x0[v0, 1], x0[v1, 1]), x0[v2, 1])
            lz = min(min(x0[v0, 2], x0[v1, 2]), x0[v2, 2])
            ux = max(max(x0[v0, 0], x0[v1, 0]), x0[v2, 0])
            uy = max(max(x0[v0, 1], x0[v1, 1]), x0[v2, 1])
            uz = max(max(x0[v0, 2], x0[v1, 2]), x0[v2, 2])
            if swept:
                lx = min(lx, min(min(x1[v0, 0], x1[v1, 0]), x1[v2, 0]))
                ly = min(ly, min(min(x1[v0, 1], x1[v1, 1]), x1[v2, 1]))
                lz = min(lz, min(min(x1[v0, 2], x1[v1, 2]), x1[v2, 2]))
                ux = max(ux, max(max(x1[v0, 0], x1[v1, 0]), x1[v2, 0]))
                uy = max(uy, max(max(x1[v0, 1], x1[v1, 1]), x1[v2, 1]))
                uz = max(uz, max(max(x1[v0, 2], x1[v1, 2]), x1[v2, 2]))
            if lx > tx or ly > ty or lz > tz or ux < wx or uy < wy or uz < wz:
                continue
            for c in range(found):
                s = close[c]
                if (
                    lx > high[s, 0] or ux < low[s, 0] or ly > high[s, 1] or uy < low[s, 1]
                    or lz > high[s, 2] or uz < low[s, 2]
                ):  # fmt: skip
                    continue
                if swept or segment_near_triangle(p0, segments[s, 0], segments[s, 1], x0, v0, v1, v2, margin):
                    if count < keys.shape[0]:
                        keys[count] = np.int64(s) * n + f
                    count += 1
    return count


class Cells:
    """Search for pairs of ``segments`` (m, 2) of a thread and ``triangles`` (f, 3) of a surface, both deforming.

    The blocks are made for the places ``x`` (n, 3) mm of the surface's nodes; wherever the nodes go later, the pairs
    are the same, but a surface whose neighbours have parted is searched more slowly. Raises ValueError for wrong
    shapes, and each search does for places that are NaN, infinite or beyond 1e9 mm.
    """

    def __init__(self, segments: np.ndarray, triangles: np.ndarray, x: Array) -> None:
        self._segments = checked_elements(segments, 2, "segments")
        self._triangles = checked_elements(triangles, 3, "triangles")
        largest_magnitude(x, "surface")
        self._last_segment = int(self._segments.max(initial=-1))
        self._last_triangle = int(self._triangles.max(initial=-1))
        self._check_indices(None, x)
        self._order, self._node_begin, self._nodes = blocks(self._triangles, x)
        if len(self._segments):
            self._grid = SegmentGrid(self._segments)
        self._stamp = np.zeros(len(self._segments), dtype=np.int64)
        self._close = np.zeros(len(self._segments), dtype=np.int32)
        self._pairs = PairList((len(self._segments), len(self._triangles)))

    def near(self, thread: Array, surface: Array, margin_mm: float) -> np.ndarray:
        """The pairs (k, 2) int32 of segment and triangle that are at most ``margin_mm`` apart, sorted.

        ``thread`` (p, 3) and ``surface`` (n, 3) mm are the nodes now. The array is overwritten by the next search.
        """
        return self._collect(thread, thread, surface, surface, False, margin_mm)

    def on_the_way(
        self, thread0: Array, thread1: Array, surface0: Array, surface1: Array, margin_mm: float
    ) -> np.ndarray:
        """The pairs (k, 2) int32 whose boxes over the way from 0 to 1 are at most ``margin_mm`` apart in x, y and z.

        No pair that meets on the way is missing, however far the nodes move in a tick. Sorted; overwritten by the next
        search.
        """
        return self._collect(thread0, thread1, surface0, surface1, True, margin_mm)

    def _collect(self, p0: Array, p1: Array, x0: Array, x1: Array, swept: bool, margin_mm: float) -> np.ndarray:
        margin = checked_margin(margin_mm)
        scale = max(largest_magnitude(p0, "thread"), largest_magnitude(x0, "surface"))
        self._check_indices(p0, x0)
        if swept:
            scale = max(scale, largest_magnitude(p1, "thread"), largest_magnitude(x1, "surface"))
            self._check_indices(p1, x1)
        if not len(self._segments) or not len(self._triangles):
            return self._pairs.collect(lambda keys: 0)
        grid = self._grid
        # The ways' boxes are what is asked for; boxes around an exact distance must not lose a pair by rounding.
        grid.fill(p0, p1, margin if swept else margin + rounding_mm(scale + margin))
        return self._pairs.collect(
            lambda keys: int(
                _search(
                    p0, x0, x1, swept, margin, self._segments, grid.low, grid.high, grid.box, grid.per_mm, grid.cells,
                    grid.begin, grid.listed, grid.sums, self._triangles, self._order, self._node_begin, self._nodes,
                    self._stamp, self._close, keys,
                )
            )
        )  # fmt: skip

    def _check_indices(self, thread: Array | None, surface: Array) -> None:
        if thread is not None and self._last_segment >= len(thread):
            raise ValueError(f"thread: segments name node {self._last_segment}, found {len(thread)} nodes")
        if self._last_triangle >= len(surface):
            raise ValueError(f"surface: triangles name node {self._last_triangle}, found {len(surface)} nodes")


def blocks(triangles: np.ndarray, x: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles that lie together in blocks of ``BLOCK``.

    Returns the order (f,) of the triangles, where each block's nodes begin (blocks + 1,), and the nodes.
    """
    if not len(triangles):
        return np.zeros(0, dtype=np.int32), np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int32)
    order = np.argsort(_morton(x[triangles].mean(axis=1)), kind="stable").astype(np.int32)
    parts = [np.unique(triangles[order[at : at + BLOCK]]) for at in range(0, len(order), BLOCK)]
    begin = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
    return order, begin, np.concatenate(parts).astype(np.int32)


def _morton(points: Array) -> np.ndarray:
    """Morton's code (n,) of ``points`` (n, 3): the bits of three coordinates of 20 bits, interleaved."""
    low, high = points.min(axis=0), points.max(axis=0)
    widest = float((high - low).max())
    cell = ((points - low) * ((2**20 - 1) / widest if widest > 0.0 else 0.0)).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(20):
        for d in range(3):
            code |= (cell[:, d] >> bit & 1) << (3 * bit + d)
    return code
