"""Poses as files hold them: rounded, perhaps not of unit length, but never what no tracker measures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainer.config import ConfigError
from trainer.geometry import Array

#: Largest entry of |RᵀR - I| that still is a rotation. Trackers send quaternions as 14-bit words, each wrong by
#: up to d = 1/8192, and a host may turn them into a matrix without scaling them to length 1: then
#: RᵀR - I = 4 [v]² (1 - |q|²), with |1 - |q|²| <= 2 d (|w| + |x| + |y| + |z|) <= 4 d. The 6 digits of the text
#: add 2 √3 · 5e-7.
ROTATION_TOLERANCE = 16 / 8192 + 2e-6

#: Largest |1 - |q|²| of such a quaternion, by the same argument.
LENGTH_TOLERANCE = 4 / 8192 + 2e-6

#: A quaternion with |1 - |q|²| up to this is taken as it is, so that it reads back bit for bit: it moves a point a
#: metre away by half a nanometre at most.
EXACT = 1e-9

#: Positions beyond this, mm, are no tracker's: a slip of the unit or a damaged file. A kilometre, assumed.
FARTHEST_MM = 1e6


def is_rotation(matrix: Array) -> np.ndarray:
    """Which of ``(n, 3, 3)`` finite matrices are rotations, as far as trackers know them, (n,) bool."""
    small = np.max(np.abs(matrix), axis=(1, 2)) < 2.0
    r = np.where(small[:, None, None], matrix, 0.0)
    error = np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max(axis=(1, 2))
    return np.asarray((error <= ROTATION_TOLERANCE) & (np.linalg.det(r) > 0.0))


def unit_quaternions(quaternion: Array, ok: np.ndarray, name: str, rows: Sequence[str]) -> Array:
    """``(n, 4)`` wxyz as read, of length 1; what is not ``ok`` becomes the identity.

    Raises ConfigError that names one of ``rows``, by which a reader finds it in the file, where it is no rotation.
    """
    q = np.where(ok[:, None], quaternion, [1.0, 0.0, 0.0, 0.0])
    q = np.where(np.max(np.abs(q), axis=1)[:, None] < 2.0, q, 0.0)
    excess = np.abs(np.sum(q * q, axis=1) - 1.0)
    good = excess <= LENGTH_TOLERANCE
    if not good.all():
        raise ConfigError(f"{name}: {rows[int(np.argmin(good))]}: the quaternion is not of length 1")
    length = np.where(excess <= EXACT, 1.0, np.linalg.norm(q, axis=1))
    return np.asarray(q / length[:, None])
