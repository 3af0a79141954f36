"""Rotations, rigid transforms and resampling of poses.

Quaternions are scalar first (w, x, y, z) and of unit length; transforms are named ``a_from_b``:
``world_from_tool.apply(p_tool)`` gives a point in the world frame. Lengths are mm, angles radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def unit(v: ArrayLike) -> Array:
    """Vector(s) ``(..., 3)`` scaled to length 1. Raises ValueError for a zero vector."""
    a = np.asarray(v, dtype=np.float64)
    if a.shape == (3,):  # a dozen in a tick, in a fifth of the time
        size = math.hypot(*a.tolist())
        if size == 0.0:
            raise ValueError("a direction of zero length has no unit vector")
        return np.asarray(a / size)
    length = np.linalg.norm(a, axis=-1, keepdims=True)
    if np.any(length == 0.0):
        raise ValueError("a direction of zero length has no unit vector")
    return np.asarray(a / length)


def length(v: Array) -> float:
    """The length of a vector (3,); numpy's general routine costs five times as much at this size."""
    return math.hypot(*v.tolist())


def cross(a: Array, b: Array) -> Array:
    """a × b for two vectors (3,); numpy's general routine costs ten times as much at this size."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def lengthwise(points: Array) -> Array:
    """The direction (3,), of length 1, along which points (n, 3) are spread the most; either way."""
    return np.asarray(np.linalg.eigh(np.cov((points - points.mean(axis=0)).T))[1][:, 2])


def quaternion_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Hamilton product of quaternions ``(..., 4)``: the rotation b followed by a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, dtype=np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, dtype=np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quaternion_conjugate(q: ArrayLike) -> Array:
    """The inverse rotation of unit quaternion(s) ``(..., 4)``."""
    return np.asarray(np.asarray(q, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0]))


def quaternion_from_axis_angle(axis: ArrayLike, angle: float) -> Array:
    """Rotation by ``angle`` rad about ``axis`` (3,), which need not have length 1."""
    half = 0.5 * angle
    return np.concatenate([[np.cos(half)], np.sin(half) * unit(axis)])


def quaternion_from_matrix(r: ArrayLike) -> Array:
    """Unit quaternion(s) ``(..., 4)`` of rotation matrices ``(..., 3, 3)``, by Shepperd's method.

    A matrix that is orthogonal only to the precision of a tracker's text file is accepted: the
    quaternion is normalised. The sign is chosen so that the first non-zero of w, x, y, z is positive.
    """
    m = np.asarray(r, dtype=np.float64)
    flat = m.reshape(-1, 3, 3)
    trace = np.trace(flat, axis1=1, axis2=2)
    diagonal = np.concatenate([trace[:, None], np.diagonal(flat, axis1=1, axis2=2)], axis=1)
    out = np.zeros((len(flat), 4))
    for k, a in enumerate(flat):
        largest = int(np.argmax(diagonal[k]))
        if largest == 0:
            q = [1.0 + trace[k], a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]]
        else:
            i = largest - 1
            j, n = (i + 1) % 3, (i + 2) % 3
            q = [a[n, j] - a[j, n], 0.0, 0.0, 0.0]
            q[1 + i] = 1.0 + a[i, i] - a[j, j] - a[n, n]
            q[1 + j] = a[j, i] + a[i, j]
            q[1 + n] = a[n, i] + a[i, n]
        out[k] = q
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    first = out[np.arange(len(out)), np.argmax(np.abs(out) > 1e-15, axis=1)]
    out *= np.sign(first)[:, None]
    return out.reshape((*m.shape[:-2], 4))


def quaternion_from_axes(x: ArrayLike, y: ArrayLike) -> Array:
    """The rotation whose first axis is ``x`` and whose second lies in the plane of ``x`` and ``y``."""
    ex = unit(x)
    yy = np.asarray(y, dtype=np.float64)
    ey = unit(yy - np.dot(yy, ex) * ex)
    return quaternion_from_matrix(np.stack([ex, ey, cross(ex, ey)], axis=-1))


def quaternion_from_euler_deg(xyz_deg: ArrayLike) -> Array:
    """Rotation by x, then y, then z degrees about the fixed axes (extrinsic xyz), as in TOML files."""
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in zip(np.eye(3), np.radians(np.asarray(xyz_deg, dtype=np.float64)), strict=True):
        q = quaternion_multiply(quaternion_from_axis_angle(axis, float(angle)), q)
    return q


def matrix_from_quaternion(q: ArrayLike) -> Array:
    """Rotation matrix ``(..., 3, 3)`` of unit quaternion(s) ``(..., 4)``."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=-2,
    )


def slerp(a: ArrayLike, b: ArrayLike, fraction: ArrayLike) -> Array:
    """Shortest great-circle interpolation between quaternions ``(..., 4)`` at ``fraction`` ``(...)`` in 0..1."""
    qa = np.asarray(a, dtype=np.float64)
    qb = np.asarray(b, dtype=np.float64)
    f = np.asarray(fraction, dtype=np.float64)[..., None]
    cosine = np.sum(qa * qb, axis=-1, keepdims=True)
    qb = np.where(cosine < 0.0, -qb, qb)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    # Below 1e-6 rad the chord and the arc agree to 1e-13, and the sine quotient loses its digits.
    near = angle < 1e-6
    sine = np.where(near, 1.0, np.sin(angle))
    wa = np.where(near, 1.0 - f, np.sin((1.0 - f) * angle) / sine)
    wb = np.where(near, f, np.sin(f * angle) / sine)
    q = wa * qa + wb * qb
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


@dataclass(frozen=True)
class Rigid:
    """A rigid transform a_from_b: rotation ``quaternion`` (4,) wxyz, then translation ``position`` (3,) mm."""

    position: Array
    quaternion: Array

    @staticmethod
    def identity() -> Rigid:
        return Rigid(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    @cached_property
    def matrix(self) -> Array:
        """The rotation as a (3, 3) matrix, by scalars: dozens are asked for in a tick."""
        w, x, y, z = self.quaternion.tolist()
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    def apply(self, points_b: ArrayLike) -> Array:
        """Points ``(..., 3)`` of frame b in frame a."""
        return np.asarray(np.dot(np.asarray(points_b, dtype=np.float64), self.matrix.T) + self.position)

    def rotate(self, directions_b: ArrayLike) -> Array:
        """Directions ``(..., 3)`` of frame b in frame a."""
        return np.asarray(np.dot(np.asarray(directions_b, dtype=np.float64), self.matrix.T))

    def inverse(self) -> Rigid:
        """b_from_a."""
        w, x, y, z = self.quaternion.tolist()
        return Rigid(-np.dot(self.position, self.matrix), np.array([w, -x, -y, -z]))

    def __matmul__(self, b_from_c: Rigid) -> Rigid:
        """a_from_c = a_from_b @ b_from_c."""
        aw, ax, ay, az = self.quaternion.tolist()
        bw, bx, by, bz = b_from_c.quaternion.tolist()
        w = aw * bw - ax * bx - ay * by - az * bz
        x = aw * bx + ax * bw + ay * bz - az * by
        y = aw * by - ax * bz + ay * bw + az * bx
        z = aw * bz + ax * by - ay * bx + az * bw
        size = math.sqrt(w * w + x * x + y * y + z * z)
        return Rigid(self.apply(b_from_c.position), np.array([w / size, x / size, y / size, z / size]))


def fit_rotation(rest: ArrayLike, now: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """The rotation (3, 3) that best carries the points ``rest`` (n, 3) to ``now`` (n, 3), means removed.

    Least squares by singular values (Kabsch 1976), reflection excluded.
    """
    p = np.asarray(rest, dtype=np.float64)
    q = np.asarray(now, dtype=np.float64)
    w = np.ones(len(p)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    covariance = ((p - w @ p) * w[:, None]).T @ (q - w @ q)
    u, _, vt = np.linalg.svd(covariance)
    d = np.sign(np.linalg.det(u @ vt))
    return np.asarray(vt.T @ np.diag([1.0, 1.0, d]) @ u.T)
