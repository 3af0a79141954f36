"""Cutting, tearing and erasing a volume: links that break (Gibson et al. 1998, 3.4).

A knife's edge sweeps a quadrilateral between two ticks; links that run through it break. Where the knife meets the
tissue is found by places, deformed as they are now, not by the rest grid: the elements that can be near are those whose
rest place is at most as far from the knife as anything has been displaced. Nothing is lost by a cut but links; tissue
springs back because its links no longer hold it, by relaxation.

A link tears when it is beyond its limits and its ends cannot be moved to satisfy it: after ChainMail that is a link to
something that is not free, or between two elements that were pulled different ways.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from trainer.geometry import Array
from trainer.mechanics.volume import (
    FREE,
    LINKS,
    PRESENT,
    Indices,
    Seams,
    Volume,
    VolumeState,
    grid_strides,
    places,
    wake,
)
from trainer.mechanics.volume_drag import drag

#: By how much of its rest length a link must be beyond its limits to tear: above rounding (assumed).
TEAR_SLACK = 1e-3
#: How often what is beyond its limits between free elements is moved before it tears.
ATTEMPTS = 3


@dataclass(frozen=True)
class Change:
    """What an instrument did to a volume's elements."""

    elements: Indices  # (k,) those that lost a link, or were joined or erased; sorted
    links: int  # how many links broke, or were made
    area_mm2: float  # the faces that those links crossed, at rest
    volume_mm3: dict[int, float]  # what ``elements`` take up at rest, by label


def change(volume: Volume, pairs: np.ndarray, sides: np.ndarray) -> Change:
    """The change of links between ``pairs`` (k, 2) of elements in directions ``sides`` (k,)."""
    elements = np.unique(pairs).astype(np.int32)
    faces = volume.element_mm3 / np.array(volume.spacing_mm)
    return Change(elements, len(pairs), float(faces[sides // 2].sum()), volumes_mm3(volume, elements))


def volumes_mm3(volume: Volume, elements: Indices) -> dict[int, float]:
    """What ``elements`` (k,) take up at rest, by label, mm³."""
    labels, counts = np.unique(volume.labels.reshape(-1)[elements], return_counts=True)
    return {int(label): float(count * volume.element_mm3) for label, count in zip(labels, counts, strict=True)}


@njit(cache=True, nogil=True, error_model="numpy")
def _reach(u, strides, box, out):  # type: ignore[no-untyped-def]
    """The least and greatest displacement (3, 2) mm of the elements in ``box``."""
    out[:] = 0.0
    for c in range(3):
        for i in range(box[0, 0], box[1, 0] + 1):
            for j in range(box[0, 1], box[1, 1] + 1):
                for k in range(box[0, 2], box[1, 2] + 1):
                    x = u[c, i * strides[0] + j * strides[2] + k]
                    out[c, 0], out[c, 1] = min(out[c, 0], x), max(out[c, 1], x)


def index_range(volume: Volume, state: VolumeState, low: Array, high: Array) -> tuple[Indices, Indices]:
    """Lowest and highest index (3,) of elements that can now be between the places ``low`` and ``high`` (3,) mm."""
    reach = np.zeros((3, 2))
    if state.disturbed is not None:
        _reach(state.u, grid_strides(volume), np.stack(state.disturbed), reach)
    h, last = np.array(volume.spacing_mm), np.array(volume.shape) - 1
    lowest = np.clip(np.ceil((low - reach[:, 1]) / h - 1e-9), 0, last + 1)
    highest = np.clip(np.floor((high - reach[:, 0]) / h + 1e-9), -1, last)
    return lowest.astype(np.int32), highest.astype(np.int32)


@njit(cache=True, nogil=True, error_model="numpy")
def _side(p, a, b, c):  # type: ignore[no-untyped-def]
    """Six times the volume of the tetrahedron: positive on one side of the plane through a, b, c."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    wx, wy, wz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    return wx * (uy * vz - uz * vy) + wy * (uz * vx - ux * vz) + wz * (ux * vy - uy * vx)


@njit(cache=True, nogil=True, error_model="numpy")
def crosses(p, q, a, b, c):  # type: ignore[no-untyped-def]
    """Whether the segment p–q runs through the triangle a, b, c; an end in its plane counts as in front."""
    if (_side(p, a, b, c) >= 0.0) == (_side(q, a, b, c) >= 0.0):
        return False
    s, t, w = _side(q, p, a, b), _side(q, p, b, c), _side(q, p, c, a)
    return (s >= 0.0 and t >= 0.0 and w >= 0.0) or (s <= 0.0 and t <= 0.0 and w <= 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(u, links, h, strides, lowest, highest, quad, box, p, q, broken, count):  # type: ignore[no-untyped-def]
    """Links of an index range through the two triangles of ``quad`` (4, 3), as far as there is room; returns how many.

    ``box`` (2, 3) is around the quad; ``p`` and ``q`` (3,) are room.
    """
    for i in range(lowest[0], highest[0] + 1):
        for j in range(lowest[1], highest[1] + 1):
            for k in range(lowest[2], highest[2] + 1):
                e = i * strides[0] + j * strides[2] + k
                bits = links[e]
                p[0], p[1], p[2] = i * h[0] + u[0, e], j * h[1] + u[1, e], k * h[2] + u[2, e]
                for axis in range(3):
                    if bits & (1 << 2 * axis) == 0:
                        continue
                    f = e + strides[2 * axis]
                    if (bits | links[f]) & FREE == 0:
                        continue
                    q[0], q[1], q[2] = i * h[0] + u[0, f], j * h[1] + u[1, f], k * h[2] + u[2, f]
                    q[axis] += h[axis]
                    apart = False
                    for c in range(3):
                        apart |= max(p[c], q[c]) < box[0, c] or min(p[c], q[c]) > box[1, c]
                    if apart:
                        continue
                    if crosses(p, q, quad[0], quad[1], quad[2]) or crosses(p, q, quad[0], quad[2], quad[3]):
                        if count < len(broken):
                            broken[count, 0], broken[count, 1], broken[count, 2] = e, f, 2 * axis
                        count += 1
    return count


def cut(volume: Volume, state: VolumeState, before: ArrayLike, after: ArrayLike) -> Change:
    """Break the links that a knife's edge crosses on its way from ``before`` to ``after``, (2, 3) mm each.

    Links between two elements neither of which is free are not cut: a knife does not go through bone. Raises ValueError
    for an edge that is not finite.
    """
    edge0, edge1 = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    quad = np.ascontiguousarray(np.stack([edge0[0], edge0[1], edge1[1], edge1[0]]))
    if not np.isfinite(quad).all():
        raise ValueError("a knife's edge must be at a finite place")
    box = np.stack([quad.min(axis=0), quad.max(axis=0)])
    longest = _longest_link(volume, state)
    lowest, highest = index_range(volume, state, box[0] - longest, box[1] + longest)
    room = 1024
    while True:
        broken = np.zeros((room, 3), dtype=np.int64)
        count = _cut(
            state.u, state.links, np.array(volume.spacing_mm), grid_strides(volume), lowest, highest, quad, box,
            np.zeros(3), np.zeros(3), broken, 0,
        )  # fmt: skip
        if count <= room:
            break
        room = count
    broken = broken[:count]
    ends = [places(volume, state, state.seams.ends[:, end]) for end in range(2)]
    through = np.array(
        [
            crosses(p, q, quad[0], quad[1], quad[2]) or crosses(p, q, quad[0], quad[2], quad[3])
            for p, q in zip(*ends, strict=True)
        ],
        dtype=np.bool_,
    )
    return _break(volume, state, broken, through)


def _longest_link(volume: Volume, state: VolumeState) -> Array:
    """How far apart along x, y, z the ends of a link can be, (3,) mm: a link may be beyond its limits."""
    reach = np.zeros((3, 2))
    if state.disturbed is not None:
        _reach(state.u, grid_strides(volume), np.stack(state.disturbed), reach)
    return np.array(volume.spacing_mm) + reach[:, 1] - reach[:, 0]


def _break(volume: Volume, state: VolumeState, broken: np.ndarray, seams: np.ndarray) -> Change:
    """Take away the links ``broken`` (k, 3: element, its neighbour, direction) and the marked ``seams`` (s,)."""
    e, f, d = broken.T
    for direction in range(6):
        here = d == direction
        state.links[e[here]] &= np.uint8(0xFF ^ (1 << direction))
        state.links[f[here]] &= np.uint8(0xFF ^ (1 << (direction ^ 1)))
    gone = state.seams.ends[seams]
    done = change(
        volume,
        np.concatenate([broken[:, :2], gone]),
        np.concatenate([d, state.seams.side[seams].astype(np.int64)]),
    )
    state.seams = kept(state.seams, ~seams)
    if len(done.elements):
        at = np.stack(np.unravel_index(done.elements, volume.shape), axis=1).astype(np.int32)
        wake(state, at.min(axis=0), at.max(axis=0))
    return done


def kept(seams: Seams, which: np.ndarray) -> Seams:
    """Those of the seams."""
    return Seams(seams.ends[which], seams.side[which], seams.rest[which], seams.low[which], seams.high[which])


@njit(cache=True, nogil=True, error_model="numpy")
def _overstretched(u, links, labels, material_of, strides, h, low, high, slack, lowest, highest, found):  # type: ignore[no-untyped-def]
    """Links stretched or sheared beyond their limits in an index range, as far as there is room; returns how many."""
    count = 0
    for i in range(lowest[0], highest[0] + 1):
        for j in range(lowest[1], highest[1] + 1):
            for k in range(lowest[2], highest[2] + 1):
                e = i * strides[0] + j * strides[2] + k
                for axis in range(3):
                    if links[e] & (1 << 2 * axis) == 0:
                        continue
                    f = e + strides[2 * axis]
                    a, b = material_of[labels[e]], material_of[labels[f]]
                    if a < 0 and b < 0:
                        continue
                    a, b = a if a >= 0 else b, b if b >= 0 else a
                    beyond = False
                    for c in range(3):
                        apart = u[c, f] - u[c, e]
                        beyond |= apart > high[a, b, 2 * axis, c] + slack * h[axis]
                        beyond |= c != axis and apart < low[a, b, 2 * axis, c] - slack * h[axis]
                    if beyond:
                        if count < len(found):
                            found[count, 0], found[count, 1], found[count, 2] = e, f, 2 * axis
                        count += 1
    return count


def overstretched(volume: Volume, state: VolumeState) -> np.ndarray:
    """Links (k, 3: element, its neighbour, direction) beyond their limits in stretch or shear, where it is awake."""
    if state.awake is None:
        return np.zeros((0, 3), dtype=np.int64)
    last = np.array(volume.shape) - 1
    lowest, highest = np.maximum(state.awake[0] - 1, 0), np.minimum(state.awake[1] + 1, last)
    room = 256
    while True:
        found = np.zeros((room, 3), dtype=np.int64)
        count = _overstretched(
            state.u, state.links, volume.labels.reshape(-1), volume.material_of, grid_strides(volume),
            np.array(volume.spacing_mm), volume.low, volume.high, TEAR_SLACK, lowest, highest, found,
        )  # fmt: skip
        if count <= room:
            return found[:count]
        room = count


def tear(volume: Volume, state: VolumeState) -> Change:
    """Break the links that are beyond their limits and stay so although their ends were moved."""
    found = overstretched(volume, state)
    for _ in range(ATTEMPTS):
        loose = ((state.links[found[:, 0]] & state.links[found[:, 1]]) & FREE) != 0
        if not loose.any():
            break
        for e, f, d in found[loose]:
            m = volume.material_of[volume.labels.reshape(-1)[[e, f]]]
            low, high = volume.low[m[0], m[1], d], volume.high[m[0], m[1], d]
            to = np.clip(state.u[:, f], state.u[:, e] + low, state.u[:, e] + high)
            drag(volume, state, np.array([f]), to)
        found = overstretched(volume, state)
    seams = state.seams
    apart = (state.u[:, seams.ends[:, 1]] - state.u[:, seams.ends[:, 0]]).T
    slack = TEAR_SLACK * min(volume.spacing_mm)
    torn = np.any((apart > seams.high + slack) | (apart < seams.low - slack), axis=1)
    return _break(volume, state, found, torn)


def erase(volume: Volume, state: VolumeState, elements: Indices) -> Change:
    """Take ``elements`` (k,) away, with all their links. Those that are not there are passed over."""
    gone = np.unique(elements[(state.links[elements] & PRESENT) != 0])
    strides = grid_strides(volume)
    links = 0
    for d in range(6):
        linked = gone[(state.links[gone] & (1 << d)) != 0]
        state.links[linked + strides[d]] &= np.uint8(0xFF ^ (1 << (d ^ 1)))
        inside = np.isin(linked + strides[d], gone)
        links += int(np.count_nonzero(~inside)) + (int(np.count_nonzero(inside)) if d % 2 == 0 else 0)
        state.links[gone] &= np.uint8(0xFF ^ (1 << d))
    state.free_count -= int(np.count_nonzero(state.links[gone] & FREE))
    state.links[gone] &= np.uint8(0xFF ^ (FREE | PRESENT | LINKS))
    state.u[:, gone] = 0.0
    hold = np.logical_not(np.isin(state.seams.ends, gone).any(axis=1, keepdims=True))[:, 0]
    links += int(np.count_nonzero(~hold))
    state.seams = kept(state.seams, hold)
    if len(gone):
        at = np.stack(np.unravel_index(gone, volume.shape), axis=1).astype(np.int32)
        wake(state, at.min(axis=0), at.max(axis=0))
    return Change(gone.astype(np.int32), links, 0.0, volumes_mm3(volume, gone.astype(np.int32)))
