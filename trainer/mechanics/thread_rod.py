"""The thread as a dynamic inextensible rod: bending, rest curvature, weight, air, and holds that may give way.

A chain of n nodes with links of length d. A link's only stretch is the material's own, T / EA: parts in a million
under a suture's weight; the constraint carries it exactly, so that a thread pulled further than its length answers
with a tension that grows at that rate, up to a hold's limit, and never leaps. ``thread_rod_solve`` says what is
solved, ``thread_rod_step`` how time passes. Twist is not modelled: it is taken to run out at a free end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainer.geometry import Array
from trainer.mechanics.thread_rod_newton import NEAR, Contacts, Law, Work, solve
from trainer.mechanics.thread_rod_solve import BAND, WIDTH, directions
from trainer.mechanics.thread_rod_step import SLIPS_AT, advance, carry_frame

#: Kinematic viscosity, mm²/s, and dynamic viscosity, mN s/mm², of air at 20 °C (US Standard Atmosphere 1976, eq. 51).
AIR_KINEMATIC, AIR_DYNAMIC = 15.0, 1.81e-8
FIRST_FIRMNESS = 1e4  # 1/s²: the first step to an equilibrium gives way as inertia does in 10 ms; decides time only
MOST_FADES = 2000
LEAST_SHARE = 1e-4
AT_REST = 1e-9  # lengths of the rod: a step to an equilibrium that moves no node further is the last


class RodStalled(ArithmeticError):
    """No step, however short, or no equilibrium was found from here."""


@dataclass(frozen=True)
class RodModel:
    """What the rod is. Raises ValueError for a number out of its range or an array of another shape."""

    count: int  # nodes, at least 3
    link: float  # d, mm
    mass: float  # kg/mm
    bending: float  # EI, mN mm²
    axial: float  # EA, mN
    drag: float = 0.0  # mN s/mm²: force per length and speed
    gravity: tuple[float, float, float] = (0.0, 0.0, -9810.0)  # mm/s²
    curvature: Array | None = None  # (count, 2) 1/mm at rest about the carried frame, or None for a straight thread

    def __post_init__(self) -> None:
        if self.count < 3:
            raise ValueError(f"a rod of {self.count} nodes cannot bend: give 3 or more")
        for name, value, least in (
            ("link", self.link, True), ("mass", self.mass, True), ("axial", self.axial, True),
            ("bending", self.bending, False), ("drag", self.drag, False),
        ):  # fmt: skip
            if not (math.isfinite(value) and (value > 0.0 if least else value >= 0.0)):
                raise ValueError(f"a rod's {name} cannot be {value}: give a number {'above' if least else 'from'} 0")
        if not (len(self.gravity) == 3 and all(map(math.isfinite, self.gravity))):
            raise ValueError(f"gravity must be three finite numbers, not {self.gravity}")
        if self.curvature is not None and not (
            self.curvature.shape == (self.count, 2) and np.isfinite(self.curvature).all()
        ):
            raise ValueError(f"rest curvature must be finite and of shape ({self.count}, 2)")

    @property
    def length(self) -> float:
        """mm."""
        return (self.count - 1) * self.link

    def node_lengths(self) -> Array:
        """The length of thread (count,) mm that each node stands for."""
        lengths = np.full(self.count, self.link)
        lengths[[0, -1]] *= 0.5
        return lengths

    def law(self) -> Law:
        """The arrays that the kernels read."""
        lengths = self.node_lengths()
        curved = self.curvature is not None and bool(np.any(self.curvature))
        return Law(
            self.mass * lengths,
            self.drag * lengths,
            np.zeros((self.count, 2)) if self.curvature is None else np.ascontiguousarray(self.curvature),
            curved,
            self.bending / self.link**3,
            self.link / self.axial,
            self.link,
        )


def monofilament(
    diameter: float, density: float, modulus: float, length: float, count: int, in_air: bool = True
) -> RodModel:
    """A straight round rod: ``diameter`` mm, ``density`` kg/mm³, Young's ``modulus`` kPa, ``length`` mm.

    EI = E π D⁴ / 64, EA = E π D² / 4. Drag in air: Lamb's law of a slow cylinder across the stream, 4 π η /
    (½ - γ - ln(Re / 8)) per length and speed (Batchelor 1967, "An Introduction to Fluid Dynamics", section 4.10), taken
    at the speed U where it bears the weight; along the thread it would be half of that.
    """
    area = 0.25 * math.pi * diameter**2
    mass = density * area
    drag = 0.0
    if in_air:
        drag = 4.0 * math.pi * AIR_DYNAMIC
        for _ in range(20):
            reynolds = min(mass * 9810.0 / drag * diameter / AIR_KINEMATIC, 1.0)  # the law holds for slow streams
            drag = 4.0 * math.pi * AIR_DYNAMIC / (0.5 - 0.5772156649 - math.log(reynolds / 8.0))
    return RodModel(count, length / (count - 1), mass, modulus * area * diameter**2 / 16.0, modulus * area, drag)


def no_contacts(capacity: int = 0) -> Contacts:
    """Room for ``capacity`` contacts, none in use."""
    return Contacts(
        np.zeros(1, dtype=np.int64),
        np.zeros(capacity, dtype=np.int32),
        np.full(capacity, -1, dtype=np.int32),
        np.zeros((capacity, 2)),
        np.zeros((capacity, 3)),
        np.zeros(capacity),
        np.zeros((capacity, 3)),
        np.zeros(capacity),
        np.zeros(capacity),
        np.zeros((capacity, 3)),
        np.zeros(capacity),
    )


@dataclass(frozen=True)
class RodState:
    """Where the rod is and how it moves; ``step`` and ``settle`` change the arrays in place."""

    x: Array  # (n, 3) mm
    v: Array  # (n, 3) mm/s
    tension: Array  # (n,) mN of the link into each node, negative in compression; entry 0 is none
    load: Array  # (n, 3) mN on the nodes: weight, to which a caller may add
    frame: Array  # (3,) unit vector across the first link: the first direction of rest curvature
    outcome: Array  # (4,) of the last tick: substeps, iterations, refused steps, 1 if it stalled
    _x_before: Array
    _v_before: Array
    _clock: Array
    _law: Law
    _work: Work
    _none: Contacts = field(default_factory=no_contacts)


def _finite(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a number that is not finite")
    return array


def _across(x: Array) -> Array:
    """A unit vector (3,) across the first link, in the plane of the first bend if there is one, else upwards of it."""
    along = x[1] - x[0]
    size = float(np.linalg.norm(along))
    along = along / size if size > 0.0 else np.array([1.0, 0.0, 0.0])
    for second in (x[2] - x[1], *np.eye(3)[[2, 1]]):
        across = second - (second @ along) * along
        if np.linalg.norm(across) > 1e-6 * max(size, float(np.linalg.norm(second))):
            return np.ascontiguousarray(across / np.linalg.norm(across))
    raise AssertionError("two axes of space cannot both lie along one line")


def begin(model: RodModel, x: ArrayLike, v: ArrayLike | None = None, frame: ArrayLike | None = None) -> RodState:
    """A rod at places ``x`` (n, 3) mm with speeds ``v`` (n, 3) mm/s, at rest if not given.

    ``frame`` (3,) says what is across the first link (made exactly so); by default the plane of the first bend.
    A link that has not its length gets it along its direction (+x, or that of the link before, if it has none): node
    0 stays, and what is held elsewhere is drawn to its target by the first step. Raises ValueError for wrong shapes or
    numbers that are not finite.
    """
    n = model.count
    places = _finite("places", x, (n, 3)).copy()
    speeds = np.zeros((n, 3)) if v is None else _finite("speeds", v, (n, 3)).copy()
    across = _across(places)
    if frame is not None:
        given = _finite("the frame", frame, (3,))
        along = places[1] - places[0]
        given = given - (given @ along) / max(float(along @ along), 1e-300) * along
        if np.linalg.norm(given) < 1e-9:
            raise ValueError("the frame must not lie along the first link")
        across = given / np.linalg.norm(given)
    law = model.law()
    t, size = np.zeros((n, 3)), np.zeros(n)
    directions(places, t, size)
    if np.max(np.abs(size[1:] - model.link)) > 1e-9 * model.link:
        places[1:] = places[0] + np.cumsum(model.link * t[1:], axis=0)
    work = Work(
        np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((4 * n + BAND, WIDTH)),
        np.zeros(4 * n + BAND), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), places.copy(), np.zeros(n),
        np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, dtype=np.bool_), np.zeros(n), np.zeros((n, 3)),
    )  # fmt: skip
    load = law.mass[:, None] * np.array(model.gravity)
    return RodState(
        places, speeds, np.zeros(n), load, across, np.zeros(4), places.copy(), speeds.copy(), np.zeros(2), law, work
    )


@dataclass(frozen=True)
class Holds:
    """Which nodes are held, where to, and how firmly. Change ``target`` in place from tick to tick."""

    node: NDArray[np.int32]  # (k,) each once
    target: Array  # (k, 3) mm at the end of the tick
    limit: Array  # (k,) mN: what a hold can bear; past it the node lags behind its target, drawn by this force
    slips: NDArray[np.bool_]  # (k,) whether the limit was reached in the last tick
    bears: Array  # (k, 3) mN the force of the hold on the rod at the end of the last tick


def holds(model: RodModel, node: ArrayLike, target: ArrayLike, limit: ArrayLike | float = math.inf) -> Holds:
    """Holds of the nodes ``node`` (k,) at ``target`` (k, 3) mm, ``limit`` mN (one or k).

    Two neighbours held clamp the rod's direction. Raises ValueError for a node that is not there or is named twice, a
    limit below zero or not a number, a target that is not finite.
    """
    nodes = np.ascontiguousarray(node, dtype=np.int32).reshape(-1)
    if len(set(nodes.tolist())) < len(nodes) or np.any((nodes < 0) | (nodes >= model.count)):
        raise ValueError(f"held nodes must be different and from 0 to {model.count - 1}: {nodes.tolist()}")
    limits = np.broadcast_to(np.asarray(limit, dtype=np.float64), len(nodes)).copy()
    if not (limits >= 0.0).all():
        raise ValueError("a hold's limit must be 0 mN or more")
    places = _finite("targets", np.asarray(target, dtype=np.float64).reshape(-1, 3), (len(nodes), 3)).copy()
    return Holds(nodes, places, limits, np.zeros(len(nodes), dtype=np.bool_), np.zeros((len(nodes), 3)))


def step(state: RodState, held: Holds, tick: float, tolerance: float = 0.0, contacts: Contacts | None = None) -> None:
    """Let ``tick`` s pass. ``tolerance`` mm: the error a substep may make, 0 for one substep a tick.

    ``state.tension`` and ``held.bears`` say afterwards what the links and holds bear. With ``contacts`` (of
    ``thread_contact``) their pushes and friction are written into them. Raises ValueError for targets or loads that are
    not finite, a tick that is not above 0, RodStalled where no substep converges: the rod stays where it was last good.
    """
    if not (math.isfinite(tick) and tick > 0.0):
        raise ValueError(f"a tick cannot last {tick} s")
    if not (math.isfinite(tolerance) and tolerance >= 0.0):
        raise ValueError(f"a tolerance cannot be {tolerance} mm")
    if not np.isfinite(held.target).all():
        raise ValueError("a hold's target is not finite")
    if not np.isfinite(state.load).all():
        raise ValueError("a load on the rod is not finite")
    advance(
        state._law, state._work, state.load, state.x, state.v, state._x_before, state._v_before, state.tension,
        state._clock, state.frame, held.node, held.target, held.limit, held.slips, held.bears,
        state._none if contacts is None else contacts, tick, tolerance, state.outcome,
    )  # fmt: skip
    if state.outcome[3] != 0.0:
        raise RodStalled("no substep of the thread converged")


@dataclass(frozen=True)
class Settled:
    """How ``settle`` ended."""

    residual: float  # mN, the largest force that is left at a free node
    iterations: int


def settle(state: RodState, held: Holds, contacts: Contacts | None = None) -> Settled:
    """Bring the rod to rest: the equilibrium of bending, weight and holds that lies downhill of where it is.

    Proximal point steps (Rockafellar 1976, "Monotone operators and the proximal point algorithm"): each is the
    minimum of the energy plus ½ weight |x - before|², so that none goes uphill, and the weights fade eightfold
    from one to the next, until Newton's own convergence is left. A hold that would bear more than its limit lets its
    node go with that force. Speeds become 0. Raises ValueError for targets or loads that are not finite,
    RodStalled where no equilibrium is found: nothing holds a rod that falls, for example.
    """
    if not (np.isfinite(held.target).all() and np.isfinite(state.load).all()):
        raise ValueError("a hold's target or a load on the rod is not finite")
    law, work = state._law, state._work
    touching = state._none if contacts is None else contacts
    length = law.link * (len(state.x) - 1)
    before, tension = state.x.copy(), state.tension.copy()
    work.force[:] = state.load
    work.held[:] = False
    work.held[held.node] = True
    loose = held.slips
    loose[:] = False
    work.pull[:] = 0.0
    work.aim[held.node] = held.target
    firmness = FIRST_FIRMNESS
    share = 1.0  # of the way to the targets
    iterations = 0
    for _ in range(MOST_FADES):
        work.weight[:] = firmness * law.mass
        work.y[:] = work.begin[:] = work.x[:] = before
        work.x[held.node[~loose]] += share * (held.target - before[held.node])[~loose]
        work.tension[:] = tension
        spent = solve(law, work, state.frame, touching, 1.0, 1.0)
        iterations += abs(spent)
        if spent < 0:
            share *= 0.25
            firmness *= 8.0
            touching.push[:] = 0.0
            touching.grip[:] = 0.0
            if share < LEAST_SHARE:
                break
            continue
        carry_frame(law, before, work.x, state.frame)
        moved = work.x - before
        before, tension = work.x.copy(), work.tension.copy()
        held.bears[~loose] = -work.left[held.node[~loose]]
        drawn = held.node[loose]
        towards = held.target[loose] - work.x[drawn]
        far = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), NEAR * law.link)
        held.bears[loose] = work.pull[drawn, None] * towards / far
        excess = np.linalg.norm(held.bears, axis=1) - SLIPS_AT * held.limit
        if len(excess) and np.max(excess[~loose], initial=-1.0) > 0.0 and firmness < 1e-3 * FIRST_FIRMNESS:
            worst = int(np.argmax(np.where(loose, -1.0, excess)))
            loose[worst] = True
            work.held[held.node[worst]] = False
            work.pull[held.node[worst]] = held.limit[worst]
            firmness = FIRST_FIRMNESS
            continue
        if share < 1.0:
            share = min(2.0 * share, 1.0)
            continue
        furthest = float(np.max(np.abs(moved)))
        if furthest <= AT_REST * length and firmness < 1e-3 * FIRST_FIRMNESS:
            state.x[:], state.tension[:] = before, tension
            state._x_before[:] = before
            state.v[:] = state._v_before[:] = 0.0
            state._clock[:] = 0.0
            return Settled(float(np.max(np.abs(work.weight[:, None] * moved)[~work.held], initial=0.0)), iterations)
        firmness /= 8.0
    raise RodStalled("the thread found no equilibrium from here")
