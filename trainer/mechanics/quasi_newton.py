"""The direction of a limited-memory quasi-Newton method (L-BFGS) whose base matrix is a kept factor.

Nocedal and Wright, Numerical Optimization, algorithm 7.4. The secant pairs (s, y) are of the tissue alone; the
stiffness A of what holds it at material points (W) is added when a pair is used, y + Wᵀ A W s, so that pairs stay
true when holds come, go or change. The base (K + Wᵀ A W)⁻¹ follows from K⁻¹ by Woodbury's identity.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.attachments import solve_dense


@njit(cache=True, nogil=True, error_model="numpy")
def dot(a: Array, b: Array, first: int, last: int) -> float:
    """Σ a_i · b_i over the rows ``first`` … ``last`` - 1 of two arrays (n, 3), summed in four strands.

    Either may be of single precision; the sum is of double."""
    u, v = a[first:last].reshape(-1), b[first:last].reshape(-1)
    n = len(u)
    whole = n - n % 4
    s0 = s1 = s2 = s3 = 0.0
    for i in range(0, whole, 4):
        s0 += u[i] * v[i]
        s1 += u[i + 1] * v[i + 1]
        s2 += u[i + 2] * v[i + 2]
        s3 += u[i + 3] * v[i + 3]
    for i in range(whole, n):
        s0 += u[i] * v[i]
    return (s0 + s1) + (s2 + s3)


@njit(cache=True, nogil=True, error_model="numpy")
def add_scaled(a: float, source: Array, target: Array, first: int, last: int) -> None:
    """target += a source on the rows ``first`` … ``last`` - 1 of arrays (n, 3)."""
    u, v = source[first:last].reshape(-1), target[first:last].reshape(-1)
    for i in range(len(u)):
        v[i] += a * u[i]


@njit(cache=True, nogil=True, error_model="numpy")
def step_along(x: Array, a: float, way: Array, out: Array, first: int, last: int) -> None:
    """``out`` = x + a way on the rows ``first`` … ``last`` - 1 of arrays (n, 3)."""
    u, v, w = x[first:last].reshape(-1), way[first:last].reshape(-1), out[first:last].reshape(-1)
    for i in range(len(u)):
        w[i] = u[i] + a * v[i]


@njit(cache=True, nogil=True, error_model="numpy")
def same(a: Array, b: Array, first: int, last: int) -> bool:
    """Whether the rows ``first`` … ``last`` - 1 of two arrays (n, 3) are equal, number for number."""
    u, v = a[first:last].reshape(-1), b[first:last].reshape(-1)
    different = 0
    for i in range(len(u)):
        different += u[i] != v[i]
    return different == 0


@njit(cache=True, nogil=True, error_model="numpy")
def at_points(values: Array, nodes: np.ndarray, weights: Array, out: Array) -> None:
    """W: the weighted means ``out`` (u, 3) of ``values`` (n, 3) at u material points."""
    for i in range(len(nodes)):
        for c in range(3):
            out[i, c] = (
                weights[i, 0] * values[nodes[i, 0], c]
                + weights[i, 1] * values[nodes[i, 1], c]
                + weights[i, 2] * values[nodes[i, 2], c]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def add_at_points(values: Array, nodes: np.ndarray, weights: Array, first: int, last: int, out: Array) -> None:
    """Adds to ``out`` (u, 3) the means as of :func:`at_points`, of values that are zero outside the rows
    ``first`` … ``last`` - 1."""
    for i in range(len(nodes)):
        for k in range(3):
            if first <= nodes[i, k] < last:
                for c in range(3):
                    out[i, c] += weights[i, k] * values[nodes[i, k], c]


@njit(cache=True, nogil=True, error_model="numpy")
def spread(scale: float, values: Array, nodes: np.ndarray, weights: Array, out: Array) -> None:
    """Adds ``scale`` Wᵀ ``values``: shares the rows (u, 3) out to the nodes of ``out`` (n, 3)."""
    for i in range(len(nodes)):
        for k in range(3):
            for c in range(3):
                out[nodes[i, k], c] += scale * weights[i, k] * values[i, c]


@njit(cache=True, nogil=True, error_model="numpy")
def multiply(matrix: Array, v: Array, out: Array) -> None:
    """``out`` = matrix · v, for ``matrix`` (3 u, 3 u) and rows (u, 3)."""
    for i in range(len(v)):
        for r in range(3):
            total = 0.0
            for j in range(len(v)):
                for c in range(3):
                    total += matrix[3 * i + r, 3 * j + c] * v[j, c]
            out[i, r] = total


@njit(cache=True, nogil=True, error_model="numpy")
def before_base(
    q: Array,
    f: Array,
    s: np.ndarray,
    y: np.ndarray,
    product: Array,
    newest: np.ndarray,
    known: np.ndarray,
    matrix: Array,
    nodes: np.ndarray,
    weights: Array,
    awake: np.ndarray,
    span: np.ndarray,
    moved: Array,
    pulled: Array,
    curvature: Array,
    share: Array,
) -> None:
    """The first loop: overwrites the gradient, ``q`` (n, 3) at nodes and ``f`` (u, 3) at points, newest pair first.

    ``s``, ``y`` (m, n, 3) float32 hold each body's pairs, in the rows ``span`` (bodies, 2) of its nodes, in a ring that
    ends at ``newest`` (bodies,) and has ``known`` (bodies,) in it; ``product`` (bodies, m) is s · y. What is held may
    join the bodies ``awake``: their pairs of one age are taken as one. Overwrites ``moved``, ``pulled`` (m, u, 3),
    ``curvature`` and ``share`` (m,), by age, for the second loop. A pair of no positive curvature is passed over.
    """
    pairs = len(s)
    for age in range(pairs):
        moved[age] = 0.0
        c = 0.0
        for b in awake:
            if age < known[b]:
                k = (newest[b] - age) % pairs
                add_at_points(s[k], nodes, weights, span[b, 0], span[b, 1], moved[age])
                c += product[b, k]
        multiply(matrix, moved[age], pulled[age])
        for i in range(len(nodes)):
            for r in range(3):
                c += moved[age, i, r] * pulled[age, i, r]
        curvature[age] = c
        if not c > 0.0:
            continue
        along = 0.0
        for i in range(len(nodes)):
            for r in range(3):
                along += moved[age, i, r] * f[i, r]
        for b in awake:
            if age < known[b]:
                along += dot(s[(newest[b] - age) % pairs], q, span[b, 0], span[b, 1])
        share[age] = along / c
        for b in awake:
            if age < known[b]:
                add_scaled(-share[age], y[(newest[b] - age) % pairs], q, span[b, 0], span[b, 1])
        for i in range(len(nodes)):
            for r in range(3):
                f[i, r] -= share[age] * pulled[age, i, r]


@njit(cache=True, nogil=True, error_model="numpy")
def balance(q: Array, f: Array, nodes: np.ndarray, weights: Array) -> None:
    """Leaves q + Wᵀ f as it is, and makes ``q`` (n, 3) small at the nodes of the points: ``f`` (u, 3) takes it up.

    The base's answer to q has single precision. Near equilibrium what holds a point takes up what the links pull there,
    and far from it a stiff hold pushes a million times harder: in either case q should be the small part.
    """
    for i in range(len(nodes)):
        squared = weights[i, 0] ** 2 + weights[i, 1] ** 2 + weights[i, 2] ** 2
        for c in range(3):
            part = 0.0
            for k in range(3):
                part += weights[i, k] * q[nodes[i, k], c] / squared
            f[i, c] += part
            for k in range(3):
                q[nodes[i, k], c] -= weights[i, k] * part


@njit(cache=True, nogil=True, error_model="numpy")
def hold_base(
    z: Array,
    f: Array,
    slots: np.ndarray,
    nodes: np.ndarray,
    weights: Array,
    influence: np.ndarray,
    slot_range: np.ndarray,
    compliance: Array,
    matrix: Array,
    point: Array,
    answer: Array,
    system: Array,
) -> None:
    """Turns z = K⁻¹ q (n, 3) into (K + Wᵀ A W)⁻¹ (q + Wᵀ f) = z + K⁻¹ Wᵀ (f - (I + A C)⁻¹ A (W z + C f)), with
    C = W K⁻¹ Wᵀ.

    ``influence`` (slots, 3, n, 3) float32 holds the columns K⁻¹ Wᵀ, zero outside the rows ``slot_range`` (slots, 2);
    ``compliance`` is C over all slots. Overwrites ``point``, ``answer`` (u, 3), ``system`` (3 u, 3 u).
    """
    u = len(slots)
    at_points(z, nodes, weights, point)
    for i in range(3 * u):
        for k in range(3 * u):
            point[i // 3, i % 3] += compliance[3 * slots[i // 3] + i % 3, 3 * slots[k // 3] + k % 3] * f[k // 3, k % 3]
    multiply(matrix, point, answer)
    for i in range(3 * u):
        for j in range(3 * u):
            total = 1.0 if i == j else 0.0
            column = 3 * slots[j // 3] + j % 3
            for k in range(3 * u):
                total += matrix[i, k] * compliance[3 * slots[k // 3] + k % 3, column]
            system[i, j] = total
    solve_dense(system, answer.reshape(-1))
    for i in range(u):
        lo, hi = slot_range[slots[i], 0], slot_range[slots[i], 1]
        for r in range(3):
            add_scaled(f[i, r] - answer[i, r], influence[slots[i], r], z, lo, hi)


@njit(cache=True, nogil=True, error_model="numpy")
def after_base(
    z: Array,
    s: np.ndarray,
    y: np.ndarray,
    newest: np.ndarray,
    known: np.ndarray,
    nodes: np.ndarray,
    weights: Array,
    awake: np.ndarray,
    span: np.ndarray,
    pulled: Array,
    curvature: Array,
    share: Array,
    point: Array,
) -> None:
    """The second loop: overwrites ``z`` (n, 3), oldest pair first."""
    pairs = len(s)
    for age in range(pairs - 1, -1, -1):
        if not curvature[age] > 0.0:
            continue
        at_points(z, nodes, weights, point)
        c = 0.0
        for i in range(len(nodes)):
            for r in range(3):
                c += pulled[age, i, r] * point[i, r]
        for b in awake:
            if age < known[b]:
                c += dot(y[(newest[b] - age) % pairs], z, span[b, 0], span[b, 1])
        for b in awake:
            if age < known[b]:
                k = (newest[b] - age) % pairs
                add_scaled(share[age] - c / curvature[age], s[k], z, span[b, 0], span[b, 1])
