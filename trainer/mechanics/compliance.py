"""How held material points answer to forces: kept factors of the bodies, and each point's influence columns.

A body's stiffness is factored at rest, and again at a deformed state when the old factor no longer serves. A thread
does that beside the solves, and the new factor is taken a fixed number of solves later, waited for if need be: when it
happens depends on what was solved, never on how fast the machine is.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array
from trainer.mechanics import banded
from trainer.mechanics.links import LinkMesh, link_blocks
from trainer.mechanics.quasi_newton import at_points

#: A new factor is taken so many solves after it was begun.
LAG = 3
#: Solves for which a new factor is used before another one of the same body may be begun.
LASTS = 2
#: At rest no pivot is below 0.4 of the diagonal. A state in which one is below this is nearly or truly unstable.
LEAST_PIVOT = 0.05
#: In place of a slot's body: the slot holds nothing.
FREE = -1


class _Scratch:
    """What a thread overwrites in a solve."""

    def __init__(self, mesh: LinkMesh, orders: tuple[np.ndarray, ...]) -> None:
        self.push = np.zeros((len(mesh.rest), 3))
        self.v = np.zeros(3 * max(len(order) for order in orders), dtype=np.float32)


@dataclass(frozen=True)
class _Renewal:
    """A body's next factor as it will be, and whom it will answer."""

    body: int
    due: int  # solves from its beginning until it is taken
    points: dict[int, tuple[np.ndarray, Array]]  # slot → its nodes and weights when the renewal began
    columns: Future[dict[int, Array]]  # slot → (3, n, 3) mm/mN; the factor is complete when they are


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
        # Each body's next factor, and what the thread that makes it works with.
        self._next = [banded.Factoring(mesh.links[lo:hi], orders[b], n) for b, (lo, hi) in enumerate(self.links)]
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="factor")
        self._here, self._there = _Scratch(mesh, orders), _Scratch(mesh, orders)
        self._free: list[int] = []
        self.slot_nodes = np.zeros((0, 3), dtype=np.int64)
        self.slot_weights = np.zeros((0, 3))
        self.slot_body: list[int] = []  # FREE for a slot that is
        self.slot_range = np.zeros((0, 2), dtype=np.int64)  # rows of the nodes of the slot's body
        self.columns = np.zeros((0, 3, n, 3))  # K⁻¹ Wᵀ, mm per mN
        self.matrix = np.zeros((0, 0))  # W K⁻¹ Wᵀ over all slots
        self._age = [LASTS] * len(orders)  # how many solves ago each body's factor was made
        self._renewal: _Renewal | None = None  # under way
        self._solves = 0

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
        _answers(nodes, weights, self.factors[body], self.columns[slot], self._here)
        self._couple(slot)
        return slot

    def drop(self, slot: int) -> None:
        """Gives the slot back; its number may be given out again."""
        self.slot_weights[slot] = 0.0
        self.slot_body[slot] = FREE
        self._free.append(slot)
        self._free.sort()

    def refresh(self, bodies: list[int], x: Array) -> None:
        """Begins to factor one of ``bodies`` at ``x`` (n, 3), that of the oldest factor; unless one is under way, or
        none is older than LASTS."""
        if self._renewal is not None or not bodies:
            return
        body = max(bodies, key=lambda b: (self._age[b], -b))
        if self._age[body] < LASTS:
            return
        points = {
            slot: (self.slot_nodes[slot].copy(), self.slot_weights[slot].copy())
            for slot, of in enumerate(self.slot_body)
            if of == body
        }
        columns = self._thread.submit(self._renew, body, x.copy(), points)
        self._renewal = _Renewal(body, self._solves + LAG, points, columns)

    def advance(self) -> None:
        """Counts a solve; when the work that :meth:`refresh` began is due, takes the new factor and columns."""
        self._solves += 1
        self._age = [age + 1 for age in self._age]
        renewal = self._renewal
        if renewal is None or self._solves < renewal.due:
            return
        body, columns = renewal.body, renewal.columns.result()
        (lo, hi), work = self.nodes[body], self._next[body]
        self.factors[body], work.factor = work.factor, self.factors[body]
        held = [slot for slot, of in enumerate(self.slot_body) if of == body]
        for slot in held:
            nodes, weights = self.slot_nodes[slot], self.slot_weights[slot]
            if slot in columns and all(map(np.array_equal, renewal.points[slot], (nodes, weights))):
                self.columns[slot, :, lo:hi] = columns[slot][:, lo:hi]
            else:  # held since the renewal began
                _answers(nodes, weights, self.factors[body], self.columns[slot], self._here)
        for slot in held:
            self._couple(slot)
        self._age[body] = 0
        self._renewal = None

    def _renew(self, body: int, x: Array, points: dict[int, tuple[np.ndarray, Array]]) -> dict[int, Array]:
        """In the thread: the body's factor at ``x`` (n, 3), and the columns of the points held."""
        work = self._next[body]
        work.begin(self._stiffness(body, x, False))
        work.advance(len(work.factor.inverse), LEAST_PIVOT)
        if work.replaced:
            # Shortened links make the plain stiffness indefinite here; without their softening it is not.
            work.begin(self._stiffness(body, x, True))
            work.advance(len(work.factor.inverse), LEAST_PIVOT)
        columns = {slot: np.zeros(self.columns.shape[1:]) for slot in points}
        for slot, (nodes, weights) in points.items():
            _answers(nodes, weights, work.factor, columns[slot], self._there)
        return columns

    def _stiffness(self, body: int, x: Array, project: bool) -> Array:
        """The blocks (m, 3, 3) of the body's links at ``x``."""
        m, (lo, hi) = self._mesh, self.links[body]
        out = np.zeros((hi - lo, 3, 3))
        link_blocks(x, m.links[lo:hi], m.rest_length[lo:hi], m.stiffness[lo:hi], project, out)
        return out

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


def _answers(nodes: np.ndarray, weights: Array, factor: banded.BandedFactor, out: Array, scratch: _Scratch) -> None:
    """The displacements ``out`` (3, n, 3) of all nodes by a unit force along x, y and z on the mean of ``nodes`` (3,)
    with ``weights`` (3,)."""
    out[:] = 0.0
    push = scratch.push
    for r in range(3):
        push[nodes] = 0.0
        np.add.at(push[:, r], nodes, weights)
        banded.solve(factor, push, scratch.v, out[r])
    push[nodes] = 0.0


def _grown(a: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    out = np.zeros(shape, dtype=a.dtype)
    out[tuple(slice(0, k) for k in a.shape)] = a
    return out
