"""Hard cases for integration in time: what each method makes of states and steps that no one should ask for.

The law in all of them: a method either says in one line why it refuses, or what it leaves behind is finite and has no
more mechanical energy than it was given: kinetic energy, energy of the links, and the work of a hand that moves nodes.
No gravity acts, but where a node falls, and drag and dashpots only take energy. 1 % is allowed for the turning of the
links, to which the linear stability of a step does not apply.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from trainer.bench.integrators import TOLERANCE_MM2, MODULI_kPa, tube
from trainer.geometry import Array
from trainer.mechanics.dynamics import Model, State, at_rest, mechanical_energy, model
from trainer.mechanics.implicit_euler import BackwardEuler
from trainer.mechanics.integrators import METHODS, Explicit, Method
from trainer.mechanics.link_law import j_shaped
from trainer.mechanics.links import LinkMesh, link_mesh

Integrator = Explicit | BackwardEuler
Make = Callable[[Model, np.ndarray], Integrator]
Case = tuple[str, str, Callable[[], str]]

#: Drag over mass, 1/s, of the cases that are not the soft vessel's. Assumed.
DRAG = 100.0
MOST_ENERGY = 1.01
WEIGHTLESS = (0.0, 0.0, 0.0)


def makers() -> dict[str, Make]:
    """How each method is set to work on a model with held nodes (n,)."""
    made: dict[str, Make] = {}
    for method in METHODS:
        made[method.name] = partial(_explicit, method)
    for name, newton_steps in (("linear backward Euler", 1), ("backward Euler", 30)):
        made[name] = partial(_implicit, newton_steps)
    return made


def _explicit(method: Method, made: Model, held: np.ndarray) -> Integrator:
    return Explicit(made, method, held)


def _implicit(newton_steps: int, made: Model, held: np.ndarray) -> Integrator:
    return BackwardEuler(made, tolerance_mN=TOLERANCE_MM2 * MODULI_kPa["soft"], newton_steps=newton_steps)


def cases() -> list[Case]:
    """Each case with each method: (case, method, run); a run answers in a line, or raises AssertionError."""
    found: list[Case] = []
    for name, make in makers().items():
        for what, begin in BEGINNINGS.items():
            for step_s, steps in ((1e-3, 50), (50e-3, 2)):
                found.append(
                    (f"{what}, steps of {step_s * 1e3:g} ms", name, partial(swing, begin, make, step_s, steps))
                )
        for bad in (math.nan, math.inf, -math.inf):
            found.append((f"a position of {bad}", name, partial(begin_with, make, bad)))
        found.append(("denormal velocities and displacements", name, partial(denormal, make)))
        found.append(("an isolated node falls", name, partial(fall, make)))
        found.append(("no damping at all", name, partial(undamped, make)))
        found.append(("the hand jumps 20 mm in a step of 10 ms", name, partial(jump, make, 20.0)))
        found.append(("a node pulled 3 radii in a step of 10 ms", name, partial(jump, make, 1.5)))
    found.append(("an isolated node without mass", "all", massless))
    return found


def energy_left(work: Integrator, state: State, step_s: float, steps: int, given: float) -> str:
    """Steps on, and says what is left of the energy ``given``. Raises AssertionError when the law is broken."""
    try:
        substeps = sum(work.step(state, step_s) for _ in range(steps))
    except ValueError as refusal:
        return f"refused: {refusal}"
    assert np.isfinite(state.x).all(), "a position is not finite"
    assert np.isfinite(state.v).all(), "a velocity is not finite"
    left = mechanical_energy(work.model, state) / given
    assert left <= MOST_ENERGY, f"energy grew {left:.3g} times"
    return f"ok: {left:.2g} of the energy is left, {substeps} substeps"


def swing(begin: Callable[[], tuple[Model, State]], make: Make, step_s: float, steps: int) -> str:
    made, state = begin()
    return energy_left(make(made, state.held), state, step_s, steps, mechanical_energy(made, state))


def own(rest: Array, links: np.ndarray, stiffness: Array, fixed: list[int]) -> LinkMesh:
    held = np.zeros(len(rest), dtype=bool)
    held[fixed] = True
    return link_mesh(rest, links, stiffness, held)


def two_tetrahedra(stiffness: Array) -> LinkMesh:
    """Two tetrahedra on a common face, 1 mm high, the first node fixed."""
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    links = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3], [1, 4], [2, 4], [3, 4]])
    return own(rest, links, stiffness, [0])


def stiff_and_soft() -> tuple[Model, State]:
    """Every second link is a million times stiffer than its neighbours; all nodes in motion."""
    mesh = two_tetrahedra(np.where(np.arange(9) % 2 == 0, 1e-4, 1e2))
    state = at_rest(mesh)
    state.v[1:] = np.random.default_rng(0).normal(scale=10.0, size=(4, 3))
    return model(mesh, np.full(5, 1e-3), drag=DRAG * 1e-3, gravity=WEIGHTLESS), state


def toe_and_loss() -> tuple[Model, State]:
    """J-shaped links, which stiffen by exp(3) and lose a third in each loop, drawn to twice their length and let go."""
    mesh = two_tetrahedra(np.full(9, 0.1))
    state = at_rest(mesh)
    state.x[:] *= 2.0
    mesh = replace(mesh, law=j_shaped(mesh, growth=6.0, toe_strain=0.5, loss=0.33))
    return model(mesh, np.full(5, 1e-4), drag=DRAG * 1e-4, gravity=WEIGHTLESS), state


def line(squeezed: bool) -> tuple[Model, State]:
    """Six nodes on a line, the first held; two of them at the same place, or the whole pushed to a third."""
    rest = np.stack([np.arange(6.0), np.zeros(6), np.zeros(6)], axis=1)
    mesh = own(rest, np.stack([np.arange(5), np.arange(1, 6)], axis=1), np.full(5, 0.1), [0])
    state = at_rest(mesh)
    if squeezed:
        state.x[:, 0] /= 3.0
    else:
        state.x[3] = state.x[2]
    return model(mesh, np.full(6, 1e-4), drag=DRAG * 1e-4, gravity=WEIGHTLESS), state


def collapsed() -> tuple[Model, State]:
    """The soft vessel flat in the plane of its axis: hulls, layers and sides lie in each other."""
    vessel, made = tube(5, 8, "soft")
    state = at_rest(vessel.mesh)
    state.x[:] -= np.outer(state.x @ vessel.twelve, vessel.twelve) * ~state.held[:, None]
    return made._replace(gravity=np.zeros(3)), state


BEGINNINGS: dict[str, Callable[[], tuple[Model, State]]] = {
    "stiffness ratio 1e6": stiff_and_soft,
    "a link without length": partial(line, False),
    "links on one line, pushed to a third": partial(line, True),
    "a vessel pressed flat": collapsed,
    "J-shaped links at twice their length": toe_and_loss,
}


def begin_with(make: Make, bad: float) -> str:
    """A node's position is ``bad``: refused, and nothing is changed."""
    vessel, made = tube(5, 8, "soft")
    state = at_rest(vessel.mesh)
    state.x[3, 1] = bad
    before = state.x.copy()
    answer = energy_left(make(made, state.held), state, 1e-3, 1, 1.0)
    assert answer.startswith("refused"), answer
    assert np.array_equal(before, state.x, equal_nan=True), "a refused step moved the nodes"
    return answer


def denormal(make: Make) -> str:
    """Numbers near the smallest: as good as rest."""
    made, state = line(squeezed=True)
    state.x[:, 0] *= 3.0
    state.x[1:, 1], state.v[1:, 2] = 1e-310, 5e-324
    rest = state.x.copy()
    work = make(made, state.held)
    for _ in range(10):
        work.step(state, 1e-3)
    far = float(np.abs(state.x - rest).max())
    assert far < 1e-12, f"moved by {far:.2g} mm"
    return f"ok: moved by {far:.2g} mm"


def fall(make: Make) -> str:
    """A node that no link holds falls g t² / 2 in 50 ms, but for the method's order: less than a step's lag, g t h."""
    lone = own(np.zeros((2, 3)), np.zeros((0, 2), dtype=np.int32), np.zeros(0), [0])
    state, span = at_rest(lone), 0.05
    work = make(model(lone, np.full(2, 1e-6)), state.held)
    for _ in range(50):
        work.step(state, span / 50)
    lag = abs(state.x[1, 2] + 0.5 * 9806.65 * span**2) / (9806.65 * span * span / 50)
    assert lag <= 0.51, f"{lag:.3g} steps behind"
    assert not state.x[0].any(), "the fixed node moved"
    return f"ok: {lag:.2g} steps behind the closed form"


def undamped(make: Make) -> str:
    """No drag, no dashpots: forward Euler and RK2 have no stable step, and say so."""
    made, state = stiff_and_soft()
    made = made._replace(drag=np.zeros(5))
    return energy_left(make(made, state.held), state, 1e-3, 50, mechanical_energy(made, state))


def jump(make: Make, by_mm: float) -> str:
    """A node of the cut edge is carried off within one step, and held there for ten more.

    The work of the hand is that of the links' energy if nothing else moved, at the most.
    """
    vessel, made = tube(5, 8, "soft")
    made = made._replace(gravity=np.zeros(3))
    state = at_rest(vessel.mesh)
    node = vessel.node(0, 0)
    state.held[node] = True
    torn = State(state.x.copy(), state.v, state.held, state.slip)
    torn.x[node] += by_mm * vessel.twelve
    given = mechanical_energy(made, torn)
    work = make(made, state.held)
    state.v[node] = by_mm / 0.01 * vessel.twelve
    answer = energy_left(work, state, 0.01, 1, math.inf)
    if answer.startswith("refused"):
        return answer
    assert np.allclose(state.x[node], torn.x[node], rtol=0.0, atol=1e-9), "the hand's node is elsewhere"
    state.v[node] = 0.0
    return energy_left(work, state, 0.01, 10, given)


def massless() -> str:
    """A node that could move and has no mass: the model is not made."""
    lone = own(np.zeros((1, 3)), np.zeros((0, 2), dtype=np.int32), np.zeros(0), [])
    try:
        model(lone, np.zeros(1))
    except ValueError as refusal:
        return f"refused: {refusal}"
    raise AssertionError("accepted")
