"""Static equilibrium of a link mesh by a kept factor and secant pairs: what runs at every tick.

Solves equation (2) of Brown et al. 2001 for all nodes at once, where the paper moves one node at a time. The
stiffness of the rest state is factored once for each body (a band per vessel). Every solve minimises the energy by
L-BFGS from the present state with that factor as base; what holds the tissue (anchors, cables) is few scalar rows and
is included exactly. Nothing is factored again when a hold comes, goes or moves; a body that is bent so far that its
rest stiffness misleads is factored anew where it is, beside the solves; so is one that was cut. A body that nothing
holds costs nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from trainer.geometry import Array
from trainer.mechanics import banded
from trainer.mechanics.attachments import Anchors, Cable, Frictions, Rows, fill, lay_out
from trainer.mechanics.compliance import FREE, Compliance
from trainer.mechanics.links import LinkMesh
from trainer.mechanics.loose_pieces import loose_pieces, unstrained
from trainer.mechanics.minimise import Base, Bodies, Held, Memory, approach
from trainer.mechanics.quasi_newton import at_points

#: Secant pairs kept from one solve to the next: fewer take more iterations where a thread draws at the tissue.
PAIRS = 8
#: More iterations than this in a solve: the kept factor no longer serves, begin a new one.
SLOW = 2


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


#: The slots of anchors, of each cable, and of frictions.
_Slots = tuple[bytes, tuple[bytes, ...], bytes]


class _Group(NamedTuple):
    """Bodies that are solved together, because cables join them, what holds them (numbers in the lists given), and the
    arrays of their solves."""

    bodies: list[int]
    anchors: list[int]
    cables: list[int]
    frictions: list[int]
    rows: Rows
    held: Held
    pieces: set[int]  # loose ones that something holds
    mesh: Bodies


class Equilibrium:
    """The state ``x`` (n, 3) mm of a link mesh, and what is held of it."""

    def __init__(self, mesh: LinkMesh, orders: tuple[np.ndarray, ...]) -> None:
        """``orders``: the free nodes of each body in elimination order; bodies share no link and follow one another
        in the numbering of nodes and links. Raises ValueError when the links leave a node free to move, or
        have a law of their own."""
        if mesh.law is not None:
            raise ValueError("the kept factor knows links of constant stiffness only: take newton, krylov or sweeps")
        n = len(mesh.rest)
        self.mesh = replace(mesh, stiffness=mesh.stiffness.copy())  # its own: a link that is cut has none
        self.x = mesh.rest.copy()
        self.compliance = Compliance(mesh, orders)
        held, bodies = self.compliance, len(orders)
        self._bodies = Bodies(
            links=mesh.links,
            rest_length=mesh.rest_length,
            stiffness=self.mesh.stiffness,
            fixed=mesh.fixed,
            span=np.array(held.links, dtype=np.int64),
            nodes=np.array(held.nodes, dtype=np.int64),
            adrift=np.zeros(0, dtype=np.int64),
            longest_step=float(np.median(mesh.rest_length)),
        )
        self._memory = Memory(
            s=np.zeros((PAIRS, n, 3), dtype=np.float32),
            y=np.zeros((PAIRS, n, 3), dtype=np.float32),
            product=np.zeros((bodies, PAIRS)),
            newest=np.zeros(bodies, dtype=np.int64),
            known=np.zeros(bodies, dtype=np.int64),
            at=np.full((n, 3), np.nan),
            energy=np.zeros(bodies),
            force=np.zeros((n, 3)),
            old_force=np.zeros((n, 3)),
            g=np.zeros((n, 3)),
            q=np.zeros((n, 3)),
            z=np.zeros((n, 3)),
            trial=mesh.rest.copy(),
            v=banded.scratch(held.factors),
        )
        self._at_rest = [True] * bodies
        self._pieces: list[np.ndarray] = []  # nodes of each that came off what is fixed
        self._tied = np.full(n, True)  # nodes of none of them
        self._still: set[int] = set()  # pieces that nothing holds, in their own shape
        self._last_target: dict[int, list[float]] = {}
        self._tension: dict[tuple[int, ...], float] = {}
        self._groups: dict[_Slots, list[_Group]] = {}  # of what was held since a slot last came or went
        self._scratch: dict[tuple[int, ...], Held] = {}

    def hold(self, nodes: np.ndarray, weights: Array) -> int:
        """A slot for the material point that is the mean of ``nodes`` (3,) with ``weights`` (3,), all of one body."""
        self._groups.clear()
        return self.compliance.hold(nodes, weights)

    def drop(self, slot: int) -> None:
        """Forgets a material point; its number may be given out again."""
        self._groups.clear()
        self.compliance.drop(slot)
        self._last_target.pop(slot, None)
        self._tension = {k: v for k, v in self._tension.items() if slot not in k}

    def cut(self, links: np.ndarray) -> None:
        """The ``links`` (k,) of the mesh bear nothing from now on.

        The next solves go on with the factor that is there, while one without the links is made. A piece that hangs on
        nothing fixed any more goes where it is held; what nothing holds stays where it is. Raises ValueError for a
        number that is no link's.
        """
        links = np.asarray(links, dtype=np.int64)
        if np.any((links < 0) | (links >= len(self.mesh.links))):
            raise ValueError(f"links are counted from 0 to {len(self.mesh.links) - 1}, found {links.tolist()}")
        self.mesh.stiffness[links] = 0.0
        self._memory.known[self.compliance.cut(links)] = 0
        self._memory.at[:] = np.nan  # forces that were found there are no longer those
        self._pieces, self._still = loose_pieces(self.mesh), set()
        self._tied[:] = True
        for nodes in self._pieces:
            self._tied[nodes] = False
        self._groups.clear()

    def position(self, slot: int) -> Array:
        """Where a material point is, (3,) mm."""
        return np.asarray(self.positions([slot])[0])

    def positions(self, slots: list[int]) -> Array:
        """Where material points are, (k, 3) mm."""
        held, found = self.compliance, np.empty((len(slots), 3))
        at_points(self.x, held.slot_nodes[slots], held.slot_weights[slots], found)
        return found

    def solve(
        self,
        anchors: Anchors | None = None,
        cables: tuple[Cable, ...] = (),
        frictions: Frictions | None = None,
        tolerance_mN: float = 1e-3,
        max_iterations: int = 60,
    ) -> Result:
        """Moves ``x`` to the equilibrium with what holds it now; ``max_iterations`` counts for each step of the way.

        A target (or a cable's end) that has leapt is approached in steps of STEP_MM along the straight line from
        where it was, because another equilibrium may lie nearer to the leap's end (facts of the paper's assumption
        that the tissue is in equilibrium at each instant). Raises ValueError when a given number is not finite.
        """
        anchors = Anchors.none() if anchors is None else anchors
        frictions = Frictions.none() if frictions is None else frictions
        slots = anchors.slot.tobytes(), tuple(cable.slot.tobytes() for cable in cables), frictions.slot.tobytes()
        if slots not in self._groups:
            self._groups[slots] = self._grouped(anchors, cables, frictions)
        groups = self._groups[slots]
        self._rest(groups)
        if self.compliance.outdated:
            self.compliance.refresh(sorted(self.compliance.outdated), self.x)
        if not groups:
            self.compliance.start()
        targets: dict[int, list[float]] = {}
        tension: dict[tuple[int, ...], float] = {}
        parts = [
            self._solve(group, anchors, cables, frictions, tolerance_mN, max_iterations, targets, tension)
            for group in groups
        ]
        self.compliance.advance()
        self._last_target, self._tension = targets, tension
        return parts[0] if len(parts) == 1 else _together(groups, parts, len(anchors.slot), len(cables))

    def _solve(
        self,
        group: _Group,
        all_anchors: Anchors,
        all_cables: tuple[Cable, ...],
        all_frictions: Frictions,
        tolerance_mN: float,
        max_iterations: int,
        targets: dict[int, list[float]],
        tensions: dict[tuple[int, ...], float],
    ) -> Result:
        """The equilibrium of one group of bodies; notes its ``targets`` and ``tensions`` for the next solve."""
        a, anchors = group.anchors, all_anchors
        if len(a) < len(anchors.slot):
            anchors = Anchors(anchors.slot[a], anchors.target[a], anchors.stiffness[a])
        cables = tuple(all_cables[c] for c in group.cables)
        f, frictions = group.frictions, all_frictions
        if len(f) < len(frictions.slot):
            frictions = Frictions(
                frictions.slot[f], frictions.place[f], frictions.along[f], frictions.stiffness[f], frictions.limit[f]
            )
        rows, held = group.rows, group.held
        fill(rows, anchors, cables, frictions)
        held.nodes[:] = self.compliance.slot_nodes[rows.slots]
        held.weights[:] = self.compliance.slot_weights[rows.slots]
        slots, names = anchors.slot.tolist(), [tuple(cable.slot.tolist()) for cable in cables]
        before = [self._last_target.get(slot) or self.position(slot).tolist() for slot in slots]
        way = rows.target - np.array(before).reshape(-1, 3)
        for n, name in enumerate(names):
            held.multiplier[n] = self._tension.get(name, 0.0)
        anchor_force, tension = np.zeros_like(way), np.zeros(len(cables))
        self.compliance.start()
        converged, iterations, steps, residual, reached = approach(
            self.x, group.mesh, self._base(), rows, held, self._memory, way, np.zeros(len(cables)), tolerance_mN,
            max_iterations, anchor_force, tension,
        )  # fmt: skip
        if iterations > steps * SLOW or not converged:
            self.compliance.refresh(group.bodies, self.x)
        targets.update(zip(slots, rows.target.tolist(), strict=True))
        tensions.update(zip(names, tension.tolist(), strict=True))
        return Result(
            converged=converged and reached == 1.0,
            iterations=iterations,
            residual_mN=residual,
            reached=reached,
            anchor_force=anchor_force,
            tension=tension,
            cable_error_mm=max(0.0, *held.stretch.tolist()) if cables else 0.0,
        )

    def _grouped(self, anchors: Anchors, cables: tuple[Cable, ...], frictions: Frictions) -> list[_Group]:
        """The bodies that something holds, those that a cable joins together. Raises ValueError for a free slot, and
        for a cable through no material point or with fewer than two points."""
        on_anchors, rubbed = self._bodies_of(anchors.slot), self._bodies_of(frictions.slot)
        on_cables = [self._bodies_of(cable.slot[cable.slot >= 0]) for cable in cables]
        if not all(on_cables):
            raise ValueError("a cable runs through no material point")
        joined = [set(through) for through in on_cables]
        groups = [{b} for b in {*on_anchors, *rubbed}.difference(*joined)]
        for bodies in joined:
            apart = [g for g in groups if not g & bodies]
            groups = [*apart, bodies.union(*(g for g in groups if g & bodies))]
        found = []
        for group in sorted(groups, key=min):
            a = [n for n, b in enumerate(on_anchors) if b in group]
            c = [n for n, through in enumerate(on_cables) if through[0] in group]
            f = [n for n, b in enumerate(rubbed) if b in group]
            rows = lay_out(anchors.slot[a], [cables[n].slot for n in c], frictions.slot[f])
            mesh, pieces = self._bodies, self._held_pieces(rows)
            if adrift := [nodes for p, nodes in enumerate(self._pieces) if p not in pieces]:
                mesh = mesh._replace(adrift=np.concatenate(adrift))
            found.append(_Group(sorted(group), a, c, f, rows, self._held(sorted(group), rows), pieces, mesh))
        return found

    def _held_pieces(self, rows: Rows) -> set[int]:
        """The loose pieces on which a material point in use is."""
        bears = self.compliance.slot_weights[rows.slots] != 0.0
        at = self.compliance.slot_nodes[rows.slots][bears]
        return {p for p, nodes in enumerate(self._pieces) if np.isin(nodes, at).any()}

    def _bodies_of(self, slots: np.ndarray) -> list[int]:
        found = [self.compliance.slot_body[slot] for slot in slots.tolist()]
        if FREE in found:
            raise ValueError("a slot is used that was dropped")
        return found

    def _rest(self, groups: list[_Group]) -> None:
        """Puts to rest the bodies that nothing holds: the only state without force that they have. Of a loose piece
        that is the nearest such state."""
        awake = {b for group in groups for b in group.bodies}
        for b, (lo, hi) in enumerate(self.compliance.nodes):
            if b not in awake and not self._at_rest[b]:
                tied = lo + np.flatnonzero(self._tied[lo:hi])
                self.x[tied] = self.mesh.rest[tied]
                self._memory.known[b] = 0
            self._at_rest[b] = b not in awake
        held = {p for group in groups for p in group.pieces}
        for p, nodes in enumerate(self._pieces):
            if p not in held and p not in self._still:
                self.x[nodes] = unstrained(self.mesh.rest[nodes], self.x[nodes])
                self._memory.known[self.compliance.body_of(int(nodes[0]))] = 0
        self._still = set(range(len(self._pieces))) - held

    def _base(self) -> Base:
        c = self.compliance
        return Base(tuple(c.factors), c.columns, c.slot_range, c.matrix)

    def _held(self, awake: list[int], rows: Rows) -> Held:
        """The arrays of one solve for the bodies ``awake``, kept for each size: a stitch has a few dozen."""
        u, c, k = len(rows.slots), len(rows.length), len(rows.cable_at)
        size = (u, c, k, *awake)
        if size not in self._scratch:
            self._scratch[size] = Held(
                awake=np.array(awake, dtype=np.int64),
                nodes=np.zeros((u, 3), dtype=np.int64),
                weights=np.zeros((u, 3)),
                multiplier=np.zeros(c),
                penalty=np.ones(c),
                row=np.zeros((k, 3)),
                point=np.zeros((u, 3)),
                force=np.zeros((u, 3)),
                matrix=np.zeros((3 * u, 3 * u)),
                stretch=np.zeros(c),
                taut=np.zeros(c, dtype=np.bool_),
                moved=np.zeros((PAIRS, u, 3)),
                pulled=np.zeros((PAIRS, u, 3)),
                rest=np.zeros((u, 3)),
                answer=np.zeros((u, 3)),
                at=np.zeros((u, 3)),
                system=np.zeros((3 * u, 3 * u)),
                curvature=np.zeros(PAIRS),
                share=np.zeros(PAIRS),
            )
        return self._scratch[size]


def _together(groups: list[_Group], parts: list[Result], anchors: int, cables: int) -> Result:
    """What was found for each of the groups, as one."""
    force, tension = np.zeros((anchors, 3)), np.zeros(cables)
    for group, part in zip(groups, parts, strict=True):
        force[group.anchors], tension[group.cables] = part.anchor_force, part.tension
    return Result(
        converged=all(part.converged for part in parts),
        iterations=sum(part.iterations for part in parts),
        residual_mN=math.hypot(*(part.residual_mN for part in parts)),
        reached=min((part.reached for part in parts), default=1.0),
        anchor_force=force,
        tension=tension,
        cable_error_mm=max((part.cable_error_mm for part in parts), default=0.0),
    )
