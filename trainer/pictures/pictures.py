"""The three pictures of a knee: a section, its surfaces, and all of it see-through.

Arrays are (height, width, 3) uint8, rows from the top. Everything is in the volume's frame, mm.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np

from trainer.geometry import Array, unit
from trainer.pictures.camera import Camera
from trainer.pictures.marching import TILE, march
from trainer.pictures.solid import Solid

#: Parts that a picture's tiles are dealt into for each thread, so that none waits long for the last.
PARTS = 4


@dataclass(frozen=True)
class Plane:
    """A rectangle in space that a section shows."""

    centre_mm: Array  # (3,)
    right: Array  # (3,) what runs to the right in the picture
    down: Array  # (3,) made perpendicular to ``right``
    pixel_mm: float
    width: int  # pixels
    height: int


def section(solid: Solid, plane: Plane) -> np.ndarray:
    """The labels that a plane cuts, each pixel in the colour of the voxel it lies in; black outside."""
    right = unit(plane.right)
    down = np.asarray(plane.down, dtype=np.float64)
    down = unit(down - (down @ right) * right)
    a = (np.arange(plane.width) - 0.5 * (plane.width - 1)) * plane.pixel_mm
    b = (np.arange(plane.height) - 0.5 * (plane.height - 1)) * plane.pixel_mm
    points = plane.centre_mm + b[:, None, None] * down + a[None, :, None] * right
    index = np.floor(points / solid.spacing_mm + 0.5).astype(np.int64)
    inside = np.all((index >= 0) & (index < solid.labels.shape), axis=-1)
    i, j, k = np.where(inside[..., None], index, 0).transpose(2, 0, 1)
    return np.where(inside[..., None], solid.look.colour[solid.labels[i, j, k]], 0).astype(np.uint8)


def surface(solid: Solid, camera: Camera) -> tuple[np.ndarray, Array]:
    """What is seen first, lit from the eye; and its depth (height, width) mm, infinite where nothing is."""
    return _march(solid, camera, see_through=False)


def see_through(solid: Solid, camera: Camera) -> np.ndarray:
    """All structures, each letting through what its opacity leaves of the light behind it."""
    return _march(solid, camera, see_through=True)[0]


def _march(solid: Solid, camera: Camera, see_through: bool) -> tuple[np.ndarray, Array]:
    picture = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    depth = np.full((camera.height, camera.width), np.inf)
    tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
    rays = camera.rays()

    def part(first: int, last: int) -> None:
        march(
            solid.labels, solid.density, solid.bricks, solid.spacing_mm, solid.look.colour, solid.look.opacity_per_mm,
            rays, see_through, first, last, picture, depth,
        )  # fmt: skip

    threads = _threads()
    edges = np.linspace(0, tiles, min(PARTS * threads, tiles) + 1).astype(int).tolist()
    list(_pool().map(part, edges[:-1], edges[1:]))
    return picture, depth


def _threads() -> int:
    """One core is left to the simulation."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 2
    return max(cores - 1, 1)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_threads(), thread_name_prefix="pictures")
