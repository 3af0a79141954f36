"""Block sweeps: the factor that they find is the best one, and the energy never rises."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from trainer.geometry import Array
from trainer.mechanics.links import LinkMesh, energy, forces, hessian, link_mesh
from trainer.mechanics.sweeps import BlockSweeps, better_factor, sweep


def taut_chain(free: int) -> LinkMesh:
    """A straight chain of links of 1 mm, stretched to twice their rest length, with both ends fixed."""
    x = np.zeros((free + 2, 3))
    x[:, 0] = np.arange(free + 2)
    links = np.stack([np.arange(free + 1), np.arange(1, free + 2)], axis=1)
    fixed = np.isin(np.arange(free + 2), [0, free + 1])
    mesh = link_mesh(x, links, np.ones(free + 1), fixed)
    return replace(mesh, rest_length=0.5 * mesh.rest_length)


def block(cells: tuple[int, int, int] = (4, 2, 2), ratio: float = 1.0) -> LinkMesh:
    """A grid of nodes with links to all neighbours of the 26, fixed at x = 0; half the links stiffer by ``ratio``."""
    shape = tuple(c + 1 for c in cells)
    at = np.stack(np.meshgrid(*(np.arange(s) for s in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    far = np.max(np.abs(at[:, None] - at[None]), axis=2)
    i, j = np.nonzero(np.triu(far == 1))
    stiffness = np.where(np.arange(len(i)) % 2 == 0, 1.0, ratio)
    return link_mesh(at.astype(float), np.stack([i, j], axis=1), stiffness, at[:, 0] == 0)


@pytest.mark.parametrize("free", [10, 30, 100])
def test_the_factor_found_is_the_best_one_for_a_known_spectral_radius(free: int) -> None:
    """Block Jacobi on a chain of N unknowns has ρ = cos(π / (N + 1)), so the best ω is 2 / (1 + sin(π / (N + 1))).

    The mesh's blocks are all alike, so this holds for the three coordinates. An estimate is final when the next one
    would differ by 5 % of 2 - ω, or stays a quarter of 2 - ω below till then: 2 - ω is found within a third.
    """
    mesh = taut_chain(free)
    method = BlockSweeps(mesh)
    method.x[1:-1] += np.random.default_rng(1).normal(scale=1e-3, size=(free, 3))
    ended = method.move(np.array([0]), mesh.rest[:1], tolerance_mN=1e-12)
    best = 2.0 / (1.0 + math.sin(math.pi / (free + 1)))
    assert ended.converged
    assert 2.0 - method.omega == pytest.approx(2.0 - best, rel=1.0 / 3.0)
    assert np.allclose(method.x, mesh.rest, atol=1e-9)
    # With ω = 1 an error falls by ρ² in a sweep: from 1e-3 to 1e-12 would take that many.
    plain = math.log(1e-9) / (2.0 * math.log(math.cos(math.pi / (free + 1))))
    assert ended.steps < (0.75 if free == 10 else 0.5) * plain


def test_the_formula_inverts_the_ratio_that_it_is_made_from() -> None:
    """For ω below the best one the slowest ratio η solves (η + ω - 1)² = η ω² ρ²; the formula finds ρ and the best."""
    rho = 0.99
    best = 2.0 / (1.0 + math.sqrt(1.0 - rho**2))
    for omega in (1.0, 1.3, 1.6):
        root = 0.5 * (omega * rho + math.sqrt(omega**2 * rho**2 - 4.0 * (omega - 1.0)))
        found, final = better_factor(omega, root**2)
        assert not final
        assert found == pytest.approx(best - 0.25 * (2.0 - best), rel=1e-9)
    assert better_factor(1.9, 0.89) == (1.9, True)  # η < ω - 1: ω is above the best, and η says no more


def test_no_sweep_raises_the_energy_however_far_and_stiff() -> None:
    """Each step lowers the energy of the node's own links, and so of the mesh, but by rounding of its sum (1e-13)."""
    mesh = block(ratio=1e6)
    x = mesh.rest.copy()
    x[-1] += [5.0, 3.0, -4.0]
    order = np.flatnonzero(~mesh.fixed)[:-1].astype(np.int32)
    load = np.zeros_like(x)
    before = energy(mesh, x)
    for omega in (1.0, 1.5, 1.9, 1.99):
        for _ in range(20):
            sweep(
                x, order, mesh.start, mesh.neighbour, mesh.via, mesh.rest_length, mesh.stiffness, load, omega
            )  # fmt: skip
            after = energy(mesh, x)
            assert after <= before * (1.0 + 1e-13)
            before = after


def distance_allowed(mesh: LinkMesh, x: Array, moved: np.ndarray, residual_mN: float) -> float:
    """How far, mm, ``x`` may be from an equilibrium: residual / softest stiffness, twice for the second order."""
    free = np.setdiff1d(np.flatnonzero(~mesh.fixed), moved)
    at = (3 * free[:, None] + np.arange(3)).ravel()
    softest = float(np.linalg.eigvalsh(hessian(mesh, x)[np.ix_(at, at)])[0])
    assert softest > 0.0, "not a stable equilibrium"
    return 2.0 * residual_mN / softest


def test_the_answer_is_a_stable_equilibrium_and_a_region_limit_leaves_the_rest() -> None:
    mesh = block()
    node = np.array([len(mesh.rest) - 1])
    place = mesh.rest[node] + [0.5, 0.2, 0.1]
    method = BlockSweeps(mesh)
    ended = method.move(node, place, tolerance_mN=1e-9)
    assert ended.converged
    inner = np.setdiff1d(np.flatnonzero(~mesh.fixed), node)
    assert np.linalg.norm(forces(mesh, method.x)[inner]) <= 1e-9
    assert distance_allowed(mesh, method.x, node, 1e-9) < 1e-6
    near = BlockSweeps(mesh)
    near.move(node, place, tolerance_mN=1e-9, most_links=1)
    untouched = np.max(np.abs(mesh.rest - mesh.rest[node]), axis=1) > 1
    assert np.array_equal(near.x[untouched], mesh.rest[untouched])
