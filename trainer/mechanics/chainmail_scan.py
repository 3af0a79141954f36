"""The last and longest lists of ChainMail (:mod:`trainer.mechanics.chainmail`) as a scan through memory.

When the lists along z and y are done, each element of the disturbed cross-section begins a line along x, and no line
needs another: an element's sponsor is its neighbour in the plane before. So instead of keeping lists whole planes are
compared with the plane before, in order of memory, with no indices to look up and 8 or 16 elements at a time. Each
element is considered once, against the same sponsor and by the same arithmetic, so it ends at the same place to the
last bit; and since no line needs another, several threads may share them out and that is no different either.

What remains is the memory's own pace: 12 bytes in and 12 out per element, and 3 for links and marks. A plane is gone
through in one go, so that memory is read as one stream, and the plane before is still in the cache if it has no more
than about 60 000 elements (12 bytes each); of larger ones a share at a time goes through all planes.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.mechanics.prefetch import ask_for
from trainer.mechanics.volume import FREE

#: Elements of a plane that go through all planes together: they and those before fit into a cache of 1 MB.
SHARE = 65536
#: Elements that are looked at together: if all are to be considered no one asks each.
RUN = 4096
#: Then so many follow while memory is asked for that comes so many later (measured: a tenth less time at 128³).
PART, AHEAD = 512, 2048
#: Else they are taken by the page of memory, and a page of which none is to be considered is not written to.
PAGE = 1024


@njit(cache=True, nogil=True, error_model="numpy")
def _all_take(mark_before, links, need, moved):  # type: ignore[no-untyped-def]
    """Whether all of a run have a sponsor that moved, are linked to it and free. In bytes, 64 at a time."""
    every, differs = need, np.uint8(0)
    for k in range(len(links)):
        every = np.uint8(every & links[k])
        differs = np.uint8(differs | (mark_before[k] ^ moved))
    return every == need and differs == np.uint8(0)


@njit(cache=True, nogil=True, error_model="numpy")
def _any_take(mark_before, links, need, moved):  # type: ignore[no-untyped-def]
    """Whether any does."""
    some = np.uint8(0)
    for k in range(len(links)):
        some = np.uint8(some | (np.uint8(mark_before[k] == moved) & np.uint8(np.uint8(links[k] & need) == need)))
    return some != np.uint8(0)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow_all(u0, u1, u2, a, b, width, l0, l1, l2, h0, h1, h2, mark, moved):  # type: ignore[no-untyped-def]
    """The run that begins at ``a`` into the limits of the one at ``b``; marks it and returns how many moved."""
    still = np.int32(0)
    for k in range(width):
        x, y, z = u0[a + k], u1[a + k], u2[a + k]
        nx = min(max(x, u0[b + k] + l0), u0[b + k] + h0)
        ny = min(max(y, u1[b + k] + l1), u1[b + k] + h1)
        nz = min(max(z, u2[b + k] + l2), u2[b + k] + h2)
        rests = np.int32((nx == x) & (ny == y) & (nz == z))
        u0[a + k], u1[a + k], u2[a + k] = nx, ny, nz
        mark[a + k] = np.uint8(moved + np.uint8(rests))
        still += rests
    return np.int64(width) - still


@njit(cache=True, nogil=True, error_model="numpy")
def _follow_some(u0, u1, u2, s0, s1, s2, l0, l1, l2, h0, h1, h2, mark, mark_before, links, need, moved):  # type: ignore[no-untyped-def]
    """The same for those of a run that have a sponsor in the run before; for the others there are no limits."""
    none = np.float32(np.inf)
    count = np.int32(0)
    for k in range(len(u0)):
        x, y, z = u0[k], u1[k], u2[k]
        take = (mark_before[k] == moved) & (np.uint8(links[k] & need) == need)
        nx = min(max(x, s0[k] + l0 if take else -none), s0[k] + h0 if take else none)
        ny = min(max(y, s1[k] + l1 if take else -none), s1[k] + h1 if take else none)
        nz = min(max(z, s2[k] + l2 if take else -none), s2[k] + h2 if take else none)
        rests = (nx == x) & (ny == y) & (nz == z)
        u0[k], u1[k], u2[k] = nx, ny, nz
        mark[k] = np.uint8(moved + np.uint8(rests)) if take else mark[k]
        count += np.int32(not rests)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def scan(u0, u1, u2, links, mark, moved, shape, d, low, high, plane, first, last):  # type: ignore[no-untyped-def]
    """Lines from ``plane`` in direction ``d`` (0 is +x, 1 is −x); returns how many moved and the last plane's i.

    They are those of the elements ``first`` to ``last`` (not included) of a plane, j·nz + k.
    """
    nx, ny, nz = shape
    need = np.uint8(FREE | (2 >> d))  # a link back towards the sponsor
    step = 1 - 2 * d
    total = 0
    reached = plane
    for share in range(first, last, SHARE):
        end = min(share + SHARE, last)
        i = plane + step
        while 0 <= i < nx:
            in_plane = 0
            for run in range(share, end, RUN):
                a = i * ny * nz + run
                width = min(RUN, end - run)
                b = a - step * ny * nz
                if _all_take(mark[b : b + width], links[a : a + width], need, moved):
                    for part in range(0, width, PART):
                        later = a + part + AHEAD
                        if run + part + AHEAD >= end:  # in the next plane
                            later += step * ny * nz - (end - share)
                        for values in (u0, u1, u2):
                            ask_for(values, later, later + PART)
                        in_plane += _follow_all(
                            u0, u1, u2, np.uint64(a + part), np.uint64(b + part), np.uint64(min(PART, width - part)),
                            low[0], low[1], low[2], high[0], high[1], high[2], mark, moved,
                        )  # fmt: skip
                    continue
                for part in range(0, width, PAGE):
                    here = slice(a + part, a + min(part + PAGE, width))
                    before = slice(b + part, b + min(part + PAGE, width))
                    if _any_take(mark[before], links[here], need, moved):
                        in_plane += _follow_some(
                            u0[here], u1[here], u2[here], u0[before], u1[before], u2[before],
                            low[0], low[1], low[2], high[0], high[1], high[2], mark[here], mark[before], links[here],
                            need, moved,
                        )  # fmt: skip
            if in_plane == 0:
                break
            total += in_plane
            reached = max(reached, i) if step > 0 else min(reached, i)
            i += step
    return total, reached


@njit(cache=True, nogil=True, error_model="numpy")
def _some_open(mark, links, bit, mark_there, links_there, considered):  # type: ignore[no-untyped-def]
    """Whether any of a run moved, while its neighbour in one direction is free and was not considered."""
    some = np.uint8(0)
    for k in range(len(mark)):
        some |= np.uint8(
            (mark[k] == considered - np.uint8(1))
            & ((links[k] & bit) != 0)
            & ((mark_there[k] | np.uint8(1)) != considered)
            & ((links_there[k] & np.uint8(FREE)) != 0)
        )
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def scan_left_out(links, mark, moved, strides, i0, i1, first, last, queue):  # type: ignore[no-untyped-def]
    """What :func:`trainer.mechanics.chainmail.left_out` finds, in order of memory, where there is no list of the moved.

    Looks at the elements ``first`` to ``last`` (not included) of the planes ``i0`` to ``i1``.
    """
    n = len(links)
    considered = np.uint8(moved | 1)
    count = 0
    for i in range(i0, i1 + 1):
        for begin in range(i * strides[0] + first, i * strides[0] + last, RUN):
            end = min(begin + RUN, i * strides[0] + last)
            some = np.uint8(0)
            for d in range(6):
                a, b = max(begin, -strides[d]), min(end, n - strides[d])
                if a < b:
                    there = slice(a + strides[d], b + strides[d])
                    some |= _some_open(mark[a:b], links[a:b], np.uint8(1 << d), mark[there], links[there], considered)
            if some == 0:
                continue
            for s in range(begin, end):
                if mark[s] != moved:
                    continue
                for d in range(6):
                    if links[s] & (1 << d):
                        e = s + strides[d]
                        if mark[e] | 1 != considered and links[e] & FREE:
                            queue[count] = s
                            count += 1
                            break
    return count
