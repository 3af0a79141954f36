"""Where a rod may touch in a tick: triangles of a mesh, and the rod itself.

Each finder takes candidate pairs (k, 2) int32 from a search and writes a row of ``Contacts`` for every pair that is
nearer than ``margin``: the nearest points, the normal between them, and how the obstacle moves. In the step the link's
point then stays on its side of the plane through the obstacle's point, so that it cannot pass through however fast it
is, if only ``margin`` is as far as the two can approach in a tick.
``thread_rod_newton`` solves contacts and Coulomb friction together with lengths and bending.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.closest_points import point_triangle, segment_segment
from trainer.mechanics.thread_rod_newton import Contacts

INTERIOR = 1e-9  # of a link: nearest points this close to its ends are its ends


def clear(contacts: Contacts) -> None:
    """No contact is in use any more."""
    contacts.used[0] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _add(
    contacts: Contacts, link: int, other: int, s: float, r: float, nx: float, ny: float, nz: float, offset: float,
    mx: float, my: float, mz: float, friction: float,
) -> bool:  # fmt: skip
    k = contacts.used[0]
    if k == len(contacts.link):
        return False
    contacts.used[0] = k + 1
    contacts.link[k], contacts.other[k] = link, other
    contacts.place[k, 0], contacts.place[k, 1] = s, r
    contacts.normal[k, 0], contacts.normal[k, 1], contacts.normal[k, 2] = nx, ny, nz
    contacts.offset[k] = offset
    contacts.move[k, 0], contacts.move[k, 1], contacts.move[k, 2] = mx, my, mz
    contacts.friction[k] = friction
    contacts.push[k] = 0.0
    contacts.grip[k, 0] = contacts.grip[k, 1] = contacts.grip[k, 2] = 0.0
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _normal(
    px: float, py: float, pz: float, ax: float, ay: float, az: float, bx: float, by: float, bz: float
) -> tuple[float, float, float, float]:
    """Unit vector of p and its length; of a x b, or +z at worst, where p is zero: two axes that cross."""
    size = math.sqrt(px * px + py * py + pz * pz)
    if size > 1e-12:
        return px / size, py / size, pz / size, size
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    across = math.sqrt(cx * cx + cy * cy + cz * cz)
    if across > 1e-12:
        return cx / across, cy / across, cz / across, 0.0
    return 0.0, 0.0, 1.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _triangle_point(
    contacts: Contacts, x: Array, i: int, s: float, radius: float, v: Array, v_end: Array, a: int, b: int, c: int,
    wa: float, wb: float, wc: float, side: float, fx: float, fy: float, fz: float, friction: float,
) -> bool:  # fmt: skip
    """A contact of the point ``s`` of link ``i`` with the triangle's point of weights w.

    ``side`` of the triangle's normal f on which it has to be, or 0 for where it is.
    """
    qx = wa * v[a, 0] + wb * v[b, 0] + wc * v[c, 0]
    qy = wa * v[a, 1] + wb * v[b, 1] + wc * v[c, 1]
    qz = wa * v[a, 2] + wb * v[b, 2] + wc * v[c, 2]
    j = i + 1 if s > 0.0 else i
    px = (1.0 - s) * x[i, 0] + s * x[j, 0] - qx
    py = (1.0 - s) * x[i, 1] + s * x[j, 1] - qy
    pz = (1.0 - s) * x[i, 2] + s * x[j, 2] - qz
    size = math.sqrt(px * px + py * py + pz * pz)
    if size > 1e-9 and side * (px * fx + py * fy + pz * fz) >= 0.0:
        nx, ny, nz = px / size, py / size, pz / size
    else:
        way = -1.0 if side < 0.0 else 1.0
        nx, ny, nz = way * fx, way * fy, way * fz
    return _add(
        contacts, i, -1, s, 0.0, nx, ny, nz, nx * qx + ny * qy + nz * qz + radius,
        wa * v_end[a, 0] + wb * v_end[b, 0] + wc * v_end[c, 0] - qx,
        wa * v_end[a, 1] + wb * v_end[b, 1] + wc * v_end[c, 1] - qy,
        wa * v_end[a, 2] + wb * v_end[b, 2] + wc * v_end[c, 2] - qz,
        friction,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _triangles(
    contacts: Contacts, x: Array, radius: float, v: Array, v_end: Array, corners: NDArray[np.int32],
    pairs: NDArray[np.int32], friction: float, margin: float,
) -> bool:  # fmt: skip
    near = (radius + margin) ** 2
    for k in range(len(pairs)):
        i, f = pairs[k, 0], pairs[k, 1]
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        ux, uy, uz = v[b, 0] - v[a, 0], v[b, 1] - v[a, 1], v[b, 2] - v[a, 2]
        wx, wy, wz = v[c, 0] - v[a, 0], v[c, 1] - v[a, 1], v[c, 2] - v[a, 2]
        fx, fy, fz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        size = math.sqrt(fx * fx + fy * fy + fz * fz)
        if size == 0.0:
            continue
        fx, fy, fz = fx / size, fy / size, fz / size
        # A link that is through the triangle goes back to where its middle is. One that is only through its plane, as
        # where it goes round an edge to a neighbour, is on no wrong side of it: side 0.
        start = (x[i, 0] - v[a, 0]) * fx + (x[i, 1] - v[a, 1]) * fy + (x[i, 2] - v[a, 2]) * fz
        end = (x[i + 1, 0] - v[a, 0]) * fx + (x[i + 1, 1] - v[a, 1]) * fy + (x[i + 1, 2] - v[a, 2]) * fz
        side = 0.0
        if (start < 0.0) != (end < 0.0):
            at = start / (start - end)
            squared, _, _ = point_triangle(
                x[i, 0] + at * (x[i + 1, 0] - x[i, 0]),
                x[i, 1] + at * (x[i + 1, 1] - x[i, 1]),
                x[i, 2] + at * (x[i + 1, 2] - x[i, 2]), v, a, b, c,
            )  # fmt: skip
            if squared <= INTERIOR**2 * size:
                side = 1.0 if start + end >= 0.0 else -1.0
        # Its first node (its second is the next link's first), and where its inside is nearest to an edge.
        for node in range(2 if i + 2 == len(x) else 1):
            squared, wb, wc = point_triangle(x[i + node, 0], x[i + node, 1], x[i + node, 2], v, a, b, c)
            if squared <= near and not _triangle_point(
                contacts,
                x,
                i,
                float(node),
                radius,
                v,
                v_end,
                a,
                b,
                c,
                1.0 - wb - wc,
                wb,
                wc,
                side,
                fx,
                fy,
                fz,
                friction,
            ):
                return False
        for edge in range(3):
            m, n = corners[f, edge], corners[f, (edge + 1) % 3]
            squared, s, r = segment_segment(x, i, i + 1, v, m, n)
            inside = INTERIOR < s < 1.0 - INTERIOR and INTERIOR < r < 1.0 - INTERIOR
            if squared <= near and inside and not _triangle_point(
                contacts, x, i, s, radius, v, v_end, m, n, n, 1.0 - r, r, 0.0, side, fx, fy, fz, friction
            ):  # fmt: skip
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _itself(
    contacts: Contacts, x: Array, radius: float, pairs: NDArray[np.int32], friction: float, margin: float
) -> bool:
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        if abs(i - j) < 2:
            continue  # they share a node
        squared, s, r = segment_segment(x, i, i + 1, x, j, j + 1)
        if squared > (2.0 * radius + margin) ** 2:
            continue
        nx, ny, nz, _ = _normal(
            (1.0 - s) * x[i, 0] + s * x[i + 1, 0] - (1.0 - r) * x[j, 0] - r * x[j + 1, 0],
            (1.0 - s) * x[i, 1] + s * x[i + 1, 1] - (1.0 - r) * x[j, 1] - r * x[j + 1, 1],
            (1.0 - s) * x[i, 2] + s * x[i + 1, 2] - (1.0 - r) * x[j, 2] - r * x[j + 1, 2],
            x[i + 1, 0] - x[i, 0], x[i + 1, 1] - x[i, 1], x[i + 1, 2] - x[i, 2],
            x[j + 1, 0] - x[j, 0], x[j + 1, 1] - x[j, 1], x[j + 1, 2] - x[j, 2],
        )  # fmt: skip
        if not _add(contacts, i, j, s, r, nx, ny, nz, 2.0 * radius, 0.0, 0.0, 0.0, friction):
            return False
    return True


class ContactsFull(ValueError):
    """More places touch than there is room for."""


def _kept(fits: bool, contacts: Contacts) -> None:
    if not fits:
        raise ContactsFull(f"more than {len(contacts.link)} contacts of the thread: give no_contacts() more room")


def touch_triangles(
    contacts: Contacts, x: Array, radius: float, vertices: Array, vertices_end: Array, triangles: NDArray[np.int32],
    pairs: NDArray[np.int32], friction: float, margin: float,
) -> None:  # fmt: skip
    """Add contacts of links with triangles: ``pairs`` (k, 2) of link and row of ``triangles`` (m, 3).

    ``vertices`` and ``vertices_end`` (v, 3) mm at the tick's start and end. The thread stays on its side of a triangle;
    a triangle without area is left out. Raises ContactsFull.
    """
    _kept(_triangles(contacts, x, radius, vertices, vertices_end, triangles, pairs, friction, margin), contacts)


def touch_itself(
    contacts: Contacts, x: Array, radius: float, pairs: NDArray[np.int32], friction: float, margin: float
) -> None:
    """Add contacts of links with links: ``pairs`` (k, 2), each once; neighbours are left out. Raises ContactsFull."""
    _kept(_itself(contacts, x, radius, pairs, friction, margin), contacts)
