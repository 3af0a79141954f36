"""Which elements of a volume still hang together, after cuts and tears."""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.mechanics.volume import PRESENT, Indices, Volume, VolumeState, grid_strides


@njit(cache=True, nogil=True, error_model="numpy")
def _flood(links, strides, begin, ends, reached, queue, starts):  # type: ignore[no-untyped-def]
    """Fill ``queue`` island by island, from each one's first element; returns how many, with where each starts.

    The seams of an element are ``ends`` from ``begin[e]``: to ``begin`` (n + 1,) they are sorted by their first end.
    """
    tail, count = 0, 0
    for first in range(len(links)):
        if reached[first] or links[first] & PRESENT == 0:
            continue
        starts[count] = tail
        count += 1
        head = tail
        reached[first] = True
        queue[tail] = first
        tail += 1
        while head < tail:
            s = queue[head]
            head += 1
            for d in range(6):
                if links[s] & (1 << d):
                    e = s + strides[d]
                    if not reached[e]:
                        reached[e] = True
                        queue[tail] = e
                        tail += 1
            if len(ends):
                for at in range(begin[s], begin[s + 1]):
                    e = ends[at]
                    if not reached[e]:
                        reached[e] = True
                        queue[tail] = e
                        tail += 1
    starts[count] = tail
    return count


def islands(state: VolumeState, volume: Volume, label: int | None = None) -> list[Indices]:
    """The elements of each connected part, in the order of their lowest element, sorted.

    With a ``label`` only ways through elements of that label count, and only those are told.
    """
    passed_over = np.zeros(volume.labels.size, np.bool_) if label is None else volume.labels.reshape(-1) != label
    n = volume.labels.size
    pairs = np.concatenate([state.seams.ends, state.seams.ends[:, ::-1]])
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    begin = np.searchsorted(pairs[:, 0], np.arange(n + 1)) if len(pairs) else np.zeros(1, np.int64)
    queue, starts = np.empty(n, np.int32), np.empty(n + 1, np.int64)
    count = _flood(
        state.links,
        grid_strides(volume),
        begin,
        np.ascontiguousarray(pairs[:, 1]),
        passed_over,
        queue,
        starts,
    )
    return [np.sort(queue[starts[c] : starts[c + 1]]) for c in range(count)]
