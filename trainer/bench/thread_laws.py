"""The laws that a thread obeys at every tick, by whatever method it moves; see :mod:`trainer.bench.hard_thread`.

*Lengths.* Only its own tension may stretch a link, by T / EA (the rod says what its tension is). What is beyond that is
error, 1e-6 of the link at most: what is asked of the program's threads. Both are told, since a stretch of 15 % by a
tension of 0.15 EA is no error and is still seen.

*Energy.* In a tick in which all that holds the thread goes the same way at the same speed w, or rests, it does no work
in the frame that goes with it; nor does a rigid link. So kinetic, bending and stretching energy grow by what weight
gives, and the air at most ``sum(c) w² / 4`` a second (c (u · w - u²) at its greatest over u). What a case gains beyond
that, over all its ticks, is at most what lifts the thread by ``ERROR`` of its length, the place error that a step may
make. A method that leaps gains many times that.

*Leading.* Where there is no speed, in the paper's follow-the-leader, no node goes further than what leads it: the
distance to a leader's new place differs from the link's length by no more than the leader's own way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trainer.geometry import Array
from trainer.mechanics.thread import ThreadModel, follow
from trainer.mechanics.thread_chain import begin_chain, step_chain
from trainer.mechanics.thread_contact import clear
from trainer.mechanics.thread_rod import Holds, RodModel, begin, holds, step
from trainer.mechanics.thread_rod_newton import Contacts
from trainer.mechanics.thread_xpbd import begin_xpbd, step_xpbd

LENGTH, ERROR = 1e-6, 5e-3
#: XPBD's substep, s: a thousand a tick at 100 Hz, beyond which it is no longer in real time at 200 links.
SUBSTEP_S = 1e-5
#: The chain takes its hold along a cubic, which is straight again so many ticks after it rests.
CUBIC = 3


class Thread(Protocol):
    """A thread moved by one method; ``held.target`` is changed between ticks."""

    name: str
    model: RodModel
    held: Holds
    tells: bool  # whether the method says when it did not come right
    inert: bool  # whether it has speeds
    uniform: bool  # whether a hold goes to its target at one speed

    @property
    def x(self) -> Array: ...

    @property
    def v(self) -> Array: ...

    def strain(self) -> Array:
        """(n - 1,) what its own tension makes of each link."""

    def go(self, tick_s: float) -> None: ...


class Rod:
    """The rod, one substep a tick."""

    name, tells, inert, uniform = "rod", True, True, True

    def __init__(
        self, model: RodModel, x: Array, nodes: list[int], limit: float = math.inf, contacts: Contacts | None = None
    ) -> None:
        self.model, self.state, self.contacts = model, begin(model, x), contacts
        self.held = holds(model, nodes, x[nodes], limit)

    @property
    def x(self) -> Array:
        return self.state.x

    @property
    def v(self) -> Array:
        return self.state.v

    def strain(self) -> Array:
        return self.state.tension[1:] / self.model.axial

    def go(self, tick_s: float) -> None:
        step(self.state, self.held, tick_s, contacts=self.contacts)
        if self.contacts is not None:
            clear(self.contacts)


class Chain:
    """The bare chain, which is refused what a rigid chain cannot do."""

    name, tells, inert, uniform = "chain", True, True, False

    def __init__(self, model: RodModel, x: Array, nodes: list[int], limit: float = math.inf) -> None:
        self.model, self.state = model, begin_chain(model, x)
        self.held = holds(model, nodes, x[nodes], limit)

    @property
    def x(self) -> Array:
        return self.state.x

    @property
    def v(self) -> Array:
        return self.state.v

    def strain(self) -> Array:
        return np.zeros(self.model.count - 1)

    def go(self, tick_s: float) -> None:
        step_chain(self.model, self.state, self.held, tick_s)


class Beads:
    """XPBD, one sweep a substep. It cannot say whether its sweeps were enough, so the laws say it."""

    name, tells, inert, uniform = f"XPBD, substeps of {1e6 * SUBSTEP_S:g} µs", False, True, True

    def __init__(self, model: RodModel, x: Array, nodes: list[int]) -> None:
        self.model, self.state = model, begin_xpbd(model, x)
        self.held = holds(model, nodes, x[nodes])

    @property
    def x(self) -> Array:
        return self.state.x

    @property
    def v(self) -> Array:
        return self.state.v

    def strain(self) -> Array:
        return np.zeros(self.model.count - 1)

    def go(self, tick_s: float) -> None:
        step_xpbd(self.model, self.state, self.held, tick_s, round(tick_s / SUBSTEP_S))


class Leader:
    """The paper's follow-the-leader; ``lacking`` mm says what thread its last tick was short of."""

    name, tells, inert, uniform = "follow-the-leader", True, False, True

    def __init__(self, model: RodModel, x: Array, nodes: list[int]) -> None:
        self.model, self.places, self.lacking = model, np.array(x), 0.0
        self.thread = ThreadModel(0.0, model.link, model.count)
        self.held = holds(model, nodes, x[nodes])

    @property
    def x(self) -> Array:
        return self.places

    @property
    def v(self) -> Array:
        return np.zeros_like(self.places)

    def strain(self) -> Array:
        """What it says that it lacks, shared by the links of its only span."""
        links = int(self.held.node[-1] - self.held.node[0])
        return np.full(self.model.count - 1, self.lacking / (links * self.model.link) if self.lacking else 0.0)

    def go(self, tick_s: float) -> None:
        arcs = self.model.link * self.held.node.astype(np.float64)
        self.lacking = float(np.max(follow(self.thread, self.places, arcs, self.held.target, self.thread.whole())))


def energy(model: RodModel, x: Array, v: Array, w: Array) -> float:
    """Kinetic in the frame of w (3,) mm/s, of weight, bending and stretching, mN mm, of a thread straight at rest."""
    law = model.law()
    ways, bends = np.diff(x, axis=0), x[2:] - 2.0 * x[1:-1] + x[:-2]
    stretch = np.linalg.norm(ways, axis=1) - model.link
    return float(
        0.5 * np.sum(law.mass * np.sum((v - w) ** 2, axis=1))
        - np.sum(law.mass @ x * np.array(model.gravity))
        + 0.5 * law.bend * np.sum(bends**2)
        + 0.5 * model.axial / model.link * np.sum(stretch**2)
    )


@dataclass
class Watch:
    """A thread, and the worst that the laws have found in it."""

    thread: Thread
    length: float = 0.0  # largest relative error of a link's length, as it is
    beyond: float = 0.0  # … beyond its own strain
    gained: float = 0.0  # energy over weight times length, summed over the ticks that gained
    furthest: float = 0.0  # mm, that a node went in a tick
    rested: int = CUBIC

    def tick(self, tick_s: float) -> None:
        """One tick. Raises AssertionError for a number that is not finite."""
        thread, model = self.thread, self.thread.model
        before, speed, ends = thread.x.copy(), thread.v.copy(), thread.x[thread.held.node].copy()
        ways = thread.held.target - ends
        thread.go(tick_s)
        assert np.isfinite(thread.x).all(), "a place is not finite"
        assert np.isfinite(thread.v).all(), "a speed is not finite"
        error = np.linalg.norm(np.diff(thread.x, axis=0), axis=1) / model.link - 1.0
        self.length = max(self.length, float(np.max(np.abs(error))))
        self.beyond = max(self.beyond, float(np.max(np.abs(error - thread.strain()))))
        moved = float(np.max(np.linalg.norm(thread.x - before, axis=1)))
        self.furthest = max(self.furthest, moved)
        if not thread.inert:
            led = float(np.max(np.linalg.norm(ways, axis=1)))
            assert moved <= led + 1e-9 * model.length or len(ways) > 1, f"a node goes {moved - led:.2g} mm too far"
            return
        w = np.zeros(3) if len(ways) == 0 else ways[0] / tick_s
        self.rested = 0 if np.any(ways) else self.rested + 1
        if len(ways) > 1 and np.ptp(ways, axis=0).any():
            return  # the holds do work on one another
        if not thread.uniform and self.rested < CUBIC:
            return
        law = model.law()
        weight = float(np.sum(law.mass)) * np.array(model.gravity)
        in_frame = weight @ w - 0.25 * float(np.sum(law.drag)) * (w @ w)
        grown = energy(model, thread.x, thread.v, w) - energy(model, before, speed, w) + float(in_frame) * tick_s
        self.gained += max(0.0, grown) / (float(np.linalg.norm(weight)) * model.length)

    def broken(self) -> str:
        """The law that does not hold, with a number; "" where all do."""
        if self.beyond > LENGTH:
            return f"a link is off its length by {self.beyond:.1e}"
        if self.gained > ERROR:
            return f"it gained {self.gained:.1e} of what would lift it by its length"
        return ""

    def words(self) -> str:
        energy = f"; energy gained: {self.gained:.0e}" if self.thread.inert else ""
        if self.length <= 2.0 * self.beyond:
            return f"lengths to {self.length:.0e}{energy}"
        return f"lengths to {self.length:.0e}, to {self.beyond:.0e} beyond what tension does{energy}"


def ended(*watches: Watch, words: str = "") -> str:
    """ "ok: …", or of a method that cannot tell "not converged: …". Raises AssertionError where one that can broke a
    law."""
    worst = max(watches, key=lambda w: (w.beyond > LENGTH, w.gained > ERROR, w.beyond))
    if broken := worst.broken():
        assert not worst.thread.tells, broken
        return f"not converged: {worst.thread.model.count - 1} links, {broken}"
    merged = Watch(
        worst.thread, max(w.length for w in watches), max(w.beyond for w in watches), max(w.gained for w in watches)
    )
    return "ok: " + "; ".join(filter(None, (words, merged.words())))
