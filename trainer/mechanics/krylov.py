"""Conjugate gradients with a kept multifrontal factor as preconditioner (Nocedal and Wright, algorithm 5.3).

A factor of an earlier stiffness answers most of a new one: the two differ where the mesh has turned or stretched since,
which is near the instrument. The iterations that this takes are counted; when they would have paid for a new factor, a
new one is made. Held nodes do not change the factor, which is of all nodes that are not fixed for good: its inverse
restricted to the others is

    K_ff⁻¹ r = K⁻¹ r - K⁻¹ E (Eᵀ K⁻¹ E)⁻¹ Eᵀ K⁻¹ r

with the unit columns E of the held nodes' coordinates.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics import multifrontal
from trainer.mechanics.links import LinkMesh, blocks
from trainer.mechanics.multifrontal import Multifrontal
from trainer.mechanics.nested_dissection import dissect
from trainer.mechanics.newton import multiply

#: More iterations than this in one solve ask for a new factor.
SLOW = 30
#: Iterations after which a solve ends as it is.
MOST = 400


class KeptFactorCG:
    """A ``newton.LinearSolver`` for one mesh; the first factor is of its rest state."""

    def __init__(self, mesh: LinkMesh) -> None:
        """Raises ValueError when the links do not hold all free nodes in place."""
        self._mesh = mesh
        self._factoring = Multifrontal(mesh.links, dissect(mesh))
        if not self._factoring.compute(blocks(mesh, mesh.rest)):
            raise ValueError("the links do not hold all free nodes in place: the stiffness matrix is singular")
        self.iterations = 0  # in all solves
        self.factors = 1  # made
        self._slow = False
        self._held = np.zeros(0, dtype=np.int64)
        self._columns = np.zeros((0, *mesh.rest.shape))
        self._inverse = np.zeros((0, 0))
        self._scratch = np.zeros((4, *mesh.rest.shape))

    def prepare(self, block: Array, free: np.ndarray) -> bool:
        self._block, self._free = block, free
        if self._slow:
            self._slow = False
            self.factors += 1
            if not self._factoring.compute(block):
                return False
            self._held = self._held[:0]
        held = np.flatnonzero(~free & ~self._mesh.fixed)
        if not np.array_equal(held, self._held):
            self._hold(held)
        return True

    def _hold(self, held: np.ndarray) -> None:
        n = len(self._mesh.rest)
        self._held = held
        self._columns = np.zeros((3 * len(held), n, 3))
        for k, node in enumerate(held):
            for c in range(3):
                unit = np.zeros((n, 3))
                unit[node, c] = 1.0
                self._factoring.solve(unit, self._columns[3 * k + c])
        answer = self._columns[:, held].reshape(3 * len(held), 3 * len(held))
        self._inverse = np.linalg.inv(0.5 * (answer + answer.T))

    def solve(self, force: Array, accuracy: float, out: Array) -> bool:
        f = self._factoring
        positive, iterations = _iterate(
            self._block, self._mesh.links, self._free, f.factor, self._held, self._columns, self._inverse,
            force, accuracy, MOST, out, self._scratch, f._v, f._w,
        )
        self.iterations += iterations
        self._slow = iterations > SLOW
        return positive


@njit(cache=True, nogil=True, error_model="numpy")
def _dot(a: Array, b: Array) -> float:
    u, v = a.reshape(-1), b.reshape(-1)
    total = 0.0
    for i in range(len(u)):
        total += u[i] * v[i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _iterate(block, links, free, factor, held, columns, inverse, force, accuracy, most, out, scratch, v, w):
    r, z, p, q = scratch[0], scratch[1], scratch[2], scratch[3]
    out[:] = 0.0
    r[:] = force
    p[:] = 0.0
    goal = accuracy * accuracy * _dot(r, r)
    rho = 1.0
    for iteration in range(most):
        multifrontal.solve(factor, r, v, w, z)
        for i in range(len(inverse)):
            share = 0.0
            for j in range(len(inverse)):
                share += inverse[i, j] * z[held[j // 3], j % 3]
            q[i // 3, i % 3] = share
        for i in range(len(inverse)):
            share = q[i // 3, i % 3]
            u, t = columns[i].reshape(-1), z.reshape(-1)
            for k in range(len(u)):
                t[k] -= share * u[k]
        for i in range(len(free)):
            if not free[i]:
                z[i, 0] = z[i, 1] = z[i, 2] = 0.0
        new = _dot(r, z)
        if not new > 0.0:
            return iteration > 0, iteration
        beta = new / rho if iteration else 0.0
        rho = new
        for i in range(len(p)):
            for c in range(3):
                p[i, c] = z[i, c] + beta * p[i, c]
        multiply(block, links, p, q)
        for i in range(len(free)):
            if not free[i]:
                q[i, 0] = q[i, 1] = q[i, 2] = 0.0
        curvature = _dot(p, q)
        if not curvature > 0.0:
            return False, iteration
        alpha = rho / curvature
        for i in range(len(p)):
            for c in range(3):
                out[i, c] += alpha * p[i, c]
                r[i, c] -= alpha * q[i, c]
        if _dot(r, r) <= goal:
            return True, iteration + 1
    return True, most
