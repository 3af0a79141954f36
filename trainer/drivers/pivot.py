"""Where the tip is, seen from its sensor: a sweep of the tool about its resting tip.

In every pose i of the sweep the tip lies in one place: p_i + R_i t = c, linear in the tip t (sensor frame) and the
pivot c (device frame), solved by least squares. The condition number of the equations says whether the sweep determines
them: when the tool turns about one axis only, the tip may lie anywhere along that axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainer.calibration import CalibrationError, Tip
from trainer.geometry import Array, matrix_from_quaternion

#: Largest estimated error of a pose, mm, with which a sweep is accepted. Assumed, as in touched_points.
LARGEST_RESIDUAL_MM = 1.0

#: Largest condition number of the equations. Poses all over a cone of half angle a make it 2.8 / a (a in rad, tried),
#: so this asks for 13 degrees to every side; a turn about one axis leaves it boundless. Assumed.
LARGEST_CONDITION = 12.0

FEWEST_POSES = 10  # assumed


@dataclass(frozen=True)
class Pivot:
    """A tip and how well its sweep determines it."""

    tip: Array  # (3,) mm, sensor frame
    pivot: Array  # (3,) mm, device frame
    residual_mm: float  # estimated error of a pose: √(Σ|r|² / (n - 2)), since 6 of 3 n numbers were fitted
    uncertainty_mm: float  # sd of the tip along its least certain axis, were all poses' errors independent
    condition: float
    poses: int

    def of(self, sensor: str) -> Tip:
        """The fit as a calibration's file states it."""
        x, y, z = self.tip.tolist()
        return Tip(sensor, (x, y, z), self.residual_mm, self.uncertainty_mm, self.poses)


def fit(position: Array, quaternion: Array) -> Pivot:
    """The tip from poses ``position`` (n, 3) mm, ``quaternion`` (n, 4) of the sensor in the device's frame.

    Raises CalibrationError for too few poses, a sweep that does not determine the tip, and a poor fit.
    """
    n = len(position)
    if n < FEWEST_POSES:
        raise CalibrationError(f"the sweep holds {n} poses, at least {FEWEST_POSES} are needed; sweep longer")
    equations = np.concatenate([matrix_from_quaternion(quaternion), np.tile(-np.eye(3), (n, 1, 1))], axis=2)
    equations = equations.reshape(3 * n, 6)
    u, s, vt = np.linalg.svd(equations, full_matrices=False)
    condition = float(s[0] / s[-1]) if s[-1] > 0.0 else math.inf
    if condition > LARGEST_CONDITION:
        raise CalibrationError(
            f"the sweep hardly turns, or about one axis only: condition number {condition:.3g}, "
            f"at most {LARGEST_CONDITION:g} is accepted; tilt the tool 15 degrees or more to every side"
        )
    wanted = -position.ravel()
    solution = vt.T @ ((u.T @ wanted) / s)
    error = (equations @ solution - wanted).reshape(n, 3)
    residual = math.sqrt(float(np.sum(error**2)) / (n - 2))
    if residual > LARGEST_RESIDUAL_MM:
        raise CalibrationError(
            f"the tip did not rest during the sweep: residual {residual:.2f} mm, "
            f"at most {LARGEST_RESIDUAL_MM:g} mm is accepted; hold it in a dimple"
        )
    covariance = (vt.T / s**2) @ vt  # of the solution, for errors of 1 mm along each axis
    worst = math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    return Pivot(solution[:3], solution[3:], residual, residual / math.sqrt(3.0) * worst, condition, n)
