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


class Method(NamedTuple):
    """Coefficients (12, 12) of speeds and places of the stages, (12,) of the result and its error."""

    at: Array  # (12,) of the step
    speed: Array
    place: Array
    end_speed: Array
    end_place: Array
    error_speed: Array
    error_place: Array


class ChainWork(NamedTuple):
    """Memory of a step: nothing in it outlives a tick but ``mobility``'s own mass."""

    x: Array  # (3, n)
    v: Array
    stage_x: Array
    stage_v: Array
    gain: Array  # (12, 3, n) accelerations of the stages
    link: Array  # (3, n - 1)
    diagonal: Array  # (n - 1,)
    beside: Array
    right: Array
    share: Array
    pull: Array  # 1/s² a link's tension over its length and over the mass of a node inside
    mobility: Array  # (n,) 1 inside, 2 at the ends, 0 where held


@njit(cache=True, nogil=True, error_model="numpy")
def _links(x: Array, mobility: Array, link: Array, diagonal: Array, beside: Array) -> None:
    """Links and the matrix of their tensions: J W Jᵀ of the lengths' Jacobian J and the mobilities W."""
    x0, x1, x2 = x[0], x[1], x[2]
    a0, a1, a2, b0, b1, b2 = x0[:-1], x1[:-1], x2[:-1], x0[1:], x1[1:], x2[1:]
    e0, e1, e2 = link[0], link[1], link[2]
    w, u = mobility[:-1], mobility[1:]
    for j in range(len(e0)):
        p, q, r = b0[j] - a0[j], b1[j] - a1[j], b2[j] - a2[j]
        e0[j], e1[j], e2[j] = p, q, r
        diagonal[j] = (p * p + q * q + r * r) * (w[j] + u[j])
    f0, f1, f2 = e0[1:], e1[1:], e2[1:]
    for j in range(len(f0)):
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
    e0, e1, e2 = link[0], link[1], link[2]
    for j in range(len(right)):
        right[j] = e0[j] * (b0[j] - a0[j]) + e1[j] * (b1[j] - a1[j]) + e2[j] * (b2[j] - a2[j])


@njit(cache=True, nogil=True, error_model="numpy")
def _accelerate(
    work: ChainWork, v: Array, gain: Array, gravity: Array, drag: float, holds: NDArray[np.int32], begin: Array,
    grow: Array, time: float,
) -> None:  # fmt: skip
    """Accelerations ``gain`` (3, n) of a chain whose ``links`` are known; held nodes have begin + grow time."""
    for c in range(3):
        row, speed, g = gain[c], v[c], gravity[c]
        for i in range(len(row)):
            row[i] = g - drag * speed[i]
        for k in range(len(holds)):
            row[holds[k]] = begin[k, c] + grow[k, c] * time
    v0, v1, v2, f0, f1, f2 = v[0], v[1], v[2], gain[0], gain[1], gain[2]
    a0, a1, a2, b0, b1, b2 = v0[:-1], v1[:-1], v2[:-1], v0[1:], v1[1:], v2[1:]
    c0, c1, c2, d0, d1, d2 = f0[:-1], f1[:-1], f2[:-1], f0[1:], f1[1:], f2[1:]
    e0, e1, e2, right = work.link[0], work.link[1], work.link[2], work.right
    for j in range(len(right)):
        p, q, r = b0[j] - a0[j], b1[j] - a1[j], b2[j] - a2[j]
        pull = e0[j] * (d0[j] - c0[j]) + e1[j] * (d1[j] - c1[j]) + e2[j] * (d2[j] - c2[j])
        right[j] = p * p + q * q + r * r + pull
    _solve(work.diagonal, work.beside, right, work.share, work.pull)
    _spread(work.pull, work.link, work.mobility, gain)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_four(out: Array, a: float, k: Array, b: float, m: Array, c: float, p: Array, d: float, q: Array) -> None:
    for i in range(len(out)):
        out[i] += a * k[i] + b * m[i] + c * p[i] + d * q[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _combine(out: Array, gain: Array, weights: Array, scale: float, stages: int) -> None:
    """out (3n,) += scale · sum of weights[j] gain[j] over the stages; the weights past them are 0."""
    for j in range(0, stages, 4):
        _add_four(
            out, scale * weights[j], gain[j], scale * weights[j + 1], gain[j + 1], scale * weights[j + 2], gain[j + 2],
            scale * weights[j + 3], gain[j + 3],
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _go_on(out: Array, x: Array, v: Array, h: float) -> None:
    for i in range(len(out)):
        out[i] = x[i] + h * v[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _project(work: ChainWork, x: Array, v: Array, length: float) -> bool:
    """Places, then speeds, to the nearest (in the masses' metric) that keep lengths. False if Newton does not."""
    right = work.right
    for _ in range(MOST_PROJECTIONS):
        _links(x, work.mobility, work.link, work.diagonal, work.beside)
        e0, e1, e2 = work.link[0], work.link[1], work.link[2]
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
def _size(out: Array, gains: Array, weights: Array, scale: float, stages: int) -> float:
    """The largest entry of scale · sum of weights[j] gains[j]; ``out`` (3n,) is overwritten."""
    out[:] = 0.0
    _combine(out, gains, weights, scale, stages)
    most = 0.0
    for i in range(len(out)):
        most = max(most, abs(out[i]))
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def _bear(
    work: ChainWork, gain: Array, mass: Array, drag: float, gravity: Array, holds: NDArray[np.int32],
    bears: Array,
) -> None:  # fmt: skip
    """The force (k, 3) mN of each hold: what its node's momentum asks for beyond weight, air and links."""
    last = len(work.pull)
    inside = mass[1]
    for k in range(len(holds)):
        i = holds[k]
        for c in range(3):
            force = mass[i] * (gain[c, i] - gravity[c] + drag * work.v[c, i])
            if i > 0:
                force += inside * work.pull[i - 1] * work.link[c, i - 1]
            if i < last:
                force -= inside * work.pull[i] * work.link[c, i]
            bears[k, c] = force


@njit(cache=True, nogil=True, error_model="numpy")
def advance_chain(
    method: Method, work: ChainWork, x: Array, v: Array, tension: Array, mass: Array, drag: float, gravity: Array,
    length: float, holds: NDArray[np.int32], targets: Array, limit: Array, bears: Array, begin: Array, grow: Array,
    secant: Array, tick: float, tick_before: float, tolerance: float, outcome: Array,
) -> None:  # fmt: skip
    """One tick. ``x``, ``v`` (n, 3) and ``tension`` (n,) change only if it succeeds: ``outcome`` (6,) says

    how it ended, steps, refused steps, the step to try next (s), and of a taut chain the hold and its force (mN).
    A hold goes along the cubic that has its speed at the start and at the end that of the parabola through its last
    three places. ``secant`` (n, 3) mm/s keeps its mean speed of the tick before, ``tick_before`` s.
    """
    n = len(x)
    for i in range(n):
        work.mobility[i] = mass[1] / mass[i]
        for c in range(3):
            work.x[c, i], work.v[c, i] = x[i, c], v[i, c]
    for k in range(len(holds)):
        i = holds[k]
        work.mobility[i] = 0.0
        for c in range(3):
            mean = (targets[k, c] - x[i, c]) / tick
            change = mean - secant[i, c]
            end = mean + (change * tick / (tick + tick_before) if tick_before > 0.0 else 0.5 * change)
            begin[k, c] = (6.0 * mean - 4.0 * v[i, c] - 2.0 * end) / tick
            grow[k, c] = 6.0 * (v[i, c] + end - 2.0 * mean) / (tick * tick)
    stages, size = len(method.at), 3 * n
    gains, at_x, at_v = work.gain.reshape(stages, size), work.stage_x.reshape(size), work.stage_v.reshape(size)
    now_x, now_v = work.x.reshape(size), work.v.reshape(size)
    outcome[0] = STALLED
    outcome[1] = outcome[2] = 0.0
    if not _project(work, work.x, work.v, length):
        return
    _accelerate(work, work.v, work.gain[0], gravity, drag, holds, begin, grow, 0.0)
    bound = _longest(work, drag)
    h = outcome[3] if outcome[3] > 0.0 else tick
    done = 0.0
    for _ in range(MOST_STEPS):
        left = tick - done
        taken = left / math.ceil(left / min(h, bound) * (1.0 - 1e-9))
        for s in range(1, stages):
            _go_on(at_x, now_x, now_v, method.at[s] * taken)
            _combine(at_x, gains, method.place[s], taken * taken, s)
            at_v[:] = now_v
            _combine(at_v, gains, method.speed[s], taken, s)
            _links(work.stage_x, work.mobility, work.link, work.diagonal, work.beside)
            time = done + method.at[s] * taken
            _accelerate(work, work.stage_v, work.gain[s], gravity, drag, holds, begin, grow, time)
        error = max(
            _size(at_x, gains, method.error_place, taken * taken, stages),
            _size(at_x, gains, method.error_speed, taken * taken, stages),
        )
        _go_on(at_x, now_x, now_v, taken)
        _combine(at_x, gains, method.end_place, taken * taken, stages)
        at_v[:] = now_v
        _combine(at_v, gains, method.end_speed, taken, stages)
        if not (error <= tolerance and _project(work, work.stage_x, work.stage_v, length)):
            outcome[2] += 1.0
            change = SAFETY * (tolerance / error) ** (1.0 / 6.0) if error > tolerance else LEAST_CHANGE
            h = taken * max(LEAST_CHANGE, change)
            work.gain[1:] = 0.0  # what is not finite would outlive its step in sums with a weight of 0
            continue
        outcome[1] += 1.0
        now_x[:] = at_x
        now_v[:] = at_v
        done = tick if taken >= left else done + taken
        change = SAFETY * (tolerance / error) ** (1.0 / 6.0) if error > 0.0 else MOST_CHANGE
        h = taken * min(MOST_CHANGE, max(LEAST_CHANGE, change))
        _accelerate(work, work.v, work.gain[0], gravity, drag, holds, begin, grow, done)
        bound = _longest(work, drag)
        _bear(work, work.gain[0], mass, drag, gravity, holds, bears)
        for k in range(len(holds)):
            force = math.sqrt(bears[k, 0] ** 2 + bears[k, 1] ** 2 + bears[k, 2] ** 2)
            if force > limit[k]:
                outcome[0], outcome[4], outcome[5] = TAUT, float(k), force
                return
        if done == tick:
            break
    if done < tick:
        return
    outcome[0], outcome[3] = DONE, h
    for k in range(len(holds)):
        i = holds[k]
        for c in range(3):
            secant[i, c] = (targets[k, c] - x[i, c]) / tick
            work.x[c, i] = targets[k, c]
    for i in range(n):
        if i > 0:
            tension[i] = work.pull[i - 1] * mass[1] * length
        for c in range(3):
            if work.mobility[i] > 0.0:
                secant[i, c] = work.v[c, i]
            x[i, c], v[i, c] = work.x[c, i], work.v[c, i]
