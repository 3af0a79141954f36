"""Nearest points of points, segments and triangles, also where these have no length or no area.

Every distance here is that of two points which lie on the two bodies, so rounding can make it a little too large on a
sliver, but never too small: a weight that came out wrong names another point of the same body. All kernels take nodes
as rows of arrays (n, 3) mm, finite and below ``LARGEST_MM``, and return squared distances, mm².

Both tests are the minimum of a quadratic over a triangle of weights or a square: Eberly 1999, "Distance between point
and triangle in 3D"; Ericson 2004, "Real-Time Collision Detection", 5.1.
"""

from __future__ import annotations

import math

from numba import njit

#: A coordinate may not be larger, mm: fourth powers of it are taken.
LARGEST_MM = 1e9
# Below this square of the sine between two directions, ends and edges are compared as well: the inner minimum has
# lost half of its digits there.
FLAT = 1e-6


@njit(cache=True, nogil=True, error_model="numpy")
def point_segment(px, py, pz, x, i, j):  # type: ignore[no-untyped-def]
    """Squared distance of a point to the segment of rows i and j of ``x``, and the weight 0..1 of row j."""
    dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    wx, wy, wz = px - x[i, 0], py - x[i, 1], pz - x[i, 2]
    dd = dx * dx + dy * dy + dz * dz
    wd = wx * dx + wy * dy + wz * dz
    t = 0.0
    if wd > 0.0:
        t = wd / dd if wd < dd else 1.0
    rx, ry, rz = wx - t * dx, wy - t * dy, wz - t * dz
    return rx * rx + ry * ry + rz * rz, t


@njit(cache=True, nogil=True, error_model="numpy")
def point_triangle(px, py, pz, x, i, j, k):  # type: ignore[no-untyped-def]
    """Squared distance of a point to the triangle of rows i, j, k of ``x``, and the weights of rows j and k."""
    ux, uy, uz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    vx, vy, vz = x[k, 0] - x[i, 0], x[k, 1] - x[i, 1], x[k, 2] - x[i, 2]
    wx, wy, wz = px - x[i, 0], py - x[i, 1], pz - x[i, 2]
    uu = ux * ux + uy * uy + uz * uz
    uv = ux * vx + uy * vy + uz * vz
    vv = vx * vx + vy * vy + vz * vz
    wu = wx * ux + wy * uy + wz * uz
    wv = wx * vx + wy * vy + wz * vz
    best, b, c = -1.0, 0.0, 0.0
    det = uu * vv - uv * uv
    if det > 0.0:
        sb = vv * wu - uv * wv
        sc = uu * wv - uv * wu
        if sb >= 0.0 and sc >= 0.0 and sb + sc <= det:  # the foot lies inside
            b, c = sb / det, sc / det
            rx, ry, rz = wx - b * ux - c * vx, wy - b * uy - c * vy, wz - b * uz - c * vz
            best = rx * rx + ry * ry + rz * rz
            if det > FLAT * uu * vv:
                return best, b, c
    d, t = point_segment(px, py, pz, x, i, j)
    if best < 0.0 or d < best:
        best, b, c = d, t, 0.0
    d, t = point_segment(px, py, pz, x, i, k)
    if d < best:
        best, b, c = d, 0.0, t
    d, t = point_segment(px, py, pz, x, j, k)
    if d < best:
        best, b, c = d, 1.0 - t, t
    return best, b, c


@njit(cache=True, nogil=True, error_model="numpy")
def segment_segment(p, i, j, q, k, l):  # type: ignore[no-untyped-def]  # noqa: E741
    """Squared distance of the segments of rows i, j of ``p`` and k, l of ``q``; the weights of rows j and l."""
    ux, uy, uz = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    vx, vy, vz = q[l, 0] - q[k, 0], q[l, 1] - q[k, 1], q[l, 2] - q[k, 2]
    wx, wy, wz = p[i, 0] - q[k, 0], p[i, 1] - q[k, 1], p[i, 2] - q[k, 2]
    uu = ux * ux + uy * uy + uz * uz
    uv = ux * vx + uy * vy + uz * vz
    vv = vx * vx + vy * vy + vz * vz
    wu = wx * ux + wy * uy + wz * uz
    wv = wx * vx + wy * vy + wz * vz
    det = uu * vv - uv * uv
    best, s, t = -1.0, 0.0, 0.0
    if det > 0.0:
        s = (uv * wv - vv * wu) / det
        s = 0.0 if s < 0.0 else (1.0 if s > 1.0 else s)
        t = (uv * s + wv) / vv
        if t < 0.0 or t > 1.0:
            t = 0.0 if t < 0.0 else 1.0
            s = (uv * t - wu) / uu
            s = 0.0 if s < 0.0 else (1.0 if s > 1.0 else s)
        rx, ry, rz = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
        best = rx * rx + ry * ry + rz * rz
        if det > FLAT * uu * vv:
            return best, s, t
    d, w = point_segment(p[i, 0], p[i, 1], p[i, 2], q, k, l)
    if best < 0.0 or d < best:
        best, s, t = d, 0.0, w
    d, w = point_segment(p[j, 0], p[j, 1], p[j, 2], q, k, l)
    if d < best:
        best, s, t = d, 1.0, w
    d, w = point_segment(q[k, 0], q[k, 1], q[k, 2], p, i, j)
    if d < best:
        best, s, t = d, w, 0.0
    d, w = point_segment(q[l, 0], q[l, 1], q[l, 2], p, i, j)
    if d < best:
        best, s, t = d, w, 1.0
    return best, s, t


@njit(cache=True, nogil=True, error_model="numpy")
def segment_near_triangle(p, i, j, x, a, b, c, margin):  # type: ignore[no-untyped-def]
    """Whether the segment of rows i, j of ``p`` comes within ``margin`` mm of the triangle of rows a, b, c of ``x``.

    The distance is attained at an end of the segment, at an edge of the triangle, or it is zero where the segment goes
    through the triangle's plane; the point there is compared like any other, so a collapsed triangle needs no case.
    """
    # The middle of the triangle and the sphere around it decide most pairs.
    mx = (x[a, 0] + x[b, 0] + x[c, 0]) * (1.0 / 3.0)
    my = (x[a, 1] + x[b, 1] + x[c, 1]) * (1.0 / 3.0)
    mz = (x[a, 2] + x[b, 2] + x[c, 2]) * (1.0 / 3.0)
    ra = (x[a, 0] - mx) ** 2 + (x[a, 1] - my) ** 2 + (x[a, 2] - mz) ** 2
    rb = (x[b, 0] - mx) ** 2 + (x[b, 1] - my) ** 2 + (x[b, 2] - mz) ** 2
    rc = (x[c, 0] - mx) ** 2 + (x[c, 1] - my) ** 2 + (x[c, 2] - mz) ** 2
    reach = (margin + math.sqrt(max(max(ra, rb), rc))) * (1.0 + 1e-6)
    d, _ = point_segment(mx, my, mz, p, i, j)
    if d > reach * reach:
        return False
    within = margin * margin
    if d <= within:
        return True
    ux, uy, uz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    vx, vy, vz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    nn = nx * nx + ny * ny + nz * nz
    h0 = (p[i, 0] - x[a, 0]) * nx + (p[i, 1] - x[a, 1]) * ny + (p[i, 2] - x[a, 2]) * nz
    h1 = (p[j, 0] - x[a, 0]) * nx + (p[j, 1] - x[a, 1]) * ny + (p[j, 2] - x[a, 2]) * nz
    if (h0 > 0.0) == (h1 > 0.0):
        # Both ends on one side: the nearer end's height over the plane is a lower bound. The normal of a sliver is
        # too uncertain to say so.
        lowest = h0 * h0 if h0 * h0 < h1 * h1 else h1 * h1
        uu = ux * ux + uy * uy + uz * uz
        vv = vx * vx + vy * vy + vz * vz
        if lowest > (1.0 + 1e-6) * within * nn and nn > FLAT * uu * vv:
            return False
    else:
        t = h0 / (h0 - h1)
        s = 1.0 - t
        d, _, _ = point_triangle(
            s * p[i, 0] + t * p[j, 0], s * p[i, 1] + t * p[j, 1], s * p[i, 2] + t * p[j, 2], x, a, b, c
        )
        if d <= within:
            return True
    d, _, _ = point_triangle(p[i, 0], p[i, 1], p[i, 2], x, a, b, c)
    if d <= within:
        return True
    d, _, _ = point_triangle(p[j, 0], p[j, 1], p[j, 2], x, a, b, c)
    if d <= within:
        return True
    d, _, _ = segment_segment(p, i, j, x, a, b)
    if d <= within:
        return True
    d, _, _ = segment_segment(p, i, j, x, b, c)
    if d <= within:
        return True
    d, _, _ = segment_segment(p, i, j, x, c, a)
    return d <= within
