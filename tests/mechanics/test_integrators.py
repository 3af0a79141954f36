"""Verification of explicit time integration and of the equations of motion: each test states the law that it checks."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from allocations import kept_bytes
from swinging import FREQUENCY, MASS, WEIGHTLESS, block, dumbbell, in_motion, spring, stretched

from trainer.mechanics.dynamics import (
    Model,
    at_rest,
    bounds,
    mechanical_energy,
    model,
)
from trainer.mechanics.implicit_euler import BackwardEuler
from trainer.mechanics.integrators import FORWARD_EULER, METHODS, MIDPOINT, RK4, RK4_RADIUS, Explicit, Method
from trainer.mechanics.link_law import j_shaped
from trainer.mechanics.link_tension import slip_at
from trainer.mechanics.links import LinkMesh, link_mesh, stiffness_from_modulus

#: R(z) = Σ z^k / k!, up to the method's order.
POLYNOMIAL = {m.name: [1.0 / math.factorial(k) for k in range(m.order, -1, -1)] for m in METHODS}


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_a_substep_multiplies_a_mode_by_the_methods_polynomial(method: Method) -> None:
    """x'' + c x' + ω² x = 0 along a link is linear: n steps give R(h A)^n, A its companion matrix.

    Only rounding is left. Positions of 10 mm are rounded to 2e-15 mm at each step, and the force of the difference to
    k times that; 20 steps of up to 4 stages that do not grow: below 1e-12 mm, and times ω for velocities.
    """
    mesh = spring()
    drag = 0.4 * MASS * FREQUENCY
    work = Explicit(model(mesh, np.full(2, MASS), drag=drag, gravity=WEIGHTLESS), method, mesh.fixed)
    h = 0.5 * work.stable_step_s
    state = stretched(mesh, 1.0)
    for _ in range(20):
        assert work.step(state, h) == 1
    a = np.array([[0.0, 1.0], [-(FREQUENCY**2), -drag / MASS]])
    r = np.zeros((2, 2))
    for coefficient in POLYNOMIAL[method.name]:
        r = r @ (h * a) + coefficient * np.eye(2)
    expected = np.linalg.matrix_power(r, 20) @ np.array([1.0, 0.0])
    assert state.x[1, 0] - 10.0 == pytest.approx(expected[0], abs=1e-12)
    assert state.v[1, 0] == pytest.approx(expected[1], abs=1e-12 * FREQUENCY)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_order_of_convergence_on_a_spring(method: Method) -> None:
    """Error ~ h^p against the damped oscillator's closed form, p = 1, 2, 4.

    The error after a fixed time is C h^p (1 + O(h)). Over a halving of h with s = h ω <= 0.05 the next order changes
    the observed exponent by O(s) / ln 2: 0.1 covers it, and no other order is that near.
    """
    mesh = spring()
    drag = 0.4 * MASS * FREQUENCY
    work = Explicit(model(mesh, np.full(2, MASS), drag=drag, gravity=WEIGHTLESS), method, mesh.fixed)
    span, gamma = 1e-3, 0.5 * drag / MASS
    swing = math.sqrt(FREQUENCY**2 - gamma**2)
    exact = math.exp(-gamma * span) * (math.cos(swing * span) + gamma / swing * math.sin(swing * span))
    errors = []
    for steps in (40, 80):
        state = stretched(mesh, 1.0)
        for _ in range(steps):
            assert work.step(state, span / steps) == 1
        errors.append(abs(state.x[1, 0] - 10.0 - exact))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(method.order, abs=0.1)


def test_rk4_loses_energy_as_its_polynomial_says() -> None:
    """Without damping |R(i s)|² = 1 - s⁶ / 72 + s⁸ / 576 is the energy's factor in each step, on one mode.

    Energy of the mode is k x² / 2 + m v² / 2, and R is a multiple of a rotation in (ω x, v). 100 steps at s = 0.8 lose
    26 %; rounding as above, 1e-11 of it.
    """
    mesh = spring()
    made = model(mesh, np.full(2, MASS), gravity=WEIGHTLESS)
    work, state = Explicit(made, RK4, mesh.fixed), stretched(mesh, 1.0)
    s = 0.8
    before = mechanical_energy(made, state)
    for _ in range(100):
        assert work.step(state, s / FREQUENCY) == 1
    factor = 1.0 - s**6 / 72.0 + s**8 / 576.0
    assert mechanical_energy(made, state) / before == pytest.approx(factor**100, rel=1e-11)


def test_rk4_keeps_the_energy_of_a_mesh_to_its_order() -> None:
    """A free block in motion, no damping: its energy is conserved, and RK4's loss falls 2⁵ times as h is halved.

    A mode loses s⁶ / 72 (1 - s² / 8) of its energy in each of n steps. At an eighth of the stable step s <= 0.33: the
    fastest modes lose 100 s⁶ / 72 = 2e-3, the mean of all, <s⁶>, is below a twentieth of it; and the next order
    changes the exponent by at most log2(1 + 0.75 s² / 8) = 0.015. Large motions add the curvature of the links' paths.
    """
    mesh, mass = block()
    made = model(mesh, mass, gravity=WEIGHTLESS)
    work = Explicit(made, RK4, mesh.fixed)
    lost = []
    for parts in (1, 2):
        state = in_motion(mesh)
        before = mechanical_energy(made, state)
        for _ in range(100 * parts):
            assert work.step(state, 0.125 * work.stable_step_s / parts) == 1
        lost.append(1.0 - mechanical_energy(made, state) / before)
    assert 0.0 < lost[0] < 1e-4
    assert math.log2(lost[0] / lost[1]) == pytest.approx(5.0, abs=0.05)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_a_free_mesh_keeps_its_momentum(method: Method) -> None:
    """Links and dashpots pull both ends alike and along their line: Σ m v is constant under every method.

    With drag proportional to mass, c = α m, the sum obeys p' = -α p for all nodes alike, so that it is R(-α h)^n p.
    Rounding: 27 nodes, 200 steps, forces of k x ε = 1e2 · 1e-15 mN against p / h: 1e-10 relative.
    """
    mesh, mass = block()
    alpha = 2000.0
    made = model(mesh, mass, drag=alpha * mass, dashpot=1e-5, gravity=WEIGHTLESS)
    work, state = Explicit(made, method, mesh.fixed), in_motion(mesh)
    before = mass @ state.v
    h = work.stable_step_s
    for _ in range(200):
        work.step(state, h)
    factor = np.polyval(POLYNOMIAL[method.name], -alpha * h) ** 200
    assert mass @ state.v == pytest.approx(factor * before, abs=1e-10 * np.abs(before).max())


def test_a_free_mesh_keeps_its_angular_momentum() -> None:
    """Σ x × m v of the equations of motion is constant; RK4 keeps it to its order, h⁴ in a fixed time.

    Halving h divides the drift by 16 (exponent read off within 0.5, as above), and it is below 1e-5 of L.
    """
    mesh, mass = block()
    made = model(mesh, mass, dashpot=1e-6, gravity=WEIGHTLESS)
    work = Explicit(made, RK4, mesh.fixed)
    drift = []
    for parts in (1, 2):
        state = in_motion(mesh)
        before = np.cross(state.x, mass[:, None] * state.v).sum(axis=0)
        for _ in range(100 * parts):
            assert work.step(state, 0.25 * work.stable_step_s / parts) == 1
        after = np.cross(state.x, mass[:, None] * state.v).sum(axis=0)
        drift.append(np.linalg.norm(after - before) / np.linalg.norm(before))
    assert drift[0] < 1e-5
    assert math.log2(drift[0] / drift[1]) > 3.5


@pytest.mark.parametrize("method", [MIDPOINT, RK4], ids=lambda m: m.name)
def test_free_fall(method: Method) -> None:
    """A mesh at rest falls undeformed: by g t² / 2, exact for order 2 and more; with drag c = α m, which RK2 needs, by

        g / α² (α t - 1 + exp(-α t)) = g t² (1/2 - α t / 6 + (α t)² / 24 - …),

    where α t = 0.01 makes the next term 1e-8 of the whole, 5e-9 mm; RK2's own error is (α h)², 1e-13. Rounding:
    coordinates of 2 mm to 4e-16, forces of 1e2 mN/mm times that on 1e-7 kg are 1e-6 mm/s² · 1e4 substeps at random.
    """
    mesh, mass = block()
    alpha, span = (1.0 if method is MIDPOINT else 0.0), 0.01
    work, state = Explicit(model(mesh, mass, drag=alpha * mass), method, mesh.fixed), at_rest(mesh)
    work.step(state, span)
    at = alpha * span
    fall = 9806.65 * span**2 * (0.5 - at / 6.0 + at * at / 24.0)
    assert state.x - mesh.rest == pytest.approx(np.tile([0.0, 0.0, -fall], (len(mass), 1)), abs=1e-8)


def test_forward_euler_falls_too_short_by_half_a_step() -> None:
    """x lags by one velocity: n steps fall g h² n (n - 1) / 2, here of a lone node (a mesh without links)."""
    lone = link_mesh(np.zeros((1, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(1, dtype=bool))
    work, state = Explicit(model(lone, np.ones(1)), FORWARD_EULER, lone.fixed), at_rest(lone)
    assert work.stable_step_s == math.inf
    for _ in range(10):
        assert work.step(state, 1e-3) == 1
    assert state.x[0, 2] == pytest.approx(-9806.65 * 1e-6 * 45.0, rel=1e-14)


def test_stable_regions() -> None:
    """|R(z)| <= 1 for all modes below the bounds; by the maximum principle RK4's needs only the half disc's edge.

    Modes are scanned: s = h ω and d = h c at 300 values each. Rounding of |R|: 1e-12.
    """
    angle = np.linspace(0.5 * np.pi, np.pi, 2001)
    edge = np.concatenate([RK4_RADIUS * np.exp(1j * angle), 1j * np.linspace(0.0, RK4_RADIUS, 2001)])
    assert np.abs(np.polyval(POLYNOMIAL["RK4"], edge)).max() <= 1.0 + 1e-12
    assert np.abs(np.polyval(POLYNOMIAL["RK4"], 1.0001 * edge)).max() > 1.0  # it is the largest such half disc
    mesh = spring()
    for method in (FORWARD_EULER, MIDPOINT):
        for ratio in (0.01, 0.3, 2.0, 10.0):  # c / ω
            made = model(mesh, np.full(2, MASS), drag=ratio * MASS * FREQUENCY, gravity=WEIGHTLESS)
            h = Explicit(made, method, mesh.fixed).stable_step_s
            s = h * bounds(made, mesh.fixed).frequency * np.linspace(0.0, 1.0, 300)
            d = h * ratio * FREQUENCY
            root = np.sqrt((0.25 * d * d - s * s).astype(np.complex128))
            for z in (-0.5 * d + root, -0.5 * d - root):
                assert np.abs(np.polyval(POLYNOMIAL[method.name], z)).max() <= 1.0 + 1e-12


def test_beyond_the_stable_step_the_method_alone_would_explode() -> None:
    """What the substeps are for: one step of twice the stable length grows at each, in place of the substeps."""
    mesh = dumbbell()
    made = model(mesh, np.full(2, MASS), gravity=WEIGHTLESS)
    work = Explicit(made, RK4, mesh.fixed)
    state, h = stretched(mesh, 1e-6), 2.0 * work.stable_step_s
    for _ in range(6):
        work.method.advance(made, state, work._stages, h, 1)
    assert np.abs(state.x - mesh.rest).max() > 1.0
    state = stretched(mesh, 1e-6)
    for _ in range(6):
        assert work.step(state, h) == 2
    assert np.abs(state.x - mesh.rest).max() <= 1e-6


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
@pytest.mark.parametrize("duration", [1e-3, 0.05])
def test_a_long_step_stays_bounded(method: Method, duration: float) -> None:
    """A stiffness ratio of 1e6 between links, a step of many stable ones: energy does not rise above its start.

    Energy bounds the motion: with E0 of the start no link is stretched beyond √(2 E0 / k). Within the stable step
    each linear mode's |R| <= 1; the geometry adds no more than a part in a thousand here (strain 1e-3).
    """
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    links, k = stiffness_from_modulus(rest, np.array([[0, 1, 2, 3], [1, 2, 3, 4]]), 1.0)
    k = k * np.where(np.arange(len(k)) % 2 == 0, 1e-3, 1e3)
    mesh = link_mesh(rest, links, k, np.array([True, False, False, False, False]))
    mass = np.full(5, 1e-3)
    made = model(mesh, mass, drag=100.0 * mass, gravity=WEIGHTLESS)
    work, state = Explicit(made, method, mesh.fixed), in_motion(mesh, speed=1.0)
    before = mechanical_energy(made, state)
    substeps = work.step(state, duration)
    assert substeps >= duration / work.stable_step_s
    assert 0.0 < mechanical_energy(made, state) < 1.001 * before


def test_moved_nodes_go_where_they_are_sent_and_draw_the_others() -> None:
    """A held node keeps its velocity: x = x0 + v t, to rounding of each substep's sum; the mesh comes after."""
    mesh, mass = block(fixed=True)
    held = mesh.fixed.copy()
    held[-1] = True
    made = model(mesh, mass, drag=1e3 * mass, gravity=WEIGHTLESS)
    work, state = Explicit(made, RK4, held), at_rest(mesh)
    state.held[:] = held
    state.v[-1] = [30.0, 0.0, 10.0]
    work.step(state, 0.01)
    assert state.x[-1] - mesh.rest[-1] == pytest.approx([0.3, 0.0, 0.1], rel=1e-9)
    assert state.v[-1] == pytest.approx([30.0, 0.0, 10.0], abs=0.0)
    assert (state.x[mesh.fixed] == mesh.rest[mesh.fixed]).all()
    assert np.linalg.norm((state.x - mesh.rest)[~held], axis=1).max() > 0.01
    state.held[-1] = False
    with pytest.raises(ValueError, match="hold"):
        work.step(state, 0.01)


@pytest.mark.parametrize("method", [FORWARD_EULER, MIDPOINT], ids=lambda m: m.name)
def test_without_drag_a_method_that_has_no_stable_step_is_refused(method: Method) -> None:
    """|1 + i s|² = 1 + s² and |1 + i s - s²/2|² = 1 + s⁴ / 4: an undamped mode grows at every step."""
    mesh = spring()
    work = Explicit(model(mesh, np.full(2, MASS), gravity=WEIGHTLESS), method, mesh.fixed)
    assert work.stable_step_s == 0.0
    with pytest.raises(ValueError, match="no step for a mesh with a free node without drag"):
        work.step(stretched(mesh, 1.0), 1e-9)


def test_what_no_step_can_begin_with_is_refused() -> None:
    mesh, mass = block(fixed=True)
    work, state = Explicit(model(mesh, mass, drag=mass), RK4, mesh.fixed), at_rest(mesh)
    for bad in (math.nan, math.inf, 0.0, -1e-3):
        with pytest.raises(ValueError, match="positive, finite time"):
            work.step(state, bad)
    for array, said in ((state.x, "position of node 7"), (state.v, "velocity of node 7")):
        for bad in (math.nan, -math.inf):
            kept = array[7, 1]
            array[7, 1] = bad
            with pytest.raises(ValueError, match=said):
                work.step(state, 1e-3)
            array[7, 1] = kept
    with pytest.raises(ValueError, match="substeps"):
        work.step(state, 1e6)
    top = int(np.argmax(mesh.rest[:, 2]))
    with pytest.raises(ValueError, match=f"node {top} has no mass"):
        model(mesh, np.where(np.arange(len(mass)) == top, 0.0, mass))
    with pytest.raises(ValueError, match="'drag' 0 must be finite"):
        model(mesh, mass, drag=-1.0)


def test_a_step_beyond_the_range_of_numbers_leaves_the_state_as_it_was() -> None:
    mesh, mass = block(fixed=True)
    work, state = Explicit(model(mesh, mass), RK4, mesh.fixed), at_rest(mesh)
    state.v[~mesh.fixed] = 1e200
    before = state.x.copy(), state.v.copy()
    with pytest.raises(ArithmeticError, match="outgrew"):
        work.step(state, 1e-3)
    assert (state.x == before[0]).all()
    assert (state.v == before[1]).all()


def heavy_case() -> tuple[Model, LinkMesh]:
    """Hysteresis, drag, dashpots and gravity together."""
    mesh, mass = block(fixed=True)
    law = j_shaped(mesh, growth=5.0, toe_strain=0.3, loss=0.3)
    return model(replace(mesh, law=law), mass, drag=2e3 * mass, dashpot=1e-6), mesh


def outcome() -> str:
    """Digests of the state after a few steps of each method."""
    made, mesh = heavy_case()
    digests = []
    for work in (*(Explicit(made, m, mesh.fixed) for m in METHODS), BackwardEuler(made, tolerance_mN=1e-6)):
        state = in_motion(mesh)
        for _ in range(3):
            work.step(state, 20e-6)
        digests.append(hashlib.sha256(state.x.tobytes() + state.v.tobytes() + state.slip.tobytes()).hexdigest())
    return " ".join(digests)


@pytest.mark.parametrize("name", [*(m.name for m in METHODS), "backward Euler"])
def test_links_remember_where_a_step_left_them(name: str) -> None:
    """After one substep from slip 0 each link's slip is that of its law at its new elongation, to the last digits."""
    made, mesh = heavy_case()
    explicit = {m.name: Explicit(made, m, mesh.fixed) for m in METHODS}
    work = explicit.get(name) or BackwardEuler(made, tolerance_mN=1e-6)
    state = in_motion(mesh)
    assert work.step(state, min(1e-6, work.stable_step_s)) == 1
    d = state.x[mesh.links[:, 1]] - state.x[mesh.links[:, 0]]
    elongation = np.linalg.norm(d, axis=1) - mesh.rest_length
    slip = np.array([slip_at(*link) for link in zip(elongation, np.zeros(len(d)), *made.law, strict=True)])
    assert np.abs(slip).max() > 1e-7
    assert state.slip == pytest.approx(slip, abs=1e-14)


def test_a_run_repeats_bit_for_bit() -> None:
    assert outcome() == outcome()


def test_without_compilation_the_result_is_the_same_bit_for_bit() -> None:
    """The kernels are plain sums in a fixed order: compiled or not, each operation rounds alike."""
    code = "import test_integrators as t; print(t.outcome())"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(["tests/mechanics", "."])}
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert run.stdout.strip() == outcome()


def test_no_step_allocates_after_the_first() -> None:
    """The peak of traced memory in a step stays below half of one (n, 3) array; Python's own numbers fit into it."""
    mesh, mass = block(cells=5, fixed=True)
    made = model(mesh, mass, drag=2e3 * mass)
    array = mesh.rest.nbytes
    for work in (*(Explicit(made, m, mesh.fixed) for m in METHODS), BackwardEuler(made, tolerance_mN=1e-6)):
        state = in_motion(mesh)
        _, peak = kept_bytes(partial(work.step, state, 1e-5))
        assert peak < 0.5 * array
