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
from trainer.mechanics.attachments import Anchors, Cable, Loads, Rows, flatten
from trainer.mechanics.compliance import Compliance
from trainer.mechanics.links import LinkMesh
from trainer.mechanics.minimise import Base, Bodies, Held, Memory, minimise, pull_points

#: Secant pairs kept from one solve to the next: twelve take the same number of iterations in a stitch, and more time.
PAIRS = 6
#: A target further away than this, mm, is approached in steps of this size, so that the tissue follows its path …
STEP_MM = 0.1
#: … in at most so many steps in one solve; the rest of the way is left to the next.
MOST_STEPS = 8
#: A cable's penalty, as a multiple of the tissue's own stiffness along it.
CABLE_PENALTY = 1e3
#: More iterations than this in a solve: the kept factor no longer serves, begin a new one.
SLOW = 8
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


class Equilibrium:
    """The state ``x`` (n, 3) mm of a link mesh, and what is held of it."""

    def __init__(self, mesh: LinkMesh, orders: tuple[np.ndarray, ...]) -> None:
        """``orders``: the free nodes of each body in elimination order; bodies share no link and follow one another
        in the numbering of nodes and links. Raises ValueError when the links leave a node free to move."""
        n = len(mesh.rest)
        self.mesh = mesh
        self.x = mesh.rest.copy()
        self.compliance = Compliance(mesh, orders)
        held, bodies = self.compliance, len(orders)
        self._bodies = Bodies(
            links=mesh.links,
            rest_length=mesh.rest_length,
            stiffness=mesh.stiffness,
            fixed=mesh.fixed,
            span=np.array(held.links, dtype=np.int64),
            nodes=np.array(held.nodes, dtype=np.int64),
            longest_step=float(np.median(mesh.rest_length)),
        )
        self._memory = Memory(
            s=np.zeros((PAIRS, n, 3)),
            y=np.zeros((PAIRS, n, 3)),
            product=np.zeros((PAIRS, bodies)),
            ring=np.zeros(2, dtype=np.int64),
            force=np.zeros((n, 3)),
            old_force=np.zeros((n, 3)),
            g=np.zeros((n, 3)),
            q=np.zeros((n, 3)),
            z=np.zeros((n, 3)),
            trial=mesh.rest.copy(),
            v=np.zeros(3 * max(len(order) for order in orders)),
        )
        self._at_rest = [True] * bodies
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
        held = self._held(rows, cables)
        pull_points(self.x, rows, held)
        start = np.array([self._last_target.get(int(s), self.position(int(s))) for s in anchors.slot]).reshape(-1, 3)
        way = rows.target - start
        distance = _distance(rows.stiffness, way)
        length = rows.length.copy()
        excess = np.maximum(held.stretch, 0.0)
        far = max(float(np.max(distance, initial=0.0)), float(np.max(excess, initial=0.0)))
        steps = min(max(int(np.ceil(far / STEP_MM)), 1), MOST_STEPS)
        share = np.minimum(1.0, steps * STEP_MM / np.maximum(distance, 1e-300))
        shortened = np.minimum(excess, steps * STEP_MM)
        iterations = 0
        for step in range(1, steps + 1):
            rows.target[:] = start + (share * step / steps)[:, None] * way
            rows.length[:] = length + excess - shortened * step / steps
            tolerance = tolerance_mN if step == steps else STEP_TOLERANCE * tolerance_mN
            converged, used, residual = minimise(
                self.x, self._bodies, self._base(), rows, held, self._memory, tolerance, max_iterations
            )
            iterations += used
        if iterations > steps * SLOW or not converged:
            self.compliance.refresh(held.awake.tolist(), self.x)
        self.compliance.advance()
        self._last_target = {int(s): t.copy() for s, t in zip(anchors.slot, rows.target, strict=True)}
        self._tension = {_key(c): float(t) for c, t in zip(cables, held.multiplier, strict=True)}
        cable_share = np.where(excess > 0.0, shortened / np.maximum(excess, 1e-300), 1.0)
        reached = min(float(np.min(share, initial=1.0)), float(np.min(cable_share, initial=1.0)))
        return Result(
            converged=converged and reached == 1.0,
            iterations=iterations,
            residual_mN=residual,
            reached=reached,
            anchor_force=np.einsum("aij,aj->ai", rows.stiffness, rows.target - held.point[rows.anchor_at]),
            tension=np.maximum(0.0, held.multiplier + held.penalty * held.stretch),
            cable_error_mm=float(np.max(held.stretch, initial=0.0)),
        )

    def _base(self) -> Base:
        c = self.compliance
        return Base(tuple(c.factors), c.columns, c.slot_range, c.matrix)

    def _held(self, rows: Rows, cables: tuple[Cable, ...]) -> Held:
        """The arrays of one solve. A body that nothing holds is put to rest, the only state without force it has."""
        kept = self.compliance
        u, c = len(rows.slots), len(rows.length)
        nodes, weights = kept.slot_nodes[rows.slots], kept.slot_weights[rows.slots]
        if not weights.any(axis=1).all():
            raise ValueError("a slot is used that was dropped")
        awake = sorted(set(kept.body_of(nodes[:, 0]).tolist()))
        if [b not in awake for b in range(len(kept.nodes))] != self._at_rest:
            self._memory.ring[1] = 0  # the pairs are of other bodies
        for b, (lo, hi) in enumerate(kept.nodes):
            if b not in awake and not self._at_rest[b]:
                self.x[lo:hi] = self.mesh.rest[lo:hi]
                self._memory.z[lo:hi] = 0.0  # it may lie between two that are awake
            self._at_rest[b] = b not in awake
        held = Held(
            awake=np.array(awake, dtype=np.int64),
            first=kept.nodes[awake[0]][0] if awake else 0,
            last=kept.nodes[awake[-1]][1] if awake else 0,
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
            at=np.zeros((u, 3)),
            system=np.zeros((3 * u, 3 * u)),
            curvature=np.zeros(PAIRS),
            share=np.zeros(PAIRS),
        )
        if c:
            pull_points(self.x, rows, held)  # for the rows' directions
            dof = (3 * rows.slots[:, None] + np.arange(3)).ravel()
            compliance = kept.matrix[np.ix_(dof, dof)]
            for n in range(c):
                d = np.zeros((u, 3))
                for k in range(rows.cable_start[n], rows.cable_start[n + 1]):
                    if rows.cable_at[k] >= 0:
                        d[rows.cable_at[k]] += held.row[k]
                give = float(d.ravel() @ compliance @ d.ravel())
                held.penalty[n] = CABLE_PENALTY / give if give > 0.0 else 1.0
        return held


def _distance(stiffness: Array, way: Array) -> Array:
    """How far (a,) mm targets move in the directions in which the anchors hold."""
    norm = np.max(np.sum(np.abs(stiffness), axis=2), axis=1, initial=0.0)
    across = np.linalg.norm(np.einsum("aij,aj->ai", stiffness, way), axis=1)
    return np.asarray(across / np.maximum(norm, 1e-300))


def _key(cable: Cable) -> tuple[int, ...]:
    return tuple(int(s) for s in cable.slot)
