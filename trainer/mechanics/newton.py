"""Static equilibrium of a link mesh by Newton's method, with a predictor along the way of the held nodes.

Solves Σ F = 0 at every free node with the exact second derivatives H of the energy (``links``): H p = F. Where held
nodes have moved by d, the first step is the tangent to the path of equilibria, H p = F - H_fh d, so that all nodes go
along with them. Where H is not positive definite, the smallest of a few multiples of the identity that makes it so is
added, and the step leads down. Each further step is shortened until the energy falls (Armijo; Nocedal and Wright,
Numerical Optimization, algorithms 3.1 and 3.3), so that the energy never rises but by rounding.
Links with a law (``link_tension``) have kinks, between which the method is Newton's and at which the search holds it.

Each system is factored anew by scipy's SuperLU: the reference for the others. ``krylov`` is for big meshes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from trainer.geometry import Array
from trainer.mechanics.links import LinkMesh, add_forces, link_blocks, never_stretched

#: Sufficient decrease (Armijo), and the shortest step tried.
DECREASE, SHORTEST_STEP = 1e-4, 1e-6
#: Share of an energy that is lost to rounding when it is summed over thousands of links.
ROUNDING = 1e-14
#: The first multiple of the identity that is tried, as a share of the stiffest link, and the next ones.
FIRST_SHIFT, GROWTH = 1e-5, 4.0
#: No node goes further in one step, in median links.
LONGEST = 4.0


@dataclass(frozen=True)
class Outcome:
    """How a solve ended. Not converged: the state is finite, and its energy is lower than it was."""

    converged: bool
    steps: int  # Newton's, or sweeps
    residual_mN: float  # Euclidean norm of the forces on the free nodes
    energy: float  # mN mm


def factor(matrix: csc_matrix) -> SuperLU | None:
    """The factors of a symmetric matrix by scipy's SuperLU; None where they show it not to be positive definite.

    A symmetric order, and pivots from the diagonal: then the signs on U's diagonal are those of the eigenvalues
    (Sylvester's law of inertia).
    """
    try:
        lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # a pivot of zero
        return None
    return lu if np.array_equal(lu.perm_r, lu.perm_c) and np.all(lu.U.diagonal() > 0.0) else None


class Pattern:
    """Where the links' blocks go in the sparse stiffness of the nodes ``free`` (n,) bool: found once, filled often."""

    def __init__(self, links: np.ndarray, free: np.ndarray) -> None:
        number = np.where(free, np.cumsum(free) - 1, -1)
        i, j = number[links].T
        row, column = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
        both = (row >= 0) & (column >= 0)
        self.free, self._size = free.copy(), 3 * int(np.count_nonzero(free))
        self._kept = np.broadcast_to(both[:, None, None], (len(both), 3, 3))
        at = (3 * column[:, None, None] + np.arange(3)) * self._size + 3 * row[:, None, None] + np.arange(3)[:, None]
        place, self._into = np.unique(at[self._kept], return_inverse=True)
        self._row = (place % self._size).astype(np.int32)
        self._begin = np.searchsorted(place, np.arange(self._size + 1) * self._size).astype(np.int32)
        self._diagonal = np.flatnonzero(place // self._size == self._row)

    def fill(self, block: Array, shift: float = 0.0) -> csc_matrix:
        """The stiffness mN/mm of the links' blocks (m, 3, 3), and ``shift`` on its diagonal."""
        values = np.concatenate([block, block, -block, -block])[self._kept]
        data = np.bincount(self._into, values, minlength=len(self._row)).astype(np.float64, copy=False)
        data[self._diagonal] += shift
        return csc_matrix((data, self._row, self._begin), shape=(self._size, self._size))


def sparse_matrix(mesh: LinkMesh, block: Array) -> csc_matrix:
    """The stiffness (3 n, 3 n) mN/mm of the links' blocks (m, 3, 3), fixed nodes included."""
    return Pattern(mesh.links, np.ones(len(mesh.rest), dtype=bool)).fill(block)


@njit(cache=True, nogil=True, error_model="numpy")
def multiply(block: Array, links: np.ndarray, v: Array, out: Array) -> None:
    """``out`` (n, 3) mN becomes the product of the links' stiffness with ``v`` (n, 3) mm."""
    out[:] = 0.0
    for e in range(len(links)):
        i, j = links[e, 0], links[e, 1]
        d0, d1, d2 = v[i, 0] - v[j, 0], v[i, 1] - v[j, 1], v[i, 2] - v[j, 2]
        for c in range(3):
            f = block[e, c, 0] * d0 + block[e, c, 1] * d1 + block[e, c, 2] * d2
            out[i, c] += f
            out[j, c] -= f


class Newton:
    """The state ``x`` (n, 3) mm of a mesh, some of whose nodes are moved; the others follow to equilibrium."""

    def __init__(self, mesh: LinkMesh) -> None:
        """Raises ValueError for a node that is neither fixed nor linked."""
        refuse_loose_nodes(mesh)
        self.mesh = mesh
        self.x = mesh.rest.copy()
        self.branch = never_stretched(mesh)  # where on their law the links are; ``links.settle`` moves it
        self._longest = float(np.median(mesh.rest_length))
        self._block = np.zeros((len(mesh.links), 3, 3))
        self._pattern: Pattern | None = None
        self._trial, self._step, self._way = (mesh.rest.copy() for _ in range(3))
        self._force, self._trial_force = np.zeros_like(mesh.rest), np.zeros_like(mesh.rest)

    def move(
        self,
        nodes: np.ndarray,
        places: Array,
        *,
        tolerance_mN: float,
        most_steps: int = 100,
        load: Array | None = None,
    ) -> Outcome:
        """Moves ``nodes`` (k,) to ``places`` (k, 3) and all others to equilibrium under the forces ``load`` (n, 3) mN.

        Raises ValueError when a place or a load is not finite.
        """
        refuse_not_finite(places, load)
        x = self.x
        load = np.zeros_like(x) if load is None else load
        free = ~self.mesh.fixed
        free[nodes] = False
        energy = self._predict(nodes, places, free, load)
        for step in range(most_steps):
            residual = float(np.linalg.norm(self._force))
            if residual <= tolerance_mN:
                return Outcome(True, step, residual, energy)
            self._direction(free)
            lower = self._search(free, load, energy)
            if lower is None:
                return Outcome(False, step, residual, energy)
            energy = lower
        residual = float(np.linalg.norm(self._force))
        return Outcome(residual <= tolerance_mN, most_steps, residual, energy)

    def _predict(self, nodes: np.ndarray, places: Array, free: np.ndarray, load: Array) -> float:
        """Moves the nodes, and all others along the tangent to the path of equilibria if that has less energy."""
        x, way, trial = self.x, self._way, self._trial
        way[:] = 0.0
        way[nodes] = places - x[nodes]
        trial[:] = x
        if np.any(way):
            self._evaluate(x, free, load, self._force)
            self._stiffness()
            multiply(self._block, self.mesh.links, way, self._trial_force)
            self._trial_force[~free] = 0.0
            np.subtract(self._force, self._trial_force, out=self._trial_force)
            if self._solve(self._trial_force, free, 0.0):
                trial += self._step
            trial[nodes] = places
        x[nodes] = places
        energy = self._evaluate(x, free, load, self._force)
        predicted = self._evaluate(trial, free, load, self._trial_force)
        if predicted < energy:
            x[:] = trial
            self._force, self._trial_force = self._trial_force, self._force
            energy = predicted
        return energy

    def _direction(self, free: np.ndarray) -> None:
        """Newton's step from ``x`` into ``_step``; it leads down."""
        self._stiffness()
        shift = 0.0
        while not (self._solve(self._force, free, shift) and float(np.vdot(self._force, self._step)) > 0.0):
            shift = max(GROWTH * shift, FIRST_SHIFT * float(np.max(self.mesh.stiffness)))

    def _stiffness(self) -> None:
        """The second derivatives at ``x`` into ``_block``."""
        m = self.mesh
        link_blocks(self.x, m.links, m.rest_length, m.stiffness, False, self._block, self.branch)

    def _solve(self, force: Array, free: np.ndarray, shift: float) -> bool:
        """The step that ``_block`` and a ``shift``, mN/mm, on its diagonal answer to ``force`` with, into ``_step``;
        False if they are not positive definite."""
        if self._pattern is None or not np.array_equal(free, self._pattern.free):
            self._pattern = Pattern(self.mesh.links, free)
        lu = factor(self._pattern.fill(self._block, shift))
        if lu is None:
            return False
        self._step[:] = 0.0
        self._step[free] = lu.solve(force[free].ravel()).reshape(-1, 3)
        return True

    def _search(self, free: np.ndarray, load: Array, energy: float) -> float | None:
        """Goes along ``_step`` as far as the energy falls enough; the new energy, or None if it nowhere does."""
        slope = float(np.vdot(self._force, self._step))
        noise = ROUNDING * (abs(energy) + float(np.sum(np.abs(load * self.x))))
        t = min(1.0, LONGEST * self._longest / max(float(np.max(np.abs(self._step))), 1e-300))
        while t >= SHORTEST_STEP:
            np.multiply(self._step, t, out=self._trial)
            self._trial += self.x
            lower = self._evaluate(self._trial, free, load, self._trial_force)
            if lower <= energy - DECREASE * t * slope + noise:
                self.x[:] = self._trial
                self._force, self._trial_force = self._trial_force, self._force
                return lower
            t *= 0.5
        return None

    def _evaluate(self, x: Array, free: np.ndarray, load: Array, force: Array) -> float:
        """The energy at ``x`` (n, 3); ``force`` (n, 3) becomes what is unbalanced on the free nodes."""
        m = self.mesh
        force[:] = load
        energy = add_forces(x, m.links, m.rest_length, m.stiffness, 0, len(m.links), force, self.branch)
        force[~free] = 0.0
        return float(energy - np.vdot(load, x))


def refuse_loose_nodes(mesh: LinkMesh) -> None:
    """Raises ValueError for a node that is neither fixed nor linked: nothing says where it belongs."""
    loose = np.flatnonzero(~mesh.fixed & (np.diff(mesh.start) == 0))
    if len(loose):
        raise ValueError(f"node {loose[0]} is neither fixed nor linked to another: fix it or remove it")


def refuse_not_finite(places: Array, load: Array | None) -> None:
    """Raises ValueError where a node is to be moved to no place, or drawn by no force."""
    if not np.isfinite(places).all():
        raise ValueError("a place to which a node is moved is not finite")
    if load is not None and not np.isfinite(load).all():
        raise ValueError("a load is not finite")
