"""Exact closure of a span of the thread: directions of rigid links that add up to a given chord.

With unit vectors u_j and lengths l_j a span from A to B closes when sum l_j u_j = B - A. The least rotation
that removes a small gap r is u_j + m, normalised, with one vector m for the whole span, H m = r and
H = sum l_j (I - u_j u_j^T), a 3 x 3 system. Lengths hold by construction in every iteration; only the gap
is driven to zero. (Least in the sum of l_j |du_j|^2: its Lagrange multiplier is m.)
"""

from __future__ import annotations

import math

from numba import njit

from trainer.geometry import Array

CLOSED = 1e-11  # links: a gap at which a span counts as closed
MOST_STEPS = 80  # tautening takes a third off the sag in each step: 0.5 rad to the 1e-5 rad of taut is about 30
LARGEST_TURN = 0.5  # of a unit vector: keeps u + m away from zero


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
def turn_between(u: Array, j: int, ex: float, ey: float, ez: float, part: float, out: Array) -> None:
    """Direction u_j turned through ``part`` of its angle to the unit vector e, into out_j."""
    along = u[j, 0] * ex + u[j, 1] * ey + u[j, 2] * ez
    nx, ny, nz = u[j, 0] - along * ex, u[j, 1] - along * ey, u[j, 2] - along * ez
    side = math.sqrt(nx * nx + ny * ny + nz * nz)
    if side > 1e-12:
        nx, ny, nz = nx / side, ny / side, nz / side
    else:
        nx, ny, nz = perpendicular(ex, ey, ez)
    angle = (1.0 - part) * math.atan2(side, along)
    c, s = math.cos(angle), math.sin(angle)
    out[j, 0], out[j, 1], out[j, 2] = c * ex + s * nx, c * ey + s * ny, c * ez + s * nz


@njit(cache=True, nogil=True, error_model="numpy")
def fold_directions(
    u: Array, trial: Array, links: int, first: float, link: float, last: float, dx: float, dy: float, dz: float
) -> int:
    """Close a span of two or three links and chord d by letting its longest link, which is returned, fold.

    The others keep their directions if that leaves the ends of the longest one no further apart than its
    length. Otherwise they turn, by the least common part of the way, towards a shape that does: along the
    chord, or as the sides of a triangle over it where together they are longer than chord and longest link.
    """
    longest = 0
    for j in range(1, links):
        if link_length(j, links, first, link, last) > link_length(longest, links, first, link, last):
            longest = j
    i = 1 if longest == 0 else 0
    k = i if links == 2 else 3 - longest - i
    chord = math.sqrt(dx * dx + dy * dy + dz * dz)
    ex, ey, ez = 1.0, 0.0, 0.0
    if chord > 0.0:
        ex, ey, ez = dx / chord, dy / chord, dz / chord
    limit = link_length(longest, links, first, link, last)
    a = link_length(i, links, first, link, last)
    b = link_length(k, links, first, link, last) if k != i else 0.0
    side = min(a + b, chord + limit)
    ca = min((side * side + a * a - b * b) / (2.0 * a * side), 1.0)
    cb = min((side * side + b * b - a * a) / (2.0 * b * side), 1.0) if k != i else 1.0
    sa, sb = math.sqrt(1.0 - ca * ca), -math.sqrt(1.0 - cb * cb)
    nx, ny, nz = u[i, 0] - u[k, 0], u[i, 1] - u[k, 1], u[i, 2] - u[k, 2]
    along = nx * ex + ny * ey + nz * ez
    nx, ny, nz = nx - along * ex, ny - along * ey, nz - along * ez
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if size > 1e-9:
        nx, ny, nz = nx / size, ny / size, nz / size
    else:
        nx, ny, nz = perpendicular(ex, ey, ez)
    low, high, part = 0.0, 1.0, 0.0
    for _ in range(54):  # halvings down to the rounding of ``part``
        turn_between(u, k, cb * ex + sb * nx, cb * ey + sb * ny, cb * ez + sb * nz, part, trial)
        turn_between(u, i, ca * ex + sa * nx, ca * ey + sa * ny, ca * ez + sa * nz, part, trial)
        gx = dx - a * trial[i, 0] - b * trial[k, 0]
        gy = dy - a * trial[i, 1] - b * trial[k, 1]
        gz = dz - a * trial[i, 2] - b * trial[k, 2]
        if gx * gx + gy * gy + gz * gz <= limit * limit:
            high = part
            if part == 0.0:
                break
        else:
            low = part
        part = 0.5 * (low + high)
    turn_between(u, k, cb * ex + sb * nx, cb * ey + sb * ny, cb * ez + sb * nz, high, trial)
    turn_between(u, i, ca * ex + sa * nx, ca * ey + sa * ny, ca * ez + sa * nz, high, trial)
    for j in (i, k):
        u[j, 0], u[j, 1], u[j, 2] = trial[j, 0], trial[j, 1], trial[j, 2]
    return longest
