"""The thread lies over what it meets: walls, blades, itself (Brown et al. 2001, section 4: "draped").

After ``thread.follow`` has moved the thread, links that would go into something are moved aside. What touches is
projected in turn with the links' lengths (position-based dynamics: Müller et al. 2007, "Position based dynamics",
section 3), with Coulomb friction as Macklin et al. 2014, "Unified particle physics for real-time applications", section
6.1, have it: in a movement a point that touches slides by no more than what it would have slid less mu times what it
was pushed. Then each span between two constraints gets its lengths back exactly, and what still goes too deep is
projected again. Nothing is pushed but the thread.

A thread drawn tight over something has a longer way than the straight one: what a span lacks is told, so that its holes
can let it have so much more (``thread_slide``).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.thread import ThreadModel
from trainer.mechanics.thread_closure import close_directions
from trainer.mechanics.thread_follow import one_sided
from trainer.mechanics.thread_line import Ints, lay_rows, no_line
from trainer.mechanics.thread_search import Blades, Walls, no_pairs, search
from trainer.mechanics.thread_touch import no_touches, sweep, touch

#: Nothing is moved for what is less deep than this, mm: a twelfth of the radius of a 10-0 thread.
TOLERANCE_MM = 1e-3
#: Projections of all touches and lengths, and how often what is near is looked for again.
SWEEPS, ROUNDS = 30, 4
#: A span that touches something nearer than this, mm, may need the longer way round it.
LIES_MM = 0.01
#: Nearer to a hole than this, mm along it, a thread lies over the hole's own vessel by nature.
BY_HOLE_MM = 0.5


@njit(cache=True, nogil=True, error_model="numpy")
def _gap(x, touches, k):  # type: ignore[no-untyped-def]
    r, q, s, t = touches.row[k], touches.other[k], touches.place[k, 0], touches.place[k, 1]
    gap = -touches.offset[k]
    for d in range(3):
        p = (1.0 - s) * x[r, d] + s * x[r + 1, d]
        if q >= 0:
            p -= (1.0 - t) * x[q, d] + t * x[q + 1, d]
        gap += touches.normal[k, d] * p
    return gap


@njit(cache=True, nogil=True, error_model="numpy")
def _move(x, weight, touches, k, wx, wy, wz):  # type: ignore[no-untyped-def]
    """Move the touching point by w, each free row as far as it has a part in it; returns whether any is free."""
    r, q, s, t = touches.row[k], touches.other[k], touches.place[k, 0], touches.place[k, 1]
    a, b = (1.0 - s) * weight[r], s * weight[r + 1]
    total = (1.0 - s) * a + s * b
    c = e = 0.0
    if q >= 0:
        c, e = (1.0 - t) * weight[q], t * weight[q + 1]
        total += (1.0 - t) * c + t * e
    if total == 0.0:
        return False
    wx, wy, wz = wx / total, wy / total, wz / total
    x[r, 0], x[r, 1], x[r, 2] = x[r, 0] + a * wx, x[r, 1] + a * wy, x[r, 2] + a * wz
    x[r + 1, 0], x[r + 1, 1], x[r + 1, 2] = x[r + 1, 0] + b * wx, x[r + 1, 1] + b * wy, x[r + 1, 2] + b * wz
    if q >= 0:
        x[q, 0], x[q, 1], x[q, 2] = x[q, 0] - c * wx, x[q, 1] - c * wy, x[q, 2] - c * wz
        x[q + 1, 0], x[q + 1, 1], x[q + 1, 2] = x[q + 1, 0] - e * wx, x[q + 1, 1] - e * wy, x[q + 1, 2] - e * wz
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _rub(x, weight, touches, k, friction):  # type: ignore[no-untyped-def]
    """Coulomb's friction of a touch that has been pushed."""
    r, q, s, t = touches.row[k], touches.other[k], touches.place[k, 0], touches.place[k, 1]
    nx, ny, nz = touches.normal[k, 0], touches.normal[k, 1], touches.normal[k, 2]
    px = (1.0 - s) * x[r, 0] + s * x[r + 1, 0] - touches.home[k, 0]
    py = (1.0 - s) * x[r, 1] + s * x[r + 1, 1] - touches.home[k, 1]
    pz = (1.0 - s) * x[r, 2] + s * x[r + 1, 2] - touches.home[k, 2]
    if q >= 0:
        px -= (1.0 - t) * x[q, 0] + t * x[q + 1, 0]
        py -= (1.0 - t) * x[q, 1] + t * x[q + 1, 1]
        pz -= (1.0 - t) * x[q, 2] + t * x[q + 1, 2]
    along = nx * px + ny * py + nz * pz
    gx = touches.grip[k, 0] - (px - along * nx)
    gy = touches.grip[k, 1] - (py - along * ny)
    gz = touches.grip[k, 2] - (pz - along * nz)
    size, most = math.sqrt(gx * gx + gy * gy + gz * gz), friction * touches.push[k]
    if size > most:
        gx, gy, gz = gx * most / size, gy * most / size, gz * most / size
    if _move(x, weight, touches, k, gx - touches.grip[k, 0], gy - touches.grip[k, 1], gz - touches.grip[k, 2]):
        touches.grip[k, 0], touches.grip[k, 1], touches.grip[k, 2] = gx, gy, gz


@njit(cache=True, nogil=True, error_model="numpy")
def project(line, m, weight, touches, count, friction):  # type: ignore[no-untyped-def]
    """Bring lengths and touches together, in place; rows move that have a ``weight`` (m,) of 1."""
    x = line.x
    touches.push[:count] = 0.0
    touches.grip[:count, :] = 0.0
    for sweeping in range(SWEEPS):
        furthest = 0.0
        for step in range(m - 1):
            r = step if sweeping % 2 == 0 else m - 2 - step
            w = weight[r] + weight[r + 1]
            if w == 0.0 or line.length[r] < 0.0:
                continue
            dx, dy, dz = x[r + 1, 0] - x[r, 0], x[r + 1, 1] - x[r, 1], x[r + 1, 2] - x[r, 2]
            size = math.sqrt(dx * dx + dy * dy + dz * dz)
            if size == 0.0:
                continue
            part = (size - line.length[r]) / (size * w)
            furthest = max(furthest, abs(size - line.length[r]))
            a, b = weight[r] * part, weight[r + 1] * part
            x[r, 0], x[r, 1], x[r, 2] = x[r, 0] + a * dx, x[r, 1] + a * dy, x[r, 2] + a * dz
            x[r + 1, 0], x[r + 1, 1], x[r + 1, 2] = x[r + 1, 0] - b * dx, x[r + 1, 1] - b * dy, x[r + 1, 2] - b * dz
        for k in range(count):
            r, q = touches.row[k], touches.other[k]
            if weight[r] + weight[r + 1] == 0.0 and (q < 0 or weight[q] + weight[q + 1] == 0.0):
                continue
            push = max(0.0, touches.push[k] - _gap(x, touches, k))
            change = push - touches.push[k]
            if change != 0.0 and _move(
                x, weight, touches, k,
                change * touches.normal[k, 0], change * touches.normal[k, 1], change * touches.normal[k, 2],
            ):  # fmt: skip
                touches.push[k] = push
                furthest = max(furthest, abs(change))
            if touches.push[k] > 0.0:
                _rub(x, weight, touches, k, friction)
        if furthest < 0.1 * TOLERANCE_MM:
            return


@njit(cache=True, nogil=True, error_model="numpy")
def _close_span(line, first, last, link, u, trial, kept):  # type: ignore[no-untyped-def]
    """Exact lengths between the rows ``first`` and ``last``, which stay; else what is between goes back to ``kept``."""
    x, links = line.x, last - first
    d0, d1 = line.length[first], line.length[last - 1]
    for j in range(links):
        p = first + j
        dx, dy, dz = x[p + 1, 0] - x[p, 0], x[p + 1, 1] - x[p, 1], x[p + 1, 2] - x[p, 2]
        size = math.sqrt(dx * dx + dy * dy + dz * dz)
        if size < 1e-9 * link:
            dx, dy, dz, size = 1.0, 0.0, 0.0, 1.0
        u[j, 0], u[j, 1], u[j, 2] = dx / size, dy / size, dz / size
    cx, cy, cz = x[last, 0] - x[first, 0], x[last, 1] - x[first, 1], x[last, 2] - x[first, 2]
    total = line.arc[last] - line.arc[first]
    if cx * cx + cy * cy + cz * cz >= total * total or not close_directions(u, trial, links, d0, link, d1, cx, cy, cz):
        for r in range(first + 1, last):
            for e in range(3):
                x[r, e] = kept[r, e]
        return
    for r in range(first + 1, last):
        for e in range(3):
            x[r, e] = x[r - 1, e] + line.length[r - 1] * u[r - 1 - first, e]


@njit(cache=True, nogil=True, error_model="numpy")
def _span(line, m, r):  # type: ignore[no-untyped-def]
    """The next rows from ``r`` on that are free together: first, last, whether one before, and after, is held."""
    while r < m and not line.free[r]:
        r += 1
    first = r
    while r + 1 < m and line.length[r] >= 0.0 and line.free[r + 1]:
        r += 1
    if first == m:
        return m, m, False, False
    return first, r, first > 0 and line.length[first - 1] >= 0.0, line.length[r] >= 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _deepest(line, first, last, touches, count):  # type: ignore[no-untyped-def]
    """The least gap of what the free rows ``first`` .. ``last`` touch."""
    least = math.inf
    for k in range(count):
        r, q = touches.row[k], touches.other[k]
        if first - 1 <= r <= last or (q >= 0 and first - 1 <= q <= last):
            least = min(least, _gap(line.x, touches, k))
    return least


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(line, m, weight, touches, count):  # type: ignore[no-untyped-def]
    """Let the spans move that go too deep; returns whether any does."""
    weight[:m] = 0.0
    r, any_moves = 0, False
    while r < m:
        first, last, _, _ = _span(line, m, r)
        if first < m and _deepest(line, first, last, touches, count) < -TOLERANCE_MM:
            weight[first : last + 1] = 1.0
            any_moves = True
        r = last + 1
    return any_moves


@njit(cache=True, nogil=True, error_model="numpy")
def _give_lengths(line, m, link, weight, kept, u, trial, lack):  # type: ignore[no-untyped-def]
    """Bring the spans that moved back to their exact lengths, and write what those between two held rows lack."""
    x = line.x
    r = 0
    while r < m:
        first, last, begun, ended = _span(line, m, r)
        r = last + 1
        if first == m or weight[first] == 0.0:
            continue
        if begun and ended:
            way = 0.0
            for q in range(first - 1, last + 1):
                dx, dy, dz = x[q + 1, 0] - x[q, 0], x[q + 1, 1] - x[q, 1], x[q + 1, 2] - x[q, 2]
                way += math.sqrt(dx * dx + dy * dy + dz * dz)
            lack[line.held[first - 1]] = way - line.arc[last + 1] + line.arc[first - 1]
            _close_span(line, first - 1, last + 1, link, u, trial, kept)
        elif ended:
            p = last + 1
            one_sided(x, last, first - 1, -1, x[p, 0], x[p, 1], x[p, 2], line.length[last], link, x)
        else:
            p = first - 1 if begun else first
            one_sided(x, p + 1, last + 1, 1, x[p, 0], x[p, 1], x[p, 2], line.length[p], link, x)


@njit(cache=True, nogil=True, error_model="numpy")
def _pass(line, m, crossed, through, before):  # type: ignore[no-untyped-def]
    """Where the thread goes through a wall without a hole, as it does where its end or a grip was drawn through it.

    There it goes on running through, as through a hole. It begins beside a held row, with a link through both hulls,
    and goes on as long as that link or one beside it is through either.
    """
    half = crossed.shape[0] // 2
    for i in range(through.shape[0]):
        before[i] = through[i]
        through[i] = -1
    for r in range(m):
        if crossed[r] == 0:
            continue
        i, vessel = line.base[r], crossed[half + r]
        held = (line.held[r] >= 0 or line.held[r + 1] >= 0) and crossed[r] == 3
        for j in range(max(i - 1, 0), min(i + 2, through.shape[0])):
            held = held or before[j] == vessel
        if held:
            through[i] = vessel


@njit(cache=True, nogil=True, error_model="numpy")
def _tell(line, m, touches, count, tools, vessels, seat, lack, way, near):  # type: ignore[no-untyped-def]
    """What spans lack, how long the way is through what they touch, how near each body is to the thread, and where.

    ``seat`` (m,) is scratch: where along a link it touches.
    """
    x = line.x
    seat[:m] = -1.0
    for k in range(count):
        if _gap(x, touches, k) < LIES_MM:
            seat[touches.row[k]] = touches.place[k, 0]
            if touches.other[k] >= 0:
                seat[touches.other[k]] = touches.place[k, 1]
    r = 0
    while r < m:
        first, last, begun, ended = _span(line, m, r)
        r = last + 1
        if first == m or not (begun and ended):
            continue
        held = line.held[first - 1]
        if _deepest(line, first, last, touches, count) >= -TOLERANCE_MM:
            lack[held] = 0.0
        px, py, pz = x[first - 1, 0], x[first - 1, 1], x[first - 1, 2]
        for q in range(first - 1, last + 2):
            s = seat[q] if q <= last else 0.0
            if s >= 0.0:
                nx, ny, nz = x[q, 0], x[q, 1], x[q, 2]
                if s > 0.0:
                    nx, ny, nz = nx + s * (x[q + 1, 0] - nx), ny + s * (x[q + 1, 1] - ny), nz + s * (x[q + 1, 2] - nz)
                way[held] += math.sqrt((nx - px) ** 2 + (ny - py) ** 2 + (nz - pz) ** 2)
                px, py, pz = nx, ny, nz
    near[:, 0] = math.inf
    for k in range(count):
        b, r = touches.body[k], touches.row[k]
        if tools <= b < tools + vessels and min(line.away[r], line.away[r + 1]) < BY_HOLE_MM:
            continue
        gap = _gap(line.x, touches, k)
        if gap < near[b, 0]:
            s = touches.place[k, 0]
            near[b, 0], near[b, 1] = gap, line.arc[r] + s * line.length[r]
            for d in range(3):
                near[b, 2 + d] = (1.0 - s) * line.x[r, d] + s * line.x[r + 1, d]


@njit(cache=True, nogil=True, error_model="numpy")
def drape_kernel(  # type: ignore[no-untyped-def]
    nodes, before, origin, link, pieces, arcs, points, points_before, holes, channel, through, radius,
    walls, x0, x1, blades, free_mm, friction, line, pairs, touches, crossed, weight, kept, u, trial, lack, way, near,
):  # fmt: skip
    """``Drape.lay`` on plain arrays; returns False, with nothing changed, where there is too little room."""
    lack[:] = 0.0
    way[:] = 0.0
    tools, vessels = blades.grip.shape[0], walls.deep.shape[0]
    m = lay_rows(
        line, nodes, before, origin, link, pieces, arcs, points, points_before, holes, channel, through, radius
    )
    search(line, m, walls, x0, x1, blades, free_mm, pairs)
    if max(pairs.used[0], max(pairs.used[1], pairs.used[2])) > pairs.wall.shape[0]:
        return False
    sweep(line, walls, x0, x1, tools, pairs, touches)
    swept = pairs.used[3]
    touch(line, walls, x0, x1, blades, radius, pairs, swept, touches, crossed)
    for r in range(m):
        for d in range(3):
            kept[r, d] = line.x[r, d]
    for _ in range(ROUNDS):
        if pairs.used[3] > touches.row.shape[0]:
            return False
        if not _mark(line, m, weight, touches, pairs.used[3]):
            break
        project(line, m, weight, touches, pairs.used[3], friction)
        _give_lengths(line, m, link, weight, kept, u, trial, lack)
        touch(line, walls, x0, x1, blades, radius, pairs, swept, touches, crossed)
    if pairs.used[3] > touches.row.shape[0]:
        return False
    _pass(line, m, crossed, through, pairs.near)
    _tell(line, m, touches, pairs.used[3], tools, vessels, weight, lack, way, near)
    for r in range(m):
        if line.free[r]:
            for d in range(3):
                nodes[line.node[r], d] = line.x[r, d]
    return True


class Drape:
    """What a thread of ``model`` with ``radius`` mm lies over: ``walls``, and the blades of ``tools`` instruments."""

    def __init__(self, model: ThreadModel, radius: float, friction: float, walls: Walls, tools: int) -> None:
        self._model, self._radius, self._friction, self._walls = model, radius, friction, walls
        self._through = np.full(model.count, -1, dtype=np.int32)
        self.near = np.full((tools + len(walls.deep) + 1, 5), np.inf)  # of each body: gap, arc, place; mm
        self._make_room(model.count + 32, 1024)

    def _make_room(self, rows: int, pairs: int) -> None:
        self._line, self._pairs, self._touches = no_line(rows), no_pairs(rows, pairs), no_touches(4 * pairs)
        self._crossed, self._weight = np.zeros(2 * rows, dtype=np.int32), np.zeros(rows)
        self._kept, self._u, self._trial = np.zeros((3, rows, 3))

    def lay(
        self, nodes: Array, before: Array, pieces: Array, arcs: Array, points: Array, points_before: Array,
        holes: np.ndarray, channel: Ints, x0: Array, x1: Array, blades: Blades, free_mm: float,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Lay the thread's ``nodes`` (n, 3) mm, in place, over what they met in a movement from ``before``.

        Constraints as in ``thread.follow``, with their ``points_before`` (c, 3); ``holes`` (c,) bool; ``channel`` (c,):
        the vessel in whose wall the thread runs from a constraint to the next, or -1. The tissue went from ``x0`` to
        ``x1`` (n, 3). Returns for each constraint, (c,) mm, the thread that the span to the next one lacks, and how
        long the way to it is from touch to touch, straight between them. ``self.near`` (bodies, 5) tells of each tool,
        vessel and the thread itself the least gap, and the arc and place there; inf where it is further than
        ``thread_search.MARGIN_MM``.
        """
        lack, way = np.zeros((2, len(arcs)))
        while True:
            through = self._through.copy()
            rows = self._model.count + len(arcs) + 1
            if rows > len(self._weight):
                self._make_room(rows + 32, len(self._pairs.wall))
            if drape_kernel(
                nodes, before, self._model.needle_length, self._model.link, pieces, arcs, points, points_before,
                holes, channel, through, self._radius, self._walls, x0, x1, blades, free_mm,
                self._friction, self._line, self._pairs, self._touches, self._crossed, self._weight,
                self._kept, self._u, self._trial, lack, way, self.near,
            ):  # fmt: skip
                self._through = through
                return lack, way
            self._make_room(len(self._weight), 2 * len(self._pairs.wall))
