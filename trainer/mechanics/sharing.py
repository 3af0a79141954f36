"""Work on large volumes shared out to threads, in parts that do not touch each other's results.

Kernels release Python's lock, so plain threads do. (numba's own parallel loops would cost less to start, but one of
their layers must not be entered by two threads at once, and a scene is not the only thread here.)
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from threading import Barrier
from typing import TypeVar

T = TypeVar("T")

#: From so many elements on: starting threads takes 0.1 ms, in which one moves 100 000 elements.
FROM_ELEMENTS = 2_000_000
#: Pieces for each thread, so that one whose core is busy with something else does fewer.
PIECES = 4
#: More threads than memory can feed do nothing (measured: 48 GB/s by one core, 55 by three).
MOST_THREADS = 3


@cache
def _threads() -> int:
    """One fewer than there are cores, which leaves one to whatever else runs; both of two."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores if cores <= 2 else cores - 1, MOST_THREADS)


@cache
def _pool() -> ThreadPoolExecutor:
    """All threads but the caller's, and all of them from the beginning on: a pool that is left to itself starts one
    more only when it takes those it has for busy."""
    others = max(1, _threads() - 1)
    pool, all_there = ThreadPoolExecutor(others, thread_name_prefix="volume"), Barrier(others + 1)
    for _ in range(others):
        pool.submit(all_there.wait)
    all_there.wait()
    return pool


def start() -> None:
    """Count the cores and start the threads, before the caller takes a core to itself: afterwards it would see and
    give to new threads no other. Where they are there already, nothing is done."""
    _pool()


def parts(begin: int, end: int, elements: int) -> list[tuple[int, int]]:
    """``begin`` to ``end`` in pieces for as many threads as pay for so many elements."""
    threads = _threads() if elements >= FROM_ELEMENTS else 1
    count = max(1, min(PIECES * threads, end - begin)) if threads > 1 else 1
    edges = [begin + (end - begin) * t // count for t in range(count + 1)]
    return list(pairwise(edges))


def share_out(work: Callable[[tuple[int, int]], T], pieces: list[tuple[int, int]]) -> list[T]:
    """``work`` for each piece, at the same time; results in the pieces' order. The caller does what none has begun."""
    if len(pieces) == 1:
        return [work(pieces[0])]
    given = [_pool().submit(work, piece) for piece in pieces]
    own = {i: work(pieces[i]) for i in reversed(range(len(pieces))) if given[i].cancel()}
    return [own[i] if i in own else given[i].result() for i in range(len(pieces))]
