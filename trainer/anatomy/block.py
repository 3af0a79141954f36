"""A block cut out of a knee along the axes of a scene: around one structure, at the scene's own resolution.

A scene needs little of a knee, and not on the grid of whoever scanned it. Its origin is the middle of one structure, so
that a task's marks mean the same place in any knee: y runs up the patient or up along the structure, x to the front at
right angles to it, z to the right of the patient. Each element has the label of the knee's voxel that it lies in.
"""

from __future__ import annotations

import numpy as np

from trainer.anatomy.imported import Anatomy
from trainer.anatomy.structures import number_of, structures
from trainer.config import ConfigError
from trainer.curriculum import KneeSpec
from trainer.geometry import Array, Rigid, lengthwise, quaternion_from_axes, unit

#: To the front and up, LPS.
FRONT, UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def cut_out(anatomy: Anatomy, spec: KneeSpec) -> tuple[np.ndarray, Array]:
    """Labels (nx, ny, nz) uint8 of cubes of ``spec.voxel_mm``, and where in the scene the first one's centre (3,) is.

    Raises ConfigError for a knee that has not the structure in the middle.
    """
    place = lps_from_scene(anatomy, spec)
    h, low = spec.voxel_mm, np.array(spec.low_mm)
    size = np.maximum(np.floor((np.array(spec.high_mm) - low) / h + 0.5).astype(int), 1)
    corner = low + 0.5 * h
    volume = anatomy.volume
    volume_from_scene = volume.lps_from_volume.inverse() @ place
    step = volume_from_scene.matrix * (h / np.array(volume.spacing_mm))[:, None]
    first = volume_from_scene.apply(corner) / np.array(volume.spacing_mm) + 0.5
    labels = np.zeros(tuple(size), dtype=np.uint8)
    j, k = np.meshgrid(np.arange(size[1]), np.arange(size[2]), indexing="ij")
    plane = first + j[..., None] * step[:, 1] + k[..., None] * step[:, 2]
    for i in range(size[0]):
        index = np.floor(plane + i * step[:, 0]).astype(np.int64)
        inside = np.all((index >= 0) & (index < volume.labels.shape), axis=-1)
        a, b, c = np.where(inside[..., None], index, 0).transpose(2, 0, 1)
        labels[i] = np.where(inside, volume.labels[a, b, c], 0)
    return labels, corner


def lps_from_scene(anatomy: Anatomy, spec: KneeSpec) -> Rigid:
    """Where a scene's frame is in the patient. Raises ConfigError for a structure that is unknown or not there."""
    if spec.about not in structures():
        raise ConfigError(f"unknown structure '{spec.about}'; known: {', '.join(structures())}")
    points = anatomy.volume.points_mm(number_of(spec.about))
    if not len(points):
        raise ConfigError(f"anatomy '{anatomy.name}' has no {spec.about}, around which the task's scene lies")
    middle = points.mean(axis=0)
    up = UP
    if spec.axis == "along":
        longest = lengthwise(points)
        up = longest * (1.0 if longest @ UP >= 0.0 else -1.0)
    return Rigid(middle, quaternion_from_axes(unit(FRONT - (FRONT @ up) * up), up))
