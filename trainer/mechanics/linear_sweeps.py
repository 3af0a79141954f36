"""Sweeps of elastic relaxation where all is one linear material, as fast as memory brings the displacements.

Elements go all at once, from where they were before the sweep, though their places are written over: of the plane that
is swept and of the one before it copies are kept, so that memory is read and written once. A copy has a margin before
and after it, where the neighbours of the first and the last row would be.

A component is swept at a time, 16 elements at once, and links are bits that choose which differences count. In the
cache it is limited by what it reads: seven numbers an element, most of which straddle two lines of memory. (Measured:
to leave out the bits where all links are there saves a tenth, which finding out where that is takes again.) Beyond the
cache memory has to be asked for ahead of time.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.mechanics.prefetch import LINE, ask_for_line
from trainer.mechanics.volume import FREE

#: Of components that the first caches do not hold: elements that are smoothed while memory is asked for that is so
#: many further on, or so many rows where these are short. Measured: a sweep of 256³ takes two fifths less time; where
#: 512 are asked for at once the processor waits, and it takes a quarter more.
RUN, AHEAD, ROWS_AHEAD, CACHED = 128, 2048, 8, 2**18
#: Elements in a line of memory, with one of which planes begin: what straddles two is read and written twice.
ALIGNED = LINE // 4


@njit(cache=True, nogil=True, error_model="numpy")
def _has(bits, bit):  # type: ignore[no-untyped-def]
    """Whether a bit is set; in 8 bits, so that 16 elements are asked at once."""
    return np.uint8(bits & bit) != np.uint8(0)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _goes_to(x, neighbours, bits, wx, wy, wz):  # type: ignore[no-untyped-def]
    """Where an element at ``x`` goes. Where a link is missing the value that stands for the neighbour is not used."""
    none = np.float32(0.0)
    to, back, up, down, right, left = neighbours
    pull = wx * ((to - x if _has(bits, 1) else none) + (back - x if _has(bits, 2) else none))
    pull += wy * ((up - x if _has(bits, 4) else none) + (down - x if _has(bits, 8) else none))
    pull += wz * ((right - x if _has(bits, 16) else none) + (left - x if _has(bits, 32) else none))
    return x + (pull if _has(bits, FREE) else none)


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_run(u, ahead, links, begin, end, margin, nz, wx, wy, wz, now, other, still, far):  # type: ignore[no-untyped-def]
    """The elements ``begin`` to ``end`` of a plane to where they go; returns how many went further than ``still``.

    ``now`` has where the plane was and ``other`` the one before, both after a ``margin``. ``ahead`` is the next
    plane's, which ``other`` keeps; where memory is ``far`` it is asked for, RUN elements at a time.
    """
    one, run = np.uint64(1), np.uint64(RUN)
    first, past, rest = np.uint64(begin), np.uint64(end), np.uint64(begin)
    if far:
        rest += (past - first) // run * run
        for a in range(first, rest, run):
            for k in range(a, a + run, np.uint64(ALIGNED)):
                ask_for_line(ahead, k + np.uint64(AHEAD))
            for k in range(a, a + run):
                m, to = k + margin, ahead[k]
                around = (to, other[m], now[m + nz], now[m - nz], now[m + one], now[m - one])
                u[k] = _goes_to(now[m], around, links[k], wx, wy, wz)
                other[m] = to
    for k in range(rest, past):
        m, to = k + margin, ahead[k]
        around = (to, other[m], now[m + nz], now[m - nz], now[m + one], now[m - one])
        u[k] = _goes_to(now[m], around, links[k], wx, wy, wz)
        other[m] = to
    moving = 0
    if still > np.float32(0.0):
        for k in range(first, past):
            moving += 1 if abs(u[k] - now[k + margin]) > still else 0
    return moving


@njit(cache=True, nogil=True, error_model="numpy")
def keep(plane, margin, u, begin, end):  # type: ignore[no-untyped-def]
    """Copy the elements ``begin`` to ``end`` of ``u`` to a plane with a margin."""
    past = np.uint64(margin)
    for k in range(np.uint64(begin), np.uint64(end)):
        plane[past + k] = u[k]


@njit(cache=True, nogil=True, error_model="numpy")
def margin_of(nz):  # type: ignore[no-untyped-def]
    """Room before and after a plane: a row and one element, in whole lines of memory."""
    return (nz + ALIGNED) // ALIGNED * ALIGNED


@njit(cache=True, nogil=True, error_model="numpy")
def _wide(box, nz):  # type: ignore[no-untyped-def]
    """Whether a region is more than half as wide as the volume: its rows are then taken together, from end to end."""
    return 2 * (box[5] + 1 - box[4]) > nz


@njit(cache=True, nogil=True, error_model="numpy")
def _keep_region(plane, u, shape, box):  # type: ignore[no-untyped-def]
    """Copy of a plane ``u`` (ny nz,) the region and one element around it to a plane with margins."""
    _, ny, nz = shape
    _, _, j0, j1, k0, k1 = box
    first, past = (0, nz) if _wide(box, nz) else (max(k0 - 1, 0), min(k1 + 2, nz))
    for j in range(max(j0 - 1, 0), min(j1 + 2, ny)):
        keep(plane, margin_of(nz), u, j * nz + first, j * nz + past)


@njit(cache=True, nogil=True, error_model="numpy")
def _keep_borders(u, shape, box, planes):  # type: ignore[no-untyped-def]
    """Copy the planes of ``u`` (3, n) before the slab ``box`` and after it to ``planes`` (3, 3, ·)."""
    nx, ny, nz = shape
    plane = ny * nz
    before, after = box[0] - 1, box[1] + 1
    for c in range(3):
        if before >= 0:
            _keep_region(planes[c, 0], u[c, before * plane : (before + 1) * plane], shape, box)
        if after < nx:
            _keep_region(planes[c, 1], u[c, after * plane : (after + 1) * plane], shape, box)


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_component(u, links, shape, box, wx, wy, wz, still, before, last, now):  # type: ignore[no-untyped-def]
    """A sweep of one component ``u`` (n,) of one linear material; returns how many went further than ``still`` mm.

    ``wx``, ``wy`` and ``wz`` are the parts of the difference to each neighbour by which an element moves. ``before``
    holds the plane before the region, ``last`` the one after it, as they were before the sweep; they and ``now`` are
    planes with margins. So memory is read and written once. Rows are taken together where the region is more than half
    as wide as the volume; memory that the cache does not hold is then asked for.
    """
    _, ny, nz = shape
    plane, margin = ny * nz, margin_of(nz)
    i0, i1, j0, j1, k0, k1 = box
    wide = _wide(box, nz)
    far = len(u) > CACHED
    begin, end = j0 * nz + k0, j1 * nz + k1 + 1
    _keep_region(now, u[i0 * plane : (i0 + 1) * plane], shape, box)
    other = before
    moving = 0
    for i in range(i0, i1 + 1):
        here = u[i * plane : (i + 1) * plane]
        bits = links[i * plane : (i + 1) * plane]
        following = last[margin : margin + plane] if i == i1 else u[(i + 1) * plane : (i + 2) * plane]
        for j in range(j0, j0 + 1 if wide else j1 + 1):
            if far and not wide:
                for k in range(k0, k1 + 1, ALIGNED):
                    ask_for_line(following, (j + ROWS_AHEAD) * nz + k)
            moving += _smooth_run(
                here, following, bits, j * nz + k0, end if wide else j * nz + k1 + 1, np.uint64(margin),
                np.uint64(nz), wx, wy, wz, now, other, still, far and wide,
            )  # fmt: skip
        if wide:
            keep(other, margin, following, max(begin - nz - 1, 0), begin)
            keep(other, margin, following, end, min(end + nz + 1, plane))
        else:
            _keep_region(other, following, shape, box)
        now, other = other, now
    return moving


@njit(cache=True, nogil=True, error_model="numpy")
def smooth(u, links, shape, box, count, part, ways, still, planes):  # type: ignore[no-untyped-def]
    """``count`` sweeps of ``u`` (3, n); returns how many went further than ``still`` mm in the last.

    ``box`` is a region, and each sweep takes one element more around it; or a ``part`` of one, a slab whose borders
    ``planes`` hold. ``ways`` (3, 3) are by component and axis; ``planes`` (3, 3, ·) have room for a plane before the
    slab, one after it and one more.
    """
    nx, ny, nz = shape
    i0, i1, j0, j1, k0, k1 = box
    moving = 0
    for left in range(count - 1, -1, -1):
        if not part:
            i0, j0, k0 = max(i0 - 1, 0), max(j0 - 1, 0), max(k0 - 1, 0)
            i1, j1, k1 = min(i1 + 1, nx - 1), min(j1 + 1, ny - 1), min(k1 + 1, nz - 1)
            _keep_borders(u, shape, (i0, i1, j0, j1, k0, k1), planes)
        most = still if left == 0 else np.float32(0.0)
        moving = 0
        for c in range(3):
            wx, wy, wz = ways[c, 0], ways[c, 1], ways[c, 2]
            before, last, now = planes[c, 0], planes[c, 1], planes[c, 2]
            moving += _smooth_component(
                u[c], links, shape, (i0, i1, j0, j1, k0, k1), wx, wy, wz, most, before, last, now
            )
    return moving
