"""How held material points answer to forces: kept factors of the bodies, and each point's influence columns.

A body's stiffness is factored at rest, and may be factored again at a deformed state when the old factor no longer
serves: a slice of the elimination at each tick, then one point's columns at each tick, so that no tick pays for it.
"""

from __future__ import annotations

import numpy as np

from trainer.geometry import Array
from trainer.mechanics import banded
from trainer.mechanics.links import LinkMesh, link_blocks
from trainer.mechanics.quasi_newton import at_points

#: Slices into which a new factorisation is divided.
SLICES = 10
#: Solves for which a new factor is used before another one of the same body may be begun.
LASTS = 2
#: At rest no pivot is below 0.4 of the diagonal. A state in which one is below this is nearly or truly unstable.
LEAST_PIVOT = 0.05
#: In place of a slot's body: the slot holds nothing.
FREE = -1


class Compliance:
    """Factors of bodies, which follow one another in the numbering of nodes and links, and the slots of held points."""

    def __init__(self, mesh: LinkMesh, orders: tuple[np.ndarray, ...]) -> None:
        """``orders``: each body's free nodes in elimination order. Raises ValueError when a free node can move without
        stretching a link."""
        n = len(mesh.rest)
        self._mesh = mesh
        owner = np.full(n, -1)
        for b, order in enumerate(orders):
            owner[order] = b
        reaches = owner[mesh.links].max(axis=1)  # a link belongs to the body of a free node that it moves
        self._first = np.array([int(mesh.links[reaches == b].min()) for b in range(len(orders))])
        self.nodes = [(int(o.min()), int(o.max()) + 1) for o in orders]  # rows of each body's free nodes
        body = self.body_of(mesh.links.min(axis=1))
        at = [np.flatnonzero(body == b) for b in range(len(orders))]
        self.links = [(int(r[0]), int(r[-1]) + 1) for r in at]
        self.factors = [
            banded.factor(self._stiffness(b, mesh.rest, False), mesh.links[lo:hi], orders[b], n)
            for b, (lo, hi) in enumerate(self.links)
        ]
        # The next factor of each body.
        self._next = [banded.Factoring(mesh.links[lo:hi], orders[b], n) for b, (lo, hi) in enumerate(self.links)]
        self._v = np.zeros(3 * max(len(order) for order in orders), dtype=np.float32)
        self._push = np.zeros((n, 3))
        self._free: list[int] = []
        self.slot_nodes = np.zeros((0, 3), dtype=np.int64)
        self.slot_weights = np.zeros((0, 3))
        self.slot_body: list[int] = []  # FREE for a slot that is
        self.slot_range = np.zeros((0, 2), dtype=np.int64)  # rows of the nodes of the slot's body
        self.columns = np.zeros((0, 3, n, 3))  # K⁻¹ Wᵀ, mm per mN
        self.matrix = np.zeros((0, 0))  # W K⁻¹ Wᵀ over all slots
        self._age = [LASTS] * len(orders)  # how many solves ago each body's factor was made
        self._under_way: int | None = None  # the body whose next factor is being made
        self._at = mesh.rest.copy()  # … at this state
        self._projected = False
        self._ready: dict[int, Array] = {}  # columns for the factor under way

    def body_of(self, node: np.ndarray | int) -> np.ndarray:
        """The body to which a node (or each of some nodes) belongs."""
        return np.asarray(np.searchsorted(self._first, node, side="right") - 1)

    def hold(self, nodes: np.ndarray, weights: Array) -> int:
        """A slot for the mean of ``nodes`` (3,), all of one body, with ``weights`` (3,)."""
        if not self._free:
            self._more_slots()
        slot = self._free.pop(0)
        body = int(self.body_of(int(nodes[0])))
        self.slot_nodes[slot] = nodes
        self.slot_weights[slot] = weights
        self.slot_range[slot] = self.nodes[body]
        self.slot_body[slot] = body
        self._answers(slot, self.factors[body], self.columns[slot])
        self._couple(slot)
        return slot

    def drop(self, slot: int) -> None:
        """Gives the slot back; its number may be given out again."""
        self.slot_weights[slot] = 0.0
        self.slot_body[slot] = FREE
        self._ready.pop(slot, None)
        self._free.append(slot)
        self._free.sort()

    def refresh(self, bodies: list[int], x: Array) -> None:
        """Begins to factor one of ``bodies`` at ``x`` (n, 3), that of the oldest factor; unless one is under way, or
        none is older than LASTS."""
        if self._under_way is not None or not bodies:
            return
        body = max(bodies, key=lambda b: (self._age[b], -b))
        if self._age[body] < LASTS:
            return
        self._at[:] = x
        self._begin(body, project=False)

    def advance(self) -> None:
        """One slice of the work that :meth:`refresh` began; the last one changes the factor and the columns."""
        self._age = [age + 1 for age in self._age]
        body = self._under_way
        if body is None:
            return
        work = self._next[body]
        complete = work.advance(-(-len(work.factor.inverse) // SLICES), LEAST_PIVOT)
        if work.replaced and not self._projected:
            # Shortened links make the plain stiffness indefinite here; without their softening it is not.
            self._begin(body, project=True)
            return
        if not complete:
            return
        held = [slot for slot, of in enumerate(self.slot_body) if of == body]
        waiting = [slot for slot in held if slot not in self._ready]
        if waiting:
            self._ready[waiting[0]] = np.zeros(self.columns.shape[1:])
            self._answers(waiting[0], work.factor, self._ready[waiting[0]])
            return
        self.factors[body], work.factor = work.factor, self.factors[body]
        for slot in held:
            self.columns[slot] = self._ready[slot]
        for slot in held:
            self._couple(slot)
        self._age[body] = 0
        self._under_way = None
        self._ready = {}

    def _begin(self, body: int, project: bool) -> None:
        self._under_way, self._projected = body, project
        self._next[body].begin(self._stiffness(body, self._at, project))

    def _stiffness(self, body: int, x: Array, project: bool) -> Array:
        """The blocks (m, 3, 3) of the body's links at ``x``."""
        m, (lo, hi) = self._mesh, self.links[body]
        out = np.zeros((hi - lo, 3, 3))
        link_blocks(x, m.links[lo:hi], m.rest_length[lo:hi], m.stiffness[lo:hi], project, out)
        return out

    def _answers(self, slot: int, factor: banded.BandedFactor, out: Array) -> None:
        """The displacements ``out`` (3, n, 3) of all nodes by a unit force on the slot along x, y and z."""
        out[:] = 0.0
        nodes, push = self.slot_nodes[slot], self._push
        for r in range(3):
            push[nodes] = 0.0
            np.add.at(push[:, r], nodes, self.slot_weights[slot])
            banded.solve(factor, push, self._v, out[r])
        push[nodes] = 0.0

    def _couple(self, slot: int) -> None:
        mean = np.zeros((len(self.slot_nodes), 3))
        for r in range(3):
            at_points(self.columns[slot, r], self.slot_nodes, self.slot_weights, mean)
            self.matrix[:, 3 * slot + r] = mean.ravel()
            self.matrix[3 * slot + r, :] = mean.ravel()

    def _more_slots(self) -> None:
        old = len(self.slot_nodes)
        new = max(8, 2 * old)
        self._free = list(range(old, new))
        self.slot_body += [FREE] * (new - old)
        self.slot_nodes = _grown(self.slot_nodes, (new, 3))
        self.slot_weights = _grown(self.slot_weights, (new, 3))
        self.slot_range = _grown(self.slot_range, (new, 2))
        self.columns = _grown(self.columns, (new, *self.columns.shape[1:]))
        self.matrix = _grown(self.matrix, (3 * new, 3 * new))


def _grown(a: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    out = np.zeros(shape, dtype=a.dtype)
    out[tuple(slice(0, k) for k in a.shape)] = a
    return out
