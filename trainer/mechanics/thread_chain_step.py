"""How a bare chain's time passes: tensions from a tridiagonal system, an explicit method of order 8, a projection.

A chain's links bear what keeps their lengths: e·(a₁ - a₀) + |w|² = 0 for each link e with the relative speed w, one
equation per link that has its neighbours' tensions in it beside its own (the constraint differentiated twice). Held
nodes have no mobility; their accelerations are given. The system is eliminated from both ends towards the middle (the
"twisted" factorisation; Golub, Van Loan 2013, "Matrix Computations", section 4.3.1): two chains of divisions that do
not wait for one another.

The method is Dormand and Prince's of order 8 with 12 stages (Hairer, Nørsett, Wanner 1993, "Solving Ordinary
Differential Equations I", section II.5), written for x'' (section II.14: A² takes accelerations to places), so that
speeds of stages are not stored. Its estimate of order 5 chooses the step; the fastest wave bounds it. After a step
places and speeds are projected onto the constraints (Hairer, Lubich, Wanner 2006, "Geometric Numerical Integration",
section IV.4), so that lengths do not drift.

Inside, arrays are (3, n): one coordinate in a row, which is what a processor's vectors load.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainer.geometry import Array

LENGTHS = 1e-10  # relative: |e|² of a link may differ from d² by twice this when it is projected
MOST_PROJECTIONS = 6
FASTEST = 4.0  # radians of the fastest wave a step: the method is stable to 5.4 on the imaginary axis
SAFETY, LEAST_CHANGE, MOST_CHANGE = 0.9, 0.2, 4.0  # of a step (Hairer, Nørsett, Wanner 1993, section II.4)
MOST_STEPS = 5000  # a tick, refused ones too
DONE, TAUT, STALLED = 0.0, 1.0, 2.0


STAGES = 12
# Rows of coefficients (29, 12): of speeds and places of the stages, of the result, of its error; when the stages are.
SPEED, PLACE, END_SPEED, END_PLACE, ERROR_SPEED, ERROR_PLACE, WHEN = 0, 12, 24, 25, 26, 27, 28
# Numbers of a chain: what ``advance_chain`` reads and says.
ENDED, STEPS, REFUSED, NEXT, HOLD, FORCE, BEFORE, LENGTH, DRAG, GRAVITY = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
MASS, ROWS = 63, 67  # of memory, n numbers each: the masses' row, and how many


class ChainWork(NamedTuple):
    """Memory of a step by name: nothing in it outlives a tick but the masses."""

    x: Array  # (3, n)
    v: Array
    stage_x: Array
    stage_v: Array
    link: Array  # (3, n), the last column is none
    begin: Array  # (3, n): of the k-th hold in column k the acceleration at the tick's start, mm/s²
    grow: Array  # its growth, mm/s³
    gain: Array  # (12, 3, n) accelerations of the stages
    diagonal: Array  # (n - 1,)
    beside: Array
    right: Array
    share: Array
    pull: Array  # 1/s²: a link's tension over its length and over the mass of a node inside
    mobility: Array  # (n,) 1 inside, 2 at the ends, 0 where held
    mass: Array  # (n,) kg
    zero: Array  # (3, n)


@njit(cache=True, nogil=True, error_model="numpy")
def _by_name(rows: Array) -> ChainWork:
    n = rows.shape[1]
    return ChainWork(
        rows[0:3], rows[3:6], rows[6:9], rows[9:12], rows[12:15], rows[15:18], rows[18:21],
        rows[21:57].reshape(STAGES, 3, n), rows[57][:-1], rows[58][:-1], rows[59][:-1], rows[60][:-1], rows[61][:-1],
        rows[62], rows[MASS], rows[64:67],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _links(x: Array, mobility: Array, link: Array, diagonal: Array, beside: Array) -> None:
    """Links and the matrix of their tensions: J W Jᵀ of the lengths' Jacobian J and the mobilities W."""
    x0, x1, x2 = x[0], x[1], x[2]
    a0, a1, a2, b0, b1, b2 = x0[:-1], x1[:-1], x2[:-1], x0[1:], x1[1:], x2[1:]
    e0, e1, e2 = link[0][:-1], link[1][:-1], link[2][:-1]
    w, u = mobility[:-1], mobility[1:]
    for j in range(len(e0)):
        p, q, r = b0[j] - a0[j], b1[j] - a1[j], b2[j] - a2[j]
        e0[j], e1[j], e2[j] = p, q, r
        diagonal[j] = (p * p + q * q + r * r) * (w[j] + u[j])
    f0, f1, f2 = e0[1:], e1[1:], e2[1:]
    for j in range(len(e0) - 1):
        beside[j] = (e0[j] * f0[j] + e1[j] * f1[j] + e2[j] * f2[j]) * u[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(diagonal: Array, beside: Array, right: Array, share: Array, pull: Array) -> None:
    """diagonal[j] pull[j] - beside[j - 1] pull[j - 1] - beside[j] pull[j + 1] = right[j]."""
    n = len(diagonal)
    middle = n // 2
    last = n - 1
    p = 1.0 / diagonal[0]
    q = right[0] * p
    share[0], pull[0] = beside[0] * p, q
    s = 1.0 / diagonal[last]
    t = right[last] * s
    if middle < last:
        share[last], pull[last] = beside[last - 1] * s, t
    for k in range(1, last - middle):
        i = last - k
        b, c = beside[k - 1], beside[i]
        p = 1.0 / (diagonal[k] - b * b * p)
        s = 1.0 / (diagonal[i] - c * c * s)
        q = (right[k] + b * q) * p
        t = (right[i] + c * t) * s
        share[k], pull[k] = beside[k] * p, q
        share[i], pull[i] = beside[i - 1] * s, t
    if n % 2 == 0 and n > 2:  # the left half has a link more
        b = beside[middle - 2]
        p = 1.0 / (diagonal[middle - 1] - b * b * p)
        q = (right[middle - 1] + b * q) * p
        share[middle - 1], pull[middle - 1] = beside[middle - 1] * p, q
    b = beside[middle - 1]
    top, bottom = right[middle] + b * q, diagonal[middle] - b * b * p
    if middle < last:
        c = beside[middle]
        top += c * t
        bottom -= c * c * s
    q = t = top / bottom
    pull[middle] = q
    for k in range(1, last - middle + 1):
        q = pull[middle - k] + share[middle - k] * q
        t = pull[middle + k] + share[middle + k] * t
        pull[middle - k], pull[middle + k] = q, t
    if n % 2 == 0:
        pull[0] += share[0] * q


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(pull: Array, link: Array, mobility: Array, out: Array) -> None:
    """Add what the links' pulls do to the nodes: W Jᵀ pull, (3, n)."""
    last = len(pull) - 1
    for c in range(3):
        e, row = link[c], out[c]
        f, g, o, w = e[1:], pull[1:], row[1:], mobility[1:]
        for j in range(last):
            o[j] += w[j] * (g[j] * f[j] - pull[j] * e[j])
        row[0] += mobility[0] * pull[0] * e[0]
        row[last + 1] -= mobility[last + 1] * pull[last] * e[last]


@njit(cache=True, nogil=True, error_model="numpy")
def _approach(v: Array, link: Array, right: Array) -> None:
    """The speed at which each link would grow, times its length."""
    v0, v1, v2 = v[0], v[1], v[2]
    a0, a1, a2, b0, b1, b2 = v0[:-1], v1[:-1], v2[:-1], v0[1:], v1[1:], v2[1:]
    e0, e1, e2 = link[0][:-1], link[1][:-1], link[2][:-1]
    for j in range(len(right)):
        right[j] = e0[j] * (b0[j] - a0[j]) + e1[j] * (b1[j] - a1[j]) + e2[j] * (b2[j] - a2[j])


@njit(cache=True, nogil=True, error_model="numpy")
def _accelerate(work: ChainWork, v: Array, gain: Array, numbers: Array, holds: NDArray[np.int32], time: float) -> None:
    """Accelerations ``gain`` (3, n) of a chain whose ``links`` are known; held nodes have begin + grow time."""
    v0, v1, v2 = v[0], v[1], v[2]
    a0, a1, a2, b0, b1, b2 = v0[:-1], v1[:-1], v2[:-1], v0[1:], v1[1:], v2[1:]
    e0, e1, e2 = work.link[0][:-1], work.link[1][:-1], work.link[2][:-1]
    right, pull, w = work.right, work.pull, work.mobility
    drag, last = numbers[DRAG], len(right)
    for j in range(last):  # weight and air: alike for both ends of a link, but for the air that it meets in growing
        p, q, r = b0[j] - a0[j], b1[j] - a1[j], b2[j] - a2[j]
        right[j] = p * p + q * q + r * r - drag * (e0[j] * p + e1[j] * q + e2[j] * r)
    for k in range(len(holds)):
        i = holds[k]
        for c in range(3):
            extra = work.begin[c, k] + work.grow[c, k] * time - (numbers[GRAVITY + c] - drag * v[c, i])
            if i > 0:
                right[i - 1] += work.link[c, i - 1] * extra
            if i < last:
                right[i] -= work.link[c, i] * extra
    _solve(work.diagonal, work.beside, right, work.share, pull)
    for c in range(3):
        row, speed, g, e = gain[c], v[c], numbers[GRAVITY + c], work.link[c]
        f, z, o, u, m = e[1:], pull[1:], row[1:], speed[1:], w[1:]
        for j in range(last - 1):
            o[j] = g - drag * u[j] + m[j] * (z[j] * f[j] - pull[j] * e[j])
        row[0] = g - drag * speed[0] + w[0] * pull[0] * e[0]
        row[last] = g - drag * speed[last] - w[last] * pull[last - 1] * e[last - 1]
        for k in range(len(holds)):
            row[holds[k]] = work.begin[c, k] + work.grow[c, k] * time


@njit(cache=True, nogil=True, error_model="numpy")
def _stage(
    at_x: Array, at_v: Array, x: Array, v: Array, gains: Array, place: Array, speed: Array, h: float, go: float,
    stages: int,
) -> None:  # fmt: skip
    """at_x = x + go v + h² Σ place gains and at_v = v + h Σ speed gains, (3n,), over the first ``stages`` (3n,) gains.

    Four at a time; weights past the stages are 0.
    """
    for j in range(0, stages, 4):
        g0, g1, g2, g3 = gains[j], gains[j + 1], gains[j + 2], gains[j + 3]
        p0, p1, p2, p3 = h * h * place[j], h * h * place[j + 1], h * h * place[j + 2], h * h * place[j + 3]
        s0, s1, s2, s3 = h * speed[j], h * speed[j + 1], h * speed[j + 2], h * speed[j + 3]
        if j == 0:
            for i in range(len(at_x)):
                at_x[i] = x[i] + go * v[i] + (p0 * g0[i] + p1 * g1[i] + (p2 * g2[i] + p3 * g3[i]))
                at_v[i] = v[i] + (s0 * g0[i] + s1 * g1[i] + (s2 * g2[i] + s3 * g3[i]))
        else:
            for i in range(len(at_x)):
                at_x[i] += p0 * g0[i] + p1 * g1[i] + (p2 * g2[i] + p3 * g3[i])
                at_v[i] += s0 * g0[i] + s1 * g1[i] + (s2 * g2[i] + s3 * g3[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _project(work: ChainWork, x: Array, v: Array, length: float) -> bool:
    """Places, then speeds, to the nearest (in the masses' metric) that keep lengths. False if Newton does not."""
    right = work.right
    for _ in range(MOST_PROJECTIONS):
        _links(x, work.mobility, work.link, work.diagonal, work.beside)
        e0, e1, e2 = work.link[0][:-1], work.link[1][:-1], work.link[2][:-1]
        worst = 0.0
        for j in range(len(right)):
            right[j] = 0.5 * (e0[j] * e0[j] + e1[j] * e1[j] + e2[j] * e2[j] - length * length)
        for j in range(len(right)):
            worst = max(worst, abs(right[j]))
        if worst <= LENGTHS * length * length:
            _approach(v, work.link, right)
            _solve(work.diagonal, work.beside, right, work.share, work.pull)
            _spread(work.pull, work.link, work.mobility, v)
            return math.isfinite(work.pull[0])  # one that is not makes all of them so
        if not worst <= 0.25 * length * length:
            return False
        _solve(work.diagonal, work.beside, right, work.share, work.pull)
        _spread(work.pull, work.link, work.mobility, x)
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _longest(work: ChainWork, drag: float) -> float:
    """The longest step, s, that the fastest wave across the links allows.

    A node between two pulls is drawn by them to its neighbours: Gershgorin's bound of the frequency squared.
    """
    most = 0.0
    for j in range(len(work.pull)):
        most = max(most, abs(work.pull[j]) * 2.0 * (work.mobility[j] + work.mobility[j + 1]))
    return FASTEST / max(math.sqrt(most) + drag, 1e-300)


@njit(cache=True, nogil=True, error_model="numpy")
def _largest(rows: Array) -> float:
    """Of the entries of (3, n), without their signs: three at a time."""
    r0, r1, r2 = rows[0], rows[1], rows[2]
    p = q = r = 0.0
    for i in range(len(r0)):
        p, q, r = max(p, abs(r0[i])), max(q, abs(r1[i])), max(r, abs(r2[i]))
    return max(p, q, r)


@njit(cache=True, nogil=True, error_model="numpy")
def _bear(
    work: ChainWork, gain: Array, numbers: Array, holds: NDArray[np.int32], bears: Array
) -> None:  # fmt: skip
    """The force (k, 3) mN of each hold: what its node's momentum asks for beyond weight, air and links."""
    last = len(work.pull)
    inside = work.mass[1]
    for k in range(len(holds)):
        i = holds[k]
        for c in range(3):
            force = work.mass[i] * (gain[c, i] - numbers[GRAVITY + c] + numbers[DRAG] * work.v[c, i])
            if i > 0:
                force += inside * work.pull[i - 1] * work.link[c, i - 1]
            if i < last:
                force -= inside * work.pull[i] * work.link[c, i]
            bears[k, c] = force


@njit(cache=True, nogil=True, error_model="numpy")
def _paths(
    work: ChainWork, x: Array, v: Array, holds: NDArray[np.int32], targets: Array, secant: Array, tick: float,
    before: float,
) -> None:  # fmt: skip
    """Accelerations of the holds on the cubics from where and how fast they are to ``targets`` (k, 3).

    The speed there is that of the parabola through the last three places; ``secant`` (n, 3) mm/s was the mean speed
    in the tick before, which lasted ``before`` s.
    """
    for k in range(len(holds)):
        i = holds[k]
        work.mobility[i] = 0.0
        for c in range(3):
            mean = (targets[k, c] - x[i, c]) / tick
            change = mean - secant[i, c]
            end = mean + (change * tick / (tick + before) if before > 0.0 else 0.5 * change)
            work.begin[c, k] = (6.0 * mean - 4.0 * v[i, c] - 2.0 * end) / tick
            work.grow[c, k] = 6.0 * (v[i, c] + end - 2.0 * mean) / (tick * tick)


@njit(cache=True, nogil=True, error_model="numpy")
def advance_chain(
    coefficients: Array, rows: Array, x: Array, v: Array, tension: Array, secant: Array, numbers: Array,
    holds: NDArray[np.int32], targets: Array, limit: Array, bears: Array, tick: float, tolerance: float,
) -> None:  # fmt: skip
    """One tick. ``x``, ``v``, ``secant`` (n, 3) and ``tension`` (n,) change only if it succeeds: ``numbers`` say how

    it ended, steps, refused steps, the step to try next (s), and of a taut chain the hold and its force (mN).
    """
    n = len(x)
    work = _by_name(rows)
    length, drag = numbers[LENGTH], numbers[DRAG]
    for i in range(n):
        work.mobility[i] = work.mass[1] / work.mass[i]
        for c in range(3):
            work.x[c, i], work.v[c, i] = x[i, c], v[i, c]
    _paths(work, x, v, holds, targets, secant, tick, numbers[BEFORE])
    size = 3 * n
    gains, at_x, at_v = work.gain.reshape(STAGES, size), work.stage_x.reshape(size), work.stage_v.reshape(size)
    now_x, now_v, zero = work.x.reshape(size), work.v.reshape(size), work.zero.reshape(size)
    numbers[ENDED] = STALLED
    numbers[STEPS] = numbers[REFUSED] = 0.0
    if not _project(work, work.x, work.v, length):
        return
    _accelerate(work, work.v, work.gain[0], numbers, holds, 0.0)
    bound = _longest(work, drag)
    h = numbers[NEXT] if numbers[NEXT] > 0.0 else tick
    done = 0.0
    for _ in range(MOST_STEPS):
        left = tick - done
        taken = left / math.ceil(left / min(h, bound) * (1.0 - 1e-9))
        for s in range(1, STAGES):
            go = coefficients[WHEN, s] * taken
            _stage(at_x, at_v, now_x, now_v, gains, coefficients[PLACE + s], coefficients[SPEED + s], taken, go, s)
            _links(work.stage_x, work.mobility, work.link, work.diagonal, work.beside)
            _accelerate(work, work.stage_v, work.gain[s], numbers, holds, done + go)
        place, speed = coefficients[ERROR_PLACE], coefficients[ERROR_SPEED]
        _stage(at_x, at_v, zero, zero, gains, place, speed, taken, 0.0, STAGES)
        error = max(_largest(work.stage_x), taken * _largest(work.stage_v))
        place, speed = coefficients[END_PLACE], coefficients[END_SPEED]
        _stage(at_x, at_v, now_x, now_v, gains, place, speed, taken, taken, STAGES)
        if not (error <= tolerance and _project(work, work.stage_x, work.stage_v, length)):
            numbers[REFUSED] += 1.0
            change = SAFETY * (tolerance / error) ** (1.0 / 6.0) if error > tolerance else LEAST_CHANGE
            h = taken * max(LEAST_CHANGE, change)
            gains[1:] = 0.0  # what is not finite would outlive its step in sums with a weight of 0
            continue
        numbers[STEPS] += 1.0
        now_x[:] = at_x
        now_v[:] = at_v
        done = tick if taken >= left else done + taken
        change = SAFETY * (tolerance / error) ** (1.0 / 6.0) if error > 0.0 else MOST_CHANGE
        h = taken * min(MOST_CHANGE, max(LEAST_CHANGE, change))
        _accelerate(work, work.v, work.gain[0], numbers, holds, done)
        bound = _longest(work, drag)
        _bear(work, work.gain[0], numbers, holds, bears)
        for k in range(len(holds)):
            force = math.sqrt(bears[k, 0] ** 2 + bears[k, 1] ** 2 + bears[k, 2] ** 2)
            if force > limit[k]:
                numbers[ENDED], numbers[HOLD], numbers[FORCE] = TAUT, float(k), force
                return
        if done == tick:
            break
    if done < tick:
        return
    numbers[ENDED], numbers[NEXT], numbers[BEFORE] = DONE, h, tick
    for k in range(len(holds)):
        i = holds[k]
        for c in range(3):
            secant[i, c] = (targets[k, c] - x[i, c]) / tick
            work.x[c, i] = targets[k, c]
    for i in range(n):
        if i > 0:
            tension[i] = work.pull[i - 1] * work.mass[1] * length
        for c in range(3):
            if work.mobility[i] > 0.0:
                secant[i, c] = work.v[c, i]
            x[i, c], v[i, c] = work.x[c, i], work.v[c, i]
