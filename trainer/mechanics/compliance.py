"""How held material points answer to forces: kept factors of the bodies, and each point's influence columns.

A body's stiffness is factored at rest, and again at a deformed state when the old factor no longer serves. A thread
does that beside the solves, and the new factor is taken a fixed number of solves later, waited for if need be: when it
happens depends on what was solved, never on how fast the machine is.
"""

from __future__ import annotations

import os
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics import banded
from trainer.mechanics.links import LinkMesh, link_blocks
from trainer.mechanics.quasi_newton import at_points

#: A new factor is taken so many solves after it was begun.
LAG = 12
#: Solves for which a new factor is used before another one of the same body may be begun.
LASTS = 10
#: At rest no pivot is below 0.4 of the diagonal. A state in which one is below this is nearly or truly unstable.
LEAST_PIVOT = 0.05
#: A link that is cut keeps this share of its stiffness in new factors, and there alone: without it the matrix of a
#: piece that came off is singular. How many iterations slits take shows no trend from 0.02 to 0.4.
TIE = 0.2
#: In place of a slot's body: the slot holds nothing.
FREE = -1


@dataclass
class _Renewal:
    """A body's next factor, and the points that it will answer."""

    body: int
    due: int  # the number of the solve after which it is taken
    slots: np.ndarray  # (k,) held when it was begun …
    nodes: np.ndarray  # (k, 3)
    weights: Array  # (k, 3) … at these points
    done: Future[None] | None = None  # the thread's work


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
        # What the thread writes is there, and was written to, before it begins: to be given fresh memory takes a system
        # milliseconds now and then, in which nothing else goes on.
        rooms = [banded.room(mesh.links[lo:hi], orders[b], n, np.float32) for b, (lo, hi) in enumerate(self.links)]
        self._bands, self._next = [band for band, _ in rooms], [factor for _, factor in rooms]
        self._blocks = np.full((max(hi - lo for lo, hi in self.links), 3, 3), 0.0)
        self._stiffness = mesh.stiffness.copy()  # what the next factor is made of
        self._at, self._of = mesh.rest.copy(), mesh.stiffness.copy()  # state and stiffness of the factor under way
        self.outdated: set[int] = set()  # bodies that were cut since their last factor was begun
        self.factors = [
            banded.factor(self._blocks_at_rest(b), mesh.links[lo:hi], orders[b], n)
            for b, (lo, hi) in enumerate(self.links)
        ]
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="factor", initializer=_give_way)
        self._thread.submit(_begin)  # a thread that began now is there when a session places its threads
        self._push, self._v = np.zeros((n, 3)), banded.scratch(self.factors)
        self._thread_push, self._thread_v = self._push.copy(), self._v.copy()
        self._free: list[int] = []
        self.slot_nodes = np.zeros((0, 3), dtype=np.int64)
        self.slot_weights = np.zeros((0, 3))
        self.slot_body: list[int] = []  # FREE for a slot that is
        self.slot_range = np.zeros((0, 2), dtype=np.int64)  # rows of the nodes of the slot's body
        self.columns = np.zeros((0, 3, n, 3), dtype=np.float32)  # K⁻¹ Wᵀ, mm/mN
        self._next_columns = self.columns
        self.matrix = np.zeros((0, 0))  # W K⁻¹ Wᵀ over all slots
        self._age = [LASTS] * len(orders)  # how many solves ago each body's factor was made
        self._renewal: _Renewal | None = None  # under way
        self._solves = 0
        self._more_slots()

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
        answers(
            self.slot_nodes[slot], self.slot_weights[slot], self.factors[body], self._push, self._v, self.columns[slot]
        )
        self._couple(slot)
        return slot

    def drop(self, slot: int) -> None:
        """Gives the slot back; its number may be given out again."""
        self.slot_weights[slot] = 0.0
        self.slot_body[slot] = FREE
        self._free.append(slot)
        self._free.sort()

    def cut(self, links: np.ndarray) -> list[int]:
        """Leaves the ``links`` (k,) out of the factors that are begun from now on; returns the bodies that lost one.

        The factor that is there goes on as the base: it is that of a stiffer mesh, and leads down all the same.
        """
        self._stiffness[links] = TIE * self._mesh.stiffness[links]
        bodies = [b for b, (lo, hi) in enumerate(self.links) if np.any((lo <= links) & (links < hi))]
        self.outdated.update(bodies)
        return bodies

    def refresh(self, bodies: list[int], x: Array) -> None:
        """Begins to factor one of ``bodies`` at ``x`` (n, 3), one that was cut or that of the oldest factor; unless one
        is under way, or none was cut or is older than LASTS."""
        if self._renewal is not None or not bodies:
            return
        body = max(bodies, key=lambda b: (b in self.outdated, self._age[b], -b))
        if self._age[body] < LASTS and body not in self.outdated:
            return
        self.outdated.discard(body)
        slots = np.array([slot for slot, of in enumerate(self.slot_body) if of == body], dtype=np.int64)
        self._at[:], self._of[:] = x, self._stiffness
        self._renewal = _Renewal(
            body, self._solves + LAG, slots, self.slot_nodes[slots].copy(), self.slot_weights[slots].copy()
        )

    def start(self) -> None:
        """Sets the thread to the work that :meth:`refresh` prepared. To be called when the caller is about to be busy
        in a kernel: one that goes on in Python wakes the thread on its own core, and waits for it."""
        renewal = self._renewal
        if renewal is None or renewal.done is not None:
            return
        m, (lo, hi) = self._mesh, self.links[renewal.body]
        renewal.done = self._thread.submit(
            renew, self._at, m.links[lo:hi], m.rest_length[lo:hi], self._of[lo:hi], self._blocks[: hi - lo],
            self._bands[renewal.body], self._next[renewal.body], renewal.slots, renewal.nodes, renewal.weights,
            self._thread_push, self._thread_v, self._next_columns,
        )  # fmt: skip

    def advance(self) -> None:
        """Counts a solve; when the work that :meth:`refresh` prepared is due, takes the new factor and columns."""
        self._solves += 1
        self._age = [age + 1 for age in self._age]
        renewal = self._renewal
        if renewal is None or self._solves < renewal.due:
            return
        self._finish(renewal)
        body = renewal.body
        lo, hi = self.nodes[body]
        self.factors[body], self._next[body] = self._next[body], self.factors[body]
        known = {int(s): (n, w) for s, n, w in zip(renewal.slots, renewal.nodes, renewal.weights, strict=True)}
        held = [slot for slot, of in enumerate(self.slot_body) if of == body]
        for slot in held:
            nodes, weights = self.slot_nodes[slot], self.slot_weights[slot]
            if slot in known and all(map(np.array_equal, known[slot], (nodes, weights))):
                self.columns[slot, :, lo:hi] = self._next_columns[slot, :, lo:hi]
            else:  # held since the renewal began
                answers(nodes, weights, self.factors[body], self._push, self._v, self.columns[slot])
        for slot in held:
            self._couple(slot)
        self._age[body] = 0
        self._renewal = None

    def _finish(self, renewal: _Renewal) -> None:
        self.start()
        assert renewal.done is not None
        renewal.done.result()

    def _blocks_at_rest(self, body: int) -> Array:
        m, (lo, hi) = self._mesh, self.links[body]
        out = self._blocks[: hi - lo]
        link_blocks(m.rest, m.links[lo:hi], m.rest_length[lo:hi], m.stiffness[lo:hi], False, out)
        return out

    def _couple(self, slot: int) -> None:
        mean = np.zeros((len(self.slot_nodes), 3))
        for r in range(3):
            at_points(self.columns[slot, r], self.slot_nodes, self.slot_weights, mean)
            self.matrix[:, 3 * slot + r] = mean.ravel()
            self.matrix[3 * slot + r, :] = mean.ravel()

    def _more_slots(self) -> None:
        old = len(self.slot_nodes)
        new = max(16, 2 * old)
        if self._renewal is not None:
            self._finish(self._renewal)  # it writes to the columns that are about to be moved
        self._free = list(range(old, new))
        self.slot_body += [FREE] * (new - old)
        self.slot_nodes = _grown(self.slot_nodes, (new, 3))
        self.slot_weights = _grown(self.slot_weights, (new, 3))
        self.slot_range = _grown(self.slot_range, (new, 2))
        self.columns = _grown(self.columns, (new, *self.columns.shape[1:]))
        self._next_columns = _grown(self._next_columns, self.columns.shape)
        self.matrix = _grown(self.matrix, (3 * new, 3 * new))


def _begin() -> None:
    """The thread's first work: none."""


def _give_way() -> None:
    """Where threads have priorities of their own (Linux), this one yields to the solves, which often share its core."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)


@njit(cache=True, nogil=True, error_model="numpy")
def answers(
    nodes: np.ndarray, weights: Array, factor: banded.BandedFactor, push: Array, v: np.ndarray, out: np.ndarray
) -> None:
    """The displacements ``out`` (3, n, 3) of all nodes by a unit force along x, y and z on the mean of ``nodes`` (3,)
    with ``weights`` (3,). ``push`` (n, 3) is zero, and is left so; overwrites ``v``, see :func:`banded.solve`."""
    for r in range(3):
        for k in range(3):
            push[nodes[k], r] += weights[k]
        out[r] = 0.0
        banded.solve(factor, push, v, out[r])
        for k in range(3):
            push[nodes[k], r] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def renew(
    x: Array,
    links: np.ndarray,
    rest_length: Array,
    stiffness: Array,
    blocks: Array,
    band: banded.Band,
    factor: banded.BandedFactor,
    slots: np.ndarray,
    nodes: np.ndarray,
    weights: Array,
    push: Array,
    v: np.ndarray,
    columns: np.ndarray,
) -> None:
    """A body's ``factor`` at ``x`` (n, 3), and the ``columns`` (slots, 3, n, 3) of the points in ``slots`` (k,)."""
    link_blocks(x, links, rest_length, stiffness, False, blocks)
    if banded.factor_blocks(blocks, band, factor, LEAST_PIVOT):
        # Shortened links make the plain stiffness indefinite here; without their softening it is not.
        link_blocks(x, links, rest_length, stiffness, True, blocks)
        banded.factor_blocks(blocks, band, factor, LEAST_PIVOT)
    for k in range(len(slots)):
        answers(nodes[k], weights[k], factor, push, v, columns[slots[k]])


def _grown(a: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    out = np.full(shape, a.dtype.type(0))
    out[tuple(slice(0, k) for k in a.shape)] = a
    return out
