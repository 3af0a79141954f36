"""Static equilibrium of a link mesh by a kept factor and secant pairs: what runs at every tick.

Solves equation (2) of Brown et al. 2001 for all nodes at once, where the paper moves one node at a time. The
stiffness of the rest state is factored once for each body (a band per vessel). Every solve minimises the energy by
L-BFGS from the present state with that factor as base; what holds the tissue (anchors, cables) is few scalar rows and
is included exactly. Nothing is factored again when a hold comes, goes or moves; a body that is bent so far that its
rest stiffness misleads is factored anew where it is, a slice at each solve. A body that nothing holds costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array
from trainer.mechanics import banded
from trainer.mechanics.attachments import Anchors, Cable, Loads, Rows, flatten, pull
from trainer.mechanics.compliance import Compliance
from trainer.mechanics.links import LinkMesh, add_forces
from trainer.mechanics.quasi_newton import add_scaled, after_base, at_points, before_base, dot, hold_base, spread

#: Secant pairs kept from one solve to the next.
PAIRS = 12
#: A target further away than this, mm, is approached in steps of this size, so that the tissue follows its path …
STEP_MM = 0.1
#: … in at most so many steps in one solve; the rest of the way is left to the next.
MOST_STEPS = 8
#: A cable's path may be longer than the cable by this much, mm.
CABLE_MM = 1e-5
#: A cable's penalty, as a multiple of the tissue's own stiffness along it.
CABLE_PENALTY = 1e3
#: Sufficient decrease (Armijo), and the shortest step tried.
DECREASE, SHORTEST_STEP = 1e-4, 1e-4
#: More iterations than this in a solve: the kept factor no longer serves, begin a new one.
SLOW = 4
#: Share of an energy that is lost to rounding when it is summed over thousands of links.
ROUNDING = 1e-14
#: On the way to a target that has leapt, the residual may be so many times the tolerance.
STEP_TOLERANCE = 100.0


@dataclass(frozen=True)
class Result:
    """What a solve found. Not converged: the state is finite and nearer, and the next solve goes on from it."""

    converged: bool
    iterations: int
    residual_mN: float  # Euclidean norm of the unbalanced forces on the free nodes
    reached: float  # 0 … 1, least share of the way to a target or length that was gone; below 1 is not converged
    anchor_force: Array  # (a, 3) mN, on the tissue, at the targets as far as they were reached
    tension: Array  # (c,) mN
    cable_error_mm: float  # longest excess of a cable's path


@dataclass
class _Work:
    """The arrays of one solve over u points in use and c cables; see Rows and the kernels that fill them."""

    awake: list[int]  # bodies that are not at rest
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
    held: Array  # (u, 3)
    system: Array  # (3 u, 3 u)
    residual: float = 0.0

    def tension(self) -> Array:
        """(c,) mN at the last evaluation."""
        return np.asarray(np.maximum(0.0, self.multiplier + self.penalty * self.stretch))


class Equilibrium:
    """The state ``x`` (n, 3) mm of a link mesh, and what is held of it."""

    def __init__(self, mesh: LinkMesh, orders: tuple[np.ndarray, ...]) -> None:
        """``orders``: the free nodes of each body in elimination order; bodies share no link and follow one another
        in the numbering of nodes and links. Raises ValueError when the links leave a node free to move."""
        n = len(mesh.rest)
        self.mesh = mesh
        self.x = mesh.rest.copy()
        self.compliance = Compliance(mesh, orders)
        self._step_limit = float(np.median(mesh.rest_length))
        self._at_rest = [True] * len(orders)
        self._s, self._y = np.zeros((PAIRS, n, 3)), np.zeros((PAIRS, n, 3))
        self._newest, self._count = 0, 0
        self._force, self._old_force, self._g, self._q, self._z = np.zeros((5, n, 3))
        self._trial = self.x.copy()
        self._last_target: dict[int, Array] = {}
        self._tension: dict[tuple[int, ...], float] = {}

    def hold(self, nodes: np.ndarray, weights: Array) -> int:
        """A slot for the material point that is the mean of ``nodes`` (3,) with ``weights`` (3,), all of one body."""
        return self.compliance.hold(nodes, weights)

    def drop(self, slot: int) -> None:
        """Forgets a material point; its number may be given out again."""
        self.compliance.drop(slot)
        self._last_target.pop(slot, None)
        self._tension = {k: v for k, v in self._tension.items() if slot not in k}

    def position(self, slot: int) -> Array:
        """Where a material point is, (3,) mm."""
        return np.asarray(self.compliance.slot_weights[slot] @ self.x[self.compliance.slot_nodes[slot]])

    def solve(
        self,
        anchors: Anchors | None = None,
        cables: tuple[Cable, ...] = (),
        loads: Loads | None = None,
        tolerance_mN: float = 1e-3,
        max_iterations: int = 60,
    ) -> Result:
        """Moves ``x`` to the equilibrium with what holds it now; ``max_iterations`` counts for each step of the way.

        A target (or a cable's end) that has leapt is approached in steps of STEP_MM along the straight line from
        where it was, because another equilibrium may lie nearer to the leap's end (facts of the paper's assumption
        that the tissue is in equilibrium at each instant). Raises ValueError when a given number is not finite.
        """
        anchors = Anchors.none() if anchors is None else anchors
        rows = flatten(anchors, cables, Loads.none() if loads is None else loads)
        work = self._work(rows, cables)
        self._evaluate(rows, work, self.x)
        start = np.array([self._last_target.get(int(s), self.position(int(s))) for s in anchors.slot]).reshape(-1, 3)
        way = rows.target - start
        distance = _distance(rows.stiffness, way)
        length = rows.length.copy()
        excess = np.maximum(work.stretch, 0.0)
        far = max(float(np.max(distance, initial=0.0)), float(np.max(excess, initial=0.0)))
        steps = min(max(int(np.ceil(far / STEP_MM)), 1), MOST_STEPS)
        share = np.minimum(1.0, steps * STEP_MM / np.maximum(distance, 1e-300))
        shortened = np.minimum(excess, steps * STEP_MM)
        iterations = 0
        for step in range(1, steps + 1):
            rows.target[:] = start + (share * step / steps)[:, None] * way
            rows.length[:] = length + excess - shortened * step / steps
            tolerance = tolerance_mN if step == steps else STEP_TOLERANCE * tolerance_mN
            converged, used = self._minimise(rows, work, tolerance, max_iterations)
            iterations += used
        if iterations > steps * SLOW or not converged:
            self.compliance.refresh(work.awake, self.x)
        self.compliance.advance()
        self._last_target = {int(s): t.copy() for s, t in zip(anchors.slot, rows.target, strict=True)}
        self._tension = {_key(c): float(t) for c, t in zip(cables, work.multiplier, strict=True)}
        cable_share = np.where(excess > 0.0, shortened / np.maximum(excess, 1e-300), 1.0)
        reached = min(float(np.min(share, initial=1.0)), float(np.min(cable_share, initial=1.0)))
        return Result(
            converged=converged and reached == 1.0,
            iterations=iterations,
            residual_mN=work.residual,
            reached=reached,
            anchor_force=np.einsum("aij,aj->ai", rows.stiffness, rows.target - work.point[rows.anchor_at]),
            tension=work.tension(),
            cable_error_mm=float(np.max(work.stretch, initial=0.0)),
        )

    def _work(self, rows: Rows, cables: tuple[Cable, ...]) -> _Work:
        """The arrays of one solve. A body that nothing holds is put to rest, the only state without force it has."""
        held = self.compliance
        u, c = len(rows.slots), len(rows.length)
        nodes, weights = held.slot_nodes[rows.slots], held.slot_weights[rows.slots]
        if not np.all(np.any(weights != 0.0, axis=1)):
            raise ValueError("a slot is used that was dropped")
        bodies = set(held.body_of(nodes[:, 0]).tolist())
        for b, (lo, hi) in enumerate(held.nodes):
            if b not in bodies and not self._at_rest[b]:
                self.x[lo:hi] = self.mesh.rest[lo:hi]
            self._at_rest[b] = b not in bodies
        awake = sorted(bodies)
        work = _Work(
            awake=awake,
            first=held.nodes[awake[0]][0] if awake else 0,
            last=held.nodes[awake[-1]][1] if awake else 0,
            nodes=nodes,
            weights=weights,
            multiplier=np.array([self._tension.get(_key(cable), 0.0) for cable in cables]),
            penalty=np.ones(c),
            row=np.zeros((len(rows.cable_at), 3)),
            point=np.zeros((u, 3)),
            force=np.zeros((u, 3)),
            matrix=np.zeros((3 * u, 3 * u)),
            stretch=np.zeros(c),
            moved=np.zeros((PAIRS, u, 3)),
            pulled=np.zeros((PAIRS, u, 3)),
            answer=np.zeros((u, 3)),
            held=np.zeros((u, 3)),
            system=np.zeros((3 * u, 3 * u)),
        )
        if c:
            self._evaluate(rows, work, self.x)  # for the rows' directions
            dof = (3 * rows.slots[:, None] + np.arange(3)).ravel()
            compliance = held.matrix[np.ix_(dof, dof)]
            for n in range(c):
                d = np.zeros((u, 3))
                for k in range(rows.cable_start[n], rows.cable_start[n + 1]):
                    if rows.cable_at[k] >= 0:
                        d[rows.cable_at[k]] += work.row[k]
                give = float(d.ravel() @ compliance @ d.ravel())
                work.penalty[n] = CABLE_PENALTY / give if give > 0.0 else 1.0
        return work

    def _evaluate(self, rows: Rows, work: _Work, x: Array) -> float:
        """The energy at ``x``; leaves the nodes' elastic forces, the points' forces and their stiffness behind."""
        energy = 0.0
        self._force[work.first : work.last] = 0.0
        m = self.mesh
        for b in work.awake:
            energy += add_forces(x, m.links, m.rest_length, m.stiffness, *self.compliance.links[b], self._force)
        at_points(x, work.nodes, work.weights, work.point)
        return energy + pull(
            work.point,
            rows.anchor_at,
            rows.target,
            rows.stiffness,
            rows.cable_start,
            rows.cable_at,
            rows.cable_place,
            rows.channel,
            rows.length,
            work.multiplier,
            work.penalty,
            rows.load,
            work.row,
            work.force,
            work.matrix,
            work.stretch,
        )

    def _gradient(self, work: _Work) -> Array:
        """Minus the unbalanced forces (n, 3) on free nodes at the last evaluation."""
        g = self._g
        lo, hi = work.first, work.last
        np.negative(self._force[lo:hi], out=g[lo:hi])
        spread(-1.0, work.force, work.nodes, work.weights, g)
        g[lo:hi][self.mesh.fixed[lo:hi]] = 0.0
        work.residual = float(np.sqrt(dot(g, g, lo, hi)))
        return g

    def _direction(self, rows: Rows, work: _Work, g: Array, count: int) -> Array:
        """A step (n, 3) towards the energy's minimum, from the newest ``count`` secant pairs."""
        lo, hi = work.first, work.last
        q, z = self._q, self._z
        q[lo:hi] = g[lo:hi]
        history = (self._s, self._y, self._newest, count)
        curvature, share = np.zeros(PAIRS), np.zeros(PAIRS)
        before_base(
            q, *history, work.matrix, work.nodes, work.weights, lo, hi, work.moved, work.pulled, curvature, share
        )
        for b in work.awake:
            banded.solve(self.compliance.factors[b], q, z)
        hold_base(
            z,
            rows.slots,
            work.nodes,
            work.weights,
            self.compliance.columns,
            self.compliance.slot_range,
            self.compliance.matrix,
            work.matrix,
            work.answer,
            work.held,
            work.system,
        )
        after_base(z, *history, work.nodes, work.weights, lo, hi, work.pulled, curvature, share, work.answer)
        return z

    def _minimise(self, rows: Rows, work: _Work, tolerance_mN: float, max_iterations: int) -> tuple[bool, int]:
        """Iterates until the residual and the cables' excess are small: (converged, iterations)."""
        lo, hi = work.first, work.last
        energy = self._evaluate(rows, work, self.x)
        g = self._gradient(work)
        for iteration in range(max_iterations):
            if work.residual <= tolerance_mN:
                tension = work.tension()
                if np.all(np.abs(tension - work.multiplier) <= CABLE_MM * work.penalty):
                    return True, iteration
                work.multiplier[:] = tension
                energy = self._evaluate(rows, work, self.x)
                g = self._gradient(work)
            d = self._direction(rows, work, g, self._count)
            slope = dot(g, d, lo, hi)
            if not slope > 0.0:  # the pairs mislead: the base alone always leads down
                self._count = 0
                d = self._direction(rows, work, g, 0)
                slope = dot(g, d, lo, hi)
                if not slope > 0.0:
                    return False, iteration
            longest = float(np.max(np.abs(d[lo:hi])))
            t = 1.0 if longest <= self._step_limit else self._step_limit / longest
            self._old_force[lo:hi] = self._force[lo:hi]
            # What rounding of the energy's sum, and of coordinates far from the origin, can pretend.
            noise = ROUNDING * (abs(energy) + float(np.max(np.abs(self.x[lo:hi]))) * float(np.sum(np.abs(work.force))))
            while True:
                self._trial[lo:hi] = self.x[lo:hi]
                add_scaled(-t, d, self._trial, lo, hi)
                new_energy = self._evaluate(rows, work, self._trial)
                if new_energy <= energy - DECREASE * t * slope + noise:
                    break
                t *= 0.5
                if not t >= SHORTEST_STEP:
                    self._evaluate(rows, work, self.x)
                    self._gradient(work)
                    return False, iteration
            energy = new_energy
            self._newest = (self._newest + 1) % PAIRS
            self._count = min(self._count + 1, PAIRS)
            np.subtract(self._trial[lo:hi], self.x[lo:hi], out=self._s[self._newest, lo:hi])
            np.subtract(self._old_force[lo:hi], self._force[lo:hi], out=self._y[self._newest, lo:hi])
            self.x[lo:hi] = self._trial[lo:hi]
            g = self._gradient(work)
        return work.residual <= tolerance_mN and bool(np.all(work.stretch <= CABLE_MM)), max_iterations


def _distance(stiffness: Array, way: Array) -> Array:
    """How far (a,) mm targets move in the directions in which the anchors hold."""
    norm = np.max(np.sum(np.abs(stiffness), axis=2), axis=1, initial=0.0)
    across = np.linalg.norm(np.einsum("aij,aj->ai", stiffness, way), axis=1)
    return np.asarray(across / np.maximum(norm, 1e-300))


def _key(cable: Cable) -> tuple[int, ...]:
    return tuple(int(s) for s in cable.slot)
