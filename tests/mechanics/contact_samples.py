"""Threads and surfaces for the tests of contact searches, and the set of near pairs by looking at all of them."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from numba import njit

from trainer.mechanics.closest_points import segment_near_triangle, segment_segment

KINDS = ("even", "doubled", "mixed sizes", "far outlier", "thread outside", "flat", "one place", "far from zero")


def chain(nodes: int) -> np.ndarray:
    """The segments (nodes - 1, 2) of one thread."""
    return np.stack([np.arange(nodes - 1), np.arange(1, nodes)], axis=1).astype(np.int32)


def sample(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A thread (13, 3), a surface's nodes (30, 3) and its triangles (90, 3), ordinary or adverse."""
    rng = np.random.default_rng(seed)
    thread = np.cumsum(rng.normal(scale=0.2, size=(13, 3)), axis=0)
    surface = rng.uniform(-1.0, 1.0, (30, 3))
    triangles = rng.integers(0, 30, (90, 3)).astype(np.int32)
    triangles[0] = 4  # no area, no length
    if kind == "doubled":
        surface[15:] = surface[:15]
        thread[6:9] = thread[5]
        thread[9] = surface[0]
    elif kind == "mixed sizes":
        surface[:5] *= 1e4
        surface[5:20] *= 1e-7
    elif kind == "far outlier":
        surface[3] = (9e8, -9e8, 5e8)
        thread[12] = (-1e7, 0.0, 0.0)
    elif kind == "thread outside":
        thread += 50.0
    elif kind == "flat":
        surface[:, 2] = thread[:, 2] = 0.25
    elif kind == "one place":
        surface[:] = thread[:] = 1.0
    elif kind == "far from zero":
        surface += 1e6
        thread += 1e6
    return thread, surface, triangles


samples = st.builds(sample, st.sampled_from(KINDS), st.integers(0, 10**6))
# 0, touching, ordinary, and larger than most samples.
margins = st.sampled_from((0.0, 1e-9, 0.05, 0.3, 5.0))


@njit
def all_pairs(thread, segments, surface, triangles, margin):  # type: ignore[no-untyped-def]
    """Every pair of a segment and a triangle at most ``margin`` apart, in the order of the indices."""
    out = []
    for s in range(len(segments)):
        for f in range(len(triangles)):
            if segment_near_triangle(
                thread, segments[s, 0], segments[s, 1],
                surface, triangles[f, 0], triangles[f, 1], triangles[f, 2], margin,
            ):  # fmt: skip
                out.append((s, f))
    return out


@njit
def all_own_pairs(x, segments, along, neighbours, margin):  # type: ignore[no-untyped-def]
    """Every pair of segments of threads, ``along`` (m,) their places, that is near and no neighbours."""
    out = []
    for s in range(len(segments)):
        for o in range(s + 1, len(segments)):
            if abs(along[o] - along[s]) > neighbours:
                d, _, _ = segment_segment(x, segments[s, 0], segments[s, 1], x, segments[o, 0], segments[o, 1])
                if d <= margin * margin:
                    out.append((s, o))
    return out
