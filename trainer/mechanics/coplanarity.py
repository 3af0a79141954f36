"""When four moving points lie in one plane: a point is at a triangle then, or an edge at an edge, if at all.

While four points move in straight lines the volume that they span is a cubic in time (Provot 1997, "Collision and
self-collision handling in cloth model dedicated to design garments"; Bridson, Fedkiw and Anderson 2002, "Robust
treatment of collisions, contact and friction for cloth animation", 6.1). Here the cubic is kept by its four Bernstein
coefficients, which are sums of triple products and bound it: where all have one sign there is no root. Otherwise it is
cut at its extremes into monotone parts, and each part that changes its sign is halved.
"""

from __future__ import annotations

import math

from numba import njit

#: Halvings of a monotone part: 2**-60 of a tick is below the rounding of the time.
HALVINGS = 60
# The bound on the rounding of a triple product of differences, as a multiple of the product of the three lengths:
# 40 operations of 1.1e-16 each.
ROUNDING = 5e-15


@njit(cache=True, nogil=True, error_model="numpy")
def _triple(start, end, a, b, c):  # type: ignore[no-untyped-def]
    """Volume of the points 1, 2, 3 from point 0, times six; ``a``, ``b``, ``c``: whether each is taken at the end."""
    p = end if a else start
    q = end if b else start
    r = end if c else start
    ux, uy, uz = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    vx, vy, vz = q[2, 0] - q[0, 0], q[2, 1] - q[0, 1], q[2, 2] - q[0, 2]
    wx, wy, wz = r[3, 0] - r[0, 0], r[3, 1] - r[0, 1], r[3, 2] - r[0, 2]
    return (uy * vz - uz * vy) * wx + (uz * vx - ux * vz) * wy + (ux * vy - uy * vx) * wz


@njit(cache=True, nogil=True, error_model="numpy")
def volume_coefficients(start, end):  # type: ignore[no-untyped-def]
    """The volume of four points ``start`` → ``end`` (4, 3): Bernstein coefficients b0 … b3, and their rounding."""
    b0 = _triple(start, end, False, False, False)
    b1 = _triple(start, end, True, False, False) + _triple(start, end, False, True, False)
    b1 += _triple(start, end, False, False, True)
    b2 = _triple(start, end, True, True, False) + _triple(start, end, True, False, True)
    b2 += _triple(start, end, False, True, True)
    b3 = _triple(start, end, True, True, True)
    size = 1.0
    for k in range(1, 4):
        d0 = (start[k, 0] - start[0, 0]) ** 2 + (start[k, 1] - start[0, 1]) ** 2 + (start[k, 2] - start[0, 2]) ** 2
        d1 = (end[k, 0] - end[0, 0]) ** 2 + (end[k, 1] - end[0, 1]) ** 2 + (end[k, 2] - end[0, 2]) ** 2
        size *= math.sqrt(d0 if d0 > d1 else d1)
    return b0, b1 / 3.0, b2 / 3.0, b3, ROUNDING * size


@njit(cache=True, nogil=True, error_model="numpy")
def volume_at(t, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    """The cubic with these coefficients at ``t`` (de Casteljau's scheme: only means of neighbours are taken)."""
    s = 1.0 - t
    c0, c1, c2 = s * b0 + t * b1, s * b1 + t * b2, s * b2 + t * b3
    return s * (s * c0 + t * c1) + t * (s * c1 + t * c2)


@njit(cache=True, nogil=True, error_model="numpy")
def coplanar_times(b0, b1, b2, b3, rounding, times):  # type: ignore[no-untyped-def]
    """Write the times in 0..1 at which the cubic is zero into ``times`` (7,), ascending; returns their number.

    Ends and extremes at which it is zero within ``rounding`` count as well: a root that is only touched is none the
    less found. One root may be listed twice.
    """
    if min(min(b0, b1), min(b2, b3)) > rounding or max(max(b0, b1), max(b2, b3)) < -rounding:
        return 0
    # A third of the derivative: c + 2 b t + a t².
    a = (b1 - b0) - 2.0 * (b2 - b1) + (b3 - b2)
    b = (b2 - b1) - (b1 - b0)
    c = b1 - b0
    first, second = 1.0, 1.0
    discriminant = b * b - a * c
    if discriminant >= 0.0:
        # The sum of equal signs loses no digits; the other extreme follows from the product of both.
        q = -(b + math.copysign(math.sqrt(discriminant), b))
        if a != 0.0 and 0.0 < q / a < 1.0:
            first = q / a
        if q != 0.0 and 0.0 < c / q < 1.0:
            second = c / q
        if second < first:
            first, second = second, first
    count = 0
    low = 0.0
    at_low = b0
    for part in range(3):
        high = first if part == 0 else (second if part == 1 else 1.0)
        at_high = volume_at(high, b0, b1, b2, b3)
        if abs(at_low) <= rounding:
            times[count] = low
            count += 1
        if (at_low > 0.0) != (at_high > 0.0):
            before, after = low, high
            for _ in range(HALVINGS):
                middle = 0.5 * (before + after)
                if (volume_at(middle, b0, b1, b2, b3) > 0.0) == (at_low > 0.0):
                    before = middle
                else:
                    after = middle
            times[count] = after
            count += 1
        low, at_low = high, at_high
    if abs(b3) <= rounding:
        times[count] = 1.0
        count += 1
    return count
