"""Contacts of a rod with round jaws: the obstacles about which the laws of a rope are known, which no scene has."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array
from trainer.mechanics.closest_points import segment_segment
from trainer.mechanics.thread_contact import _add, _kept, _normal
from trainer.mechanics.thread_rod_newton import Contacts

SAME_SIDE = 0.5  # cosine of the angle between normals of a tick's start and end up to which the end's is taken


@njit(nogil=True, error_model="numpy")
def _capsule_normal(x: Array, i: int, axis: Array, j: int) -> tuple[float, ...]:
    """Squared distance, the nearest points' places on link and axis, and the normal (3) to the link."""
    squared, s, r = segment_segment(x, i, i + 1, axis, 2 * j, 2 * j + 1)
    nx, ny, nz, _ = _normal(
        (1.0 - s) * x[i, 0] + s * x[i + 1, 0] - (1.0 - r) * axis[2 * j, 0] - r * axis[2 * j + 1, 0],
        (1.0 - s) * x[i, 1] + s * x[i + 1, 1] - (1.0 - r) * axis[2 * j, 1] - r * axis[2 * j + 1, 1],
        (1.0 - s) * x[i, 2] + s * x[i + 1, 2] - (1.0 - r) * axis[2 * j, 2] - r * axis[2 * j + 1, 2],
        x[i + 1, 0] - x[i, 0], x[i + 1, 1] - x[i, 1], x[i + 1, 2] - x[i, 2],
        axis[2 * j + 1, 0] - axis[2 * j, 0],
        axis[2 * j + 1, 1] - axis[2 * j, 1],
        axis[2 * j + 1, 2] - axis[2 * j, 2],
    )  # fmt: skip
    return squared, s, r, nx, ny, nz


@njit(nogil=True, error_model="numpy")
def _capsules(
    contacts: Contacts, x: Array, x_next: Array, radius: float, axis: Array, axis_end: Array, radii: Array,
    pairs: NDArray[np.int32], friction: float, margin: float,
) -> bool:  # fmt: skip
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        reach = radius + radii[j]
        squared, s, r, nx, ny, nz = _capsule_normal(x, i, axis, j)
        if squared > (reach + margin) ** 2:
            continue
        _, s_next, r_next, ux, uy, uz = _capsule_normal(x_next, i, axis_end, j)
        if nx * ux + ny * uy + nz * uz > SAME_SIDE:
            s, r, nx, ny, nz = s_next, r_next, ux, uy, uz
        qx = (1.0 - r) * axis[2 * j, 0] + r * axis[2 * j + 1, 0]
        qy = (1.0 - r) * axis[2 * j, 1] + r * axis[2 * j + 1, 1]
        qz = (1.0 - r) * axis[2 * j, 2] + r * axis[2 * j + 1, 2]
        if not _add(
            contacts, i, -1, s, 0.0, nx, ny, nz, nx * qx + ny * qy + nz * qz + reach,
            (1.0 - r) * axis_end[2 * j, 0] + r * axis_end[2 * j + 1, 0] - qx,
            (1.0 - r) * axis_end[2 * j, 1] + r * axis_end[2 * j + 1, 1] - qy,
            (1.0 - r) * axis_end[2 * j, 2] + r * axis_end[2 * j + 1, 2] - qz,
            friction,
        ):  # fmt: skip
            return False
    return True


def touch_capsules(
    contacts: Contacts, x: Array, x_next: Array, radius: float, axis: Array, axis_end: Array, radii: Array,
    pairs: NDArray[np.int32], friction: float, margin: float,
) -> None:  # fmt: skip
    """Add contacts of links with capsules: ``pairs`` (k, 2) of link and capsule.

    ``x_next`` (n, 3) is where the rod is going (``x`` if unknown): as long as it stays on this side of the axis the
    normal is that of the tick's end, so that a sliding thread is not held back by the slope behind it. ``radius`` mm
    of the thread; ``axis`` and ``axis_end`` (2 m, 3) mm the ends of m axes, one after the other, at the
    tick's start and end, ``radii`` (m,) mm. Raises ContactsFull.
    """
    _kept(_capsules(contacts, x, x_next, radius, axis, axis_end, radii, pairs, friction, margin), contacts)
