"""Elastic relaxation: elements go part of the way to where their links want them (Gibson et al. 1998, 3.2.2).

ChainMail leaves a rough shape that merely respects limits; relaxation smooths it between moves and when nobody moves.
Each sweep moves every free element by the same part of what would satisfy its links if its neighbours stayed where
they were; all at once, from the places before the sweep (Jacobi), so that no order is preferred, and of a free body of
one linear material the mean displacement stays where it is.

Time. A displaced element whose neighbours rest comes back with its material's time constant τ: u(t) = u₀ exp(−t/τ).
Sweeps are a fixed time apart, τ/8 of the fastest material, and time that is left over is kept for the next call, so
that after the same time the same sweeps were made, whatever the tick: the same places, bit for bit. Each sweep moves
by 1 − exp(−1/8), which is exact for that element; a slow mode of a large body, whose rate is λ/τ with λ ≪ 1, decays
faster than λ/τ by 1/16, as the sweeps' own expansion shows: −ln(1 − (1 − e^(−s)) λ) = s λ (1 + (λ − 1) s/2 + …).
Forces of elements that move slower than τ lag behind the pull: loading and unloading have different curves
(hysteresis), the more so the faster.

An element with all its links has the rate 1/τ; with fewer links it is held by fewer, and is slower in proportion.
Where a J-curve is steeper than at rest, the part is taken of the steeper slope, so that no element overshoots.

Only the region that is awake is swept: what was moved, and one more element around it with each sweep. It sleeps when
nothing moved by more than STILL rest lengths in a sweep. Limits are ChainMail's business: relaxation, which averages,
hardly ever leaves them, and does not ask.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.linear_sweeps import ALIGNED, keep, margin_of, smooth
from trainer.mechanics.prefetch import LINE
from trainer.mechanics.sharing import parts, share_out
from trainer.mechanics.tissue_law import constants, link_answer, rest_stiffness
from trainer.mechanics.volume import FREE, PRESENT, Indices, Singles, Volume, VolumeState, grid_strides, wake

#: Sweeps in a time constant.
SWEEPS = 8
#: A region in which no element moves further than this in a sweep, in the shortest rest length, falls asleep.
STILL = 1e-5


# Laws go from function to function as tuples: arrays would be counted on the way in and out, nine tenths of the time.
@njit(cache=True, nogil=True, error_model="numpy")
def _pull(law, other, alone, d, c, apart, h, area):  # type: ignore[no-untyped-def]
    """Force, mN, and stiffness, mN/mm, of the link in direction ``d`` on component ``c`` of an element.

    ``apart`` is the neighbour's displacement without the element's; ``h`` and ``area`` are those of the link's axis.
    """
    sign = 1.0 - 2.0 * (d % 2)
    t, k = link_answer(law, other, alone, d // 2 == c, sign * apart / h)
    return sign * area * t, k * area / h


@njit(cache=True, nogil=True, error_model="numpy")
def answer(u, links, labels, material_of, shape, strides, box, c, law, h, area, rest, part, still, before, last, now):  # type: ignore[no-untyped-def]
    """A sweep of component ``c`` for any laws and materials; like ``linear_sweeps``, but asks each link.

    ``rest`` (m, 3, 3) is the stiffness at rest and ``part`` (m,) how much of the way an element goes.
    """
    _, ny, nz = shape
    plane, margin = ny * nz, margin_of(nz)
    i0, i1, j0, j1, k0, k1 = box
    moving = 0
    for i in range(i0, i1 + 1):
        keep(now, margin, u[i * plane : (i + 1) * plane], max(j0 - 1, 0) * nz, min(j1 + 2, ny) * nz)
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                e = i * plane + j * nz + k
                bits = links[e]
                if bits & FREE == 0:
                    continue
                p = margin + j * nz + k
                x = now[p]
                m = material_of[labels[e]]
                own = (law[m, 0], law[m, 1], law[m, 2], law[m, 3], law[m, 4])
                force, stiffness = 0.0, 0.0
                for d in range(6):
                    if bits & (1 << d) == 0:
                        continue
                    if d == 0:
                        there = last[p] if i == i1 else u[e + plane]
                    elif d == 1:
                        there = before[p]
                    else:
                        there = now[p + strides[d]]
                    n = material_of[labels[e + strides[d]]]
                    other = (law[n, 0], law[n, 1], law[n, 2], law[n, 3], law[n, 4])
                    f, s = _pull(own, other, n < 0 or n == m, d, c, there - x, h[d // 2], area[d // 2])
                    force += f
                    stiffness += s
                whole = 0.0
                for axis in range(3):
                    if shape[axis] > 1:
                        whole += 2.0 * rest[m, axis, c]
                way = part[m] * force / max(whole, stiffness)
                u[e] = x + way
                moving += abs(way) > still
        before, now = now, before
    return moving


def relax(volume: Volume, state: VolumeState, duration_s: float) -> int:
    """Let the volume relax for ``duration_s``; returns the number of sweeps that were due. Nothing awake, none."""
    if not (duration_s >= 0.0 and math.isfinite(duration_s)):
        raise ValueError(f"relaxation was asked to last {duration_s} s; expected at least 0")
    step_s = min(m.time_constant_s for m in volume.materials) / SWEEPS
    state.owed_s += duration_s
    # A billionth of a step is rounding of the sum of the ticks.
    due = math.floor(state.owed_s / step_s + 1e-9)
    state.owed_s -= due * step_s
    if state.awake is None:
        return 0
    sweep(volume, state, step_s, count=due)
    return due


class Sweeps(NamedTuple):
    """What is the same in all sweeps of one length; a state keeps it."""

    volume: Volume
    step_s: float
    rest: Array  # (m, 3, 3) mN/mm, see rest_stiffness
    part: Array  # (m,) how much of the way an element goes
    whole: Array  # (m, 3) mN/mm of all links of an element
    ways: Singles  # (3, 3) of one linear material, by component and axis: parts of the differences
    linear: bool  # one linear material is all
    h: Array  # (3,) mm
    area: Array  # (3,) mm²
    law: Array  # (m, 5)
    strides: np.ndarray  # (6,)


def _sweeps(volume: Volume, step_s: float) -> Sweeps:
    rest = rest_stiffness(volume)
    part = np.array([-math.expm1(-step_s / m.time_constant_s) for m in volume.materials])
    whole = 2.0 * rest[:, np.array(volume.shape) > 1].sum(axis=1)
    bent = any(m.steepness or m.straight_from < math.inf or m.yield_strain for m in volume.materials)
    # A single element has no links at all, and moves nowhere.
    ways = part[0] * rest[0] / np.where(whole[0] > 0.0, whole[0], 1.0)
    h = np.array(volume.spacing_mm)
    return Sweeps(
        volume,
        step_s,
        rest=rest,
        part=part,
        whole=whole,
        ways=np.ascontiguousarray(ways.T, dtype=np.float32),
        linear=len(volume.materials) == 1 and not bent,
        h=h,
        area=volume.element_mm3 / h,
        law=constants(volume),
        strides=grid_strides(volume)[:6],
    )


def sweep(volume: Volume, state: VolumeState, step_s: float, look: bool = True, count: int = 1) -> None:
    """``count`` sweeps of the region that is awake, and one more element around it with each; ``look``: does anything
    still move in the last?"""
    if state.awake is None or count == 0:
        return
    if volume.labels.size == 1:  # nothing pulls at it
        state.awake = None
        return
    if state.sweeps is None or state.sweeps.volume is not volume or state.sweeps.step_s != step_s:
        state.sweeps = _sweeps(volume, step_s)
    same = state.sweeps
    before = tuple(zip(*(end.tolist() for end in state.awake), strict=True))
    box = [(max(low - count, 0), min(high + count, n - 1)) for (low, high), n in zip(before, volume.shape, strict=True)]
    pieces = parts(box[0][0], box[0][1] + 1, math.prod(high - low + 1 for low, high in box))
    still = STILL * min(volume.spacing_mm) if look else 0.0
    planes = _edges(volume, state, len(pieces))
    if same.linear and len(pieces) == 1 and not len(state.seams.ends):
        region = before[0] + before[1] + before[2]
        moving = smooth(
            state.u, state.links, volume.shape, region, count, False, same.ways, np.float32(still), planes[0]
        )
    elif count > 1:
        for left in range(count - 1, -1, -1):
            sweep(volume, state, step_s, look=look and left == 0)
        return
    else:
        moving = _sweep_pieces(volume, state, same, box, pieces, planes, still)
    lowest, highest = np.array(box, dtype=np.int32).T
    wake(state, lowest, highest)
    if look and moving == 0:
        state.awake = None


def _sweep_pieces(
    volume: Volume,
    state: VolumeState,
    same: Sweeps,
    box: list[tuple[int, int]],
    pieces: list[tuple[int, int]],
    planes: Singles,
    still: float,
) -> int:
    """A sweep of ``box`` by as many threads as there are ``pieces``; returns how many went further than ``still``."""
    ways = _seam_ways(volume, state, same.rest, same.part, same.whole)
    room = dict(zip(pieces, planes, strict=False))
    nx, ny, nz = volume.shape
    inside = slice(margin_of(nz), margin_of(nz) + ny * nz)
    u = state.u.reshape(3, nx, ny * nz)

    def keep_borders(piece: tuple[int, int]) -> None:
        begin, end = piece
        if begin > 0:
            room[piece][:, 0, inside] = u[:, begin - 1]
        if end < nx:
            room[piece][:, 1, inside] = u[:, end]

    def slab(piece: tuple[int, int]) -> int:
        own = (piece[0], piece[1] - 1, *box[1], *box[2])
        if same.linear:
            return int(
                smooth(state.u, state.links, volume.shape, own, 1, True, same.ways, np.float32(still), room[piece])
            )
        return sum(
            answer(
                state.u[c], state.links, volume.labels.reshape(-1), volume.material_of, volume.shape, same.strides, own,
                c, same.law, same.h, same.area, same.rest, same.part, still, *room[piece][c],
            )
            for c in range(3)
        )  # fmt: skip

    share_out(keep_borders, pieces)
    moving = sum(share_out(slab, pieces))
    if len(ways):
        for end in range(2):
            for c in range(3):
                np.add.at(state.u[c], state.seams.ends[:, end], ways[:, end, c])
        moving += int(np.count_nonzero(np.abs(ways) > still))
    return moving


def _edges(volume: Volume, state: VolumeState, count: int) -> Singles:
    """Room for planes with margins: (pieces, 3, 3, ·), for each piece and component of the one before it, of the one
    after it, and one more. Outside the volume leads no link."""
    _, ny, nz = volume.shape
    if state.edges is None or len(state.edges) < count:
        size = -(-ny * nz // ALIGNED) * ALIGNED + 2 * margin_of(nz)
        room = np.zeros(count * 9 * size + ALIGNED, dtype=np.float32)
        first = -room.ctypes.data % LINE // room.itemsize
        state.edges = room[first : first + count * 9 * size].reshape(count, 3, 3, size)
    return state.edges


def _seam_ways(volume: Volume, state: VolumeState, rest: Array, part: Array, whole: Array) -> Array:
    """How far seams move their ends (s, 2, 3) mm in a sweep: each is a linear link of its ends' materials."""
    seams = state.seams
    if not len(seams.ends):
        return np.zeros((0, 2, 3))
    labels = volume.labels.reshape(-1)
    stretched = (state.u[:, seams.ends[:, 1]] - state.u[:, seams.ends[:, 0]]).T - seams.rest
    ways = np.zeros((len(seams.ends), 2, 3))
    for end, sign in ((0, 1.0), (1, -1.0)):
        elements = seams.ends[:, end]
        m = volume.material_of[labels[elements]]
        free = ((state.links[elements] & FREE) != 0) & (m >= 0)
        share = part[m, None] * rest[m, seams.side // 2] / whole[m]
        ways[:, end] = np.where(free[:, None], sign * share * stretched, 0.0)
    return ways


@njit(cache=True, nogil=True, error_model="numpy")
def _force(u, c, links, labels, material_of, elements, strides, law, h, area):  # type: ignore[no-untyped-def]
    total = 0.0
    for e in elements:
        m = material_of[labels[e]]
        own = (law[m, 0], law[m, 1], law[m, 2], law[m, 3], law[m, 4])
        for d in range(6):
            if links[e] & (1 << d):
                n = material_of[labels[e + strides[d]]]
                other = (law[n, 0], law[n, 1], law[n, 2], law[n, 3], law[n, 4])
                apart = np.float64(u[e + strides[d]]) - np.float64(u[e])
                total += _pull(own, other, n < 0 or n == m, d, c, apart, h[d // 2], area[d // 2])[0]
    return total


def force_on(volume: Volume, state: VolumeState, elements: Indices) -> Array:
    """What the links of ``elements`` (k,) pull at them with, together: (3,) mN. Between themselves that is nothing."""
    h = np.array(volume.spacing_mm)
    strides = grid_strides(volume)
    there = elements[(state.links[elements] & PRESENT) != 0]
    return np.array(
        [
            _force(
                state.u[c], c, state.links, volume.labels.reshape(-1), volume.material_of, there, strides,
                constants(volume), h, volume.element_mm3 / h,
            )
            for c in range(3)
        ]
    )  # fmt: skip
