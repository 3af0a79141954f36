"""The instant at which a moving point goes through a moving surface."""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.geometry import Array

# A crossing on the common edge of two triangles must belong to at least one of them: weights may be
# negative by this much, which on a triangle of 0.1 mm is a tenth of a nanometre.
EDGE_TOLERANCE = 1e-6
# Boxes this far apart are still compared (mm), so that rounding opens no gap between two triangles.
NEAR_MM = 1e-6
# Halvings of the tick in the search for the crossing: 2**-50 of a 10 ms tick is far below rounding.
HALVINGS = 50


@njit(cache=True, nogil=True, error_model="numpy")
def _side(px, py, pz, ax, ay, az, bx, by, bz, cx, cy, cz):  # type: ignore[no-untyped-def]
    """Six times the signed volume of (a, b, c, p): positive where p is on the side of the normal."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    return (uy * vz - uz * vy) * (px - ax) + (uz * vx - ux * vz) * (py - ay) + (ux * vy - uy * vx) * (pz - az)


@njit(cache=True, nogil=True, error_model="numpy")
def side(p: Array, x: Array, nodes: np.ndarray) -> float:
    """Positive where the point ``p`` (3,) is on the side of the normal of the triangle of ``nodes`` (3,) of ``x``."""
    a, b, c = x[nodes[0]], x[nodes[1]], x[nodes[2]]
    return float(_side(p[0], p[1], p[2], a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]))


@njit(cache=True, nogil=True, error_model="numpy")
def _first(p0, p1, x0, x1, triangles, skip, weights):  # type: ignore[no-untyped-def]
    best = 2.0
    hit = -1
    inward = False
    for f in range(triangles.shape[0]):
        if skip[f]:
            continue
        i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        apart = False
        for d in range(3):
            low = min(p0[d], p1[d])
            high = max(p0[d], p1[d])
            tl = min(min(min(x0[i, d], x1[i, d]), min(x0[j, d], x1[j, d])), min(x0[k, d], x1[k, d]))
            th = max(max(max(x0[i, d], x1[i, d]), max(x0[j, d], x1[j, d])), max(x0[k, d], x1[k, d]))
            if high < tl - NEAR_MM or low > th + NEAR_MM:
                apart = True
                break
        if apart:
            continue
        s0 = _side(
            p0[0], p0[1], p0[2], x0[i, 0], x0[i, 1], x0[i, 2],
            x0[j, 0], x0[j, 1], x0[j, 2], x0[k, 0], x0[k, 1], x0[k, 2],
        )  # fmt: skip
        s1 = _side(
            p1[0], p1[1], p1[2], x1[i, 0], x1[i, 1], x1[i, 2],
            x1[j, 0], x1[j, 1], x1[j, 2], x1[k, 0], x1[k, 1], x1[k, 2],
        )  # fmt: skip
        if (s0 > 0.0) == (s1 > 0.0):
            continue
        low_t, high_t = 0.0, 1.0
        for _ in range(HALVINGS):
            t = 0.5 * (low_t + high_t)
            u = 1.0 - t
            s = _side(
                u * p0[0] + t * p1[0], u * p0[1] + t * p1[1], u * p0[2] + t * p1[2],
                u * x0[i, 0] + t * x1[i, 0], u * x0[i, 1] + t * x1[i, 1], u * x0[i, 2] + t * x1[i, 2],
                u * x0[j, 0] + t * x1[j, 0], u * x0[j, 1] + t * x1[j, 1], u * x0[j, 2] + t * x1[j, 2],
                u * x0[k, 0] + t * x1[k, 0], u * x0[k, 1] + t * x1[k, 1], u * x0[k, 2] + t * x1[k, 2],
            )  # fmt: skip
            if (s > 0.0) == (s0 > 0.0):
                low_t = t
            else:
                high_t = t
        t = high_t
        if t >= best:
            continue
        u = 1.0 - t
        ax, ay, az = u * x0[i, 0] + t * x1[i, 0], u * x0[i, 1] + t * x1[i, 1], u * x0[i, 2] + t * x1[i, 2]
        bx, by, bz = u * x0[j, 0] + t * x1[j, 0], u * x0[j, 1] + t * x1[j, 1], u * x0[j, 2] + t * x1[j, 2]
        cx, cy, cz = u * x0[k, 0] + t * x1[k, 0], u * x0[k, 1] + t * x1[k, 1], u * x0[k, 2] + t * x1[k, 2]
        ux, uy, uz = bx - ax, by - ay, bz - az
        vx, vy, vz = cx - ax, cy - ay, cz - az
        wx = u * p0[0] + t * p1[0] - ax
        wy = u * p0[1] + t * p1[1] - ay
        wz = u * p0[2] + t * p1[2] - az
        uu = ux * ux + uy * uy + uz * uz
        uv = ux * vx + uy * vy + uz * vz
        vv = vx * vx + vy * vy + vz * vz
        wu = wx * ux + wy * uy + wz * uz
        wv = wx * vx + wy * vy + wz * vz
        det = uu * vv - uv * uv
        if det <= 0.0:  # a triangle collapsed to a line has no inside
            continue
        wb = (vv * wu - uv * wv) / det
        wc = (uu * wv - uv * wu) / det
        wa = 1.0 - wb - wc
        if wa < -EDGE_TOLERANCE or wb < -EDGE_TOLERANCE or wc < -EDGE_TOLERANCE:
            continue
        best = t
        hit = f
        inward = s0 > 0.0
        weights[0], weights[1], weights[2] = wa, wb, wc
    return hit, best, inward


def first_crossing(
    p0: Array, p1: Array, x0: Array, x1: Array, triangles: np.ndarray, skip: np.ndarray
) -> tuple[int, float, bool, Array] | None:
    """The first triangle that a point goes through while everything moves in straight lines.

    Args: the point ``p0`` → ``p1`` (3,) mm; the nodes ``x0`` → ``x1`` (n, 3) mm; ``triangles`` (f, 3) int32 with
    the normal by the right-hand rule; ``skip`` (f,) bool. Returns (triangle, fraction of the motion 0..1, whether the
    point went against the normal, weights (3,) of the triangle's nodes), or None. A touch that does not end on the
    other side is no crossing. The instant is found by bisection of the signed volume of the four moving points.
    """
    weights = np.zeros(3)
    hit, fraction, inward = _first(p0, p1, x0, x1, triangles, skip, weights)
    return None if hit < 0 else (int(hit), float(fraction), bool(inward), weights)


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(p, x, triangles, weights):  # type: ignore[no-untyped-def]
    best = np.inf
    hit = -1
    for f in range(triangles.shape[0]):
        i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        ux, uy, uz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        vx, vy, vz = x[k, 0] - x[i, 0], x[k, 1] - x[i, 1], x[k, 2] - x[i, 2]
        wx, wy, wz = p[0] - x[i, 0], p[1] - x[i, 1], p[2] - x[i, 2]
        uu = ux * ux + uy * uy + uz * uz
        uv = ux * vx + uy * vy + uz * vz
        vv = vx * vx + vy * vy + vz * vz
        wu = wx * ux + wy * uy + wz * uz
        wv = wx * vx + wy * vy + wz * vz
        det = uu * vv - uv * uv
        b, c = -1.0, -1.0
        if det > 0.0:
            b = (vv * wu - uv * wv) / det
            c = (uu * wv - uv * wu) / det
        if b < 0.0 or c < 0.0 or b + c > 1.0:  # the nearest point lies on an edge
            lowest = np.inf
            for edge in range(3):
                if edge == 0:
                    s = min(max(wu / uu, 0.0), 1.0) if uu > 0.0 else 0.0
                    eb, ec = s, 0.0
                elif edge == 1:
                    s = min(max(wv / vv, 0.0), 1.0) if vv > 0.0 else 0.0
                    eb, ec = 0.0, s
                else:
                    span = uu - 2.0 * uv + vv
                    s = min(max((wv - wu + uu - uv) / span, 0.0), 1.0) if span > 0.0 else 0.0
                    eb, ec = 1.0 - s, s
                dx, dy, dz = wx - eb * ux - ec * vx, wy - eb * uy - ec * vy, wz - eb * uz - ec * vz
                d = dx * dx + dy * dy + dz * dz
                if d < lowest:
                    lowest, b, c = d, eb, ec
        dx, dy, dz = wx - b * ux - c * vx, wy - b * uy - c * vy, wz - b * uz - c * vz
        d = dx * dx + dy * dy + dz * dz
        if d < best:
            best = d
            hit = f
            weights[0], weights[1], weights[2] = 1.0 - b - c, b, c
    return hit, best


def nearest_on_surface(p: Array, x: Array, triangles: np.ndarray) -> tuple[int, Array]:
    """The triangle of ``triangles`` (f, 3) nearest to the point ``p`` (3,) mm, and its nodes' weights (3,) there."""
    weights = np.zeros(3)
    hit, _ = _nearest(p, x, triangles, weights)
    return int(hit), weights
