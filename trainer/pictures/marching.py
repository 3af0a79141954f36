"""Kernels that follow rays through a solid: the first surface, or all light along the way.

Rays are in voxels. Both kernels do a range of tiles of 16 × 16 pixels: rays of a tile go through the same bricks, which
the processor then still has at hand (twice as fast as rows).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.pictures.solid import BRICK, BRICK_BITS

TILE = 16
#: Length of a step in voxels: a surface of the smoothed density is thicker than that.
STEP = 0.75
#: The same where light is only summed up.
WIDE_STEP = 1.25
#: The surface is where the density is half of 255.
LEVEL = 127.5
BISECTIONS = 5
#: From this density on a place is inside and shows no surface; interpolating eight times 255 may round below it.
INSIDE = 254.5
#: Steps beyond a surface within which its label is looked for: the filter's reach.
AHEAD = 5
#: Light from the eye, as an arthroscope has it, and what comes from everywhere; assumed.
AMBIENT = 0.25
#: Cosine that stands for a place without a surface, deep inside; assumed.
UNTURNED = 0.5
#: A ray that has lost so much of its light is not followed further.
OPAQUE = 0.98


@njit(cache=True, nogil=True, error_model="numpy")
def density_at(density: np.ndarray, u: float, v: float, w: float) -> float:
    """The density (0 … 255) at (u, v, w) in voxels, trilinear; outside the grid that of the nearest place in it."""
    nx, ny, nz = density.shape
    u, v, w = min(max(u, 0.0), nx - 1.0), min(max(v, 0.0), ny - 1.0), min(max(w, 0.0), nz - 1.0)
    i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
    a, b, c = u - i, v - j, w - k
    d00 = (1.0 - c) * density[i, j, k] + c * density[i, j, k + 1]
    d01 = (1.0 - c) * density[i, j + 1, k] + c * density[i, j + 1, k + 1]
    d10 = (1.0 - c) * density[i + 1, j, k] + c * density[i + 1, j, k + 1]
    d11 = (1.0 - c) * density[i + 1, j + 1, k] + c * density[i + 1, j + 1, k + 1]
    return float((1.0 - a) * ((1.0 - b) * d00 + b * d01) + a * ((1.0 - b) * d10 + b * d11))


@njit(cache=True, nogil=True, error_model="numpy")
def enter(lowest: float, highest: float, o: float, d: float, t0: float, t1: float) -> tuple[float, float]:
    """The part of t0 … t1 in which o + t d lies between two planes; empty (t0 > t1) where it never does."""
    if d == 0.0:
        return (t0, t1) if lowest <= o <= highest else (1.0, 0.0)
    a, b = (lowest - o) / d, (highest - o) / d
    return max(t0, min(a, b)), min(t1, max(a, b))


@njit(cache=True, nogil=True, error_model="numpy")
def leave_brick(u: float, v: float, w: float, du: float, dv: float, dw: float) -> float:
    """How far along the ray its brick ends, and a little more."""
    t = math.inf
    if du != 0.0:
        t = min(t, (((int(u) >> BRICK_BITS) + (du > 0.0)) * BRICK - u) / du)
    if dv != 0.0:
        t = min(t, (((int(v) >> BRICK_BITS) + (dv > 0.0)) * BRICK - v) / dv)
    if dw != 0.0:
        t = min(t, (((int(w) >> BRICK_BITS) + (dw > 0.0)) * BRICK - w) / dw)
    return max(t, 0.0) + 1e-3


@njit(cache=True, nogil=True, error_model="numpy")
def shown_label(labels: np.ndarray, opacity: Array, u: float, v: float, w: float) -> int:
    """The label nearest to (u, v, w) among the eight voxels around it that is shown; 0 where none is."""
    nx, ny, nz = labels.shape
    i0, j0, k0 = min(max(int(u), 0), nx - 2), min(max(int(v), 0), ny - 2), min(max(int(w), 0), nz - 2)
    nearest, found = math.inf, 0
    for i in range(i0, i0 + 2):
        for j in range(j0, j0 + 2):
            for k in range(k0, k0 + 2):
                label = labels[i, j, k]
                away = (u - i) ** 2 + (v - j) ** 2 + (w - k) ** 2
                if opacity[label] > 0.0 and away < nearest:
                    nearest, found = away, int(label)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def brightness(
    density: np.ndarray, inverse: Array, u: float, v: float, w: float, du: float, dv: float, dw: float
) -> float:
    """Light that a surface sends back along the ray: Lambert's, from the eye, with some from everywhere."""
    gx = (density_at(density, u + 1.0, v, w) - density_at(density, u - 1.0, v, w)) * inverse[0]
    gy = (density_at(density, u, v + 1.0, w) - density_at(density, u, v - 1.0, w)) * inverse[1]
    gz = (density_at(density, u, v, w + 1.0) - density_at(density, u, v, w - 1.0)) * inverse[2]
    x, y, z = du / inverse[0], dv / inverse[1], dw / inverse[2]
    length = math.sqrt((gx * gx + gy * gy + gz * gz) * (x * x + y * y + z * z))
    facing = (gx * x + gy * y + gz * z) / length if length > 0.0 else UNTURNED
    return AMBIENT + (1.0 - AMBIENT) * max(facing, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def march(
    labels: np.ndarray,
    density: np.ndarray,
    bricks: np.ndarray,
    spacing: Array,
    colour: np.ndarray,
    opacity: Array,
    rays: Array,
    see_through: bool,
    first_tile: int,
    last_tile: int,
    picture: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Draw tiles ``first_tile`` to ``last_tile`` - 1 of ``picture`` (h, w, 3) uint8 and ``depth`` (h, w) mm.

    ``see_through``: all light along the ray; otherwise the first surface. ``depth`` is the way to what was met first,
    infinite where nothing was.
    """
    height, width = depth.shape
    across = (width + TILE - 1) // TILE
    nx, ny, nz = density.shape
    inverse = 1.0 / spacing
    for tile in range(first_tile, last_tile):
        top, left = tile // across * TILE, tile % across * TILE
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                # The ray in mm, of unit length, then in voxels: t stays mm.
                x = rays[1, 0] + (column + 0.5) * rays[2, 0] + (row + 0.5) * rays[3, 0]
                y = rays[1, 1] + (column + 0.5) * rays[2, 1] + (row + 0.5) * rays[3, 1]
                z = rays[1, 2] + (column + 0.5) * rays[2, 2] + (row + 0.5) * rays[3, 2]
                length = math.sqrt(x * x + y * y + z * z)
                du, dv, dw = x / length * inverse[0], y / length * inverse[1], z / length * inverse[2]
                ou, ov, ow = rays[0, 0] * inverse[0], rays[0, 1] * inverse[1], rays[0, 2] * inverse[2]
                t, end = enter(0.0, nx - 1.0, ou, du, 0.0, math.inf)
                t, end = enter(0.0, ny - 1.0, ov, dv, t, end)
                t, end = enter(0.0, nz - 1.0, ow, dw, t, end)
                step = (WIDE_STEP if see_through else STEP) / math.sqrt(du * du + dv * dv + dw * dw)
                left_over, red, green, blue = 1.0, 0.0, 0.0, 0.0
                before = t
                depth[row, column] = math.inf
                while t <= end and left_over > 1.0 - OPAQUE:
                    u = min(max(ou + t * du, 0.0), nx - 1.0)
                    v = min(max(ov + t * dv, 0.0), ny - 1.0)
                    w = min(max(ow + t * dw, 0.0), nz - 1.0)
                    if bricks[int(u) >> BRICK_BITS, int(v) >> BRICK_BITS, int(w) >> BRICK_BITS] == 0:
                        t += leave_brick(u, v, w, du, dv, dw)
                        before = t
                        continue
                    d = density_at(density, u, v, w)
                    part, label = 0.0, 0
                    if not see_through and d >= LEVEL:
                        outside = before
                        for _ in range(BISECTIONS):
                            middle = 0.5 * (outside + t)
                            if density_at(density, ou + middle * du, ov + middle * dv, ow + middle * dw) >= LEVEL:
                                t = middle
                            else:
                                outside = middle
                        u, v, w = ou + t * du, ov + t * dv, ow + t * dw
                        part = 1.0
                        # Smoothed corners stand out of their voxels: the structure lies a little further on.
                        for ahead in range(AHEAD):
                            if label == 0:
                                a = t + ahead * step
                                label = shown_label(labels, opacity, ou + a * du, ov + a * dv, ow + a * dw)
                    elif see_through and d > 0.0:
                        label = int(labels[int(u + 0.5), int(v + 0.5), int(w + 0.5)])
                        if opacity[label] == 0.0:
                            label = shown_label(labels, opacity, u, v, w)
                        part = 1.0 - math.exp(-opacity[label] * d / 255.0 * step)
                    if part > 0.0:
                        light = left_over * part
                        if d < INSIDE:
                            light *= brightness(density, inverse, u, v, w, du, dv, dw)
                        else:
                            light *= AMBIENT + (1.0 - AMBIENT) * UNTURNED
                        red += light * colour[label, 0]
                        green += light * colour[label, 1]
                        blue += light * colour[label, 2]
                        left_over *= 1.0 - part
                        if depth[row, column] == math.inf:
                            depth[row, column] = t
                    before = t
                    t += step
                picture[row, column, 0] = int(red)
                picture[row, column, 1] = int(green)
                picture[row, column, 2] = int(blue)
