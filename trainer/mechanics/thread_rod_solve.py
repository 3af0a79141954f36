"""The implicit problem of an inextensible rod, by Newton's method with a direct band factorisation: O(n).

Every implicit step and the equilibrium of a rod (``thread_rod``) is one problem: places x of the nodes and
tensions T of the links for which

    weight_i (x_i - y_i) + f'_bend(x)_i - f_i = T_{i+1} t_{i+1} - T_i t_i      (force balance of node i)
    |x_i - x_{i-1}| = d (1 + T_i / EA)                                         (link i, from node i-1 to node i)

with t the links' directions, y where inertia and drag alone would bring a node, and ``weight`` what they resist with.
It is the stationary point of  ½ Σ weight |x - y|² + E_bend - Σ f·x  under the lengths: a proximal point.

Bending, E = EI / (2 d³) Σ |x_{i-1} - 2 x_i + x_{i+1} - b_i|², is quadratic in x: on links of constant length the second
difference is the curvature times d² (Bergou et al. 2006, "A quadratic bending model for inextensible surfaces",
section 3). Its matrix is constant; the b_i (rest curvature) turn with the rod and are kept for a step.

The unknowns of node i are x_i, y_i, z_i and T_i: 4 n of them, in that order the matrix is symmetric with eight
off-diagonals. It is factored as L D Lᵀ without pivoting: where weights, bending and tensions give a positive
definite matrix the pivots of the T are negative and those of the nodes positive, whatever the links' directions
(Vanderbei 1995, "Symmetric quasidefinite matrices"). Compression may break that; the tensions below zero are then
left out of the matrix, not out of the balance.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array

BAND = 8  # off-diagonals of the matrix on each side
WIDTH = 2 * BAND + 1  # of a stored row: zeros behind the band let the elimination run over a fixed width
LEAST_LINK = 0.1  # link lengths: shorter than this, a link's direction turns too fast for its second derivative


@njit(cache=True, nogil=True, error_model="numpy")
def directions(x: Array, t: Array, size: Array) -> None:
    """Directions ``t`` (n, 3) and lengths ``size`` (n,) of the links into each node; row 0 is not a link.

    A link of no length takes the direction of the link before it (+x if there is none).
    """
    ux, uy, uz = 1.0, 0.0, 0.0
    for i in range(1, len(x)):
        dx, dy, dz = x[i, 0] - x[i - 1, 0], x[i, 1] - x[i - 1, 1], x[i, 2] - x[i - 1, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length > 0.0:
            ux, uy, uz = dx / length, dy / length, dz / length
        t[i, 0], t[i, 1], t[i, 2] = ux, uy, uz
        size[i] = length


@njit(cache=True, nogil=True, error_model="numpy")
def imbalance(
    x: Array, tension: Array, y: Array, weight: Array, force: Array, bend: float, rest: Array, t: Array, out: Array
) -> None:
    """The forces (n, 3) mN that are left at the nodes: what a hold must bear, zero at a free node."""
    n = len(x)
    for i in range(n):
        for c in range(3):
            out[i, c] = force[i, c] - weight[i] * (x[i, c] - y[i, c])
    for i in range(1, n):
        for c in range(3):
            pull = tension[i] * t[i, c]
            out[i, c] -= pull
            out[i - 1, c] += pull
    for i in range(1, n - 1):
        for c in range(3):
            moment = bend * (x[i - 1, c] - 2.0 * x[i, c] + x[i + 1, c] - rest[i, c])
            out[i - 1, c] -= moment
            out[i, c] += 2.0 * moment
            out[i + 1, c] -= moment


@njit(cache=True, nogil=True, error_model="numpy")
def assemble(
    tension: Array, weight: Array, bend: float, stretch: float, link: float, t: Array,
    size: Array, compression: bool, a: Array,
) -> None:  # fmt: skip
    """The upper band ``a`` (4 n + BAND, WIDTH) of Newton's matrix: a[r, k] is entry (r, r + k). mN/mm.

    ``stretch`` mm/mN is a link's compliance d / EA. ``compression`` false: tensions below zero are left out.
    """
    n = len(weight)
    for r in range(len(a)):
        for k in range(BAND + 1):  # what lies behind the band is never written
            a[r, k] = 0.0
    for i in range(n):
        for c in range(3):
            a[4 * i + c, 0] = weight[i]
        a[4 * i + 3, 0] = -stretch
    a[3, 0] = -1.0  # node 0 has no link into it
    for i in range(1, n - 1):
        for c in range(3):
            a[4 * i - 4 + c, 0] += bend
            a[4 * i + c, 0] += 4.0 * bend
            a[4 * i + 4 + c, 0] += bend
            a[4 * i - 4 + c, 4] -= 2.0 * bend
            a[4 * i + c, 4] -= 2.0 * bend
            a[4 * i - 4 + c, 8] += bend
    for i in range(1, n):
        g = tension[i] / max(size[i], LEAST_LINK * link)
        if g < 0.0 and not compression:
            g = 0.0
        row, before = 4 * i, 4 * i - 4
        for c in range(3):
            for e in range(c, 3):
                value = (g if c == e else 0.0) - g * t[i, c] * t[i, e]
                a[row + c, e - c] += value
                a[before + c, e - c] += value
                a[before + c, 4 + e - c] -= value
                if e > c:
                    a[before + e, 4 + c - e] -= value
            # The balance holds - T t at node i: its derivative to T, with the sign that makes the matrix symmetric.
            a[row + c, 3 - c] += t[i, c]
            a[before + c, 7 - c] -= t[i, c]


@njit(cache=True, nogil=True, error_model="numpy")
def hold(held: NDArray[np.bool_], a: Array) -> None:
    """Give the held nodes rows and columns of the identity."""
    for i in range(len(held)):
        if held[i]:
            for c in range(3):
                row = 4 * i + c
                for k in range(BAND + 1):
                    a[row, k] = 0.0
                    if k <= row:
                        a[row - k, k] = 0.0
                a[row, 0] = 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def factor(a: Array, rows: int) -> bool:
    """L D Lᵀ in place: a[r, 0] becomes 1 / D, a[r, k] row r of Lᵀ. False where a pivot has the wrong sign."""
    sound = True
    for r in range(rows):
        pivot = a[r, 0]
        if (pivot <= 0.0) == (r % 4 != 3):
            sound = False
            if pivot == 0.0:
                pivot = 1e-300
        inverse = 1.0 / pivot
        for p in range(1, BAND + 1):
            factor_p = a[r, p] * inverse
            if factor_p != 0.0:
                for q in range(BAND):
                    a[r + p, q] -= factor_p * a[r, p + q]
        a[r, 0] = inverse
        for p in range(1, BAND + 1):
            a[r, p] *= inverse
    return sound


@njit(cache=True, nogil=True, error_model="numpy")
def substitute(a: Array, rows: int, b: Array) -> None:
    """Solve with the factors of ``factor``; ``b`` (rows + BAND,) in place, zeros behind its end."""
    for r in range(rows):
        value = b[r]
        for k in range(1, BAND + 1):
            b[r + k] -= a[r, k] * value
    for r in range(BAND):
        b[rows + r] = 0.0
    for r in range(rows - 1, -1, -1):
        value = b[r] * a[r, 0]
        for k in range(1, BAND + 1):
            value -= a[r, k] * b[r + k]
        b[r] = value


@njit(cache=True, nogil=True, error_model="numpy")
def rest_bends(x: Array, frame: Array, curvature: Array, link: float, t: Array, rest: Array) -> None:
    """The second differences ``rest`` (n, 3) mm that the rest curvature (n, 2), 1/mm, asks for where the rod lies now.

    ``frame`` (3,) is across the first link. Carried along the rod without twist (Bishop 1975, "There is more than
    one way to frame a curve"; discrete transport: Bergou et al. 2008, "Discrete elastic rods", section 4.2.2) it is
    the first direction of curvature; the second is t x that. Exact for a rod whose twist can run out at an end.
    """
    ux, uy, uz = frame[0], frame[1], frame[2]
    for i in range(1, len(x) - 1):
        mx, my, mz = t[i, 0] + t[i + 1, 0], t[i, 1] + t[i + 1, 1], t[i, 2] + t[i + 1, 2]
        m2 = mx * mx + my * my + mz * mz
        if m2 < 1e-12:  # the rod turns back on itself: no direction along it at this node
            rest[i, 0] = rest[i, 1] = rest[i, 2] = 0.0
            continue
        size = math.sqrt(m2)
        # Half the turn from link to link, so that the frame lies across the rod at the node; then the other half.
        for half in range(2):
            if half == 0:
                ax, ay, az = t[i, 0], t[i, 1], t[i, 2]
                bx, by, bz = mx / size, my / size, mz / size
            else:
                ax, ay, az = mx / size, my / size, mz / size
                bx, by, bz = t[i + 1, 0], t[i + 1, 1], t[i + 1, 2]
            k = (ux * bx + uy * by + uz * bz) / (1.0 + ax * bx + ay * by + az * bz)
            ux, uy, uz = ux - k * (ax + bx), uy - k * (ay + by), uz - k * (az + bz)
            if half == 0:
                s1, s2 = curvature[i, 0] * link * link, curvature[i, 1] * link * link
                rest[i, 0] = s1 * ux + s2 * (by * uz - bz * uy)
                rest[i, 1] = s1 * uy + s2 * (bz * ux - bx * uz)
                rest[i, 2] = s1 * uz + s2 * (bx * uy - by * ux)


@njit(cache=True, nogil=True, error_model="numpy")
def turn_frame(frame: Array, ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> None:
    """Carry ``frame`` (3,), across direction a, to direction b without twist, and make it a unit vector across b."""
    k = frame[0] * bx + frame[1] * by + frame[2] * bz
    turned = 1.0 + ax * bx + ay * by + az * bz
    if turned > 1e-6:
        k /= turned
        frame[0] -= k * (ax + bx)
        frame[1] -= k * (ay + by)
        frame[2] -= k * (az + bz)
    k = frame[0] * bx + frame[1] * by + frame[2] * bz
    frame[0] -= k * bx
    frame[1] -= k * by
    frame[2] -= k * bz
    size = math.sqrt(frame[0] * frame[0] + frame[1] * frame[1] + frame[2] * frame[2])
    frame[0] /= size
    frame[1] /= size
    frame[2] /= size
