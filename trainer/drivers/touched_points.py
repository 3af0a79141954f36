"""Where the scene is, seen from the device: a rigid fit to points that were touched with the tip.

Least squares over rotations and translations (Horn 1987; the rotation by singular values, Kabsch 1976). A point that
was touched several times counts once, with the mean of its touches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainer.calibration import CalibrationError, Placement
from trainer.geometry import Array, Rigid, fit_rotation, matrix_from_quaternion, quaternion_from_matrix

#: Largest estimated error of a touch, mm, with which a fit is accepted. Assumed: an order above the step of a
#: miniBIRD's position words (0.11 mm), below what a metal object nearby or a mistaken point makes.
LARGEST_RESIDUAL_MM = 1.0

#: Points whose spread across their longest line is less than this part of that along it lie on a line: about it the
#: rotation is uncertain by the touches' error over the spread across. Assumed.
LEAST_SPREAD_ACROSS = 0.1


@dataclass(frozen=True)
class Fit:
    """A rigid fit and how well it fits."""

    scene_from_device: Rigid
    residual_mm: float  # estimated error of a touch: √(Σ|r|² / (n - 2)), since 6 of 3 n numbers were fitted
    worst_mm: float
    points: int

    def placement(self) -> Placement:
        """The fit as a calibration's file states it."""
        x, y, z = self.scene_from_device.position.tolist()
        return Placement((x, y, z), euler_deg(self.scene_from_device.quaternion), self.residual_mm, self.points)


def fit(device: Array, scene: Array) -> Fit:
    """scene_from_device from touches ``device`` (n, 3) of points known as ``scene`` (n, 3), both mm.

    Raises CalibrationError for fewer than three different points, points on a line, and a poor fit.
    """
    device, scene = means(device, scene)
    n = len(scene)
    if n < 3:
        raise CalibrationError(f"{n} different points were touched; touch three or more that are not on a line")
    for points, whose in ((scene, "as they are known"), (device, "as they were touched")):
        along, across = spread(points)[:2]
        if across < LEAST_SPREAD_ACROSS * along or along == 0.0:
            raise CalibrationError(
                f"the points lie on a line, {whose}: spread {along:.2f} mm along it, {across:.2f} mm across, "
                f"at least {LEAST_SPREAD_ACROSS:g} of that is needed; touch one that is aside of it"
            )
    found = rigid(device, scene)
    error = np.linalg.norm(found.apply(device) - scene, axis=1)
    residual = math.sqrt(float(np.sum(error**2)) / (n - 2))
    if residual > LARGEST_RESIDUAL_MM:
        raise CalibrationError(
            f"the points do not fit: residual {residual:.2f} mm, at most {LARGEST_RESIDUAL_MM:g} mm is accepted; "
            f"worst at scene point {_text(scene[int(np.argmax(error))])}, {error.max():.2f} mm"
        )
    return Fit(found, residual, float(error.max()), n)


def rigid(a: Array, b: Array) -> Rigid:
    """The rigid transform b_from_a that best carries the points ``a`` (n, 3) to ``b`` (n, 3)."""
    rotation = fit_rotation(a, b)
    return Rigid(b.mean(axis=0) - rotation @ a.mean(axis=0), quaternion_from_matrix(rotation))


def means(measured: Array, known: Array) -> tuple[Array, Array]:
    """The mean of ``measured`` (n, 3) for each different row of ``known`` (n, 3), in the order of their first touch."""
    rows, first, which = np.unique(known, axis=0, return_index=True, return_inverse=True)
    total = np.zeros_like(rows)
    np.add.at(total, which.ravel(), measured)
    mean = total / np.bincount(which.ravel())[:, None]
    order = np.argsort(first)
    return mean[order], rows[order]


def spread(points: Array) -> Array:
    """Root mean square distances (3,) of points (n, 3) from their mean, along their principal axes, largest first."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / math.sqrt(len(points))
    return np.concatenate([values, np.zeros(3)])[:3]


def euler_deg(quaternion: Array) -> tuple[float, float, float]:
    """Angles about x, then y, then z (fixed axes) of a rotation, as TOML files state it, degrees.

    R = Rz Ry Rx. Where y is a quarter turn, only x ∓ z is determined; z is 0 then.
    """
    r = matrix_from_quaternion(quaternion)
    level = math.hypot(r[0, 0], r[1, 0])
    y = math.atan2(-r[2, 0], level)
    if level < 1e-9:
        x, z = math.atan2(-r[1, 2], r[1, 1]), 0.0
    else:
        x, z = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    return math.degrees(x), math.degrees(y), math.degrees(z)


def _text(point: Array) -> str:
    return f"({', '.join(f'{v:g}' for v in point)})"
