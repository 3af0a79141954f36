"""Verification of the equations of motion, their masses and the bounds of their modes: each test states its law."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from swinging import MASS, STIFFNESS, WEIGHTLESS, block, dumbbell, spring, stretched

from trainer.mechanics.dynamics import at_rest, bounds, lumped_masses, masses_of_links, mechanical_energy, model
from trainer.mechanics.integrators import RK4, Explicit
from trainer.mechanics.link_law import j_shaped
from trainer.mechanics.links import hessian, link_mesh, stiffness_from_modulus


def test_drag_slows_at_its_rate() -> None:
    """v = v0 exp(-c t / m) of a lone node; RK4 over one of c t / m in 100 steps errs by 0.01⁴ / 120 = 1e-10."""
    lone = link_mesh(np.zeros((1, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(1, dtype=bool))
    made = model(lone, np.full(1, 1e-6), drag=2e-4, gravity=WEIGHTLESS)
    work, state = Explicit(made, RK4, lone.fixed), at_rest(lone)
    state.v[0] = [3.0, 0.0, 4.0]
    for _ in range(100):
        work.step(state, 5e-5)
    assert state.v[0] == pytest.approx(np.array([3.0, 0.0, 4.0]) * math.exp(-1.0), rel=2e-10)


def test_a_dashpot_damps_at_its_rate() -> None:
    """Two masses on one link, reduced mass m / 2: the length swings with exp(-b t / m), γ = b / (2 · m / 2).

    RK4 in 400 steps of s = h ω <= 0.02: error s⁵ / 120 each, 1e-8 in all.
    """
    mesh = link_mesh(
        np.array([[0.0, 0, 0], [10.0, 0, 0]]), np.array([[0, 1]]), np.array([8.0]), np.zeros(2, dtype=bool)
    )
    b = 4e-4
    made = model(mesh, np.full(2, MASS), dashpot=b, gravity=WEIGHTLESS)
    work, state = Explicit(made, RK4, mesh.fixed), stretched(mesh, 0.5)
    span, gamma, omega = 2.5e-3, b / MASS, math.sqrt(2.0 * 8.0 / MASS)
    for _ in range(400):
        assert work.step(state, span / 400) == 1
    swing = math.sqrt(omega**2 - gamma**2)
    exact = 0.5 * math.exp(-gamma * span) * (math.cos(swing * span) + gamma / swing * math.sin(swing * span))
    assert state.x[1, 0] - state.x[0, 0] - 10.0 == pytest.approx(exact, abs=1e-8)


def test_lost_energy_is_what_the_links_loops_enclose() -> None:
    """A heavy node on a link with hysteresis, undamped: its energy never rises, and half a swing loses h U less a bit.

    From rest stretched by 1 mm, slip 0 (loaded once), it flies back through rest with the energy that the link stored.
    RK4's own error where the law has a kink is of order h²: 1e-6 of the energy at 2000 steps in a swing.
    """
    mesh = spring()
    law = j_shaped(mesh, growth=20.0, toe_strain=0.2, loss=0.4)
    made = model(replace(mesh, law=law), np.full(2, MASS), gravity=WEIGHTLESS)
    work, state = Explicit(made, RK4, mesh.fixed), stretched(mesh, 1.0)
    state.slip[0] = 1.0 - 0.4 * (STIFFNESS / 2.0 * math.expm1(2.0)) / law.friction[0]
    energies = [mechanical_energy(made, state)]
    for _ in range(2000):
        work.step(state, 2e-6)
        energies.append(mechanical_energy(made, state))
        if state.x[1, 0] <= 10.0:
            break
    assert state.x[1, 0] <= 10.0
    assert np.diff(energies).max() < 1e-6 * energies[0]
    assert 0.5 * MASS * state.v[1, 0] ** 2 == pytest.approx(energies[0], rel=1e-4)
    whole = 4.0 / 2.0 * (math.expm1(2.0) / 2.0 - 1.0) * 2.0
    assert energies[0] == pytest.approx(0.6 * whole + (0.4 * 4.0 * math.expm1(2.0)) ** 2 / (2 * law.friction[0]))


def test_lumped_masses_keep_total_and_centre() -> None:
    """Σ m = ρ V and Σ m x = ρ ∫ x dV of a cube that is cut in any way; masses read off the links are the same."""
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    tetrahedra = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    mass = lumped_masses(rest, tetrahedra, 6.0)
    assert mass == pytest.approx([0.25, 0.75, 0.75, 0.75, 0.5])
    links, k = stiffness_from_modulus(rest, tetrahedra, 7.0)
    mesh = link_mesh(rest, links, k, np.zeros(5, dtype=bool))
    assert masses_of_links(mesh, 7.0, 6.0) == pytest.approx(mass, rel=1e-14)


@pytest.mark.parametrize("stretch", [1.0, 1.5])
def test_no_mode_is_faster_than_the_bound(stretch: float) -> None:
    """Against the eigenvalues of M⁻¹ K, at rest and drawn out: the bound is above, and not twice as high."""
    mesh, mass = block(fixed=True)
    made = model(mesh, mass)
    free = np.repeat(~mesh.fixed, 3)
    root = np.repeat(mass, 3)[free] ** -0.5
    k = hessian(mesh, stretch * mesh.rest)[np.ix_(free, free)]
    fastest = math.sqrt(np.linalg.eigvalsh(root[:, None] * k * root)[-1])
    assert fastest < bounds(made, mesh.fixed).frequency < 2.0 * fastest


def test_the_bound_is_sharp_on_a_chain_along_a_line() -> None:
    """Two free masses on a link: ω² = 2 k / m, which Gershgorin's bound meets exactly."""
    mesh = dumbbell()
    found = bounds(model(mesh, np.full(2, MASS), dashpot=3e-4), mesh.fixed)
    assert found.frequency == pytest.approx(math.sqrt(16.0 / MASS), rel=1e-11)
    assert found.most_damping == pytest.approx(6e-4 / MASS, rel=1e-11)
    assert found.least_damping == 0.0
