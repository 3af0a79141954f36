"""Follow-the-leader between constraints, closed exactly: the kernels behind ``thread.follow``.

Source: Brown, Montgomery, Latombe, Stephanides 2001, "A Microsurgery Simulation System", section 4.

The average of the two one-sided passes shortens links. The exact closure here works on link
*directions*: with unit vectors u_j and lengths l_j a span closes when sum l_j u_j = B - A. The least
rotation that removes a small gap r is u_j + m, normalised, with one vector m for the whole span,
H m = r and H = sum l_j (I - u_j u_j^T), a 3 x 3 system. Lengths hold by construction in every iteration;
only the gap is driven to zero. (Least in the sum of l_j |du_j|^2: its Lagrange multiplier is m.)
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array

SNAP = 1e-10  # links: a node nearer than this to a constraint's arc, or a span nearer to taut, is exactly so
CLOSED = 1e-11  # links: a gap at which a span counts as closed
MOST_STEPS = 80  # tautening halves the sag in two steps: 0.5 rad to the 1e-5 rad of SNAP takes about 30
LARGEST_TURN = 0.5  # of a unit vector: keeps u + m away from zero
FOLD_NODES = 3  # from three interior nodes on, no chord is too short for the links to close


@njit(cache=True, nogil=True, error_model="numpy")
def perpendicular(dx: float, dy: float, dz: float) -> tuple[float, float, float]:
    """Some unit vector at a right angle to (dx, dy, dz), the same one every time; +x for a zero vector."""
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    if ax <= ay and ax <= az:
        px, py, pz = 0.0, -dz, dy
    elif ay <= az:
        px, py, pz = dz, 0.0, -dx
    else:
        px, py, pz = -dy, dx, 0.0
    size = math.sqrt(px * px + py * py + pz * pz)
    if size == 0.0:
        return 1.0, 0.0, 0.0
    return px / size, py / size, pz / size


@njit(cache=True, nogil=True, error_model="numpy")
def link_length(j: int, links: int, first: float, link: float, last: float) -> float:
    """Length of link ``j`` of a span: a part of a link at either end, whole ones between."""
    if j == 0:
        return first
    return last if j == links - 1 else link


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
def turned(
    u: Array, links: int, first: float, link: float, last: float, mx: float, my: float, mz: float, out: Array
) -> tuple[float, float, float]:
    """Directions u + m, normalised, into ``out``; returns the sum of l_j out_j."""
    sx = sy = sz = 0.0
    for j in range(links):
        ax, ay, az = u[j, 0] + mx, u[j, 1] + my, u[j, 2] + mz
        inverse = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax * inverse, ay * inverse, az * inverse
        out[j, 0], out[j, 1], out[j, 2] = ax, ay, az
        length = link_length(j, links, first, link, last)
        sx += length * ax
        sy += length * ay
        sz += length * az
    return sx, sy, sz


@njit(cache=True, nogil=True, error_model="numpy")
def bend_into_arc(
    u: Array, links: int, first: float, link: float, last: float, total: float, dx: float, dy: float, dz: float
) -> None:
    """Give the links the directions of a circular arc with chord d and length ``total``.

    The arc bulges to the side to which the links already lean (their first moment along the span); if
    they lean nowhere, to an arbitrary fixed side.
    """
    chord = math.sqrt(dx * dx + dy * dy + dz * dz)
    if chord > 1e-12 * total:
        ex, ey, ez = dx / chord, dy / chord, dz / chord
    else:
        ex, ey, ez = u[0, 0], u[0, 1], u[0, 2]
    nx = ny = nz = 0.0
    passed = 0.0
    for j in range(links):
        length = link_length(j, links, first, link, last)
        weight = length * (total - 2.0 * passed - length)
        nx += weight * u[j, 0]
        ny += weight * u[j, 1]
        nz += weight * u[j, 2]
        passed += length
    along = nx * ex + ny * ey + nz * ez
    nx, ny, nz = nx - along * ex, ny - along * ey, nz - along * ez
    lean = math.sqrt(nx * nx + ny * ny + nz * nz)
    if lean > 1e-9 * total * total:
        nx, ny, nz = nx / lean, ny / lean, nz / lean
    else:
        nx, ny, nz = perpendicular(ex, ey, ez)
    # sin(a) / a = chord / length: Newton from the small-angle root, on a concave function.
    ratio = min(chord / total, 1.0)
    angle = min(math.sqrt(max(6.0 * (1.0 - ratio), 1e-20)), math.pi)
    for _ in range(20):
        slope = math.cos(angle) - ratio
        if slope >= -1e-14:
            break
        angle = min(max(angle - (math.sin(angle) - ratio * angle) / slope, 1e-10), math.pi)
    passed = 0.0
    for j in range(links):
        length = link_length(j, links, first, link, last)
        a = angle * (1.0 - (2.0 * passed + length) / total)
        c, s = math.cos(a), math.sin(a)
        u[j, 0], u[j, 1], u[j, 2] = c * ex + s * nx, c * ey + s * ny, c * ez + s * nz
        passed += length


@njit(cache=True, nogil=True, error_model="numpy")
def close_directions(
    u: Array, trial: Array, links: int, first: float, link: float, last: float, dx: float, dy: float, dz: float
) -> bool:
    """Turn the unit vectors ``u`` (links, 3) so that their weighted sum is d; True when the gap is closed.

    Newton steps on the 3 x 3 system of this module's head, with a limited turn and a line search on the
    gap. Where every link lies along the gap and has to give way (a straight thread pushed together), no
    turn helps to first order: such a span buckles into a circular arc, once.
    """
    total = 0.0
    for j in range(links):
        total += link_length(j, links, first, link, last)
    sx, sy, sz = turned(u, links, first, link, last, 0.0, 0.0, 0.0, u)
    buckled = False
    for step in range(2 * MOST_STEPS):
        rx, ry, rz = dx - sx, dy - sy, dz - sz
        gap2 = rx * rx + ry * ry + rz * rz
        if gap2 <= (CLOSED * link) ** 2:
            return True
        hxx = hxy = hxz = hyy = hyz = hzz = 0.0
        for j in range(links):
            length = link_length(j, links, first, link, last)
            ax, ay, az = u[j, 0], u[j, 1], u[j, 2]
            hxx += length * (ay * ay + az * az)
            hyy += length * (ax * ax + az * az)
            hzz += length * (ax * ax + ay * ay)
            hxy -= length * ax * ay
            hxz -= length * ax * az
            hyz -= length * ay * az
        # mean square sine of the angle between the links and the gap
        sine2 = (
            hxx * rx * rx + hyy * ry * ry + hzz * rz * rz + 2.0 * (hxy * rx * ry + hxz * rx * rz + hyz * ry * rz)
        ) / (gap2 * total)
        pushed = sx * rx + sy * ry + sz * rz < 0.0
        if not buckled and ((pushed and sine2 < 1e-6) or sine2 < 1e-12 or step == MOST_STEPS):
            buckled = True
            bend_into_arc(u, links, first, link, last, total, dx, dy, dz)
            sx, sy, sz = turned(u, links, first, link, last, 0.0, 0.0, 0.0, u)
            continue
        shift = 1e-14 * total
        hxx, hyy, hzz = hxx + shift, hyy + shift, hzz + shift
        cxx, cxy, cxz = hyy * hzz - hyz * hyz, hxz * hyz - hxy * hzz, hxy * hyz - hxz * hyy
        cyy, cyz, czz = hxx * hzz - hxz * hxz, hxy * hxz - hxx * hyz, hxx * hyy - hxy * hxy
        inverse = 1.0 / (hxx * cxx + hxy * cxy + hxz * cxz)
        mx = (cxx * rx + cxy * ry + cxz * rz) * inverse
        my = (cxy * rx + cyy * ry + cyz * rz) * inverse
        mz = (cxz * rx + cyz * ry + czz * rz) * inverse
        turn = math.sqrt(mx * mx + my * my + mz * mz)
        scale = min(1.0, LARGEST_TURN / turn)
        for _ in range(12):
            sx, sy, sz = turned(u, links, first, link, last, scale * mx, scale * my, scale * mz, trial)
            if (dx - sx) ** 2 + (dy - sy) ** 2 + (dz - sz) ** 2 < gap2:
                break
            scale *= 0.5
        for j in range(links):
            u[j, 0], u[j, 1], u[j, 2] = trial[j, 0], trial[j, 1], trial[j, 2]
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def follow_between(
    x: Array, start: int, stop: int, first: float, link: float, last: float, a: Array, b: Array, ka: int, kb: int,
    ahead: Array, back: Array, u: Array,
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

    split = links - 1  # the link that takes up what is left: closed, so any will do
    folded = False
    if nodes < FOLD_NODES:
        longest = 0
        for j in range(1, links):
            if link_length(j, links, first, link, last) > link_length(longest, links, first, link, last):
                longest = j
        if chord <= 2.0 * link_length(longest, links, first, link, last) - total + SNAP * link:
            folded = True
            split = longest
    if not folded:
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
    x: Array, origin: float, link: float, pieces: Array, arcs: Array, points: Array, shortage: Array, ahead: Array,
    back: Array, u: Array,
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
                        x, start, stop, (start - t_previous) * link, link, (t - stop + 1) * link, points, points,
                        previous, k, ahead, back, u,
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
                x, start, i1 + 1, 1, points[previous, 0], points[previous, 1], points[previous, 2],
                (start - t_previous) * link, link, x,
            )
