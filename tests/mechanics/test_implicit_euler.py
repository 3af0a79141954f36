"""Verification of backward Euler: each test states the law that it checks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from swinging import FREQUENCY, MASS, STIFFNESS, WEIGHTLESS, block, in_motion, spring, stretched

from trainer.mechanics.dynamics import at_rest, mechanical_energy, model
from trainer.mechanics.implicit_euler import BackwardEuler, linearise, multiply, residual
from trainer.mechanics.integrators import RK4, Explicit
from trainer.mechanics.link_law import j_shaped
from trainer.mechanics.link_tension import area
from trainer.mechanics.links import forces, hessian, link_mesh

#: Both of them: to the end of Newton's iteration, and the one linear step.
NEWTON_STEPS = (30, 1)


@pytest.mark.parametrize("newton_steps", NEWTON_STEPS)
@pytest.mark.parametrize("s", [0.1, 3.0, 100.0])
def test_a_step_multiplies_a_mode_by_its_rational_function(s: float, newton_steps: int) -> None:
    """Along a link all is linear: n steps give (I - h A)^-n, whatever the step; here 10 steps with s = h ω.

    A residual of 1e-9 mN is 1e-9 / k mm of position where springs rule, or h² / m times that where inertia does:
    1e-9 mm at most, in each of 10 steps that do not grow.
    """
    mesh, drag = spring(), 0.3 * MASS * FREQUENCY
    work = BackwardEuler(
        model(mesh, np.full(2, MASS), drag=drag, gravity=WEIGHTLESS), tolerance_mN=1e-9, newton_steps=newton_steps
    )
    h, state = s / FREQUENCY, stretched(mesh, 1.0)
    for _ in range(10):
        assert work.step(state, h) == 1
    a = np.array([[0.0, 1.0], [-(FREQUENCY**2), -drag / MASS]])
    expected = np.linalg.matrix_power(np.linalg.inv(np.eye(2) - h * a), 10) @ np.array([1.0, 0.0])
    assert state.x[1, 0] - 10.0 == pytest.approx(expected[0], abs=1e-8)
    assert state.v[1, 0] == pytest.approx(expected[1], abs=1e-8 * FREQUENCY)


@pytest.mark.parametrize("newton_steps", NEWTON_STEPS)
def test_order_of_convergence_is_one(newton_steps: int) -> None:
    """A free, turning block in large motion against RK4: halving the step halves the error.

    The next order changes the exponent by O(h ω) / ln 2; h is 1/80 of the stable step of RK4, h ω < 0.04: within 0.1.
    The reference's own error is of order 4 at a hundredth of its stable step, 1e-7 of that looked at.
    """
    mesh, mass = block()
    made = model(mesh, mass, gravity=WEIGHTLESS)
    fine = Explicit(made, RK4, mesh.fixed)
    span = 0.5 * fine.stable_step_s
    reference = in_motion(mesh, speed=300.0)
    for _ in range(50):
        fine.step(reference, span / 50)
    work = BackwardEuler(made, tolerance_mN=1e-8, newton_steps=newton_steps)
    errors = []
    for steps in (40, 80):
        state = in_motion(mesh, speed=300.0)
        for _ in range(steps):
            work.step(state, span / steps)
        errors.append(np.abs(state.x - reference.x).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.1)


def test_the_product_without_a_matrix_is_that_of_the_matrix() -> None:
    """(M + h C + h² K) p on free nodes, K from links.hessian, the dashpots by their own outer products."""
    mesh, mass = block(fixed=True)
    made = model(mesh, mass, drag=50.0 * mass, dashpot=3e-5)
    work, state, h = BackwardEuler(made, tolerance_mN=1.0), at_rest(mesh), 1e-3
    x = mesh.rest + np.random.default_rng(3).normal(scale=0.1, size=mesh.rest.shape)
    p = np.where(mesh.fixed[:, None], 0.0, np.random.default_rng(4).normal(size=x.shape))
    inner, out = work._solve, np.empty_like(p)
    linearise(made, state, x, h, False, inner.block, inner.inverse)
    curvature = multiply(made, mesh.fixed, h, inner.block, p, out)
    d = mesh.rest[mesh.links[:, 1]] - mesh.rest[mesh.links[:, 0]]
    u = d / mesh.rest_length[:, None]
    resisted = 3e-5 * np.einsum("ei,ei->e", u, p[mesh.links[:, 1]] - p[mesh.links[:, 0]])[:, None] * u
    expected = (mass * (1.0 + h * 50.0))[:, None] * p + h * h * (hessian(mesh, x) @ p.ravel()).reshape(-1, 3)
    np.add.at(expected, mesh.links[:, 1], h * resisted)
    np.subtract.at(expected, mesh.links[:, 0], h * resisted)
    expected[mesh.fixed] = 0.0
    assert out == pytest.approx(expected, rel=1e-12, abs=1e-12 * np.abs(expected).max())
    assert curvature == pytest.approx(np.sum(p * expected), rel=1e-12)


def test_newton_ends_within_the_tolerance() -> None:
    """m (v - v_old) / h = f(x_old + h v) + m g on free nodes, the force taken from links.forces."""
    mesh, mass = block(fixed=True)
    work, state, h = BackwardEuler(model(mesh, mass), tolerance_mN=1e-7), in_motion(mesh, speed=1e3), 2e-3
    before = state.v.copy()
    assert work.step(state, h) == 1
    unbalanced = mass[:, None] * (state.v - before) / h - forces(mesh, state.x)
    unbalanced[:, 2] += mass * 9806.65
    assert np.linalg.norm(unbalanced[~mesh.fixed]) < 1.1e-7
    assert np.linalg.norm(state.x - mesh.rest, axis=1).max() > 0.01


def test_the_linear_step_leaves_what_turning_costs() -> None:
    """One linear step is not the solution in large motion: the same equation, a residual far above the tolerance."""
    mesh, mass = block(fixed=True)
    made, h = model(mesh, mass), 2e-3
    work, state = BackwardEuler(made, tolerance_mN=1e-7, newton_steps=1), in_motion(mesh, speed=200.0)
    before = at_rest(mesh)
    before.v[:] = state.v
    work.step(state, h)
    left = residual(made, before, state.v, h, np.empty_like(state.x), np.empty_like(state.x))
    assert left > 1e-3


@pytest.mark.parametrize("newton_steps", NEWTON_STEPS)
def test_a_free_mesh_keeps_its_linear_momentum(newton_steps: int) -> None:
    """Σ m v changes in a step by the sum of the residual impulses, |Σ r_i| <= √n |r| <= √n h tolerance."""
    mesh, mass = block()
    tolerance, h = 1e-6, 1e-3
    made = model(mesh, mass, dashpot=1e-5, gravity=WEIGHTLESS)
    work, state = BackwardEuler(made, tolerance_mN=tolerance, newton_steps=newton_steps), in_motion(mesh)
    before = mass @ state.v
    steps = sum(work.step(state, h) for _ in range(20))
    # The forces of the linear step are central at the old places as well: only the solve's error is left there.
    assert np.linalg.norm(mass @ state.v - before) <= 1.01 * steps * math.sqrt(len(mass)) * h * tolerance


def test_angular_momentum_is_lost_in_proportion_to_the_step() -> None:
    """x × m v changes by h² Σ a × m v_old: over a fixed time in proportion to h (exponent within 0.1, as above)."""
    mesh, mass = block()
    made = model(mesh, mass, gravity=WEIGHTLESS)
    span = 0.5 * Explicit(made, RK4, mesh.fixed).stable_step_s
    work, lost = BackwardEuler(made, tolerance_mN=1e-8), []
    for steps in (40, 80):
        state = in_motion(mesh, speed=300.0)
        before = np.cross(state.x, mass[:, None] * state.v).sum(axis=0)
        for _ in range(steps):
            work.step(state, span / steps)
        lost.append(np.linalg.norm(np.cross(state.x, mass[:, None] * state.v).sum(axis=0) - before))
    assert math.log2(lost[0] / lost[1]) == pytest.approx(1.0, abs=0.1)


def test_free_fall_is_ahead_by_half_a_step() -> None:
    """x follows the new velocity: n steps fall g h² n (n + 1) / 2, exactly but for the tolerance."""
    mesh, mass = block()
    work, state, h = BackwardEuler(model(mesh, mass), tolerance_mN=1e-9), at_rest(mesh), 1e-3
    for _ in range(10):
        work.step(state, h)
    assert state.x - mesh.rest == pytest.approx(np.tile([0.0, 0.0, -9806.65 * h * h * 55.0], (len(mass), 1)), abs=1e-6)


@pytest.mark.parametrize("duration", [1e-3, 0.05])
@pytest.mark.parametrize("newton_steps", NEWTON_STEPS)
def test_energy_only_falls_at_any_step(newton_steps: int, duration: float) -> None:
    """Stiffness ratio 1e6, undamped, steps up to 1e5 periods of the stiff links: E_new <= E_old for small motions.

    On each mode |1 / (1 - i s)|² = 1 / (1 + s²) < 1. In 50 ms nodes go 5e-5 mm at most; what the stiff links lengthen
    as they turn, 1000 (5e-5)⁴ / 8 mN mm, is below a thousandth of the energy 4 · m v² / 2 = 6e-12 mN mm, and what the
    tolerance leaves, (1e-9)² / 1e-3, as well.
    """
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    links = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3], [1, 4], [2, 4], [3, 4]])
    k = np.where(np.arange(9) % 2 == 0, 1e-3, 1e3)
    mesh = link_mesh(rest, links, k, np.array([True, False, False, False, False]))
    made = model(mesh, np.full(5, 1e-6), gravity=WEIGHTLESS)
    work, state = BackwardEuler(made, tolerance_mN=1e-9, newton_steps=newton_steps), in_motion(mesh, speed=1e-3)
    last = mechanical_energy(made, state)
    for _ in range(10):
        work.step(state, duration)
        now = mechanical_energy(made, state)
        assert now <= 1.001 * last + 1e-15
        last = now


def test_long_steps_end_in_equilibrium() -> None:
    """As h grows, m (v - v_old) / h fades and what is solved is f + m g = 0: the static balance, in two steps of 1e3 s.

    What inertia leaves is m x / h² = 1e-6 · 1 / 1e6 mN; the tolerance is 1e-6 mN.
    """
    mesh, mass = block(fixed=True)
    made = model(mesh, 100.0 * mass)
    work, state = BackwardEuler(made, tolerance_mN=1e-6), at_rest(mesh)
    for _ in range(2):
        work.step(state, 1e3)
    unbalanced = forces(mesh, state.x)
    unbalanced[:, 2] -= 100.0 * mass * 9806.65
    assert np.linalg.norm(unbalanced[~mesh.fixed]) < 2e-6
    assert (mesh.rest[:, 2] - state.x[:, 2]).max() > 0.01


@pytest.mark.parametrize("newton_steps", NEWTON_STEPS)
def test_held_nodes_are_met_exactly(newton_steps: int) -> None:
    """The filter leaves the given velocity alone: x + h v to the last bit, though the mesh is drawn by three edges."""
    mesh, mass = block(fixed=True)
    state = at_rest(mesh)
    state.held[-1] = True
    state.v[-1] = [300.0, 0.0, 0.0]
    work = BackwardEuler(model(mesh, mass), tolerance_mN=1e-6, newton_steps=newton_steps)
    assert work.step(state, 0.01) == 1
    assert (state.x[-1] == mesh.rest[-1] + 0.01 * np.array([300.0, 0.0, 0.0])).all()
    assert (state.v[-1] == [300.0, 0.0, 0.0]).all()
    assert (state.x[mesh.fixed] == mesh.rest[mesh.fixed]).all()
    assert np.linalg.norm(state.x - mesh.rest, axis=1)[~state.held].max() > 0.1


def test_a_link_with_hysteresis_gives_back_what_it_stored() -> None:
    """Drawn out by 1 mm and let go slowly by its held node, a link costs h U - (h T)² / (2 κ): see link_tension.

    The work of the held node is Σ T Δx over 1000 steps each way with the tension at the end of the step: of first
    order, and its error cancels but for h T'' terms: 2e-3 of the work.
    """
    mesh = spring()
    law = j_shaped(mesh, growth=20.0, toe_strain=0.2, loss=0.4)
    made = model(replace(mesh, law=law), np.full(2, MASS), gravity=WEIGHTLESS)
    state = at_rest(mesh)
    state.held[:] = True
    work, spent = BackwardEuler(made, tolerance_mN=1e-9), 0.0
    for speed in (1.0, -1.0):
        for _ in range(1000):
            state.v[1, 0] = speed
            work.step(state, 1e-3)
            # The tension is read off the stored energy and the slip, which the step has left behind.
            q = law.friction[0] * (state.x[1, 0] - 10.0 - state.slip[0])
            below = 0.6 * STIFFNESS / 2.0 * math.expm1(2.0 * max(state.x[1, 0] - 10.0, 0.0))
            spent += speed * 1e-3 * (below + q)
    top = STIFFNESS / 2.0 * math.expm1(2.0)
    expected = 0.4 * area(1.0, STIFFNESS, 2.0, 2.0) - (0.4 * top) ** 2 / (2.0 * law.friction[0])
    assert spent == pytest.approx(expected, rel=1e-2)
    assert expected > 1.0


def test_links_without_length_and_on_one_line() -> None:
    """Two nodes at the same place have no direction between them: no force, no NaN. On a line all stays on the line."""
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    mesh = link_mesh(rest, np.array([[0, 1], [1, 2], [2, 3]]), np.full(3, 10.0), np.array([True, False, False, False]))
    state = at_rest(mesh)
    state.x[2] = state.x[1]
    work = BackwardEuler(model(mesh, np.full(4, 1e-6), gravity=WEIGHTLESS), tolerance_mN=1e-6)
    for _ in range(20):
        work.step(state, 1e-3)
    assert np.isfinite(state.x).all()
    assert (state.x[:, 1:] == 0.0).all()


def test_what_no_step_can_begin_with_is_refused() -> None:
    mesh, mass = block(fixed=True)
    made = model(mesh, mass)
    work, state = BackwardEuler(made, tolerance_mN=1e-6), at_rest(mesh)
    state.x[5, 2] = np.nan
    with pytest.raises(ValueError, match="position of node 5"):
        work.step(state, 1e-3)
    with pytest.raises(ValueError, match="positive, finite time"):
        work.step(at_rest(mesh), math.nan)
    with pytest.raises(ValueError, match="tolerance_mN"):
        BackwardEuler(made, tolerance_mN=0.0)
    with pytest.raises(ValueError, match="newton_steps"):
        BackwardEuler(made, tolerance_mN=1.0, newton_steps=0)


def test_a_step_that_does_not_converge_leaves_the_state_as_it_was() -> None:
    """A tolerance below rounding (forces of 1e-11 mN cannot be told from zero) is never met."""
    mesh, mass = block(fixed=True)
    work, state = BackwardEuler(model(mesh, mass), tolerance_mN=1e-30), in_motion(mesh)
    before = state.x.copy(), state.v.copy()
    with pytest.raises(ArithmeticError, match="does not converge"):
        work.step(state, 1e-3)
    assert (state.x == before[0]).all()
    assert (state.v == before[1]).all()
