"""Moving elements of a volume: ChainMail by the method that is fastest for the size of the disturbance.

One free material: lists (:mod:`trainer.mechanics.chainmail`) for a local pull, a scan
(:mod:`trainer.mechanics.chainmail_scan`) for their longest part when much of a cross-section moves; both put every
element at the same place to the last bit. Several: corrected (:mod:`trainer.mechanics.chainmail_corrected`), or, where
the held elements are pulled different ways, largest violation first (:mod:`trainer.mechanics.chainmail_mixed`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from trainer.mechanics.chainmail import cross_section, left_out, lengthwise, over_seams, spread, widen
from trainer.mechanics.chainmail_corrected import HELD, ROUNDING, Ring, by_correction
from trainer.mechanics.chainmail_mixed import Waiting, by_violation
from trainer.mechanics.chainmail_scan import scan, scan_left_out
from trainer.mechanics.sharing import parts, share_out
from trainer.mechanics.volume import (
    PRESENT,
    Indices,
    Volume,
    VolumeError,
    VolumeState,
    grid_strides,
    next_marks,
    wake,
)

#: A scan pays when so many moved in a cross-section, and at least one in so many of its elements (measured).
SCAN_FROM, SCAN_SHARE = 64, 2


@dataclass(frozen=True)
class Moved:
    """What a move came to."""

    count: int  # elements that moved, the held ones included
    method: str  # lists or scan; corrected or largest first
    lowest: Indices  # (3,) lowest i, j, k of what moved
    highest: Indices  # (3,)


def drag(
    volume: Volume, state: VolumeState, held: Indices, displacement: ArrayLike, method: str | None = None
) -> Moved:
    """Put the elements ``held`` (h,) at ``displacement`` (3,) or (h, 3) mm from rest; the others follow.

    The held elements go there whether they are free or tacked. ``method`` is chosen by the size of the disturbance
    unless it is named. Raises VolumeError when the displacement is not finite, or an element is not there or rigid.
    """
    held = np.ascontiguousarray(held, dtype=np.int32)
    to = np.ascontiguousarray(np.broadcast_to(np.asarray(displacement, dtype=np.float32), (len(held), 3)))
    _check(volume, state, held, to)
    moved, _ = next_marks(state)
    box = np.zeros(6, dtype=np.int64)
    chain = _mixed if len(volume.materials) > 1 else _uniform
    count, method = chain(volume, state, moved, held, to, box, method)
    done = Moved(count, method, box[0::2].astype(np.int32), box[1::2].astype(np.int32))
    wake(state, done.lowest, done.highest)
    return done


def _check(volume: Volume, state: VolumeState, held: Indices, to: np.ndarray) -> None:
    if not len(held):
        raise VolumeError("a drag holds no element")
    if not np.isfinite(to).all():
        raise VolumeError("a drag leads to a place that is not finite")
    if held.min() < 0 or held.max() >= volume.labels.size or not (state.links[held] & PRESENT).all():
        raise VolumeError("a drag holds an element that is not there")
    if len(np.unique(held)) != len(held):
        raise VolumeError("a drag holds an element twice")
    if (volume.material_of[volume.labels.reshape(-1)[held]] < 0).any():
        raise VolumeError("a drag holds a rigid element")


def _uniform(
    volume: Volume,
    state: VolumeState,
    moved: np.uint8,
    held: Indices,
    to: np.ndarray,
    box: np.ndarray,
    method: str | None,
) -> tuple[int, str]:
    """ChainMail in one material; returns how many moved and by which method."""
    u0, u1, u2 = state.u
    links, mark, queue = state.links, state.mark, state.queue
    strides = grid_strides(volume)
    low, high = volume.low[0, 0], volume.high[0, 0]
    begin, not_free = cross_section(u0, u1, u2, links, mark, moved, strides, low, high, held, to, queue, box)
    nz = volume.shape[2]
    first, last = int(box[2] * nz + box[4]), int(box[3] * nz + box[5] + 1)
    if method is None:
        method = "scan" if begin >= SCAN_FROM and begin * SCAN_SHARE >= last - first else "lists"
    if method == "scan":
        total = begin + _scan(volume, state, moved, low, high, first, last, box)
    else:
        total = lengthwise(u0, u1, u2, links, mark, moved, strides, low, high, queue, begin, box)
    tail = 0
    if total - not_free < state.free_count:
        if method == "scan":
            tail = scan_left_out(links, mark, moved, strides, box[0], box[1], first, last, queue)
        else:
            tail = left_out(links, mark, moved, strides, queue, total)
            queue[:tail].sort()
        begin = tail
        tail = spread(u0, u1, u2, links, mark, moved, strides, low, high, queue, tail)
        widen(queue, begin, tail, strides, box)
        total += tail - begin
    seams = state.seams
    while len(seams.ends):
        begin = 0
        tail = over_seams(
            u0, u1, u2, links, mark, moved, seams.ends, seams.low, seams.high, -seams.high, -seams.low, queue, 0
        )  # fmt: skip
        if tail == 0:
            break
        tail = spread(u0, u1, u2, links, mark, moved, strides, low, high, queue, tail)
        widen(queue, 0, tail, strides, box)
        total += tail
    return int(total), method


def _scan(
    volume: Volume, state: VolumeState, moved: np.uint8, low: np.ndarray, high: np.ndarray,
    first: int, last: int, box: np.ndarray,
) -> int:  # fmt: skip
    """The lines along x by scan, in as many threads as pay; returns how many moved and widens ``box``."""
    u0, u1, u2 = state.u
    planes = (int(box[1]), int(box[0]))

    def lines(piece: tuple[int, int]) -> list[tuple[int, int]]:
        return [
            scan(u0, u1, u2, state.links, state.mark, moved, volume.shape, d, low[d], high[d], planes[d], *piece)
            for d in range(2)
        ]

    total = 0
    for (ahead, i1), (behind, i0) in share_out(lines, parts(first, last, (last - first) * volume.shape[0])):
        total += ahead + behind
        box[0], box[1] = min(box[0], i0), max(box[1], i1)
    return total


def _mixed(
    volume: Volume,
    state: VolumeState,
    moved: np.uint8,
    held: Indices,
    to: np.ndarray,
    box: np.ndarray,
    method: str | None,
) -> tuple[int, str]:
    """ChainMail in several materials; returns how many moved and by which method."""
    u0, u1, u2 = state.u
    way = _one_way(state.u[:, held].T, to)
    if method is None:
        method = "largest first" if way is None else "corrected"
    mark, queue, strides = state.mark, state.queue, grid_strides(volume)
    u0[held], u1[held], u2[held] = to.T
    mark[held] = moved
    queue[: len(held)] = held
    begin, tail = 0, len(held)
    box[0::2], box[1::2] = volume.shape, -1
    seams = state.seams
    tables = (volume.labels.reshape(-1), volume.material_of, len(volume.materials))
    limits = (volume.low.reshape(-1, 3), volume.high.reshape(-1, 3))
    while begin < tail:
        if method == "corrected" and way is not None:
            if state.ring is None:
                state.ring = Ring.room(volume.labels.size)
            r = state.ring
            r.waits[held] = HELD
            bound = np.where(way > 0, *limits)
            slack = np.float32(ROUNDING * np.abs(to).max())
            end = by_correction(
                u0, u1, u2, state.links, *tables, mark, moved, strides, bound, way, slack, queue, begin, tail,
                r.ring, r.waits,
            )  # fmt: skip
            r.waits[held] = 0
        else:
            if state.waiting is None:
                state.waiting = Waiting.room(volume.labels.size)
            w = state.waiting
            if state.marks_used == 1:
                w.asked[:] = 0
            end = by_violation(
                u0, u1, u2, state.links, *tables, mark, moved, strides, *limits, queue, begin, tail,
                w.element, w.key, w.via, w.least, w.asked, w.following, w.buckets, *w.bits,
            )  # fmt: skip
        tail = over_seams(
            u0, u1, u2, state.links, mark, moved, seams.ends, seams.low, seams.high, -seams.high, -seams.low, queue, end
        )
        begin = end
    widen(queue, 0, tail, strides, box)
    return int(tail), method


def _one_way(before: np.ndarray, to: np.ndarray) -> np.ndarray | None:
    """The way (3,) each component of the held is pulled, 1, -1 or 0; None if they are pulled different ways."""
    way = np.sign(to - before)
    forward, back = np.any(way > 0, axis=0), np.any(way < 0, axis=0)
    if np.any(forward & back):
        return None
    return np.asarray(forward.astype(np.float32) - back.astype(np.float32))
