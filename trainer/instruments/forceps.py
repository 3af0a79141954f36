"""Microsurgical forceps: two rigid blades that turn about their proximal ends.

Virtual tools are rigid triangulated parts whose relative rotation a device controls (Brown et al. 2001,
section 2). In the instrument's frame the origin lies between the tips, +x points out of the tips (distal)
and +y is the direction in which the jaws open. Each blade has a frame of its own: origin at the axis it
turns about, ``BLADE_MM`` behind the tips, axes along the instrument's when the jaws are closed.

All measures are assumed (the shape of a straight jeweller's forceps; no maker's drawing was read). Only the
distal 12 mm are modelled: whole forceps of 100 mm and more would dwarf a vessel of 1 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array, Rigid

#: Length of a blade from its axis to its tip, mm.
BLADE_MM = 12.0
#: Distance of the tips at closure 0, mm.
OPEN_GAP_MM = 1.0
#: Width (along z) and thickness (along y) of a blade at its tip and at its axis, mm.
TIP_WIDTH_MM, TIP_THICKNESS_MM = 0.10, 0.08
ROOT_WIDTH_MM, ROOT_THICKNESS_MM = 0.90, 0.45
#: The flat that grips: the inner faces touch this far back from the tips when closed, mm.
PLATFORM_MM = 1.0
#: Distance of the closed blades' inner faces from the middle plane at the axis, mm.
ROOT_CLEARANCE_MM = 0.5

_OPEN_ANGLE = math.asin(0.5 * OPEN_GAP_MM / BLADE_MM)
_STATIONS = 25
# Where the capsules' axes begin and end along a blade, mm from its axis: the last one at its tip.
_CAPSULE_STATIONS = np.array([0.0, 4.0, 8.0, BLADE_MM - PLATFORM_MM, BLADE_MM])
_AROUND = 12


@dataclass(frozen=True)
class Blade:
    """A rigid part in its own frame: a closed surface, triangles counter-clockwise from outside."""

    name: str  # upper (+y) or lower (-y)
    vertices: Array  # (v, 3) mm, blade frame
    triangles: np.ndarray  # (f, 3) int32


def parts() -> tuple[Blade, Blade]:
    """The upper and the lower blade, in the order of :func:`part_poses`."""
    vertices, triangles = _upper_blade()
    mirrored = vertices * np.array([1.0, -1.0, 1.0])
    return (
        Blade("upper", vertices, triangles),
        Blade("lower", mirrored, np.ascontiguousarray(triangles[:, ::-1])),
    )


def part_poses(world_from_tool: Rigid, closure: float) -> tuple[Array, Array]:
    """Where the blades are: positions (2, 3) mm and quaternions (2, 4) wxyz, world_from_blade."""
    half = 0.5 * _blade_angle(closure)
    axis = np.array([-BLADE_MM, 0.0, 0.0])
    blades = [
        world_from_tool @ Rigid(axis, np.array([math.cos(half), 0.0, 0.0, side * math.sin(half)]))
        for side in (1.0, -1.0)
    ]
    return np.array([b.position for b in blades]), np.array([b.quaternion for b in blades])


def capsules(world_from_tool: Rigid, closure: float) -> tuple[Array, Array]:
    """The blades as tapered capsules: the ends (16, 3) mm of eight axes, upper blade first, and the radii (16,) there.

    A capsule's section has the area of a rectangle around the blade's.
    """
    half = 0.5 * _blade_angle(closure)
    c, s = math.cos(half), math.sin(half)
    ends = np.empty((2, len(_CAPSULE_X), 3))
    for blade, side in enumerate((1.0, -1.0)):
        ends[blade, :, 0] = c * _CAPSULE_X - s * _CAPSULE_Y - BLADE_MM
        ends[blade, :, 1] = side * (s * _CAPSULE_X + c * _CAPSULE_Y)
    ends[:, :, 2] = 0.0
    return world_from_tool.apply(ends.reshape(-1, 3)), _CAPSULE_RADIUS


def jaw_gap_mm(closure: float) -> float:
    """Distance of the tips' inner faces at a closure of 0 (open) … 1 (closed)."""
    return 2.0 * BLADE_MM * math.sin(_blade_angle(closure))


def _blade_angle(closure: float) -> float:
    return _OPEN_ANGLE * (1.0 - min(max(closure, 0.0), 1.0))


def _upper_blade() -> tuple[Array, np.ndarray]:
    """D-shaped sections (flat towards the other blade) lofted from root to tip, closed by a fan at each end."""
    x = np.linspace(0.0, BLADE_MM, _STATIONS)
    taper = 1.0 - x / BLADE_MM
    half_width = 0.5 * (TIP_WIDTH_MM + (ROOT_WIDTH_MM - TIP_WIDTH_MM) * taper)
    thickness = TIP_THICKNESS_MM + (ROOT_THICKNESS_MM - TIP_THICKNESS_MM) * taper
    clearance = ROOT_CLEARANCE_MM * np.clip((BLADE_MM - PLATFORM_MM - x) / (BLADE_MM - PLATFORM_MM), 0.0, 1.0)

    # Counter-clockwise seen from the tip (+x towards the eye, y right, z up): the arc from -z over +y to +z;
    # the flat inner face is the chord that closes it.
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, _AROUND)
    sections = np.empty((_STATIONS, _AROUND, 3))
    sections[:, :, 0] = x[:, None]
    sections[:, :, 1] = clearance[:, None] + thickness[:, None] * np.cos(angle)
    sections[:, :, 2] = half_width[:, None] * np.sin(angle)
    sections[:, [0, -1], 1] = clearance[:, None]  # cos(±π/2) is not quite 0: the platform shall be flat

    station, around = np.meshgrid(np.arange(_STATIONS - 1), np.arange(_AROUND), indexing="ij")
    a = (station * _AROUND + around).ravel()
    b = (station * _AROUND + (around + 1) % _AROUND).ravel()
    side = np.concatenate([np.stack([a, b, b + _AROUND], 1), np.stack([a, b + _AROUND, a + _AROUND], 1)])
    k = np.arange(1, _AROUND - 1)
    root = np.stack([np.zeros_like(k), k + 1, k], axis=1)
    tip = (_STATIONS - 1) * _AROUND + np.stack([np.zeros_like(k), k, k + 1], axis=1)
    return sections.reshape(-1, 3), np.concatenate([side, root, tip]).astype(np.int32)


def _capsules() -> tuple[Array, Array, Array]:
    """Along the blade (8,), out of the middle plane (8,) and radii (8,) mm of the upper blade's axes' ends."""
    x = np.repeat(_CAPSULE_STATIONS, 2)[1:-1]
    taper = 1.0 - x / BLADE_MM
    width = TIP_WIDTH_MM + (ROOT_WIDTH_MM - TIP_WIDTH_MM) * taper
    thickness = TIP_THICKNESS_MM + (ROOT_THICKNESS_MM - TIP_THICKNESS_MM) * taper
    clearance = ROOT_CLEARANCE_MM * np.clip((BLADE_MM - PLATFORM_MM - x) / (BLADE_MM - PLATFORM_MM), 0.0, 1.0)
    radius = 0.5 * np.sqrt(width * thickness)
    return np.minimum(x, BLADE_MM - radius[-1]), clearance + 0.5 * thickness, radius


_CAPSULE_X, _CAPSULE_Y, _RADII = _capsules()
_CAPSULE_RADIUS = np.tile(_RADII, 2)
