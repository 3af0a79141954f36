"""Is the thread where no thread can be? Told without anything that the scene's contact is made of.

A point is inside of a wall where the wall's closed surface winds around it: the solid angles of its triangles add up to
4 pi there and to 0 outside (Van Oosterom and Strackee 1983, "The solid angle of a plane triangle").
"""

from __future__ import annotations

import numpy as np

from trainer.geometry import Array
from trainer.interactions.world import World


def winding(points: Array, x: Array, triangles: np.ndarray) -> Array:
    """How often (p,) the closed surface ``triangles`` (f, 3) of nodes ``x`` (n, 3) winds around ``points`` (p, 3)."""
    a, b, c = (x[triangles[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    volume = np.einsum("pfd,pfd->pf", a, np.cross(b, c))
    below = (
        la * lb * lc
        + np.einsum("pfd,pfd->pf", a, b) * lc
        + np.einsum("pfd,pfd->pf", b, c) * la
        + np.einsum("pfd,pfd->pf", c, a) * lb
    )
    return np.asarray(np.arctan2(volume, below).sum(axis=1) / (2.0 * np.pi))


def depth(point: Array, x: Array, triangles: np.ndarray) -> float:
    """Distance mm of ``point`` (3,) to the nearest triangle."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1)[:, None]
    height = np.einsum("fd,fd->f", point - a, n)
    at = point - height[:, None] * n
    inside = np.ones(len(a), dtype=bool)
    nearest = np.full(len(a), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("fd,fd->f", np.cross(q - p, at - p), n) >= 0.0
        t = np.clip(np.einsum("fd,fd->f", point - p, q - p) / np.einsum("fd,fd->f", q - p, q - p), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(p + t[:, None] * (q - p) - point, axis=1))
    return float(np.min(np.where(inside, np.abs(height), nearest)))


def in_walls(world: World) -> tuple[float, float]:
    """The greatest depth, mm, to which a node lies in a wall, and to which the thread does between nodes.

    Left out is the thread between the holes through which it goes into a wall and out of it: it is a pass's stretch
    from one hull to the other, or from a hull to the needle that is still in the other.
    """
    assert world.thread is not None
    assert world.needle is not None
    assert world.tissue is not None
    assert world.solver is not None
    arcs, swage = world.thread.arcs(), world.needle.length
    channels: list[tuple[int, float, float]] = []
    for number in {h.pass_number for h in world.holes}:
        for v in range(len(world.tissue.vessels)):
            ends = [h.arc for h in world.open_holes() if (h.pass_number, h.place.vessel) == (number, v)]
            if len(ends) == 2:
                channels.append((v, min(ends), max(ends)))
    found = deepest = 0.0
    for v, vessel in enumerate(world.tissue.vessels):
        x = world.solver.x[world.tissue.nodes(v)]
        free = np.ones(len(arcs), dtype=bool)
        for w, low, high in channels:
            if w == v:
                free &= (arcs < low) | (arcs > high)
        low, high = x.min(axis=0), x.max(axis=0)
        for a, b in world.pieces:
            rows = np.flatnonzero((arcs >= a - 1e-9) & (arcs <= b + 1e-9) & free & (arcs > swage))
            near = rows[((world.nodes[rows] >= low) & (world.nodes[rows] <= high)).all(axis=1)]
            if len(near):
                for i in near[np.abs(winding(world.nodes[near], x, vessel.display_triangles)) > 0.5]:
                    found = max(found, depth(world.nodes[i], x, vessel.display_triangles))
            # Links both of whose nodes are free and between which no hole or grip is.
            held = np.array([h.arc for h in world.open_holes()] + [j.arc for j in world.jaws if j.target == "thread"])
            for i in rows[:-1]:
                if not free[i + 1] or arcs[i + 1] > b + 1e-9 or np.any((held >= arcs[i]) & (held <= arcs[i + 1])):
                    continue
                p, q = world.nodes[i], world.nodes[i + 1]
                if np.any(np.maximum(p, q) < low) or np.any(np.minimum(p, q) > high):
                    continue
                between = p + np.linspace(0.05, 0.95, 19)[:, None] * (q - p)
                for point in between[np.abs(winding(between, x, vessel.display_triangles)) > 0.5]:
                    deepest = max(deepest, depth(point, x, vessel.display_triangles))
    return found, deepest
