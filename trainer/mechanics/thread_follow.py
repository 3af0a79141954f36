"""Follow-the-leader along a piece of thread: the kernels behind ``thread.follow``.

Source: Brown, Montgomery, Latombe, Stephanides 2001, "A Microsurgery Simulation System", section 4. The
average of the two one-sided passes shortens links; ``thread_closure`` restores their lengths.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.thread_closure import close_directions, fold_directions, link_length, perpendicular

SNAP = 1e-10  # links: a node nearer than this to a constraint's arc, or a span nearer to taut, is exactly so
FOLD_NODES = 3  # a span with fewer interior nodes may have no way to close, and takes up its slack in a fold


@njit(cache=True, nogil=True, error_model="numpy")
def one_sided(
    x: Array, start: int, stop: int, step: int, px: float, py: float, pz: float, first: float, link: float, out: Array
) -> None:
    """The paper's rule from a leader at p along nodes ``start``, ``start + step``, ... before ``stop``.

    Each node goes to its distance from its leader's new place, along the line to its own old place. A
    node that its leader has landed upon keeps the direction of its predecessor (+x for the first one).
    """
    ux, uy, uz = 1.0, 0.0, 0.0
    length = first
    for i in range(start, stop, step):
        dx, dy, dz = x[i, 0] - px, x[i, 1] - py, x[i, 2] - pz
        size = math.sqrt(dx * dx + dy * dy + dz * dz)
        if size > 1e-12 * link:
            ux, uy, uz = dx / size, dy / size, dz / size
        px, py, pz = px + length * ux, py + length * uy, pz + length * uz
        out[i, 0], out[i, 1], out[i, 2] = px, py, pz
        length = link


@njit(cache=True, nogil=True, error_model="numpy")
def follow_between(
    x: Array,
    start: int,
    stop: int,
    first: float,
    link: float,
    last: float,
    a: Array,
    b: Array,
    ka: int,
    kb: int,
    ahead: Array,
    back: Array,
    u: Array,
) -> float:
    """Nodes ``start`` .. ``stop - 1`` between the points a[ka] and b[kb]; returns the thread that is lacking, mm.

    ``first`` and ``last`` are the arcs from the points to their nearest nodes. ``ahead``, ``back`` and ``u``
    are working space of the shape of x plus one row.
    """
    nodes = stop - start
    dx, dy, dz = b[kb, 0] - a[ka, 0], b[kb, 1] - a[ka, 1], b[kb, 2] - a[ka, 2]
    chord = math.sqrt(dx * dx + dy * dy + dz * dz)
    if nodes == 0:
        return chord - first if chord - first > 10.0 * SNAP * link else 0.0
    links = nodes + 1
    total = first + last + (links - 2) * link
    if chord >= total - SNAP * min(link, total):
        for i in range(start, stop):
            part = (first + (i - start) * link) / total
            x[i, 0], x[i, 1], x[i, 2] = a[ka, 0] + part * dx, a[ka, 1] + part * dy, a[ka, 2] + part * dz
        return chord - total if chord - total > 10.0 * SNAP * link else 0.0

    one_sided(x, start, stop, 1, a[ka, 0], a[ka, 1], a[ka, 2], first, link, ahead)
    one_sided(x, stop - 1, start - 1, -1, b[kb, 0], b[kb, 1], b[kb, 2], last, link, back)
    px, py, pz = a[ka, 0], a[ka, 1], a[ka, 2]
    for j in range(links):
        i = start + j
        if j < nodes:
            qx = 0.5 * (ahead[i, 0] + back[i, 0])
            qy = 0.5 * (ahead[i, 1] + back[i, 1])
            qz = 0.5 * (ahead[i, 2] + back[i, 2])
        else:
            qx, qy, qz = b[kb, 0], b[kb, 1], b[kb, 2]
        ux, uy, uz = qx - px, qy - py, qz - pz
        size = math.sqrt(ux * ux + uy * uy + uz * uz)
        if size > 1e-9 * link_length(j, links, first, link, last):
            ux, uy, uz = ux / size, uy / size, uz / size
        elif j > 0:
            ux, uy, uz = u[j - 1, 0], u[j - 1, 1], u[j - 1, 2]
        else:
            ux, uy, uz = perpendicular(dx, dy, dz)
        u[j, 0], u[j, 1], u[j, 2] = ux, uy, uz
        px, py, pz = qx, qy, qz

    if nodes < FOLD_NODES:
        split = fold_directions(u, ahead, links, first, link, last, dx, dy, dz)
    else:
        split = links - 1  # the link that takes up the rounding
        close_directions(u, ahead, links, first, link, last, dx, dy, dz)
    px, py, pz = a[ka, 0], a[ka, 1], a[ka, 2]
    for j in range(split):
        length = link_length(j, links, first, link, last)
        px, py, pz = px + length * u[j, 0], py + length * u[j, 1], pz + length * u[j, 2]
        x[start + j, 0], x[start + j, 1], x[start + j, 2] = px, py, pz
    px, py, pz = b[kb, 0], b[kb, 1], b[kb, 2]
    for j in range(links - 1, split, -1):
        length = link_length(j, links, first, link, last)
        px, py, pz = px - length * u[j, 0], py - length * u[j, 1], pz - length * u[j, 2]
        x[start + j - 1, 0], x[start + j - 1, 1], x[start + j - 1, 2] = px, py, pz
    return 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def follow_kernel(
    x: Array,
    origin: float,
    link: float,
    pieces: Array,
    arcs: Array,
    points: Array,
    shortage: Array,
    ahead: Array,
    back: Array,
    u: Array,
) -> None:
    """``thread.follow`` on plain arrays: each piece from constraint to constraint, then out to its free ends."""
    shortage[:] = 0.0
    for p in range(pieces.shape[0]):
        i0 = round((pieces[p, 0] - origin) / link)
        i1 = round((pieces[p, 1] - origin) / link)
        previous = -1
        t_previous = 0.0
        for k in range(arcs.shape[0]):
            t = (arcs[k] - origin) / link
            if t < i0 - SNAP or t > i1 + SNAP:
                continue
            stop = math.ceil(t - SNAP)
            if previous < 0:
                one_sided(
                    x, stop - 1, i0 - 1, -1, points[k, 0], points[k, 1], points[k, 2], (t - stop + 1) * link, link, x
                )
            else:
                start = math.floor(t_previous + SNAP) + 1
                if stop > start:
                    shortage[previous] = follow_between(
                        x,
                        start,
                        stop,
                        (start - t_previous) * link,
                        link,
                        (t - stop + 1) * link,
                        points,
                        points,
                        previous,
                        k,
                        ahead,
                        back,
                        u,
                    )
                else:
                    shortage[previous] = follow_between(
                        x, start, start, (t - t_previous) * link, link, 0.0, points, points, previous, k, ahead, back, u
                    )
            nearest = int(np.rint(t))
            if abs(t - nearest) <= SNAP:
                x[nearest, 0], x[nearest, 1], x[nearest, 2] = points[k, 0], points[k, 1], points[k, 2]
            previous = k
            t_previous = t
        if previous >= 0:
            start = math.floor(t_previous + SNAP) + 1
            one_sided(
                x,
                start,
                i1 + 1,
                1,
                points[previous, 0],
                points[previous, 1],
                points[previous, 2],
                (start - t_previous) * link,
                link,
                x,
            )
