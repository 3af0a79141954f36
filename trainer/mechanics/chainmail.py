"""3-D ChainMail: what is moved moves its neighbours, as far as the links between them ask for and no further.

Gibson 1997, "3D ChainMail: a fast algorithm for deforming volumetric objects", and Gibson et al. 1998, 3.2.2. A link
along an axis has a least and a greatest length and may be offset sideways only so far. When an element has moved, a
neighbour whose link it violates is moved by the least that satisfies it, then that one's neighbours, and so on.

In a volume of one material each element is considered once and compared with one neighbour, its sponsor. Candidates
wait in lists, one for each direction, which are worked off in turn: those along ±z from what was moved, then those
along ±y from all that has moved so far, then those along ±x. So the sponsor of an element is its neighbour towards
the moved elements, along x if it has another x than those, else along y, else along z; nobody else puts it on a list.
If the volume was within its limits before, it is so afterwards: along every shortest way from the moved element the
same limits add up, so that all possible sponsors ask an element to go to the same place (up to rounding).

That holds for a block. Tissue has holes, notches and cuts, through which an element is reached another way or late:
what the lists have not considered although a neighbour has moved is considered afterwards, first come, first served,
still each element once and by one neighbour (:func:`spread`).

Results depend on the order of the lists alone, and that on nothing but the volume: bit-identical from run to run.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.mechanics.volume import FREE


@njit(cache=True, nogil=True, error_model="numpy")
def consider(u0, u1, u2, mark, moved, e, s, low, high, row):  # type: ignore[no-untyped-def]
    """Move the element ``e`` to within the limits of its sponsor ``s`` and mark it; says whether it had to move.

    The limits are a row of ``low`` and ``high`` (r, 3).
    """
    x, y, z = u0[e], u1[e], u2[e]
    nx = min(max(x, u0[s] + low[row, 0]), u0[s] + high[row, 0])
    ny = min(max(y, u1[s] + low[row, 1]), u1[s] + high[row, 1])
    nz = min(max(z, u2[s] + low[row, 2]), u2[s] + high[row, 2])
    if nx == x and ny == y and nz == z:
        mark[e] = moved + 1
        return False
    u0[e], u1[e], u2[e] = nx, ny, nz
    mark[e] = moved
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def work_off(u0, u1, u2, links, mark, moved, strides, d, low, high, begin, core, queue, tail):  # type: ignore[no-untyped-def]
    """The list of direction ``d``: what ``queue[:begin]`` and then each other moves; returns the queue's new end.

    Of the first, those begin that lie at the face ``core`` (index) of what was moved; along another axis than theirs
    they all do, and the index of the face is -1. The moved are appended.
    """
    bit = np.uint8(1 << d)
    step = strides[d]
    size = abs(step)
    period = strides[6 + d // 2]
    first = tail
    for head in range(begin):
        s = queue[head]
        if links[s] & bit and (core < 0 or s // size % period == core):
            e = s + step
            if links[e] & FREE and consider(u0, u1, u2, mark, moved, e, s, low, high, d):
                queue[tail] = e
                tail += 1
    head = first
    while head < tail:
        s = queue[head]
        head += 1
        if links[s] & bit:
            e = s + step
            if links[e] & FREE and consider(u0, u1, u2, mark, moved, e, s, low, high, d):
                queue[tail] = e
                tail += 1
    return tail


@njit(cache=True, nogil=True, error_model="numpy")
def left_out(links, mark, moved, strides, queue, tail):  # type: ignore[no-untyped-def]
    """Keep of ``queue[:tail]`` the moved that have a free neighbour which was not considered; returns their number."""
    count = 0
    for head in range(tail):
        s = queue[head]
        for d in range(6):
            if links[s] & (1 << d):
                e = s + strides[d]
                if mark[e] | 1 != moved | 1 and links[e] & FREE:
                    queue[count] = s
                    count += 1
                    break
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def spread(u0, u1, u2, links, mark, moved, strides, low, high, queue, tail):  # type: ignore[no-untyped-def]
    """First come, first served from ``queue[:tail]``, whatever has not been considered; returns the queue's end."""
    index, one = np.uint64, np.uint64(1)
    head, end = index(0), index(tail)
    while head < end:
        s = index(queue[head])
        head += one
        bits = links[s]
        for d in range(index(6)):
            if bits & (one << d):
                e = index(np.int64(s) + strides[d])
                open_ = mark[e] | 1 != moved | 1 and links[e] & FREE
                if open_ and consider(u0, u1, u2, mark, moved, e, s, low, high, d):
                    queue[end] = e
                    end += one
    return np.int64(end)


@njit(cache=True, nogil=True, error_model="numpy")
def widen(queue, begin, tail, strides, box):  # type: ignore[no-untyped-def]
    """Widen ``box`` by the elements ``queue[begin:tail]``.

    In floating point, since 16 of these are divided at once: (e + ½)/p is at least 1/(2p) away from a whole number, and
    its rounding errors are below 2^-52 (e + ½)/p for each e of 31 bits, so that what is cut off is the quotient.
    """
    plane, row = np.int32(strides[0]), np.int32(strides[2])
    per_plane, per_row = 1.0 / plane, 1.0 / row
    i0, i1, j0, j1, k0, k1 = box
    i0, i1, j0 = np.int32(i0), np.int32(i1), np.int32(j0)
    j1, k0, k1 = np.int32(j1), np.int32(k0), np.int32(k1)
    for head in range(np.uint64(begin), np.uint64(tail)):
        e = queue[head]
        i = np.int32((e + 0.5) * per_plane)
        in_plane = np.int32(e - i * plane)
        j = np.int32((in_plane + 0.5) * per_row)
        k = np.int32(in_plane - j * row)
        i0, i1 = min(i0, i), max(i1, i)
        j0, j1 = min(j0, j), max(j1, j)
        k0, k1 = min(k0, k), max(k1, k)
    box[0], box[1], box[2], box[3], box[4], box[5] = i0, i1, j0, j1, k0, k1


@njit(cache=True, nogil=True, error_model="numpy")
def cross_section(u0, u1, u2, links, mark, moved, strides, low, high, held, to, queue, box):  # type: ignore[no-untyped-def]
    """Put the elements ``held`` (h,) at the displacements ``to`` (h, 3) and work off the lists along z and y.

    Writes to ``box`` (6,) the lowest and highest i, j and k of what moved, and returns how many moved and how many of
    those are not free.
    """
    size_x, size_y = strides[0], strides[2]
    not_free = 0
    box[0], box[2], box[4] = strides[6], strides[7], strides[8]
    box[1], box[3], box[5] = -1, -1, -1
    for h in range(len(held)):
        e = held[h]
        u0[e], u1[e], u2[e] = to[h, 0], to[h, 1], to[h, 2]
        mark[e] = moved
        queue[h] = e
        not_free += links[e] & FREE == 0
        i, j, k = e // size_x, e % size_x // size_y, e % size_y
        box[0], box[1] = min(box[0], i), max(box[1], i)
        box[2], box[3] = min(box[2], j), max(box[3], j)
        box[4], box[5] = min(box[4], k), max(box[5], k)
    tail = len(held)
    for axis in (2, 1):
        begin = tail
        for d in (2 * axis, 2 * axis + 1):
            core = box[2 * axis + 1 - d % 2] if box[2 * axis] < box[2 * axis + 1] else -1
            tail = work_off(u0, u1, u2, links, mark, moved, strides, d, low, high, begin, core, queue, tail)
    widen(queue, len(held), tail, strides, box)
    return tail, not_free


@njit(cache=True, nogil=True, error_model="numpy")
def lengthwise(u0, u1, u2, links, mark, moved, strides, low, high, queue, tail, box):  # type: ignore[no-untyped-def]
    """The lists along x, after :func:`cross_section`; returns the queue's end and widens ``box``."""
    begin = tail
    for d in range(2):
        core = box[1 - d] if box[0] < box[1] else -1
        tail = work_off(u0, u1, u2, links, mark, moved, strides, d, low, high, begin, core, queue, tail)
    widen(queue, begin, tail, strides, box)
    return tail


@njit(cache=True, nogil=True, error_model="numpy")
def over_seams(u0, u1, u2, links, mark, moved, ends, low, high, back_low, back_high, queue, tail):  # type: ignore[no-untyped-def]
    """Across the seams between a moved element and one that was not considered; returns the queue's end."""
    for c in range(len(ends)):
        a, b = ends[c, 0], ends[c, 1]
        ahead = mark[a] == moved and mark[b] | 1 != moved | 1 and links[b] & FREE
        back = mark[b] == moved and mark[a] | 1 != moved | 1 and links[a] & FREE
        if ahead and consider(u0, u1, u2, mark, moved, b, a, low, high, c):
            queue[tail] = b
            tail += 1
        elif back and consider(u0, u1, u2, mark, moved, a, b, back_low, back_high, c):
            queue[tail] = a
            tail += 1
    return tail
