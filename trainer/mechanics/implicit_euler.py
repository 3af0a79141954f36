"""Backward Euler with conjugate gradients on the links (Baraff & Witkin 1998, Large steps in cloth simulation).

The velocity v at the end of a step h solves, on every node that is not held, with x = x_old + h v,

    r(v) = m (v - v_old - h g) + h c v - h f(x, v) = 0,

f being the links' tensions at x and the dashpots' resistance to v along the directions that the links had before the
step. Newton's method starts from v = 0, so that its first step is equation (6) of Baraff & Witkin: linear, with the
derivatives of the old state. They stop there; ``newton_steps=1`` does, too. Otherwise the steps go on to a tolerance
of the unbalanced force |r| / h.

The matrix M + h C + h² K is never formed: a link keeps its 3 × 3 block, h² B + h b u uᵀ, and a product visits the
links. Conjugate gradients are preconditioned by the inverse of each node's own block. Held nodes are filtered as in
section 5.3: their entries in residual and direction are zero, and their given velocity enters through the first
guess, so it is met exactly. Because whole nodes are filtered, the filter commutes with the preconditioner, and the
iteration is that of the free nodes alone.

Where shortened links make the matrix indefinite, the iteration meets a direction of no positive curvature; the part
of B across shortened links is then left out, and the matrix is positive definite.

Backward Euler is stable at every step on every damped or undamped mode (|R| = 1 / |1 - h λ| <= 1) and damps what it
cannot resolve. It keeps linear momentum to the tolerance; angular momentum only in the limit of small steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.dynamics import Model, State, finite, refuse, settle_links
from trainer.mechanics.link_tension import Branch, tension_of

#: Newton's steps before the step in time is halved, and how often it may be.
MOST_NEWTON_STEPS, MOST_HALVINGS = 30, 10
#: Each step of Newton's method solves its linear system to this share of the residual.
FORCING = 1e-2
#: Iterations of conjugate gradients, per coordinate of a mesh, before they count as stuck.
MOST_ITERATIONS = 2
#: A line search ends where the slope has fallen to this share, and gives up after so many tries.
SLOPE_LEFT, MOST_TRIES = 0.5, 20


class Solve(NamedTuple):
    """What a solve needs besides the state; it is kept from step to step."""

    v: Array  # (n, 3) mm/s, the iterate
    x: Array  # (n, 3) mm, old positions + h v
    r: Array  # (n, 3) mN s, the residual impulse
    step: Array  # (n, 3) mm/s, Newton's step
    error: Array  # (n, 3) mN s, what conjugate gradients leave
    scaled: Array  # (n, 3) the same, preconditioned
    p: Array  # (n, 3) direction of the iteration
    image: Array  # (n, 3) the matrix times p
    block: Array  # (m, 6) kg, of each link: xx, xy, xz, yy, yz, zz
    inverse: Array  # (n, 6) 1/kg, inverse of each node's block
    old_x: Array  # (n, 3) the state before the step, to which a failed step returns
    old_v: Array  # (n, 3)
    old_slip: Array  # (m,)


@njit(cache=True, nogil=True, error_model="numpy")
def residual(model: Model, state: State, v: Array, h: float, x: Array, r: Array) -> float:
    """Fills ``x`` (n, 3) and ``r`` (n, 3), zero at held nodes; returns |r| / h, mN."""
    law, old = model.law, state.x
    branch = Branch(law, state.slip)
    for i in range(len(x)):
        for c in range(3):
            x[i, c] = old[i, c] + h * v[i, c]
            r[i, c] = model.mass[i] * (v[i, c] - state.v[i, c] - h * model.gravity[c]) + h * model.drag[i] * v[i, c]
    for e in range(len(model.links)):
        i, j = model.links[e, 0], model.links[e, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length > 0.0:
            tension, _ = tension_of(e, length - model.rest_length[e], law.stiffness, branch)
            pull = h * tension / length
            for c in range(3):
                along = pull * (x[j, c] - x[i, c])
                r[i, c] -= along
                r[j, c] += along
        if model.dashpot[e] > 0.0:
            dx, dy, dz = old[j, 0] - old[i, 0], old[j, 1] - old[i, 1], old[j, 2] - old[i, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared > 0.0:
                rate = (v[j, 0] - v[i, 0]) * dx + (v[j, 1] - v[i, 1]) * dy + (v[j, 2] - v[i, 2]) * dz
                pull = h * model.dashpot[e] * rate / squared
                for c in range(3):
                    along = pull * (old[j, c] - old[i, c])
                    r[i, c] -= along
                    r[j, c] += along
    total = 0.0
    for i in range(len(x)):
        for c in range(3):
            if state.held[i]:
                r[i, c] = 0.0
            total += r[i, c] * r[i, c]
    return math.sqrt(total) / h


@njit(cache=True, nogil=True, error_model="numpy")
def add_outer(along: float, across: float, dx: float, dy: float, dz: float, block: Array) -> None:
    """Adds along d dᵀ + across I to a symmetric ``block`` (6,)."""
    block[0] += along * dx * dx + across
    block[1] += along * dx * dy
    block[2] += along * dx * dz
    block[3] += along * dy * dy + across
    block[4] += along * dy * dz
    block[5] += along * dz * dz + across


@njit(cache=True, nogil=True, error_model="numpy")
def linearise(model: Model, state: State, x: Array, h: float, project: bool, block: Array, inverse: Array) -> None:
    """The links' blocks h² B + h b u uᵀ at ``x`` (n, 3), and the inverse of each node's own block."""
    law, old = model.law, state.x
    branch = Branch(law, state.slip)
    block[:] = 0.0
    inverse[:] = 0.0
    for i in range(len(x)):
        add_outer(0.0, model.mass[i] + h * model.drag[i], 0.0, 0.0, 0.0, inverse[i])
    for e in range(len(model.links)):
        i, j = model.links[e, 0], model.links[e, 1]
        dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        squared = dx * dx + dy * dy + dz * dz
        length = math.sqrt(squared)
        if length > 0.0:
            tension, tangent = tension_of(e, length - model.rest_length[e], law.stiffness, branch)
            across = tension / length
            if project and across < 0.0:
                across = 0.0
            add_outer(h * h * (tangent - across) / squared, h * h * across, dx, dy, dz, block[e])
        if model.dashpot[e] > 0.0:
            dx, dy, dz = old[j, 0] - old[i, 0], old[j, 1] - old[i, 1], old[j, 2] - old[i, 2]
            squared = dx * dx + dy * dy + dz * dz
            if squared > 0.0:
                add_outer(h * model.dashpot[e] / squared, 0.0, dx, dy, dz, block[e])
        for c in range(6):
            inverse[i, c] += block[e, c]
            inverse[j, c] += block[e, c]
    for i in range(len(x)):
        invert(inverse[i])


@njit(cache=True, nogil=True, error_model="numpy")
def invert(a: Array) -> None:
    """Inverts a symmetric 3 × 3 matrix (6,) in place, by its cofactors."""
    xx, xy, xz, yy, yz, zz = a[0], a[1], a[2], a[3], a[4], a[5]
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * cxx + xy * cxy + xz * cxz
    a[0], a[1], a[2] = cxx / determinant, cxy / determinant, cxz / determinant
    a[3], a[4] = (xx * zz - xz * xz) / determinant, (xy * xz - xx * yz) / determinant
    a[5] = (xx * yy - xy * xy) / determinant


@njit(cache=True, nogil=True, error_model="numpy")
def multiply(model: Model, held: np.ndarray, h: float, block: Array, p: Array, out: Array) -> float:
    """``out`` = (M + h C + h² K) ``p``, each (n, 3), filtered; returns p · out."""
    for i in range(len(p)):
        own = model.mass[i] + h * model.drag[i]
        out[i, 0], out[i, 1], out[i, 2] = own * p[i, 0], own * p[i, 1], own * p[i, 2]
    for e in range(len(block)):
        i, j = model.links[e, 0], model.links[e, 1]
        dx, dy, dz = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        fx = block[e, 0] * dx + block[e, 1] * dy + block[e, 2] * dz
        fy = block[e, 1] * dx + block[e, 3] * dy + block[e, 4] * dz
        fz = block[e, 2] * dx + block[e, 4] * dy + block[e, 5] * dz
        out[i, 0] += fx
        out[i, 1] += fy
        out[i, 2] += fz
        out[j, 0] -= fx
        out[j, 1] -= fy
        out[j, 2] -= fz
    total = 0.0
    for i in range(len(p)):
        if held[i]:
            out[i, 0] = out[i, 1] = out[i, 2] = 0.0
        total += p[i, 0] * out[i, 0] + p[i, 1] * out[i, 1] + p[i, 2] * out[i, 2]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def precondition(inverse: Array, error: Array, out: Array) -> float:
    """``out`` = the nodes' inverse blocks times ``error``, each (n, 3); returns error · out.

    The error of a held node is zero from the first, so nothing is to be filtered here.
    """
    total = 0.0
    for i in range(len(out)):
        x, y, z = error[i, 0], error[i, 1], error[i, 2]
        out[i, 0] = inverse[i, 0] * x + inverse[i, 1] * y + inverse[i, 2] * z
        out[i, 1] = inverse[i, 1] * x + inverse[i, 3] * y + inverse[i, 4] * z
        out[i, 2] = inverse[i, 2] * x + inverse[i, 4] * y + inverse[i, 5] * z
        total += x * out[i, 0] + y * out[i, 1] + z * out[i, 2]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def conjugate_gradients(model: Model, held: np.ndarray, h: float, s: Solve, goal: float) -> bool:
    """Solves A step = -r, beginning with the ``step`` that is there, to an error of norm ``goal`` mN s.

    ``step`` keeps its entries at held nodes. Answers False when it meets a direction of no positive curvature.
    """
    multiply(model, held, h, s.block, s.step, s.image)
    for i in range(len(s.r)):
        for c in range(3):
            s.error[i, c] = -s.r[i, c] - s.image[i, c]
    slope = precondition(s.inverse, s.error, s.scaled)
    s.p[:] = s.scaled
    for _ in range(3 * MOST_ITERATIONS * len(s.r)):
        total = 0.0
        for i in range(len(s.error)):
            for c in range(3):
                total += s.error[i, c] * s.error[i, c]
        if math.sqrt(total) <= goal:
            return True
        curvature = multiply(model, held, h, s.block, s.p, s.image)
        if not (curvature > 0.0 and slope > 0.0):
            return False
        t = slope / curvature
        for i in range(len(s.p)):
            for c in range(3):
                s.step[i, c] += t * s.p[i, c]
                s.error[i, c] -= t * s.image[i, c]
        new_slope = precondition(s.inverse, s.error, s.scaled)
        share = new_slope / slope
        slope = new_slope
        for i in range(len(s.p)):
            for c in range(3):
                s.p[i, c] = s.scaled[i, c] + share * s.p[i, c]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def dot(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def add_step(v: Array, t: float, step: Array) -> None:
    for i in range(len(v)):
        for c in range(3):
            v[i, c] += t * step[i, c]


@njit(cache=True, nogil=True, error_model="numpy")
def newton(model: Model, state: State, s: Solve, h: float, tolerance_mN: float, most_steps: int) -> tuple[bool, float]:
    """Leaves the new velocities in ``s.v`` and positions in ``s.x``; whether they will do, and the residual, mN."""
    held = state.held
    s.v[:] = 0.0
    force = residual(model, state, s.v, h, s.x, s.r)
    for steps in range(1, most_steps + 1):
        goal = 0.5 * h * tolerance_mN if most_steps == 1 else h * max(0.5 * tolerance_mN, FORCING * force)
        for project in (False, True):
            s.step[:] = 0.0
            if steps == 1:
                for i in range(len(held)):
                    if held[i]:
                        s.step[i, 0], s.step[i, 1], s.step[i, 2] = state.v[i, 0], state.v[i, 1], state.v[i, 2]
            linearise(model, state, s.x, h, project, s.block, s.inverse)
            if conjugate_gradients(model, held, h, s, goal):
                break
        slope = dot(s.r, s.step)
        t, taken = 1.0, 0.0
        for _ in range(MOST_TRIES):
            add_step(s.v, t - taken, s.step)
            taken = t
            force = residual(model, state, s.v, h, s.x, s.r)
            # The first step carries the held nodes to their velocities, and is taken whole.
            new_slope = dot(s.r, s.step)
            if steps == 1 or new_slope <= -SLOPE_LEFT * slope:
                break
            t *= min(0.5, max(0.1, slope / (slope - new_slope)))
        if force <= tolerance_mN:
            return True, force
        if not math.isfinite(force):
            return False, force
    return most_steps == 1, force


class BackwardEuler:
    """Backward Euler at work on one mesh."""

    name = "backward Euler"
    #: No mode grows at any step.
    stable_step_s = math.inf

    def __init__(self, model: Model, *, tolerance_mN: float, newton_steps: int = MOST_NEWTON_STEPS) -> None:
        """``tolerance_mN`` is the norm of the forces that may stay unbalanced over all nodes.

        With ``newton_steps=1`` it is what the linear solve of Baraff & Witkin leaves, and the forces follow the links'
        turning and stiffening one step late.
        """
        if not 0.0 < tolerance_mN < math.inf:
            raise ValueError(f"'tolerance_mN' must be positive and finite, found {tolerance_mN:g}")
        if newton_steps < 1:
            raise ValueError(f"'newton_steps' must be at least 1, found {newton_steps}")
        self.model, self.tolerance_mN, self.newton_steps = model, tolerance_mN, newton_steps
        #: Norm of the forces that the last step left unbalanced, mN: the largest of its substeps.
        self.residual_mN = 0.0
        n, m = len(model.mass), len(model.links)
        by_node, old = np.zeros((8, n, 3)), np.zeros((2, n, 3))
        self._solve = Solve._make([*by_node, np.zeros((m, 6)), np.zeros((n, 6)), *old, np.zeros(m)])

    def step(self, state: State, duration: float) -> int:
        """Moves ``state`` on by ``duration`` s, in place; returns the number of substeps.

        There is one, unless Newton's method does not converge: then the rest is done in halves.
        Raises ValueError for a state or a duration that is not finite, ArithmeticError where even the smallest
        substep does not converge. The state is then as it was.
        """
        refuse(state, duration)
        s = self._solve
        s.old_x[:], s.old_v[:], s.old_slip[:] = state.x, state.v, state.slip
        # Time is counted in the smallest substeps, so that the halves add up.
        whole = 1 << MOST_HALVINGS
        done, size, substeps = 0, whole, 0
        self.residual_mN = 0.0
        while done < whole:
            h = duration * (size / whole)
            converged, left = newton(self.model, state, s, h, self.tolerance_mN, self.newton_steps)
            if converged and finite(s.x) and finite(s.v):
                state.x[:], state.v[:] = s.x, s.v
                settle_links(self.model, state)
                self.residual_mN = max(self.residual_mN, left)
                done, substeps = done + size, substeps + 1
            elif size > 1:
                size //= 2
            else:
                state.x[:], state.v[:], state.slip[:] = s.old_x, s.old_v, s.old_slip
                raise ArithmeticError(f"backward Euler does not converge in a substep of {h:g} s")
        return substeps
