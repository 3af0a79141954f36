"""A force field around rigid anatomy, for a hand that feels it (Gibson et al. 1998, section 4.2.3; Avila and
Sobierajski 1996).

The labels of rigid structures, 1 inside and 0 outside, are smoothed by a 5 × 5 × 5 Gaussian. At the tip the density
d is interpolated trilinearly; the gradient g takes it at six points, one voxel to each side along each axis of the
grid; the force is

    f = k · d · g / |g|,    g = (d(x-1) - d(x+1), d(y-1) - d(y+1), d(z-1) - d(z+1))

which points outwards. Where voxels are not cubes each difference is divided by its own distance in mm, so that g
stays normal to the surface; for cubes that changes nothing, since only g's direction counts.

The paper tunes k by hand for densities from 0 to 255. Here densities go from 0 to 1 and k is a stiffness in mN/mm times
a depth in mm, the one over which a density that grew as it does at a wall across the grid would go from 0 to 1; so
``stiffness`` is the steepest growth of the force where the tip goes into such a wall.

Two cases have no direction. Outside the grid there is nothing: the grid has a rim wide enough for the density to have
come down to zero, so no force jumps there. Deep inside, where all samples are alike, the gradient is zero and the last
direction that the tip came through holds; a tip that has none feels nothing. There a force of full density remains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from trainer.geometry import Array, Rigid

#: Weights of one axis of the Gaussian: 5 taps, a standard deviation of one voxel (assumed: the paper gives the size).
REACH = 2
_TAPS = np.exp(-0.5 * np.arange(-REACH, REACH + 1, dtype=np.float64) ** 2)
WEIGHTS: Array = _TAPS / _TAPS.sum()

#: Voxels around the labels: the filter reaches two, and the density must be zero at the last one.
RIM = REACH + 1


@dataclass(frozen=True)
class DensityField:
    """A smoothed volume and what :func:`force_at` needs to know of it."""

    density: np.ndarray  # (nx, ny, nz) float32, 0 … 1, with a rim of zeros
    constants: Array  # (17,): rotation and origin, world from volume; 1 / spacing; force at density 1, limit


def density_field(
    rigid: np.ndarray,
    spacing_mm: tuple[float, float, float],
    world_from_volume: Rigid,
    stiffness_mN_per_mm: float,
    limit_mN: float,
) -> DensityField:
    """The field of the voxels that are ``rigid`` (nx, ny, nz) bool.

    The centre of voxel (0, 0, 0) is the volume's origin. ``limit_mN`` is the largest force that the device can make; no
    force is longer. Raises ValueError for a stiffness, limit or spacing that is not positive and finite.
    """
    for name, value in (("stiffness", stiffness_mN_per_mm), ("limit", limit_mN), ("spacing", min(spacing_mm))):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be positive and finite, found {value}")
    density = np.zeros([n + 2 * RIM for n in rigid.shape], dtype=np.float32)
    density[RIM:-RIM, RIM:-RIM, RIM:-RIM] = rigid
    for axis in range(3):
        smooth_axis(np.moveaxis(density, axis, 2), WEIGHTS.astype(np.float32))
    constants = np.empty(17)
    constants[:9] = world_from_volume.matrix.ravel()
    # Where the centre of the density's first voxel lies in the world.
    constants[9:12] = world_from_volume.apply(-RIM * np.asarray(spacing_mm))
    constants[12:15] = 1.0 / np.asarray(spacing_mm)
    constants[15] = stiffness_mN_per_mm * min(spacing_mm) / WEIGHTS[REACH]
    constants[16] = limit_mN
    return DensityField(density, constants)


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_axis(density: np.ndarray, weights: np.ndarray) -> None:
    """Convolve ``density`` (a, b, c) float32 in place along its last axis with 5 ``weights``; outside lies zero."""
    w0, w1, w2 = weights[2], weights[1], weights[0]
    n = density.shape[2]
    for i in range(density.shape[0]):
        for j in range(density.shape[1]):
            row = density[i, j]
            before2 = before1 = np.float32(0.0)
            here = row[0]
            after1 = row[1]
            for k in range(n):
                after2 = row[k + 2] if k + 2 < n else np.float32(0.0)
                row[k] = w0 * here + w1 * (before1 + after1) + w2 * (before2 + after2)
                before2, before1, here, after1 = before1, here, after1, after2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def sample(density: np.ndarray, u: float, v: float, w: float) -> float:
    """The density at (u, v, w) in voxels, trilinear; 0 outside the grid.

    Differences are scaled, not weights, so that eight equal corners give exactly their value.
    """
    nx, ny, nz = density.shape
    if not (0.0 <= u <= nx - 1.0 and 0.0 <= v <= ny - 1.0 and 0.0 <= w <= nz - 1.0):
        return 0.0
    i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
    a, b, c = u - i, v - j, w - k
    d00 = density[i, j, k] + c * (density[i, j, k + 1] - density[i, j, k])
    d01 = density[i, j + 1, k] + c * (density[i, j + 1, k + 1] - density[i, j + 1, k])
    d10 = density[i + 1, j, k] + c * (density[i + 1, j, k + 1] - density[i + 1, j, k])
    d11 = density[i + 1, j + 1, k] + c * (density[i + 1, j + 1, k + 1] - density[i + 1, j + 1, k])
    d0 = d00 + b * (d01 - d00)
    d1 = d10 + b * (d11 - d10)
    return float(d0 + a * (d1 - d0))


@njit(cache=True, nogil=True, error_model="numpy")
def force_at(density: np.ndarray, constants: Array, tip: Array, force: Array, direction: Array) -> float:
    """Sets ``force`` (3,) mN on a ``tip`` (3,) mm, both in the world; returns the density there.

    ``direction`` (3,) is the unit vector outwards, set where the gradient has one and left as it was elsewhere: a loop
    hands in the same array again and again, and zeros for a tip that comes from nowhere. A tip that is not finite
    feels nothing.
    """
    c = constants
    force[0], force[1], force[2] = 0.0, 0.0, 0.0
    if not (math.isfinite(tip[0]) and math.isfinite(tip[1]) and math.isfinite(tip[2])):
        return 0.0
    x, y, z = tip[0] - c[9], tip[1] - c[10], tip[2] - c[11]
    u = (c[0] * x + c[3] * y + c[6] * z) * c[12]
    v = (c[1] * x + c[4] * y + c[7] * z) * c[13]
    w = (c[2] * x + c[5] * y + c[8] * z) * c[14]
    d = sample(density, u, v, w)
    if d <= 0.0:
        return 0.0
    gx = (sample(density, u - 1.0, v, w) - sample(density, u + 1.0, v, w)) * c[12]
    gy = (sample(density, u, v - 1.0, w) - sample(density, u, v + 1.0, w)) * c[13]
    gz = (sample(density, u, v, w - 1.0) - sample(density, u, v, w + 1.0)) * c[14]
    g = math.sqrt(gx * gx + gy * gy + gz * gz)
    if g > 0.0:
        direction[0] = (c[0] * gx + c[1] * gy + c[2] * gz) / g
        direction[1] = (c[3] * gx + c[4] * gy + c[5] * gz) / g
        direction[2] = (c[6] * gx + c[7] * gy + c[8] * gz) / g
    size = min(c[15] * d, c[16])
    force[0], force[1], force[2] = size * direction[0], size * direction[1], size * direction[2]
    return d
