"""What a person sees of a region before touching it: what is not cut yet, and which way in is free."""

from __future__ import annotations

import numpy as np

from trainer.anatomy.structures import number_of
from trainer.geometry import Array, lengthwise
from trainer.interactions.region import Region
from trainer.mechanics.volume import Indices

#: How far above and below a level a cut is looked for: as far as a hand misses it. Assumed.
LEVEL_MM = 4.0
#: How near to other things a straight way into the joint may lead, mm, and how many places of a structure are passed
#: over in looking for one: they lie close together. Assumed.
CLEARANCE_MM, SIGHT_EVERY = 2.0, 7


def uncut_at(region: Region, structure: str, place: Array) -> Indices:
    """The elements (k,) of a structure at the level of ``place`` (3,) along it that nothing has been cut from.

    Looked at is LEVEL_MM to each side, along the axis of the grid that the structure is nearest to. At its sides,
    where the structure does not go on along that axis, there is nothing to cut.
    """
    elements = region.elements[structure]
    rest = region.rest(elements)
    way = lengthwise(rest)
    axis = int(np.argmax(np.abs(way)))
    h = region.volume.spacing_mm[axis]
    both = np.uint8(0b11 << 2 * axis)
    level = elements[np.abs((rest - place) @ way) < h]
    for k in (0, -1, 1):  # who has both links has both neighbours
        level = level[(region.state.links[level + k * region.volume.strides[axis]] & both) == both]
    opened = region.opened.get(structure, np.empty(0, np.int32))
    steps = range(-round(LEVEL_MM / h), round(LEVEL_MM / h) + 1)
    return np.asarray(level[~np.any([np.isin(region.beside(level, axis, k), opened) for k in steps], axis=0)])


def in_sight(region: Region, structure: str, eye: Array) -> Array | None:
    """Where a straight way from ``eye`` (3,) meets a structure first, with as much room around its end as there is.

    Of such places (3,) mm at rest the nearest; the way keeps CLEARANCE_MM from everything until near its end, and
    there from everything else, or less where that cannot be. None where there is no such way.
    """
    h = np.array(region.volume.spacing_mm)
    own = region.labels == number_of(structure)
    places = region.corner + np.argwhere(own) * h
    away = np.linalg.norm(places - eye, axis=1)
    room = round(CLEARANCE_MM / min(h))
    blocked = _grown(region.labels > 0, room)
    for margin in range(room, -1, -1):
        others = _grown((region.labels > 0) & ~own, margin)
        for e in np.argsort(away, kind="stable")[::SIGHT_EVERY]:
            along = np.arange(0.0, away[e], 0.5 * min(h))
            points = eye + along[:, None] * (places[e] - eye) / away[e]
            index = np.floor((points - region.corner) / h + 0.5).astype(int)
            i, j, k = np.clip(index, 0, np.array(region.labels.shape) - 1).T
            if not np.where(along > away[e] - 2.0 * CLEARANCE_MM, others[i, j, k], blocked[i, j, k]).any():
                return np.asarray(places[e])
    return None


def _grown(inside: np.ndarray, voxels: int) -> np.ndarray:
    """``inside`` (nx, ny, nz) and all that is at most so many steps along the axes from it."""
    grown = inside.copy()
    for _ in range(voxels):
        before = grown.copy()
        for axis in range(3):
            to, of = np.moveaxis(grown, axis, 0), np.moveaxis(before, axis, 0)
            to[1:] |= of[:-1]
            to[:-1] |= of[1:]
    return grown
