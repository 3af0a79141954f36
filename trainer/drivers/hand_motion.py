"""How a hand moves: paces, tremor, and paths that go round a vessel."""

from __future__ import annotations

import math

import numpy as np

from trainer.geometry import Array, Rigid, cross, quaternion_from_matrix, slerp, unit

#: Width of the tremor's resonance, Hz. Assumed: physiological tremor is a narrow band around its peak.
TREMOR_WIDTH_HZ = 2.0


class Tremor:
    """Band-limited noise of a hand-held tip: a resonator at ``hz`` driven by white noise on each axis.

    x_k = a1 x_{k-1} + a2 x_{k-2} + e_k has its poles at radius exp(-π B dt) and angle 2π f dt, and the variance
    (1 - a2) σ² / ((1 + a2) ((1 - a2)² - a1²)), from which σ follows for a wanted root mean square of the length.
    """

    def __init__(self, rms_mm: float, hz: float, dt: float, rng: np.random.Generator) -> None:
        radius = math.exp(-math.pi * TREMOR_WIDTH_HZ * dt)
        self._a1 = 2.0 * radius * math.cos(2.0 * math.pi * hz * dt)
        self._a2 = -radius * radius
        gain = (1.0 - self._a2) / ((1.0 + self._a2) * ((1.0 - self._a2) ** 2 - self._a1**2))
        self._sigma = rms_mm / math.sqrt(3.0 * gain)
        self._rng = rng
        self._last = np.zeros(3)
        self._before = np.zeros(3)

    def next(self) -> Array:
        """Displacement (3,) mm of the next tick."""
        now = self._a1 * self._last + self._a2 * self._before
        if self._sigma > 0.0:
            now = now + self._sigma * self._rng.standard_normal(3)
        self._before, self._last = self._last, now
        return now


def ease(u: float) -> float:
    """Progress 0..1 of a minimum-jerk movement at the fraction ``u`` of its duration (Flash & Hogan 1985)."""
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


def between(a: Rigid, b: Rigid, u: float) -> Rigid:
    """The pose at progress ``u`` on the straight way from ``a`` to ``b``."""
    return Rigid((1.0 - u) * a.position + u * b.position, slerp(a.quaternion, b.quaternion, u))


def turn_angle(a: Rigid, b: Rigid) -> float:
    """Angle in rad between the orientations of two poses."""
    return 2.0 * math.acos(min(1.0, abs(float(a.quaternion @ b.quaternion))))


def needle_pose(point: Array, tangent: Array, inward: Array, arc: float, radius: float) -> Rigid:
    """world_from_needle of a circular needle of ``radius`` whose point at ``arc`` mm from the tip is at ``point``.

    There it runs along ``tangent`` (towards the tip) and bends towards ``inward`` (to the circle's centre), both unit
    and at right angles. In the needle's frame the tip is the origin, the tangent there +x, the centre on +y.
    """
    phi = arc / radius
    s, c = math.sin(phi), math.cos(phi)
    in_needle = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # columns: tangent, inward, normal
    in_world = np.stack([tangent, inward, cross(tangent, inward)], axis=-1)
    rotation = in_world @ in_needle.T
    return Rigid(point - rotation @ np.array([-radius * s, radius * (1.0 - c), 0.0]), quaternion_from_matrix(rotation))


def along_arc(pose: Rigid, distance: float, radius: float) -> Rigid:
    """The needle moved by ``distance`` mm along its own circle, tip first."""
    matrix = pose.matrix
    centre = pose.position + radius * matrix[:, 1]
    phi = distance / radius
    s, c = math.sin(phi), math.cos(phi)
    turned = np.stack([c * matrix[:, 0] + s * matrix[:, 1], c * matrix[:, 1] - s * matrix[:, 0], matrix[:, 2]], axis=-1)
    return Rigid(centre - radius * turned[:, 1], quaternion_from_matrix(turned))


def round_vessel(start: Array, end: Array, origin: Array, axis: Array, clearance: float) -> list[Array]:
    """Waypoints (3,) from ``start`` to ``end`` that stay ``clearance`` mm from a vessel's axis on the way round it.

    Straight out from the axis, round it at that distance in steps of a sixth of a turn at most, straight in.
    """

    def split(p: Array) -> tuple[float, Array]:
        height = float((p - origin) @ axis)
        out = p - origin - height * axis
        return height, out

    h0, r0 = split(start)
    h1, r1 = split(end)
    if np.linalg.norm(r0) < 1e-6 or np.linalg.norm(r1) < 1e-6:
        return [start, end]
    u0, u1 = unit(r0), unit(r1)
    side = cross(axis, u0)
    angle = math.atan2(float(u1 @ side), float(u1 @ u0))
    n = max(1, math.ceil(abs(angle) / (math.pi / 3.0)))
    d0, d1 = max(clearance, float(np.linalg.norm(r0))), max(clearance, float(np.linalg.norm(r1)))
    ring = []
    for k in range(n + 1):
        f = k / n
        direction = math.cos(f * angle) * u0 + math.sin(f * angle) * side
        ring.append(origin + ((1 - f) * h0 + f * h1) * axis + ((1 - f) * d0 + f * d1) * direction)
    return [start, *ring, end]
