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
from trainer.mechanics.attachments import Rows, pull, tension_of
from trainer.mechanics.links import add_forces
from trainer.mechanics.quasi_newton import (
    after_base,
    at_points,
    balance,
    before_base,
    dot,
    hold_base,
    same,
    spread,
    step_along,
)

#: A target further away than this, mm, is approached in steps of this size, so that the tissue follows its path …
STEP_MM = 0.1
#: … in at most so many steps in one solve; the rest of the way is left to the next.
MOST_STEPS = 8
#: On the way to a target that has leapt, the residual may be so many times the tolerance.
STEP_TOLERANCE = 100.0
#: A cable's path may be longer than the cable by this much, mm: a fifth of what nodes are off in a stitch.
CABLE_MM = 5e-4
#: A cable's penalty, as a multiple of the tissue's own stiffness along it: with 1000 every other first step overshoots.
CABLE_PENALTY = 1e2
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
    adrift: np.ndarray  # (k,) int64, nodes that nothing holds any more: they stay
    longest_step: float  # mm, of a node along a coordinate in one iteration


class Base(NamedTuple):
    """The kept factors and how held points answer to forces; see Compliance."""

    factors: tuple[banded.BandedFactor, ...]
    columns: np.ndarray  # (slots, 3, n, 3) float32 mm/mN
    slot_range: np.ndarray  # (slots, 2) int64
    matrix: Array  # (3 slots, 3 slots) mm/mN


class Memory(NamedTuple):
    """Each body's secant pairs in a ring, and scratch; all that is kept from one solve to the next."""

    s: np.ndarray  # (pairs, n, 3) float32 mm; half the memory, and the cache is full of the factors
    y: np.ndarray  # (pairs, n, 3) float32 mN
    product: Array  # (bodies, pairs) s · y
    newest: np.ndarray  # (bodies,) int64, the newest pair
    known: np.ndarray  # (bodies,) int64, how many there are; less than none: see use_pairs
    at: Array  # (n, 3) mm, of the last evaluation; not a number before the first
    energy: Array  # (bodies,) mN mm, of the links there …
    force: Array  # (n, 3) mN, … and on their nodes
    old_force: Array  # (n, 3)
    g: Array  # (n, 3)
    q: Array  # (n, 3)
    z: Array  # (n, 3)
    trial: Array  # (n, 3)
    v: np.ndarray  # float32, see banded.solve


class Held(NamedTuple):
    """What one solve holds at u points in use by c cables with k points, and the arrays of its size."""

    awake: np.ndarray  # (b,) int64, the bodies that are solved for
    nodes: np.ndarray  # (u, 3)
    weights: Array  # (u, 3)
    multiplier: Array  # (c,) mN
    penalty: Array  # (c,) mN/mm
    row: Array  # (k, 3)
    point: Array  # (u, 3) mm
    force: Array  # (u, 3) mN
    matrix: Array  # (3 u, 3 u) mN/mm
    stretch: Array  # (c,) mm
    taut: np.ndarray  # (c,) bool, see attachments.pull
    moved: Array  # (pairs, u, 3)
    pulled: Array  # (pairs, u, 3)
    rest: Array  # (u, 3) mN
    answer: Array  # (u, 3)
    at: Array  # (u, 3)
    system: Array  # (3 u, 3 u)
    curvature: Array  # (pairs,)
    share: Array  # (pairs,)


@njit(cache=True, nogil=True, error_model="numpy")
def pull_points(x: Array, rows: Rows, held: Held) -> float:
    """The energy of what holds the points at ``x`` (n, 3); leaves their forces and their stiffness behind."""
    at_points(x, held.nodes, held.weights, held.point)
    return pull(
        held.point, rows, held.multiplier, held.penalty, held.row, held.force, held.matrix, held.stretch, held.taut
    )


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate(x: Array, bodies: Bodies, rows: Rows, held: Held, memory: Memory) -> float:
    """The energy at ``x`` (n, 3); leaves the nodes' elastic forces, the points' forces and their stiffness behind."""
    energy = 0.0
    for b in held.awake:
        lo, hi = bodies.nodes[b, 0], bodies.nodes[b, 1]
        if not same(x, memory.at, lo, hi):  # a solve begins where the last one ended
            memory.at[lo:hi] = x[lo:hi]
            memory.force[lo:hi] = 0.0
            first, last = bodies.span[b, 0], bodies.span[b, 1]
            memory.energy[b] = add_forces(
                x, bodies.links, bodies.rest_length, bodies.stiffness, first, last, memory.force
            )
        energy += memory.energy[b]
    return energy + pull_points(x, rows, held)


@njit(cache=True, nogil=True, error_model="numpy")
def gradient(bodies: Bodies, held: Held, memory: Memory) -> float:
    """Minus the unbalanced forces on free nodes at the last evaluation, into ``memory.g``; their norm, mN."""
    g, force = memory.g, memory.force
    for b in held.awake:
        for i in range(bodies.nodes[b, 0], bodies.nodes[b, 1]):
            for c in range(3):
                g[i, c] = -force[i, c]
    spread(-1.0, held.force, held.nodes, held.weights, g)
    squared = 0.0
    for b in held.awake:
        lo, hi = bodies.nodes[b, 0], bodies.nodes[b, 1]
        for i in range(lo, hi):
            if bodies.fixed[i]:
                g[i, 0] = g[i, 1] = g[i, 2] = 0.0
        squared += dot(g, g, lo, hi)
    return math.sqrt(squared)


@njit(cache=True, nogil=True, error_model="numpy")
def direction(bodies: Bodies, base: Base, rows: Rows, held: Held, memory: Memory) -> float:
    """A step towards the energy's minimum into ``memory.z``, from ``memory.g``; returns the slope along it, mN mm."""
    q, z = memory.q, memory.z
    for b in held.awake:
        for i in range(bodies.nodes[b, 0], bodies.nodes[b, 1]):
            for c in range(3):
                q[i, c] = 0.0 if bodies.fixed[i] else -memory.force[i, c]
    for i in range(len(held.force)):
        for c in range(3):
            held.rest[i, c] = -held.force[i, c]
    before_base(
        q, held.rest, memory.s, memory.y, memory.product, memory.newest, memory.known, held.matrix, held.nodes,
        held.weights, held.awake, bodies.nodes, held.moved, held.pulled, held.curvature, held.share,
    )  # fmt: skip
    balance(q, held.rest, held.nodes, held.weights)
    for b in held.awake:
        banded.solve(base.factors[b], q, memory.v, z)
    hold_base(
        z, held.rest, rows.slots, held.nodes, held.weights, base.columns, base.slot_range, base.matrix, held.matrix,
        held.at, held.answer, held.system,
    )  # fmt: skip
    after_base(
        z, memory.s, memory.y, memory.newest, memory.known, held.nodes, held.weights, held.awake, bodies.nodes,
        held.pulled, held.curvature, held.share, held.at,
    )  # fmt: skip
    for i in bodies.adrift:
        z[i, 0] = z[i, 1] = z[i, 2] = 0.0
    slope = 0.0
    for b in held.awake:
        slope += dot(memory.g, z, bodies.nodes[b, 0], bodies.nodes[b, 1])
    return slope


@njit(cache=True, nogil=True, error_model="numpy")
def keep_pairs(x: Array, bodies: Bodies, held: Held, memory: Memory) -> None:
    """The accepted step becomes each body's newest secant pair, and ``x`` (n, 3) the trial."""
    pairs = len(memory.s)
    for b in held.awake:
        k = (memory.newest[b] + 1) % pairs
        memory.newest[b] = k
        memory.known[b] = min(memory.known[b] + 1, pairs)
        s, y, trial = memory.s[k], memory.y[k], memory.trial
        lo, hi = bodies.nodes[b, 0], bodies.nodes[b, 1]
        for i in range(lo, hi):
            for c in range(3):
                s[i, c] = trial[i, c] - x[i, c]
                y[i, c] = memory.old_force[i, c] - memory.force[i, c]
                x[i, c] = trial[i, c]
        memory.product[b, k] = dot(s, y, lo, hi)


@njit(cache=True, nogil=True, error_model="numpy")
def use_pairs(held: Held, memory: Memory, wanted: bool) -> None:
    """Each body's pairs count, or are kept and do not: as many less than none."""
    for b in held.awake:
        memory.known[b] = abs(memory.known[b]) if wanted else -memory.known[b]


@njit(cache=True, nogil=True, error_model="numpy")
def forget_pairs(held: Held, memory: Memory) -> None:
    for b in held.awake:
        memory.known[b] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def largest(a: Array, bodies: Bodies, held: Held) -> float:
    """The largest absolute value in the rows of ``a`` (n, 3) that belong to the bodies that are solved for."""
    most = 0.0
    for b in held.awake:
        u = a[bodies.nodes[b, 0] : bodies.nodes[b, 1]].reshape(-1)
        for i in range(len(u)):
            most = max(most, abs(u[i]))
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def tension(held: Held, c: int) -> float:
    """A cable's tension at the last evaluation, mN."""
    return tension_of(held.multiplier[c], held.penalty[c], held.stretch[c], held.taut[c])


@njit(cache=True, nogil=True, error_model="numpy")
def expect_taut(held: Held) -> None:
    """Which cables will be taut: those that were, unless the tissue gives less way than they are slack."""
    for c in range(len(held.taut)):
        soft = held.penalty[c] / CABLE_PENALTY
        held.taut[c] = held.multiplier[c] > 0.0 and held.multiplier[c] + soft * held.stretch[c] > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def tensions_are_settled(held: Held) -> bool:
    """Whether each cable pulls, and its multiplier is its tension within CABLE_MM; they are put right if not."""
    settled = True
    for c in range(len(held.stretch)):
        pulls = tension(held, c) >= 0.0
        settled = settled and pulls and abs(tension(held, c) - held.multiplier[c]) <= CABLE_MM * held.penalty[c]
        held.taut[c] = held.taut[c] and pulls
    if not settled:
        for c in range(len(held.stretch)):
            held.multiplier[c] = tension(held, c)
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
    pull_points(x, rows, held)
    expect_taut(held)
    energy = evaluate(x, bodies, rows, held, memory)
    width = largest(x, bodies, held)
    residual = gradient(bodies, held, memory)
    for iteration in range(max_iterations):
        if residual <= tolerance_mN:
            if tensions_are_settled(held):
                return True, iteration, residual
            energy = evaluate(x, bodies, rows, held, memory)
            residual = gradient(bodies, held, memory)
        slope = direction(bodies, base, rows, held, memory)
        far = largest(memory.z, bodies, held)
        if not slope > 0.0 or far > bodies.longest_step:
            # The pairs may mislead: rounding in them grows with a hold that is a million times stiffer than the tissue.
            # The base alone always leads down; where it goes as far, it is the way that is long.
            slope_with, far_with = slope, far
            use_pairs(held, memory, False)
            slope = direction(bodies, base, rows, held, memory)
            far = largest(memory.z, bodies, held)
            if slope_with > 0.0 and far > bodies.longest_step:
                use_pairs(held, memory, True)
                slope, far = direction(bodies, base, rows, held, memory), far_with
            else:
                forget_pairs(held, memory)
            if not slope > 0.0:
                return False, iteration, residual
        t = min(1.0, bodies.longest_step / max(far, 1e-300))
        for b in held.awake:
            lo, hi = bodies.nodes[b, 0], bodies.nodes[b, 1]
            memory.old_force[lo:hi] = memory.force[lo:hi]
        # What rounding of the energy's sum, and of coordinates far from the origin, can pretend.
        held_with = 0.0
        for i in range(len(held.force)):
            held_with += abs(held.force[i, 0]) + abs(held.force[i, 1]) + abs(held.force[i, 2])
        noise = ROUNDING * (abs(energy) + width * held_with)
        while True:
            for b in held.awake:
                lo, hi = bodies.nodes[b, 0], bodies.nodes[b, 1]
                step_along(x, -t, memory.z, memory.trial, lo, hi)
            new_energy = evaluate(memory.trial, bodies, rows, held, memory)
            if new_energy <= energy - DECREASE * t * slope + noise:
                break
            t *= 0.5
            if not t >= SHORTEST_STEP:
                evaluate(x, bodies, rows, held, memory)
                return False, iteration, gradient(bodies, held, memory)
        energy = new_energy
        keep_pairs(x, bodies, held, memory)
        residual = gradient(bodies, held, memory)
    converged = residual <= tolerance_mN
    for c in range(len(held.stretch)):
        converged = converged and held.stretch[c] <= CABLE_MM and tension(held, c) >= 0.0
    return converged, max_iterations, residual


@njit(cache=True, nogil=True, error_model="numpy")
def approach(
    x: Array,
    bodies: Bodies,
    base: Base,
    rows: Rows,
    held: Held,
    memory: Memory,
    way: Array,
    excess: Array,
    tolerance_mN: float,
    max_iterations: int,
    anchor_force: Array,
    tensions: Array,
) -> tuple[bool, int, int, float, float]:
    """Moves ``x`` (n, 3) to equilibrium while the anchors' targets go there the straight ``way`` (a, 3) mm.

    In steps of STEP_MM, in which cables are shortened, too. ``rows`` keeps the targets and lengths that were reached.
    Returns whether the last step converged, the iterations, the steps, the residual mN, and the least share of a way
    that was gone. Overwrites ``way``, ``excess`` (c,) mm, ``anchor_force`` (a, 3) and ``tensions`` (c,) mN.
    """
    held.taut[:] = False
    pull_points(x, rows, held)
    set_penalties(base, rows, held)
    far = 0.0
    for a in range(len(way)):
        far = max(far, length_across(rows.stiffness[a], way[a]))
    for c in range(len(excess)):
        far = max(far, held.stretch[c])
    steps = min(max(math.ceil(far / STEP_MM), 1), MOST_STEPS)
    most = steps * STEP_MM
    reached = 1.0
    for a in range(len(way)):
        share = min(1.0, most / max(length_across(rows.stiffness[a], way[a]), 1e-300))
        reached = min(reached, share)
        for r in range(3):
            rows.target[a, r] -= way[a, r]
            way[a, r] *= share
    for c in range(len(excess)):
        excess[c] = max(held.stretch[c], 0.0)
        rows.length[c] += excess[c]
        if excess[c] > most:
            reached = min(reached, most / excess[c])
            excess[c] = most
    converged, residual, iterations = False, 0.0, 0
    for step in range(1, steps + 1):
        for a in range(len(way)):
            for r in range(3):
                rows.target[a, r] += way[a, r] / steps
        for c in range(len(excess)):
            rows.length[c] -= excess[c] / steps
        tolerance = tolerance_mN if step == steps else STEP_TOLERANCE * tolerance_mN
        converged, used, residual = minimise(x, bodies, base, rows, held, memory, tolerance, max_iterations)
        iterations += used
    for a in range(len(way)):
        for r in range(3):
            anchor_force[a, r] = 0.0
            for c in range(3):
                off = rows.target[a, c] - held.point[rows.anchor_at[a], c]
                anchor_force[a, r] += rows.stiffness[a, r, c] * off
    for c in range(len(tensions)):
        tensions[c] = max(0.0, tension(held, c))
    return converged, iterations, steps, residual, reached


@njit(cache=True, nogil=True, error_model="numpy")
def set_penalties(base: Base, rows: Rows, held: Held) -> None:
    """Each cable's penalty from how far the tissue gives way to a unit of tension, d · K⁻¹ d."""
    u = len(rows.slots)
    for n in range(len(held.penalty)):
        d = held.at
        d[:] = 0.0
        for k in range(rows.cable_start[n], rows.cable_start[n + 1]):
            if rows.cable_at[k] >= 0:
                for r in range(3):
                    d[rows.cable_at[k], r] += held.row[k, r]
        give = 0.0
        for i in range(u):
            for j in range(u):
                for r in range(3):
                    for c in range(3):
                        give += d[i, r] * base.matrix[3 * rows.slots[i] + r, 3 * rows.slots[j] + c] * d[j, c]
        held.penalty[n] = CABLE_PENALTY / give if give > 0.0 else 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def length_across(stiffness: Array, way: Array) -> float:
    """How far mm a target that goes the ``way`` (3,) moves in the directions in which ``stiffness`` (3, 3) holds."""
    norm = squared = 0.0
    for r in range(3):
        row = force = 0.0
        for c in range(3):
            row += abs(stiffness[r, c])
            force += stiffness[r, c] * way[c]
        norm = max(norm, row)
        squared += force * force
    return math.sqrt(squared) / norm if norm > 0.0 else 0.0
