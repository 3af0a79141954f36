"""A labelled volume made ready for rays: smoothed, so that surfaces have normals, and with its empty bricks marked.

A ray that meets an empty brick of 8 × 8 × 8 voxels leaves it in one step; most of a knee's volume is empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.density_field import WEIGHTS, smooth_axis

#: Voxels along a brick's edge, as a power of two.
BRICK_BITS = 3
BRICK = 1 << BRICK_BITS


@dataclass(frozen=True)
class Look:
    """How labels are shown; a label of opacity 0 is left out of surface and volume pictures."""

    colour: np.ndarray  # (256, 3) uint8
    opacity_per_mm: np.ndarray  # (256,) float64


@dataclass(frozen=True)
class Solid:
    """What rays go through; all arrays belong to the same grid."""

    labels: np.ndarray  # (nx, ny, nz) uint8
    density: np.ndarray  # (nx, ny, nz) uint8, 255 inside what is shown
    bricks: np.ndarray  # (bx, by, bz) uint8, 0 where no voxel of a brick or beside it has a density
    spacing_mm: Array  # (3,)
    look: Look


def look_of(shown: Mapping[int, tuple[tuple[int, int, int], float]]) -> Look:
    """Labels with their colour and the part of light that they take per mm; all others are left out."""
    colour = np.zeros((256, 3), dtype=np.uint8)
    opacity = np.zeros(256)
    for label, (rgb, per_mm) in shown.items():
        colour[label], opacity[label] = rgb, per_mm
    return Look(colour, opacity)


def solid_of(labels: np.ndarray, spacing_mm: tuple[float, float, float], look: Look) -> Solid:
    """The labels (nx, ny, nz) uint8 made ready. Raises ValueError for a grid of fewer than two voxels along an axis."""
    if min(labels.shape) < 2:
        raise ValueError(f"a picture needs at least two voxels along each axis, found {labels.shape}")
    density = (look.opacity_per_mm > 0.0).astype(np.float32)[labels]
    for axis in range(3):
        smooth_axis(np.moveaxis(density, axis, 2), WEIGHTS.astype(np.float32))
    levels = np.round(255.0 * density).astype(np.uint8)
    bricks = np.zeros([(n + BRICK - 1) >> BRICK_BITS for n in labels.shape], dtype=np.uint8)
    mark_bricks(levels, bricks)
    return Solid(np.ascontiguousarray(labels), levels, bricks, np.array(spacing_mm), look)


@njit(cache=True, nogil=True, error_model="numpy")
def mark_bricks(density: np.ndarray, bricks: np.ndarray) -> None:
    """Mark each brick that an interpolated density above zero can reach: one voxel beyond it counts."""
    nx, ny, nz = density.shape
    for a in range(bricks.shape[0]):
        for b in range(bricks.shape[1]):
            for c in range(bricks.shape[2]):
                found = False
                for i in range(max(a * BRICK - 1, 0), min((a + 1) * BRICK + 1, nx)):
                    for j in range(max(b * BRICK - 1, 0), min((b + 1) * BRICK + 1, ny)):
                        for k in range(max(c * BRICK - 1, 0), min((c + 1) * BRICK + 1, nz)):
                            if density[i, j, k] > 0:
                                found = True
                bricks[a, b, c] = found
