"""The iterations of a static equilibrium in one kernel: energy and forces, direction, line search.

A tick has a few iterations of a quarter of a millisecond each. Called one after the other from Python, the same
kernels take twice that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics import banded
from trainer.mechanics.attachments import Rows, pull
from trainer.mechanics.links import add_forces
from trainer.mechanics.quasi_newton import add_scaled, after_base, at_points, before_base, dot, hold_base, spread

#: A cable's path may be longer than the cable by this much, mm.
CABLE_MM = 1e-5
#: Sufficient decrease (Armijo), and the shortest step tried.
DECREASE, SHORTEST_STEP = 1e-4, 1e-4
#: Share of an energy that is lost to rounding when it is summed over thousands of links.
ROUNDING = 1e-14


class Bodies(NamedTuple):
    """A link mesh of bodies that follow one another in the numbering of nodes and links."""

    links: np.ndarray  # (m, 2) int32
    rest_length: Array  # (m,) mm
    stiffness: Array  # (m,) mN/mm
    fixed: np.ndarray  # (n,) bool
    span: np.ndarray  # (bodies, 2) int64, rows of a body's links
    nodes: np.ndarray  # (bodies, 2) int64, rows of a body's free nodes
    longest_step: float  # mm, of a node along a coordinate in one iteration


class Base(NamedTuple):
    """The kept factors and how held points answer to forces; see Compliance."""

    factors: tuple[banded.BandedFactor, ...]
    columns: Array  # (slots, 3, n, 3) mm/mN
    slot_range: np.ndarray  # (slots, 2) int64
    matrix: Array  # (3 slots, 3 slots) mm/mN


class Memory(NamedTuple):
    """Secant pairs in a ring, and scratch; all that is kept from one solve to the next."""

    s: Array  # (pairs, n, 3) mm
    y: Array  # (pairs, n, 3) mN
    product: Array  # (pairs, bodies) s · y
    ring: np.ndarray  # (2,) int64, the newest pair and how many there are
    force: Array  # (n, 3) mN, of the links at the last evaluation
    old_force: Array  # (n, 3)
    g: Array  # (n, 3)
    q: Array  # (n, 3)
    z: Array  # (n, 3)
    trial: Array  # (n, 3)
    v: Array  # (3 free nodes of the largest body,)


class Held(NamedTuple):
    """What one solve holds at u points in use by c cables with k points, and the arrays of its size."""

    awake: np.ndarray  # (bodies that are not at rest,) int64
    first: int  # rows of the nodes that take part
    last: int
    nodes: np.ndarray  # (u, 3)
    weights: Array  # (u, 3)
    multiplier: Array  # (c,) mN
    penalty: Array  # (c,) mN/mm
    row: Array  # (k, 3)
    point: Array  # (u, 3) mm
    force: Array  # (u, 3) mN
    matrix: Array  # (3 u, 3 u) mN/mm
    stretch: Array  # (c,) mm
    moved: Array  # (pairs, u, 3)
    pulled: Array  # (pairs, u, 3)
    answer: Array  # (u, 3)
    at: Array  # (u, 3)
    system: Array  # (3 u, 3 u)
    curvature: Array  # (pairs,)
    share: Array  # (pairs,)


@njit(cache=True, nogil=True, error_model="numpy")
def pull_points(x: Array, rows: Rows, held: Held) -> float:
    """The energy of what holds the points at ``x`` (n, 3); leaves their forces and their stiffness behind."""
    at_points(x, held.nodes, held.weights, held.point)
    return pull(held.point, rows, held.multiplier, held.penalty, held.row, held.force, held.matrix, held.stretch)


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate(x: Array, bodies: Bodies, rows: Rows, held: Held, memory: Memory) -> float:
    """The energy at ``x`` (n, 3); leaves the nodes' elastic forces, the points' forces and their stiffness behind."""
    energy = 0.0
    memory.force[held.first : held.last] = 0.0
    for b in held.awake:
        first, last = bodies.span[b, 0], bodies.span[b, 1]
        energy += add_forces(x, bodies.links, bodies.rest_length, bodies.stiffness, first, last, memory.force)
    return energy + pull_points(x, rows, held)


@njit(cache=True, nogil=True, error_model="numpy")
def gradient(bodies: Bodies, held: Held, memory: Memory) -> float:
    """Minus the unbalanced forces on free nodes at the last evaluation, into ``memory.g``; their norm, mN."""
    g, force = memory.g, memory.force
    for i in range(held.first, held.last):
        for c in range(3):
            g[i, c] = -force[i, c]
    spread(-1.0, held.force, held.nodes, held.weights, g)
    for i in range(held.first, held.last):
        if bodies.fixed[i]:
            g[i, 0] = g[i, 1] = g[i, 2] = 0.0
    return math.sqrt(dot(g, g, held.first, held.last))


@njit(cache=True, nogil=True, error_model="numpy")
def direction(base: Base, rows: Rows, held: Held, memory: Memory) -> float:
    """A step towards the energy's minimum into ``memory.z``, from ``memory.g``; returns the slope along it, mN mm."""
    lo, hi = held.first, held.last
    q, z = memory.q, memory.z
    newest, count = memory.ring[0], memory.ring[1]
    q[lo:hi] = memory.g[lo:hi]
    before_base(
        q, memory.s, memory.y, memory.product, newest, count, held.matrix, held.nodes, held.weights, held.awake,
        lo, hi, held.moved, held.pulled, held.curvature, held.share,
    )  # fmt: skip
    for b in held.awake:
        banded.solve(base.factors[b], q, memory.v, z)
    hold_base(
        z, rows.slots, held.nodes, held.weights, base.columns, base.slot_range, base.matrix, held.matrix,
        held.at, held.answer, held.system,
    )  # fmt: skip
    after_base(
        z, memory.s, memory.y, newest, count, held.nodes, held.weights, lo, hi, held.pulled, held.curvature,
        held.share, held.at,
    )  # fmt: skip
    return dot(memory.g, z, lo, hi)


@njit(cache=True, nogil=True, error_model="numpy")
def keep_pair(x: Array, bodies: Bodies, held: Held, memory: Memory) -> None:
    """The accepted step becomes the newest secant pair, and ``x`` (n, 3) the trial."""
    pairs = len(memory.s)
    k = (memory.ring[0] + 1) % pairs
    memory.ring[0] = k
    memory.ring[1] = min(memory.ring[1] + 1, pairs)
    s, y, trial = memory.s[k], memory.y[k], memory.trial
    for i in range(held.first, held.last):
        for c in range(3):
            s[i, c] = trial[i, c] - x[i, c]
            y[i, c] = memory.old_force[i, c] - memory.force[i, c]
            x[i, c] = trial[i, c]
    for b in held.awake:
        memory.product[k, b] = dot(s, y, bodies.nodes[b, 0], bodies.nodes[b, 1])


@njit(cache=True, nogil=True, error_model="numpy")
def largest(a: Array, first: int, last: int) -> float:
    """The largest absolute value in the rows ``first`` … ``last`` - 1 of ``a`` (n, 3)."""
    u = a[first:last].reshape(-1)
    most = 0.0
    for i in range(len(u)):
        most = max(most, abs(u[i]))
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def tensions_are_settled(held: Held) -> bool:
    """Whether each cable's multiplier is its tension within CABLE_MM; it is set to the tension if one is not."""
    settled = True
    for c in range(len(held.stretch)):
        tension = max(0.0, held.multiplier[c] + held.penalty[c] * held.stretch[c])
        settled = settled and abs(tension - held.multiplier[c]) <= CABLE_MM * held.penalty[c]
    if not settled:
        for c in range(len(held.stretch)):
            held.multiplier[c] = max(0.0, held.multiplier[c] + held.penalty[c] * held.stretch[c])
    return settled


@njit(cache=True, nogil=True, error_model="numpy")
def minimise(
    x: Array,
    bodies: Bodies,
    base: Base,
    rows: Rows,
    held: Held,
    memory: Memory,
    tolerance_mN: float,
    max_iterations: int,
) -> tuple[bool, int, float]:
    """Moves ``x`` (n, 3) until the residual and the cables' excess are small: (converged, iterations, residual mN)."""
    lo, hi = held.first, held.last
    energy = evaluate(x, bodies, rows, held, memory)
    residual = gradient(bodies, held, memory)
    for iteration in range(max_iterations):
        if residual <= tolerance_mN:
            if tensions_are_settled(held):
                return True, iteration, residual
            energy = evaluate(x, bodies, rows, held, memory)
            residual = gradient(bodies, held, memory)
        slope = direction(base, rows, held, memory)
        if not slope > 0.0:  # the pairs mislead: the base alone always leads down
            memory.ring[1] = 0
            slope = direction(base, rows, held, memory)
            if not slope > 0.0:
                return False, iteration, residual
        t = min(1.0, bodies.longest_step / max(largest(memory.z, lo, hi), 1e-300))
        memory.old_force[lo:hi] = memory.force[lo:hi]
        # What rounding of the energy's sum, and of coordinates far from the origin, can pretend.
        held_with = 0.0
        for i in range(len(held.force)):
            held_with += abs(held.force[i, 0]) + abs(held.force[i, 1]) + abs(held.force[i, 2])
        noise = ROUNDING * (abs(energy) + largest(x, lo, hi) * held_with)
        while True:
            memory.trial[lo:hi] = x[lo:hi]
            add_scaled(-t, memory.z, memory.trial, lo, hi)
            new_energy = evaluate(memory.trial, bodies, rows, held, memory)
            if new_energy <= energy - DECREASE * t * slope + noise:
                break
            t *= 0.5
            if not t >= SHORTEST_STEP:
                evaluate(x, bodies, rows, held, memory)
                return False, iteration, gradient(bodies, held, memory)
        energy = new_energy
        keep_pair(x, bodies, held, memory)
        residual = gradient(bodies, held, memory)
    converged = residual <= tolerance_mN
    for c in range(len(held.stretch)):
        converged = converged and held.stretch[c] <= CABLE_MM
    return converged, max_iterations, residual
