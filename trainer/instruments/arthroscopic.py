"""Instruments of an arthroscopy: a shaft with two jaws that turn about its end, a grasper's or the blades of scissors.

In the instrument's frame the origin lies between the tips of the jaws, +x points out of them (distal) and +y is the
direction in which they open, as for forceps. All measures are assumed: a shaft of 4 mm for a portal of 5 mm, jaws of
8 mm that open by 45 degrees; no maker's drawing was read.
"""

from __future__ import annotations

import math

import numpy as np

from trainer.geometry import Array, Rigid
from trainer.instruments.forceps import Blade

#: Length of a jaw from its axis to its tip, mm.
JAW_MM = 8.0
#: Each jaw's angle from the middle at closure 0, rad.
OPEN_ANGLE = math.radians(22.5)
#: Thickness of a jaw at its axis and at its tip, and its width, mm.
ROOT_MM, TIP_MM, WIDTH_MM = 1.6, 0.6, 2.4
#: Radius of the shaft and the length of it that is shown, mm.
SHAFT_RADIUS_MM, SHAFT_MM = 2.0, 60.0
_AROUND = 16


def jaw_angle(closure: float) -> float:
    """Angle (rad) of a jaw from the middle at a closure of 0 (open) … 1 (closed)."""
    return OPEN_ANGLE * (1.0 - min(max(closure, 0.0), 1.0))


def edges(pose: Rigid, closure: float) -> Array:
    """The cutting edges (2, 2, 3) mm of scissors: for each blade its end at the axis and its tip."""
    angle = jaw_angle(closure)
    axis = np.array([-JAW_MM, 0.0, 0.0])
    tips = [axis + JAW_MM * np.array([math.cos(angle), side * math.sin(angle), 0.0]) for side in (1.0, -1.0)]
    return np.stack([np.stack([pose.apply(axis), pose.apply(tip)]) for tip in tips])


def parts() -> tuple[Blade, Blade, Blade]:
    """The upper and the lower jaw and the shaft, in the order of :func:`part_poses`."""
    half = 0.5 * WIDTH_MM
    section = np.array([[0.0, -half], [0.0, half], [1.0, 0.5 * half], [1.0, -0.5 * half]])
    rings = [np.column_stack([np.full(4, x), thick * section[:, 0], section[:, 1]])
             for x, thick in ((0.0, ROOT_MM), (JAW_MM, TIP_MM))]  # fmt: skip
    upper, triangles = _prism(*rings)
    lower = upper * np.array([1.0, -1.0, 1.0])
    return (
        Blade("upper", upper, triangles),
        Blade("lower", lower, np.ascontiguousarray(triangles[:, ::-1])),
        cylinder("shaft", SHAFT_RADIUS_MM, -SHAFT_MM, 0.0),
    )


def cylinder(name: str, radius_mm: float, from_mm: float, to_mm: float) -> Blade:
    """A closed cylinder about the x axis."""
    turn = np.linspace(0.0, 2.0 * math.pi, _AROUND, endpoint=False)
    circle = radius_mm * np.column_stack([np.cos(turn), np.sin(turn)])
    return Blade(name, *_prism(*(np.column_stack([np.full(_AROUND, x), circle]) for x in (from_mm, to_mm))))


def part_poses(world_from_tool: Rigid, closure: float) -> tuple[Array, Array]:
    """Where jaws and shaft are: positions (3, 3) mm and quaternions (3, 4) wxyz, world_from_part."""
    angle = jaw_angle(closure)
    axis = np.array([-JAW_MM, 0.0, 0.0])
    placed = [
        world_from_tool @ Rigid(axis, np.array([math.cos(0.5 * a), 0.0, 0.0, math.sin(0.5 * a)]))
        for a in (angle, -angle, 0.0)
    ]
    return np.array([p.position for p in placed]), np.array([p.quaternion for p in placed])


def _prism(root: Array, tip: Array) -> tuple[Array, np.ndarray]:
    """A closed surface between two rings (n, 3) that run counter-clockwise seen from the tip's side (+x)."""
    n = len(root)
    a = np.arange(n)
    b = (a + 1) % n
    side = np.concatenate([np.stack([a, b, b + n], 1), np.stack([a, b + n, a + n], 1)])
    k = np.arange(1, n - 1)
    zero = np.zeros_like(k)
    ends = np.concatenate([np.stack([zero, k + 1, k], 1), np.stack([zero + n, k + n, k + 1 + n], 1)])
    return np.concatenate([root, tip]), np.concatenate([side, ends]).astype(np.int32)
