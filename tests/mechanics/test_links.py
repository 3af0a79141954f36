"""Verification of link meshes: each test states the law that it checks."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.geometry import Array
from trainer.mechanics.links import (
    LinkMesh,
    diagonal_blocks,
    energy,
    forces,
    hessian,
    link_mesh,
    stiffness_from_modulus,
    tetrahedron_volumes,
)

MODULUS_kPa = 1000.0


def five_tetrahedra(cells: int) -> tuple[Array, np.ndarray]:
    """A cube of ``cells``³ unit cells, each split into five tetrahedra, mirrored from cell to cell."""
    n = cells + 1
    index = np.arange(n**3).reshape(n, n, n)
    rest = np.stack(np.meshgrid(*[np.arange(n, dtype=np.float64)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.array([(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)])
    tetrahedra = []
    for cell in np.ndindex(cells, cells, cells):
        at = corner + cell
        even = at.sum(axis=1) % 2 == 0
        nodes = index[tuple(at.T)]
        tetrahedra.append(nodes[even])
        for k in np.flatnonzero(~even):
            tetrahedra.append(np.append(nodes[np.abs(corner - corner[k]).sum(axis=1) == 1], nodes[k]))
    return rest, np.array(tetrahedra)


@pytest.fixture(scope="module")
def block() -> LinkMesh:
    rest, tetrahedra = five_tetrahedra(2)
    links, stiffness = stiffness_from_modulus(rest, tetrahedra, MODULUS_kPa)
    return link_mesh(rest, links, stiffness, np.zeros(len(rest), dtype=bool))


def deformed(mesh: LinkMesh) -> Array:
    return mesh.rest + np.random.default_rng(1).normal(scale=0.1, size=mesh.rest.shape)


def test_rest_is_free_of_force(block: LinkMesh) -> None:
    """l = l0 in every link: no force at all, since both lengths come from the same numbers.

    The kernel's root and numpy's may differ by one unit in the last place, 2e-16 of a length of 1.4, times a
    stiffness of up to 700 mN/mm and 18 links at a node: 1e-11 mN is far above it.
    """
    assert np.abs(forces(block, block.rest)).max() < 1e-11


def test_tetrahedra_fill_the_block() -> None:
    rest, tetrahedra = five_tetrahedra(3)
    assert tetrahedron_volumes(rest, tetrahedra).sum() == pytest.approx(27.0, rel=1e-14)


def test_stiffness_keeps_the_sum_of_an_isotropic_solid() -> None:
    """Σ k L² = 6 E V, for any tetrahedra: here a distorted block whose volume is Σ V_T."""
    rest, tetrahedra = five_tetrahedra(2)
    rest = rest + np.random.default_rng(0).uniform(-0.2, 0.2, rest.shape)
    links, k = stiffness_from_modulus(rest, tetrahedra, MODULUS_kPa)
    squared = np.sum((rest[links[:, 0]] - rest[links[:, 1]]) ** 2, axis=1)
    volume = tetrahedron_volumes(rest, tetrahedra).sum()
    assert k @ squared == pytest.approx(6.0 * MODULUS_kPa * volume, rel=1e-13)


def test_patch_uniform_stretch_leaves_inner_nodes_in_balance() -> None:
    """Patch test: under a uniform deformation gradient the inner nodes feel no force.

    Each inner node's links come in pairs of opposite direction, equal length and stiffness, so that it holds to
    rounding: forces of 1e3 mN of 26 links at 1e-16 each, 1e-11 mN.
    """
    rest, tetrahedra = five_tetrahedra(4)
    links, k = stiffness_from_modulus(rest, tetrahedra, MODULUS_kPa)
    mesh = link_mesh(rest, links, k, np.zeros(len(rest), dtype=bool))
    gradient = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.05], [-0.1, 0.0, 1.0]])
    inner = np.all((rest > 0.5) & (rest < 3.5), axis=1)
    assert np.abs(forces(mesh, rest @ gradient.T)[~inner]).max() > 1.0
    assert np.abs(forces(mesh, rest @ gradient.T)[inner]).max() < 1e-11


def test_axial_constants_of_split_cubes() -> None:
    """C_xxxx = 4/3 E and C_xxyy = 1/3 E for unit cubes split into five (docstring of stiffness_from_modulus: 1.2 E).

    Per cube the 12 sides have k L² = E V / 6 and the 6 diagonals 2/3 E V. Along x lie 4 sides and, at 45 degrees,
    4 diagonals: C_xxxx = 4/6 + 4 · 2/3 · 1/4 = 4/3; C_xxyy = 2 · 2/3 · 1/4 = 1/3. The energy of a strain e along x is
    V C_xxxx e² / 2; at e = 1e-5 the diagonals' own nonlinearity changes it by about e, hence 1e-4.
    """
    rest, tetrahedra = five_tetrahedra(2)
    links, k = stiffness_from_modulus(rest, tetrahedra, MODULUS_kPa)
    mesh = link_mesh(rest, links, k, np.zeros(len(rest), dtype=bool))
    e, volume = 1e-5, 8.0
    along = energy(mesh, rest * (1.0 + e, 1.0, 1.0))
    both = energy(mesh, rest * (1.0 + e, 1.0 + e, 1.0))
    assert along == pytest.approx(0.5 * volume * 4.0 / 3.0 * MODULUS_kPa * e**2, rel=1e-4)
    assert (both - 2.0 * along) / (volume * e**2) == pytest.approx(MODULUS_kPa / 3.0, rel=1e-4)


def test_internal_forces_and_moments_sum_to_zero(block: LinkMesh) -> None:
    """Newton's third law, along the line between two nodes: no net force and no net moment.

    Forces of up to 1e3 mN at 1e-16, summed over about 200 links at a distance of up to 3 mm: 1e-10.
    """
    x = deformed(block)
    f = forces(block, x)
    assert np.abs(f).max() > 1.0
    assert np.abs(f.sum(axis=0)).max() < 1e-10
    assert np.abs(np.cross(x, f).sum(axis=0)).max() < 1e-10


def test_forces_are_minus_the_energy_gradient(block: LinkMesh) -> None:
    """Central differences at h = 1e-5: truncation h² times third derivatives (~1e3) 1e-7, rounding 1e-12 / h 1e-7."""
    x, h = deformed(block), 1e-5
    f = forces(block, x)
    for i, c in ((0, 0), (13, 1), (26, 2), (7, 2)):
        d = np.zeros_like(x)
        d[i, c] = h
        assert (energy(block, x - d) - energy(block, x + d)) / (2 * h) == pytest.approx(f[i, c], abs=1e-5)


def test_hessian_against_differences_of_forces(block: LinkMesh) -> None:
    """Central differences at h = 1e-5: truncation h² k / L² ~ 1e-7, rounding 1e-12 / h ~ 1e-7; 1e-5 covers both."""
    x, h = deformed(block), 1e-5
    full = hessian(block, x)
    for column in (0, 17, 40, 80):
        d = np.zeros(x.size)
        d[column] = h
        d = d.reshape(x.shape)
        difference = (forces(block, x - d) - forces(block, x + d)).ravel() / (2 * h)
        assert np.abs(full[:, column] - difference).max() < 1e-5


def test_projected_hessian_has_no_negative_direction(block: LinkMesh) -> None:
    """Compressed to half, the plain Hessian is indefinite and the projected one is not (rounding: 1e-10 of 1e3)."""
    x = 0.5 * block.rest + 0.01 * np.random.default_rng(2).normal(size=block.rest.shape)
    assert np.linalg.eigvalsh(hessian(block, x)).min() < -1.0
    assert np.linalg.eigvalsh(hessian(block, x, project=True)).min() > -1e-7


def test_diagonal_blocks_are_those_of_the_hessian(block: LinkMesh) -> None:
    x = deformed(block)
    full = hessian(block, x)
    for i, b in enumerate(diagonal_blocks(block, x)):
        assert np.array_equal(full[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], b)


def test_adjacency_lists_every_link_from_both_ends(block: LinkMesh) -> None:
    found = set()
    for i in range(len(block.rest)):
        for entry in range(block.start[i], block.start[i + 1]):
            assert set(block.links[block.via[entry]]) == {i, block.neighbour[entry]}
            found.add((i, int(block.via[entry])))
    assert len(found) == 2 * len(block.links)


def test_a_link_without_length_is_refused() -> None:
    with pytest.raises(ValueError, match="link 0 joins two nodes"):
        link_mesh(np.zeros((2, 3)), np.array([[0, 1]]), np.ones(1), np.zeros(2, dtype=bool))
