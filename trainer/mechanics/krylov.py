"""Newton's method for big meshes: conjugate gradients over a kept factor, in a region of trust.

A factor of an earlier stiffness answers most of a new one, and better with a small new one near the instrument
(``preconditioner``). So Newton's equation is solved by conjugate gradients with the exact second derivatives, and these
two M⁻¹ as preconditioner. Where the energy curves down, or the step gets longer than the quadratic model
deserves trust, the step ends at the border of the region |p|_M <= radius (Steihaug 1983, SIAM J. Numer. Anal. 20:626;
Nocedal and Wright, Numerical Optimization, algorithms 4.1 and 7.2). A step that does not lower the energy is not taken,
so that the energy never rises but by rounding. Iterations are counted, and many ask for a new factor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.links import LinkMesh, add_forces, never_stretched
from trainer.mechanics.newton import Outcome, multiply, refuse_loose_nodes, refuse_not_finite
from trainer.mechanics.preconditioner import Kept, Preconditioner, precondition
from trainer.mechanics.quasi_newton import add_scaled, dot

#: More iterations than this in one step ask for a new factor, or as many as cost what the factor does: an iteration
#: takes the time of so many arithmetic operations for each number in the factor (measured, within two).
SLOW, ITERATION_COST = 30, 9.0
#: So many times as many iterations in all steps of one move do so, too: the region of trust is measured by the factor.
MANY = 3
#: Iterations after which a step ends as it is.
MOST = 200
#: The least accuracy of a linear solve, as a share of its right-hand side.
FIRST_ACCURACY = 0.03
#: Share of the predicted decrease that a step must bring; and those below and above which the region changes.
TAKEN, POOR, GOOD = 1e-4, 0.25, 0.75
#: Share of an energy that is lost to rounding when it is summed over m links, over √m: three standard deviations.
ROUNDING = 3.0 * float(np.finfo(float).eps)
#: No node goes further in one step than this, in median links.
LONGEST = 2.0


class Scratch(NamedTuple):
    """Arrays of one mesh that the kernels overwrite."""

    r: Array  # (n, 3)
    z: Array  # (n, 3)
    p: Array  # (n, 3)
    q: Array  # (n, 3)


class NewtonKrylov:
    """The state ``x`` (n, 3) mm of a mesh, some of whose nodes are moved; the others follow to equilibrium."""

    def __init__(self, mesh: LinkMesh) -> None:
        """Raises ValueError for a node that is neither fixed nor linked, or when the links leave nodes free to move."""
        refuse_loose_nodes(mesh)
        self.mesh = mesh
        self.x = mesh.rest.copy()
        self.iterations = 0  # of conjugate gradients, so far
        self.factors = 1  # made so far
        self.branch = never_stretched(mesh)  # where on their law the links are; ``links.settle`` moves it
        self._base = Preconditioner(mesh)
        self._block = np.zeros((len(mesh.links), 3, 3))
        self._slow = False
        self._spent = 0  # iterations of this move with this factor
        self._slow_from = max(SLOW, self._base.operations / ITERATION_COST)
        self._rounding = ROUNDING * math.sqrt(len(mesh.links))
        self._longest = LONGEST * float(np.median(mesh.rest_length))
        self._trial, self._step, self._way = (np.zeros_like(mesh.rest) for _ in range(3))
        self._force, self._trial_force = np.zeros_like(mesh.rest), np.zeros_like(mesh.rest)
        self._no_load = np.zeros_like(mesh.rest)
        self._scratch = Scratch(*(np.zeros_like(mesh.rest) for _ in range(4)))

    def move(
        self,
        nodes: np.ndarray,
        places: Array,
        *,
        tolerance_mN: float,
        most_steps: int = 200,
        load: Array | None = None,
    ) -> Outcome:
        """Moves ``nodes`` (k,) to ``places`` (k, 3) and all others to equilibrium under the forces ``load`` (n, 3) mN.

        Raises ValueError when a place or a load is not finite.
        """
        refuse_not_finite(places, load)
        load = self._no_load if load is None else load
        self._spent = 0
        self._base.hold(nodes)
        energy = self._predict(nodes, places, load)
        first = residual = float(np.linalg.norm(self._force))
        radius = math.inf
        for step in range(most_steps):
            if residual <= tolerance_mN:
                return Outcome(True, step, residual, energy)
            self._update()
            accuracy = max(min(FIRST_ACCURACY, residual / first), 0.1 * tolerance_mN / residual)
            decrease, length, cut = self._solve(self._force, accuracy, radius)
            np.add(self.x, self._step, out=self._trial)
            lower = self._evaluate(self._trial, load, self._trial_force)
            noise = self._rounding * (abs(energy) + self._work_of(load))
            trial_residual = float(np.linalg.norm(self._trial_force))
            share = (energy - lower) / decrease if decrease > 0.0 else -1.0
            if decrease <= 100.0 * noise and lower <= energy + noise and trial_residual < residual:
                share = 1.0  # the energies' difference is below their rounding: the forces tell
            if share < POOR:
                radius = POOR * length
            elif share > GOOD and cut:
                radius = 2.0 * length
            if share > TAKEN:
                self.x[:] = self._trial
                self._force, self._trial_force = self._trial_force, self._force
                energy, residual = lower, trial_residual
            elif length == 0.0 or decrease <= noise:
                return Outcome(False, step, residual, energy)
        return Outcome(residual <= tolerance_mN, most_steps, residual, energy)

    @property
    def held_bytes(self) -> int:
        """What each iteration reads of memory, at least: what the preconditioner does, the blocks and six vectors."""
        return int(self._base.held_bytes + self._block.nbytes + 6 * self.x.nbytes)

    @property
    def moved_bytes(self) -> int:
        """What the iterations so far have read of memory, at least: each reads the factor twice."""
        return self.iterations * (self.held_bytes + self._base.factor_bytes)

    def _update(self) -> None:
        """The stiffness at ``x``, and a new factor where the old one has become slow."""
        if self._slow:
            self._slow = False
            self._spent = 0
            self.factors += 1
            self._base.renew(self.x, self._block, self.branch)
        self._base.update(self.x, self._block, self.branch)

    def _predict(self, nodes: np.ndarray, places: Array, load: Array) -> float:
        """Moves the nodes, and all others along the tangent to the path of equilibria if that has less energy."""
        x, way, trial = self.x, self._way, self._trial
        way[:] = 0.0
        way[nodes] = places - x[nodes]
        trial[:] = x
        if np.any(way):
            self._evaluate(x, load, self._force)
            self._update()
            multiply(self._block, self.mesh.links, way, self._trial_force)
            _zero(self._base.free, self._trial_force)
            np.subtract(self._force, self._trial_force, out=self._trial_force)
            self._solve(self._trial_force, FIRST_ACCURACY, math.inf)
            trial += self._step
            trial[nodes] = places
        x[nodes] = places
        energy = self._evaluate(x, load, self._force)
        predicted = self._evaluate(trial, load, self._trial_force)
        if predicted < energy:
            x[:] = trial
            self._force, self._trial_force = self._trial_force, self._force
            energy = predicted
        return energy

    def _solve(self, force: Array, accuracy: float, radius: float) -> tuple[float, float, bool]:
        """The step from ``x`` into ``_step``: the decrease that it promises, its length, and if the border cut it."""
        decrease, length, cut, iterations = conjugate_gradients(
            self._block, self.mesh.links, self._base.kept, force, accuracy, radius, self._longest, self._step,
            self._scratch,
        )  # fmt: skip
        self.iterations += iterations
        self._spent += iterations
        self._slow = iterations > self._slow_from or self._spent > MANY * self._slow_from
        return decrease, length, cut

    def _evaluate(self, x: Array, load: Array, force: Array) -> float:
        """The energy at ``x`` (n, 3); ``force`` (n, 3) becomes what is unbalanced on the free nodes."""
        m = self.mesh
        force[:] = load
        energy = add_forces(x, m.links, m.rest_length, m.stiffness, 0, len(m.links), force, self.branch)
        _zero(self._base.free, force)
        return float(energy - np.vdot(load, x))

    def _work_of(self, load: Array) -> float:
        """The sum of what its terms come to, mN mm, whatever their signs; overwrites ``_way``."""
        np.multiply(load, self.x, out=self._way)
        return float(np.sum(np.abs(self._way, out=self._way)))


@njit(cache=True, nogil=True, error_model="numpy")
def _zero(free: np.ndarray, values: Array) -> None:
    for i in range(len(free)):
        if not free[i]:
            values[i, 0] = values[i, 1] = values[i, 2] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def conjugate_gradients(
    block: Array,
    links: np.ndarray,
    kept: Kept,
    force: Array,
    accuracy: float,
    radius: float,
    longest: float,
    out: Array,
    s: Scratch,
) -> tuple[float, float, bool, int]:
    """The step ``out`` (n, 3) mm that lowers the quadratic model under ``force`` (n, 3) mN, within ``radius``.

    Without a radius (inf) a direction in which the energy curves down is followed until a node has gone ``longest`` mm.
    Returns (the model's decrease, the step's length in the norm of M, cut short, iterations).
    """
    n = len(out)
    out[:] = 0.0
    s.r[:] = force
    s.p[:] = 0.0
    goal = accuracy * accuracy * dot(s.r, s.r, 0, n)
    rho = 1.0
    decrease = 0.0
    oo = op = pp = 0.0  # products of out and p with M, by recurrence
    for iteration in range(MOST):
        precondition(kept, block, links, s.r, s.z)
        new = dot(s.r, s.z, 0, n)
        if not new > 0.0:
            return decrease, math.sqrt(oo), False, iteration
        beta = new / rho if iteration else 0.0
        u, t = s.p.reshape(-1), s.z.reshape(-1)
        for i in range(len(u)):
            u[i] = t[i] + beta * u[i]
        op = beta * op
        pp = new + beta * beta * pp
        rho = new
        multiply(block, links, s.p, s.q)
        _zero(kept.free, s.q)
        curvature = dot(s.p, s.q, 0, n)
        alpha = rho / curvature if curvature > 0.0 else math.inf
        if not oo + alpha * (2.0 * op + alpha * pp) < radius * radius or curvature <= 0.0:
            if radius < math.inf:
                alpha = (math.sqrt(max(op * op + pp * (radius * radius - oo), 0.0)) - op) / pp
            else:
                largest = 0.0
                for i in range(len(u)):
                    largest = max(largest, abs(u[i]))
                alpha = longest / largest
            decrease += alpha * rho - 0.5 * alpha * alpha * curvature
            add_scaled(alpha, s.p, out, 0, n)
            return decrease, math.sqrt(oo + alpha * (2.0 * op + alpha * pp)), True, iteration + 1
        decrease += 0.5 * alpha * rho
        oo += alpha * (2.0 * op + alpha * pp)
        op += alpha * pp
        add_scaled(alpha, s.p, out, 0, n)
        add_scaled(-alpha, s.q, s.r, 0, n)
        if dot(s.r, s.r, 0, n) <= goal:
            return decrease, math.sqrt(oo), False, iteration + 1
    return decrease, math.sqrt(oo), False, MOST
