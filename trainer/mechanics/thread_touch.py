"""What a thread touches: points of links, and the planes on whose side they stay.

``touch`` finds what is near where the thread is now, ``sweep`` what it would pass through in a movement.

A wall's surface is closed and its normals point out of the wall, so that being inside shows by itself. A node in the
wall no deeper than half its thickness goes back out through the triangle over it; what would get deeper in one movement
is found by the zeros of the volumes (:mod:`trainer.mechanics.continuous_collision`). Links meet edges only where the
wall is sharp, as at its cut edge: between the facets of a round wall they sag by less than their own thickness.

Of a blade or another link the thread stays on the side on which it was when the movement began: the normal is that of
the movement's end where it agrees with that of the start, else that of the start, as in ``thread_contact``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.closest_points import segment_segment
from trainer.mechanics.continuous_collision import EDGE_EDGE, POINT_TRIANGLE, crossing
from trainer.mechanics.thread_line import Ints
from trainer.mechanics.thread_search import MARGIN_MM

#: A foot may be this far beyond a blunt edge of its triangle, in weights: behind two facets that lean towards one
#: another there is a wedge in which a point has its foot on neither.
WEDGE = 0.1
#: A point of a link of which less than this part is free, next to a held row, cannot give way and touches nothing.
GIVES = 0.3
#: Two bodies nearer than this, mm, have no direction between them.
TOGETHER_MM = 1e-9


class Touches(NamedTuple):
    """Points of links, and the planes on whose side they stay."""

    row: Ints  # (t,) the link to the next row
    other: Ints  # (t,) the other link, or -1
    place: Array  # (t, 2) 0..1 along the link, and along the other
    normal: Array  # (t, 3)
    offset: Array  # (t,) mm: the gap is normal · (point - other point) - offset
    home: Array  # (t, 3) mm: point (less other point) that has not slid
    body: Ints  # (t,) tool, then vessel, then the thread itself
    push: Array  # (t,) mm, the answer
    grip: Array  # (t, 3) mm, the answer


def no_touches(room: int) -> Touches:
    """Room for ``room`` touches."""
    row, other, body = (np.zeros(room, dtype=np.int32) for _ in range(3))
    return Touches(
        row, other, np.zeros((room, 2)), np.zeros((room, 3)), np.zeros(room), np.zeros((room, 3)), body,
        np.zeros(room), np.zeros((room, 3)),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _add(touches, used, row, other, s, t, nx, ny, nz, offset, hx, hy, hz, body):  # type: ignore[no-untyped-def]
    k = used[3]
    used[3] = k + 1
    if k >= touches.row.shape[0]:
        return
    touches.row[k], touches.other[k], touches.body[k] = row, other, body
    touches.place[k, 0], touches.place[k, 1] = s, t
    touches.normal[k, 0], touches.normal[k, 1], touches.normal[k, 2] = nx, ny, nz
    touches.offset[k] = offset
    touches.home[k, 0], touches.home[k, 1], touches.home[k, 2] = hx, hy, hz


@njit(cache=True, nogil=True, error_model="numpy")
def _between(x, i, s, d):  # type: ignore[no-untyped-def]
    """Coordinate d of the point s of the way from row i to the next."""
    return (1.0 - s) * x[i, d] + s * x[i + 1, d]


@njit(cache=True, nogil=True, error_model="numpy")
def _gives(line, r, s):  # type: ignore[no-untyped-def]
    """Whether the point s of link r can give way."""
    return (1.0 - s) * line.free[r] + s * line.free[r + 1] >= GIVES


@njit(cache=True, nogil=True, error_model="numpy")
def face_normal(x, triangles, f):  # type: ignore[no-untyped-def]
    """Unit normal of a triangle by the right-hand rule; zeros where it has no area."""
    i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
    ux, uy, uz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    vx, vy, vz = x[k, 0] - x[i, 0], x[k, 1] - x[i, 1], x[k, 2] - x[i, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if size == 0.0:
        return 0.0, 0.0, 0.0
    return nx / size, ny / size, nz / size


@njit(cache=True, nogil=True, error_model="numpy")
def _foot(px, py, pz, x, i, j, k):  # type: ignore[no-untyped-def]
    """Weights of corners j and k of the point's foot on the plane of a triangle; -1 where it has no area."""
    ux, uy, uz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    vx, vy, vz = x[k, 0] - x[i, 0], x[k, 1] - x[i, 1], x[k, 2] - x[i, 2]
    wx, wy, wz = px - x[i, 0], py - x[i, 1], pz - x[i, 2]
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    wu, wv = wx * ux + wy * uy + wz * uz, wx * vx + wy * vy + wz * vz
    det = uu * vv - uv * uv
    if det <= 0.0:
        return -1.0, -1.0
    return (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det


@njit(cache=True, nogil=True, error_model="numpy")
def _plane(line, r, s, f, walls, x0, x1, b, c, nx, ny, nz, tools, used, touches):  # type: ignore[no-untyped-def]
    """The point s of link r stays over the point of triangle f with the weights b and c."""
    if not _gives(line, r, s):
        return
    i, j, k = walls.triangles[f, 0], walls.triangles[f, 1], walls.triangles[f, 2]
    a = 1.0 - b - c
    qx = a * x1[i, 0] + b * x1[j, 0] + c * x1[k, 0]
    qy = a * x1[i, 1] + b * x1[j, 1] + c * x1[k, 1]
    qz = a * x1[i, 2] + b * x1[j, 2] + c * x1[k, 2]
    skin = (1.0 - s) * line.skin[r] + s * line.skin[r + 1]
    _add(
        touches, used, r, -1, s, 0.0, nx, ny, nz, nx * qx + ny * qy + nz * qz + skin,
        _between(line.start, r, s, 0) + qx - a * x0[i, 0] - b * x0[j, 0] - c * x0[k, 0],
        _between(line.start, r, s, 1) + qy - a * x0[i, 1] - b * x0[j, 1] - c * x0[k, 1],
        _between(line.start, r, s, 2) + qz - a * x0[i, 2] - b * x0[j, 2] - c * x0[k, 2],
        tools + walls.vessel[f],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _edge(line, r, f, e, walls, x0, x1, ox, oy, oz, tools, pairs, touches):  # type: ignore[no-untyped-def]
    """The link r and the sharp edge e of triangle f, outwards of which is (ox, oy, oz)."""
    i, j = walls.triangles[f, e], walls.triangles[f, (e + 1) % 3]
    squared, s, t = segment_segment(line.x, r, r + 1, x1, i, j)
    distance = math.sqrt(squared)
    vessel = walls.vessel[f]
    if distance > MARGIN_MM + line.skin[r] or distance < TOGETHER_MM or line.inside[r] == vessel:
        return
    nx = (_between(line.x, r, s, 0) - (1.0 - t) * x1[i, 0] - t * x1[j, 0]) / distance
    ny = (_between(line.x, r, s, 1) - (1.0 - t) * x1[i, 1] - t * x1[j, 1]) / distance
    nz = (_between(line.x, r, s, 2) - (1.0 - t) * x1[i, 2] - t * x1[j, 2]) / distance
    if nx * ox + ny * oy + nz * oz < 0.0:
        # The link runs inside of the edge. Where that is only because an end of either does, faces see to it.
        if not (0.0 < s < 1.0 and 0.0 < t < 1.0 and distance < walls.deep[vessel]):
            return
        nx, ny, nz = -nx, -ny, -nz
    b, c = (t, 0.0) if e == 0 else ((1.0 - t, t) if e == 1 else (0.0, 1.0 - t))
    _plane(line, r, s, f, walls, x0, x1, b, c, nx, ny, nz, tools, pairs.used, touches)


@njit(cache=True, nogil=True, error_model="numpy")
def _touch_wall(line, r, f, walls, x0, x1, tools, pairs, touches, crossed):  # type: ignore[no-untyped-def]
    nx, ny, nz = face_normal(x1, walls.triangles, f)
    i, j, k = walls.triangles[f, 0], walls.triangles[f, 1], walls.triangles[f, 2]
    vessel = walls.vessel[f]
    x = line.x
    h0 = nx * (x[r, 0] - x1[i, 0]) + ny * (x[r, 1] - x1[i, 1]) + nz * (x[r, 2] - x1[i, 2])
    h1 = nx * (x[r + 1, 0] - x1[i, 0]) + ny * (x[r + 1, 1] - x1[i, 1]) + nz * (x[r + 1, 2] - x1[i, 2])
    reach = MARGIN_MM + max(line.skin[r], line.skin[r + 1])
    if min(h0, h1) > reach or max(h0, h1) < -walls.deep[vessel]:
        return
    for end in range(2 if line.length[r + 1] < 0.0 else 1):
        at, height = (r, h0) if end == 0 else (r + 1, h1)
        if line.free[at] and line.wall[at] != vessel and -walls.deep[vessel] < height < MARGIN_MM + line.skin[at]:
            b, c = _foot(x[at, 0], x[at, 1], x[at, 2], x1, i, j, k)
            if (
                c >= (-WEDGE if walls.sharp[f, 0] == 0 else 0.0)
                and b + c <= (1.0 + WEDGE if walls.sharp[f, 1] == 0 else 1.0)
                and b >= (-WEDGE if walls.sharp[f, 2] == 0 else 0.0)
            ):
                _plane(line, r, float(end), f, walls, x0, x1, b, c, nx, ny, nz, tools, pairs.used, touches)
    for e in range(3):
        if walls.sharp[f, e] == 2:
            gx, gy, gz = face_normal(x1, walls.triangles, walls.outwards[f, e])
            _edge(line, r, f, e, walls, x0, x1, nx + gx, ny + gy, nz + gz, tools, pairs, touches)
    if (h0 > 0.0) != (h1 > 0.0) and line.away[r] > 0.0 and line.away[r + 1] > 0.0:
        s = h0 / (h0 - h1)
        b, c = _foot(_between(x, r, s, 0), _between(x, r, s, 1), _between(x, r, s, 2), x1, i, j, k)
        if b >= 0.0 and c >= 0.0 and b + c <= 1.0:
            crossed[r] |= walls.hull[f]
            crossed[r + crossed.shape[0] // 2] = vessel


@njit(cache=True, nogil=True, error_model="numpy")
def _side(x, r, axis, i, j):  # type: ignore[no-untyped-def]
    """Distance, weights and unit direction from the segment i, j of ``axis`` to link r."""
    squared, s, t = segment_segment(x, r, r + 1, axis, i, j)
    distance = math.sqrt(squared)
    if distance < TOGETHER_MM:
        return 0.0, s, t, 0.0, 0.0, 0.0
    return (
        distance, s, t,
        (_between(x, r, s, 0) - (1.0 - t) * axis[i, 0] - t * axis[j, 0]) / distance,
        (_between(x, r, s, 1) - (1.0 - t) * axis[i, 1] - t * axis[j, 1]) / distance,
        (_between(x, r, s, 2) - (1.0 - t) * axis[i, 2] - t * axis[j, 2]) / distance,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _touch_blade(line, r, k, blades, radius, pairs, touches):  # type: ignore[no-untyped-def]
    i, j = 2 * k, 2 * k + 1
    distance, s, t, nx, ny, nz = _side(line.x, r, blades.end, i, j)
    before, s0, t0, mx, my, mz = _side(line.start, r, blades.start, i, j)
    reach = radius + (1.0 - t) * blades.radius[i] + t * blades.radius[j]
    if before > 0.0 and nx * mx + ny * my + nz * mz <= 0.0:  # passed through, or turned round the end of the axis
        s, t, nx, ny, nz = s0, t0, mx, my, mz
        reach = radius + (1.0 - t) * blades.radius[i] + t * blades.radius[j]
    elif distance > reach + MARGIN_MM:
        return
    if not _gives(line, r, s):
        return
    qx = (1.0 - t) * blades.end[i, 0] + t * blades.end[j, 0]
    qy = (1.0 - t) * blades.end[i, 1] + t * blades.end[j, 1]
    qz = (1.0 - t) * blades.end[i, 2] + t * blades.end[j, 2]
    _add(
        touches, pairs.used, r, -1, s, 0.0, nx, ny, nz, nx * qx + ny * qy + nz * qz + reach,
        _between(line.start, r, s, 0) + qx - (1.0 - t) * blades.start[i, 0] - t * blades.start[j, 0],
        _between(line.start, r, s, 1) + qy - (1.0 - t) * blades.start[i, 1] - t * blades.start[j, 1],
        _between(line.start, r, s, 2) + qz - (1.0 - t) * blades.start[i, 2] - t * blades.start[j, 2],
        blades.tool[k],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _touch_itself(line, r, q, radius, body, pairs, touches):  # type: ignore[no-untyped-def]
    distance, s, t, nx, ny, nz = _side(line.x, r, line.x, q, q + 1)
    before, s0, t0, mx, my, mz = _side(line.start, r, line.start, q, q + 1)
    if before > 0.0 and nx * mx + ny * my + nz * mz <= 0.0:
        s, t, nx, ny, nz = s0, t0, mx, my, mz
    elif distance > 2.0 * radius + MARGIN_MM:
        return
    if not (_gives(line, r, s) or _gives(line, q, t)):
        return
    _add(
        touches, pairs.used, r, q, s, t, nx, ny, nz, 2.0 * radius,
        _between(line.start, r, s, 0) - _between(line.start, q, t, 0),
        _between(line.start, r, s, 1) - _between(line.start, q, t, 1),
        _between(line.start, r, s, 2) - _between(line.start, q, t, 2),
        body,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def touch(line, walls, x0, x1, blades, radius, pairs, kept, touches, crossed):  # type: ignore[no-untyped-def]
    """Write the touches of all candidates after the first ``kept``; walls come last, they have the last word.

    ``crossed`` (2 m,) tells of each link the hulls that it goes through where it has no hole, and then their vessels.
    """
    tools, used = blades.grip.shape[0], pairs.used
    used[3] = kept
    crossed[:] = 0
    for k in range(used[1]):
        _touch_blade(line, pairs.blade[k, 0], pairs.blade[k, 1], blades, radius, pairs, touches)
    for k in range(used[2]):
        body = tools + walls.deep.shape[0]
        _touch_itself(line, pairs.itself[k, 0], pairs.itself[k, 1], radius, body, pairs, touches)
    for k in range(used[0]):
        _touch_wall(line, pairs.wall[k, 0], pairs.wall[k, 1], walls, x0, x1, tools, pairs, touches, crossed)


@njit(cache=True, nogil=True, error_model="numpy")
def _beyond(x, r, s, v, f, triangles, nx, ny, nz):  # type: ignore[no-untyped-def]
    i = triangles[f, 0]
    return (
        nx * (_between(x, r, s, 0) - v[i, 0]) + ny * (_between(x, r, s, 1) - v[i, 1])
        + nz * (_between(x, r, s, 2) - v[i, 2])
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _put(four, at, x, i):  # type: ignore[no-untyped-def]
    for d in range(3):
        four[at, d] = x[i, d]


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(line, walls, x0, x1, tools, pairs, touches):  # type: ignore[no-untyped-def]
    """Write a touch for each node that would go into a wall, and each link that would go over a sharp edge into it."""
    used = pairs.used
    used[3] = 0
    start, end, now, normal = pairs.four[0], pairs.four[1], pairs.four[2], pairs.four[3, 0]
    for p in range(used[0]):
        r, f = pairs.wall[p, 0], pairs.wall[p, 1]
        vessel, corners = walls.vessel[f], walls.triangles[f]
        ax, ay, az = face_normal(x0, walls.triangles, f)
        nx, ny, nz = face_normal(x1, walls.triangles, f)
        for finish in range(2 if line.length[r + 1] < 0.0 else 1):
            at = r + finish
            if not line.free[at] or line.wall[at] == vessel:
                continue
            before = _beyond(line.start, r, float(finish), x0, f, walls.triangles, ax, ay, az)
            after = _beyond(line.x, r, float(finish), x1, f, walls.triangles, nx, ny, nz)
            if before < 0.0 or after >= 0.0:
                continue
            _put(start, 0, line.start, at)
            _put(end, 0, line.x, at)
            for c in range(3):
                _put(start, 1 + c, x0, corners[c])
                _put(end, 1 + c, x1, corners[c])
            time, b, c, side = crossing(POINT_TRIANGLE, start, end, now, normal, pairs.times)
            if time <= 1.0 and side >= 0:
                _plane(line, r, float(finish), f, walls, x0, x1, b, c, nx, ny, nz, tools, used, touches)
        if line.inside[r] == vessel:
            continue
        for e in range(3):
            if walls.sharp[f, e] != 2:
                continue
            gx, gy, gz = face_normal(x1, walls.triangles, walls.outwards[f, e])
            for c in range(2):
                _put(start, c, line.start, r + c)
                _put(end, c, line.x, r + c)
                _put(start, 2 + c, x0, corners[(e + c) % 3])
                _put(end, 2 + c, x1, corners[(e + c) % 3])
            time, s, w, side = crossing(EDGE_EDGE, start, end, now, normal, pairs.times)
            if not time <= 1.0 or side == 0:
                continue
            # Square to both as they are at the end, outwards: where the link came from, if it goes in.
            mx = (end[1, 1] - end[0, 1]) * (end[3, 2] - end[2, 2]) - (end[1, 2] - end[0, 2]) * (end[3, 1] - end[2, 1])
            my = (end[1, 2] - end[0, 2]) * (end[3, 0] - end[2, 0]) - (end[1, 0] - end[0, 0]) * (end[3, 2] - end[2, 2])
            mz = (end[1, 0] - end[0, 0]) * (end[3, 1] - end[2, 1]) - (end[1, 1] - end[0, 1]) * (end[3, 0] - end[2, 0])
            size = math.sqrt(mx * mx + my * my + mz * mz)
            if size < TOGETHER_MM:
                continue
            if mx * (nx + gx) + my * (ny + gy) + mz * (nz + gz) <= 0.0:
                size = -size
            gap = 0.0
            for d in range(3):
                way = _between(line.x, r, s, d) - (1.0 - w) * end[2, d] - w * end[3, d]
                gap += (mx if d == 0 else (my if d == 1 else mz)) / size * way
            if gap < 0.0:
                wb, wc = (w, 0.0) if e == 0 else ((1.0 - w, w) if e == 1 else (0.0, 1.0 - w))
                _plane(line, r, s, f, walls, x0, x1, wb, wc, mx / size, my / size, mz / size, tools, used, touches)
