"""Joining: elements along an instrument's path that lack neighbours are paired and linked (Gibson et al. 1998, 3.4).

An element that lacks its link in a direction is an edge element there. Of those within reach of the path each is paired
with the nearest that lacks the opposite link and lies on that side. Neighbours in the grid get their old link back;
others are linked by a seam, which has the limits and the elasticity of a link in that direction. Then the pairs are
drawn together, each end half of the way if both are free.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from trainer.geometry import Array
from trainer.mechanics.incision import Change, change, index_range
from trainer.mechanics.volume import (
    FREE,
    LINKS,
    PRESENT,
    STEPS,
    Indices,
    Seams,
    Volume,
    VolumeState,
    grid_strides,
    places,
    wake,
)
from trainer.mechanics.volume_drag import drag


@njit(cache=True, nogil=True, error_model="numpy")
def _edges_near(u, links, h, strides, lowest, highest, path, radius, found):  # type: ignore[no-untyped-def]
    """Elements in an index range that lack a link and are at most ``radius`` from the line ``path`` (2, 3)."""
    wx, wy, wz = path[1, 0] - path[0, 0], path[1, 1] - path[0, 1], path[1, 2] - path[0, 2]
    squared = wx * wx + wy * wy + wz * wz
    count = 0
    for i in range(lowest[0], highest[0] + 1):
        for j in range(lowest[1], highest[1] + 1):
            for k in range(lowest[2], highest[2] + 1):
                e = i * strides[0] + j * strides[2] + k
                if links[e] & PRESENT == 0 or links[e] & LINKS == LINKS:
                    continue
                x = i * h[0] + u[0, e] - path[0, 0]
                y = j * h[1] + u[1, e] - path[0, 1]
                z = k * h[2] + u[2, e] - path[0, 2]
                t = min(max((x * wx + y * wy + z * wz) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
                x, y, z = x - t * wx, y - t * wy, z - t * wz
                if x * x + y * y + z * z <= radius * radius:
                    if count < len(found):
                        found[count] = e
                    count += 1
    return count


def edge_elements(volume: Volume, state: VolumeState, path: ArrayLike, radius_mm: float) -> Indices:
    """Elements (k,) that lack a link, now at most ``radius_mm`` from the line ``path`` (2, 3) mm.

    Raises ValueError for a path that is not finite or a radius that is no length.
    """
    line = np.ascontiguousarray(path, dtype=np.float64)
    if not (np.isfinite(line).all() and 0.0 < radius_mm < np.inf):
        raise ValueError("a joining instrument needs a finite path and a radius above 0 mm")
    lowest, highest = index_range(volume, state, line.min(axis=0) - radius_mm, line.max(axis=0) + radius_mm)
    room = 256
    while True:
        found = np.zeros(room, dtype=np.int32)
        count = _edges_near(
            state.u, state.links, np.array(volume.spacing_mm), grid_strides(volume), lowest, highest, line, radius_mm,
            found,
        )  # fmt: skip
        if count <= room:
            return found[:count]
        room = count


def join(volume: Volume, state: VolumeState, path: ArrayLike, radius_mm: float, reach_mm: float) -> Change:
    """Pair and link the edge elements within ``radius_mm`` of ``path`` (2, 3) mm, if at most ``reach_mm`` apart.

    Nearest pairs first; each element is joined at most once in each direction. At least one of a pair must be free.
    """
    edges = edge_elements(volume, state, path, radius_mm)
    at = places(volume, state, edges)
    strides = grid_strides(volume)
    pairs, sides = [], []
    for axis in range(3):
        d = 2 * axis
        ahead = np.flatnonzero(_lacks(state, edges, d))
        behind = np.flatnonzero(_lacks(state, edges, d + 1))
        for a, b in _nearest_first(at, ahead, behind, axis, reach_mm):
            one, other = int(edges[a]), int(edges[b])
            if (state.links[one] | state.links[other]) & FREE:
                pairs.append((one, other))
                sides.append(d)
    if not pairs:
        return change(volume, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))
    joined, side = np.array(pairs, dtype=np.int32), np.array(sides, dtype=np.uint8)
    # Where the neighbour's index lies in the same row: strides alone would lead around the volume's edge.
    step = np.array(STEPS)[side]
    indices = [np.stack(np.unravel_index(joined[:, end], volume.shape), axis=1) for end in range(2)]
    old = np.all(indices[1] - indices[0] == step, axis=1)
    for d in (0, 2, 4):
        here = old & (side == d)
        state.links[joined[here, 0]] |= np.uint8(1 << d)
        state.links[joined[here, 0] + strides[d]] |= np.uint8(1 << (d + 1))
    state.seams = _with(volume, state.seams, joined[~old], side[~old])
    reached = np.concatenate(indices).astype(np.int32)
    wake(state, reached.min(axis=0), reached.max(axis=0))
    _draw_together(volume, state, joined, side)
    return change(volume, joined, side.astype(np.int64))


def _lacks(state: VolumeState, elements: Indices, d: int) -> np.ndarray:
    """Which of ``elements`` have neither link nor seam in direction ``d``."""
    lacking: np.ndarray = (state.links[elements] & (1 << d)) == 0
    seams = state.seams
    taken = np.concatenate([seams.ends[seams.side == d, 0], seams.ends[seams.side == d ^ 1, 1]])
    return lacking & ~np.isin(elements, taken)


def _nearest_first(
    at: Array, ahead: np.ndarray, behind: np.ndarray, axis: int, reach_mm: float
) -> list[tuple[int, int]]:
    """Pairs, each of one of ``ahead`` and one of ``behind`` that lies beyond it along ``axis``, nearest first."""
    way = at[behind][None] - at[ahead][:, None]
    distance = np.linalg.norm(way, axis=2)
    aside = np.linalg.norm(np.delete(way, axis, axis=2), axis=2)
    facing = (way[:, :, axis] > 0.0) & (aside <= way[:, :, axis]) & (distance <= reach_mm)
    a, b = np.nonzero(facing)
    order = np.lexsort((b, a, distance[a, b]))
    used_a, used_b, pairs = set(), set(), []
    for m in order:
        if a[m] not in used_a and b[m] not in used_b:
            used_a.add(a[m])
            used_b.add(b[m])
            pairs.append((int(ahead[a[m]]), int(behind[b[m]])))
    return pairs


def _with(volume: Volume, seams: Seams, ends: Indices, side: np.ndarray) -> Seams:
    """The seams and new ones between ``ends`` (s, 2)."""
    if not len(ends):
        return seams
    labels = volume.labels.reshape(-1)
    m = volume.material_of[labels[ends]]
    one, other = np.where(m[:, 0] >= 0, m[:, 0], m[:, 1]), np.where(m[:, 1] >= 0, m[:, 1], m[:, 0])
    link = np.array(STEPS)[side] * np.array(volume.spacing_mm)
    rest = (volume.rest(ends[:, 0]) + link - volume.rest(ends[:, 1])).astype(np.float32)
    return Seams(
        np.concatenate([seams.ends, ends]),
        np.concatenate([seams.side, side]),
        np.concatenate([seams.rest, rest]),
        np.concatenate([seams.low, rest + volume.low[one, other, side]]),
        np.concatenate([seams.high, rest + volume.high[one, other, side]]),
    )


def _draw_together(volume: Volume, state: VolumeState, joined: Indices, side: np.ndarray) -> None:
    """Move the ends of each pair to one rest length from each other, each half of the way if both are free."""
    link = np.array(STEPS)[side] * np.array(volume.spacing_mm)
    wanted = volume.rest(joined[:, 0]) + link - volume.rest(joined[:, 1])  # second's minus first's displacement
    free = ((state.links[joined] & FREE) != 0).astype(float)
    for (a, b), to, (move_a, move_b) in zip(joined, wanted, free, strict=True):
        gap = (state.u[:, b] - state.u[:, a]) - to
        share = gap / (move_a + move_b)
        held = np.array([e for e, moves in ((a, move_a), (b, move_b)) if moves], dtype=np.int32)
        by = np.array([s for s, moves in ((share, move_a), (-share, move_b)) if moves])
        if len(held) and a != b:
            drag(volume, state, held, state.u[:, held].T + by)
