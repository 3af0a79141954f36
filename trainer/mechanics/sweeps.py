"""Local block sweeps: each node in turn goes to its own equilibrium, and a factor of over-relaxation beyond it.

The paper's relaxation moves a node along the force on it. Here the node takes a step of Newton's method for its three
coordinates, x_i ← x_i + ω B_i⁻¹ f_i with B_i the sum of its links' blocks (block Gauss–Seidel, or nonlinear block SOR:
Ortega and Rheinboldt 1970, section 7.4). B_i is made of the links' positive parts, and a step that does not lower the
energy of the node's own links is halved until it does; so the energy of the mesh never rises but by rounding.

ω is found, not given. Near the answer a sweep with ω multiplies the changes of the sweep before by some η < 1. Where
the blocks can be ordered consistently, η tells the spectral radius ρ of block Jacobi (Young 1954, Trans. AMS 76:92) by

    (η + ω - 1)² = η ω² ρ²,    and the best factor is    ω = 2 / (1 + sqrt(1 - ρ²)).

The first estimate is from sweeps with ω = 1; while η > ω - 1 the factor is still too small and the formula is used
again (Carré 1961, Comput. J. 4:73); once it is not, η says nothing more and ω stays. The formula overrates ρ when the
observed ratio is still growing or is near 1 by chance: an ω that stops the energy from falling is taken back.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.link_tension import Branch, potential_of, tension_of
from trainer.mechanics.links import LinkMesh, add_forces, never_stretched
from trainer.mechanics.newton import Outcome, refuse_loose_nodes, refuse_not_finite
from trainer.mechanics.relaxation import breadth_first

#: The fewest sweeps between two looks at the residual and at ω.
SWEEPS_PER_LOOK = 10
#: A pivot below this share of a block's trace is none: the node then moves along the force, as in the paper.
SINGULAR = 1e-9
#: How often a node's step is halved; then the node stays.
MOST_HALVINGS = 20
#: Share of a sum of energies that is lost to rounding.
ROUNDING = 1e-15
#: ω stays below 2, from where on nothing converges.
MOST_OMEGA = 1.9999


class BlockSweeps:
    """The state ``x`` (n, 3) mm of a mesh, and the factor ``omega`` that its sweeps have found so far."""

    def __init__(self, mesh: LinkMesh) -> None:
        """Raises ValueError for a node that is neither fixed nor linked."""
        refuse_loose_nodes(mesh)
        self.mesh = mesh
        self.x = mesh.rest.copy()
        self.branch = never_stretched(mesh)  # where on their law the links are; ``links.settle`` moves it
        self.omega = 1.0
        self._known = False  # omega is found: the observed ratio says no more
        self._force = np.zeros_like(mesh.rest)
        self._order: tuple[bytes, int | None, np.ndarray] | None = None

    def move(
        self,
        nodes: np.ndarray,
        places: Array,
        *,
        tolerance_mN: float,
        most_sweeps: int = 100_000,
        load: Array | None = None,
        most_links: int | None = None,
    ) -> Outcome:
        """Moves ``nodes`` (k,) to ``places`` (k, 3) and the others towards equilibrium under ``load`` (n, 3) mN.

        Nodes more than ``most_links`` from the moved ones stay where they are. Raises ValueError when a place or a
        load is not finite.
        """
        refuse_not_finite(places, load)
        mesh, x = self.mesh, self.x
        load = np.zeros_like(x) if load is None else load
        order = self._breadth_first(nodes, most_links)
        x[nodes] = places
        done = 0
        energy, residual = self._evaluate(order, load)
        while residual > tolerance_mN and done < most_sweeps:
            # As many sweeps as it takes until the slowest change stands out from the others.
            count = min(max(SWEEPS_PER_LOOK, math.ceil(2.0 / (2.0 - self.omega))), most_sweeps - done)
            first = last = 0.0
            for k in range(count):
                last = sweep(
                    x, order, mesh.start, mesh.neighbour, mesh.via, mesh.rest_length, mesh.stiffness, load, self.omega,
                    self.branch,
                )  # fmt: skip
                if k == count // 2:
                    first = last
            done += count
            energy, residual = self._evaluate(order, load)
            if count >= SWEEPS_PER_LOOK and first > 0.0:
                self._look((last / first) ** (1.0 / (count - 1 - count // 2)))
        return Outcome(residual <= tolerance_mN, done, residual, energy)

    def _look(self, eta: float) -> None:
        """Learns from the ratio of the changes of two sweeps."""
        if eta >= 1.0:
            if self._known:  # too bold
                self.omega, self._known = 1.0 + 0.5 * (self.omega - 1.0), False
            return
        if not self._known:
            self.omega, self._known = better_factor(self.omega, eta)

    def _breadth_first(self, nodes: np.ndarray, most_links: int | None) -> np.ndarray:
        """The order of the sweeps, kept while the same nodes are moved.

        Without a region's limit it ends with the nodes that no link joins to the moved ones: a load may move them.
        """
        key = np.asarray(nodes, dtype=np.int64).tobytes()
        if self._order is None or self._order[:2] != (key, most_links):
            order = breadth_first(self.mesh, nodes, most_links)
            if most_links is None:
                left = ~self.mesh.fixed
                left[nodes] = left[order] = False
                order = np.concatenate([order, np.flatnonzero(left).astype(np.int32)])
            self._order = (key, most_links, order)
        return self._order[2]

    def _evaluate(self, order: np.ndarray, load: Array) -> tuple[float, float]:
        """The energy, and the norm of the forces on the nodes of ``order``."""
        m = self.mesh
        self._force[:] = load
        energy = add_forces(self.x, m.links, m.rest_length, m.stiffness, 0, len(m.links), self._force, self.branch)
        return float(energy - np.vdot(load, self.x)), float(np.linalg.norm(self._force[order]))


def better_factor(omega: float, eta: float) -> tuple[float, bool]:
    """The factor that follows from a ratio ``eta`` < 1 of changes seen with ``omega``, and whether it is final."""
    if eta <= omega - 1.0:
        return omega, True
    squared = (eta + omega - 1.0) ** 2 / (eta * omega**2)
    if squared >= 1.0:
        return omega, False
    best = min(2.0 / (1.0 + math.sqrt(1.0 - squared)), MOST_OMEGA)
    # Final when a new estimate would hardly differ; till then it stays somewhat below, where the ratio tells (Carré).
    if abs(best - omega) <= 0.05 * (2.0 - best):
        return best, True
    return max(omega, best - 0.25 * (2.0 - best)), False


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(
    x: Array,
    order: np.ndarray,
    start: np.ndarray,
    neighbour: np.ndarray,
    via: np.ndarray,
    rest_length: Array,
    stiffness: Array,
    load: Array,
    omega: float,
    branch: Branch | None = None,
) -> float:
    """One sweep over the nodes ``order``; returns the Euclidean norm of the changes, mm."""
    total = 0.0
    for i in order:
        fx, fy, fz = load[i, 0], load[i, 1], load[i, 2]
        xx = xy = xz = yy = yz = zz = trace = energy = 0.0
        for entry in range(start[i], start[i + 1]):
            j, e = neighbour[entry], via[entry]
            dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            stretch = length - rest_length[e]
            tension, k = tension_of(e, stretch, stiffness, branch)
            trace += k
            energy += potential_of(e, stretch, stiffness, branch)
            if length > 0.0:
                pull = tension / length
                across = max(pull, 0.0)
                along = (k - across) / (length * length)
                fx += pull * dx
                fy += pull * dy
                fz += pull * dz
                xx += along * dx * dx + across
                xy += along * dx * dy
                xz += along * dx * dz
                yy += along * dy * dy + across
                yz += along * dy * dz
                zz += along * dz * dz + across
        # LDLᵀ of the node's block.
        least = SINGULAR * trace
        l10, l20 = xy / xx, xz / xx
        d1 = yy - l10 * xy
        l21 = (yz - l20 * xy) / d1
        d2 = zz - l20 * xz - l21 * l21 * d1
        if xx > least and d1 > least and d2 > least:
            gy = fy - l10 * fx
            gz = (fz - l20 * fx - l21 * gy) / d2
            gy = gy / d1 - l21 * gz
            gx = fx / xx - l10 * gy - l20 * gz
            sx, sy, sz = omega * gx, omega * gy, omega * gz
        else:
            sx, sy, sz = fx / trace, fy / trace, fz / trace
        for _ in range(MOST_HALVINGS):
            changed = -load[i, 0] * sx - load[i, 1] * sy - load[i, 2] * sz
            for entry in range(start[i], start[i + 1]):
                j, e = neighbour[entry], via[entry]
                dx, dy, dz = x[j, 0] - x[i, 0] - sx, x[j, 1] - x[i, 1] - sy, x[j, 2] - x[i, 2] - sz
                stretch = math.sqrt(dx * dx + dy * dy + dz * dz) - rest_length[e]
                changed += potential_of(e, stretch, stiffness, branch)
            if changed <= energy * (1.0 + ROUNDING):
                x[i, 0] += sx
                x[i, 1] += sy
                x[i, 2] += sz
                total += sx * sx + sy * sy + sz * sz
                break
            sx, sy, sz = 0.5 * sx, 0.5 * sy, 0.5 * sz
    return math.sqrt(total)
