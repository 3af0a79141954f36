"""The thread: a chain of rigid links that runs through holes and grips, never longer or shorter than it is.

Source: Brown, Montgomery, Latombe, Stephanides 2001, "A Microsurgery Simulation System", section 4.

Needle and thread share one arc length s, mm, from the needle's tip: the rigid needle is s in [0, Ln], the
thread s in [Ln, Ln + Lt], its nodes at Ln + i d; node 0 is the swage. A *constraint* holds the thread's
arc s_c at a point: a hole in a vessel's wall (soft), a grip or the swage of a placed needle (hard). s_c may
lie inside a link, so the thread's polyline is nodes and constraint points sorted by s. ``slide`` first lets
the thread run through the holes, then ``follow`` places the nodes.

Between two constraints with fewer than three nodes the nodes alone cannot always take up the slack (two holes
on one link could not come nearer to one another). There the longest link of the span may fold: the polyline
has one more point, half-way along that link. Lengths hold along this polyline, everywhere.

A broken thread is several *pieces*, an array (p, 2) of arcs, each from a node to a node.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.thread_closure import perpendicular
from trainer.mechanics.thread_follow import FOLD_NODES, SNAP, follow_kernel
from trainer.mechanics.thread_slide import slide_kernel


@dataclass(frozen=True)
class ThreadModel:
    """What a thread is. ``needle_length`` mm (arc Ln of the swage), ``link`` mm, ``count`` nodes (at least 2).

    Raises ValueError for a length that is negative, zero or not finite, or fewer than two nodes.
    """

    needle_length: float
    link: float
    count: int

    def __post_init__(self) -> None:
        if not (math.isfinite(self.needle_length) and self.needle_length >= 0.0):
            raise ValueError(f"a needle cannot be {self.needle_length} mm long: give 0 or more")
        if not (math.isfinite(self.link) and self.link > 0.0):
            raise ValueError(f"a thread's links cannot be {self.link} mm long: give more than 0")
        if self.count < 2:
            raise ValueError(f"a thread of {self.count} nodes has no link: give 2 or more")

    @property
    def end(self) -> float:
        """Arc of the tail, mm."""
        return self.needle_length + (self.count - 1) * self.link

    def arcs(self) -> Array:
        """Arcs (count,) of the nodes, mm."""
        return self.needle_length + self.link * np.arange(self.count, dtype=np.float64)

    def whole(self) -> Array:
        """The pieces (1, 2) of an unbroken thread."""
        return np.array([[self.needle_length, self.end]])


@dataclass(frozen=True)
class Slid:
    """What ``slide`` found.

    ``arc`` (c,) mm: the constraints' new arcs. ``shortage`` (c,) mm: at a hard constraint, the thread lacking
    between it and the next hard one; otherwise 0. ``pulled_out`` (c,) bool: the thread's end has left this hole.
    """

    arc: Array
    shortage: Array
    pulled_out: NDArray[np.bool_]


def _constraints(arc: Array, position: Array) -> tuple[Array, Array]:
    s = np.ascontiguousarray(arc, dtype=np.float64)
    p = np.ascontiguousarray(position, dtype=np.float64)
    if p.shape != (len(s), 3):
        raise ValueError(f"{len(s)} constraint arcs need positions of shape ({len(s)}, 3), not {p.shape}")
    if not in_order(s):
        raise ValueError("constraints must come in the order of their arcs, which must be finite")
    if not np.isfinite(p).all():
        raise ValueError("a constraint's place is not finite")
    return s, p


@njit(cache=True, nogil=True, error_model="numpy")
def in_order(arcs: Array) -> bool:
    """Whether arcs (c,) are finite and none is less than the one before it."""
    last = -math.inf
    for arc in arcs:  # an arc that is no number is not in order
        if not (last <= arc < math.inf):
            return False
        last = arc
    return len(arcs) == 0 or arcs[0] > -math.inf


def _nodes(model: ThreadModel, x: Array) -> Array:
    if x.shape != (model.count, 3):
        raise ValueError(f"this thread's positions have shape ({model.count}, 3), not {x.shape}")
    return x


def slide(
    model: ThreadModel,
    constraint_arc: Array,
    constraint_position: Array,
    hard: NDArray[np.bool_],
    pieces: Array,
    detour: Array | None = None,
) -> Slid:
    """Let the thread run through soft constraints so that no span is stretched, with the least total sliding.

    ``constraint_arc`` (c,) mm in ascending order, ``constraint_position`` (c, 3) mm, ``hard`` (c,). Hard
    arcs stay, the order stays, and a hole slides only when it must. Between two hard constraints with less
    thread than the straight way through their holes no sliding helps: the holes then share the thread in
    proportion to the distances, and the lack is reported. A constraint outside every piece, as on the
    needle or on a lost link, stays as it is. ``detour`` (c,) mm: by how much the way from a constraint to the next one
    is longer than the straight one, round what the thread lies over. Raises ValueError for constraints out of order.
    """
    old, points = _constraints(constraint_arc, constraint_position)
    arcs = old.copy()
    shortage = np.zeros(len(old))
    pulled_out = np.zeros(len(old), dtype=np.bool_)
    slide_kernel(
        arcs,
        points,
        np.ascontiguousarray(hard, dtype=np.bool_),
        pieces,
        SNAP * model.link,
        np.zeros(len(old)) if detour is None else detour,
        old,
        shortage,
        pulled_out,
        np.empty((5, len(old))),
    )
    return Slid(arcs, shortage, pulled_out)


def follow(model: ThreadModel, x: Array, constraint_arc: Array, constraint_position: Array, pieces: Array) -> Array:
    """Move the nodes ``x`` (n, 3) mm, in place, after the constraints: the paper's follow-the-leader.

    From a constraint to a free end each node follows the one before it. Between two constraints both
    one-sided passes are averaged and the links then brought back to their exact length. A piece without a
    constraint stays. Returns (c,) mm: the thread lacking between a constraint and the next one on the
    same piece, 0 after a ``slide`` that reported no shortage; the nodes of such a span lie straight and
    evenly, and ``length_error`` tells their stretch. Raises ValueError for constraints out of order.
    """
    arcs, points = _constraints(constraint_arc, constraint_position)
    shortage = np.empty(len(arcs))
    work = np.empty((3, model.count + 1, 3))
    follow_kernel(
        _nodes(model, x), model.needle_length, model.link, pieces, arcs, points, shortage, work[0], work[1], work[2]
    )
    return shortage


def break_at(model: ThreadModel, pieces: Array, arc: float) -> Array:
    """The pieces (p, 2) after the link that contains ``arc`` has given way. That link is lost.

    A piece without a link left is lost too. Raises ValueError where there is no thread at ``arc``.
    """
    for p, (s0, s1) in enumerate(pieces):
        if s0 <= arc <= s1:
            i1 = round((s1 - model.needle_length) / model.link)
            i = min(math.floor((arc - model.needle_length) / model.link + SNAP), i1 - 1)
            ends = model.needle_length + model.link * np.array([i, i + 1])
            kept = [half for half in ((s0, ends[0]), (ends[1], s1)) if half[1] - half[0] > 0.5 * model.link]
            return np.concatenate([pieces[:p], np.array(kept).reshape(-1, 2), pieces[p + 1 :]])
    raise ValueError(f"there is no thread at arc {arc} mm to break")


@njit(cache=True, nogil=True, error_model="numpy")
def _vertices(
    x: Array, origin: float, link: float, s0: float, s1: float, arcs: Array, points: Array, work: Array, out: Array
) -> int:
    """One piece's polyline into ``out`` (m, 5): x, y, z, arc, 1 for a constraint; returns the number of rows.

    ``work`` is working space of the same shape, at least n + 2 c rows.
    """
    i0 = round((s0 - origin) / link)
    i1 = round((s1 - origin) / link)
    rows = 0
    k = 0
    while k < len(arcs) and (arcs[k] - origin) / link < i0 - SNAP:
        k += 1
    for i in range(i0, i1 + 1):
        at_node = False
        while k < len(arcs) and (arcs[k] - origin) / link <= i + SNAP:
            at_node = (arcs[k] - origin) / link >= i - SNAP
            work[rows, 0], work[rows, 1], work[rows, 2] = points[k, 0], points[k, 1], points[k, 2]
            work[rows, 3], work[rows, 4] = arcs[k], 1.0
            rows += 1
            k += 1
        if not at_node:
            work[rows, 0], work[rows, 1], work[rows, 2] = x[i, 0], x[i, 1], x[i, 2]
            work[rows, 3], work[rows, 4] = origin + i * link, 0.0
            rows += 1
    count = 0
    fold = -1  # the row after which the present span may fold
    for row in range(rows):
        if work[row, 4] == 1.0:
            fold = -1
            slack = SNAP * link
            for other in range(row + 1, min(row + 1 + FOLD_NODES, rows)):
                dx = work[other, 0] - work[other - 1, 0]
                dy = work[other, 1] - work[other - 1, 1]
                dz = work[other, 2] - work[other - 1, 2]
                lacking = work[other, 3] - work[other - 1, 3] - math.sqrt(dx * dx + dy * dy + dz * dz)
                if lacking > slack:
                    fold, slack = other - 1, lacking
                if work[other, 4] == 1.0:
                    break
            else:
                fold = -1  # no constraint follows, or not so soon
        for e in range(5):
            out[count, e] = work[row, e]
        count += 1
        if row == fold:
            dx = work[row + 1, 0] - work[row, 0]
            dy = work[row + 1, 1] - work[row, 1]
            dz = work[row + 1, 2] - work[row, 2]
            length = work[row + 1, 3] - work[row, 3]
            chord2 = dx * dx + dy * dy + dz * dz
            before, after = max(row - 1, 0), min(row + 2, rows - 1)
            nx = work[row, 0] + work[row + 1, 0] - work[before, 0] - work[after, 0]
            ny = work[row, 1] + work[row + 1, 1] - work[before, 1] - work[after, 1]
            nz = work[row, 2] + work[row + 1, 2] - work[before, 2] - work[after, 2]
            if chord2 > 0.0:
                along = (nx * dx + ny * dy + nz * dz) / chord2
                nx, ny, nz = nx - along * dx, ny - along * dy, nz - along * dz
            size = math.sqrt(nx * nx + ny * ny + nz * nz)
            if size > 1e-6 * link:
                nx, ny, nz = nx / size, ny / size, nz / size
            else:
                nx, ny, nz = perpendicular(dx, dy, dz)
            height = 0.5 * math.sqrt(length * length - chord2)
            out[count, 0] = work[row, 0] + 0.5 * dx + height * nx
            out[count, 1] = work[row, 1] + 0.5 * dy + height * ny
            out[count, 2] = work[row, 2] + 0.5 * dz + height * nz
            out[count, 3], out[count, 4] = work[row, 3] + 0.5 * length, 0.0
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _largest_error(v: Array, rows: int, link: float) -> float:
    worst = 0.0
    for i in range(rows - 1):
        dx, dy, dz = v[i + 1, 0] - v[i, 0], v[i + 1, 1] - v[i, 1], v[i + 1, 2] - v[i, 2]
        error = abs(math.sqrt(dx * dx + dy * dy + dz * dz) - (v[i + 1, 3] - v[i, 3])) / link
        if math.isnan(error):
            return math.nan
        worst = max(worst, error)
    return worst


@njit(cache=True, nogil=True, error_model="numpy")
def _closest(v: Array, rows: int, qx: float, qy: float, qz: float) -> tuple[float, float]:
    best, arc = math.inf, math.nan
    for i in range(rows - 1):
        ax, ay, az = v[i, 0], v[i, 1], v[i, 2]
        dx, dy, dz = v[i + 1, 0] - ax, v[i + 1, 1] - ay, v[i + 1, 2] - az
        size2 = dx * dx + dy * dy + dz * dz
        part = 0.0
        if size2 > 0.0:
            part = min(max(((qx - ax) * dx + (qy - ay) * dy + (qz - az) * dz) / size2, 0.0), 1.0)
        ex, ey, ez = ax + part * dx - qx, ay + part * dy - qy, az + part * dz - qz
        distance2 = ex * ex + ey * ey + ez * ez
        if distance2 < best:
            best, arc = distance2, v[i, 3] + part * (v[i + 1, 3] - v[i, 3])
    return math.sqrt(best), arc


def _polylines(model: ThreadModel, x: Array, arc: Array, position: Array, pieces: Array) -> list[Array]:
    arcs, points = _constraints(arc, position)
    found = []
    for s0, s1 in pieces:
        v, work = np.empty((2, model.count + 2 * len(arcs) + 1, 5))
        rows = _vertices(_nodes(model, x), model.needle_length, model.link, s0, s1, arcs, points, work, v)
        found.append(v[:rows])
    return found


def polyline(
    model: ThreadModel, x: Array, constraint_arc: Array, constraint_position: Array, pieces: Array
) -> list[Array]:
    """The thread as it is drawn: for each piece the points (m, 3) mm, nodes, constraints and folds in order."""
    return [v[:, :3].copy() for v in _polylines(model, x, constraint_arc, constraint_position, pieces)]


def length_error(
    model: ThreadModel, x: Array, constraint_arc: Array, constraint_position: Array, pieces: Array
) -> float:
    """The largest |distance - arc| between neighbours of the polyline, in link lengths; 0 is exact, NaN shows."""
    lines = _polylines(model, x, constraint_arc, constraint_position, pieces)
    return float(np.max([_largest_error(v, len(v), model.link) for v in lines], initial=0.0))


def closest(
    model: ThreadModel, x: Array, constraint_arc: Array, constraint_position: Array, pieces: Array, point: Array
) -> tuple[float, float]:
    """(distance mm, arc mm) of the thread's point nearest to ``point`` (3,); (inf, nan) if no thread is left."""
    lines = _polylines(model, x, constraint_arc, constraint_position, pieces)
    found = [_closest(v, len(v), point[0], point[1], point[2]) for v in lines]
    return min(found, default=(math.inf, math.nan))
