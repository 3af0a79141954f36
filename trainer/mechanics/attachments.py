"""What holds a tissue at material points: springs to places in the world, taut threads, and what rubs in a hole.

A material point is a weighted mean of three nodes. At most a few dozen are held at a time, so that everything here is
a small dense problem in the 3 u coordinates of the u points in use.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array

#: A segment shorter than this, mm, has no direction of its own; below it a thread's pull turns no further.
SHORTEST_MM = 1e-6
#: What a solve is given, in the order in which it is looked through.
NUMBERS = (
    "an anchor's target", "an anchor's stiffness", "a cable's place", "a cable's length", "a friction's place",
    "a friction's direction", "a friction's stiffness", "a friction's limit",
)  # fmt: skip


@dataclass(frozen=True)
class Anchors:
    """Springs from material points to places: the force on the tissue is ``stiffness`` (``target`` - p)."""

    slot: np.ndarray  # (a,) int, from Equilibrium.hold
    target: Array  # (a, 3) mm
    stiffness: Array  # (a, 3, 3) mN/mm, symmetric positive semidefinite

    @staticmethod
    def none() -> Anchors:
        return Anchors(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class Cable:
    """A thread without friction through k points: it pulls, and never pushes, so that its path is not too long.

    Where it runs in a channel, between two holes of one wall, it does not draw them together: the tissue between them
    hardly gives way, which the few links of a thin wall do not show. Such a stretch is no part of path and length.
    """

    slot: np.ndarray  # (k,) int; -1 for a point that is no material point
    place: Array  # (k, 3) mm, where that point is; not read elsewhere
    length_mm: float  # of the thread outside channels
    channel: np.ndarray  # (k,) bool; True where the way on to the next point is a channel


@dataclass(frozen=True)
class Frictions:
    """What rubs along a line at material points: Coulomb friction with an elastic way before it slides (Dahl 1968).

    The force on the tissue is ``stiffness`` (``place`` - p) · ``along``, of at most ``limit`` either way. Within one
    equilibrium it follows from a convex energy, so that it cannot overshoot from one direction to the other, however
    soft the tissue is along the line. The caller moves ``place`` on afterwards by what has slid.
    """

    slot: np.ndarray  # (f,) int
    place: Array  # (f, 3) mm, where the point feels no friction
    along: Array  # (f, 3) unit
    stiffness: Array  # (f,) mN/mm, positive
    limit: Array  # (f,) mN

    @staticmethod
    def none() -> Frictions:
        return Frictions(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))


class Rows(NamedTuple):
    """Anchors, cables and frictions of one solve, flattened for the kernels; ``at`` counts the points in use."""

    slots: np.ndarray  # (u,) the slots in use, ascending
    anchor_at: np.ndarray  # (a,)
    target: Array  # (a, 3) mm; changed while targets are approached in steps
    stiffness: Array  # (a, 3, 3) mN/mm
    cable_start: np.ndarray  # (c + 1,) a cable's points in the next two
    cable_at: np.ndarray  # (k,) -1 for a place in the world
    cable_place: Array  # (k, 3) mm
    channel: np.ndarray  # (k,) bool
    length: Array  # (c,) mm; changed while lengths are approached in steps
    rub_at: np.ndarray  # (f,)
    rub_place: Array  # (f, 3) mm
    rub_along: Array  # (f, 3)
    rub_stiffness: Array  # (f,) mN/mm
    rub_limit: Array  # (f,) mN


def lay_out(anchored: np.ndarray, cables: list[np.ndarray], rubbed: np.ndarray) -> Rows:
    """Rows for solves that hold the slots ``anchored`` (a,), those of ``cables`` (k,) each, and ``rubbed`` (f,), to be
    given their numbers by :func:`fill`. Raises ValueError when a cable has fewer than two points."""
    count = [len(cable) for cable in cables]
    if any(n < 2 for n in count):
        raise ValueError("a cable needs at least two points")
    on_anchors, on_rubbed = anchored.tolist(), rubbed.tolist()
    on_cables = [n for cable in cables for n in cable.tolist()]
    slots = sorted({*on_anchors, *(n for n in on_cables if n >= 0), *on_rubbed})
    at = {-1: -1} | {slot: u for u, slot in enumerate(slots)}
    return Rows(
        slots=np.array(slots, dtype=np.int64),
        anchor_at=np.array([at[n] for n in on_anchors], dtype=np.int64),
        target=np.zeros((len(on_anchors), 3)),
        stiffness=np.zeros((len(on_anchors), 3, 3)),
        cable_start=np.array([0, *itertools.accumulate(count)], dtype=np.int64),
        cable_at=np.array([at[n] for n in on_cables], dtype=np.int64),
        cable_place=np.zeros((len(on_cables), 3)),
        channel=np.zeros(len(on_cables), dtype=np.bool_),
        length=np.zeros(len(cables)),
        rub_at=np.array([at[n] for n in on_rubbed], dtype=np.int64),
        rub_place=np.zeros((len(rubbed), 3)),
        rub_along=np.zeros((len(rubbed), 3)),
        rub_stiffness=np.zeros(len(rubbed)),
        rub_limit=np.zeros(len(rubbed)),
    )


def fill(rows: Rows, anchors: Anchors, cables: tuple[Cable, ...], frictions: Frictions) -> None:
    """Gives ``rows`` the numbers of one solve. Raises ValueError when one is not finite."""
    rows.target[:] = anchors.target
    rows.stiffness[:] = anchors.stiffness
    first = 0
    for c, cable in enumerate(cables):
        last = first + len(cable.slot)
        rows.cable_place[first:last] = cable.place
        rows.channel[first:last] = cable.channel
        rows.length[c] = cable.length_mm
        first = last
    rows.cable_place[rows.cable_at >= 0] = 0.0
    rows.rub_place[:] = frictions.place
    rows.rub_along[:] = frictions.along
    rows.rub_stiffness[:] = frictions.stiffness
    rows.rub_limit[:] = frictions.limit
    bad = first_not_finite(
        rows.target, rows.stiffness, rows.cable_place, rows.length, rows.rub_place, rows.rub_along, rows.rub_stiffness,
        rows.rub_limit,
    )  # fmt: skip
    if bad >= 0:
        raise ValueError(f"{NUMBERS[bad]} is not finite")


@njit(cache=True, nogil=True, error_model="numpy")
def first_not_finite(
    target: Array, stiffness: Array, cable: Array, length: Array, place: Array, along: Array, rub: Array, limit: Array
) -> int:
    """Which of the arrays, counted from 0, is the first with a number that is not finite; -1 if none: one call for all
    that a solve is given."""
    checks = (
        all_finite(target), all_finite(stiffness), all_finite(cable), all_finite(length), all_finite(place),
        all_finite(along), all_finite(rub), all_finite(limit),
    )  # fmt: skip
    for k in range(len(checks)):
        if not checks[k]:
            return k
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def all_finite(values: Array) -> bool:
    """Whether each number is; for a few numbers an order faster than numpy."""
    for v in values.flat:  # noqa: SIM110, numba has no all() of a generator
        if not math.isfinite(v):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def tension_of(multiplier: float, penalty: float, stretch: float, taut: bool) -> float:
    """A cable's tension, mN, see :func:`pull`."""
    tension = multiplier + penalty * stretch
    return tension if taut else max(0.0, tension)


@njit(cache=True, nogil=True, error_model="numpy")
def pull(
    p: Array,
    rows: Rows,
    multiplier: Array,
    penalty: Array,
    row: Array,
    force: Array,
    matrix: Array,
    stretch: Array,
    taut: np.ndarray,
) -> float:
    """Forces on the points in use, their stiffness and their energy (mN mm, returned).

    A cable of path length s, longest length L, multiplier m and penalty k has the augmented Lagrangian
    (T² - m²) / (2 k) with the tension T = max(0, m + k (s - L)) (Rockafellar 1973). Its second derivative,
    k d dᵀ + T ∂²s/∂p² with d = ∂s/∂p, is positive semidefinite, because a path length is convex. Of a cable that is
    expected to be ``taut`` (c,) in the end the path is an equation: on the way there it may push.

    Reads ``p`` (u, 3) mm, ``rows``, ``multiplier`` (c,) mN, ``penalty`` (c,) mN/mm. Overwrites ``row``
    (k, 3), ``force`` (u, 3) mN, ``matrix`` (3 u, 3 u) mN/mm and ``stretch`` (c,) = s - L mm.
    """
    anchor_at, target, anchor_stiffness = rows.anchor_at, rows.target, rows.stiffness
    cable_start, cable_at, cable_place, channel = rows.cable_start, rows.cable_at, rows.cable_place, rows.channel
    energy = 0.0
    matrix[:] = 0.0
    for i in range(len(p)):
        for r in range(3):
            force[i, r] = 0.0
    for a in range(len(anchor_at)):
        i = anchor_at[a]
        for r in range(3):
            f = 0.0
            for c in range(3):
                f += anchor_stiffness[a, r, c] * (target[a, c] - p[i, c])
                matrix[3 * i + r, 3 * i + c] += anchor_stiffness[a, r, c]
            force[i, r] += f
            energy += 0.5 * f * (target[a, r] - p[i, r])
    for n in range(len(rows.rub_at)):
        i, k, limit = rows.rub_at[n], rows.rub_stiffness[n], rows.rub_limit[n]
        drawn = 0.0
        for r in range(3):
            drawn += (rows.rub_place[n, r] - p[i, r]) * rows.rub_along[n, r]
        f = min(limit, max(-limit, k * drawn))
        energy += f * drawn - 0.5 * f * f / k
        slides = abs(k * drawn) > limit
        for r in range(3):
            force[i, r] += f * rows.rub_along[n, r]
            for c in range(3):
                if not slides:
                    matrix[3 * i + r, 3 * i + c] += k * rows.rub_along[n, r] * rows.rub_along[n, c]
    for n in range(len(rows.length)):
        first, last = cable_start[n], cable_start[n + 1]
        path = 0.0
        for k in range(first, last):
            row[k, 0] = row[k, 1] = row[k, 2] = 0.0
        for k in range(first, last - 1):
            if channel[k]:
                continue
            i, j = cable_at[k], cable_at[k + 1]
            d0 = (p[j, 0] if j >= 0 else cable_place[k + 1, 0]) - (p[i, 0] if i >= 0 else cable_place[k, 0])
            d1 = (p[j, 1] if j >= 0 else cable_place[k + 1, 1]) - (p[i, 1] if i >= 0 else cable_place[k, 1])
            d2 = (p[j, 2] if j >= 0 else cable_place[k + 1, 2]) - (p[i, 2] if i >= 0 else cable_place[k, 2])
            s = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            path += s
            s = max(s, SHORTEST_MM)
            row[k, 0] -= d0 / s
            row[k, 1] -= d1 / s
            row[k, 2] -= d2 / s
            row[k + 1, 0] += d0 / s
            row[k + 1, 1] += d1 / s
            row[k + 1, 2] += d2 / s
        stretch[n] = path - rows.length[n]
        tension = tension_of(multiplier[n], penalty[n], stretch[n], taut[n])
        energy += (tension * tension - multiplier[n] * multiplier[n]) / (2.0 * penalty[n])
        if tension == 0.0:
            continue
        for k in range(first, last):
            i = cable_at[k]
            if i < 0:
                continue
            for r in range(3):
                force[i, r] -= tension * row[k, r]
            for m in range(first, last):
                j = cable_at[m]
                if j >= 0:
                    for r in range(3):
                        for c in range(3):
                            matrix[3 * i + r, 3 * j + c] += penalty[n] * row[k, r] * row[m, c]
        for k in range(first, last - 1):
            if channel[k]:
                continue
            i, j = cable_at[k], cable_at[k + 1]
            d0 = (p[j, 0] if j >= 0 else cable_place[k + 1, 0]) - (p[i, 0] if i >= 0 else cable_place[k, 0])
            d1 = (p[j, 1] if j >= 0 else cable_place[k + 1, 1]) - (p[i, 1] if i >= 0 else cable_place[k, 1])
            d2 = (p[j, 2] if j >= 0 else cable_place[k + 1, 2]) - (p[i, 2] if i >= 0 else cable_place[k, 2])
            s = max(math.sqrt(d0 * d0 + d1 * d1 + d2 * d2), SHORTEST_MM)
            bending = max(0.0, tension)
            for r in range(3):
                dr = d0 if r == 0 else (d1 if r == 1 else d2)
                for c in range(3):
                    dc = d0 if c == 0 else (d1 if c == 1 else d2)
                    g = bending / s * ((1.0 if r == c else 0.0) - dr * dc / (s * s))
                    if i >= 0:
                        matrix[3 * i + r, 3 * i + c] += g
                    if j >= 0:
                        matrix[3 * j + r, 3 * j + c] += g
                    if i >= 0 and j >= 0:
                        matrix[3 * i + r, 3 * j + c] -= g
                        matrix[3 * j + r, 3 * i + c] -= g
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def solve_dense(matrix: Array, v: Array) -> None:
    """Overwrites ``v`` (n,) with matrix⁻¹ v, and ``matrix`` (n, n); Gaussian elimination with partial pivoting."""
    n = len(v)
    for j in range(n):
        pivot = j
        for i in range(j + 1, n):
            if abs(matrix[i, j]) > abs(matrix[pivot, j]):
                pivot = i
        if pivot != j:
            for k in range(j, n):
                matrix[j, k], matrix[pivot, k] = matrix[pivot, k], matrix[j, k]
            v[j], v[pivot] = v[pivot], v[j]
        for i in range(j + 1, n):
            multiplier = matrix[i, j] / matrix[j, j]
            if multiplier != 0.0:
                for k in range(j + 1, n):
                    matrix[i, k] -= multiplier * matrix[j, k]
                v[i] -= multiplier * v[j]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            v[i] -= matrix[i, k] * v[k]
        v[i] /= matrix[i, i]
