"""Which links of a thread may meet which triangles, blades and other links of it in one movement.

Boxes over the whole movement, so that nothing that moves fast is missed: runs of links against blocks of triangles
that lie together (:mod:`trainer.mechanics.cells` makes them) first, then one by one. A thread of a stitch has a dozen
runs; for so few a grid costs more than it saves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.cells import BLOCK, blocks
from trainer.mechanics.thread_line import Ints

#: Boxes are larger by this, mm: as far as contact may move a link, and as far off as one is still told to lie over.
MARGIN_MM = 0.05
#: Links in a run.
RUN = 8
#: Cosine of the angle between the normals of two facets up to which their edge, at rest, is sharp.
SHARP = math.cos(math.radians(20.0))
#: Links nearer than this along the thread, in links, do not touch one another.
APART = 3


class Walls(NamedTuple):
    """The closed surface of the tissue's walls; normals point out of the wall. Does not change."""

    triangles: Ints  # (f, 3)
    sharp: Ints  # (f, 3) of the edge from corner k to k + 1: 0 for blunt, else sharp, and 2 for one triangle of the two
    outwards: Ints  # (f, 3) the triangle beyond that edge
    vessel: Ints  # (f,)
    hull: Ints  # (f,) 1 for the outer, 2 for the inner, 0 for what joins them
    deep: Array  # (vessels,) mm, half a wall's thickness
    order: Ints  # (f,) triangles in blocks that lie together
    node_begin: NDArray[np.int64]  # (blocks + 1,)
    nodes: Ints  # nodes of the blocks


class Blades(NamedTuple):
    """Tapered capsules at the movement's start and end."""

    start: Array  # (2 k, 3) mm, the ends of k axes
    end: Array  # (2 k, 3) mm
    radius: Array  # (2 k,) mm, at the axes' ends
    tool: Ints  # (k,)
    grip: Array  # (tools,) mm, arc at which the tool holds the thread; nan for none
    leaps: NDArray[np.bool_]  # (tools,) whether the tool moved further than it sweeps


class Pairs(NamedTuple):
    """Candidates, and how many there are, which may be more than there is room for: walls, blades, itself."""

    wall: Ints  # (p, 2) row and triangle
    blade: Ints  # (p, 2) row and capsule
    itself: Ints  # (p, 2) row and row
    used: NDArray[np.int64]  # (4,) of the three, and of the touches
    low: Array  # (m, 3) mm, boxes of the links
    high: Array
    run_low: Array  # (m / RUN + 1, 3)
    run_high: Array
    near: Ints  # (m,) scratch
    four: Array  # (4, 4, 3) scratch
    times: Array  # (7,) scratch


def surface(triangles: Ints, vessel: Ints, hull: Ints, wall_mm: Array, x: Array) -> Walls:
    """The closed surface ``triangles`` (f, 3) of walls ``wall_mm`` (vessels,) thick; ``vessel`` (f,); ``x`` (n, 3) mm.

    ``hull`` (f,): 1 for the outer one, 2 for the inner one, 0 for what joins them.

    Raises ValueError where an edge has not two triangles that turn the same way round.
    """
    edges = {(int(t[k]), int(t[(k + 1) % 3])): f for f, t in enumerate(triangles) for k in range(3)}
    try:
        beside = [[edges[int(t[(k + 1) % 3]), int(t[k])] for k in range(3)] for t in triangles]
    except KeyError as edge:
        raise ValueError(f"the walls' surface is not closed at the edge {edge}") from None
    neighbour = np.array(beside, dtype=np.int32).reshape(-1, 3)
    corners = x[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Outwards of an edge is what lies under both planes: the middles of its triangles are below one another's.
    way = corners.mean(axis=1)[neighbour] - corners.mean(axis=1)[:, None]
    convex = np.einsum("fkd,fd->fk", way, normal) < 0.0
    sharp = (convex & (np.einsum("fkd,fd->fk", normal[neighbour], normal) <= SHARP)).astype(np.int32)
    sharp[neighbour > np.arange(len(triangles))[:, None]] *= 2
    return Walls(
        triangles.astype(np.int32),
        sharp,
        neighbour,
        vessel.astype(np.int32),
        hull.astype(np.int32),
        0.5 * wall_mm,
        *blocks(triangles, x),
    )


def no_pairs(rows: int, pairs: int) -> Pairs:
    """Room for ``pairs`` candidates of each sort among ``rows`` rows."""
    wall, blade, itself = (np.zeros((pairs, 2), dtype=np.int32) for _ in range(3))
    (low, high), (run_low, run_high) = np.zeros((2, rows, 3)), np.zeros((2, rows // RUN + 1, 3))
    used, near = np.zeros(4, dtype=np.int64), np.zeros(rows, dtype=np.int32)
    return Pairs(wall, blade, itself, used, low, high, run_low, run_high, near, np.zeros((4, 4, 3)), np.zeros(7))


@njit(cache=True, nogil=True, error_model="numpy")
def _boxes(line, m, pairs):  # type: ignore[no-untyped-def]
    """Boxes of the links on their way, and of runs of them; links that cannot move have none."""
    low, high, run_low, run_high = pairs.low, pairs.high, pairs.run_low, pairs.run_high
    for g in range((m + RUN - 1) // RUN):
        run_low[g, :] = math.inf
        run_high[g, :] = -math.inf
        for r in range(g * RUN, min(m, (g + 1) * RUN)):
            if line.length[r] < 0.0 or not (line.free[r] or line.free[r + 1]):
                low[r, :] = math.inf
                high[r, :] = -math.inf
                continue
            for d in range(3):
                a, b, c, e = line.x[r, d], line.x[r + 1, d], line.start[r, d], line.start[r + 1, d]
                low[r, d] = min(min(a, b), min(c, e)) - MARGIN_MM
                high[r, d] = max(max(a, b), max(c, e)) + MARGIN_MM
                run_low[g, d] = min(run_low[g, d], low[r, d])
                run_high[g, d] = max(run_high[g, d], high[r, d])


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(low, high, a, lx, ly, lz, ux, uy, uz):  # type: ignore[no-untyped-def]
    return not (
        lx > high[a, 0] or ux < low[a, 0] or ly > high[a, 1] or uy < low[a, 1] or lz > high[a, 2] or uz < low[a, 2]
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _add(found, used, which, a, b):  # type: ignore[no-untyped-def]
    if used[which] < found.shape[0]:
        found[used[which], 0], found[used[which], 1] = a, b
    used[which] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _search_walls(m, pairs, walls, x0, x1):  # type: ignore[no-untyped-def]
    runs = (m + RUN - 1) // RUN
    low, high = pairs.low, pairs.high
    for b in range(walls.node_begin.shape[0] - 1):
        v = walls.nodes[walls.node_begin[b]]
        lx, ly, lz = x1[v, 0], x1[v, 1], x1[v, 2]
        ux, uy, uz = lx, ly, lz
        for e in range(walls.node_begin[b], walls.node_begin[b + 1]):
            v = walls.nodes[e]
            lx, ux = min(lx, min(x0[v, 0], x1[v, 0])), max(ux, max(x0[v, 0], x1[v, 0]))
            ly, uy = min(ly, min(x0[v, 1], x1[v, 1])), max(uy, max(x0[v, 1], x1[v, 1]))
            lz, uz = min(lz, min(x0[v, 2], x1[v, 2])), max(uz, max(x0[v, 2], x1[v, 2]))
        near = 0
        for g in range(runs):
            if _meet(pairs.run_low, pairs.run_high, g, lx, ly, lz, ux, uy, uz):
                pairs.near[near] = g
                near += 1
        if near == 0:
            continue
        for at in range(b * BLOCK, min((b + 1) * BLOCK, walls.triangles.shape[0])):
            f = walls.order[at]
            i, j, k = walls.triangles[f, 0], walls.triangles[f, 1], walls.triangles[f, 2]
            lx = min(min(min(x0[i, 0], x0[j, 0]), x0[k, 0]), min(min(x1[i, 0], x1[j, 0]), x1[k, 0]))
            ly = min(min(min(x0[i, 1], x0[j, 1]), x0[k, 1]), min(min(x1[i, 1], x1[j, 1]), x1[k, 1]))
            lz = min(min(min(x0[i, 2], x0[j, 2]), x0[k, 2]), min(min(x1[i, 2], x1[j, 2]), x1[k, 2]))
            ux = max(max(max(x0[i, 0], x0[j, 0]), x0[k, 0]), max(max(x1[i, 0], x1[j, 0]), x1[k, 0]))
            uy = max(max(max(x0[i, 1], x0[j, 1]), x0[k, 1]), max(max(x1[i, 1], x1[j, 1]), x1[k, 1]))
            uz = max(max(max(x0[i, 2], x0[j, 2]), x0[k, 2]), max(max(x1[i, 2], x1[j, 2]), x1[k, 2]))
            for e in range(near):
                g = pairs.near[e]
                if not _meet(pairs.run_low, pairs.run_high, g, lx, ly, lz, ux, uy, uz):
                    continue
                for r in range(g * RUN, min(m, (g + 1) * RUN)):
                    if _meet(low, high, r, lx, ly, lz, ux, uy, uz):
                        _add(pairs.wall, pairs.used, 0, r, f)


@njit(cache=True, nogil=True, error_model="numpy")
def _search_blades(line, m, pairs, blades, free_mm):  # type: ignore[no-untyped-def]
    for k in range(blades.tool.shape[0]):
        tool = blades.tool[k]
        if blades.leaps[tool]:
            continue
        widest = max(blades.radius[2 * k], blades.radius[2 * k + 1])
        a, b, c, e = blades.start[2 * k], blades.start[2 * k + 1], blades.end[2 * k], blades.end[2 * k + 1]
        lx = min(min(a[0], b[0]), min(c[0], e[0])) - widest
        ly = min(min(a[1], b[1]), min(c[1], e[1])) - widest
        lz = min(min(a[2], b[2]), min(c[2], e[2])) - widest
        ux = max(max(a[0], b[0]), max(c[0], e[0])) + widest
        uy = max(max(a[1], b[1]), max(c[1], e[1])) + widest
        uz = max(max(a[2], b[2]), max(c[2], e[2])) + widest
        for g in range((m + RUN - 1) // RUN):
            if not _meet(pairs.run_low, pairs.run_high, g, lx, ly, lz, ux, uy, uz):
                continue
            for r in range(g * RUN, min(m, (g + 1) * RUN)):
                held = abs(line.arc[r] - blades.grip[tool]) < free_mm
                if not held and _meet(pairs.low, pairs.high, r, lx, ly, lz, ux, uy, uz):
                    _add(pairs.blade, pairs.used, 1, r, k)


@njit(cache=True, nogil=True, error_model="numpy")
def _search_itself(m, pairs):  # type: ignore[no-untyped-def]
    low, high = pairs.low, pairs.high
    runs = (m + RUN - 1) // RUN
    for g in range(runs):
        for h in range(g, runs):
            if not _meet(
                pairs.run_low, pairs.run_high, h, pairs.run_low[g, 0], pairs.run_low[g, 1], pairs.run_low[g, 2],
                pairs.run_high[g, 0], pairs.run_high[g, 1], pairs.run_high[g, 2],
            ):  # fmt: skip
                continue
            for r in range(g * RUN, min(m, (g + 1) * RUN)):
                for q in range(max(h * RUN, r + APART), min(m, (h + 1) * RUN)):
                    if _meet(low, high, q, low[r, 0], low[r, 1], low[r, 2], high[r, 0], high[r, 1], high[r, 2]):
                        _add(pairs.itself, pairs.used, 2, r, q)


@njit(cache=True, nogil=True, error_model="numpy")
def search(line, m, walls, x0, x1, blades, free_mm, pairs):  # type: ignore[no-untyped-def]
    """Find the candidates of ``m`` rows: the walls' nodes go from ``x0`` to ``x1`` (n, 3) mm.

    A blade does not touch the thread nearer than ``free_mm`` along it to where its own jaws hold it.
    """
    pairs.used[:] = 0
    _boxes(line, m, pairs)
    _search_walls(m, pairs, walls, x0, x1)
    _search_blades(line, m, pairs, blades, free_mm)
    _search_itself(m, pairs)
