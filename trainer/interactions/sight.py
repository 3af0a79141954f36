"""What a person sees of a region before touching it: what is not cut yet, and which ways are free."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from trainer.anatomy.structures import number_of
from trainer.geometry import Array, lengthwise
from trainer.interactions.region import Region
from trainer.mechanics.volume import Indices, grid_strides

#: How far above and below a level a cut is looked for: as far as a hand misses it. Assumed.
LEVEL_MM = 4.0
#: How near to other things a straight way into the joint may lead, mm, and how many places of a structure are passed
#: over in looking for one: they lie close together. Assumed.
CLEARANCE_MM, SIGHT_EVERY = 2.0, 7
#: How far from what is rigid a tip is led past it, mm: six times a practised hand's tremor of 0.04 mm rms. Assumed.
PAST_MM = 0.25


def uncut_at(region: Region, structure: str, place: Array) -> Indices:
    """The elements (k,) of a structure at the level of ``place`` (3,) along it that nothing has been cut from.

    Looked at is LEVEL_MM to each side, along the axis of the grid that the structure is nearest to. At its sides,
    where the structure does not go on along that axis, there is nothing to cut. Where all is cut, but at different
    levels, told are the strands that hold together still.
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
    uncut = level[~np.any([np.isin(region.beside(level, axis, k), opened) for k in steps], axis=0)]
    return uncut if len(uncut) else _strands(region, elements, (rest - place) @ way, axis)


def _strands(region: Region, elements: Indices, height: Array, axis: int) -> Indices:
    """What stands below (k,) and is linked to what hangs from above, of ``elements`` (n,) at heights (n,) over a cut.

    It is, where the cuts beside each other are at different levels: links across hold both sides together.
    """
    near = np.abs(height) <= LEVEL_MM
    slab, height = elements[near], height[near]
    edge = LEVEL_MM - region.volume.spacing_mm[axis]
    both = (2 * axis, 2 * axis + 1)
    below = _linked(region, slab, slab[height < -edge], both)
    above = np.setdiff1d(_linked(region, slab, slab[height > edge], both), below)
    hanging = _linked(region, np.setdiff1d(slab, below), above, range(6))
    across = np.concatenate([_neighbours(region, hanging, step) for step in range(6)])
    return np.intersect1d(across, below).astype(np.int32)


def _linked(region: Region, among: Indices, start: Indices, steps: Iterable[int]) -> Indices:
    """``start`` (k,) and all of ``among`` (n,) that links in the directions ``steps`` lead to from there."""
    found = last = start
    while len(last):
        reached = np.concatenate([_neighbours(region, last, step) for step in steps])
        last = np.setdiff1d(np.intersect1d(reached, among), found)
        found = np.union1d(found, last)
    return found


def _neighbours(region: Region, elements: Indices, step: int) -> Indices:
    """Those that ``elements`` (k,) are linked to in one of the six directions."""
    linked = elements[(region.state.links[elements] & (1 << step)) != 0]
    return np.asarray(linked + grid_strides(region.volume)[step], dtype=np.int32)


def free_mm(region: Region, place: Array, way: Array, most_mm: float) -> float:
    """How far from ``place`` (3,) a tip keeps PAST_MM from everything rigid on its straight way, up to ``most_mm``.

    ``way`` (3,) is a unit vector; what moves is in no way.
    """
    h = np.array(region.volume.spacing_mm)
    rigid = (region.labels > 0) & ~np.isin(region.labels, [number_of(s) for s in region.elements])
    along = np.linspace(0.0, most_mm, 1 + math.ceil(most_mm / (0.5 * PAST_MM)))
    around = PAST_MM * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    points = (place + along[:, None] * way)[:, None] + around
    if region.flat >= 0:
        points[..., region.flat] = region.origin[region.flat]
    index = np.floor((points - region.corner) / h + 0.5).astype(int)
    there = ((index >= 0) & (index < rigid.shape)).all(axis=2)
    i, j, k = np.moveaxis(np.clip(index, 0, np.array(rigid.shape) - 1), 2, 0)
    met = (rigid[i, j, k] & there).any(axis=1)
    return float(along[max(int(np.argmax(met)) - 1, 0)]) if met.any() else most_mm


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
